"""Planning again while UAVs are in the air: what need not change stays as it is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from sb3_uav.common.optional import require
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.missions.old_routes import OldRoutes
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.problem import make_instance
from sb3_uav.missions.remarks import remarks_on
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.situation import Situation, situation_of
from sb3_uav.missions.status import Status

DEFAULT_SECONDS = 0.5
# Nobody plans anything with less, in meters.
_LEAST_RANGE = 1e-3
# How a plan came about, from the least disruptive: the rest of the routes, or with tasks put between their stops, or
# improved by local search, or annealed.
Method = Literal["kept", "insertion", "repair", "search"]
# UAV, from which stop to which: None stands for the first and for the last point of a route.
_Legs = set[tuple[str, str | None, str | None]]


@dataclass(frozen=True, eq=False)
class Replanned:
    """
    :param plan: The new plan; the old one itself if nothing is new
    :param n_kept: Legs of the old plan that the new one has too
    :param n_remaining: Legs of the old plan that were left to fly: those of UAVs that still fly, from where they are over
        their stops that are left to their end. Legs from or to a stop that is done or dropped do not count
    :param method: How the plan came about
    :param unchanged: Names of UAVs that fly what was left of their routes, and nothing else
    :param added: Names of new tasks
    :param gone: Names of tasks that are done or dropped
    :param freed: Names of tasks that were planned for a UAV that is lost
    :param removed: Names of tasks that were planned, are left, and are in no route any more
    :param lost: Names of UAVs that are lost
    :param remarks: What had to be assumed, and what a person should know about the change
    """

    plan: Plan
    n_kept: int
    n_remaining: int
    method: Method
    unchanged: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    freed: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def kept_share(self) -> float:
        """Part of the legs that were left to fly that are kept; 1 if there were none."""
        return self.n_kept / self.n_remaining if self.n_remaining else 1.0


def replan(plan: Plan, status: Status, time_limit: float = DEFAULT_SECONDS, seed: int = 0, min_gain: float = 0.0) -> Replanned:
    """
    Plan again after what has happened.

    Done, dropped and lost things leave. UAVs that report are where they are, with the range that they have; the reserve stays
    the same in meters. The rest of every route keeps its order; where the range no longer admits it, the stops that are worth
    least for the range that they take are left out, those that must be served last. Then the tasks that nobody serves are put
    between the stops. Routes are changed further only if this serves more tasks that must be served, or a larger value.

    The first call in a process loads compiled code, which takes seconds; see
    :func:`~sb3_uav.local_search.search.warm_up`.

    :param plan: A plan
    :param status: What has happened since
    :param time_limit: Seconds of search for a plan that is worth more; 0 for local search until nothing changes, without
        annealing
    :param seed: Seed of the search
    :param min_gain: What further changes must add to the value, in percent; tasks that must be served always count
    :return: The new plan, accepted by the checker, and what has changed
    :raises ValueError: If the status does not fit the plan, where the message names the row, nothing is left to plan, or an
        option is negative or not finite
    :raises ImportError: If numba is not installed
    """
    for name, number in (("time_limit", time_limit), ("min_gain", min_gain)):
        if not 0 <= number < math.inf:
            raise ValueError(f"{name} is {number:g}; give a finite number, 0 or more.")
    require("numba", "Replanning", "missions")
    start = time.perf_counter()
    now = situation_of(plan, status)
    legs = _legs_to_fly(plan, now)
    if not now.is_news:
        everybody = tuple(uav.id for uav in plan.fleet)
        return Replanned(plan, len(legs), len(legs), "kept", everybody, remarks=now.remarks)
    if max(uav.usable_m for uav in now.fleet) < _LEAST_RANGE:
        raise ValueError(f"{status.source}: no UAV has any range left beyond its reserve, so there is nothing to plan.")
    instance = make_instance(now.tasks, now.fleet)
    chosen = _least_disruptive(instance, OldRoutes(instance, now.routes), time_limit, seed, min_gain)
    seconds = time.perf_counter() - start
    new = make_plan(now.tasks, now.fleet, chosen.schedule, f"replan:{chosen.method}", seed, seconds, instance)
    n_kept = len(legs & _legs_of(new))
    notes = (*now.remarks, *_of_legs(n_kept, len(legs)), *_of_gain(chosen, new))
    new = replace(
        new,
        past_tasks=tuple(dict.fromkeys((*plan.past_tasks, *now.gone, *_never_planned(now, status)))),
        past_uavs=(*plan.past_uavs, *now.lost),
        time_limit=time_limit,
        notes=notes,
    )
    new = replace(new, remarks=remarks_on(new))
    served = {now.tasks.ids[task] for route in new.routes for task in route.stops}
    planned = {route.uav.id: [plan.tasks.ids[task] for task in route.stops] for route in plan.routes}
    left = set(now.tasks.ids)
    return Replanned(
        new,
        n_kept,
        len(legs),
        chosen.method,
        tuple(route.uav.id for route, old in zip(new.routes, now.routes, strict=True) if route.stops == old),
        now.added,
        now.gone,
        tuple(name for uav in now.lost for name in planned[uav] if name in left),
        tuple(name for stops in planned.values() for name in stops if name in left and name not in served),
        now.lost,
        notes,
    )


def _of_legs(n_kept: int, n_remaining: int) -> list[str]:
    """:return: A note on how much is kept"""
    if n_remaining == 0:
        return []
    return [f"{n_kept} of the {n_remaining} legs that were left to fly are kept ({n_kept / n_remaining:.0%})."]


def _of_gain(chosen: _Choice, plan: Plan) -> list[str]:
    """:return: A note on what has been gained by changing routes further, or could have been"""
    if chosen.method not in ("repair", "search"):
        if chosen.forgone_value <= plan.objective:
            return []
        return [
            f"Changing routes further would serve a value of {chosen.forgone_value:g} in place of {plan.objective:g}; "
            f"--min-gain 0 does so."
        ]
    gained = [f"a value of {plan.objective:g} in place of {chosen.calm_value:g}"]
    if len(plan.unserved) < chosen.calm_unserved:
        more = chosen.calm_unserved - len(plan.unserved)
        gained.insert(0, f"{more} more {'task' if more == 1 else 'tasks'} that must be served")
    return [
        f"Routes are changed further than tasks between stops that stay would do, for {' and '.join(gained)}; --min-gain asks "
        f"for more."
    ]


def _never_planned(now: Situation, status: Status) -> list[str]:
    """:return: Names of tasks that were new, and done or dropped at once"""
    gone = {*status.done, *status.dropped}
    return [task.id for task in status.tasks if task.id in gone and task.id not in now.gone]


def _legs_to_fly(plan: Plan, now: Situation) -> _Legs:
    """:return: The legs of the plan that are left to fly, see :class:`Replanned`"""
    left, uavs = set(now.tasks.ids), {uav.id: uav for uav in now.fleet}
    legs: _Legs = set()
    for route in plan.routes:
        uav = uavs.get(route.uav.id)
        if uav is None:
            continue
        planned = [plan.tasks.ids[task] for task in route.stops]
        ahead = [name for name in planned if name in left]
        if ahead:
            legs.add((uav.id, None, ahead[0]))
            legs |= {(uav.id, a, b) for a, b in pairwise(planned) if a in left and b in left}
            legs |= {(uav.id, planned[-1], None)} if planned[-1] in left else set()
        elif route.length_m > 0 and tuple(route.points[-1]) != (uav.start or tuple(route.points[0])):
            legs.add((uav.id, None, None))
    return legs


def _legs_of(plan: Plan) -> _Legs:
    """:return: All legs that are flown"""
    legs: _Legs = set()
    for route in plan.routes:
        if route.flies:
            legs |= {(route.uav.id, a, b) for a, b in pairwise([None, *(plan.tasks.ids[task] for task in route.stops), None])}
    return legs


class _Choice(NamedTuple):
    """
    :param schedule: A schedule
    :param method: How it came about
    :param calm_unserved: How many tasks that must be served are not, in the schedule that changes least
    :param calm_value: Value of that schedule
    """

    schedule: Schedule
    method: Method
    calm_unserved: int
    calm_value: float
    forgone_value: float


def _least_disruptive(instance: Instances, old: OldRoutes, time_limit: float, seed: int, min_gain: float) -> _Choice:
    """
    :param instance: A batch of one
    :param old: What is left of the routes
    :param time_limit: As of :func:`replan`
    :param seed: As of :func:`replan`
    :param min_gain: As of :func:`replan`
    :return: Of several schedules the one that changes least, unless another one serves more
    """
    from sb3_uav.local_search.search import LocalSearch

    def rank(schedule: Schedule) -> tuple[int, float]:
        report = check_schedule(instance, 0, schedule)
        return -len(report.unserved), report.objective

    start = time.perf_counter()
    search, residual = LocalSearch(instance), old.fitting()
    inserted = search.insertion(residual)
    calm: tuple[Schedule, Method] = (inserted, "insertion") if rank(inserted) > rank(residual) else (residual, "kept")
    best, unserved, value = calm, *rank(calm[0])
    forgone = value
    further: list[tuple[Method, Callable[[Schedule, float], Schedule]]] = [
        ("repair", lambda given, left: search.repair(given, left if time_limit > 0 else None)),
        ("search", lambda given, left: search.improve(given, left, seed)),
    ]
    found, n_useful = inserted, np.count_nonzero(instance.prizes[0].numpy() > 0)
    for method, change in further:
        left = time_limit - (time.perf_counter() - start)
        if best[0].n_visited >= n_useful or (left <= 0 and method == "search"):
            break
        found = change(found, left)
        new_unserved, new_value = rank(found)
        if new_unserved > unserved or (new_unserved == unserved and new_value > value * (1.0 + min_gain / 100.0)):
            best, unserved, value = (found, method), new_unserved, new_value
        elif new_unserved == unserved:
            forgone = max(forgone, new_value)
    least, calm_value = rank(calm[0])
    schedule, method = best
    return _Choice(old.in_old_order(schedule), method, -least, calm_value, forgone)
