"""The interactive training strategy (paper, section IV-C and Algorithm 1) as a callback on the allocator's training."""

from __future__ import annotations

import csv
import inspect
import io
import json
import re
import shutil
import time
import warnings
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, ProgressBarCallback, tqdm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_streams import SUBSET_STREAM, TRAINING_STREAM, WARM_START_STREAM, random_stream
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.envs.generators import training_batch
from sb3_uav.envs.routing import RoutePlanningEnv
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.reinforce import find_problem
from sb3_uav.training.common import CallbackT, find_run_folder, hand_over_router, siblings, undisturbed_random_state
from sb3_uav.training.episode_buffer import use_episode_buffer
from sb3_uav.training.freezing import Freezer
from sb3_uav.training.subsets import AllocatedSubsets, WholeInstances

ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {
    "reinforce": REINFORCE,
    "ppo": PPO,
    "ppo_mask": MaskablePPO,
    "a2c": A2C,
}
# The paper's names (Fig. 5); "independent" is DL-DRL-I.
STRATEGIES = ("ITS", "ITS/pre-training", "ITS/intensive", "ITS/pre-training&intensive", "independent")

CHECKPOINT_FOLDER = "its_checkpoint"
STATE_FILE = "its_state.json"
WARM_START_FOLDER = "warm_start"
# An attribute of the allocator, so that any zip of it knows its last checkpoint: stock rl_zoo3 does not tell callbacks which
# zip it goes on from.
CHECKPOINT = "its_checkpoint"
LOG_FILE = "its_log.csv"
# Settings of the router that follow from the environment, or that its zip decides when a run goes on.
NOT_RELOADED = {"algo", "n_envs", "policy", "policy_kwargs"}
BEST_ROUTER_FILE = "best_router.zip"


@dataclass(frozen=True)
class EpochRecord:
    """
    One finished epoch of one level.

    :param epoch: Number of the epoch of this level, from 1
    :param level: ``"allocator"`` or ``"router"``
    :param phase: ``"pre-training"``, ``"intensive"`` or ``"alternate"``; of the allocator, that of the router's next block
    :param n_instances: Instances trained on in this epoch
    :param objective: Mean return of its training episodes
    :param seconds: Wall time
    :param generation_seconds: How much of it went into the router's instances, that is into allocating tasks
    """

    epoch: int
    level: str
    phase: str
    n_instances: int
    objective: float
    seconds: float
    generation_seconds: float = 0.0


class EpisodeStatistics(BaseCallback):
    """Mean return of the episodes since the last :meth:`reset_statistics`."""

    def __init__(self) -> None:
        super().__init__()
        self.reset_statistics()

    def reset_statistics(self) -> None:
        self.n_episodes, self.total_return = 0, 0.0

    @property
    def mean_return(self) -> float:
        return self.total_return / self.n_episodes if self.n_episodes > 0 else float("nan")

    def count(self, variables: dict[str, Any]) -> None:
        """:param variables: The local variables of a rollout, as callbacks get them"""
        if not np.any(variables["dones"]):
            return
        returns = [info["episode"]["r"] for info in variables["infos"] if "episode" in info]
        self.n_episodes += len(returns)
        self.total_return += float(sum(returns))

    def _on_step(self) -> bool:
        self.count(self.locals)
        return True


class RouterProgress(BaseCallback):
    """
    Says on the allocator's progress bar how far the router's epoch is, because two bars at a time would disturb each other.

    :param description: What to say
    :param bar: A tqdm bar
    :param n_instances: Instances of the epoch
    """

    def __init__(self, description: str, bar: Any, n_instances: int) -> None:
        super().__init__()
        self.description, self.bar, self.n_instances = description, bar, n_instances
        self.n_episodes = 0

    def _on_step(self) -> bool:
        n_finished = int(np.sum(self.locals["dones"]))
        if n_finished > 0:
            self.n_episodes += n_finished
            self.report(min(self.n_episodes / getattr(self.model, "n_samples", 1) / self.n_instances, 1.0))
        return True

    def report(self, done: float) -> None:
        """:param done: Part of the epoch that is done"""
        self.bar.set_description(f"{self.description} {done:4.0%}")


class OwnProgress(RouterProgress):
    """The same on a bar of its own, for pre-training, when the allocator has none yet."""

    def report(self, done: float) -> None:
        self.bar.update(round(done * self.n_instances) - self.bar.n)


class ITSCallback(BaseCallback):
    """
    Trains a router beside the allocator and freezes one while the other learns.

    Before the allocator's training the router learns on whole uniform instances (pre-training). Up to allocator epoch
    ``n_intensive_epochs`` it learns for ``n_continuous_epochs`` epochs after every ``n_continuous_epochs``-th one, on the
    shuffled subsets of that epoch's instances (intensive training); after that for one epoch after every one, on a random V-th
    part of them (alternate training).

    The router is saved after each of its epochs, and a checkpoint of both levels after each epoch of pre-training and every
    ``checkpoint_freq``-th one of the allocator. With ``REINFORCE`` and constant learning rates (``lr_decay`` included) a run
    goes on from its checkpoint with the same result as if it had not been interrupted.

    :param router: The router's algorithm: ``algo`` (``reinforce``, ``ppo``, ``ppo_mask``, ``a2c`` or the dotted path of an
        on-policy algorithm), ``n_envs``, and the algorithm's own arguments, among them ``policy``
    :param warm_start: What gives the router a start before anything else, by its dotted path, and its arguments, as in
        ``{"sb3_uav.training.imitation.imitate": {"n_updates": 1000}}``: a function of the policies of router and allocator,
        the generator of the instances and a random generator, see :func:`~sb3_uav.training.imitation.imitate`. If it has the
        arguments ``report`` and ``folder``, it gets a function to tell its progress to, and a folder to keep it in (None
        without ``save_path``), so that a run that goes on from the checkpoint of before its end can go on with it; the
        folder is removed afterwards
    :param n_epochs: Allocator epochs (the paper's E)
    :param n_pretraining_epochs: Router epochs of pre-training (E_p)
    :param n_intensive_epochs: Allocator epochs of intensive training (E_t)
    :param n_continuous_epochs: Epochs in a row in intensive training (E_c)
    :param instances_per_epoch: Instances of an epoch, of both levels; that of the allocator's algorithm when None
    :param router_instances_per_epoch: Instances of a router epoch, where they shall be others than those of the allocator
    :param strategy: ``"ITS"``, or one of the paper's ablations: ``"ITS/pre-training"`` (without pre-training),
        ``"ITS/intensive"`` (without intensive training), ``"ITS/pre-training&intensive"`` (neither), ``"independent"``
        (DL-DRL-I: the router is only pre-trained)
    :param save_path: Folder of the zips; that of the other callbacks or of the monitor files when None
    :param resume_from: Folder written by an earlier run (its ``its_checkpoint``); train the allocator loaded from there
    :param checkpoint_freq: Allocator epochs between checkpoints
    :param verbose: Verbosity level: 0 for no output, 1 for a line per epoch
    :raises ValueError: If an argument is not allowed; the message names it
    """

    def __init__(
        self,
        router: dict[str, Any],
        n_epochs: int = 100,
        n_pretraining_epochs: int = 5,
        n_intensive_epochs: int = 8,
        n_continuous_epochs: int = 4,
        instances_per_epoch: int | None = None,
        router_instances_per_epoch: int | None = None,
        strategy: str = "ITS",
        save_path: str | None = None,
        resume_from: str | None = None,
        checkpoint_freq: int = 1,
        verbose: int = 0,
        warm_start: dict[str, dict[str, Any]] | None = None,
    ) -> None:
        super().__init__(verbose)
        if warm_start is not None and (not isinstance(warm_start, dict) or len(warm_start) != 1):
            raise ValueError(
                f"warm_start must map the dotted path of one function to its arguments, found {warm_start!r:.80}."
            )
        if strategy not in STRATEGIES:
            raise ValueError(f"strategy is {strategy!r}; choose one of {STRATEGIES}.")
        for name, value, least in (
            ("n_epochs", n_epochs, 1),
            ("n_pretraining_epochs", n_pretraining_epochs, 0),
            ("n_intensive_epochs", n_intensive_epochs, 0),
            ("n_continuous_epochs", n_continuous_epochs, 1),
            ("checkpoint_freq", checkpoint_freq, 1),
            ("instances_per_epoch", 1 if instances_per_epoch is None else instances_per_epoch, 1),
            ("router_instances_per_epoch", 1 if router_instances_per_epoch is None else router_instances_per_epoch, 1),
        ):
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} is {value!r}; it must be a whole number of at least {least}.")
        if not isinstance(router, dict) or "policy" not in router:
            raise ValueError(f"router must be a mapping with at least the key 'policy', found {router!r:.80}.")
        self.router_kwargs = dict(router)
        self.n_epochs = n_epochs
        self.n_pretraining_epochs = 0 if strategy.startswith("ITS/pre-training") else n_pretraining_epochs
        self.n_intensive_epochs = 0 if strategy.endswith("intensive") else n_intensive_epochs
        self.n_continuous_epochs = n_continuous_epochs
        self.instances_per_epoch = instances_per_epoch
        self.router_instances_per_epoch = router_instances_per_epoch
        self.strategy = strategy
        self.save_path = None if save_path is None else Path(save_path)
        self.resume_from = None if resume_from is None else Path(resume_from)
        self.checkpoint_freq = checkpoint_freq
        self.warm_start = warm_start

        self.records: list[EpochRecord] = []
        self.epoch = 0
        self.router: OnPolicyAlgorithm
        self._router_env: BatchedVecEnv
        self._freezers: dict[str, Freezer] = {}
        self._statistics = EpisodeStatistics()
        self._subsets: AllocatedSubsets | None = None
        self._started = False
        self._warm_started = warm_start is None
        self._epoch_start = 0.0
        self._epoch_first_batch = 0
        self._instances_at_start = 0
        self._best_mean_reward: dict[str, float] = {}
        self._instances_before = 0
        self._steps_before = 0
        self._callers_limit: int | None = None

    # ------------------------------------------------------------------------------------------------------ set-up

    def _on_training_start(self) -> None:
        problem = find_problem(self.training_env)
        if not isinstance(problem, AllocationProblem) or not isinstance(self.model.policy, AllocatorPolicy):
            raise ValueError(
                "ITSCallback needs an AllocatorPolicy on a TaskAllocation environment, found "
                f"{type(self.model.policy).__name__} on {self.training_env}; its VecEnv must be a BatchedVecEnv or a "
                "DummyVecEnv (not --vec-env subproc) without wrappers."
            )
        self.problem = problem
        own = getattr(self.model, "instances_per_epoch", None)
        if self.instances_per_epoch is None:
            if own is None:
                raise ValueError(f"{type(self.model).__name__} has no instances_per_epoch; give it to ITSCallback.")
            self.instances_per_epoch = own
        elif own is not None and own != self.instances_per_epoch:
            raise ValueError(
                f"instances_per_epoch is {self.instances_per_epoch} in ITSCallback and {own} in "
                f"{type(self.model).__name__}; give it once, to the algorithm."
            )
        if self.save_path is None:
            self.save_path = self._find_save_path()
        if not self._started:
            self._make_router()
            if self.resume_from is None:
                self.resume_from = self._find_checkpoint()
            if self.resume_from is not None:
                self._resume(self.resume_from)
            elif self.model._n_updates > 0:
                raise ValueError(
                    "The allocator has been trained before, but ITSCallback does not know its router: set resume_from to the "
                    f"{CHECKPOINT_FOLDER} folder of the earlier run."
                )
            if self.warm_start is not None and not self._warm_started:
                self._start_router(self.warm_start)
            self._warm_started = True
            self._started = True
        # SB3's algorithms count steps only, and may start again from 0: what they have learned from is counted from here.
        self._instances_before = self.epoch * self.instances_per_epoch
        self._steps_before = self.model.num_timesteps
        assert isinstance(self._router_policy, RouterPolicy)
        hand_over_router(self, self._router_policy.plan)
        if self.epoch == 0 and len(self.records) < self.n_pretraining_epochs:
            self._router_env.set_generator(WholeInstances(self.problem.generator))
            self._train_router(self.n_pretraining_epochs, "pre-training", first=len(self.records))
        self._freezers["router"].freeze()
        if isinstance(self.model, REINFORCE):
            self._callers_limit = self.model.max_instances
            limit = self.n_epochs * self.instances_per_epoch
            self.model.max_instances = limit if self._callers_limit is None else min(limit, self._callers_limit)
        self._begin_epoch()

    def _find_checkpoint(self) -> Path | None:
        """The checkpoint that a loaded allocator belongs to, if it is still where it was written."""
        noted = getattr(self.model, CHECKPOINT, None)
        if noted is None or not (Path(noted["folder"]) / STATE_FILE).is_file():
            return None
        return Path(noted["folder"])

    def _make_router(self) -> None:
        kwargs = dict(self.router_kwargs)
        algo, n_envs = kwargs.pop("algo", "reinforce"), kwargs.pop("n_envs", self.training_env.num_envs)
        algorithm = resolve_algorithm(algo)
        if kwargs["policy"] in ("RouterPolicy", f"{RouterPolicy.__module__}.RouterPolicy", "sb3_uav.policies.RouterPolicy"):
            kwargs["policy"] = RouterPolicy
        if not isinstance(n_envs, int) or n_envs < 1:
            raise ValueError(f"router: n_envs is {n_envs!r}; it must be a whole number of at least 1.")
        if isinstance(kwargs.get("learning_rate"), str):
            raise ValueError(
                f"router: learning_rate is {kwargs['learning_rate']!r}; write a number. How many steps the router will "
                "take is not known, so it has no schedule but lr_decay."
            )
        generator = WholeInstances(self.problem.generator)
        self._router_env = BatchedVecEnv([lambda: RoutePlanningEnv(generator=generator)] * n_envs)
        if algorithm is REINFORCE:
            kwargs.setdefault("instances_per_epoch", self._router_epoch_size())
        # The next seed, because with the same one both levels would draw the same points.
        seed = None if self.model.seed is None else self.model.seed + 1
        try:
            with undisturbed_random_state():
                self.router = algorithm(env=self._router_env, seed=seed, device=self.model.device, **kwargs)
        except TypeError as error:
            raise ValueError(f"router: these arguments do not fit algorithm {algo!r}: {error}") from error
        if not isinstance(self._router_policy, RouterPolicy):
            raise ValueError(f"router: policy must be a RouterPolicy, found {type(self._router_policy).__name__}.")
        self._prepare_router()
        outputs = [f for f in self.logger.output_formats if isinstance(f, TensorBoardOutputFormat)]
        folder = str(Path(self.logger.dir) / "router") if outputs and self.logger.dir else None
        self.router.set_logger(Logger(folder, [TensorBoardOutputFormat(folder)] if folder else []))
        self._freezers = {"allocator": Freezer(self.model.policy), "router": Freezer(self.router.policy)}

    def _start_router(self, warm_start: dict[str, dict[str, Any]]) -> None:
        ((path, arguments),) = warm_start.items()
        function = resolve_path(path, "warm_start")
        rng = random_stream(self._seed(), WARM_START_STREAM)

        def report(text: str) -> None:
            if self.verbose > 0:
                print(text, flush=True)

        positional = (self.router.policy, self.model.policy, self.problem.generator, rng)
        folder = None if self.save_path is None else self.save_path / CHECKPOINT_FOLDER / WARM_START_FOLDER
        offered = {"report": report, "folder": folder}
        try:
            signature = inspect.signature(function)
            known = {name: value for name, value in offered.items() if name in signature.parameters}
            call = signature.bind(*positional, **{**known, **(arguments or {})})
        except TypeError as error:
            raise ValueError(f"warm_start: these arguments do not fit {path}: {error}") from error
        if folder is not None:
            self._bring_progress(folder)
        # From here on an interrupted run can go on.
        self._save_checkpoint()
        with undisturbed_random_state():
            function(*call.args, **call.kwargs)
        self._warm_started = True
        self._save_checkpoint()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)

    def _bring_progress(self, folder: Path) -> None:
        """
        Leave no progress in the folder but that of the checkpoint which this run goes on from.

        :param folder: Where the warm start is going to look for it
        """
        earlier = None if self.resume_from is None else self.resume_from / WARM_START_FOLDER
        if earlier is not None and earlier.resolve() == folder.resolve():
            return
        if folder.is_dir():
            shutil.rmtree(folder)
        if earlier is not None and earlier.is_dir():
            shutil.copytree(earlier, folder)

    @property
    def _router_policy(self) -> BasePolicy:
        """The router's policy; SB3 declares it an ``ActorCriticPolicy``, which a maskable one is not."""
        return self.router.policy

    def _siblings(self, kind: type[CallbackT]) -> list[CallbackT]:
        """The other callbacks of this kind in the same training."""
        return siblings(self, kind)

    def _find_save_path(self) -> Path | None:
        folder = find_run_folder(self)
        if folder is None:
            warnings.warn("ITSCallback saves no router: set save_path to a folder.", stacklevel=3)
        return folder

    # ------------------------------------------------------------------------------------------------------ epochs

    def _instances_seen(self) -> int:
        """Instances that the allocator has learned from."""
        if isinstance(self.model, REINFORCE):
            return self.model.n_instances
        return self._instances_before + (self.model.num_timesteps - self._steps_before) // self.problem.generator.n_tasks

    def _begin_epoch(self) -> None:
        self._statistics.reset_statistics()
        self._epoch_start = time.time()
        self._instances_at_start = self._instances_seen()
        self._epoch_first_batch = getattr(self.model, "n_batches", 0)

    def _on_rollout_start(self) -> None:
        self._save_best_router()
        if self._epoch_is_over():
            self._end_epoch()

    def _on_step(self) -> bool:
        self._statistics.count(self.locals)
        self._save_best_router()
        return self.epoch < self.n_epochs

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this a second time, and after Ctrl-C, when training the router for an epoch is not wanted.
        if not self._started:
            return
        self._save_best_router()
        if self.model.num_timesteps >= self.model._total_timesteps and self._epoch_is_over():
            self._end_epoch()
        self._save_router()
        for freezer in self._freezers.values():
            freezer.thaw()
        if isinstance(self.model, REINFORCE):
            self.model.max_instances = self._callers_limit

    def _epoch_is_over(self) -> bool:
        assert self.instances_per_epoch is not None
        return self.epoch < self.n_epochs and self._instances_seen() >= (self.epoch + 1) * self.instances_per_epoch

    def _end_epoch(self) -> None:
        """What Algorithm 1 does after every epoch of the allocator (lines 10 to 23)."""
        self.epoch += 1
        n_instances = self._instances_seen() - self._instances_at_start
        phase = "intensive" if self.epoch <= self.n_intensive_epochs else "alternate"
        self._record("allocator", self.epoch, phase, n_instances, self._statistics.mean_return, self._epoch_start)
        if self.strategy != "independent":
            n_uavs = self.problem.generator.n_uavs
            if phase == "alternate":
                self._train_on_subsets(1, 1 / n_uavs, phase)
            elif self.epoch % self.n_continuous_epochs == 0:
                self._train_on_subsets(self.n_continuous_epochs, 1.0, phase)
        if self.epoch % self.checkpoint_freq == 0 or self.epoch == self.n_epochs:
            self._save_checkpoint()
        else:
            self._save_router()
        self._begin_epoch()

    def _train_on_subsets(self, n_epochs: int, fraction: float, phase: str) -> None:
        assert isinstance(self.model.policy, AllocatorPolicy)
        n_batches = getattr(self.model, "n_batches", 0) - self._epoch_first_batch
        if isinstance(self.model, REINFORCE):
            first, draw_batch = self._epoch_first_batch, self.model.draw_batch
        else:
            # SB3's algorithms do not replay instances: new ones of the same distribution.
            first, n_batches, draw_batch = 0, self._batches_per_epoch(), self._draw_new_batch
        self._subsets = AllocatedSubsets(
            self.model.policy,
            self.problem.generator,
            draw_batch,
            range(first, first + n_batches),
            fraction,
            lambda chunk: random_stream(self._seed(), SUBSET_STREAM, self.epoch, chunk),
        )
        self._router_env.set_generator(self._subsets)
        self._freezers["allocator"].freeze()
        self._freezers["router"].thaw()
        try:
            self._train_router(n_epochs, phase)
        finally:
            self._freezers["router"].freeze()
            self._freezers["allocator"].thaw()

    def _batches_per_epoch(self) -> int:
        assert self.instances_per_epoch is not None
        return -(-self.instances_per_epoch // self.training_env.num_envs)

    def _draw_new_batch(self, index: int) -> Any:
        rng = random_stream(self._seed(), TRAINING_STREAM, self.epoch, index)
        assert isinstance(self.model.policy, AllocatorPolicy)
        return self.model.policy.arrange(training_batch(self.problem.generator, self.training_env.num_envs, rng))

    def _seed(self) -> int:
        return getattr(self.model, "stream_seed", None) or self.model.seed or 0

    def _n_router_epochs(self) -> int:
        return sum(record.level == "router" for record in self.records)

    def _train_router(self, n_epochs: int, phase: str, first: int = 0) -> None:
        """
        :param n_epochs: Epochs of the block
        :param phase: Name of the block
        :param first: Epochs of it that are done already
        """
        for index in range(first, n_epochs):
            start, number = time.time(), 1 + self._n_router_epochs()
            generated_before = self._generation_seconds()
            statistics = EpisodeStatistics()
            with_bar, close_bar = self._progress(f"router, {phase} {index + 1}/{n_epochs}")
            try:
                n_instances = self._learn_router(number, statistics, with_bar)
            finally:
                close_bar()
            generation = self._generation_seconds() - generated_before
            self._record("router", number, phase, n_instances, statistics.mean_return, start, generation)
            if phase == "pre-training":
                self._save_checkpoint()
            else:
                self._save_router()
        self.router.policy.set_training_mode(False)

    def _generation_seconds(self) -> float:
        """How long it has taken to make the router's instances since the allocator's last epoch."""
        return 0.0 if self._subsets is None else self._subsets.seconds

    def _learn_router(self, number: int, statistics: EpisodeStatistics, others: list[BaseCallback]) -> int:
        """
        Let the router learn for one epoch.

        :param number: Number of the epoch, from 1
        :param statistics: Counts its episodes
        :param others: More callbacks
        :return: How many instances it learned from
        """
        n_instances = self._router_epoch_size()
        callback = CallbackList([statistics, *others])
        if isinstance(self.router, REINFORCE):
            before = self.router.n_instances
            # Up to a multiple of the epoch's size, so that whole batches do not add up to more epochs than there are.
            self.router.learn_instances(number * n_instances - before, callback)
            return self.router.n_instances - before
        # SB3 keeps the last observation of the previous generator's instances otherwise.
        self.router._last_obs = None
        # Whole rollouts, because SB3 throws away one that a callback stops.
        steps = self.router.n_steps * self.router.n_envs
        while statistics.n_episodes < n_instances:
            self.router.learn(steps, callback, reset_num_timesteps=False)
        return statistics.n_episodes

    def _router_epoch_size(self) -> int:
        size = self.router_instances_per_epoch or self.instances_per_epoch
        assert size is not None
        return size

    def _progress(self, description: str) -> tuple[list[BaseCallback], Any]:
        """A callback that reports on the run's progress bar, if there is one, and what to call afterwards."""
        bars = self._siblings(ProgressBarCallback)
        if not bars:
            return [], lambda: None
        n_instances = self._router_epoch_size()
        if getattr(bars[0], "pbar", None) is None:
            # Pre-training: the allocator's bar does not exist yet.
            bar = tqdm(total=n_instances, desc=description)
            return [OwnProgress(description, bar, n_instances)], bar.close
        bar = bars[0].pbar
        return [RouterProgress(description, bar, n_instances)], lambda: bar.set_description("allocator")

    # ------------------------------------------------------------------------------------------------------ files

    def _record(
        self, level: str, epoch: int, phase: str, n_instances: int, objective: float, start: float, generation: float = 0.0
    ) -> None:
        seconds, generation = round(time.time() - start, 3), round(generation, 3)
        record = EpochRecord(epoch, level, phase, n_instances, objective, seconds, generation)
        self.records.append(record)
        self.logger.record(f"its/{level}_epoch", epoch)
        self.logger.record(f"its/{level}_objective", objective)
        if self.verbose > 0:
            print(f"{level} epoch {epoch} ({phase}): mean objective {objective:.2f}, {record.seconds:.1f} s")
        if self.save_path is not None:
            write_atomically(self.save_path / LOG_FILE, self._log_text())

    def _log_text(self) -> str:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(EpochRecord.__annotations__))
        writer.writeheader()
        writer.writerows(asdict(record) for record in self.records)
        return text.getvalue()

    def _save_router(self) -> None:
        if self.save_path is not None:
            save_atomically(self.router, self.save_path / "router.zip")

    def _save_best_router(self) -> None:
        """Keep the router that the best allocator was evaluated with."""
        for callback in self._siblings(EvalCallback):
            folder = callback.best_model_save_path
            if folder is not None and callback.best_mean_reward > self._best_mean_reward.get(folder, -np.inf):
                self._best_mean_reward[folder] = callback.best_mean_reward
                self.save_best_router(Path(folder))

    def save_best_router(self, folder: Path) -> None:
        """
        Save the router as that of the best allocator so far.

        :param folder: Where that one is saved
        """
        save_atomically(self.router, folder / BEST_ROUTER_FILE)

    def _save_checkpoint(self) -> None:
        """
        Write both zips and the state of the strategy.

        The state names the zips it belongs to and is replaced last, so the folder is consistent at any moment.
        """
        self._save_router()
        if self.save_path is None:
            return
        folder = self.save_path / CHECKPOINT_FOLDER
        setattr(self.model, CHECKPOINT, {"folder": str(folder.resolve()), "epoch": self.epoch})
        # Another name before the warm start, because a zip that the state file names must not change.
        number = str(self._n_router_epochs()) if self._warm_started else "start"
        names = {"allocator": f"allocator_{self.epoch}.zip", "router": f"router_{number}.zip"}
        save_atomically(self.model, folder / names["allocator"])
        save_atomically(self.router, folder / names["router"])
        records = [asdict(record) for record in self.records]
        state = {"epoch": self.epoch, **names, "warm_started": self._warm_started, "records": records}
        write_atomically(folder / STATE_FILE, json.dumps(state, indent=1))
        for old in folder.iterdir():
            if re.fullmatch(r"(allocator|router)_(\d+|start)\.zip", old.name) and old.name not in names.values():
                old.unlink()

    def _resume(self, folder: Path) -> None:
        state = read_state(folder)
        noted = getattr(self.model, CHECKPOINT, {"epoch": state["epoch"]})["epoch"]
        epoch = self.model.epoch if isinstance(self.model, REINFORCE) else noted
        if epoch != state["epoch"]:
            raise ValueError(
                f"{folder}: the checkpoint is of epoch {state['epoch']}, the allocator of epoch {epoch}; "
                f"train the allocator of {folder / state['allocator']}."
            )
        self.epoch = state["epoch"]
        # Without it, the state was written when there was no checkpoint before the end of the warm start.
        self._warm_started = state.get("warm_started", True)
        self.records = [EpochRecord(**record) for record in state["records"]]
        # As rl_zoo3 does with the allocator: the settings are those of now, the networks those of the zip.
        given = self.router_kwargs.keys() - NOT_RELOADED
        # From the new router, as its constructor may have changed them.
        settings = {key: getattr(self.router, key) for key in given if hasattr(self.router, key)}
        try:
            with undisturbed_random_state():
                loaded = type(self.router).load(
                    folder / state["router"], env=self._router_env, device=self.model.device, **settings
                )
        except (ValueError, RuntimeError, OSError) as error:
            raise ValueError(f"{folder / state['router']}: not an intact router ({error}); use another checkpoint.") from error
        loaded.set_logger(self.router.logger)
        self.router = loaded
        self._prepare_router()
        self._freezers["router"] = Freezer(self.router.policy)

    def _prepare_router(self) -> None:
        """Give the router the buffer of whole episodes, and reset its environment."""
        is_stock_buffer = type(self.router.rollout_buffer) in (DictRolloutBuffer, MaskableDictRolloutBuffer)
        if is_stock_buffer and not isinstance(self.router, REINFORCE):
            # A YAML file cannot name a buffer class.
            use_episode_buffer(self.router)
        # SB3 would reset it when the router first learns, which may be in the middle of generated subsets.
        self.router._last_obs = self._router_env.reset()  # type: ignore[assignment]
        self.router._last_episode_starts = np.ones(self._router_env.num_envs, dtype=bool)


def read_state(folder: Path) -> dict[str, Any]:
    """
    :param folder: A checkpoint of :class:`ITSCallback`
    :return: What its state file says: ``epoch``, ``allocator`` and ``router`` (names of the zips), ``records``, and, unless an
        older version wrote it, ``warm_started``
    :raises FileNotFoundError: If there is none
    :raises ValueError: If it is damaged
    """
    path = Path(folder) / STATE_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the {CHECKPOINT_FOLDER} folder of an earlier run.")
    try:
        state = json.loads(path.read_text())
        missing = {"epoch", "allocator", "router", "records"} - set(state)
        for record in state.get("records", []):
            EpochRecord(**record)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not an intact state file ({error}); resume from another checkpoint.") from error
    if missing:
        raise ValueError(f"{path}: fields {sorted(missing)} are missing; resume from another checkpoint.")
    return state


def resolve_path(path: str, what: str) -> Any:
    """
    :param path: ``package.module.name``
    :param what: What has this path, named in errors
    :return: The object
    :raises ValueError: If there is none
    """
    module_name, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{what} is {path!r}, which cannot be imported ({error}); give its dotted path.") from error


def resolve_algorithm(name: str) -> type[OnPolicyAlgorithm]:
    """
    :param name: ``reinforce``, ``ppo``, ``ppo_mask``, ``a2c`` or a dotted path
    :raises ValueError: If there is no such on-policy algorithm
    """
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    module_name, _, class_name = name.rpartition(".")
    try:
        algorithm = getattr(import_module(module_name), class_name)
    except (ImportError, AttributeError, ValueError) as error:
        choices = ", ".join(ALGORITHMS)
        raise ValueError(f"router: algo is {name!r}; choose one of {choices} or give a dotted path.") from error
    if not (isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)):
        raise ValueError(f"router: algo {name!r} is not an on-policy algorithm of SB3.")
    return algorithm
