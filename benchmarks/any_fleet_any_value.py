"""
How good a pair of networks is on the whole problem: clustered maps, fleets of any size, values, one dear task, unlike UAVs.

Each row compares two solvers on the same held-out instances: ratio of the mean objectives with its 95 % interval. Times are
CPU times of one core; run it on a quiet machine.

    python benchmarks/any_fleet_any_value.py --pair universal --out floors.csv
    python benchmarks/any_fleet_any_value.py --allocator allocator_90.zip --router router_90.zip --parts values dear whole
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_uav.common.random_streams import keyed_generator
from sb3_uav.common.statistics import Interval
from sb3_uav.envs import ClusteredGenerator, Instances, UniformGenerator, WorldGenerator, check_schedule
from sb3_uav.solvers import Solver, make_solver

# Fleets, maximum distances and sizes of the clustered and uniform sets: V 2 to 10, D 1 to 3, N 40 to 400.
_SETS = ((2, 1.0, 40), (3, 1.5, 80), (4, 2.0, 100), (6, 2.0, 200), (8, 2.5, 300), (10, 3.0, 400))
# A task in reach of a UAV that flies for nothing else.
_DEAR_REACH = 0.97


class Row(NamedTuple):
    """
    :param part: Which part
    :param instances: What the instances are
    :param solver: The solver that is judged
    :param reference: What it is compared with
    :param ratio: Ratio of the mean objectives; where there is no reference, a mean
    :param seconds: CPU seconds of the solver per instance
    """

    part: str
    instances: str
    solver: str
    reference: str
    ratio: Interval
    seconds: float


class Measuring:
    """
    Solves sets of instances with the pair and with references.

    :param pair: Options of the solver ``dl-drl`` that name the pair
    :param n_instances: How many instances of each kind
    :param seed: Seed of the instances
    """

    def __init__(self, pair: str, n_instances: int, seed: int) -> None:
        self.pair = pair
        self.n_instances = n_instances
        self.seed = seed

    def networks(self, options: str) -> Solver:
        """:return: The pair with these options"""
        return make_solver(f"dl-drl:{','.join(part for part in (options, self.pair) if part)}")

    def objectives(self, solver: Solver, instances: Instances) -> tuple[np.ndarray, float]:
        """:return: ``(n,)`` objectives that the checker accepts, and CPU seconds per instance"""
        solver.prepare()
        start = time.process_time()
        # One at a time, so that a time limit is the instance's own.
        found = [solver.solve(instances[row], seed=self.seed)[0].schedule for row in range(len(instances))]
        seconds = (time.process_time() - start) / len(instances)
        return np.array([check_schedule(instances, row, schedule).objective for row, schedule in enumerate(found)]), seconds

    def compare(self, part: str, name: str, instances: Instances, options: str, reference: str) -> Row:
        """:return: The pair with these options against a solver"""
        mine, seconds = self.objectives(self.networks(options), instances)
        other, _ = self.objectives(make_solver(reference), instances)
        return Row(part, name, options, reference, Interval.of_ratio(mine, other), seconds)

    def maps(self) -> Iterator[Row]:
        """Clustered and uniform maps with unit values."""
        for number, (n_uavs, distance, n_tasks) in enumerate(_SETS):
            for kind, generator in (("clustered", ClusteredGenerator), ("uniform", UniformGenerator)):
                instances = generator(n_tasks, n_uavs, distance)(self.n_instances, keyed_generator(self.seed, number))
                name = f"{kind}, V = {n_uavs}, D = {distance:g}, N = {n_tasks}"
                for options in ("decode=augment", "decode=augment,repair=1,polish=1,time_limit=1"):
                    yield self.compare("maps", name, instances, options, "pyvrp:time_limit=1")

    def values(self) -> Iterator[Row]:
        """Values from 1 to 100."""
        rng = keyed_generator(self.seed, 100)
        plain = UniformGenerator(100, 4)(2 * self.n_instances, rng)
        instances = replace(plain, values=th.from_numpy(rng.integers(1, 101, plain.values.shape).astype(np.float64)))
        for reference in ("greedy-insertion", "ortools"):
            yield self.compare("values", "uniform, V = 4, N = 100, values 1 to 100", instances, "decode=greedy", reference)
        yield self.compare(
            "values", "uniform, V = 4, N = 100, values 1 to 100", instances, "decode=augment", "pyvrp:time_limit=1"
        )

    def dear(self) -> Iterator[Row]:
        """One task in reach that is worth more than all others together: in which part of the instances it is served."""
        rng = keyed_generator(self.seed, 200)
        instances = UniformGenerator(60, 3, 1.5)(24, rng)
        angle = th.from_numpy(rng.uniform(0, 2 * np.pi, len(instances)))
        place = instances.depot + _DEAR_REACH * 0.75 * th.stack([angle.cos(), angle.sin()], dim=-1)
        tasks, values = instances.tasks.clone(), instances.values.clone()
        tasks[:, 0], values[:, 0] = place, 2.0 * instances.n_tasks
        instances = replace(instances, tasks=tasks, values=values)
        for options in ("decode=greedy", "decode=greedy,repair=1", "decode=augment"):
            found, seconds = self.objectives(self.networks(options), instances)
            # It is worth more than all others together.
            served = (found >= values[:, 0].numpy()).astype(float)
            yield Row("dear", "one dear task far out, V = 3, N = 60", options, "served", Interval.of_mean(served), seconds)
        some = instances[: self.n_instances]
        yield self.compare("dear", "one dear task far out, V = 3, N = 60", some, "decode=greedy", "pyvrp:time_limit=1")

    def whole(self) -> Iterator[Row]:
        """UAVs that differ, several depots, UAVs in the air, service costs."""
        for n_uavs, n_tasks in ((2, 50), (4, 100), (8, 200)):
            generator = WorldGenerator(n_tasks, n_uavs, whole_share=1.0, paper_share=0.0)
            instances = generator(2 * self.n_instances, keyed_generator(self.seed, 300 + n_tasks))
            for options in ("decode=greedy", "decode=augment", "decode=augment,repair=1,polish=1,time_limit=1"):
                yield self.compare("whole", f"world, V = {n_uavs}, N = {n_tasks}", instances, options, "pyvrp:time_limit=1")


_PARTS: dict[str, Callable[[Measuring], Iterator[Row]]] = {
    "maps": Measuring.maps,
    "values": Measuring.values,
    "dear": Measuring.dear,
    "whole": Measuring.whole,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", default="", help="name of a trained pair; the default pair when not given")
    parser.add_argument("--allocator", type=Path, help="zip of an allocator, in place of --pair")
    parser.add_argument("--router", type=Path, help="zip of its router")
    parser.add_argument("--parts", nargs="+", choices=sorted(_PARTS), default=list(_PARTS), help="default: all")
    parser.add_argument("--n-instances", type=int, default=8, help="instances of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=20261207, help="seed of the instances (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="CSV file to write")
    args = parser.parse_args()
    th.set_num_threads(1)
    options = {"allocator": args.allocator or args.pair or None, "router": args.router}
    pair = ",".join(f"{name}={value}" for name, value in options.items() if value is not None)
    measuring = Measuring(pair, args.n_instances, args.seed)
    rows = []
    for part in args.parts:
        for row in _PARTS[part](measuring):
            rows.append(row)
            ratio = f"{row.ratio.mean:.3f} [{row.ratio.low:.3f}, {row.ratio.high:.3f}]"
            print(f"{row.instances}: {row.solver} / {row.reference}: {ratio}, {row.seconds:.2f} CPU s", flush=True)
    if args.out is not None:
        with args.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["part", "instances", "solver", "reference", "ratio", "low", "high", "n", "cpu_seconds"])
            writer.writerows(
                [*row[:4], *(f"{x:.5f}" for x in row.ratio[:3]), row.ratio.n, f"{row.seconds:.4f}"] for row in rows
            )


if __name__ == "__main__":
    main()
