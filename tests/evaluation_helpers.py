"""What the tests of evaluations share: solvers that do as they are told, and the files read back."""

from __future__ import annotations

import csv
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_uav.envs import Instances, Schedule
from sb3_uav.evaluation.summary import SummaryRow
from sb3_uav.solvers import OneByOneSolver, Solution, Solver, SolverResult


class Stub(Solver):
    """Returns the given routes for every instance."""

    name = "stub"

    def __init__(self, routes: Sequence[Sequence[int]] = ()) -> None:
        self.routes = routes

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        return [SolverResult(Schedule(self.routes), 0.5, len(instances)) for _ in range(len(instances))]


class Nearest(OneByOneSolver):
    """
    Visits one task, which depends on the random numbers.

    :param broken: Rows at which it raises ``error``, told by the coordinates of their depots
    """

    name = "nearest"

    def __init__(self, broken: Sequence[float] = (), error: BaseException | None = None) -> None:
        self.broken = broken
        self.error = error
        self.solved: list[float] = []

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        place = float(instance.depot[0, 0])
        if place in self.broken:
            raise self.error or RuntimeError("no\nway")
        self.solved.append(place)
        reachable = np.nonzero(instance.reachable()[0].numpy())[0]
        return Solution(Schedule([rng.choice(reachable, 1)]), bound=float(instance.n_tasks))


class Limited(OneByOneSolver):
    """Visits as many of three tasks at the depot as it has seconds, and refuses to work without any."""

    name = "limited"

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        if time_limit is None or time_limit <= 0:
            raise ValueError(f"{self.name} needs a time limit above 0.")
        return Solution(Schedule([range(round(time_limit))]))


class Unlimited(Stub):
    uses_time_limit = False
    calls = 0

    def solve(self, instances: Instances, time_limit: float | None = None, seed: int = 0) -> list[SolverResult]:
        assert time_limit is None
        self.calls += 1
        return super().solve(instances, time_limit, seed)


class Choosy(Stub):
    """Refuses fleets of more than two UAVs."""

    name = "choosy"

    def check(self, instances: Instances) -> None:
        if instances.n_uavs > 2:
            raise RuntimeError("the license is too small")


class Fastidious(Stub):
    """Refuses ways that end elsewhere than at the depot, and visits nothing."""

    def check(self, instances: Instances) -> None:
        if instances.end is not None:
            raise ValueError("no open ways")


class Mortal(OneByOneSolver):
    """Ends its process, or never ends, on instances whose depot lies at the given places."""

    name = "mortal"

    def __init__(self, deadly: Sequence[float] = (), endless: Sequence[float] = ()) -> None:
        self.deadly = deadly
        self.endless = endless

    def solve_one(self, instance: Instances, time_limit: float | None, rng: np.random.Generator) -> Solution:
        place = float(instance.depot[0, 0])
        if place in self.deadly:
            os._exit(1)
        while place in self.endless:
            time.sleep(1)
        return Solution(Schedule([[int(rng.integers(3))]]))


def places(instances: Instances) -> list[float]:
    return instances.depot[:, 0].tolist()


def named(name: str, solver: Solver) -> Solver:
    solver.name = name
    return solver


def read_rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_schedules(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "schedules.jsonl").read_text().splitlines()]


def contents(folder: Path) -> tuple[str, str]:
    """Both files, without the seconds."""
    lines = [",".join({**row, "seconds": ""}.values()) for row in read_rows(folder)]
    return "\n".join(lines), (folder / "schedules.jsonl").read_text()


def figures(summary: list[SummaryRow]) -> list[list[Any]]:
    """What a summary says, without the seconds, and so that NaN equals itself."""
    return [[repr(value) for name, value in vars(row).items() if name != "seconds"] for row in summary]
