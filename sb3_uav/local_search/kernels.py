"""
The compiled part of local search: plain loops over arrays, without the GIL.

All of it stands in one file because numba's cache on disk notices changes of a function's own file only. The first call
after an installation compiles, which takes a while; later processes load the result from ``__pycache__``.

Node 0 is the depot, nodes 1 to ``n_tasks`` are the tasks. Then follow the other *terminals*, points where a UAV starts or has
to arrive; every route holds its own terminals, so that no code depends on which they are. Lengths of tours hold the service
costs of their tasks. A *place* in a tour is the position that a new task would take there.
Sums of legs are added up again from scratch whenever a tour has been changed for good, so rounding errors never pile up.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sb3_uav.common.optional import install_command

try:
    from numba import njit
except ImportError as error:
    raise ImportError(f"Local search needs numba; run: {install_command('solvers')}") from error

# Changes of a tour's length below this are rounding errors; tours are at most 1 long.
EPSILON = 1e-12
# Values of schedules that differ by less count as equal while annealing: less than any two sums of task values differ by.
SAME_VALUE = 0.5**37
# What no insertion costs.
NOWHERE = 1e300
# The longest chain of tasks that moves as one.
MAX_SEGMENT = 3
# A task is dear to a tour if it is worth more than so many average tasks of it: less is won by taking short strings out.
DEAR = 3
# Probability that no task may be inserted into one of the tours, where UAVs differ.
CLOSED = 0.2


# What is known of a node: where it is, what it is worth, and what serving it costs; by whom it is visited, -1 if by none, and
# as which stop; whether it waits in the queue (set for terminals, which never get there); and, as a candidate for insertion,
# the trial that saw it last, the factor on its worth (below 0 to leave it out), which length of legs its cheapest insertion
# adds to which tour, and after which node.
NODE = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("value", np.float64),
        ("service", np.float64),
        ("owner", np.int32),
        ("position", np.int32),
        ("seen", np.int64),
        ("cost", np.float64),
        ("tour", np.int32),
        ("after", np.int32),
        ("noise", np.float32),
        ("queued", np.int32),
    ],
    align=True,
)
# The longest that a tour may be; its number of tasks and its length, now and when the current trial changed it first.
TOUR = np.dtype(
    [
        ("limit", np.float64),
        ("size", np.int64),
        ("length", np.float64),
        ("old_size", np.int64),
        ("old_length", np.float64),
        ("touched", np.int64),
    ],
    align=True,
)
# The number of tasks, whether all tours have the same terminals and limits, the largest value that is not out of the
# ordinary, the number of trials so far, and the state of the random numbers.
STATE = np.dtype(
    [("n_tasks", np.int64), ("equal", np.int64), ("ordinary", np.float64), ("clock", np.int64), ("random", np.uint64)],
    align=True,
)
# Rows of Plan.lists.
QUEUE, REMOVED, CANDIDATES, TOUCHED = range(4)


class AnnealingSettings(NamedTuple):
    """
    How ruin and recreate works.

    :param mean_removed: How many tasks a trial takes out, on average
    :param longest_string: How many tasks at most it takes out of one tour
    :param n_near: Beside how many neighbors a task may be inserted
    :param blink: Probability that a trial overlooks a task
    :param noise: By how much the worth of an insertion may be misjudged, as a fraction of it
    :param thrift: What a shorter tour is worth: that part of the value now collected on the same length
    :param hot: Temperature at the start, in mean task values
    :param cold: Temperature at the end
    """

    mean_removed: float = 10.0
    longest_string: float = 10.0
    n_near: int = 16
    blink: float = 0.01
    noise: float = 0.2
    thrift: float = 0.3
    hot: float = 2.0
    cold: float = 0.02


class Plan(NamedTuple):
    """
    A schedule that is being changed, its instance, and the memory that takes.

    Records, because every array that is passed to a function costs time.

    :param nodes: ``(n_nodes,)`` of :data:`NODE`: the depot, the tasks, other terminals
    :param near: ``(n_nodes, n_near)`` int32, for every node the nearest tasks, nearest first
    :param routes: ``(2 * n_uavs, n_tasks + 2)`` int64: of every UAV its start, its tasks in flying order, its end; copies
    :param tours: ``(n_uavs,)`` of :data:`TOUR`
    :param lists: ``(4, n_tasks + n_uavs + 1)`` int64, lists of nodes or tours
    :param state: ``(1,)`` of :data:`STATE`
    """

    nodes: np.ndarray
    near: np.ndarray
    routes: np.ndarray
    tours: np.ndarray
    lists: np.ndarray
    state: np.ndarray


# ------------------------------------------------------------------------------------------------------------- plain pieces


@njit(cache=True, nogil=True, forceinline=True)
def distance(plan, a, b):
    dx = plan.nodes[a].x - plan.nodes[b].x
    dy = plan.nodes[a].y - plan.nodes[b].y
    return math.sqrt(dx * dx + dy * dy)


@njit(cache=True, nogil=True, forceinline=True)
def uniform(plan):
    """xorshift64*: the next random number in [0, 1)."""
    state = plan.state[0].random
    state ^= state >> np.uint64(12)
    state ^= state << np.uint64(25)
    state ^= state >> np.uint64(27)
    plan.state[0].random = state
    return ((state * np.uint64(2685821657736338717)) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def measure(plan, v):
    """Add up the legs of tour ``v`` and renumber its tasks."""
    route = plan.routes[v]
    length = 0.0
    for p in range(1, plan.tours[v].size + 1):
        plan.nodes[route[p]].owner = v
        plan.nodes[route[p]].position = p
        length += distance(plan, route[p - 1], route[p]) + plan.nodes[route[p]].service
    size = plan.tours[v].size
    plan.tours[v].length = length + distance(plan, route[size], route[size + 1])


@njit(cache=True, nogil=True)
def measure_all(plan):
    """Compute from the routes which UAV visits each task, and how long the tours are."""
    for task in range(1, plan.state[0].n_tasks + 1):
        plan.nodes[task].owner = -1
    for v in range(len(plan.tours)):
        measure(plan, v)


@njit(cache=True, nogil=True)
def total_value(plan):
    total = 0.0
    for task in range(1, plan.state[0].n_tasks + 1):
        if plan.nodes[task].owner >= 0:
            total += plan.nodes[task].value
    return total


@njit(cache=True, nogil=True)
def count_visited(plan):
    total = 0
    for v in range(len(plan.tours)):
        total += plan.tours[v].size
    return total


@njit(cache=True, nogil=True)
def total_length(plan):
    """The length of all tours, without UAVs that cannot fly: they stay where they are, however far away their end is."""
    total = 0.0
    for v in range(len(plan.tours)):
        if plan.tours[v].size > 0 or plan.tours[v].length <= plan.tours[v].limit:
            total += plan.tours[v].length
    return total


@njit(cache=True, nogil=True, forceinline=True)
def insert(plan, v, place, task, added):
    """Put ``task`` at ``place`` of tour ``v``, which grows by ``added``."""
    route = plan.routes[v]
    for p in range(plan.tours[v].size + 1, place - 1, -1):
        route[p + 1] = route[p]
        plan.nodes[route[p]].position = p + 1
    route[place] = task
    plan.nodes[task].owner = v
    plan.nodes[task].position = place
    plan.tours[v].size += 1
    plan.tours[v].length += added


@njit(cache=True, nogil=True, forceinline=True)
def cut(plan, v, first, count):
    """Take ``count`` tasks, from position ``first`` on, out of tour ``v``; its length is left as it was."""
    route = plan.routes[v]
    for p in range(first, first + count):
        plan.nodes[route[p]].owner = -1
    for p in range(first + count, plan.tours[v].size + 2):
        route[p - count] = route[p]
        plan.nodes[route[p]].position = p - count
    plan.tours[v].size -= count


@njit(cache=True, nogil=True)
def reverse(plan, v, first, last):
    """Turn round the positions ``first`` to ``last`` of tour ``v``."""
    route = plan.routes[v]
    while first <= last:
        a, b = route[first], route[last]
        route[first], route[last] = b, a
        plan.nodes[b].position = first
        plan.nodes[a].position = last
        first += 1
        last -= 1


@njit(cache=True, nogil=True, forceinline=True)
def push(plan, n_queued, node):
    """Queue a node unless it is a terminal or waits already; returns the new length of the queue."""
    if plan.nodes[node].queued:
        return n_queued
    plan.nodes[node].queued = True
    plan.lists[QUEUE, n_queued] = node
    return n_queued + 1


@njit(cache=True, nogil=True)
def find_near(nodes, n_tasks, near):
    """
    Fill in the nearest tasks of every node, nearest first; of several as near, those with the smallest numbers.

    :param nodes: As in :class:`Plan`
    :param n_tasks: Number of tasks
    :param near: As in :class:`Plan`, to be filled
    """
    n_near = near.shape[1]
    squares = np.empty(n_near)
    for a in range(len(nodes)):
        count = 0
        for b in range(1, n_tasks + 1):
            dx, dy = nodes[a].x - nodes[b].x, nodes[a].y - nodes[b].y
            square = dx * dx + dy * dy
            if b == a or (count == n_near and (n_near == 0 or square >= squares[n_near - 1])):
                continue
            k = count if count < n_near else n_near - 1
            while k > 0 and squares[k - 1] > square:
                squares[k] = squares[k - 1]
                near[a, k] = near[a, k - 1]
                k -= 1
            squares[k] = square
            near[a, k] = b
            count = min(count + 1, n_near)


# ------------------------------------------------------------------------------------------------------------ shorter tours


@njit(cache=True, nogil=True)
def move_segment(plan, v, first, count, w, place, flip):
    """
    Move up to three neighboring tasks of tour ``v`` to ``place`` of tour ``w`` (as numbered before), turned if ``flip``.
    """
    route = plan.routes[v]
    a, b, c = route[first], route[first + 1], route[min(first + 2, plan.tours[v].size + 1)]
    cut(plan, v, first, count)
    if w == v and place > first:
        place -= count
    for i in range(count):
        k = i if flip else count - 1 - i
        insert(plan, w, place, a if k == 0 else b if k == 1 else c, 0.0)


@njit(cache=True, nogil=True)
def survey_segments(plan, a, saved):
    """
    :param saved: ``(2 * MAX_SEGMENT,)`` float64, to be filled with what is saved by taking out the tasks from ``a`` forwards,
        one to three, and backwards; 0 where a tour ends before
    :return: The largest
    """
    v, p = plan.nodes[a].owner, plan.nodes[a].position
    size = plan.tours[v].size
    most = 0.0
    for k in range(2 * MAX_SEGMENT):
        first = p if k < MAX_SEGMENT else p - k + MAX_SEGMENT
        last = p + k if k < MAX_SEGMENT else p
        saved[k] = 0.0
        if first >= 1 and last <= size:
            before, behind = plan.routes[v, first - 1], plan.routes[v, last + 1]
            saved[k] = distance(plan, before, plan.routes[v, first]) - distance(plan, before, behind)
            saved[k] += distance(plan, plan.routes[v, last], behind)
            most = max(most, saved[k])
    return most


@njit(cache=True, nogil=True)
def try_segments(plan, n_queued, a, w, q, distance_ab, saved):
    """
    Or-opt and relocation: move one to three tasks, ``a`` at one end, next to another stop, if that makes the tours shorter.

    :param w: A tour
    :param q: Position in it of the other stop ``b``; it is a terminal only if the tour is ``a``'s own
    :param distance_ab: Distance between the two
    :param saved: See :func:`survey_segments`
    :return: The new length of the queue, -1 if nothing has changed
    """
    v = plan.nodes[a].owner
    b = plan.routes[w, q]
    p = plan.nodes[a].position
    for k in range(2 * MAX_SEGMENT):
        if saved[k] <= distance_ab:
            continue
        forward = k < MAX_SEGMENT
        first = p if forward else p - k + MAX_SEGMENT
        last = p + k if forward else p
        if w == v and first <= q <= last:
            continue
        end = plan.routes[v, last] if forward else plan.routes[v, first]
        for after_b in (True, False):
            if (q > plan.tours[w].size) if after_b else (q == 0):
                continue
            place = q + 1 if after_b else q
            if w == v and first <= place <= last + 1:
                continue
            c = plan.routes[w, q + 1] if after_b else plan.routes[w, q - 1]
            added = distance_ab + distance(plan, end, c) - distance(plan, b, c)
            if added - saved[k] >= -EPSILON:
                continue
            inside = 0.0
            if w != v:
                for r in range(first, last):
                    inside += distance(plan, plan.routes[v, r], plan.routes[v, r + 1])
                for r in range(first, last + 1):
                    inside += plan.nodes[plan.routes[v, r]].service
                if plan.tours[w].length + added + inside > plan.tours[w].limit:
                    continue
            before, behind = plan.routes[v, first - 1], plan.routes[v, last + 1]
            plan.tours[v].length -= saved[k] + inside
            plan.tours[w].length += added + inside
            move_segment(plan, v, first, last - first + 1, w, place, forward != after_b)
            for node in (a, b, end, c, before, behind):
                n_queued = push(plan, n_queued, node)
            return n_queued
    return -1


@njit(cache=True, nogil=True)
def try_two_opt(plan, n_queued, a, q, distance_ab, forwards, backwards):
    """
    2-opt within one tour: join ``a`` and another stop ``b``, turn round what lies between.

    :param q: Position of ``b``, which may be a terminal
    :param distance_ab: Distance between the two
    :param forwards: Whether the legs behind both may vanish, which the end of a tour has not
    :param backwards: Whether the legs before both may vanish, which the start of a tour has not
    :return: The new length of the queue, -1 if nothing has changed
    """
    v = plan.nodes[a].owner
    p = plan.nodes[a].position
    route = plan.routes[v]
    b = route[q]
    for forward in (True, False):
        if not (forwards if forward else backwards):
            continue
        # The neighbors on the side of the legs that vanish.
        next_a = route[p + 1] if forward else route[p - 1]
        next_b = route[q + 1] if forward else route[q - 1]
        if next_a == b or next_b == a:
            continue
        change = distance_ab + distance(plan, next_a, next_b) - distance(plan, a, next_a) - distance(plan, b, next_b)
        if change >= -EPSILON:
            continue
        if forward:
            reverse(plan, v, min(p, q) + 1, max(p, q))
        else:
            reverse(plan, v, min(p, q), max(p, q) - 1)
        plan.tours[v].length += change
        for node in (a, b, next_a, next_b):
            n_queued = push(plan, n_queued, node)
        return n_queued
    return -1


@njit(cache=True, nogil=True)
def try_exchange(plan, n_queued, a, b, distance_ab):
    """Swap ``a`` with a neighbor of ``b``, a task of another tour; returns as :func:`try_segments`."""
    v, w = plan.nodes[a].owner, plan.nodes[b].owner
    p = plan.nodes[a].position
    before, behind = plan.routes[v, p - 1], plan.routes[v, p + 1]
    old = distance(plan, before, a) + distance(plan, a, behind)
    for side in (1, -1):
        q = plan.nodes[b].position + side
        if q == 0 or q > plan.tours[w].size:
            continue
        c = plan.routes[w, q]
        beyond = plan.routes[w, q + side]
        change_w = distance_ab + distance(plan, a, beyond) - distance(plan, b, c) - distance(plan, c, beyond)
        change_v = distance(plan, before, c) + distance(plan, c, behind) - old
        if change_v + change_w >= -EPSILON:
            continue
        change_v += plan.nodes[c].service - plan.nodes[a].service
        change_w += plan.nodes[a].service - plan.nodes[c].service
        if plan.tours[v].length + change_v > plan.tours[v].limit or plan.tours[w].length + change_w > plan.tours[w].limit:
            continue
        plan.routes[v, p], plan.routes[w, q] = c, a
        plan.nodes[a].owner, plan.nodes[c].owner = w, v
        plan.nodes[a].position, plan.nodes[c].position = q, p
        plan.tours[v].length += change_v
        plan.tours[w].length += change_w
        for node in (a, b, c, before, behind, beyond):
            n_queued = push(plan, n_queued, node)
        return n_queued
    return -1


@njit(cache=True, nogil=True)
def head_length(plan, v, p):
    """Length of tour ``v`` from its start to position ``p``, with the service there."""
    length = 0.0
    for k in range(p):
        length += distance(plan, plan.routes[v, k], plan.routes[v, k + 1]) + plan.nodes[plan.routes[v, k + 1]].service
    return length


@njit(cache=True, nogil=True, forceinline=True)
def terminal_change(plan, node, new, old):
    """By how much the leg between a node and a terminal grows when another takes its place: exactly 0 for the same one."""
    return distance(plan, node, new) - distance(plan, node, old) if new != old else 0.0


@njit(cache=True, nogil=True)
def try_crossing(plan, n_queued, a, b, distance_ab):
    """
    2-opt*: join two tours at the tasks ``a`` and ``b``, and what is left of them; returns as :func:`try_segments`.

    Tails that change their tour leave their terminals behind.
    """
    v, w = plan.nodes[a].owner, plan.nodes[b].owner
    size_v, size_w = plan.tours[v].size, plan.tours[w].size
    for variant in range(3):
        p, q = plan.nodes[a].position, plan.nodes[b].position
        # Positions of the last stop before the leg that vanishes, in either tour.
        if variant == 0:
            q -= 1
        elif variant == 2:
            p -= 1
            q -= 1
        route_v, route_w = plan.routes[v], plan.routes[w]
        end_v, start_v, end_w, start_w = route_v[p], route_v[p + 1], route_w[q], route_w[q + 1]
        last_v, last_w = route_v[size_v + 1], route_w[size_w + 1]
        change = -distance(plan, end_v, start_v) - distance(plan, end_w, start_w)
        # Heads are joined to tails, or heads to heads and tails to tails. The stop beside a terminal that is exchanged may be
        # that on the other side of the new leg.
        if variant == 0:
            change += distance_ab + distance(plan, end_w, start_v)
            more_v = terminal_change(plan, route_w[size_w] if q < size_w else end_v, last_v, last_w)
            more_w = terminal_change(plan, route_v[size_v] if p < size_v else end_w, last_w, last_v)
        else:
            if variant == 1:
                change += distance_ab + distance(plan, start_v, start_w)
            else:
                change += distance_ab + distance(plan, end_v, end_w)
            more_v = terminal_change(plan, route_w[1] if q > 0 else end_v, last_v, route_w[0])
            more_w = terminal_change(plan, route_v[size_v] if p < size_v else start_w, route_w[0], last_v)
        if change + (more_v + more_w) >= -EPSILON:
            continue
        head_v, head_w = head_length(plan, v, p), head_length(plan, w, q)
        tail_v = plan.tours[v].length - head_v - distance(plan, end_v, start_v)
        tail_w = plan.tours[w].length - head_w - distance(plan, end_w, start_w)
        if variant == 0:
            new_v = head_v + tail_w + distance(plan, end_v, start_w) + more_v
            new_w = head_w + tail_v + distance(plan, end_w, start_v) + more_w
        else:
            new_v = head_v + head_w + distance(plan, end_v, end_w) + more_v
            new_w = tail_v + tail_w + distance(plan, start_v, start_w) + more_w
        if new_v > plan.tours[v].limit or new_w > plan.tours[w].limit:
            continue
        old_v, old_w = route_v[: size_v + 2].copy(), route_w[: size_w + 2].copy()
        if variant == 0:
            plan.tours[v].size = p + size_w - q
            plan.tours[w].size = q + size_v - p
            route_v[p + 1 : plan.tours[v].size + 2] = old_w[q + 1 :]
            route_w[q + 1 : plan.tours[w].size + 2] = old_v[p + 1 :]
        else:
            plan.tours[v].size = p + q
            plan.tours[w].size = size_v - p + size_w - q
            route_v[p + 1 : p + q + 2] = old_w[q::-1]
            route_w[: size_v - p + 1] = old_v[:p:-1]
            route_w[size_v - p + 1 : plan.tours[w].size + 2] = old_w[q + 1 :]
            route_w[0] = old_w[0]
        route_v[plan.tours[v].size + 1] = last_v
        route_w[plan.tours[w].size + 1] = last_w
        measure(plan, v)
        measure(plan, w)
        for node in (end_v, start_v, end_w, start_w):
            n_queued = push(plan, n_queued, node)
        return n_queued
    return -1


@njit(cache=True, nogil=True)
def try_terminals(plan, n_queued, a, v, longest, saved):
    """
    Join ``a`` to the start or to the end of its own tour ``v``; returns as :func:`try_segments`.

    :param longest: How long the new leg may be
    :param saved: See :func:`survey_segments`
    """
    last = plan.tours[v].size + 1
    to_start, to_end = distance(plan, a, plan.routes[v, 0]), distance(plan, a, plan.routes[v, last])
    n = -1
    if to_start < longest:
        n = try_two_opt(plan, n_queued, a, 0, to_start, True, False)
    if n < 0 and to_end < longest:
        n = try_two_opt(plan, n_queued, a, last, to_end, False, True)
    if n < 0 and to_start < longest:
        n = try_segments(plan, n_queued, a, v, 0, to_start, saved)
    if n < 0 and to_end < longest:
        n = try_segments(plan, n_queued, a, v, last, to_end, saved)
    return n


@njit(cache=True, nogil=True)
def shorten(plan, n_queued, n_near):
    """
    Make tours shorter around the tasks in the queue until nothing changes there.

    :param n_near: How many neighbors of a task to try
    :return: Whether anything has changed
    """
    changed = False
    n_near = min(n_near, plan.near.shape[1])
    saved = np.empty(2 * MAX_SEGMENT)
    while n_queued > 0:
        n_queued -= 1
        a = plan.lists[QUEUE, n_queued]
        plan.nodes[a].queued = False
        improved = plan.nodes[a].owner >= 0
        while improved:
            improved = False
            v, p = np.int64(plan.nodes[a].owner), plan.nodes[a].position
            longest = max(distance(plan, plan.routes[v, p - 1], a), distance(plan, a, plan.routes[v, p + 1]))
            longest = max(longest, survey_segments(plan, a, saved))
            n = try_terminals(plan, n_queued, a, v, longest, saved)
            if n >= 0:
                n_queued = n
                improved = changed = True
                continue
            for j in range(n_near):
                b = np.int64(plan.near[a, j])
                distance_ab = distance(plan, a, b)
                if distance_ab >= longest:
                    break
                w, q = np.int64(plan.nodes[b].owner), np.int64(plan.nodes[b].position)
                if w < 0:
                    continue
                if w == v:
                    n = try_two_opt(plan, n_queued, a, q, distance_ab, True, True)
                if n < 0:
                    n = try_segments(plan, n_queued, a, w, q, distance_ab, saved)
                if n < 0 and w != v:
                    n = try_exchange(plan, n_queued, a, b, distance_ab)
                    if n < 0:
                        n = try_crossing(plan, n_queued, a, b, distance_ab)
                if n >= 0:
                    n_queued = n
                    improved = changed = True
                    break
    return changed


# -------------------------------------------------------------------------------------------------------------- more tasks


@njit(cache=True, nogil=True, forceinline=True)
def offer(plan, task, v, a, b):
    """Note that ``task`` fits between ``a`` and ``b`` of tour ``v``, if it does so cheaper than anywhere before."""
    offer_at(plan, task, v, a, distance(plan, a, task) + distance(plan, task, b) - distance(plan, a, b))


@njit(cache=True, nogil=True, forceinline=True)
def offer_at(plan, task, v, a, added):
    """The same, when the added length of legs is already known."""
    if added < plan.nodes[task].cost and plan.tours[v].length + (added + plan.nodes[task].service) <= plan.tours[v].limit:
        plan.nodes[task].cost = added
        plan.nodes[task].tour = v
        plan.nodes[task].after = a


@njit(cache=True, nogil=True)
def look_everywhere(plan, task):
    """Find the cheapest place of a task in all tours."""
    plan.nodes[task].cost = NOWHERE
    plan.nodes[task].tour = -1
    for v in range(len(plan.tours)):
        for p in range(plan.tours[v].size + 1):
            offer(plan, task, v, plan.routes[v, p], plan.routes[v, p + 1])


@njit(cache=True, nogil=True)
def look_around(plan, task, n_near):
    """Find the cheapest place of a task beside its ``n_near`` neighbors and the terminals; everywhere if that is None."""
    if n_near == 0:
        look_everywhere(plan, task)
        return
    plan.nodes[task].cost = NOWHERE
    plan.nodes[task].tour = -1
    for j in range(n_near):
        a = np.int64(plan.near[task, j])
        v = plan.nodes[a].owner
        if v >= 0:
            p = plan.nodes[a].position
            offer(plan, task, v, plan.routes[v, p - 1], a)
            offer(plan, task, v, a, plan.routes[v, p + 1])
    for v in range(len(plan.tours)):
        size = plan.tours[v].size
        offer(plan, task, v, plan.routes[v, 0], plan.routes[v, 1])
        offer(plan, task, v, plan.routes[v, size], plan.routes[v, size + 1])


@njit(cache=True, nogil=True, forceinline=True)
def keep(plan, n_touched, v):
    """Copy tour ``v``, unless it has been copied in this trial already; returns the number of copied tours."""
    if plan.tours[v].touched == plan.state[0].clock:
        return n_touched
    plan.tours[v].touched = plan.state[0].clock
    plan.lists[TOUCHED, n_touched] = v
    size = plan.tours[v].size
    plan.routes[len(plan.tours) + v, : size + 2] = plan.routes[v, : size + 2]
    plan.tours[v].old_size = size
    plan.tours[v].old_length = plan.tours[v].length
    return n_touched + 1


@njit(cache=True, nogil=True)
def put_back(plan, n_touched):
    """Undo the trial."""
    for i in range(n_touched):
        v = plan.lists[TOUCHED, i]
        for p in range(1, plan.tours[v].size + 1):
            plan.nodes[plan.routes[v, p]].owner = -1
    for i in range(n_touched):
        v = plan.lists[TOUCHED, i]
        size = plan.tours[v].old_size
        plan.routes[v, : size + 2] = plan.routes[len(plan.tours) + v, : size + 2]
        plan.tours[v].size = size
        for p in range(1, size + 1):
            plan.nodes[plan.routes[v, p]].owner = v
            plan.nodes[plan.routes[v, p]].position = p
        plan.tours[v].length = plan.tours[v].old_length


@njit(cache=True, nogil=True, forceinline=True)
def enter(plan, n_candidates, task, blink, spread):
    """Make a task a candidate, unless it is one or has been left out already; returns the number of candidates."""
    if plan.nodes[task].seen == plan.state[0].clock:
        return n_candidates
    plan.nodes[task].seen = plan.state[0].clock
    plan.nodes[task].cost = NOWHERE
    plan.nodes[task].tour = -1
    plan.nodes[task].noise = 1.0
    if blink > 0.0 and uniform(plan) < blink:
        plan.nodes[task].noise = -1.0
        return n_candidates
    if spread > 0.0:
        plan.nodes[task].noise += spread * (2.0 * uniform(plan) - 1.0)
    plan.lists[CANDIDATES, n_candidates] = task
    return n_candidates + 1


@njit(cache=True, nogil=True)
def fill(plan, n_candidates, n_touched, n_near, blink, spread):
    """
    Insert candidates, the one that is worth most per added length first, until none fits.

    :param n_near: How many neighbors of a task to look at; 0 for all
    :param blink: Probability of leaving a new candidate out
    :param spread: Standard noise of the worth
    :return: The number of copied tours
    """
    while True:
        best, best_worth = -1, 0.0
        i = 0
        while i < n_candidates:
            task = plan.lists[CANDIDATES, i]
            v = plan.nodes[task].tour
            cost = plan.nodes[task].cost + plan.nodes[task].service
            if v >= 0 and plan.tours[v].length + cost > plan.tours[v].limit:
                look_around(plan, task, n_near)
                v = plan.nodes[task].tour
                cost = plan.nodes[task].cost + plan.nodes[task].service
            if v < 0 and n_near > 0:
                # It comes back when a leg beside it appears.
                n_candidates -= 1
                plan.lists[CANDIDATES, i] = plan.lists[CANDIDATES, n_candidates]
                plan.nodes[task].seen = 0
                continue
            if v < 0:
                i += 1
                continue
            worth = plan.nodes[task].noise * plan.nodes[task].value / max(cost, EPSILON)
            if worth > best_worth:
                best, best_worth = i, worth
            i += 1
        if best < 0:
            return n_touched
        task = plan.lists[CANDIDATES, best]
        n_candidates -= 1
        plan.lists[CANDIDATES, best] = plan.lists[CANDIDATES, n_candidates]
        v, a = plan.nodes[task].tour, np.int64(plan.nodes[task].after)
        n_touched = keep(plan, n_touched, v)
        place = plan.nodes[a].position + 1 if a != plan.routes[v, 0] else 1
        b = plan.routes[v, place]
        insert(plan, v, place, task, plan.nodes[task].cost + plan.nodes[task].service)
        for i in range(n_candidates):
            other = plan.lists[CANDIDATES, i]
            if plan.nodes[other].tour == v and plan.nodes[other].after == a:
                look_around(plan, other, n_near)
            elif n_near == 0:
                offer(plan, other, v, a, task)
                offer(plan, other, v, task, b)
        for j in range(n_near):
            other = np.int64(plan.near[task, j])
            if plan.nodes[other].owner < 0:
                n_candidates = enter(plan, n_candidates, other, blink, spread)
                if plan.nodes[other].noise > 0.0:
                    offer(plan, other, v, a, task)
                    offer(plan, other, v, task, b)


@njit(cache=True, nogil=True)
def fill_everywhere(plan):
    """Insert unvisited tasks until none fits anywhere; returns how many."""
    plan.state[0].clock += 1
    before = count_visited(plan)
    n_candidates = 0
    for task in range(1, plan.state[0].n_tasks + 1):
        if plan.nodes[task].owner < 0:
            n_candidates = enter(plan, n_candidates, task, 0.0, 0.0)
            look_everywhere(plan, task)
    fill(plan, n_candidates, 0, 0, 0.0, 0.0)
    for v in range(len(plan.tours)):
        measure(plan, v)
    return count_visited(plan) - before


@njit(cache=True, nogil=True)
def replace(plan):  # noqa: C901 (compiled: every call of a helper would pass the whole state)
    """Swap visited tasks for unvisited ones that are worth more, or as much on a shorter tour; returns how often."""
    count = 0
    n_stops = plan.state[0].n_tasks + 2
    leg, saved, reach = np.empty(n_stops), np.empty(n_stops), np.empty(n_stops)
    for v in range(len(plan.tours)):
        route = plan.routes[v]
        stale = True
        for task in range(1, plan.state[0].n_tasks + 1):
            if plan.nodes[task].owner >= 0:
                continue
            size = plan.tours[v].size
            if stale:
                measure(plan, v)
                for p in range(size + 1):
                    leg[p] = distance(plan, route[p], route[p + 1])
                for p in range(1, size + 1):
                    saved[p] = leg[p - 1] + leg[p] - distance(plan, route[p - 1], route[p + 1])
                stale = False
            for p in range(size + 2):
                reach[p] = distance(plan, route[p], task)
            # The three cheapest legs; two of them may touch the task that leaves.
            first, second, third = -1, -1, -1
            cost1, cost2, cost3 = NOWHERE, NOWHERE, NOWHERE
            for p in range(size + 1):
                added = reach[p] + reach[p + 1] - leg[p]
                if added < cost1:
                    first, second, third = p, first, second
                    cost1, cost2, cost3 = added, cost1, cost2
                elif added < cost2:
                    second, third = p, second
                    cost2, cost3 = added, cost2
                elif added < cost3:
                    third, cost3 = p, added
            best, best_leg, best_gain, best_change = -1, -1, 0.0, -EPSILON
            for p in range(1, size + 1):
                gain = plan.nodes[task].value - plan.nodes[route[p]].value
                if gain < best_gain:
                    continue
                # Straight into its place, or between two others.
                at, added = p, reach[p - 1] + reach[p + 1] - (leg[p - 1] + leg[p] - saved[p])
                for k, cost in ((first, cost1), (second, cost2), (third, cost3)):
                    if k >= 0 and k != p and k != p - 1:
                        if cost < added:
                            at, added = k, cost
                        break
                change = added - saved[p] + (plan.nodes[task].service - plan.nodes[route[p]].service)
                if (gain > best_gain or change < best_change) and plan.tours[v].length + change <= plan.tours[v].limit:
                    best, best_leg, best_gain, best_change = p, at, gain, change
            if best < 0:
                continue
            if best_leg == best:
                plan.nodes[route[best]].owner = -1
                route[best] = task
            else:
                cut(plan, v, best, 1)
                insert(plan, v, best_leg + 1 if best_leg < best else best_leg, task, 0.0)
            stale = True
            count += 1
            measure(plan, v)
    return count


# ------------------------------------------------------------------------------------------------------ ruin and recreate


@njit(cache=True, nogil=True)
def ruin(plan, n_removed, v, first, count):
    """Take a string of tasks out of tour ``v``; returns the number of removed tasks."""
    route = plan.routes[v]
    old = 0.0
    for p in range(first, first + count):
        plan.lists[REMOVED, n_removed] = route[p]
        n_removed += 1
        old += plan.nodes[route[p]].service
    for p in range(first, first + count + 1):
        old += distance(plan, route[p - 1], route[p])
    plan.tours[v].length += distance(plan, route[first - 1], route[first + count]) - old
    cut(plan, v, first, count)
    return n_removed


@njit(cache=True, nogil=True, forceinline=True)
def account(plan, n_touched):
    """Measure the copied tours; returns by how much value and length of all tours have grown since the trial began."""
    value, length = 0.0, 0.0
    for i in range(n_touched):
        v = plan.lists[TOUCHED, i]
        measure(plan, v)
        length += plan.tours[v].length - plan.tours[v].old_length
        for p in range(1, plan.tours[v].size + 1):
            value += plan.nodes[plan.routes[v, p]].value
        for p in range(1, plan.tours[v].old_size + 1):
            value -= plan.nodes[plan.routes[len(plan.tours) + v, p]].value
    return value, length


@njit(cache=True, nogil=True, forceinline=True)
def keep_empty(plan, n_touched):
    """
    Where UAVs differ, copy the empty tours, so that they are filled as well: no string is ever taken out of them.

    :return: The number of copied tours
    """
    if not plan.state[0].equal:
        for v in range(len(plan.tours)):
            if plan.tours[v].size == 0 and plan.tours[v].length <= plan.tours[v].limit:
                n_touched = keep(plan, n_touched, v)
    return n_touched


@njit(cache=True, nogil=True)
def recreate(plan, n_removed, n_touched, n_near, blink, spread):
    """
    Fill the tours that have been ruined.

    :return: The number of copied tours, and by how much the value and the length of all tours have grown since the ruin began
    """
    n_near = min(n_near, plan.near.shape[1])
    n_candidates = 0
    for i in range(n_removed):
        task = plan.lists[REMOVED, i]
        n_candidates = enter(plan, n_candidates, task, blink, spread)
        if plan.nodes[task].noise > 0.0:
            look_around(plan, task, n_near)
    n_touched = keep_empty(plan, n_touched)
    for i in range(n_touched):
        v = plan.lists[TOUCHED, i]
        route = plan.routes[v]
        leg_before = 0.0
        last = plan.tours[v].size + 1
        for p in range(last):
            node, behind = route[p], route[p + 1]
            before = route[p - 1] if p > 0 else route[0]
            leg_behind = distance(plan, node, behind)
            for j in range(n_near):
                task = np.int64(plan.near[node, j])
                if plan.nodes[task].owner >= 0:
                    continue
                n_candidates = enter(plan, n_candidates, task, blink, spread)
                if plan.nodes[task].noise > 0.0:
                    reach = distance(plan, node, task)
                    offer_at(plan, task, v, node, reach + distance(plan, task, behind) - leg_behind)
                    if p > 0:
                        offer_at(plan, task, v, before, reach + distance(plan, task, before) - leg_before)
            leg_before = leg_behind
        # What is near the end of a tour is near its start, unless they are different.
        for j in range(n_near if route[last] != route[0] else 0):
            task = np.int64(plan.near[route[last], j])
            if plan.nodes[task].owner < 0:
                n_candidates = enter(plan, n_candidates, task, blink, spread)
                if plan.nodes[task].noise > 0.0:
                    offer(plan, task, v, route[last - 1], route[last])
    n_touched = fill(plan, n_candidates, n_touched, n_near, blink, spread)
    value, length = account(plan, n_touched)
    return n_touched, value, length


@njit(cache=True, nogil=True)
def eject(plan, n_near, max_string):
    """Take every string of up to ``max_string`` tasks out and fill the gap, wherever that is better; returns how often."""
    count = 0
    for task in range(1, plan.state[0].n_tasks + 1):
        for length in range(1, max_string + 1):
            v = plan.nodes[task].owner
            if v < 0:
                break
            first = plan.nodes[task].position
            if first + length - 1 > plan.tours[v].size:
                break
            plan.state[0].clock += 1
            n_touched = keep(plan, 0, v)
            n_removed = ruin(plan, 0, v, first, length)
            n_touched, value, change = recreate(plan, n_removed, n_touched, n_near, 0.0, 0.0)
            if value > EPSILON or (value > -EPSILON and change < -EPSILON):
                count += 1
            else:
                put_back(plan, n_touched)
    return count


@njit(cache=True, nogil=True)
def make_room(plan, task, v, keep_rest):
    """
    Put an unvisited task into tour ``v``, which has to be copied before, whatever has to leave.

    :param keep_rest: Whether only so many tasks leave that it fits, those first whose value is least for what they take; else
        all leave
    :return: The number of removed tasks, -1 if even then it does not fit
    """
    route = plan.routes[v]
    n_removed = 0
    if not keep_rest and plan.tours[v].size > 0:
        n_removed = ruin(plan, n_removed, v, 1, plan.tours[v].size)
    place, least = -1, NOWHERE
    for p in range(1, plan.tours[v].size + 2):
        added = distance(plan, route[p - 1], task) + distance(plan, task, route[p]) - distance(plan, route[p - 1], route[p])
        if added < least:
            place, least = p, added
    insert(plan, v, place, task, least + plan.nodes[task].service)
    while plan.tours[v].length > plan.tours[v].limit:
        out, least = -1, NOWHERE
        for p in range(1, plan.tours[v].size + 1):
            if route[p] == task:
                continue
            saved = distance(plan, route[p - 1], route[p]) + distance(plan, route[p], route[p + 1])
            saved += plan.nodes[route[p]].service - distance(plan, route[p - 1], route[p + 1])
            worth = plan.nodes[route[p]].value / max(saved, EPSILON)
            if worth < least:
                out, least = p, worth
        if out < 0:
            return -1
        n_removed = ruin(plan, n_removed, v, out, 1)
    return n_removed


@njit(cache=True, nogil=True)
def admit(plan, n_near):
    """
    Make room for unvisited tasks and insert what had to leave elsewhere, wherever that is worth more; returns how often.

    For a task that is dear to a tour all of it may leave. Where UAVs are equal, only such tasks are tried: the others come in
    where strings are taken out.

    :param n_near: Beside how many neighbors a task may be inserted
    """
    count = 0
    for task in range(1, plan.state[0].n_tasks + 1):
        for v in range(len(plan.tours)):
            if plan.nodes[task].owner >= 0:
                break
            size = plan.tours[v].size
            value = 0.0
            for p in range(1, size + 1):
                value += plan.nodes[plan.routes[v, p]].value
            is_dear = plan.nodes[task].value * size > value * min(size, DEAR)
            alone = distance(plan, plan.routes[v, 0], task) + distance(plan, task, plan.routes[v, size + 1])
            if alone + plan.nodes[task].service > plan.tours[v].limit or (plan.state[0].equal and not is_dear):
                continue
            for keep_rest in (True, False):
                if not keep_rest and not is_dear:
                    break
                plan.state[0].clock += 1
                n_touched = keep(plan, 0, v)
                n_removed = make_room(plan, task, v, keep_rest)
                gain = -1.0
                if n_removed >= 0:
                    n_touched, gain, _ = recreate(plan, n_removed, n_touched, n_near, 0.0, 0.0)
                if gain > EPSILON:
                    count += 1
                    break
                put_back(plan, n_touched)
    return count


@njit(cache=True, nogil=True)
def descend(plan, n_near_joined, n_near_inserted, max_string):
    """
    One round of every neighborhood.

    :param n_near_joined: Number of neighbors that a task may be joined to
    :param n_near_inserted: Beside how many neighbors a task may be inserted where a string has been taken out
    :param max_string: The longest string of tasks that is taken out; 0 for none
    :return: Whether anything has changed
    """
    n_queued = 0
    for v in range(len(plan.tours)):
        for p in range(1, plan.tours[v].size + 1):
            n_queued = push(plan, n_queued, plan.routes[v, p])
    changed = shorten(plan, n_queued, n_near_joined)
    for v in range(len(plan.tours)):
        measure(plan, v)
    if fill_everywhere(plan) > 0:
        changed = True
    if replace(plan) > 0:
        return True
    if changed or max_string == 0:
        return changed
    return eject(plan, n_near_inserted, max_string) > 0 or admit(plan, n_near_inserted) > 0


@njit(cache=True, nogil=True)
def ruin_around(plan, mean_removed, longest):
    """
    Take strings of tasks near a random one out of several tours (SISR, Christiaens and Vanden Berghe, 2020).

    :return: The numbers of removed tasks and of copied tours
    """
    n_removed, n_touched = 0, 0
    n_served, n_flying = 0, 0
    for v in range(len(plan.tours)):
        n_served += plan.tours[v].size
        n_flying += plan.tours[v].size > 0
    if n_served == 0:
        return 0, 0
    longest_here = max(1.0, min(longest, n_served / n_flying))
    n_strings = int(1.0 + uniform(plan) * max(4.0 * mean_removed / (1.0 + longest_here) - 1.0, 0.0))
    seed = 1 + int(uniform(plan) * plan.state[0].n_tasks)
    for j in range(-1, plan.near.shape[1]):
        task = seed if j < 0 else np.int64(plan.near[seed, j])
        v = plan.nodes[task].owner
        if v < 0 or plan.tours[v].touched == plan.state[0].clock:
            continue
        n_touched = keep(plan, n_touched, v)
        size = plan.tours[v].size
        count = int(1.0 + uniform(plan) * min(float(size), longest_here))
        count = min(count, size)
        # A string around the task, possibly with one task in it that stays.
        spared = 1 if 1 < count < size and uniform(plan) < 0.5 else 0
        span = count + spared
        position = plan.nodes[task].position
        low, high = max(1, position - span + 1), min(position, size - span + 1)
        first = low + int(uniform(plan) * (high - low + 1))
        if spared == 0:
            n_removed = ruin(plan, n_removed, v, first, count)
        else:
            left = 1 + int(uniform(plan) * (count - 1))
            n_removed = ruin(plan, n_removed, v, first + left + 1, count - left)
            n_removed = ruin(plan, n_removed, v, first, left)
        if n_touched >= n_strings:
            break
    return n_removed, n_touched


@njit(cache=True, nogil=True)
def extraordinary_value(plan, visited):
    """What visited or unvisited tasks are worth beyond the ordinary."""
    total = 0.0
    for task in range(1, plan.state[0].n_tasks + 1):
        if (plan.nodes[task].owner >= 0) == visited:
            total += max(plan.nodes[task].value - plan.state[0].ordinary, 0.0)
    return total


@njit(cache=True, nogil=True)
def copy_routes(source, target):
    """Make the routes of ``target`` those of ``source``; owners and positions are not."""
    for v in range(len(source.tours)):
        size = source.tours[v].size
        target.tours[v].size = size
        target.routes[v, : size + 2] = source.routes[v, : size + 2]


@njit(cache=True, nogil=True)
def anneal(plan, best, n_trials, progress_before, progress_after, settings):
    """
    Ruin and recreate, with worse schedules accepted as in simulated annealing.

    :param best: The best schedule so far, updated; owners and positions are not
    :param n_trials: How many
    :param progress_before: Which part of all trials lies behind, 0 to 1
    :param progress_after: Which part will lie behind after these
    :param settings: :class:`AnnealingSettings`
    """
    scale, mean = 0.0, 0.0
    for task in range(1, plan.state[0].n_tasks + 1):
        scale += min(plan.nodes[task].value, plan.state[0].ordinary)
        mean += plan.nodes[task].value
    scale /= plan.state[0].n_tasks
    measure_all(best)
    best_value, best_length = total_value(best), total_length(best)
    # In the end the temperature is one for ordinary tasks; while others are missing, it starts with one for them too.
    ratio = 1.0
    if extraordinary_value(best, False) > 0.0:
        ratio = mean / plan.state[0].n_tasks / scale
    elif extraordinary_value(plan, False) > 0.0:
        copy_routes(best, plan)
        measure_all(plan)
    value, length, limit = total_value(plan), total_length(plan), 0.0
    # What is dear beyond measure does not make length dear.
    beyond = extraordinary_value(plan, True)
    for trial in range(n_trials):
        plan.state[0].clock += 1
        n_removed, n_touched = ruin_around(plan, settings.mean_removed, settings.longest_string)
        if n_removed == 0:
            if count_visited(plan) == 0:
                # This is where we begin, or a trial has overlooked all that it had taken out.
                fill_everywhere(plan)
                value, length = total_value(plan), total_length(plan)
                beyond = extraordinary_value(plan, True)
            continue
        closed = -1
        if not plan.state[0].equal and uniform(plan) < CLOSED:
            # Else a task always goes where it adds least, and never makes way for one that only this UAV can serve.
            closed = int(uniform(plan) * len(plan.tours))
            limit = plan.tours[closed].limit
            plan.tours[closed].limit = -1.0
        n_touched, gain, change = recreate(plan, n_removed, n_touched, settings.n_near, settings.blink, settings.noise)
        if closed >= 0:
            plan.tours[closed].limit = limit
        progress = progress_before + (progress_after - progress_before) * (trial / n_trials)
        temperature = scale * settings.hot * (settings.cold / settings.hot) ** progress
        if ratio > 1.0:
            temperature *= ratio ** (1.0 - progress)
        score = gain - settings.thrift * (value - beyond) / max(length, EPSILON) * change
        if score < 0.0 and uniform(plan) >= math.exp(score / temperature):
            put_back(plan, n_touched)
            continue
        value += gain
        length += change
        if abs(gain) > plan.state[0].ordinary:
            beyond = extraordinary_value(plan, True)
        if value > best_value + SAME_VALUE or (value > best_value - SAME_VALUE and length < best_length - EPSILON):
            best_value, best_length = value, length
            copy_routes(plan, best)
