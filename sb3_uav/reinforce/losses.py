"""The losses of REINFORCE: of whole episodes, and of the steps of SB3's loop."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.utils import explained_variance

from sb3_uav.reinforce.advantages import BY_INSTANCE, scale_advantages, scale_by_instance
from sb3_uav.reinforce.episode_batch import EpisodeBatch


def episode_loss(model: Any, batch: EpisodeBatch) -> th.Tensor:
    """
    mean((baseline - return) * sum of log-probabilities) (paper, equation (24)).

    :param model: A REINFORCE algorithm, whose logger gets the parts of the loss
    :param batch: The episodes
    :return: The loss, a scalar
    """
    evaluation = model.policy.evaluate_episodes(batch.instances, batch.actions, batch.cache)
    value_loss = None
    if model.baseline == "critic":
        # Actions after the end of an episode are padding.
        lengths = model.problem.lengths(batch.instances, batch.actions)
        real = th.arange(batch.actions.shape[-1], device=lengths.device) < lengths[..., None]
        to_go, values = batch.rewards_to_go(model.problem)[real], evaluation.values[real]
        value_loss = ((to_go - values) ** 2).mean()
        variance = explained_variance(values.detach().cpu().numpy(), to_go.cpu().numpy())
        model.logger.record("train/explained_variance", float(variance))
        weighted = th.zeros_like(evaluation.log_prob)
        weighted[real] = _normalized(model, to_go - values.detach()) * evaluation.log_prob[real]
    else:
        model.logger.record("train/baseline", batch.baseline.mean().item())
        advantages = _normalized(model, (batch.returns - batch.baseline).float())
        weighted = advantages[..., None] * evaluation.log_prob
    policy_loss = -weighted.sum(-1).mean()
    return _total_loss(model, policy_loss, evaluation.entropy.sum(-1).mean(), value_loss)


def step_loss(model: Any) -> th.Tensor:
    """
    :param model: A REINFORCE algorithm, whose rollout buffer holds the steps
    :return: The loss, a scalar
    """
    data = next(model.rollout_buffer.get(batch_size=None))
    # Of sb3-contrib's buffers; the policies of this package find masks in the observations.
    masks = {"action_masks": data.action_masks} if hasattr(data, "action_masks") else {}
    values, log_prob, entropy = model.policy.evaluate_actions(data.observations, data.actions.flatten().long(), **masks)
    value_loss = None
    if model.baseline == "critic":
        value_loss = ((data.returns - values.flatten()) ** 2).mean()
    mean_entropy = -log_prob.mean() if entropy is None else entropy.mean()
    return _total_loss(model, -(data.advantages * log_prob).mean(), mean_entropy, value_loss)


def _normalized(model: Any, advantages: th.Tensor) -> th.Tensor:
    # The critic's advantages are those of steps, not of episodes.
    if model.normalize_advantage == BY_INSTANCE and advantages.dim() == 2:
        return scale_by_instance(advantages)
    return scale_advantages(advantages) if model.normalize_advantage else advantages


def _total_loss(model: Any, policy_loss: th.Tensor, entropy: th.Tensor, value_loss: th.Tensor | None) -> th.Tensor:
    model.logger.record("train/policy_gradient_loss", policy_loss.item())
    model.logger.record("train/entropy_loss", -entropy.item())
    loss = policy_loss - model.ent_coef * entropy
    if value_loss is not None:
        model.logger.record("train/value_loss", value_loss.item())
        loss = loss + model.vf_coef * value_loss
    return loss
