"""
The compiled part of bounds: the best route for given prices, by dynamic programming, without the GIL.

A *place* is a task, or several at one point; places are numbered from 0. All of it stands in one file because numba's cache on
disk notices changes of a function's own file only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_uav.common.optional import install_command

try:
    from numba import njit
except ImportError as error:
    raise ImportError(f"Bounds need numba; run: {install_command('solvers')}") from error

# What no route is worth.
NOTHING = -1e300
# By how much a multiple of the grid's step may be missed because of rounding errors.
_GRID_SLACK = 1e-9
# States of a search for labels.
RUNNING, FINISHED, FULL = range(3)

# The beginning of a route: its length, its profit, which neighbors of its last place it remembers (as bits), that place, the
# label that it continues (-1 for none), the next in the same bucket, the next that waits, and whether nothing dominates it.
LABEL = np.dtype(
    [
        ("length", np.float64),
        ("profit", np.float64),
        ("memory", np.int32),
        ("place", np.int32),
        ("before", np.int32),
        ("chained", np.int32),
        ("waiting", np.int32),
        ("alive", np.int32),
    ],
    align=True,
)


class Grid(NamedTuple):
    """
    One kind of UAVs on a grid of lengths, rounded down. Places less than a step apart are one *cluster*, whose profits are
    collected together: else a walk of length 0 could go on for ever.

    :param step: Length of a step
    :param cluster: ``(n,)`` int64, of each place
    :param only: ``(n_clusters,)`` int64, the place of a cluster that has one, else -1
    :param legs: ``(n_clusters, n_clusters)`` int64, the least steps between them
    :param order: ``(n_clusters, n_clusters - 1)`` int64, the other clusters, nearest first
    :param homeward: ``(n_clusters,)`` int64, steps to the end
    """

    step: float
    cluster: np.ndarray
    only: np.ndarray
    legs: np.ndarray
    order: np.ndarray
    homeward: np.ndarray


class Completion(NamedTuple):
    """
    What can still be collected at most after a cluster, with so many steps left.

    :param best: ``(n_steps + 1, n_clusters)``
    :param following: ``(n_steps + 1, n_clusters)`` int32, the cluster that comes next then; -1 for the end
    :param second: ``(n_steps + 1, n_clusters)``, the most with another next cluster
    :param profit: ``(n_clusters,)``, of all places of each cluster
    """

    best: np.ndarray
    following: np.ndarray
    second: np.ndarray
    profit: np.ndarray


class Fleet(NamedTuple):
    """
    :param distances: ``(n, n)``, between places
    :param outward: ``(n,)``, from the start
    :param homeward: ``(n,)``, to the end
    :param limit: ``(2,)``, how far such a UAV flies, and half of it: so far labels go, from both ends
    :param near: ``(n, n_near)`` int64, the places that each remembers; -1 where there are fewer
    :param position: ``(n, n)`` int8, where the second place stands in ``near`` of the first; -1 for nowhere
    """

    distances: np.ndarray
    outward: np.ndarray
    homeward: np.ndarray
    limit: np.ndarray
    near: np.ndarray
    position: np.ndarray


class Labels(NamedTuple):
    """
    :param labels: ``(n_labels,)`` of :data:`LABEL`
    :param heads: ``(n, n_buckets)`` int32, the first label at each place in each bucket of lengths; -1 for none
    :param tops: ``(n, n_buckets)``, the greatest profit among them
    :param waiting: ``(n_buckets,)`` int32, the first label that has not been continued
    :param state: ``(4,)`` int64: how many labels there are, how many have been continued, the bucket, the state
    """

    labels: np.ndarray
    heads: np.ndarray
    tops: np.ndarray
    waiting: np.ndarray
    state: np.ndarray


@njit(cache=True, nogil=True)
def complete(grid, profit, best, following, second):
    """
    Fill a :class:`Completion`: the best walks over clusters to the end that never return to a place by way of only one other.

    :param grid: The grid
    :param profit: ``(n_clusters,)``
    :param best: See :class:`Completion`; filled, as the next two
    """
    n_steps, n_clusters = best.shape[0] - 1, best.shape[1]
    for left in range(n_steps + 1):
        for a in range(n_clusters):
            if left < grid.homeward[a]:
                best[left, a] = NOTHING
                second[left, a] = NOTHING
                following[left, a] = -1
                continue
            first_value, second_value, first = 0.0, NOTHING, -1
            returns = grid.only[a] < 0
            for b in grid.order[a]:
                after = left - grid.legs[a, b]
                if after < 0:
                    break
                if profit[b] <= 0.0:
                    continue
                value = best[after, b]
                if following[after, b] == a and not returns:
                    value = second[after, b]
                value += profit[b]
                if value > first_value:
                    second_value = first_value
                    first_value = value
                    first = b
                elif value > second_value:
                    second_value = value
            best[left, a] = first_value
            second[left, a] = second_value
            following[left, a] = first


@njit(cache=True, nogil=True, inline="always")
def remaining(grid, fleet, completion, profit, place, length, memory):
    """:return: What can be collected at most after a place, without what is remembered there"""
    left = int((fleet.limit[0] - length) / grid.step + _GRID_SLACK)
    cluster = grid.cluster[place]
    most = completion.best[left, cluster]
    following = completion.following[left, cluster]
    if following >= 0:
        only = grid.only[following]
        if only >= 0:
            position = fleet.position[place, only]
            if position >= 0 and (memory >> position) & 1:
                most = completion.second[left, cluster]
    return most + completion.profit[cluster] - profit[place]


@njit(cache=True, nogil=True)
def _passed_on(fleet, place, following, memory):
    """:return: What the following place remembers of what a place remembers, and of that place"""
    passed = 0
    position = fleet.position[following, place]
    if position >= 0:
        passed |= 1 << position
    a = 0
    while memory:
        if memory & 1:
            position = fleet.position[following, fleet.near[place, a]]
            if position >= 0:
                passed |= 1 << position
        memory >>= 1
        a += 1
    return passed


@njit(cache=True, nogil=True)
def _insert(fleet, found, place, length, profit, memory, before, exact):
    """:return: Whether the label was new and not dominated"""
    labels, heads, tops = found.labels, found.heads, found.tops
    n_buckets = heads.shape[1]
    bucket = min(int(length / fleet.limit[1] * n_buckets), n_buckets - 1)
    for b in range(bucket + 1):
        if tops[place, b] < profit:
            continue
        k = heads[place, b]
        while k >= 0:
            other = labels[k]
            if other.profit >= profit and other.length <= length and (not exact or (other.memory & ~memory) == 0):
                return False
            k = other.chained
    for b in range(bucket, n_buckets):
        last = -1
        k = heads[place, b]
        while k >= 0:
            other = labels[k]
            chained = other.chained
            if other.profit <= profit and other.length >= length and (not exact or (memory & ~other.memory) == 0):
                labels[k].alive = 0
                if last < 0:
                    heads[place, b] = chained
                else:
                    labels[last].chained = chained
            else:
                last = k
            k = chained
    n = found.state[0]
    found.state[0] = n + 1
    labels[n].length = length
    labels[n].profit = profit
    labels[n].memory = memory
    labels[n].place = place
    labels[n].before = before
    labels[n].alive = 1
    labels[n].chained = heads[place, bucket]
    heads[place, bucket] = n
    tops[place, bucket] = max(tops[place, bucket], profit)
    labels[n].waiting = found.waiting[bucket]
    found.waiting[bucket] = n
    return True


@njit(cache=True, nogil=True)
def begin(grid, fleet, completion, profit, threshold, found, exact):
    """
    Write down the routes to each first place.

    :param threshold: Routes that are not worth more do not count
    :param found: Empty labels, filled
    :param exact: Whether what a route remembers counts when two are compared; if not, the best route may be missed
    """
    found.heads[:] = -1
    found.tops[:] = NOTHING
    found.waiting[:] = -1
    found.state[:] = 0
    for place in range(len(profit)):
        length = fleet.outward[place]
        if profit[place] <= 0.0 or length > fleet.limit[1] or length + fleet.homeward[place] > fleet.limit[0]:
            continue
        if profit[place] + remaining(grid, fleet, completion, profit, place, length, 0) > threshold:
            _insert(fleet, found, place, length, profit[place], 0, -1, exact)


@njit(cache=True, nogil=True)
def proceed(grid, fleet, completion, profit, threshold, found, exact, n_steps):
    """
    Continue labels, shortest first, until none is left that can be worth more than the threshold.

    :param n_steps: After how many labels to return
    :return: State of the search: RUNNING, FINISHED, or FULL
    """
    labels, n_buckets = found.labels, found.heads.shape[1]
    n_places = len(profit)
    for _ in range(n_steps):
        while found.state[2] < n_buckets and found.waiting[found.state[2]] < 0:
            found.state[2] += 1
        if found.state[2] == n_buckets:
            return FINISHED
        if found.state[0] + n_places > len(labels):
            return FULL
        k = found.waiting[found.state[2]]
        label = labels[k]
        found.waiting[found.state[2]] = label.waiting
        if label.alive == 0:
            continue
        found.state[1] += 1
        place, length_so_far, profit_so_far = label.place, label.length, label.profit
        memory_so_far = np.int64(label.memory)
        for b in range(n_places):
            if profit[b] <= 0.0 or b == place:
                continue
            length = length_so_far + fleet.distances[place, b]
            if length > fleet.limit[1] or length + fleet.homeward[b] > fleet.limit[0]:
                continue
            position = fleet.position[place, b]
            if position >= 0 and (memory_so_far >> position) & 1:
                continue
            total = profit_so_far + profit[b]
            if total + remaining(grid, fleet, completion, profit, b, length, 0) <= threshold:
                continue
            memory = _passed_on(fleet, place, b, memory_so_far)
            if total + remaining(grid, fleet, completion, profit, b, length, memory) <= threshold:
                continue
            _insert(fleet, found, b, length, total, memory, k, exact)
    return RUNNING


@njit(cache=True, nogil=True)
def join(fleet, labels, backward, first, best, front, back):
    """
    Join beginnings and ends of routes, where they cross half of the length.

    :param labels: ``(n_labels,)`` of :data:`LABEL`, beginnings that nothing dominates
    :param backward: ``(n_backward,)`` of :data:`LABEL`, ends, in the order of their places, those of a place by falling profit
    :param first: ``(n + 1,)`` int64, where those of each place begin
    :param best: ``(n,)``, what the best route is worth whose second half begins at each place, only above what it is before;
        updated, as the next two
    :param front: ``(n,)`` int64, its first half
    :param back: ``(n,)`` int64, its second half
    """
    n_places = len(best)
    for a in range(len(labels)):
        label = labels[a]
        place, profit, own_length = label.place, label.profit, label.length
        memory = np.int64(label.memory)
        for b in range(n_places):
            if first[b] == first[b + 1] or b == place or profit + backward[first[b]].profit <= best[b]:
                continue
            length = own_length + fleet.distances[place, b]
            if length <= fleet.limit[1] or length + fleet.homeward[b] > fleet.limit[0]:
                continue
            position = fleet.position[place, b]
            if position >= 0 and (memory >> position) & 1:
                continue
            passed = _passed_on(fleet, place, b, memory)
            for k in range(first[b], first[b + 1]):
                other = backward[k]
                if profit + other.profit <= best[b]:
                    break
                if length + other.length <= fleet.limit[0] and (passed & other.memory) == 0:
                    best[b] = profit + other.profit
                    front[b] = a
                    back[b] = k
                    break
