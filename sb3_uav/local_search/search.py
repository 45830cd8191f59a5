"""Improving schedules: local search until nothing changes, and ruin and recreate for a given time."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sb3_uav.common.random_streams import WARM_UP_SEED, keyed_generator, mixed_state
from sb3_uav.envs.distances import DISTANCE_TOLERANCE
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.reduction import USABLE_TOLERANCE
from sb3_uav.envs.schedule import Schedule, ScheduleReport, check_schedule
from sb3_uav.local_search import kernels
from sb3_uav.local_search.kernels import AnnealingSettings, Plan

# Length of the lists of nearest tasks.
_N_NEAR = 64
# Number of neighbors that local search joins a task to, and beside which it looks for an insertion.
_N_NEAR_JOINED, _N_NEAR_INSERTED = 10, 16
# Local search removes strings of at most this many tasks.
_MAX_STRING = 3
# Kernels use values rounded to this many binary digits of the greatest: sums of 100,000 tasks are exact, and differences are
# far above the threshold for rounding errors of lengths.
_VALUE_BITS = 36
# Values above so many medians are out of the ordinary: they count in full, but annealing takes its measure from the others.
_ORDINARY_MEDIANS = 8.0
# Bound of the rounding errors of a tour's length, in units of the largest coordinate. Only for UAVs that fly a tiny part of
# what another one flies it is more than what USABLE_TOLERANCE leaves.
_ROUNDING = 1e-14
# Ruin and recreate returns to Python about this often, in seconds, to look at the clock.
_CHUNK_SECONDS = 0.02
# The repair after it ends at the latest so many seconds after the given time.
_LAST_REPAIR_SECONDS = 1.0
# Trials per task where no time is given.
_TRIALS_PER_TASK = 100


class LocalSearch:
    """
    One instance, prepared for searches from any number of schedules; several threads may search at once.

    Tasks of value 0 and tasks that no UAV can reach are left out; a schedule loses them.

    :param instance: A batch of one, possibly padded
    :raises ValueError: If it is not one instance
    """

    def __init__(self, instance: Instances) -> None:
        if len(instance) != 1:
            raise ValueError(f"Local search treats one instance at a time, found {len(instance)}; select one by its index.")
        instance = instance.to("cpu")
        # What must be served is a matter of value.
        self.instance = instance = replace(instance, values=instance.prizes, must_serve=None)
        # Equal UAVs are looked at once.
        fleet = instance.with_fleet(1) if instance.has_equal_uavs else instance
        starts, ends, limits = (field[0].numpy() for field in (fleet.uav_start, fleet.uav_end, fleet.uav_distance))
        # Far from the origin, and for distances of any magnitude, numbers are of about 1.
        origin, unit = starts[0], float(instance.unit[0])
        points, starts, ends = ((field - origin) / unit for field in (instance.tasks[0].numpy(), starts, ends))
        limits, service, values = limits / unit, instance.service_cost[0].numpy() / unit, instance.values[0].numpy()
        outward, homeward = (np.hypot(*(points - ends_of[:, None]).transpose(2, 0, 1)) for ends_of in (starts, ends))
        within_reach = outward + homeward + service <= limits[:, None] * (1.0 + DISTANCE_TOLERANCE) ** 2
        self._tasks = np.flatnonzero(instance.task_mask[0].numpy() & (values > 0) & within_reach.any(0))
        n_tasks = len(self._tasks)
        terminals, numbers = np.unique(np.concatenate([starts, ends]), axis=0, return_inverse=True)
        # Node 0 is where the first UAV starts, other terminals follow the tasks.
        first = numbers.flat[0]
        node_of_terminal = n_tasks + np.arange(len(terminals)) + (np.arange(len(terminals)) < first)
        node_of_terminal[first] = 0
        self._starts, self._ends = node_of_terminal[numbers.reshape(2, -1)]
        self._nodes = np.zeros(n_tasks + len(terminals), kernels.NODE)
        for nodes, places in ((node_of_terminal, terminals), (slice(1, n_tasks + 1), points[self._tasks])):
            self._nodes["x"][nodes], self._nodes["y"][nodes] = places.T
        self._nodes["service"][1 : n_tasks + 1] = service[self._tasks]
        self._nodes["owner"] = -1
        self._nodes["queued"][node_of_terminal] = True
        # In whole multiples of a power of two, so that kernels add them up without rounding errors: else a search that takes
        # such an error for a gain never ends. At most 1, so that sums neither vanish nor overflow.
        values = values[self._tasks]
        scaled = np.ldexp(values, _VALUE_BITS - np.frexp(values.max(initial=0.0))[1])
        rounded = np.ldexp(np.maximum(np.ceil(scaled), 1.0), -_VALUE_BITS)
        self._nodes["value"][1 : n_tasks + 1] = rounded
        self._ordinary = _ORDINARY_MEDIANS * float(np.median(rounded)) if n_tasks > 0 else np.inf
        self._node_of_task = np.zeros(instance.n_tasks, np.int64)
        self._node_of_task[self._tasks] = np.arange(1, n_tasks + 1)
        largest = max(abs(self._nodes["x"]).max(), abs(self._nodes["y"]).max(), 1.0)
        self._limits = np.minimum(limits * (1.0 + USABLE_TOLERANCE), limits * (1.0 + DISTANCE_TOLERANCE) - _ROUNDING * largest)
        self._near = np.zeros((len(self._nodes), max(min(_N_NEAR, n_tasks - 1), 0)), np.int32)
        kernels.find_near(self._nodes, n_tasks, self._near)

    def _load(self, schedule: Schedule, seed: int = 0) -> Plan:
        """
        :param schedule: A feasible schedule
        :param seed: Seed for random numbers
        :return: The data of the kernels
        """
        n_tasks = len(self._tasks)
        # Useless UAVs cost memory.
        n_uavs = max(self.instance.useful_fleet, len(schedule.routes))
        state = np.zeros(1, kernels.STATE)
        state["n_tasks"], state["equal"], state["ordinary"] = n_tasks, self.instance.has_equal_uavs, self._ordinary
        # The state of the generator must not be 0.
        state["random"] = mixed_state(seed) | np.uint64(1)
        routes = np.zeros((2 * n_uavs, n_tasks + 2), np.int64)
        tours = np.zeros(n_uavs, kernels.TOUR)
        tours["limit"] = self._limits
        for uav, route in enumerate(schedule.routes):
            stops = self._node_of_task[list(route)]
            stops = stops[stops > 0]
            routes[uav, 1 : len(stops) + 1] = stops
            tours["size"][uav] = len(stops)
        routes[:n_uavs, 0] = self._starts
        routes[np.arange(n_uavs), tours["size"] + 1] = self._ends
        lists = np.zeros((4, n_tasks + n_uavs + 1), np.int64)
        plan = Plan(self._nodes.copy(), self._near, routes, tours, lists, state)
        kernels.measure_all(plan)
        return plan

    def _unload(self, plan: Plan) -> Schedule:
        return Schedule(self._tasks[plan.routes[uav, 1 : size + 1] - 1] for uav, size in enumerate(plan.tours["size"]))

    def report(self, schedule: Schedule) -> ScheduleReport:
        """
        :param schedule: A schedule of the instance
        :return: What it achieves
        :raises InfeasibleScheduleError: If it breaks a constraint
        """
        return check_schedule(self.instance, 0, schedule)

    def better(self, found: Schedule, given: Schedule) -> Schedule:
        """
        Compare two schedules without the rounding errors of the kernels' sums.

        :param found: A feasible schedule
        :param given: Another one
        :return: ``found``, unless ``given`` has a larger value, or the same value and shorter tours
        """
        new, old = self.report(found), self.report(given)
        return found if (new.objective, -new.length) >= (old.objective, -old.length) else given

    def insertion(self, schedule: Schedule | None = None) -> Schedule:
        """
        Cheapest insertion: always the task that is worth most per added length. What is in a tour stays there, in its order.

        :param schedule: The tours to begin with, feasible; empty ones when None
        :return: A feasible schedule
        """
        plan = self._load(Schedule([]) if schedule is None else schedule)
        kernels.fill_everywhere(plan)
        return self._unload(plan)

    def repair(self, schedule: Schedule, seconds: float | None = None, max_string: int = _MAX_STRING) -> Schedule:
        """See :func:`repair`."""
        end = time.perf_counter() + (np.inf if seconds is None else seconds)
        self.report(schedule)
        plan = self._load(schedule)
        while time.perf_counter() < end and kernels.descend(plan, _N_NEAR_JOINED, _N_NEAR_INSERTED, max_string):
            pass
        return self.better(self._unload(plan), schedule)

    def improve(
        self,
        schedule: Schedule,
        seconds: float | None = None,
        seed: int = 0,
        settings: AnnealingSettings | None = None,
        n_trials: int | None = None,
    ) -> Schedule:
        """See :func:`improve`; ``n_trials`` is the number of trials where no time is given."""
        start = time.perf_counter()
        self.report(schedule)
        settings = settings or AnnealingSettings()
        plan = self._load(schedule, seed)
        best = self._load(schedule)
        # Annealing does not find a dear task that costs a whole tour; it has to begin with it.
        for each in (plan, best):
            kernels.admit(each, _N_NEAR_INSERTED)
        if len(self._tasks) > 0:
            if seconds is None:
                n_trials = _TRIALS_PER_TASK * len(self._tasks) if n_trials is None else n_trials
                kernels.anneal(plan, best, n_trials, 0.0, 1.0, settings)
            else:
                self._anneal(plan, best, start, seconds, settings)
        kernels.measure_all(best)
        end = start + (np.inf if seconds is None else seconds + _LAST_REPAIR_SECONDS)
        while time.perf_counter() < end and kernels.descend(best, _N_NEAR_JOINED, _N_NEAR_INSERTED, _MAX_STRING):
            pass
        return self.better(self._unload(best), schedule)

    @staticmethod
    def _anneal(plan: Plan, best: Plan, start: float, seconds: float, settings: AnnealingSettings) -> None:
        """
        Anneal until the time is up.

        :param plan: Where to begin
        :param best: The best schedule so far, updated
        :param start: Start, in seconds of ``time.perf_counter``
        :param seconds: Length in seconds
        :param settings: Settings of ruin and recreate
        """
        n_trials = 10
        now = time.perf_counter()
        while now < start + seconds:
            progress = (now - start) / seconds
            chunk = min(_CHUNK_SECONDS, start + seconds - now)
            kernels.anneal(plan, best, n_trials, progress, min(progress + chunk / seconds, 1.0), settings)
            then, now = now, time.perf_counter()
            n_trials = max(1, int(n_trials * min(_CHUNK_SECONDS / max(now - then, 1e-9), 4.0)))


def warm_up() -> None:
    """
    Load the compiled code, or compile it where that has never been done: seconds that should not count against a time limit.
    """
    instance = UniformGenerator(8, n_uavs=2)(1, keyed_generator(WARM_UP_SEED))
    search = LocalSearch(instance)
    search.repair(search.improve(search.insertion()))


def repair(instance: Instances, schedule: Schedule, seconds: float | None = None, max_string: int = _MAX_STRING) -> Schedule:
    """
    Local search until nothing changes.

    Makes tours shorter (2-opt and or-opt within a tour, relocation, exchange and 2-opt* between two), inserts unvisited tasks
    wherever they fit, swaps visited tasks for unvisited ones that are worth more or cost less, takes short strings of tasks
    out to fill the gap better, and empties a tour, or a part of it, for a task that is worth more: of all tasks in reach the
    one that is worth more than the others together is never missed. Deterministic, and a second repair changes nothing.
    Differences between values below 1e-10 of the greatest do not count, but the result is never worse for them. With tasks
    that must be served, values are :attr:`~sb3_uav.envs.instances.Instances.prizes`.

    :param instance: A batch of one, possibly padded
    :param schedule: A feasible schedule of it
    :param seconds: When to stop, at the end of a round, even if there is more to be found; None for never
    :param max_string: How many tasks in a row are taken out at most; 0 for none, which is faster and less good
    :return: A feasible schedule that is not worse: of the same value it is not longer
    :raises InfeasibleScheduleError: If the schedule breaks a constraint
    :raises ValueError: If there is not exactly one instance
    """
    return LocalSearch(instance).repair(schedule, seconds, max_string)


def repaired_insertion(instance: Instances, seconds: float | None = None) -> Schedule:
    """
    Cheapest insertion, then local search until nothing changes: a good schedule in a few milliseconds, whatever the instance.

    :param instance: A batch of one, possibly padded
    :param seconds: When to stop, but not before the insertion has ended; None for never
    :return: A feasible schedule
    :raises ValueError: If there is not exactly one instance
    """
    start = time.perf_counter()
    search = LocalSearch(instance)
    inserted = search.insertion()
    return search.repair(inserted, None if seconds is None else start + seconds - time.perf_counter())


def repair_best(instance: Instances, schedules: Iterable[Schedule], seconds: float | None = None) -> Schedule:
    """
    Repair several schedules of an instance, the best first, and keep the best.

    The compiled part does not hold the GIL, so that threads can treat several instances at once.

    :param instance: A batch of one, possibly padded
    :param schedules: Feasible schedules of it, at least one
    :param seconds: When to stop, even if some have not been repaired; None for never
    :return: The best
    :raises InfeasibleScheduleError: If a schedule breaks a constraint
    :raises ValueError: If there is not exactly one instance, or no schedule
    """
    end = time.perf_counter() + (np.inf if seconds is None else seconds)
    search = LocalSearch(instance)
    reports = [(search.report(schedule), schedule) for schedule in dict.fromkeys(schedules)]
    if not reports:
        raise ValueError("There is no schedule to repair; give at least one.")
    reports.sort(key=lambda pair: (-pair[0].objective, pair[0].length))
    best = reports[0][1]
    for _, schedule in reports:
        left = end - time.perf_counter()
        if left <= 0:
            break
        best = search.better(search.repair(schedule, left), best)
    return best


def improve(instance: Instances, schedule: Schedule, seconds: float | None = None, seed: int = 0) -> Schedule:
    """
    Ruin and recreate for a given time.

    Strings of neighboring tasks are taken out of one to three tours and the gaps filled again, with worse schedules accepted
    as in simulated annealing; then the best is repaired. Value comes first, then length.

    :param instance: A batch of one, possibly padded
    :param schedule: A feasible schedule of it; an empty one will do
    :param seconds: Wall time, exceeded only by the last repair, whose last round starts within a second; if None, trials in
        proportion to the number of tasks
    :param seed: Seed for random numbers; without ``seconds`` the same seed gives the same schedule
    :return: A feasible schedule that is not worse: of the same value it is not longer
    :raises InfeasibleScheduleError: If the schedule breaks a constraint
    :raises ValueError: If there is not exactly one instance
    """
    return LocalSearch(instance).improve(schedule, seconds, seed)
