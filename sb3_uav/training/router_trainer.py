"""The router's algorithm and environment, beside the allocator's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_uav.common import distributed
from sb3_uav.common.divergence import note_saved
from sb3_uav.common.epoch_log import EpisodeStatistics
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.common.saving import save_atomically
from sb3_uav.common.sb3_compat import forget_last_observation, set_last_observation
from sb3_uav.envs.generators import InstanceGenerator
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.freezing import Freezer
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.algorithms import resolve_algorithm
from sb3_uav.reinforce.finite import watch
from sb3_uav.reinforce.transfer import fine_tuning_settings, load
from sb3_uav.training.episode_buffer import use_episode_buffer
from sb3_uav.training.safe_load import safe_zips
from sb3_uav.training.subsets import WholeInstances

# Settings that follow from the environment, or that the router's zip decides when a run is resumed.
_NOT_RELOADED = {"algo", "n_envs", "policy", "policy_kwargs", "seed", "device", "instances_per_epoch"}
# Arguments of algorithms that cannot be set here, and why.
_REFUSED = {
    "env": "ITSCallback makes the router's environment from the allocator's; set n_envs for its size",
    "tensorboard_log": "the router logs beside the allocator, in the folder 'router' of its TensorBoard events",
    "_init_setup_model": "the router needs its network when training starts",
}


class RouterTrainer:
    """
    Trains the router epoch by epoch.

    :param settings: ``algo``, ``n_envs``, and the algorithm's own arguments, among them ``policy`` unless there is a zip
    :param allocator: The allocator's algorithm, which gives the logger, and seed and device where the settings have none
    :param n_envs: Number of environments where the settings have none; at most ``epoch_size`` are made
    :param generator: Draws the instances of the fleet
    :param epoch_size: Instances of a router epoch
    :param weights: Zip of a router to start from, with the settings for fine-tuning where there are no others
    :raises ValueError: If a setting is not allowed; the message names it
    """

    def __init__(
        self,
        settings: dict[str, Any],
        allocator: BaseAlgorithm,
        n_envs: int,
        generator: InstanceGenerator,
        epoch_size: int,
        weights: Path | None = None,
    ) -> None:
        self.settings = settings
        self.epoch_size = epoch_size
        kwargs = dict(settings)
        if isinstance(kwargs.get("policy_kwargs"), dict):
            # A2C writes its optimizer into it, and in a YAML both levels may share one mapping.
            kwargs["policy_kwargs"] = dict(kwargs["policy_kwargs"])
        algo = kwargs.pop("algo", "reinforce")
        n_envs = kwargs.pop("n_envs", min(n_envs, epoch_size))
        algorithm = resolve_algorithm(algo)
        for name, reason in _REFUSED.items():
            if name in kwargs:
                raise ValueError(f"router: {name} cannot be set: {reason}.")
        if kwargs.get("policy") in (
            "RouterPolicy",
            f"{RouterPolicy.__module__}.RouterPolicy",
            "sb3_uav.policies.RouterPolicy",
        ):
            kwargs["policy"] = RouterPolicy
        if not isinstance(n_envs, int) or n_envs < 1:
            raise ValueError(f"router: n_envs is {n_envs!r}; it must be a whole number of at least 1.")
        if isinstance(kwargs.get("learning_rate"), str):
            raise ValueError(
                f"router: learning_rate is {kwargs['learning_rate']!r}; write a number. How many steps the router will "
                "take is not known, so it has no schedule but lr_decay."
            )
        if distributed.world_size() > 1 and not issubclass(algorithm, REINFORCE):
            raise ValueError(f"router: algo is {algo!r}; several processes can only share the training of reinforce.")
        if issubclass(algorithm, REINFORCE):
            self._check_epoch(n_envs, kwargs.get("instances_per_epoch", epoch_size))
        whole = WholeInstances(generator)
        self.env = BatchedVecEnv([lambda: RoutePlanningEnv(generator=whole)] * n_envs)
        # The next seed, because with the same one both levels would draw the same points.
        kwargs.setdefault("seed", None if allocator.seed is None else allocator.seed + 1)
        kwargs.setdefault("device", allocator.device)
        try:
            with undisturbed_random_state():
                self.algorithm: OnPolicyAlgorithm = self._make(algorithm, kwargs, weights)
        except TypeError as error:
            raise ValueError(f"router: these arguments do not fit algorithm {algo!r}: {error}") from error
        if not isinstance(self.policy, RouterPolicy):
            raise ValueError(f"router: policy must be a RouterPolicy, found {type(self.policy).__name__}.")
        distributed.share_tensors(self.policy.state_dict().values())
        self._prepare()
        outputs = [f for f in allocator.logger.output_formats if isinstance(f, TensorBoardOutputFormat)]
        folder = str(Path(allocator.logger.dir) / "router") if outputs and allocator.logger.dir else None
        self.algorithm.set_logger(Logger(folder, [TensorBoardOutputFormat(folder)] if folder else []))

    def _make(self, algorithm: type[OnPolicyAlgorithm], kwargs: dict[str, Any], weights: Path | None) -> OnPolicyAlgorithm:
        if weights is None:
            return algorithm(env=self.env, **kwargs)
        policy = kwargs.pop("policy", RouterPolicy)
        if policy is not RouterPolicy:
            raise ValueError(f"router: policy is {policy!r}, but {weights} has its own; leave it out.")
        return load(weights, self.env, algorithm, **{**fine_tuning_settings(algorithm, self.env), **kwargs})

    def _check_epoch(self, n_envs: int, instances_per_epoch: Any) -> None:
        if instances_per_epoch != self.epoch_size:
            raise ValueError(
                f"router: instances_per_epoch is {instances_per_epoch!r}, a router epoch of ITSCallback has {self.epoch_size} "
                "instances; set router_instances_per_epoch of ITSCallback instead."
            )
        if n_envs > self.epoch_size:
            raise ValueError(
                f"router: n_envs is {n_envs}, more than the {self.epoch_size} instances of a router epoch, so that most "
                "epochs would have no batch; lower n_envs, or raise router_instances_per_epoch of ITSCallback."
            )

    @property
    def policy(self) -> BasePolicy:
        """The router's policy; SB3 declares it an ``ActorCriticPolicy``, which a maskable one is not."""
        return self.algorithm.policy

    @property
    def plan(self) -> Any:
        """What plans tours in the allocator's environments."""
        assert isinstance(self.policy, RouterPolicy)
        return self.policy.plan

    def _prepare(self) -> None:
        """Give the router its epochs and the buffer of whole episodes, and reset its environment."""
        if isinstance(self.algorithm, REINFORCE):
            # Set here, because the constructor of a subclass may not have this argument.
            self.algorithm.instances_per_epoch = self.epoch_size
        is_stock_buffer = type(self.algorithm.rollout_buffer) in (DictRolloutBuffer, MaskableDictRolloutBuffer)
        if is_stock_buffer and not isinstance(self.algorithm, REINFORCE):
            # A YAML file cannot name a buffer class.
            use_episode_buffer(self.algorithm)
        # SB3 would reset it when the router first learns, which may be in the middle of generated subsets.
        observation: Any = self.env.reset()
        set_last_observation(self.algorithm, observation)
        self.freezer = Freezer(self.policy)
        watch(self.algorithm)

    def learn(self, size: int, planned: int, statistics: EpisodeStatistics, others: list[BaseCallback]) -> int:
        """
        Let the router learn for one epoch.

        :param size: Instances of the epoch
        :param planned: Instances of all epochs up to this one
        :param statistics: Counts its episodes
        :param others: More callbacks
        :return: How many instances it learned from
        """
        callback = CallbackList([statistics, *others])
        if isinstance(self.algorithm, REINFORCE):
            before = self.algorithm.n_instances
            # Up to the planned sum, so that rounding up to whole batches does not add epochs.
            self.algorithm.learn_instances(planned - before, callback)
            return self.algorithm.n_instances - before
        # SB3 keeps the last observation of the previous generator's instances otherwise.
        forget_last_observation(self.algorithm)
        # Whole rollouts, because SB3 throws away one that a callback stops.
        steps = self.algorithm.n_steps * self.algorithm.n_envs
        while statistics.n_episodes < size:
            self.algorithm.learn(steps, callback, reset_num_timesteps=False)
        return statistics.n_episodes

    def save(self, path: Path) -> None:
        """
        :param path: The zip to write
        :raises OSError: If it cannot be written; an older file of this name is then untouched
        """
        save_atomically(self.algorithm, path)

    def load(self, path: Path) -> None:
        """
        Continue with a router of an earlier run: the networks are those of the zip, the settings those of now, as rl_zoo3
        does with the allocator.

        :param path: Its zip
        :raises ValueError: If it is not an intact router
        """
        given = self.settings.keys() - _NOT_RELOADED
        # From the new router, as its constructor may have changed them.
        settings = {key: getattr(self.algorithm, key) for key in given if hasattr(self.algorithm, key)}
        try:
            with undisturbed_random_state(), safe_zips():
                loaded = type(self.algorithm).load(path, env=self.env, device=self.algorithm.device, **settings)
        except (ValueError, RuntimeError, OSError) as error:
            raise ValueError(f"{path}: not an intact router ({error}); use another checkpoint.") from error
        loaded.set_logger(self.algorithm.logger)
        self.algorithm = loaded
        note_saved(loaded, path, is_checkpoint=True)
        self._prepare()
