"""A good start for the router: imitation of the tours that local search finds for the subsets of an allocator."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th
from torch.nn import functional

from sb3_uav.common.random_streams import torch_generator
from sb3_uav.envs.allocation import split_tasks
from sb3_uav.envs.generators import InstanceGenerator, training_batch
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule
from sb3_uav.envs.symmetries import turn
from sb3_uav.local_search.search import LocalSearch
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.training.imitation_progress import ImitationProgress, Lesson

# A batch holds as many subsets of so many tasks as it is said to have; of larger ones fewer.
TYPICAL_SIZE = 30
# Trials of the search per task: with 12, tours had 99 % of the tasks that 25 times as long a search found.
TRIALS_PER_TASK = 12
WARM_UP = 50
LAST_RATE = 0.02
MAX_GRAD_NORM = 1.0
REPORT_EVERY = 250
# After so many updates, and so many tours, progress is saved.
SAVE_EVERY = 500
CHUNK_SIZE = 10_000


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
) -> None:
    """
    Train a router on the tours of local search, by the likelihood of their moves.

    The subsets are what the allocator gives to the UAVs when it is sampled; it may be untrained. Every tour is shown in both
    directions and turned around the depot by any angle.

    :param router: The policy to train, in place
    :param allocator: Splits the tasks
    :param generator: Draws the instances; all values should be equal, as a tour that ends early is not understood
    :param rng: The source of all randomness
    :param n_subsets: How many subsets to search tours for
    :param n_updates: How many gradient steps to take; the rate rises for a few, then falls like a cosine
    :param batch_size: Subsets of an update, if they have 30 tasks; of larger ones it takes fewer
    :param learning_rate: The highest rate of Adam
    :param report: Is told how far it is
    :param folder: Where to keep the progress; what is there is gone on from, with the same result as without an interruption
        if everything else is the same
    :raises ImportError: If numba is not installed
    :raises OSError: If the progress cannot be written
    :raises ValueError: If a number is not above 0, or the folder holds the progress of other settings or damaged files
    """
    for name, value in (("n_subsets", n_subsets), ("n_updates", n_updates), ("batch_size", batch_size)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} is {value!r}; it must be a whole number of at least 1.")
    if not learning_rate > 0:
        raise ValueError(f"learning_rate is {learning_rate}; it must be above 0.")
    settings = dict(n_subsets=n_subsets, n_updates=n_updates, batch_size=batch_size, learning_rate=learning_rate)
    progress = None if folder is None else ImitationProgress(Path(folder), settings)
    lessons = search_lessons(allocator, generator, rng, n_subsets, batch_size, report, progress)
    optimizer = th.optim.Adam(router.parameters(), learning_rate)
    n_done = 0 if progress is None else progress.restore_updates(router, optimizer, rng)
    if n_done > 0:
        report(f"imitation: goes on after {n_done} of {n_updates} updates")
    start, total, n_moves = time.perf_counter(), th.zeros((), dtype=th.float32, device=router.device), 0
    router.set_training_mode(True)
    for update in range(n_done + 1, n_updates + 1):
        cosine = 0.5 * (1 + math.cos(math.pi * update / n_updates))
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * min(1.0, update / WARM_UP) * (LAST_RATE + (1 - LAST_RATE) * cosine)
        lesson = varied(lessons[int(rng.integers(len(lessons)))], rng, batch_size)
        lesson = Lesson(lesson.instances.to(router.device), lesson.tours.to(router.device))
        is_move = lesson.tours > 0
        n_new = int(is_move.sum())
        log_prob = router.evaluate_episodes(lesson.instances, lesson.tours[:, None]).log_prob[:, 0]
        loss = -log_prob[is_move].sum() / max(n_new, 1)
        optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(router.parameters(), MAX_GRAD_NORM)
        optimizer.step()
        total, n_moves = total + n_new * loss.detach(), n_moves + n_new
        if update % REPORT_EVERY == 0 or update == n_updates:
            seconds, nats = time.perf_counter() - start, total.item() / max(n_moves, 1)
            report(f"imitation: {update} of {n_updates} updates, {nats:.3f} nats a move, {seconds:.0f} s")
            total, n_moves = th.zeros_like(total), 0
        if progress is not None and update % SAVE_EVERY == 0:
            progress.save_updates(update, router, optimizer, rng)
    router.set_training_mode(False)


def search_lessons(
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
    :param rng: The source of randomness
    :param n_subsets: How many subsets there shall be at least
    :param batch_size: As for :func:`imitate`
    :param report: Is told how far it is
    :param progress: Keeps what was found, and knows what was found before
    :return: Subsets of similar sizes, with tours
    """
    start = time.perf_counter()
    lessons = [] if progress is None else progress.restore_lessons(rng)
    n_found, n_saved = sum(len(lesson.tours) for lesson in lessons), len(lessons)
    allocator.set_training_mode(False)
    while n_found < n_subsets:
        instances = allocator.arrange(training_batch(generator, max(batch_size // 2, 1), rng))
        actions = torch_generator(rng, allocator.device)
        assignment = allocator.decode_episodes(instances.to(allocator.device), deterministic=False, generator=actions)
        subsets = split_tasks(instances, assignment.cpu()).instances
        n_rows = 2 * batch_size * TYPICAL_SIZE // subsets.n_tasks
        subsets = subsets[rng.permutation(len(subsets))[: max(n_rows, 4)]]
        subsets = subsets.trim(max(int(subsets.task_mask.sum(1).max()), 1))
        lessons.append(Lesson(subsets, good_tours(subsets)))
        before, n_found = n_found, n_found + len(subsets)
        if n_found // CHUNK_SIZE > before // CHUNK_SIZE or n_found >= n_subsets:
            report(f"imitation: {n_found} of {n_subsets} tours, {time.perf_counter() - start:.0f} s")
            if progress is not None:
                progress.save_lessons(lessons[n_saved:], rng)
                n_saved = len(lessons)
    return lessons


def good_tours(subsets: Instances) -> th.Tensor:
    """
    :param subsets: ``batch`` single-UAV instances
    :return: ``(batch, n_steps)`` int64 nodes, padded with the depot: tours that local search finds in some milliseconds
    """
    routes = []
    for row in range(len(subsets)):
        search = LocalSearch(subsets[row])
        n_trials = TRIALS_PER_TASK * int(subsets.task_mask[row].sum())
        routes.append([task + 1 for task in search.improve(Schedule([]), n_trials=n_trials).routes[0]])
    n_steps = 1 + max(map(len, routes))
    padded = [route + [0] * (n_steps - len(route)) for route in routes]
    return th.tensor(padded, dtype=th.int64, device="cpu")


def varied(lesson: Lesson, rng: np.random.Generator, batch_size: int) -> Lesson:
    """
    :param lesson: Subsets and tours
    :param rng: The source of randomness
    :param batch_size: As for :func:`imitate`
    :return: Some of them, half of them backwards, each turned around its depot
    """
    instances, tours = lesson
    rows = rng.permutation(len(instances))[: max(batch_size * TYPICAL_SIZE // instances.n_tasks, 4)]
    instances, tours = instances[rows], tours[rows]
    length = (tours > 0).sum(1, keepdim=True)
    steps = th.arange(tours.shape[1], device=tours.device)
    backwards = tours.gather(1, th.where(steps < length, length - 1 - steps, steps))
    tours = th.where(th.from_numpy(rng.random((len(rows), 1)) < 0.5), backwards, tours)
    n_steps = int(length.max()) + 1
    tours = functional.pad(tours, (0, max(n_steps - tours.shape[1], 0)))[:, :n_steps]
    return Lesson(turn(instances, th.from_numpy(rng.uniform(0, 2 * math.pi, len(rows)))), tours)
