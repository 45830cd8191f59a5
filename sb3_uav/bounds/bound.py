"""Upper bounds of the total value that any schedule of an instance can have."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sb3_uav.bounds.column_generation import ColumnGeneration
from sb3_uav.bounds.places import Places, value_unit
from sb3_uav.common.random_streams import WARM_UP_SEED, keyed_generator
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.local_search import LocalSearch

OPTIMAL, BOUND, TIME_LIMIT = "optimal", "bound", "time limit"
# Rounding errors of sums, relative; and what a bound may miss a whole number by.
_ROUNDING, _WHOLE_SLACK = 1e-9, 1e-6
# The first routes: searches of so many seeds, each for this part of the time limit, and no longer than so many seconds.
_N_SEARCHES, _SEARCH_SHARE, _MOST_SEARCH_SECONDS = 4, 0.02, 0.5


@dataclass(frozen=True)
class Bound:
    """
    :param value: No schedule has a larger total value
    :param seconds: How long that took
    :param status: ``"optimal"`` if a schedule of this value is known and no task must be served; ``"time limit"`` if more
        time might lower it; else ``"bound"``
    :param best: The largest total value of a schedule that is known
    """

    value: float
    seconds: float
    status: str
    best: float


def upper_bound(
    instances: Instances,
    time_limit: float,
    incumbents: Sequence[Schedule | None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Bound]:
    """
    Bound the total value of the schedules of every instance.

    :param instances: ``batch`` instances on the CPU, possibly padded
    :param time_limit: Seconds per instance
    :param incumbents: A feasible schedule of each, as far as known
    :param clock: What measures the time
    :return: Bounds
    :raises ValueError: If the time limit is not above 0, or a schedule is not feasible
    """
    if not 0 < time_limit < math.inf:
        raise ValueError(f"time_limit of a bound is {time_limit:g} seconds; it must be more than 0, and finite.")
    if incumbents is not None and len(incumbents) != len(instances):
        raise ValueError(f"There are {len(incumbents)} schedules for {len(instances)} instances; give one of each, or None.")
    given = incumbents or [None] * len(instances)
    return [_bound_one(instances[row], time_limit, given[row], clock) for row in range(len(instances))]


def warm_up() -> None:
    """
    Load the compiled code, or compile it where that has never been done: seconds that should not count against a time limit.
    """
    upper_bound(UniformGenerator(12, n_uavs=2, max_distance=1.0)(1, keyed_generator(WARM_UP_SEED)), 1.0)


def _bound_one(instance: Instances, time_limit: float, incumbent: Schedule | None, clock: Callable[[], float]) -> Bound:
    start = clock()
    end = start + time_limit
    best = 0.0 if incumbent is None else check_schedule(instance, 0, incumbent).objective
    places = Places.of(instance)
    reached = instance.values[0].numpy()[places.place_of >= 0]
    unit = value_unit(reached)
    trivial = math.fsum(reached)

    def rounded(bound: float) -> float:
        bound = min(bound * (1 + _ROUNDING), trivial)
        if unit > 0:
            bound = min(math.floor((bound + _WHOLE_SLACK * unit) / unit) * unit, trivial)
        return bound

    def is_met(bound: float) -> bool:
        return best >= bound * (1 - 2 * _ROUNDING)

    value, is_finished = trivial, is_met(trivial)
    if not is_finished:
        columns = ColumnGeneration(places, lambda: clock() >= end, lambda: end - clock())
        if incumbent is not None:
            columns.add(places.routes(incumbent))
        for schedule in _first_schedules(instance, incumbent, min(_SEARCH_SHARE * time_limit, _MOST_SEARCH_SECONDS)):
            best = max(best, check_schedule(instance, 0, schedule).objective)
            columns.add(places.routes(schedule))
            if is_met(value):
                break
        while not is_met(value) and not columns.is_finished and clock() < end:
            columns.step(best)
            value = min(value, rounded(columns.bound))
        is_finished = columns.is_finished
    # A schedule of the same total value may leave out what must be served.
    is_all = instance.must_serve is None or not bool(instance.must_serve.any())
    status = OPTIMAL if is_met(value) and is_all else BOUND if is_finished or is_met(value) else TIME_LIMIT
    if best > value * (1 + 2 * _ROUNDING):
        raise AssertionError(f"A schedule is worth {best:g}, above the bound of {value:g}; please report this error.")
    return Bound(max(value, best), clock() - start, status, best)


def _first_schedules(instance: Instances, incumbent: Schedule | None, seconds: float) -> Iterator[Schedule]:
    """
    :param instance: A batch of one
    :param incumbent: A schedule that is known
    :param seconds: How long each search may take
    :return: Schedules by local search
    """
    search = LocalSearch(instance)
    yield (first := search.repair(search.insertion(), seconds))
    for seed in range(_N_SEARCHES):
        yield search.improve(first if incumbent is None or seed % 2 else incumbent, seconds, seed)
