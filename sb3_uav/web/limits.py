"""What one server admits."""

from __future__ import annotations

from dataclasses import dataclass

#: The most that may be configured, whatever the command line says.
MOST_TASKS = 20_000
MOST_UAVS = 100


@dataclass(frozen=True)
class Limits:
    """
    :param max_tasks: Tasks of one problem
    :param max_uavs: UAVs of one problem
    :param max_body_mb: Size of one request in MiB
    :param max_solves: Solves that run at one time
    :param max_waiting: Solves that wait for their turn
    :param max_seconds: Time limit of one solve
    :param max_kept: Finished solves that are kept; the oldest are dropped
    :param max_sessions: Browsers whose work is kept; the one that was not used for longest is dropped
    :param max_bodies: Requests whose bodies are read at one time
    :param desk_seconds: Time for reading one file or writing one zip
    :raises ValueError: If a limit is not allowed
    """

    max_tasks: int = 2_000
    max_uavs: int = MOST_UAVS
    max_body_mb: float = 16.0
    max_solves: int = 1
    max_waiting: int = 16
    max_seconds: float = 120.0
    max_kept: int = 32
    max_sessions: int = 64
    max_bodies: int = 8
    desk_seconds: float = 60.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("max_tasks", 1, MOST_TASKS),
            ("max_uavs", 1, MOST_UAVS),
            ("max_body_mb", 0.001, 1024),
            ("max_solves", 1, 64),
            ("max_waiting", 0, 1000),
            ("max_seconds", 0.1, 86_400),
            ("max_kept", 1, 1000),
            ("max_sessions", 1, 10_000),
            ("max_bodies", 1, 100),
            ("desk_seconds", 1, 3600),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name):g}; give a number from {low:g} to {high:g}.")

    @property
    def max_body_bytes(self) -> int:
        return int(self.max_body_mb * 2**20)
