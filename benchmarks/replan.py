"""
How fast a half-flown mission is planned again, how much of it stays, and what that costs against planning from scratch.

UAVs are in the air with the rest of their range, one is lost, new tasks come up. "value / anew" compares the value of the new
plan with that of the same solver on the same situation without the old routes: the ratio of means with its 95 % interval.

    python benchmarks/replan.py --n-tasks 200 --seeds 8
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence

import numpy as np
import torch as th

from sb3_uav.common.statistics import Interval
from sb3_uav.local_search.search import warm_up
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.replan import replan
from sb3_uav.missions.search import solve
from sb3_uav.missions.status import NewTask, Status, UavReport
from sb3_uav.missions.tasks import TaskList

DEPOT = (47.38, 8.54)
_SPEED = 12.0
# Half the side of the area, in degrees of latitude and longitude: about 10 km by 10 km.
_HALF_SIDE = (0.045, 0.066)


def some_places(n_places: int, rng: np.random.Generator) -> np.ndarray:
    """:return: ``(n_places, 2)``, latitudes and longitudes in the area"""
    return np.array(DEPOT) + rng.uniform(-1, 1, (n_places, 2)) * _HALF_SIDE


def some_plan(n_tasks: int, n_uavs: int, seed: int, solver: str, time_limit: float = 0.5) -> Plan:
    """
    :param n_tasks: Number of tasks, of values 1 to 5, some with service, some that must be served
    :param n_uavs: Number of UAVs, which can serve about two thirds of them
    :param seed: Seed of tasks and solver
    :param solver: As of :func:`~sb3_uav.solvers.registry.make_solver`
    :param time_limit: Seconds
    :return: A plan
    """
    rng = np.random.default_rng(seed)
    tasks = TaskList.of(
        [f"t{number}" for number in range(1, n_tasks + 1)],
        some_places(n_tasks, rng),
        "wgs84",
        rng.integers(1, 6, n_tasks),
        rng.choice([0.0, 10.0, 30.0], n_tasks),
        rng.uniform(size=n_tasks) < 0.03,
        depot=DEPOT,
    )
    # Tours through n points of an area take about 0.7 sqrt(n area).
    whole = 0.7 * np.sqrt(n_tasks * 1e8) + 10.0 * _SPEED * n_tasks
    reach = 0.6 * whole / n_uavs + 4_000.0
    uavs = tuple(Uav(f"uav-{n}", reach, _SPEED, reserve_percent=10.0) for n in range(1, n_uavs + 1))
    return solve(tasks, Fleet(uavs), solver, time_limit, seed)


def flown(plan: Plan, route: Route, part: float) -> tuple[tuple[float, float], float, int]:
    """
    :param plan: A plan
    :param route: One of its routes
    :param part: Which part of it has been flown
    :return: Where the UAV is, how many meters of its range it has used, and how many stops lie behind it
    """
    speed = route.uav.speed_mps or 0.0
    coordinates = plan.tasks.coordinates()
    points = coordinates.to_plane(route.points)
    budget, used = part * route.used_m, 0.0
    for behind, leg in enumerate(route.legs_m):
        if used + leg >= budget or behind == len(route.stops):
            share = (budget - used) / leg if leg > 0 else 0.0
            place = coordinates.from_plane((points[behind] + share * (points[behind + 1] - points[behind]))[None])[0]
            return (float(place[0]), float(place[1])), budget, behind
        used += leg + plan.tasks.service_s[route.stops[behind]] * speed
        if used >= budget:
            return (float(route.points[behind + 1][0]), float(route.points[behind + 1][1])), used, behind + 1
    raise AssertionError("the last leg ends the loop")


def half_flown(plan: Plan, seed: int, n_new: int = 10) -> Status:
    """
    :param plan: A plan of :func:`some_plan`
    :param seed: Seed
    :param n_new: Number of new tasks
    :return: All UAVs somewhere in the middle of their routes, one of them lost, and new tasks
    """
    rng = np.random.default_rng((seed, 1))
    lost = int(rng.integers(len(plan.fleet)))
    reports, done = [], []
    for number, route in enumerate(plan.routes):
        position, used, behind = flown(plan, route, float(rng.uniform(0.3, 0.7)))
        done += [plan.tasks.ids[task] for task in route.stops[:behind]]
        if number != lost:
            # Wind has taken a little of the rest.
            left = (route.uav.range_m - used) * float(rng.uniform(0.97, 1.0))
            reports.append(UavReport(route.uav.id, position, left))
    new = tuple(
        NewTask(f"new-{number}", (float(point[0]), float(point[1])), float(rng.integers(1, 6)), must=number == 1)
        for number, point in enumerate(some_places(n_new, rng), 1)
    )
    return Status(tuple(reports), tuple(done), (plan.fleet.uavs[lost].id,), new)


def _report(source: str, seeds: Sequence[int], n_tasks: int, n_uavs: int, time_limit: float, min_gain: float) -> str:
    """:return: A row of the table"""
    seconds, kept, values, anew, methods, must = [], [], [], [], [], 0
    for seed in seeds:
        plan = some_plan(n_tasks, n_uavs, seed, source)
        status = half_flown(plan, seed)
        start = time.perf_counter()
        found = replan(plan, status, time_limit, seed, min_gain)
        seconds.append(time.perf_counter() - start)
        scratch = solve(found.plan.tasks, found.plan.fleet, source, 0.5, seed)
        must += len(found.plan.unserved) - len(scratch.unserved)
        kept.append(found.kept_share)
        values.append(found.plan.objective)
        anew.append(scratch.objective)
        methods.append(found.method)
    share, ratio = Interval.of_mean(np.array(kept)), Interval.of_ratio(np.array(values), np.array(anew))
    how = ", ".join(f"{methods.count(name)} {name}" for name in dict.fromkeys(methods))
    return (
        f"| {source} | {time_limit:g} | {statistics.median(seconds):.3f} | {max(seconds):.3f} "
        f"| {share.mean:.2f} [{share.low:.2f}, {share.high:.2f}] | {ratio.mean:.4f} [{ratio.low:.4f}, {ratio.high:.4f}] "
        f"| {must:+d} | {how} |"
    )


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: Arguments; those of the process when None
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-tasks", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--n-uavs", type=int, default=5, help="default: %(default)s")
    parser.add_argument("--seeds", type=int, default=8, help="number of missions (default: %(default)s)")
    parser.add_argument(
        "--sources",
        nargs="+",
        default=["local-search", "dl-drl:allocator=world,decode=greedy,repair=1"],
        help="solvers of the old plans and of plans anew (default: %(default)s)",
    )
    parser.add_argument("--time-limits", type=float, nargs="+", default=[0.0, 0.5], help="of replan (default: %(default)s)")
    parser.add_argument("--min-gain", type=float, default=0.0, help="of replan, in percent (default: %(default)g)")
    args = parser.parse_args(argv)
    th.set_num_threads(1)
    warm_up()
    print("| plans by | limit, s | median s | max s | kept share | value / anew | must not served, less anew | by |")
    print("|---|---|---|---|---|---|---|---|")
    for source in args.sources:
        for time_limit in args.time_limits:
            print(_report(source, range(args.seeds), args.n_tasks, args.n_uavs, time_limit, args.min_gain), flush=True)


if __name__ == "__main__":
    main()
