"""Imitation: training the router on the tours that local search finds for the subsets of an allocator."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch as th
from torch.nn import functional

from sb3_uav.common import distributed
from sb3_uav.common.divergence import LARGEST_WEIGHT, DivergenceError, first_bad, largest
from sb3_uav.envs.generators import InstanceGenerator, training_batch
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.symmetries import turn
from sb3_uav.local_search.search import LocalSearch
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.training.arguments import check_counts
from sb3_uav.training.imitation_progress import ImitationProgress, Lesson
from sb3_uav.training.subsets import sample_subsets

# Number of tasks of a subset for which a batch holds exactly batch_size subsets; of larger subsets it holds fewer.
_TYPICAL_SIZE = 30
# Trials of the search per task. With 12, tours visit 99 % of the tasks that a search 25 times as long visits.
_TRIALS_PER_TASK = 12
_WARM_UP = 50
_LAST_RATE = 0.02
_MAX_GRAD_NORM = 1.0
# Beyond it the first step of Adam is infinite in float32.
_LARGEST_RATE = 1e35
_REPORT_EVERY = 250
# Progress is saved every SAVE_EVERY updates and every CHUNK_SIZE tours.
_SAVE_EVERY = 500
_CHUNK_SIZE = 10_000


def imitate(
    router: RouterPolicy,
    allocator: AllocatorPolicy,
    generator: InstanceGenerator,
    rng: np.random.Generator,
    n_subsets: int = 40_000,
    n_updates: int = 4_000,
    batch_size: int = 64,
    learning_rate: float = 2e-3,
    report: Callable[[str], None] = lambda _: None,
    folder: str | Path | None = None,
    share: float = 1.0,
    record: Callable[[int, float], None] = lambda n_moves, nats: None,
) -> None:
    """
    Train a router on the tours of local search, by the likelihood of their moves.

    Several processes (see :mod:`sb3_uav.common.distributed`) share the search and the gradients; all must see the folder.

    The subsets are sampled from the allocator, which may be untrained. Tours are reversed and rotated around the
    depot at random.

    :param router: The policy to train, in place
    :param allocator: Splits the tasks
    :param generator: Draws the instances
    :param rng: Random generator for everything that is drawn
    :param n_subsets: Number of subsets to search tours for
    :param n_updates: Number of gradient steps; the learning rate warms up, then follows a cosine
    :param batch_size: Subsets per update if they have 30 tasks; fewer if they are larger
    :param learning_rate: Peak learning rate of Adam
    :param report: Called with a line of text about the progress
    :param folder: Folder for the progress. Calling again with the same arguments resumes from it, with the same result as
        without an interruption
    :param share: Part of ``n_subsets`` and ``n_updates`` to do, above 0 and at most 1
    :param record: Called as often with the number of moves learned from so far, those before an interruption included, and
        the mean loss since the last call in nats per move
    :raises DivergenceError: If a loss, a gradient or a weight is not finite; the progress stays as last saved
    :raises ImportError: If numba is not installed
    :raises OSError: If the progress cannot be written
    :raises ValueError: If a number is not above 0, or the folder holds the progress of other settings or damaged files
    """
    check_counts(1, n_subsets=n_subsets, n_updates=n_updates, batch_size=batch_size)
    if not 0 < learning_rate < _LARGEST_RATE:
        raise ValueError(f"learning_rate is {learning_rate}; it must be above 0, and below {_LARGEST_RATE:g}.")
    n_subsets, n_updates = math.ceil(share * n_subsets), math.ceil(share * n_updates)
    settings = dict(n_subsets=n_subsets, n_updates=n_updates, batch_size=batch_size, learning_rate=learning_rate)
    progress = None if folder is None else ImitationProgress(Path(folder), settings)
    lessons = _search_lessons(allocator, generator, rng, n_subsets, batch_size, report, progress)
    optimizer = th.optim.Adam(router.parameters(), learning_rate)
    n_done, n_learned = (0, 0) if progress is None else progress.restore_updates(router, optimizer, rng)
    if n_done > 0:
        report(f"imitation: resumed after {n_done} of {n_updates} updates")
    start, total, n_moves = time.perf_counter(), th.zeros((), dtype=th.float32, device=router.device), 0
    router.set_training_mode(True)
    exploded = False
    for update in range(n_done + 1, n_updates + 1):
        cosine = 0.5 * (1 + math.cos(math.pi * update / n_updates))
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * min(1.0, update / _WARM_UP) * (_LAST_RATE + (1 - _LAST_RATE) * cosine)
        lesson = _varied(lessons[int(rng.integers(len(lessons)))], rng, batch_size)
        n_new = int((lesson.tours > 0).sum())
        rows = distributed.shard(len(lesson.tours))
        lesson = Lesson(lesson.instances[rows].to(router.device), lesson.tours[rows].to(router.device))
        is_move = lesson.tours > 0
        log_prob = router.evaluate_episodes(lesson.instances, lesson.tours[:, None]).log_prob[:, 0]
        # A part of the mean over the moves of all processes; several of them may have the same few.
        loss = -log_prob[is_move].sum() / max(distributed.total(int(is_move.sum())), 1)
        optimizer.zero_grad()
        loss.backward()
        distributed.sum_gradients(list(router.parameters()))
        loss = distributed.sum_with_gradient(loss.detach())
        norm = th.nn.utils.clip_grad_norm_(router.parameters(), _MAX_GRAD_NORM)
        _require_finite(update, progress, {"imitation loss": loss, "gradient norm of the imitation": norm})
        optimizer.step()
        name, size = largest(router.named_parameters())
        _require_finite(update, progress, {f"weight {name}": th.tensor(size)})
        if size > LARGEST_WEIGHT and not exploded:
            exploded = True
            warnings.warn(
                f"router: The weight {name} has grown to {size:.3g} in update {update} of the imitation, more than "
                f"{LARGEST_WEIGHT:g}: it is likely to diverge; lower learning_rate of the warm start.",
                stacklevel=2,
            )
        total, n_moves, n_learned = total + n_new * loss.detach(), n_moves + n_new, n_learned + n_new
        if update % _REPORT_EVERY == 0 or update == n_updates:
            seconds, nats = time.perf_counter() - start, total.item() / max(n_moves, 1)
            report(f"imitation: {update} of {n_updates} updates, {nats:.3f} nats a move, {seconds:.0f} s")
            record(n_learned, nats)
            total, n_moves = th.zeros_like(total), 0
        if progress is not None and update % _SAVE_EVERY == 0:
            progress.save_updates(update, n_learned, router, optimizer, rng)
    router.set_training_mode(False)


def _require_finite(update: int, progress: ImitationProgress | None, values: dict[str, th.Tensor]) -> None:
    """
    :param update: Number of the update, from 1
    :param progress: Where the last good state is
    :param values: Scalars by the name that the error gives them
    :raises DivergenceError: If one is infinite or NaN
    """
    for name, value in values.items():
        bad = first_bad(value)
        if bad is not None:
            saved = "none was kept, as no folder is given" if progress is None else f"{progress.folder} holds it"
            raise DivergenceError(
                f"router: The {name} is {bad} in update {update}; nothing was saved since the last good state: {saved}. Train "
                "with a smaller learning_rate of the warm start."
            )


def _search_lessons(
    allocator: AllocatorPolicy,
    generator: InstanceGenerator,
    rng: np.random.Generator,
    n_subsets: int,
    batch_size: int,
    report: Callable[[str], None] = lambda _: None,
    progress: ImitationProgress | None = None,
) -> list[Lesson]:
    """
    :param allocator: Splits the tasks
    :param generator: Draws the instances
    :param rng: Random generator
    :param n_subsets: Smallest number of subsets in all
    :param batch_size: As for :func:`imitate`
    :param report: Called with a line of text about the progress
    :param progress: Where tours are saved and restored
    :return: Batches of subsets with their tours
    """
    start = time.perf_counter()
    lessons = [] if progress is None else progress.restore_lessons(rng)
    n_found, n_saved = sum(len(lesson.tours) for lesson in lessons), len(lessons)
    while n_found < n_subsets:
        instances = allocator.arrange(training_batch(generator, max(batch_size // 2, 1), rng))
        subsets = sample_subsets(allocator, instances, rng)
        n_rows = 2 * batch_size * _TYPICAL_SIZE // subsets.n_tasks
        subsets = subsets[rng.permutation(len(subsets))[: max(n_rows, 4)]]
        subsets = subsets.trim(max(int(subsets.task_mask.sum(1).max()), 1))
        # Each process searches tours for its part of the subsets.
        tours = distributed.gather(good_tours(subsets[distributed.shard(len(subsets))]), len(subsets), ragged=True)
        lessons.append(Lesson(subsets, tours))
        before, n_found = n_found, n_found + len(subsets)
        if n_found // _CHUNK_SIZE > before // _CHUNK_SIZE or n_found >= n_subsets:
            report(f"imitation: {n_found} of {n_subsets} tours, {time.perf_counter() - start:.0f} s")
            if progress is not None:
                progress.save_lessons(lessons[n_saved:], rng)
                n_saved = len(lessons)
    return lessons


def good_tours(subsets: Instances) -> th.Tensor:
    """
    :param subsets: ``batch`` single-UAV instances
    :return: ``(batch, n_steps)`` int64 nodes, padded with the depot: tours from a local search of a few milliseconds
    """
    routes = []
    for row in range(len(subsets)):
        search = LocalSearch(subsets[row])
        n_trials = _TRIALS_PER_TASK * int(subsets.task_mask[row].sum())
        routes.append([task + 1 for route in search.improve(Schedule([]), n_trials=n_trials).routes for task in route])
    n_steps = 1 + max(map(len, routes))
    padded = [route + [0] * (n_steps - len(route)) for route in routes]
    return th.tensor(padded, dtype=th.int64, device="cpu")


def _varied(lesson: Lesson, rng: np.random.Generator, batch_size: int) -> Lesson:
    """
    :param lesson: Subsets and tours
    :param rng: Random generator
    :param batch_size: As for :func:`imitate`
    :return: A random selection, about half of the tours flown backwards, from end to start; each instance rotated around its
        depot
    """
    instances, tours = lesson
    rows = rng.permutation(len(instances))[: max(batch_size * _TYPICAL_SIZE // instances.n_tasks, 4)]
    instances, tours = instances[rows], tours[rows]
    length = (tours > 0).sum(1, keepdim=True)
    steps = th.arange(tours.shape[1], device=tours.device)
    backwards = tours.gather(1, th.where(steps < length, length - 1 - steps, steps))
    is_backwards = th.from_numpy(rng.random((len(rows), 1)) < 0.5)
    tours = th.where(is_backwards, backwards, tours)
    if not instances.has_equal_uavs:
        instances = _with_ends_exchanged(instances, is_backwards)
    n_steps = int(length.max()) + 1
    tours = functional.pad(tours, (0, max(n_steps - tours.shape[1], 0)))[:, :n_steps]
    return Lesson(turn(instances, th.from_numpy(rng.uniform(0, 2 * math.pi, len(rows)))), tours)


def _with_ends_exchanged(instances: Instances, rows: th.Tensor) -> Instances:
    """
    :param instances: ``batch`` single-UAV instances
    :param rows: ``(batch, 1)`` bool
    :return: The instances, in these rows with the end as start and the start as end
    """
    start, end = instances.uav_start, instances.uav_end
    exchanged = rows[..., None]
    return replace(instances, start=th.where(exchanged, end, start), end=th.where(exchanged, start, end))
