"""Jobs for the workers: a bounded queue, results as they come, cancel, and ends that harm nobody."""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from typing import Any, Literal

from sb3_uav.web.workers import Worker, receive_message, send_message

State = Literal["waiting", "running", "done", "failed", "canceled"]
#: What a plan consists of, in this order, see :func:`~sb3_uav.web.plan_view.plan_parts`.
PARTS = ("mission", "report", "geojson")
_MOST_POINTS = 500
_TICK = 0.2
# A worker that is gone, or whose message is none: nothing of this may end the thread that looks after a worker.
_UNREADABLE = (EOFError, OSError, ValueError, KeyError, TypeError, MemoryError)


class BusyError(Exception):
    """The queue is full."""


@dataclass(eq=False)
class Job:
    """
    :param request: Plain data for :func:`~sb3_uav.web.work.do`
    :param blocks: Bytes that go with it; dropped when the job has ended
    :param seconds: After this time in a worker, the worker is stopped
    :param about: What the server keeps with it
    """

    request: dict[str, Any]
    blocks: list[bytes]
    seconds: float
    about: dict[str, Any] = field(default_factory=dict)
    id: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    state: State = "waiting"
    error: str | None = None
    version: int = 0
    message: dict[str, Any] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    history: list[tuple[float, float]] = field(default_factory=list)
    started: float | None = None
    ended: float | None = None
    cancel: bool = False
    over: threading.Event = field(default_factory=threading.Event)

    @property
    def elapsed(self) -> float:
        """Seconds in a worker."""
        return 0.0 if self.started is None else (self.ended or time.monotonic()) - self.started

    def take(self, message: dict[str, Any], parts: list[bytes]) -> None:
        """Keep a result, an early or the last one."""
        self.message, self.parts = message, parts
        self.version += 1
        if "objective" in message and len(self.history) < _MOST_POINTS:
            self.history.append((round(self.elapsed, 2), message["objective"]))

    def end(self, state: State, error: str | None = None) -> None:
        self.state, self.error, self.ended = state, error, time.monotonic()
        self.blocks = []
        self.version += 1
        self.over.set()


class Pool:
    """
    Workers and the queue in front of them. Safe to use from any thread.

    :param size: Workers
    :param max_waiting: Jobs that may wait
    :param max_kept: Jobs that are kept after their end
    :param what: What the jobs are, for sentences
    """

    def __init__(self, size: int, max_waiting: int, max_kept: int, what: str) -> None:
        self._what, self._max_waiting, self._max_kept = what, max_waiting, max_kept
        self._queue: deque[Job] = deque()
        self._jobs: OrderedDict[str, Job] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False
        self.workers: list[Worker | None] = [None] * size
        self._ready = [False] * size
        self.start_error: str | None = None
        self._pause = 1.0
        self._threads = [threading.Thread(target=self._serve, args=(slot,), daemon=True) for slot in range(size)]

    def open(self) -> None:
        """Start the workers. Jobs that are given before wait."""
        for thread in self._threads:
            thread.start()

    @property
    def is_ready(self) -> bool:
        """Whether a worker has been warmed up."""
        return any(self._ready)

    @property
    def n_waiting(self) -> int:
        return len(self._queue)

    @property
    def n_running(self) -> int:
        with self._changed:
            return sum(job.state == "running" for job in self._jobs.values())

    def submit(self, job: Job) -> Job:
        """
        :param job: A new job
        :return: The same
        :raises BusyError: If too many wait
        """
        with self._changed:
            free = len(self.workers) - sum(found.state == "running" for found in self._jobs.values())
            if self._closed or len(self._queue) >= self._max_waiting + max(free, 0):
                raise BusyError(
                    f"{len(self._queue)} {self._what} wait already, which is all that this server admits; try again later."
                )
            self._queue.append(job)
            self._jobs[job.id] = job
            self._drop_oldest()
            self._changed.notify()
        return job

    def get(self, name: str) -> Job | None:
        """:return: The job of this id, if it is still kept"""
        return self._jobs.get(name)

    def place(self, job: Job) -> int | None:
        """:return: How many jobs come before this one; None if it does not wait"""
        with self._changed:
            return self._queue.index(job) if job in self._queue else None

    def cancel(self, job: Job) -> None:
        """Take a job out of the queue, or stop the worker that does it. What it has found is kept."""
        with self._changed:
            if job in self._queue:
                self._queue.remove(job)
                job.end("canceled")
            else:
                job.cancel = True

    def close(self) -> None:
        """End all processes and threads."""
        with self._changed:
            self._closed = True
            for job in self._queue:
                job.end("canceled")
            self._queue.clear()
            self._changed.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(10.0)

    def _drop_oldest(self) -> None:
        ended = [name for name, job in self._jobs.items() if job.over.is_set()]
        for name in ended[: max(len(ended) - self._max_kept, 0)]:
            del self._jobs[name]

    def _serve(self, slot: int) -> None:
        """What the thread of a worker does."""
        worker = None
        while not self._closed:
            if worker is None:
                worker = self._start(slot)
                continue
            with self._changed:
                if not self._queue:
                    self._changed.wait(_TICK)
                job = self._queue.popleft() if self._queue and not self._closed else None
                if job is not None:
                    job.state, job.started = "running", time.monotonic()
                    job.version += 1
            if job is None:
                if not worker.process.is_alive():
                    self._stop(slot, worker)
                    worker = None
                continue
            if not self._run(worker, job):
                self._stop(slot, worker)
                worker = None
            with self._changed:
                self._drop_oldest()
        if worker is not None:
            self._stop(slot, worker)

    def _start(self, slot: int) -> Worker | None:
        try:
            worker = self.workers[slot] = Worker()
        except (EOFError, OSError) as error:
            # EOFError: the process that workers are forked from has just been killed; the next try starts it again.
            self.start_error = f"A worker cannot be started ({error})."
            self._wait_longer()
            return None
        while not self._closed:
            ready = wait(worker.waitable, _TICK)
            if worker.connection in ready:
                try:
                    message, _ = receive_message(worker.connection)
                except _UNREADABLE:
                    break
                if message["event"] != "ready":
                    self.start_error = message["error"]
                    break
                self._ready[slot] = True
                self.start_error, self._pause = None, 1.0
                return worker
            if ready:
                break
        if not self._closed:
            self.start_error = self.start_error or "A worker ended while it was started; see the output of the server."
            self._wait_longer()
        self._stop(slot, worker)
        return None

    def _wait_longer(self) -> None:
        """What cannot be started now may never be; do not try it all the time."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed, self._pause)
        self._pause = min(2 * self._pause, 60.0)

    def _stop(self, slot: int, worker: Worker) -> None:
        self._ready[slot] = False
        worker.end()
        self.workers[slot] = None

    def _run(self, worker: Worker, job: Job) -> bool:
        """:return: Whether the worker can do another job"""
        try:
            send_message(worker.connection, job.request, job.blocks)
            while True:
                if job.cancel or self._closed:
                    job.end("canceled")
                    return False
                if job.elapsed > job.seconds:
                    job.end("failed", f"This took longer than {job.seconds:g} s and was stopped.")
                    return False
                ready = wait(worker.waitable, _TICK)
                if worker.connection in ready:
                    message, parts = receive_message(worker.connection)
                    event = message.pop("event")
                    if event in ("refused", "broken"):
                        job.end("failed", message["error"])
                        return True
                    job.take(message, parts)
                    if event == "done":
                        job.end("done")
                        return True
                elif ready:
                    break
        except _UNREADABLE:
            pass
        worker.process.join(1.0)
        code = worker.process.exitcode
        job.end("failed", f"The process that worked on this ended unexpectedly (exit code {code}); nothing else is affected.")
        return False
