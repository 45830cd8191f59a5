"""Evaluation on fixed instances during training, so that the best model is chosen by more than a lucky draw."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_streams import FIXED_SET_STREAM, random_stream
from sb3_uav.common.sb3_compat import n_updates
from sb3_uav.common.tensorboard import record_picture, shows_pictures
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy
from sb3_uav.policies.greedy_map import greedy_map
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training.arguments import check_counts
from sb3_uav.training.best_pair import BEST_MODEL_FILE, BestPair, BestPairOwner, best_model_folder, find_best_router, take_over
from sb3_uav.training.fixed_set_history import RESULTS_FILE, EvaluationHistory, FixedSetResult
from sb3_uav.training.fixed_set_returns import draw_fixed_set, evaluate_fixed_set, evaluated_problem
from sb3_uav.training.instance_sets import InstanceSets, InstanceSource, SizeTable
from sb3_uav.training.its import ITSCallback
from sb3_uav.training.recorded_settings import record_settings
from sb3_uav.training.run_folder import find_run_folder

_INSTANCES_FILE = "evaluation_instances.npz"
# Means by size, where there are several.
TABLE_FILE = "size_grid.csv"
# Where a stock EvalCallback of the same run writes its results instead; it appends the suffix .npz.
_STOCK_RESULTS = "evaluations_eval_callback"
# An attribute of the model, so that every zip of it names its earlier evaluations: SB3 starts counting steps again from 0.
EVALUATIONS = "fixed_set_evaluations"
# SB3's EvalCallback is called every 10,000 calls, rl_zoo3's every 25,000 steps.
_DEFAULT_EVAL_FREQ = 25_000


class FixedSetEvalCallback(BestPairOwner):
    """
    Evaluates the policy on fixed instances while it learns: greedily, and by the best of several samples.

    For our policies on our environments, under any on-policy algorithm. In the YAML of a zoo::

        callback:
          - sb3_uav.training.FixedSetEvalCallback: {n_instances: 256, n_samples: 16}

    The instances are one set or several. They are read from files, or drawn once with random numbers that no training uses:
    one set from the environment's own generator, or sets of uniform instances of the given ``sizes``. Models are compared by
    their mean on a single set; on ``sizes`` or several sets by the mean logarithm of the means, so that all sets count alike.

    An evaluation takes place before the first rollout whose steps reach a multiple of ``eval_freq``, so that the policy has
    learned from exactly the steps that are noted, and at the end. It changes neither the training's random states nor the
    policy's mode: parameters are bit-equal with and without this callback. The router of an allocation environment is the one
    that the environment has at that time; name this callback after ``ITSCallback``.

    It logs ``eval/fixed_greedy``, ``eval/fixed_sampled``, ``eval/fixed_best`` and ``eval/fixed_ep_length``, for ``sizes`` or
    several sets also ``size_grid/U4-N80`` and so on. TensorBoard also gets ``eval/schedule``, a map of the greedy schedule of
    the first instance (if matplotlib is installed), and the settings of the training with these values in its HPARAMS tab.
    It writes into the run folder:

    - ``evaluations.npz`` in SB3's format (returns of the greedy episodes, set after set) with more arrays, see
      :class:`~sb3_uav.training.fixed_set_history.EvaluationHistory`;
    - ``best_model.zip`` whenever the model is the best so far, and beside it ``best_router.zip`` under ``ITSCallback``;
    - ``evaluation_instances.npz``, the set, or one file per set;
    - ``size_grid.csv``, the means by set, for ``sizes`` or several sets.

    The run folder is that of rl_zoo3 (its ``EvalCallback`` or its monitor files name it), or the folder of the logger.
    SB3's ``EvalCallback``, which rl_zoo3 adds by itself, would write files of the same names, its best model being that of
    a few random episodes. If there is one with the same folder, it leaves ``best_model.zip`` to this callback and writes its
    results to ``evaluations_eval_callback.npz``; ``--eval-freq -1`` saves its time.

    The zips of a model name the folder of its evaluations. If it is trained further (``-i`` of the zoo, or ``load`` and
    ``learn``) with the same instances, its new folder takes over the evaluations up to there and the best zips, and steps and
    times continue from there.

    :param instances: Path of an ``.npz`` file, or ``Instances``, or a list of these; drawn when None
    :param n_instances: How many to draw from the environment's generator
    :param seed: Seed for drawing the instances and for sampling; not that of the training, so that all runs get the same set
    :param n_samples: Samples per instance; 0 for greedy evaluation only
    :param eval_freq: Environment steps between evaluations, of all environments together. When None: once per epoch of
        ``ITSCallback`` or ``REINFORCE``, and every 25,000 steps under other algorithms
    :param best_by: Which returns decide on the best model: ``"greedy"`` or ``"sampled"``
    :param save_path: Folder of the files; the run folder when None
    :param verbose: Verbosity level: 0 for no output, 1 for a line per evaluation
    :param sizes: UAVs, tasks and number of instances of each set to draw, and maybe its distribution, such as
        ``[[4, 80, 48], [6, 200, 16, clustered]]``; in place of ``instances`` and ``n_instances``
    :param max_distance: Maximum flight distance of the instances of these ``sizes``
    :param eval_updates: Updates between evaluations, in place of ``eval_freq``
    :raises FileNotFoundError: If there is no such file of instances
    :raises ValueError: If an argument is not allowed; the message names it
    """

    # Of several processes, the first one evaluates; see sb3_uav.reinforce.ranks.
    only_on_main_rank = True
    # Two callbacks with the same name here cannot share a folder.
    results_file: ClassVar[str] = RESULTS_FILE
    instances_file: ClassVar[str | None] = _INSTANCES_FILE
    # Additional names for a copy of the best model.
    best_copies: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        instances: InstanceSource | Sequence[InstanceSource] | None = None,
        n_instances: int = 256,
        seed: int = 0,
        n_samples: int = 16,
        eval_freq: int | None = None,
        best_by: str = "greedy",
        save_path: str | os.PathLike[str] | None = None,
        verbose: int = 0,
        sizes: Sequence[Sequence[Any]] | None = None,
        max_distance: float = 2.0,
        eval_updates: int | None = None,
    ) -> None:
        super().__init__(verbose)
        check_counts(1, n_instances=n_instances, eval_freq=eval_freq, eval_updates=eval_updates)
        check_counts(0, seed=seed, n_samples=n_samples)
        if best_by not in ("greedy", "sampled"):
            raise ValueError(f"best_by is {best_by!r}; choose 'greedy' or 'sampled'.")
        if best_by == "sampled" and n_samples == 0:
            raise ValueError("best_by is 'sampled', but n_samples is 0; set it to at least 1.")
        if sizes is not None and instances is not None:
            raise ValueError("instances and sizes are both given; give one of them.")
        if eval_updates is not None and eval_freq is not None:
            raise ValueError("eval_freq and eval_updates are both given; give one of them.")
        self.seed = seed
        self.sets: InstanceSets | None = None
        if instances is not None:
            self.sets = InstanceSets.read(instances)
        elif sizes is not None:
            self.sets = InstanceSets.draw(sizes, max_distance, self._source_of_size)
        self.n_instances = n_instances
        self.n_samples = n_samples
        self.eval_freq = eval_freq
        self.eval_updates = eval_updates
        self.best_by = best_by
        self.save_path = None if save_path is None else Path(save_path)

        self.best_mean_reward = -np.inf
        self.last_mean_reward = -np.inf
        self.history: EvaluationHistory
        self.table = SizeTable()
        self.folder: Path | None = None
        self._its: ITSCallback | None = None
        self._ready = False
        # Steps of earlier calls of `learn`, which are not in the model's count.
        self._steps_before = 0
        self._learned_steps = 0
        self._evaluated_epoch = 0
        self._evaluated_updates = 0
        self._described_in: str | None = ""
        self._fingerprint = ""
        # A clock that stands still during evaluations: wall and CPU seconds when it showed 0.
        self._clock_start = np.zeros(2)

    @property
    def instances(self) -> Instances | None:
        """The instances of a single set; None before they are drawn, and of several sets."""
        if self.sets is None or len(self.sets.sets) > 1:
            return None
        return next(iter(self.sets.sets.values()))

    @property
    def owned_folder(self) -> Path | None:
        """Where it keeps the best pair."""
        return self.folder

    def _source_of_size(self, n_uavs: int, n_tasks: int) -> np.random.Generator:
        """Random numbers for the instances of a size."""
        return random_stream(self.seed, FIXED_SET_STREAM, n_uavs, n_tasks)

    # ------------------------------------------------------------------------------------------------------ set-up

    def _init_callback(self) -> None:
        self._clock_start = self._now() - np.array(self._state["seconds"])

    def _on_training_start(self) -> None:
        self._policy, self._problem = self._find_policy_and_problem()
        its = siblings(self, ITSCallback)
        self._its = its[0] if its else None
        self.folder = self._find_folder()
        if self.sets is None:
            self.sets = InstanceSets.read(draw_fixed_set(self._problem, self.n_instances, self.seed))
        if not self._problem.uses_fleet:
            self.sets = self.sets.for_one_uav()
        if isinstance(self._policy, AllocatorPolicy):
            for instances in self.sets.sets.values():
                self._policy.check_fleet(instances)
        self._fingerprint = self.sets.fingerprint(self.n_samples)
        self._steps_before = max(self._state["timesteps"] - self.model.num_timesteps, 0)
        self._continue(self.sets)
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self.instances_file is not None:
                self.sets.save(self.folder / self.instances_file)
            self._take_over(self.folder)
            if len(self.history.timesteps) > 0:
                # Zips name this folder from now on.
                self._save_history(self.folder)
        self._learned_steps = self.model.num_timesteps
        self._evaluated_epoch, self._evaluated_updates = self._epoch() or 0, n_updates(self.model)
        if not np.any(self.history.timesteps >= self._timesteps):
            # The earlier run may have ended between a checkpoint and the evaluation that was due.
            evaluated = self._state.get("evaluated", {})
            self._evaluated_epoch = min(self._evaluated_epoch, evaluated.get("epoch", self._evaluated_epoch))
            self._evaluated_updates = min(self._evaluated_updates, evaluated.get("updates", self._evaluated_updates))
        self._note_state(self._now() - self._clock_start)
        self._ready = True

    def _find_policy_and_problem(self) -> tuple[EpisodicPolicy, Problem]:
        policy: Any = self.model.policy
        problem = evaluated_problem(self.training_env)
        if problem is None or not isinstance(policy, EpisodicPolicy):
            raise ValueError(
                f"{type(self).__name__} needs an AllocatorPolicy or RouterPolicy on an environment of sb3_uav, found "
                f"{type(policy).__name__} on {self.training_env}; its VecEnv must be a BatchedVecEnv or a DummyVecEnv (not "
                "--vec-env subproc) without wrappers that change observations."
            )
        return policy, problem

    def _find_folder(self) -> Path | None:
        folder = self.save_path
        if folder is None and self._its is not None:
            folder = self._its.save_path
        if folder is None:
            folder = find_run_folder(self)
        if folder is None:
            warnings.warn(f"{type(self).__name__} saves nothing: set save_path to a folder.", stacklevel=3)
            return None
        for other in siblings(self, FixedSetEvalCallback):
            same_files = other.results_file == self.results_file
            if same_files and other.folder is not None and other.folder.resolve() == folder.resolve():
                raise ValueError(f"Two {type(self).__name__}s would write to {folder}; give one of them another save_path.")
        return folder

    @property
    def _state(self) -> dict[str, Any]:
        """
        The model's own record: steps and seconds of training, the folder of the evaluations of each set, and the epoch and
        update of the last one.
        """
        return getattr(self.model, EVALUATIONS, {"timesteps": 0, "seconds": [0.0, 0.0], "folders": {}})

    def _note_state(self, seconds: np.ndarray) -> None:
        """
        Store in the model what its zip must hold to resume the evaluations.

        :param seconds: Wall and CPU seconds of the training
        """
        folder = None if self.folder is None else str(self.folder)
        state = {
            "timesteps": self._steps_before + self.model.num_timesteps,
            "seconds": seconds.tolist(),
            "folders": {**self._state["folders"], self._fingerprint: folder},
            "evaluated": {"epoch": self._evaluated_epoch, "updates": self._evaluated_updates},
        }
        setattr(self.model, EVALUATIONS, state)

    def _continue(self, sets: InstanceSets) -> None:
        """Continue the history of the model's earlier training, or begin a new one."""
        folders, timesteps = self._state["folders"], self._state["timesteps"]
        if folders.get(self._fingerprint, "") is None and self._ready:
            # No files, but this very callback was there.
            return
        self.history = EvaluationHistory.empty(sets.n_instances, self.n_samples)
        self.table = SizeTable()
        self.best_mean_reward = -np.inf
        if folders.get(self._fingerprint) is None:
            return
        old = Path(folders[self._fingerprint])
        try:
            recorded = EvaluationHistory.load(old / self.results_file)
            if [array.shape[1:] for array in recorded] != [array.shape[1:] for array in self.history]:
                shape = recorded.results.shape
                raise ValueError(f"{old / self.results_file}: results of shape {shape} are of other instances.")
            if sets.is_grid:
                self._restore_table(old, list(sets.sets))
        except (OSError, ValueError) as error:
            warnings.warn(f"The evaluations of the earlier run cannot be continued, new ones begin: {error}", stacklevel=3)
            return
        self.history = recorded.until(timesteps)
        scores = self._scores(recorded)
        # The best zip may be more recent than the zip that is being trained further; then it is not of this run.
        if len(self.history.timesteps) == 0 or int(scores.argmax()) >= len(self.history.timesteps):
            return
        self.best_mean_reward = float(scores.max())
        self._bring_best_pair(old / BEST_MODEL_FILE, find_best_router(old))

    def _restore_table(self, old: Path, names: Sequence[str]) -> None:
        """Take over the rows of an earlier run's table up to now."""
        rows = SizeTable.load(old / TABLE_FILE, names).rows
        self.table = SizeTable([row for row in rows if row["updates"] <= n_updates(self.model)])

    def _bring_best_pair(self, model: Path, router: Path | None) -> None:
        """Copy the best pair of an earlier run, unless it is in place."""
        folder = self.owned_folder
        if folder is not None and model.is_file() and (folder / BEST_MODEL_FILE).resolve() != model.resolve():
            BestPair(folder, self.best_copies).copy(model, router)

    def _take_over(self, folder: Path) -> None:
        """
        :param folder: Where an ``EvalCallback`` must not write files of the same names
        """
        results = (folder / RESULTS_FILE).with_suffix("").resolve()
        for other in siblings(self, EvalCallback):
            best = best_model_folder(other)
            if best is not None and best.resolve() == folder.resolve():
                take_over(other, self.model)
            if self.results_file == RESULTS_FILE and other.log_path is not None and Path(other.log_path).resolve() == results:
                other.log_path = str(folder / _STOCK_RESULTS)

    # ------------------------------------------------------------------------------------------------------ when

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])

    @property
    def _timesteps(self) -> int:
        """Steps that the policy has learned from, in all calls of ``learn``."""
        return self._steps_before + self._learned_steps

    def _epoch(self) -> int | None:
        """Number of finished epochs; None if there are no epochs."""
        if self._its is not None:
            return self._its.epoch
        return self.model.epoch if isinstance(self.model, REINFORCE) else None

    def _is_due(self) -> bool:
        if len(self.history.timesteps) == 0:
            return True
        last, epoch = int(self.history.timesteps[-1]), self._epoch()
        if self._timesteps <= last:
            return False
        if self.eval_updates is not None:
            return n_updates(self.model) // self.eval_updates > self._evaluated_updates // self.eval_updates
        if self.eval_freq is None and epoch is not None:
            return epoch > self._evaluated_epoch
        frequency = self.eval_freq or _DEFAULT_EVAL_FREQ
        return self._timesteps // frequency > last // frequency

    def _on_rollout_start(self) -> None:
        self._learned_steps = self.model.num_timesteps
        if self._is_due():
            self.evaluate()

    def _on_step(self) -> bool:
        self._note_state(self._now() - self._clock_start)
        return True

    def _on_rollout_end(self) -> None:
        # Its steps are going to be learned from before anything else is called.
        self._learned_steps = self.model.num_timesteps

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this a second time, and even if the training could not start.
        if self._ready and not np.any(self.history.timesteps >= self._timesteps):
            self.evaluate()

    # ------------------------------------------------------------------------------------------------------ what

    def _scores(self, history: EvaluationHistory) -> np.ndarray:
        """``(n_evaluations,)``: by what models are compared."""
        assert self.sets is not None
        return self.sets.score(history.results if self.best_by == "greedy" else history.sampled)

    def evaluate(self) -> float:
        """
        Evaluate now, and save the model if it is the best so far.

        :return: What models are compared by, see the class
        """
        assert self.sets is not None
        seconds = self._now() - self._clock_start
        parts = self.sets.sets.values()
        result = FixedSetResult.concatenate(
            [evaluate_fixed_set(self._policy, self._problem, part, self.n_samples, self.seed) for part in parts]
        )
        self.history = self.history.append(self._timesteps, result, seconds)
        self._evaluated_epoch = self._epoch() or 0
        self._evaluated_updates = n_updates(self.model)
        self.last_mean_reward = float(self._scores(self.history)[-1])
        improved = self.last_mean_reward > self.best_mean_reward
        self.best_mean_reward = max(self.last_mean_reward, self.best_mean_reward)
        self._note_state(seconds)
        if self.sets.is_grid:
            self._append_to_table(self.sets, seconds)
        if self.folder is not None:
            if improved and self.owned_folder is not None:
                self._save_best_pair(self.owned_folder)
            self._save_history(self.folder)
        self._report(result, improved)
        pause = self._now() - self._clock_start - seconds
        for callback in (self, *siblings(self, FixedSetEvalCallback)):
            callback.leave_out(pause)
        return self.last_mean_reward

    def leave_out(self, pause: np.ndarray) -> None:
        """
        :param pause: ``(2,)``, wall and CPU seconds that are no training time, such as those of an evaluation
        """
        self._clock_start = self._clock_start + pause

    def _save_history(self, folder: Path) -> None:
        self.history.save(folder / self.results_file, self.n_samples)
        if self.sets is not None and self.sets.is_grid:
            write_atomically(folder / TABLE_FILE, self.table.text())

    def _save_best_pair(self, folder: Path) -> None:
        router = None if self._its is None else self._its.router
        about = {"timesteps": self._timesteps, "mean_reward": self.last_mean_reward}
        BestPair(folder, self.best_copies).save(self.model, router, evaluated_by=type(self).__name__, **about)

    def _append_to_table(self, sets: InstanceSets, seconds: np.ndarray) -> None:
        values = self.history.results if self.best_by == "greedy" else self.history.sampled
        means = {name: float(mean[-1]) for name, mean in sets.means(values).items()}
        row = {"updates": n_updates(self.model), "seconds": round(float(seconds[0]), 1), **means}
        # Replace a row of the same update, which an earlier run may have evaluated too.
        earlier = [old for old in self.table.rows if old["updates"] < row["updates"]]
        self.table = SizeTable([*earlier, {**row, "score": self.last_mean_reward}])
        for name, mean in means.items():
            self.logger.record(f"size_grid/{name}", mean)

    def _report(self, result: FixedSetResult, improved: bool) -> None:
        if self._described_in != self.logger.dir:
            metrics = ["eval/fixed_greedy", "eval/fixed_best", *(["eval/fixed_sampled"] if self.n_samples > 0 else [])]
            record_settings(self.model, self._policy, self._its, metrics)
            self._described_in = self.logger.dir
        text = f"greedy {result.greedy.mean():.2f}"
        self.logger.record("eval/fixed_greedy", float(result.greedy.mean()))
        if self.n_samples > 0:
            text += f", best of {self.n_samples} samples {result.sampled.mean():.2f}"
            self.logger.record("eval/fixed_sampled", float(result.sampled.mean()))
        self.logger.record("eval/fixed_best", self.best_mean_reward)
        self.logger.record("eval/fixed_ep_length", float(result.lengths.mean()))
        if self.sets is not None and shows_pictures(self.logger):
            first = next(iter(self.sets.sets.values()))[0]
            record_picture(self.logger, "eval/schedule", greedy_map(self._policy, self._problem, first))
        if self.verbose > 0:
            print(f"Fixed set after {self._timesteps} steps: {text}{' (new best)' if improved else ''}")
        # As SB3's EvalCallback does, so that the values stand at their own step.
        self.logger.record("time/total_timesteps", self.model.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.model.num_timesteps)
