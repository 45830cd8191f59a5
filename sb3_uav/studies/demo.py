"""The demo after its training: evaluation beside heuristics, learning curves and a schedule."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

from sb3_uav.common.epoch_log import LOG_FILE
from sb3_uav.common.random_streams import TEST_SEED, keyed_generator
from sb3_uav.envs import TaskAllocationEnv
from sb3_uav.evaluation import evaluate, print_table
from sb3_uav.evaluation.results import RESULTS_FILE
from sb3_uav.plots.learning_curves import plot_learning_curves
from sb3_uav.plots.schedule_map import MapPanel, plot_schedules
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers import Solver, make_solver
from sb3_uav.solvers.dl_drl import DLDRL


def newest_run(folder: Path, env_id: str) -> Path:
    """
    :param folder: rl_zoo3's folder of an algorithm
    :param env_id: Id of an environment
    :return: Its run with the highest number
    """
    runs = [path for path in folder.glob(f"{env_id}_*") if path.name.rpartition("_")[2].isdigit()]
    return max(runs, key=lambda path: int(path.name.rpartition("_")[2]))


def evaluate_run(run: Path, env_id: str, out: Path, n_instances: int, seed: int) -> int:
    """
    Evaluate a trained pair beside heuristics, print the table and draw the figures.

    :param run: rl_zoo3's folder of the run
    :param env_id: Id of its environment
    :param out: Folder of the results
    :param n_instances: Number of test instances
    :param seed: Seed of the solvers
    :return: Exit code: 1 if a schedule was infeasible
    """
    environment = gym.make(env_id).unwrapped
    assert isinstance(environment, TaskAllocationEnv)
    instances = environment.problem.generator(n_instances, keyed_generator(TEST_SEED))
    instances.save(out / "instances.npz")

    allocator = load_policy(run / f"{env_id}.zip", expected=AllocatorPolicy)
    router = load_policy(run / "router.zip", expected=RouterPolicy)
    greedy, sampling = DLDRL(allocator, router), DLDRL(allocator, router, "sampling")
    heuristics = [make_solver("kmeans-nearest"), make_solver("random-nearest")]
    solvers: list[Solver] = [greedy, sampling, greedy.untrained(seed), *heuristics]
    print(f"\nEvaluating on {n_instances} new instances of {env_id}; every schedule is checked.")
    summary = evaluate(solvers, {env_id: instances}, out / "results", seed)
    print_table(summary)
    _print_gains(out / "results" / RESULTS_FILE, [greedy.name, sampling.name], [solver.name for solver in heuristics])

    plot_learning_curves(run / LOG_FILE, out / "learning_curves.png")
    # The instance with the most central depot shows the tours best.
    row = int((instances.depot - 0.5).norm(dim=1).argmin())
    panels = []
    for solver in (sampling, heuristics[0]):
        schedule = solver.solve(instances[row], seed=seed)[0].schedule
        panels.append(MapPanel(instances, row, schedule, f"{solver.name}: {schedule.n_visited} tasks"))
    plot_schedules(panels, out / "schedule.png")
    files = {
        "trained allocator": run / f"{env_id}.zip",
        "trained router": run / "router.zip",
        "results": out / "results" / "results.csv",
        "schedules": out / "results" / "schedules.jsonl",
        "learning curves": out / "learning_curves.png",
        "a schedule": out / "schedule.png",
    }
    for what, path in files.items():
        print(f"{what:>18}: {path}")
    print(f"{'training curves':>18}: tensorboard --logdir {out / 'tensorboard'}")
    return int(any(row.violations for row in summary))


def _print_gains(results: Path, ours: Sequence[str], others: Sequence[str]) -> None:
    """
    Print the mean paired difference between our solvers and others.

    :param results: The ``results.csv`` of an evaluation
    :param ours: Names of the solvers to compare
    :param others: Names of the solvers to compare them with
    """
    with results.open() as file:
        rows = list(csv.DictReader(file))
    objectives = {
        name: np.array([float(row["objective"] or "nan") for row in rows if row["solver"] == name])
        for name in (*ours, *others)
    }
    for name in ours:
        for other in others:
            gain = objectives[name] - objectives[other]
            error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else float("nan")
            relative = gain.mean() / objectives[other].mean()
            print(f"{name} against {other}: {gain.mean():+.2f} tasks ({relative:+.1%}), standard error {error:.2f}")
