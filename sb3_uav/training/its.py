"""The interactive training strategy (paper, section IV-C and Algorithm 1) as a callback on the allocator's training."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_uav.common import distributed
from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.divergence import DivergenceError, with_checkpoint
from sb3_uav.common.epoch_log import LOG_FILE, EpisodeStatistics, EpochRecord, Moment, log_text
from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.common.random_streams import SUBSET_STREAM, WARM_START_STREAM, random_stream, stream_seed
from sb3_uav.common.sb3_compat import total_timesteps
from sb3_uav.common.shared_axis import SharedAxis
from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.freezing import Freezer
from sb3_uav.pretrained.router_source import router_source
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.finite import watch
from sb3_uav.reinforce.ranks import require_shareable
from sb3_uav.reinforce.recognition import find_problem
from sb3_uav.training.arguments import check_counts
from sb3_uav.training.best_pair import RouterCallback, take_over
from sb3_uav.training.its_checkpoint import (
    CHECKPOINT_FOLDER,
    WARM_START_FOLDER,
    begin_anew,
    find_state,
    n_router_epochs,
    noted_checkpoint,
    origin_of,
    write_checkpoint,
)
from sb3_uav.training.its_schedule import ALTERNATE, PRETRAINING, EpochSchedule, strategy_name
from sb3_uav.training.router_handover import hand_over_router
from sb3_uav.training.router_progress import router_progress
from sb3_uav.training.router_trainer import RouterTrainer
from sb3_uav.training.run_folder import folder_for_router
from sb3_uav.training.run_size import find_epoch_size, share_of_plan, warn_of_complete_run, warn_of_large_batches
from sb3_uav.training.subsets import AllocatedSubsets, WholeInstances, new_batch
from sb3_uav.training.warm_start import WarmStart, bring_progress

ROUTER_FILE = "router.zip"
_PRETRAINING_EPOCHS = 5


class ITSCallback(RouterCallback):
    """
    Trains a router beside the allocator and freezes one while the other learns.

    Before the allocator's training the router learns on whole uniform instances (pre-training). Up to allocator epoch
    ``n_intensive_epochs`` it learns for ``n_continuous_epochs`` epochs after every ``n_continuous_epochs``-th one, on the
    shuffled subsets of that epoch's instances (intensive training); after that for one epoch after every one, on a random V-th
    part of them (alternate training).

    ``total_timesteps`` bounds the whole run: with fewer steps than ``n_epochs`` epochs take, warm start and pre-training are
    cut to the same share, and the run stops after these steps of the allocator.

    The router is saved after each of its epochs, and a checkpoint of both levels after each epoch of pre-training and every
    ``checkpoint_freq``-th one of the allocator. With ``REINFORCE`` and constant learning rates (``lr_decay`` included) a
    resumed run ends with the same result as an uninterrupted one.

    Both levels log on one axis, that of the steps that either of them has learned from: environment steps, and in the warm
    start the moves that are imitated. The router's TensorBoard events are in the folder ``router`` of the allocator's.

    :param router: The router's algorithm: ``algo`` (``reinforce``, ``ppo``, ``ppo_mask``, ``a2c`` or the dotted path of an
        on-policy algorithm), ``n_envs``, and the algorithm's own arguments, among them ``policy``. Or a router that was
        trained before, to go on with: its zip or the name of a pair such as ``"universal"``, with the settings of
        :func:`~sb3_uav.reinforce.transfer.fine_tuning_settings`; or ``{"zip": "router.zip", ...}`` or ``{"pretrained":
        "universal", ...}`` with other settings of the algorithm. The zip is read without unpickling. An allocator that was
        trained before then starts a new run at epoch 0, unless it belongs to the checkpoint of a run with this router and size
    :param warm_start: What trains the router before anything else: arguments of
        :func:`~sb3_uav.training.imitation.imitate`, as in ``{"n_updates": 1000}``; or the dotted path of another function and
        its arguments, as in ``{"my_package.start": {"n_steps": 10}}``. It is called with the policies of router and
        allocator, the generator of the instances and a random generator. If it has the parameters ``report``, ``record`` and
        ``folder``, it gets a function to report its progress to, one to log its loss with, and a folder to keep its progress
        in (None without ``save_path``), from which an interrupted run resumes; the folder is removed afterwards. If it has a
        parameter ``share``, it gets the part of the planned steps that this run takes
    :param n_epochs: Allocator epochs (the paper's E)
    :param n_pretraining_epochs: Router epochs of pre-training (E_p); when None 5, or none for a router that was trained before
    :param n_intensive_epochs: Allocator epochs of intensive training (E_t)
    :param n_continuous_epochs: Epochs in a row in intensive training (E_c)
    :param instances_per_epoch: Instances of an epoch, of both levels; that of the allocator's algorithm when None
    :param router_instances_per_epoch: Instances of a router epoch, where it differs from that of the allocator
    :param strategy: ``"its"``, or one of the paper's ablations: ``"no-pretraining"``, ``"no-intensive"``,
        ``"alternate-only"`` (neither), ``"independent"`` (DL-DRL-I: the router is only pre-trained, for as many epochs as
        ``"its"`` would train it in all). The paper's names (``"ITS/pre-training"`` for training without it, and so on) mean
        the same
    :param save_path: Folder of the zips; that of the other callbacks or of the monitor files when None
    :param resume_from: Folder written by an earlier run (its ``its_checkpoint``); train the allocator loaded from there
    :param checkpoint_freq: Allocator epochs between checkpoints
    :param verbose: Verbosity level: 0 for no output, 1 for a line per epoch
    :param keep_checkpoints: Number of checkpoints to keep; older ones are removed when a new one is complete
    :raises ValueError: If an argument is not allowed; the message names it
    """

    def __init__(
        self,
        router: dict[str, Any] | str | os.PathLike[str],
        n_epochs: int = 100,
        n_pretraining_epochs: int | None = None,
        n_intensive_epochs: int = 8,
        n_continuous_epochs: int = 4,
        instances_per_epoch: int | None = None,
        router_instances_per_epoch: int | None = None,
        strategy: str = "its",
        save_path: str | None = None,
        resume_from: str | None = None,
        checkpoint_freq: int = 1,
        verbose: int = 0,
        warm_start: dict[str, Any] | None = None,
        keep_checkpoints: int = 3,
    ) -> None:
        super().__init__(verbose)
        check_counts(1, n_epochs=n_epochs, n_continuous_epochs=n_continuous_epochs, checkpoint_freq=checkpoint_freq)
        check_counts(1, keep_checkpoints=keep_checkpoints)
        self.router_zip, self.router_kwargs = router_source(router)
        if n_pretraining_epochs is None:
            n_pretraining_epochs = _PRETRAINING_EPOCHS if self.router_zip is None else 0
        check_counts(0, n_pretraining_epochs=n_pretraining_epochs, n_intensive_epochs=n_intensive_epochs)
        check_counts(1, instances_per_epoch=instances_per_epoch, router_instances_per_epoch=router_instances_per_epoch)
        self.strategy = strategy_name(strategy)
        self.schedule = EpochSchedule.of(
            self.strategy, n_epochs, n_pretraining_epochs, n_intensive_epochs, n_continuous_epochs
        )
        self.n_epochs = n_epochs
        self.instances_per_epoch = instances_per_epoch
        self.router_instances_per_epoch = router_instances_per_epoch
        self.save_path = None if save_path is None else Path(save_path)
        self.resume_from = None if resume_from is None else Path(resume_from)
        self.checkpoint_freq = checkpoint_freq
        self.keep_checkpoints = keep_checkpoints
        self.warm_start = None if warm_start is None else WarmStart(warm_start)

        self.records: list[EpochRecord] = []
        self.epoch = 0
        self._trainer: RouterTrainer
        self._allocator_freezer: Freezer
        self._axis = SharedAxis()
        self._statistics = EpisodeStatistics()
        self._subsets: AllocatedSubsets | None = None
        self._started = False
        # The part of the planned steps that the run takes.
        self.share = 1.0
        self._origin: str | None = None
        self._warm_started = warm_start is None
        self._epoch_start = Moment.now()
        self._epoch_first_batch = 0
        self._instances_at_start = 0
        self._instances_before = 0
        self._steps_before = 0
        self._callers_limit: int | None = None

    @property
    def router(self) -> OnPolicyAlgorithm:
        """The router's algorithm."""
        return self._trainer.algorithm

    # ------------------------------------------------------------------------------------------------------ set-up

    def _on_training_start(self) -> None:
        problem = find_problem(self.training_env)
        if not isinstance(problem, AllocationProblem) or not isinstance(self.model.policy, AllocatorPolicy):
            raise ValueError(
                "ITSCallback needs an AllocatorPolicy on a TaskAllocation environment, found "
                f"{type(self.model.policy).__name__} on {self.training_env}; its VecEnv must be a BatchedVecEnv or a "
                "DummyVecEnv (not --vec-env subproc) without wrappers."
            )
        require_shareable(self.model)
        self.verbose = self.verbose if distributed.is_main() else 0
        self.problem = problem
        watch(self.model)
        self.instances_per_epoch = find_epoch_size(self.model, self.instances_per_epoch)
        if self.save_path is None:
            self.save_path = folder_for_router(self)
        self._axis.begin(self.model)
        if self._started:
            self._axis.join(lambda: self.router)
        else:
            # Before anything is drawn or saved, so that an unseeded run draws a seed and every zip of it has that seed.
            self._seed()
            warn_of_large_batches(self.model, self.instances_per_epoch, self.problem.generator.n_tasks)
            self._set_up_router()
            self._started = True
        # SB3's algorithms only count steps, which may start again from 0, so instances are counted from here.
        self._instances_before = self.epoch * self.instances_per_epoch
        self._steps_before = self.model.num_timesteps
        hand_over_router(self, self._trainer.plan)
        n_epochs, _ = self.schedule.pretraining_of(self.share, self._trainer.epoch_size)
        if self.epoch == 0 and len(self.records) < n_epochs:
            self._trainer.env.set_generator(WholeInstances(self.problem.generator))
            self._train_router(n_epochs, PRETRAINING, first=len(self.records))
        self._trainer.freezer.freeze()
        for evaluation in siblings(self, EvalCallback):
            take_over(evaluation, self.model)
        if isinstance(self.model, REINFORCE):
            self._callers_limit = self.model.max_instances
            limit = self.n_epochs * self.instances_per_epoch
            self.model.max_instances = limit if self._callers_limit is None else min(limit, self._callers_limit)
        self._begin_epoch()

    def _set_up_router(self) -> None:
        """Create the router, restore an earlier run if there is one, and run the warm start."""
        assert self.instances_per_epoch is not None
        self._trainer = RouterTrainer(
            self.router_kwargs,
            self.model,
            self.training_env.num_envs,
            self.problem.generator,
            self.router_instances_per_epoch or self.instances_per_epoch,
            self.router_zip,
        )
        self._allocator_freezer = Freezer(self.model.policy)
        self._origin = origin_of(self.router_zip, self.problem.generator)
        if self.resume_from is None:
            self.resume_from = noted_checkpoint(self.model, self._origin)
        share: float | None = None
        if self.resume_from is not None:
            share = self._resume(self.resume_from)
        else:
            begin_anew(self.model, self.router_zip)
        if share is None:
            since = self.model.num_timesteps if self.resume_from is None else 0
            n_tasks = self.problem.generator.n_tasks
            share = share_of_plan(self.model, self.n_epochs, self.instances_per_epoch, n_tasks, since)
        self.share = share
        self._axis.join(lambda: self.router)
        if self.warm_start is not None and not self._warm_started:
            self._start_router(self.warm_start)
        self._warm_started = True

    def _start_router(self, warm_start: WarmStart) -> None:
        rng = random_stream(self._seed(), WARM_START_STREAM)

        def report(text: str) -> None:
            if self.verbose > 0:
                print(text, flush=True)

        def record(n_moves: int, nats: float) -> None:
            self._axis.extra = n_moves
            self.router.logger.record("imitation/nats_per_move", nats)
            self.router.logger.dump(self.router.num_timesteps)

        folder = None if self.save_path is None else self.save_path / CHECKPOINT_FOLDER / WARM_START_FOLDER
        positional = (self._trainer.policy, self.model.policy, self.problem.generator, rng)
        offered = {"report": report, "record": record, "folder": folder, "share": self.share}
        start = warm_start.bind(positional, offered)
        if folder is not None:
            bring_progress(folder, None if self.resume_from is None else self.resume_from / WARM_START_FOLDER)
        # From here on an interrupted run can be resumed.
        self._save_checkpoint()
        with undisturbed_random_state():
            start()
        self._warm_started = True
        self._save_checkpoint()
        if folder is not None and distributed.is_main():
            shutil.rmtree(folder, ignore_errors=True)

    # ------------------------------------------------------------------------------------------------------ epochs

    def _instances_seen(self) -> int:
        """Instances that the allocator has learned from."""
        if isinstance(self.model, REINFORCE):
            return self.model.n_instances
        return self._instances_before + (self.model.num_timesteps - self._steps_before) // self.problem.generator.n_tasks

    def _begin_epoch(self) -> None:
        assert self.instances_per_epoch is not None
        self._epoch_start = Moment.now()
        n_batches = getattr(self.model, "n_batches", 0)
        if self._epoch_is_over():
            # The last batch also completed this epoch; both share its episodes and its instances.
            self._instances_at_start = self.epoch * self.instances_per_epoch
            self._epoch_first_batch = max(n_batches - 1, 0)
        else:
            self._statistics.reset_statistics()
            self._instances_at_start = self._instances_seen()
            self._epoch_first_batch = n_batches

    def _on_rollout_start(self) -> None:
        while self._epoch_is_over():
            self._end_epoch()

    def _on_step(self) -> bool:
        self._axis.note()
        self._statistics.count(self.locals)
        return self.epoch < self.n_epochs

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this a second time, and after Ctrl-C, when the router must not start another epoch.
        if not self._started:
            return
        if self.model.num_timesteps >= total_timesteps(self.model):
            while self._epoch_is_over():
                self._end_epoch()
        self._save_router()
        self._trainer.freezer.thaw()
        self._allocator_freezer.thaw()
        if isinstance(self.model, REINFORCE):
            self.model.max_instances = self._callers_limit

    def _epoch_is_over(self) -> bool:
        assert self.instances_per_epoch is not None
        return self.epoch < self.n_epochs and self._instances_seen() >= (self.epoch + 1) * self.instances_per_epoch

    def _end_epoch(self) -> None:
        """Lines 10 to 23 of Algorithm 1, after every epoch of the allocator."""
        self.epoch += 1
        end = self.epoch * (self.instances_per_epoch or 0) if self._epoch_is_over() else self._instances_seen()
        phase = self.schedule.phase(self.epoch)
        objective = self._statistics.mean_return
        if self._statistics.n_episodes == 0:
            # Resumed between two epochs of the same batch.
            objective = next((r.objective for r in reversed(self.records) if r.level == "allocator"), objective)
        self._record("allocator", self.epoch, phase, end - self._instances_at_start, objective, self._epoch_start)
        if (n_epochs := self.schedule.router_epochs_after(self.epoch)) > 0:
            self._train_on_subsets(n_epochs, 1 / self.problem.generator.n_uavs if phase == ALTERNATE else 1.0, phase)
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
            # SB3's algorithms cannot replay their instances; draw new ones from the same distribution.
            first, draw_batch = 0, self._draw_new_batch
            n_batches = -(-(self.instances_per_epoch or 0) // self.training_env.num_envs)
        self._subsets = AllocatedSubsets(
            self.model.policy,
            self.problem.generator,
            draw_batch,
            range(first, first + n_batches),
            fraction,
            lambda chunk: random_stream(self._seed(), SUBSET_STREAM, self.epoch, chunk),
        )
        self._trainer.env.set_generator(self._subsets)
        self._allocator_freezer.freeze()
        self._trainer.freezer.thaw()
        try:
            self._train_router(n_epochs, phase)
        finally:
            self._trainer.freezer.freeze()
            self._allocator_freezer.thaw()

    def _draw_new_batch(self, index: int) -> Any:
        n_envs, seed = self.training_env.num_envs, self._seed()
        return new_batch(self.model.policy, self.problem.generator, n_envs, seed, self.epoch, index)

    def _seed(self) -> int:
        # Of the streams for warm start and router instances, saved in the allocator's zips.
        return stream_seed(self.model)

    def _train_router(self, n_epochs: int, phase: str, first: int = 0) -> None:
        """
        :param n_epochs: Epochs of the block
        :param phase: Name of the block
        :param first: Epochs of it that are done already
        """
        size = self._trainer.epoch_size
        if phase == PRETRAINING:
            _, size = self.schedule.pretraining_of(self.share, size)
        for index in range(first, n_epochs):
            start, number = Moment.now(), 1 + n_router_epochs(self.records)
            generated_before = self._generation_seconds()
            statistics = EpisodeStatistics()
            description = f"router, {phase} {index + 1}/{n_epochs}"
            with_bar, close_bar = router_progress(self, description, size)
            try:
                n_instances = self._trainer.learn(size, self._planned_before() + size, statistics, with_bar)
            except DivergenceError as error:
                # rl_zoo3 ends the training even after an error, but this router must not be saved.
                self._started = False
                raise DivergenceError(f"Router epoch {number} ({phase}), {with_checkpoint(error, self.router)}") from error
            finally:
                close_bar()
            generation = self._generation_seconds() - generated_before
            self._record("router", number, phase, n_instances, statistics.mean_return, start, generation)
            if phase == PRETRAINING:
                self._save_checkpoint()
            else:
                self._save_router()
        self._trainer.policy.set_training_mode(False)

    def _planned_before(self) -> int:
        """The router's instances in the epochs so far, but for rounding up to whole batches."""
        learned = [record.n_instances for record in self.records if record.level == "router" and record.phase == PRETRAINING]
        size = self._trainer.epoch_size
        # Pre-training may have been cut.
        return min(sum(learned), len(learned) * size) + (n_router_epochs(self.records) - len(learned)) * size

    def _generation_seconds(self) -> float:
        """How long it has taken to make the router's instances since the allocator's last epoch."""
        return 0.0 if self._subsets is None else self._subsets.seconds

    # ------------------------------------------------------------------------------------------------------ files

    def _record(
        self, level: str, epoch: int, phase: str, n_instances: int, objective: float, start: Moment, generation: float = 0.0
    ) -> None:
        passed = start.since()
        record = EpochRecord(epoch, level, phase, n_instances, objective, passed.wall, round(generation, 3), passed.cpu)
        self.records.append(record)
        self.logger.record(f"its/{level}_epoch", epoch)
        self.logger.record(f"its/{level}_objective", objective)
        if level == "router":
            # At its own step: the allocator may not log before several of these epochs are over.
            self.logger.dump(self.model.num_timesteps)
        self._axis.note()
        if self.verbose > 0:
            print(f"{level} epoch {epoch} ({phase}): mean objective {objective:.2f}, {record.seconds:.1f} s")
        if self.save_path is not None and distributed.is_main():
            write_atomically(self.save_path / LOG_FILE, log_text(self.records))

    def _save_router(self) -> None:
        if self.save_path is not None and distributed.is_main():
            self._trainer.save(self.save_path / ROUTER_FILE)

    def _save_checkpoint(self) -> None:
        """Write both levels' zips and the state of the strategy."""
        self._axis.note()
        self._save_router()
        if self.save_path is not None and distributed.is_main():
            folder, begun = self.save_path / CHECKPOINT_FOLDER, (self._warm_started, self.share, self._origin)
            write_checkpoint(folder, self.model, self.router, self.epoch, self.records, *begun, self.keep_checkpoints)

    def _resume(self, folder: Path) -> float | None:
        """:return: The share of the plan with which the run began, unless an older version wrote the checkpoint"""
        state = find_state(folder, self.model)
        self.epoch = state["epoch"]
        warn_of_complete_run(folder, self.epoch, self.n_epochs)
        # Versions that did not write this field saved no checkpoint before the end of the warm start.
        self._warm_started = state.get("warm_started", True)
        self.records = [EpochRecord(**record) for record in state["records"]]
        self._trainer.load(folder / state["router"])
        # Nothing is replaced there before all processes have read it.
        distributed.barrier()
        return state.get("share")
