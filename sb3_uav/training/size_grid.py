"""Evaluation on fixed instances of several sizes, keeping the best pair."""

from __future__ import annotations

import csv
import io
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_streams import GRID_SEED
from sb3_uav.common.saving import save_atomically
from sb3_uav.common.sb3_compat import n_updates
from sb3_uav.envs.allocation import AllocationProblem, plan_tours
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce.recognition import find_problem
from sb3_uav.training.callback_tree import siblings
from sb3_uav.training.its import BEST_ROUTER_FILE, ITSCallback

# UAVs, tasks, instances.
DEFAULT_SIZES = ((4, 80, 48), (6, 80, 32), (4, 200, 16), (6, 200, 16), (4, 500, 8), (6, 500, 8))
GRID_FILE, BEST_ALLOCATOR_FILE = "size_grid.csv", "best_allocator.zip"


class SizeGridCallback(BaseCallback):
    """
    Evaluates allocator and router on the same instances again and again, with the fused driver.

    Both are greedy; with ``n_samples`` the allocator is sampled and the best of the schedules counts, always from the same
    random numbers. What is best in the one way need not be so in the other.

    Writes ``size_grid.csv`` (mean objective by size) and, whenever the geometric mean over the sizes is better than ever,
    ``best_allocator.zip`` and, next to an :class:`~sb3_uav.training.ITSCallback`, ``best_router.zip``.

    :param sizes: UAVs, tasks and number of instances of each part
    :param max_distance: Maximum flight distance
    :param freq: Updates between evaluations
    :param n_samples: How many allocations to sample for every instance; the greedy one instead when None
    :param save_path: Folder of the files; that of the ITS when None
    :param verbose: Verbosity level: 0 for no output, 1 for a line per evaluation
    """

    def __init__(
        self,
        sizes: Sequence[Sequence[int]] = DEFAULT_SIZES,
        max_distance: float = 2.0,
        freq: int = 100,
        n_samples: int | None = None,
        save_path: str | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if freq < 1:
            raise ValueError(f"freq is {freq}; give at least 1 update.")
        if n_samples is not None and n_samples < 1:
            raise ValueError(f"n_samples is {n_samples}; give at least 1, or None for greedy allocations.")
        self.freq = freq
        self.n_samples = n_samples
        self.save_path = None if save_path is None else Path(save_path)
        self.parts = {
            f"U{n_uavs}-N{n_tasks}": UniformGenerator(n_tasks, n_uavs, max_distance)(
                n_instances, np.random.default_rng([GRID_SEED, n_uavs, n_tasks])
            )
            for n_uavs, n_tasks, n_instances in sizes
        }
        self.records: list[dict[str, float]] = []
        self.best_score = -np.inf
        self._is_restored = False

    def _on_training_start(self) -> None:
        problem = find_problem(self.training_env)
        if not isinstance(problem, AllocationProblem) or not isinstance(self.model.policy, AllocatorPolicy):
            raise ValueError(f"SizeGridCallback needs an AllocatorPolicy on a TaskAllocation environment, found {problem}.")
        self.problem = problem
        self._start = time.time()

    def _its(self) -> ITSCallback | None:
        found = siblings(self, ITSCallback)
        return found[0] if found else None

    def _on_rollout_start(self) -> None:
        if not self._is_restored:
            self._restore()
        if n_updates(self.model) % self.freq == 0 and (
            not self.records or self.records[-1]["updates"] != n_updates(self.model)
        ):
            self.evaluate()

    def _on_step(self) -> bool:
        return True

    def _folder(self) -> Path | None:
        its = self._its()
        return self.save_path or (None if its is None else its.save_path)

    def _restore(self) -> None:
        """Go on with the history, and with the best pair, of a run that is resumed."""
        self._is_restored = True
        folder, its = self._folder(), self._its()
        if folder is None:
            warnings.warn("SizeGridCallback keeps no best pair: set save_path to a folder.", stacklevel=3)
        if folder is None or n_updates(self.model) == 0:
            return
        earlier = [folder] if its is None or its.resume_from is None else [folder, its.resume_from.parent]
        for source in earlier:
            if not (source / GRID_FILE).is_file():
                continue
            with (source / GRID_FILE).open(newline="", encoding="utf-8") as file:
                rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
            self.records = [row for row in rows if row["updates"] <= n_updates(self.model)]
            self.best_score = max((row["score"] for row in rows), default=-np.inf)
            for name in (BEST_ALLOCATOR_FILE, BEST_ROUTER_FILE):
                if source != folder and (source / name).is_file():
                    write_atomically(folder / name, (source / name).read_bytes())
            return

    def evaluate(self) -> float:
        """
        Evaluate now.

        :return: The score: mean logarithm of the mean objectives
        """
        assert isinstance(self.model.policy, AllocatorPolicy)
        policy, was_training = self.model.policy, self.model.policy.training
        policy.set_training_mode(False)
        objectives = {name: self._objective(policy, part) for name, part in self.parts.items()}
        policy.set_training_mode(was_training)
        score = float(np.mean([np.log(max(objective, 1e-9)) for objective in objectives.values()]))
        its = self._its()
        seconds = round(time.time() - self._start, 1)
        self.records.append({"updates": n_updates(self.model), "seconds": seconds, **objectives, "score": score})
        for name, objective in objectives.items():
            self.logger.record(f"size_grid/{name}", objective)
        if self.verbose > 0:
            found = ", ".join(f"{name} {objective:.2f}" for name, objective in objectives.items())
            print(f"update {n_updates(self.model)}: {found}, score {score:.4f}", flush=True)
        folder = self._folder()
        if folder is not None:
            text = io.StringIO()
            writer = csv.DictWriter(text, list(self.records[0]))
            writer.writeheader()
            writer.writerows(self.records)
            write_atomically(folder / GRID_FILE, text.getvalue())
            if score > self.best_score:
                save_atomically(self.model, folder / BEST_ALLOCATOR_FILE)
                if its is not None:
                    save_atomically(its.router, folder / BEST_ROUTER_FILE)
        self.best_score = max(self.best_score, score)
        return score

    def _objective(self, policy: AllocatorPolicy, part: Instances) -> float:
        with th.no_grad():
            arranged = policy.arrange(part).to(policy.device)
            generator = th.Generator(policy.device).manual_seed(GRID_SEED)
            actions = policy.decode_episodes(arranged, self.n_samples or 1, self.n_samples is None, generator)
            planned = plan_tours(arranged, actions, self.problem.router)
        return float(planned.value.amax(1).mean())
