"""The gradient of one update of REINFORCE, at once or micro-batch by micro-batch."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.utils import explained_variance

from sb3_uav.common import distributed
from sb3_uav.reinforce.episode_batch import EpisodeBatch
from sb3_uav.reinforce.finite import require_finite
from sb3_uav.reinforce.losses import LossParts, episode_advantages, episode_loss, real_steps, step_loss


def accumulate_gradients(model: Any, batch: EpisodeBatch | None) -> th.Tensor:
    """
    Replace the gradients of the policy's parameters by those of the loss of one update.

    The advantages are those of the whole batch, so that micro-batches give the same gradient but for rounding.

    :param model: A REINFORCE algorithm, whose logger gets the parts of the loss
    :param batch: The episodes; None to use the steps in its rollout buffer
    :return: The loss, a scalar without gradients
    :raises DivergenceError: If a baseline or an advantage is not finite
    """
    model.policy.optimizer.zero_grad()
    if batch is None:
        require_finite(model, advantage=th.as_tensor(model.rollout_buffer.advantages))
        parts = step_loss(model)
        parts.loss.backward()
    else:
        parts, baseline = _over_ranks(model, _accumulate_episodes(model, batch), batch.weight * batch.baseline.mean().item())
        if model.baseline != "critic":
            model.logger.record("train/baseline", baseline)
    model.logger.record("train/policy_gradient_loss", parts.policy.item())
    model.logger.record("train/entropy_loss", -parts.entropy.item())
    if parts.value is not None:
        model.logger.record("train/value_loss", parts.value.item())
    return parts.loss.detach()


def _accumulate_episodes(model: Any, batch: EpisodeBatch) -> LossParts:
    policy = model.policy
    micro_batches = batch.micro_batches()
    whole = policy.evaluate_episodes(batch.instances, batch.actions, batch.cache) if len(micro_batches) == 1 else None
    values = None
    if model.baseline == "critic":
        values = whole.values.detach() if whole is not None else _values(model, micro_batches)
        real = real_steps(model, batch)
        batch = batch._replace(n_steps=distributed.total(int(real.sum())))
        to_go = batch.rewards_to_go(model.problem)[real]
        variance = explained_variance(values[real].cpu().numpy(), to_go.cpu().numpy())
        model.logger.record("train/explained_variance", float(variance))
    advantages = episode_advantages(model, batch, values)
    require_finite(model, baseline=batch.baseline, advantage=advantages)
    total: LossParts | None = None
    for part, chosen in zip(micro_batches, advantages.split([len(part.instances) for part in micro_batches]), strict=True):
        evaluation = whole or policy.evaluate_episodes(part.instances, part.actions, part.cache)
        loss = episode_loss(model, part, evaluation, chosen, batch)
        loss.loss.backward()
        total = loss.detach() if total is None else total.plus(loss.detach())
    assert total is not None
    return total


def _over_ranks(model: Any, parts: LossParts, baseline: float) -> tuple[LossParts, float]:
    """
    Add the gradients of all processes.

    :param model: A REINFORCE algorithm
    :param parts: This process's part of the loss
    :param baseline: Its part of the mean of the baseline values
    :return: The sums over all processes, by which all of them decide alike whether they are finite
    """
    own = [part.item() for part in parts if part is not None]
    *sums, baseline = distributed.sum_gradients(list(model.policy.parameters()), *own, baseline)
    if distributed.world_size() == 1:
        return parts, baseline
    loss, policy, entropy, *value = [th.tensor(number, dtype=th.float32, device="cpu") for number in sums]
    return LossParts(loss, policy, entropy, value[0] if value else None), baseline


@th.no_grad()
def _values(model: Any, micro_batches: list[EpisodeBatch]) -> th.Tensor:
    """:return: ``(batch, n_samples, n_steps)``, the critic's estimates of all micro-batches"""
    policy = model.policy
    return th.cat([policy.evaluate_episodes(part.instances, part.actions, part.cache).values for part in micro_batches])
