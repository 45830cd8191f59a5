"""Evaluation on one fixed set of instances during training, so that the best model is that of more than a lucky draw."""

from __future__ import annotations

import os
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

from sb3_uav.common.files import write_atomically
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training.callback_tree import siblings
from sb3_uav.training.fixed_set_history import RESULTS_FILE, EvaluationHistory, FixedSetResult
from sb3_uav.training.fixed_set_returns import draw_fixed_set, evaluate_fixed_set, evaluated_problem, fingerprint
from sb3_uav.training.its import BEST_ROUTER_FILE, ITSCallback
from sb3_uav.training.run_folder import find_run_folder

INSTANCES_FILE = "evaluation_instances.npz"
BEST_MODEL_FILE = "best_model.zip"
# Where a stock EvalCallback of the same run writes its results instead; it appends the suffix .npz.
STOCK_RESULTS = "evaluations_eval_callback"
# An attribute of the model, so that every zip of it names its earlier evaluations: SB3 starts counting steps again from 0.
STATE = "fixed_set_evaluations"
# SB3's EvalCallback is called every 10,000 calls, rl_zoo3's every 25,000 steps.
DEFAULT_EVAL_FREQ = 25_000


class FixedSetEvalCallback(BaseCallback):
    """
    Evaluates the policy on one fixed set of instances while it learns: greedily, and by the best of several samples.

    For our policies on our environments, under any on-policy algorithm. In the YAML of a zoo::

        callback:
          - sb3_uav.training.FixedSetEvalCallback: {n_instances: 256, n_samples: 16}

    The set is read from a file, or drawn once from the environment's own generator with random numbers that no training uses.
    An evaluation takes place before the first rollout whose steps reach a multiple of ``eval_freq``, so that the policy has
    learned from exactly the steps that are noted, and at the end. It neither changes the training's random states nor the
    policy's mode: parameters are bit-equal with and without this callback. The router of an allocation environment is the one
    that the environment has at that time; name this callback after ``ITSCallback``.

    It logs ``eval/fixed_greedy``, ``eval/fixed_sampled``, ``eval/fixed_best`` and ``eval/fixed_ep_length``, and writes into
    the run folder:

    - ``evaluations.npz`` in SB3's format (returns of the greedy episodes) with more arrays, see :class:`EvaluationHistory`;
    - ``best_model.zip`` whenever the mean is the best so far, and beside it ``best_router.zip`` under ``ITSCallback``;
    - ``evaluation_instances.npz``, the set.

    The run folder is that of rl_zoo3 (its ``EvalCallback`` or its monitor files name it), or the folder of the logger.
    SB3's ``EvalCallback``, which rl_zoo3 adds by itself, would write files of the same names, its best model being that of
    a few random episodes. If there is one with the same folder, it leaves ``best_model.zip`` to this callback and writes its
    results to ``evaluations_eval_callback.npz``; ``--eval-freq -1`` saves its time.

    The zips of a model remember where its evaluations are. If one goes on learning (``-i`` of the zoo, or ``load`` and
    ``learn``) with the same set, its new folder takes over the evaluations up to there and the best zips, and steps and times
    are counted on.

    :param instances: Path of an ``.npz`` file, or ``Instances``; drawn when None
    :param n_instances: How many to draw
    :param seed: Of the drawn instances and of the samples; not the seed of the training, so that all runs get the same set
    :param n_samples: Samples per instance; 0 for greedy evaluation only
    :param eval_freq: Environment steps between evaluations, of all environments together. When None: once per epoch of
        ``ITSCallback`` or ``REINFORCE``, and every 25,000 steps under other algorithms
    :param best_by: Whose mean the best model has: ``"greedy"`` or ``"sampled"``
    :param save_path: Folder of the files; the run folder when None
    :param verbose: Verbosity level: 0 for no output, 1 for a line per evaluation
    :raises FileNotFoundError: If there is no such file of instances
    :raises ValueError: If an argument is not allowed; the message names it
    """

    def __init__(
        self,
        instances: str | os.PathLike[str] | Instances | None = None,
        n_instances: int = 256,
        seed: int = 0,
        n_samples: int = 16,
        eval_freq: int | None = None,
        best_by: str = "greedy",
        save_path: str | os.PathLike[str] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value, least in (
            ("n_instances", n_instances, 1),
            ("seed", seed, 0),
            ("n_samples", n_samples, 0),
            ("eval_freq", 1 if eval_freq is None else eval_freq, 1),
        ):
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} is {value!r}; it must be a whole number of at least {least}.")
        if best_by not in ("greedy", "sampled"):
            raise ValueError(f"best_by is {best_by!r}; choose 'greedy' or 'sampled'.")
        if best_by == "sampled" and n_samples == 0:
            raise ValueError("best_by is 'sampled', but n_samples is 0; set it to at least 1.")
        self.instances = instances if instances is None or isinstance(instances, Instances) else Instances.load(instances)
        self.n_instances = n_instances
        self.seed = seed
        self.n_samples = n_samples
        self.eval_freq = eval_freq
        self.best_by = best_by
        self.save_path = None if save_path is None else Path(save_path)

        self.best_mean_reward = -np.inf
        self.last_mean_reward = -np.inf
        self.history: EvaluationHistory
        self.folder: Path | None = None
        self._its: ITSCallback | None = None
        self._ready = False
        # Steps of earlier calls of `learn`, which are not in the model's count.
        self._steps_before = 0
        self._learned_steps = 0
        self._evaluated_epoch = 0
        self._fingerprint = ""
        # A clock that stands still during evaluations: wall and CPU seconds when it showed 0.
        self._clock_start = np.zeros(2)

    # ------------------------------------------------------------------------------------------------------ set-up

    def _init_callback(self) -> None:
        self._clock_start = self._now() - np.array(self._state["seconds"])

    def _on_training_start(self) -> None:
        self._policy, self._problem = self._find_policy_and_problem()
        its = siblings(self, ITSCallback)
        self._its = its[0] if its else None
        self.folder = self._find_folder()
        if self.instances is None:
            self.instances = draw_fixed_set(self._problem, self.n_instances, self.seed)
        if not self._problem.uses_fleet:
            self.instances = replace(self.instances, n_uavs=1)
        if isinstance(self._policy, AllocatorPolicy):
            self._policy.check_fleet(self.instances)
        self._fingerprint = fingerprint(self.instances, self.n_samples)
        self._steps_before = max(self._state["timesteps"] - self.model.num_timesteps, 0)
        self._continue()
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.instances.save(self.folder / INSTANCES_FILE)
            self._take_over(self.folder)
        self._learned_steps = self.model.num_timesteps
        self._evaluated_epoch = self._epoch() or 0
        self._note_state(self._now() - self._clock_start)
        self._ready = True

    def _find_policy_and_problem(self) -> tuple[EpisodicPolicy, Problem]:
        policy: Any = self.model.policy
        problem = evaluated_problem(self.training_env)
        if problem is None or not isinstance(policy, EpisodicPolicy):
            raise ValueError(
                "FixedSetEvalCallback needs an AllocatorPolicy or RouterPolicy on an environment of sb3_uav, found "
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
            warnings.warn("FixedSetEvalCallback saves nothing: set save_path to a folder.", stacklevel=3)
            return None
        for other in siblings(self, FixedSetEvalCallback):
            if other.folder is not None and other.folder.resolve() == folder.resolve():
                raise ValueError(f"Two FixedSetEvalCallbacks would write to {folder}; give one of them another save_path.")
        return folder

    @property
    def _state(self) -> dict[str, Any]:
        """What the model remembers: steps and seconds of its training, and the folder of each set's evaluations."""
        return getattr(self.model, STATE, {"timesteps": 0, "seconds": [0.0, 0.0], "folders": {}})

    def _note_state(self, seconds: np.ndarray) -> None:
        """
        Keep in the model what a zip of it must know to go on.

        :param seconds: Wall and CPU seconds of the training
        """
        folder = None if self.folder is None else str(self.folder)
        state = {
            "timesteps": self._steps_before + self.model.num_timesteps,
            "seconds": seconds.tolist(),
            "folders": {**self._state["folders"], self._fingerprint: folder},
        }
        setattr(self.model, STATE, state)

    def _continue(self) -> None:
        """Go on with the history of what the model has learned before, or begin a new one."""
        assert self.instances is not None
        folders, timesteps = self._state["folders"], self._state["timesteps"]
        if folders.get(self._fingerprint, "") is None and self._ready:
            # No files, but this very callback has been there.
            return
        self.history = EvaluationHistory.empty(len(self.instances), self.n_samples)
        self.best_mean_reward = -np.inf
        if folders.get(self._fingerprint) is None:
            return
        old = Path(folders[self._fingerprint])
        try:
            recorded = EvaluationHistory.load(old / RESULTS_FILE)
        except (FileNotFoundError, ValueError) as error:
            warnings.warn(f"The evaluations of the earlier run cannot be continued, new ones begin: {error}", stacklevel=3)
            return
        self.history = recorded.until(timesteps)
        means = self._means(recorded)
        # The best zip may be of a time after that of the zip which is going on; then it is none of this run.
        if len(self.history.timesteps) == 0 or int(means.argmax()) >= len(self.history.timesteps):
            return
        self.best_mean_reward = float(means.max())
        if self.folder is not None and self.folder.resolve() != old.resolve():
            for name in (BEST_MODEL_FILE, BEST_ROUTER_FILE):
                if (old / name).is_file():
                    write_atomically(self.folder / name, (old / name).read_bytes())

    def _take_over(self, folder: Path) -> None:
        """
        :param folder: Where an ``EvalCallback`` shall not write files of the same names
        """
        results = (folder / RESULTS_FILE).with_suffix("").resolve()
        for other in siblings(self, EvalCallback):
            if other.best_model_save_path is not None and Path(other.best_model_save_path).resolve() == folder.resolve():
                other.best_model_save_path = None
            if other.log_path is not None and Path(other.log_path).resolve() == results:
                other.log_path = str(folder / STOCK_RESULTS)

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
        if self.eval_freq is None and epoch is not None:
            return epoch > self._evaluated_epoch
        frequency = self.eval_freq or DEFAULT_EVAL_FREQ
        return self._timesteps // frequency > last // frequency

    def _on_rollout_start(self) -> None:
        self._learned_steps = self.model.num_timesteps
        if self._is_due():
            self._evaluate()

    def _on_step(self) -> bool:
        self._note_state(self._now() - self._clock_start)
        return True

    def _on_rollout_end(self) -> None:
        # Its steps are going to be learned from before anything else is called.
        self._learned_steps = self.model.num_timesteps

    def _on_training_end(self) -> None:
        # rl_zoo3 calls this a second time, and even if the training could not start.
        if self._ready and not np.any(self.history.timesteps >= self._timesteps):
            self._evaluate()

    # ------------------------------------------------------------------------------------------------------ what

    def _means(self, history: EvaluationHistory) -> np.ndarray:
        """``(n_evaluations,)``: by what models are compared."""
        return (history.results if self.best_by == "greedy" else history.sampled).mean(1)

    def _evaluate(self) -> None:
        assert self.instances is not None
        seconds = self._now() - self._clock_start
        result = evaluate_fixed_set(self._policy, self._problem, self.instances, self.n_samples, self.seed)
        self.history = self.history.append(self._timesteps, result, seconds)
        self._evaluated_epoch = self._epoch() or 0
        self.last_mean_reward = float(self._means(self.history)[-1])
        improved = self.last_mean_reward > self.best_mean_reward
        self.best_mean_reward = max(self.last_mean_reward, self.best_mean_reward)
        self._note_state(seconds)
        if self.folder is not None:
            if improved:
                save_atomically(self.model, self.folder / BEST_MODEL_FILE)
                if self._its is not None:
                    self._its.save_best_router(self.folder)
            self.history.save(self.folder / RESULTS_FILE, self.n_samples)
        self._report(result, improved)
        pause = self._now() - self._clock_start - seconds
        for callback in (self, *siblings(self, FixedSetEvalCallback)):
            callback._clock_start = callback._clock_start + pause

    def _report(self, result: FixedSetResult, improved: bool) -> None:
        text = f"greedy {result.greedy.mean():.2f}"
        self.logger.record("eval/fixed_greedy", float(result.greedy.mean()))
        if self.n_samples > 0:
            text += f", best of {self.n_samples} samples {result.sampled.mean():.2f}"
            self.logger.record("eval/fixed_sampled", float(result.sampled.mean()))
        self.logger.record("eval/fixed_best", self.best_mean_reward)
        self.logger.record("eval/fixed_ep_length", float(result.lengths.mean()))
        if self.verbose > 0:
            print(f"Fixed set after {self._timesteps} steps: {text}{' (new best)' if improved else ''}")
        # As SB3's EvalCallback does, so that the values stand at their own step.
        self.logger.record("time/total_timesteps", self.model.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.model.num_timesteps)
