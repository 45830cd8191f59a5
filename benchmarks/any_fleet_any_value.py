"""
How good a pair of networks is on the whole problem: clustered maps, fleets of any size, values, one dear task, unlike UAVs.

Each row compares two solvers on the same held-out instances: ratio of the mean objectives with its 95 % interval. Times are
CPU times of one core; run it on a quiet machine.

    python benchmarks/any_fleet_any_value.py --pair universal --out floors.csv
    python benchmarks/any_fleet_any_value.py --allocator allocator_90.zip --router router_90.zip --parts values dear whole
    python benchmarks/any_fleet_any_value.py --pair world --parts ablation

The ablation asks what each field of the problem is worth to the networks: they see the same instances with one field
replaced by its default (values all 1; service costs 0; UAVs start, or end, at the depot; every UAV flies as far as the mean
of them, which concerns the allocator only, as a router looks at one UAV). Nothing else changes: which actions are legal,
how long tours are, what the best of several schedules is and what the checker measures are always those of the true
instance. So every schedule is feasible, and the ratio is what blindness costs networks that were trained to see; networks
that are trained without a field may do better than these. Only instances in which the field differs from its default count.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_uav.common.random_streams import keyed_generator
from sb3_uav.common.statistics import Interval
from sb3_uav.envs import ClusteredGenerator, Instances, UniformGenerator, WorldGenerator, check_schedule
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import StoredPolicy, read_policy
from sb3_uav.solvers import DLDRL, Solver, make_solver

# Fleets, maximum distances and sizes of the clustered and uniform sets: V 2 to 10, D 1 to 3, N 40 to 400.
_SETS = ((2, 1.0, 40), (3, 1.5, 80), (4, 2.0, 100), (6, 2.0, 200), (8, 2.5, 300), (10, 3.0, 400))
# A task in reach of a UAV that flies for nothing else.
_DEAR_REACH = 0.97
# Fleets and sizes of the ablation.
_ABLATED = ((3, 50), (4, 100))

Hide = Callable[[Instances], Instances]


def _without_ranges(instances: Instances) -> Instances:
    return replace(instances, max_distance=instances.uav_distance.mean(1))


def _without_values(instances: Instances) -> Instances:
    return replace(instances, values=instances.task_mask.to(instances.values.dtype), must_serve=None)


# What networks see in place of an instance.
HIDDEN: dict[str, Hide] = {
    "values": _without_values,
    "service": lambda instances: replace(instances, service=None),
    "start": lambda instances: replace(instances, start=None),
    "end": lambda instances: replace(instances, end=None),
    "ranges": _without_ranges,
    "all of these": lambda instances: _without_values(_without_ranges(replace(instances, service=None, start=None, end=None))),
}


class BlindAllocator(AllocatorPolicy):
    """An allocator that sees instances with a field hidden. Which UAVs may take a task is no matter of what it sees."""

    hide: Hide

    def task_order(self, instances: Instances, variant: int = 0) -> th.Tensor:
        return super().task_order(self.hide(instances), variant)

    def encode(self, instances: Instances) -> Any:
        return super().encode(self.hide(instances))

    def encode_nodes(self, instances: Instances) -> th.Tensor:
        return super().encode_nodes(self.hide(instances))

    def arranged_cache(self, nodes: th.Tensor, order: th.Tensor, arranged: Instances) -> Any:
        return super().arranged_cache(nodes, order, self.hide(arranged))


class BlindRouter(RouterPolicy):
    """A router that sees instances with a field hidden. Where it may fly is no matter of what it sees."""

    hide: Hide

    def encode(self, instances: Instances) -> Any:
        return super().encode(self.hide(instances))


def tells(instances: Instances, hide: Hide) -> th.Tensor:
    """:return: ``(batch,)`` bool, in which instances a field that is hidden differs from what is seen in its place"""
    hidden = hide(instances)
    pairs = [
        (getattr(instances, name), getattr(hidden, name))
        for name in ("prizes", "service_cost", "uav_start", "uav_end", "uav_distance")
    ]
    return th.stack([(true != seen).flatten(1).any(1) for true, seen in pairs]).any(0)


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

    @cached_property
    def stored(self) -> list[StoredPolicy]:
        """The allocator and the router as their zips hold them."""
        return [read_policy(file) for file in self.networks("").files.values()]

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

    def blind(self, decode: str, hide: Hide) -> DLDRL:
        """:return: The pair with this decoding, and with something hidden from both networks"""
        networks: list[Any] = []
        for network, cls in zip(self.stored, (BlindAllocator, BlindRouter), strict=True):
            networks.append(cls.from_parameters(network.parameters, network.policy_kwargs, "cpu"))
            networks[-1].hide = hide
        return DLDRL(networks[0], networks[1], decode)

    def ablation(self) -> Iterator[Row]:
        """One field after the other hidden from the networks."""
        for n_uavs, n_tasks in _ABLATED:
            generator = WorldGenerator(n_tasks, n_uavs, whole_share=1.0, paper_share=0.0)
            instances = generator(2 * self.n_instances, keyed_generator(self.seed, 400 + n_tasks))
            for decode in ("greedy", "augment"):
                seen, _ = self.objectives(self.networks(f"decode={decode}"), instances)
                for field, hide in HIDDEN.items():
                    rows = tells(instances, hide)
                    if rows.sum() < 2:
                        continue
                    blind, seconds = self.objectives(self.blind(decode, hide), instances[rows])
                    ratio = Interval.of_ratio(blind, seen[rows.numpy()])
                    name = f"world, V = {n_uavs}, N = {n_tasks}"
                    yield Row("ablation", name, f"decode={decode}, {field} hidden", "nothing hidden", ratio, seconds)


_PARTS: dict[str, Callable[[Measuring], Iterator[Row]]] = {
    "maps": Measuring.maps,
    "values": Measuring.values,
    "dear": Measuring.dear,
    "whole": Measuring.whole,
    "ablation": Measuring.ablation,
}
# Of a pair that is measured for the first time.
_DEFAULT_PARTS = [part for part in _PARTS if part != "ablation"]


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", default="", help="name of a trained pair; the default pair when not given")
    parser.add_argument("--allocator", type=Path, help="zip of an allocator, in place of --pair")
    parser.add_argument("--router", type=Path, help="zip of its router")
    parser.add_argument("--parts", nargs="+", choices=sorted(_PARTS), default=_DEFAULT_PARTS, help="default: all but ablation")
    parser.add_argument("--n-instances", type=int, default=8, help="instances of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=20261207, help="seed of the instances (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="CSV file to write")
    args = parser.parse_args(argv)
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
