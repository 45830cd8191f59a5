"""REINFORCE (paper, section IV-C) as an SB3 on-policy algorithm."""

from __future__ import annotations

import io
import math
import pathlib
from collections.abc import Iterable
from copy import deepcopy
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_uav.common import distributed
from sb3_uav.common.divergence import report_weights
from sb3_uav.common.random_streams import ACTION_STREAM, TRAINING_STREAM, draw_seed, random_stream, torch_generator
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs.generators import training_batch
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, MaskedAttentionPolicy, RouterPolicy
from sb3_uav.reinforce.advantages import BY_INSTANCE, complete_steps, step_advantages
from sb3_uav.reinforce.any_size import AnySizeAlgorithm
from sb3_uav.reinforce.baselines import BASELINES, Baseline
from sb3_uav.reinforce.drivers import warn_of_ignored_settings, why_step_loop
from sb3_uav.reinforce.episode_batch import (
    EpisodeBatch,
    PlayedEpisodes,
    episodes_by_sample,
    episodes_of_all,
    steps_of_episodes,
)
from sb3_uav.reinforce.finite import require_finite, require_finite_returns, require_possible_rate
from sb3_uav.reinforce.gradients import accumulate_gradients
from sb3_uav.reinforce.masked_steps import MaskedStepLoop
from sb3_uav.reinforce.micro_batches import MicroBatches, encode_in_parts
from sb3_uav.reinforce.monitor_rows import log_episodes
from sb3_uav.reinforce.ranks import begin_together, part_of_batch
from sb3_uav.reinforce.recognition import find_problem

SelfT = TypeVar("SelfT", bound="REINFORCE")

# More steps than any run takes; learn_instances stops after a number of instances instead.
NO_STEP_LIMIT = 2**62
# Settings of SB3's on-policy algorithms that REINFORCE does not offer: returns are not mixed with value estimates, and actions
# are discrete.
_NOT_OFFERED: dict[str, Any] = dict(gae_lambda=1.0, use_sde=False, sde_sample_freq=-1)

_NOT_SAVED = ("_baseline", "baseline_policy", "_batch", "max_instances", "_micro_batches")


class REINFORCE(MaskedStepLoop, AnySizeAlgorithm):
    """
    REINFORCE with a choice of baselines.

    With the policies and environments of this package, whole episodes of ``n_envs`` instances are played at a time on the
    policy's device (the fused driver): one encoding, ``n_samples`` episodes per instance, one gradient pass over all their
    steps, one update. With any other policy or environment, SB3's loop collects ``n_steps`` steps per environment, and the
    episodes that are completed in them are used for training; the baselines ``shared`` and ``rollout``, which replay
    instances, are then not available. Settings without effect are reported by a warning. Policies of sb3-contrib get the
    environment's action masks, see :class:`~sb3_uav.reinforce.masked_steps.MaskedStepLoop`.

    Under ``torchrun`` (see :mod:`sb3_uav.common.distributed`) the fused driver shares the ``n_envs`` instances of an update
    among the processes; the update is that of a single process, but for rounding.

    Training stops with a :class:`~sb3_uav.common.divergence.DivergenceError` before an update whose returns, baseline,
    advantages, loss or gradient are not finite, and warns when a weight exceeds 1,000.

    :param policy: The policy model to use (MlpPolicy, AllocatorPolicy, RouterPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: The learning rate, it can be a function of the current progress remaining (from 1 to 0)
    :param n_steps: Steps per env and update in SB3's loop; the fused driver always plays whole episodes
    :param n_samples: Episodes per instance and update (fused driver)
    :param baseline: ``"none"``, ``"exponential"``, ``"shared"`` (mean over the samples of an instance), ``"critic"`` or
        ``"rollout"`` (the paper's)
    :param baseline_kwargs: Arguments of the baseline, see :mod:`sb3_uav.reinforce.baselines`
    :param instances_per_epoch: Instances per epoch (fused driver); after the update that completes it, the rollout baseline is
        tested and the learning rate decays
    :param lr_decay: Factor by which the learning rate is multiplied after each epoch (fused driver)
    :param gamma: Discount factor (SB3's loop; the fused driver does not discount)
    :param ent_coef: Entropy coefficient for the loss calculation
    :param vf_coef: Value function coefficient for the loss calculation (baseline ``critic``)
    :param max_grad_norm: The maximum value for the gradient clipping
    :param normalize_advantage: Whether to divide advantages by their standard deviation (SB3's loop, like SB3's A2C, also
        subtracts their mean); ``"instance"`` divides those of each instance by their own (fused driver), for instances whose
        returns differ much
    :param micro_batch_size: Number of instances whose gradients are computed at once (fused driver); the update is the same,
        but for rounding, with less memory. When None all of a batch, or as many as fit into memory, see
        :mod:`sb3_uav.reinforce.micro_batches`
    :param stats_window_size: Window size for the rollout logging
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ActorCriticPolicy,
        "CnnPolicy": ActorCriticCnnPolicy,
        "MultiInputPolicy": MultiInputActorCriticPolicy,
        "AllocatorPolicy": AllocatorPolicy,
        "RouterPolicy": RouterPolicy,
        "MaskedAttentionPolicy": MaskedAttentionPolicy,
    }

    # See sb3_uav.reinforce.finite.watch.
    checks_its_updates: ClassVar[bool] = True
    # SB3 declares an ActorCriticPolicy, which ours are not.
    policy: ActorCriticPolicy | MaskableActorCriticPolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        n_steps: int = 512,
        n_samples: int = 1,
        baseline: str = "exponential",
        baseline_kwargs: dict[str, Any] | None = None,
        instances_per_epoch: int = 1_280_000,
        lr_decay: float = 1.0,
        gamma: float = 1.0,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 1.0,
        normalize_advantage: bool | str = False,
        micro_batch_size: int | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            **_NOT_OFFERED,
            max_grad_norm=max_grad_norm,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            supported_action_spaces=(spaces.Discrete,),
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.n_samples = n_samples
        self.baseline = baseline
        self.baseline_kwargs = baseline_kwargs or {}
        self.instances_per_epoch = instances_per_epoch
        self.lr_decay = lr_decay
        if isinstance(normalize_advantage, str) and normalize_advantage != BY_INSTANCE:
            raise ValueError(f"normalize_advantage is {normalize_advantage!r}; give True, False or {BY_INSTANCE!r}.")
        self.normalize_advantage = normalize_advantage
        self.micro_batch_size = micro_batch_size
        # State from which a resumed run continues as if it had not been interrupted.
        self.stream_seed = draw_seed() if seed is None else seed
        self.baseline_state: dict[str, Any] = {}
        self.baseline_policy: EpisodicPolicy | None = None
        self.n_batches = 0
        self.n_instances = 0
        self.epoch = 0
        self._n_updates = 0
        # Difference between num_timesteps, which grows by n_envs at a time, and the total length of the episodes played.
        self.steps_ahead = 0
        # Training stops at this number of instances; set by learn_instances and by the ITS callback.
        self.max_instances: int | None = None
        self._batch: EpisodeBatch | None = None

        if _init_setup_model:
            self._setup_model()

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/on_policy_algorithm.py#L115
    def _setup_model(self) -> None:
        for name in ("n_samples", "instances_per_epoch", "n_steps"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} is {value!r}; it must be a whole number of at least 1.")
        self._micro_batches = MicroBatches(self.micro_batch_size)
        if not self.lr_decay > 0:
            raise ValueError(f"lr_decay is {self.lr_decay}; it must be above 0.")
        if self.baseline not in BASELINES:
            raise ValueError(f"baseline is {self.baseline!r}; choose one of {sorted(BASELINES)}.")
        if self.baseline == "shared" and self.n_samples < 2:
            raise ValueError("baseline 'shared' is the mean of several samples: set n_samples to at least 2.")
        n_steps = self.n_steps
        if issubclass(self.policy_class, EpisodicPolicy):
            # The fused driver does not use SB3's buffer, so do not allocate a large one.
            self.n_steps = 1
        super()._setup_model()
        self.n_steps = n_steps
        try:
            self._baseline: Baseline = BASELINES[self.baseline](self, **self.baseline_kwargs)
        except TypeError as error:
            raise ValueError(
                f"baseline_kwargs {self.baseline_kwargs} do not fit baseline {self.baseline!r}: {error}"
            ) from error
        if self._baseline.needs_episodes and not issubclass(self.policy_class, EpisodicPolicy):
            self._refuse_baseline()
        if self.baseline == "rollout":
            assert isinstance(self.policy, EpisodicPolicy)
            self.baseline_policy = deepcopy(self.policy)
            self.baseline_policy.requires_grad_(False)
            self.baseline_policy.set_training_mode(False)
        if self.baseline != "critic" and hasattr(self.policy, "value_net"):
            # It is never trained; with zero values, SB3's bootstrapping at time limits adds nothing.
            for parameter in self.policy.value_net.parameters():
                th.nn.init.zeros_(parameter)

    def _refuse_baseline(self) -> None:
        raise ValueError(
            f"baseline {self.baseline!r} replays instances, which needs a sb3_uav policy on a sb3_uav environment, but "
            f"{why_step_loop(self.policy_class, self.env)}; use 'none', 'exponential' or 'critic' here."
        )

    @property
    def problem(self) -> Problem | None:
        """The problem that the fused driver plays; None if the policy or the environment requires SB3's step loop."""
        if not isinstance(self.policy, EpisodicPolicy) or self.env is None:
            return None
        return find_problem(self.env)

    def draw_batch(self, index: int) -> Instances:
        """
        The training instances of one update, the same at every call.

        :param index: Number of the update, from 0
        :return: The instances on the CPU, tasks in the policy's preferred order; ``n_envs`` unless the generator mixes sizes
        """
        assert self.problem is not None and isinstance(self.policy, EpisodicPolicy)
        rng = random_stream(self.stream_seed, TRAINING_STREAM, index)
        return self.policy.arrange(training_batch(self.problem.generator, self.n_envs, rng))

    def action_generator(self, counter: int) -> th.Generator:
        """
        :param counter: Number of the update, from 0
        :return: The random generator for sampling its actions, on the device of the policy
        """
        return torch_generator(random_stream(self.stream_seed, ACTION_STREAM, counter), self.device)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        problem = self.problem
        if problem is not None:
            return self._collect_episodes(problem, env, callback)
        if self._baseline.needs_episodes:
            self._refuse_baseline()
        if rollout_buffer.buffer_size != n_rollout_steps:
            rollout_buffer.buffer_size = n_rollout_steps
        if not super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps):
            return False
        if self.baseline == "critic":
            # The critic bootstraps the return beyond the end of the buffer.
            complete = np.ones_like(rollout_buffer.returns, dtype=bool)
        else:
            assert self._last_episode_starts is not None
            complete = complete_steps(rollout_buffer, self._last_episode_starts)
        rollout_buffer.advantages = step_advantages(rollout_buffer, complete, self._baseline, bool(self.normalize_advantage))
        return True

    def _collect_episodes(self, problem: Problem, env: VecEnv, callback: BaseCallback) -> bool:
        """Play ``n_samples`` complete episodes on each of ``n_envs`` new instances."""
        assert isinstance(self.policy, EpisodicPolicy)
        self._batch = None
        callback.on_rollout_start()
        if self.max_instances is not None and self.n_instances >= self.max_instances:
            return False
        instances, n_instances, generator = part_of_batch(self)
        # In training mode and with gradients: the gradient pass uses this encoding too, so that batch normalization acts and
        # learns with the same statistics.
        self.policy.set_training_mode(True)
        size = self._micro_batches.size(self, instances)
        cache = self.policy.encode(instances) if size is None else encode_in_parts(self.policy, instances, size)
        actions = self.policy.decode_episodes(instances, self.n_samples, False, generator, cache)
        with th.no_grad():
            returns = problem.returns(instances, actions)
            samples = episodes_of_all(episodes_by_sample(problem, instances, actions, returns), n_instances)
            require_finite_returns(self, th.as_tensor(np.stack([played.returns for played in samples]), device="cpu"))
            baseline = self._baseline.of_episodes(problem, instances, returns)
        if not distributed.all_agree(self._report_episodes(env, callback, samples)):
            return False
        # In micro-batches each is encoded again, with gradients.
        self._batch = EpisodeBatch(instances, cache if size is None else None, actions, returns, baseline, size, n_instances)
        callback.on_rollout_end()
        return True

    def _report_episodes(self, env: VecEnv, callback: BaseCallback, samples: list[PlayedEpisodes]) -> bool:
        """
        Count the steps and call the callbacks as SB3's loop does, once per ``n_envs`` steps.

        :param samples: The episodes of each sample, one per instance
        :return: False if a callback stops the training
        """
        for played in samples:
            n_played = int(played.lengths.sum())
            n_calls = max(math.ceil((n_played - self.steps_ahead) / self.n_envs), 1)
            self.steps_ahead += n_calls * self.n_envs - n_played
            # Callbacks find rewards, dones and infos among the local variables, as in SB3's loop.
            for rewards, dones, infos in steps_of_episodes(played, n_calls):  # noqa: B007
                self.num_timesteps += self.n_envs
                if dones.all():
                    log_episodes(env, infos)
                callback.update_locals(locals())
                if not callback.on_step():
                    return False
            self._update_info_buffer(infos, dones)
        return True

    def train(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        batch, self._batch = self._batch, None
        loss = accumulate_gradients(self, batch)
        grad_norm = th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        require_finite(self, loss=loss, gradient_norm=grad_norm)
        require_possible_rate(self, self.policy.optimizer)
        self.policy.optimizer.step()
        report_weights(self)
        self._n_updates += 1
        self.logger.record("train/loss", loss.item())
        self.logger.record("train/grad_norm", grad_norm.item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

        problem = self.problem
        if problem is not None:
            self.n_batches += 1
            self.n_instances += self.n_envs if batch is None else batch.n_instances
            self.logger.record("train/epoch", self.epoch)
            complete = self.n_instances // self.instances_per_epoch
            if complete > self.epoch:
                # A batch may complete several epochs. The policy is the same at the end of each of them, so the baseline is
                # updated once, as at the end of the last.
                self.epoch = complete - 1
                self._baseline.end_epoch(problem)
                self.epoch = complete

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L287
    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            for group in optimizer.param_groups:
                group["lr"] *= self.lr_decay**self.epoch
            self.logger.record("train/learning_rate", optimizer.param_groups[0]["lr"])

    def learn(
        self: SelfT,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "REINFORCE",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfT:
        warn_of_ignored_settings(self)
        callback, progress_bar = begin_together(self, callback, progress_bar)
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def learn_instances(
        self: SelfT, n_instances: int, callback: MaybeCallback = None, log_interval: int = 1, tb_log_name: str = "REINFORCE"
    ) -> SelfT:
        """
        Continue training for a number of instances, however many steps they take (fused driver only).

        Learning rate schedules do not advance during the call, because the number of steps is not known in advance; the decay
        by ``lr_decay`` does.

        :param n_instances: Number of further instances to train on, rounded up to whole batches
        :param callback: Callback(s) called at every step
        :param log_interval: Number of updates between logs
        :param tb_log_name: Name of the run for TensorBoard logging
        :return: The trained model
        :raises ValueError: If the policy or the environment requires SB3's step loop
        """
        if self.problem is None:
            reason = why_step_loop(self.policy_class, self.env)
            raise ValueError(f"learn_instances needs whole episodes, but {reason}; use learn here.")
        self.max_instances = self.n_instances + n_instances
        try:
            is_new = self.num_timesteps == 0
            return self.learn(NO_STEP_LIMIT - self.num_timesteps, callback, log_interval, tb_log_name, is_new)
        finally:
            self.max_instances = None

    def set_parameters(self, load_path_or_dict: Any, exact_match: bool = True, device: th.device | str = "auto") -> None:
        if isinstance(load_path_or_dict, dict):
            # Training may continue with another baseline than the one the model was saved with.
            parameters = dict(load_path_or_dict)
            if self.baseline != "rollout":
                parameters.pop("baseline_policy", None)
            elif "policy" in parameters:
                parameters.setdefault("baseline_policy", parameters["policy"])
            load_path_or_dict = parameters
        super().set_parameters(load_path_or_dict, exact_match, device)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        save_atomically(self, path, exclude, include)

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/base_class.py#L303
    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *_NOT_SAVED]

    # https://github.com/DLR-RM/stable-baselines3/blob/v2.9.2/stable_baselines3/common/on_policy_algorithm.py#L343
    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.baseline == "rollout":
            state_dicts = [*state_dicts, "baseline_policy"]
        return state_dicts, variables
