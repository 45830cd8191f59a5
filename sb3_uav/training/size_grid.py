"""Evaluation on fixed instances of several sizes, under its former name."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.random_streams import GRID_SEED
from sb3_uav.common.sb3_compat import n_updates
from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy
from sb3_uav.training.best_pair import find_best_router
from sb3_uav.training.fixed_set import TABLE_FILE, FixedSetEvalCallback
from sb3_uav.training.instance_sets import InstanceSets

# UAVs, tasks, instances.
_DEFAULT_SIZES = ((4, 80, 48), (6, 80, 32), (4, 200, 16), (6, 200, 16), (4, 500, 8), (6, 500, 8))
_BEST_ALLOCATOR_FILE = "best_allocator.zip"


class SizeGridCallback(FixedSetEvalCallback):
    """
    Deprecated: :class:`~sb3_uav.training.FixedSetEvalCallback` with ``sizes`` and ``eval_updates`` does the same.

    It keeps the instances, the arguments and the file ``size_grid.csv`` of earlier versions, and continues their runs.
    ``best_allocator.zip`` is a copy of ``best_model.zip``. Beside a ``FixedSetEvalCallback`` of the same folder, which then
    decides on the best pair, it only writes its table.

    :param sizes: UAVs, tasks and number of instances of each set
    :param max_distance: Maximum flight distance
    :param freq: Updates between evaluations
    :param n_samples: How many allocations to sample for every instance; the greedy one instead when None
    :param save_path: Folder of the files; the run folder when None
    :param verbose: Verbosity level: 0 for no output, 1 for a line per evaluation
    :raises ValueError: If an argument is not allowed; the message names it
    """

    results_file = "size_grid.npz"
    instances_file = None
    best_copies = (_BEST_ALLOCATOR_FILE,)

    def __init__(
        self,
        sizes: Sequence[Sequence[int]] = _DEFAULT_SIZES,
        max_distance: float = 2.0,
        freq: int = 100,
        n_samples: int | None = None,
        save_path: str | None = None,
        verbose: int = 0,
    ) -> None:
        warnings.warn(
            "SizeGridCallback is deprecated; use FixedSetEvalCallback with sizes and eval_updates.",
            DeprecationWarning,
            stacklevel=2,
        )
        if freq < 1:
            raise ValueError(f"freq is {freq}; give at least 1 update.")
        if n_samples is not None and n_samples < 1:
            raise ValueError(f"n_samples is {n_samples}; give at least 1, or None for greedy allocations.")
        super().__init__(
            n_samples=n_samples or 0,
            best_by="greedy" if n_samples is None else "sampled",
            save_path=save_path,
            verbose=verbose,
            sizes=sizes,
            max_distance=max_distance,
            eval_updates=freq,
        )

    @property
    def parts(self) -> dict[str, Instances]:
        """The instances of each size."""
        assert self.sets is not None
        return self.sets.sets

    @property
    def records(self) -> list[dict[str, float]]:
        """The rows of ``size_grid.csv``."""
        return self.table.rows

    @property
    def best_score(self) -> float:
        """The best mean logarithm of the mean objectives so far."""
        return self.best_mean_reward

    @property
    def owned_folder(self) -> Path | None:
        """Where it keeps the best pair, unless a ``FixedSetEvalCallback`` does."""
        others = [other for other in siblings(self, FixedSetEvalCallback) if not isinstance(other, SizeGridCallback)]
        folders = [other.folder.resolve() for other in others if other.folder is not None]
        return None if self.folder is None or self.folder.resolve() in folders else self.folder

    def _source_of_size(self, n_uavs: int, n_tasks: int) -> np.random.Generator:
        return np.random.default_rng([GRID_SEED, n_uavs, n_tasks])

    def _find_policy_and_problem(self) -> tuple[EpisodicPolicy, Problem]:
        policy, problem = super()._find_policy_and_problem()
        if not isinstance(problem, AllocationProblem) or not isinstance(policy, AllocatorPolicy):
            raise ValueError(f"SizeGridCallback needs an AllocatorPolicy on a TaskAllocation environment, found {problem}.")
        return policy, problem

    def _continue(self, sets: InstanceSets) -> None:
        super()._continue(sets)
        if len(self.history.timesteps) == 0 and n_updates(self.model) > 0:
            self._continue_table(list(sets.sets))

    def _continue_table(self, names: Sequence[str]) -> None:
        """Continue a run of a version that wrote nothing but the table, if there is one."""
        folders = [self.folder]
        if self._its is not None and self._its.resume_from is not None:
            folders.append(self._its.resume_from.parent)
        for folder in folders:
            if folder is None or not (folder / TABLE_FILE).is_file():
                continue
            self._restore_table(folder, names)
            best = max((row["score"] for row in self.table.rows), default=-np.inf)
            self.best_mean_reward = best
            self._bring_best_pair(folder / _BEST_ALLOCATOR_FILE, find_best_router(folder))
            return
