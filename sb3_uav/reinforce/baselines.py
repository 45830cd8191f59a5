"""Baselines that REINFORCE subtracts from returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import deepcopy
from typing import Any, Protocol

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_uav.common import distributed
from sb3_uav.common.random_streams import HELD_OUT_STREAM, random_stream
from sb3_uav.common.statistics import significantly_positive
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem

# Number of test instances decoded at once: the smaller of the paper's batch sizes.
_TEST_ROWS = 256


class Learner(Protocol):
    """
    The part of an algorithm that its baseline uses.

    :param policy: The policy that learns
    :param baseline_policy: A copy of it for greedy episodes, if the baseline needs one
    :param baseline_state: Plain data that the baseline keeps between runs
    :param epoch: Number of complete epochs
    :param stream_seed: Seed of the random streams
    :param device: Device of the policy
    :param logger: SB3's logger
    """

    baseline_state: dict[str, Any]
    epoch: int
    stream_seed: int
    device: th.device

    @property
    def policy(self) -> Any: ...

    @property
    def baseline_policy(self) -> Any: ...

    @property
    def logger(self) -> Logger: ...


class Baseline(ABC):
    """
    A baseline of returns.

    State that must survive between runs is kept in ``model.baseline_state`` (plain data) or in a module that the model saves.

    :param model: The algorithm, usually :class:`~sb3_uav.reinforce.REINFORCE`
    """

    # Whether the baseline needs whole episodes on known instances, which only the fused driver provides.
    needs_episodes = False

    def __init__(self, model: Learner) -> None:
        self.model = model

    @abstractmethod
    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        """
        :param problem: The problem being learned
        :param instances: ``batch`` instances on the device of the policy
        :param returns: ``(batch, n_samples)`` float64
        :return: Baseline values, float64, broadcastable against ``returns``
        """

    def of_steps(self, returns: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        :param returns: ``(n_steps, n_envs)``, discounted rewards to go of complete episodes, NaN elsewhere
        :param values: ``(n_steps, n_envs)``, the critic's estimates
        :return: Baseline values, broadcastable against ``returns``
        :raises ValueError: If the baseline needs whole episodes
        """
        raise ValueError(f"{type(self).__name__} needs whole episodes.")

    def end_epoch(self, problem: Problem) -> None:
        """
        Called after the last update of an epoch; if an update completes several epochs, once, for the last of them.

        :param problem: The problem being learned
        """
        return


class _NoBaseline(Baseline):
    """No baseline: the advantage is the return."""

    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        return th.zeros_like(returns[:1, :1])

    def of_steps(self, returns: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.zeros((1, 1))


class _ExponentialBaseline(Baseline):
    """
    Exponential moving average of the mean return, including the current batch (Kool et al., appendix).

    :param model: The algorithm
    :param beta: Weight of the previous average
    """

    def __init__(self, model: Learner, beta: float = 0.8) -> None:
        super().__init__(model)
        if not 0 <= beta < 1:
            raise ValueError(f"beta of the exponential baseline is {beta}; it must be >= 0 and < 1.")
        self.beta = beta

    def _update(self, mean: float) -> float:
        state = self.model.baseline_state
        state["mean_return"] = (
            mean if "mean_return" not in state else self.beta * state["mean_return"] + (1 - self.beta) * mean
        )
        return state["mean_return"]

    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        # Instances are shared out evenly, but for one; the mean is weighted by their numbers.
        n_rows = distributed.total(len(returns))
        mean = (
            returns.mean().item()
            if distributed.world_size() == 1
            else distributed.total(returns.mean(1).sum().item()) / n_rows
        )
        return th.full_like(returns[:1, :1], self._update(mean))

    def of_steps(self, returns: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.full((1, 1), self._update(float(np.nanmean(returns))))


class _SharedBaseline(Baseline):
    """The mean return of the ``n_samples`` episodes of the same instance."""

    needs_episodes = True

    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        return returns.mean(1, keepdim=True)


class _CriticBaseline(Baseline):
    """The policy's value network, trained with the policy and subtracted from the rewards to go at each step."""

    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        return th.zeros_like(returns[:1, :1])

    def of_steps(self, returns: np.ndarray, values: np.ndarray) -> np.ndarray:
        return values


class _RolloutBaseline(Baseline):
    """
    Greedy episodes of a copy of the policy (paper, section IV-C; Kool et al.).

    An exponential moving average replaces it during the first epochs. After each epoch, the copy is replaced if the policy is
    significantly better on fresh instances that are not used in training. Both are evaluated on these instances after each
    epoch, so the comparison always uses the current router.

    :param model: The algorithm
    :param warmup_epochs: Number of epochs with the exponential moving average
    :param beta: Weight of the previous average in the exponential moving average
    :param n_test_instances: Number of instances for the t-test
    :param alpha: Significance level of the one-sided paired t-test
    """

    needs_episodes = True

    def __init__(
        self,
        model: Learner,
        warmup_epochs: int = 1,
        beta: float = 0.8,
        n_test_instances: int = 10_000,
        alpha: float = 0.05,
    ) -> None:
        super().__init__(model)
        if n_test_instances < 2:
            raise ValueError(f"n_test_instances is {n_test_instances}; a paired t-test needs at least 2.")
        if not 0 < alpha < 1:
            raise ValueError(f"alpha is {alpha}; a significance level lies between 0 and 1.")
        self.warmup = _ExponentialBaseline(model, beta)
        self.warmup_epochs = warmup_epochs
        self.n_test_instances = n_test_instances
        self.alpha = alpha

    def of_episodes(self, problem: Problem, instances: Instances, returns: th.Tensor) -> th.Tensor:
        if self.model.epoch < self.warmup_epochs:
            return self.warmup.of_episodes(problem, instances, returns)
        assert self.model.baseline_policy is not None
        return _greedy_returns(self.model.baseline_policy, problem, instances)

    def end_epoch(self, problem: Problem) -> None:
        assert self.model.baseline_policy is not None
        policy, copy = self.model.policy, self.model.baseline_policy
        draw = getattr(problem.generator, "held_out", problem.generator)
        instances = draw(self.n_test_instances, random_stream(self.model.stream_seed, HELD_OUT_STREAM, self.model.epoch))
        n_instances = len(instances)
        instances = copy.arrange(instances)[distributed.shard(n_instances)]
        gains = []
        for rows in th.arange(len(instances), device=instances.device).split(_TEST_ROWS):
            part = instances[rows].to(self.model.device)
            gains.append((_greedy_returns(policy, problem, part) - _greedy_returns(copy, problem, part)).cpu())
        # All processes test the same numbers, so that they come to the same decision.
        gain = distributed.gather(th.cat(gains).flatten(), n_instances).numpy()
        replaced = significantly_positive(gain, self.alpha)
        if replaced:
            copy.load_state_dict(deepcopy(policy.state_dict()))
        self.model.logger.record("train/baseline_gain", float(gain.mean()))
        self.model.logger.record("train/baseline_replaced", int(replaced))


def _greedy_returns(policy: Any, problem: Problem, instances: Instances) -> th.Tensor:
    """
    :param policy: An ``EpisodicPolicy``
    :param problem: The problem to play
    :param instances: ``batch`` instances on the device of the policy
    :return: ``(batch, 1)`` float64, returns of the policy's greedy episodes
    """
    was_training = policy.training
    policy.set_training_mode(False)
    returns = problem.returns(instances, policy.decode_episodes(instances))
    policy.set_training_mode(was_training)
    return returns


BASELINES: dict[str, type[Baseline]] = {
    "none": _NoBaseline,
    "exponential": _ExponentialBaseline,
    "shared": _SharedBaseline,
    "critic": _CriticBaseline,
    "rollout": _RolloutBaseline,
}
