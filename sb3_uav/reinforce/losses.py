"""The losses of REINFORCE: of whole episodes, and of the steps of SB3's loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th

from sb3_uav.common import distributed
from sb3_uav.policies.base import EpisodeEvaluation
from sb3_uav.reinforce.advantages import BY_INSTANCE, scale_advantages, scale_by_instance, scale_steps
from sb3_uav.reinforce.episode_batch import EpisodeBatch


class LossParts(NamedTuple):
    """
    A loss and what it is made of, all scalars.

    :param loss: What is minimized
    :param policy: The policy gradient's part
    :param entropy: Mean entropy
    :param value: The critic's part; None without a critic
    """

    loss: th.Tensor
    policy: th.Tensor
    entropy: th.Tensor
    value: th.Tensor | None

    def detach(self) -> LossParts:
        """:return: The same without gradients"""
        value = None if self.value is None else self.value.detach()
        return LossParts(self.loss.detach(), self.policy.detach(), self.entropy.detach(), value)

    def plus(self, other: LossParts) -> LossParts:
        """
        :param other: The parts of another micro-batch
        :return: The sums
        """
        value = None if self.value is None or other.value is None else self.value + other.value
        return LossParts(self.loss + other.loss, self.policy + other.policy, self.entropy + other.entropy, value)


def real_steps(model: Any, batch: EpisodeBatch) -> th.Tensor:
    """
    :param model: A REINFORCE algorithm
    :param batch: The episodes
    :return: ``(batch, n_samples, n_steps)`` bool, False after the end of an episode, where actions are padding
    """
    lengths = model.problem.lengths(batch.instances, batch.actions)
    return th.arange(batch.actions.shape[-1], device=lengths.device) < lengths[..., None]


def episode_advantages(model: Any, batch: EpisodeBatch, values: th.Tensor | None) -> th.Tensor:
    """
    :param model: A REINFORCE algorithm
    :param batch: All episodes of the update
    :param values: ``(batch, n_samples, n_steps)``, the critic's estimates; None without a critic
    :return: The advantage of every episode, ``(batch, n_samples, 1)``; with a critic of every step, ``(batch, n_samples,
        n_steps)``, 0 after the end of an episode
    """
    if values is None:
        if not model.normalize_advantage:
            return (batch.returns - batch.baseline).float()[..., None]
        # Of the whole batch, whichever processes share it, so that all divide by the same numbers.
        everywhere = distributed.gather((batch.returns - batch.baseline).float(), batch.n_instances)
        return _normalized(model, everywhere)[batch.rows][..., None]
    real = real_steps(model, batch)
    advantages = th.zeros_like(values)
    advantages[real] = _normalized(model, batch.rewards_to_go(model.problem)[real] - values[real])
    return advantages


def episode_loss(
    model: Any, batch: EpisodeBatch, evaluation: EpisodeEvaluation, advantages: th.Tensor, whole: EpisodeBatch
) -> LossParts:
    """
    mean((baseline - return) * sum of log-probabilities) (paper, equation (24)).

    :param model: A REINFORCE algorithm
    :param batch: Some of the episodes of the update, or all
    :param evaluation: The policy's view of them, with gradients
    :param advantages: Their part of :func:`episode_advantages`
    :param whole: All episodes of the update
    :return: What these episodes contribute to the loss of all of them, in all processes
    """
    share = len(batch.instances) / len(whole.instances) * whole.weight
    policy_loss = -(advantages * evaluation.log_prob).sum(-1).mean() * share
    value_loss = None
    if model.baseline == "critic":
        assert whole.n_steps is not None
        real = real_steps(model, batch)
        errors = batch.rewards_to_go(model.problem)[real] - evaluation.values[real]
        value_loss = (errors**2).sum() / whole.n_steps
    return _parts(model, policy_loss, evaluation.entropy.sum(-1).mean() * share, value_loss)


def step_loss(model: Any) -> LossParts:
    """
    :param model: A REINFORCE algorithm, whose rollout buffer holds the steps
    :return: The loss
    """
    data = next(model.rollout_buffer.get(batch_size=None))
    # Of sb3-contrib's buffers; the policies of this package find masks in the observations.
    masks = {"action_masks": data.action_masks} if hasattr(data, "action_masks") else {}
    values, log_prob, entropy = model.policy.evaluate_actions(data.observations, data.actions.flatten().long(), **masks)
    value_loss = None
    if model.baseline == "critic":
        value_loss = ((data.returns - values.flatten()) ** 2).mean()
    mean_entropy = -log_prob.mean() if entropy is None else entropy.mean()
    return _parts(model, -(data.advantages * log_prob).mean(), mean_entropy, value_loss)


def _normalized(model: Any, advantages: th.Tensor) -> th.Tensor:
    # The critic's advantages are those of steps, not of episodes.
    if model.normalize_advantage == BY_INSTANCE and advantages.dim() == 2:
        return scale_by_instance(advantages)
    if not model.normalize_advantage:
        return advantages
    return scale_steps(advantages) if advantages.dim() == 1 else scale_advantages(advantages)


def _parts(model: Any, policy_loss: th.Tensor, entropy: th.Tensor, value_loss: th.Tensor | None) -> LossParts:
    return LossParts(_total_loss(model, policy_loss, entropy, value_loss), policy_loss, entropy, value_loss)


def _total_loss(model: Any, policy_loss: th.Tensor, entropy: th.Tensor, value_loss: th.Tensor | None) -> th.Tensor:
    loss = policy_loss - model.ent_coef * entropy
    return loss if value_loss is None else loss + model.vf_coef * value_loss
