"""A served planner on a free port of this machine, for tests."""

from __future__ import annotations

import http.client
import json
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_uav.web.limits import Limits

if TYPE_CHECKING:
    from sb3_uav.web.api import Rooms

# Where nothing is compiled yet, the first server takes a minute or two.
_PATIENCE = 300.0
JSON = {"content-type": "application/json"}


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def detail(self) -> str:
        """The sentence of an error."""
        return str(self.json["detail"])


class Served:
    """
    :ivar rooms: The pools of the server; None if it is another process
    :ivar port: Its port
    """

    def __init__(self, rooms: Rooms | None, port: int) -> None:
        self.rooms, self.port = rooms, port

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def ask(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None, **kwargs: Any) -> Answer:
        """
        :param method: Of the request
        :param path: Of the request
        :param body: Bytes, or data for JSON
        :param headers: Of the request
        :return: What the server answers
        """
        given = dict(headers or {})
        if body is not None and not hasattr(body, "__next__") and not isinstance(body, bytes):
            body, given = json.dumps(body).encode(), {**JSON, **given}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=_PATIENCE)
        try:
            connection.request(method, path, body, given, **kwargs)
            found = connection.getresponse()
            return Answer(found.status, {name.lower(): value for name, value in found.getheaders()}, found.read())
        finally:
            connection.close()

    def solve(self, **options: Any) -> str:
        """:return: Id of a solve that has been started"""
        answer = self.ask("POST", "/api/v1/solves", problem(**options))
        assert answer.status == 202, answer
        return str(answer.json["id"])

    def wait(self, name: str, *states: str, with_plan: bool = False) -> dict[str, Any]:
        """
        :param name: Id of a solve
        :param states: States to wait for; those at the end of a solve when there are none
        :param with_plan: Whether to wait for a plan, too
        :return: Where the solve stands then
        """
        wanted = states or ("done", "failed", "canceled")
        until = time.monotonic() + _PATIENCE
        while time.monotonic() < until:
            found: dict[str, Any] = self.ask("GET", f"/api/v1/solves/{name}").json
            if found["state"] in wanted and (found["has_plan"] or not with_plan):
                return found
            assert found["state"] in ("waiting", "running"), found
            time.sleep(0.02)
        raise AssertionError(f"still {found}")


def problem(n_tasks: int = 12, time_limit: float = 0.3, **changes: Any) -> dict[str, Any]:
    """
    :param n_tasks: Number of tasks
    :param time_limit: Seconds
    :param changes: Other parts of the problem
    :return: A body for POST /api/v1/solves
    """
    rng = random.Random(n_tasks)
    tasks = [
        {"id": f"t{task}", "point": [round(rng.uniform(0, 1000)), round(rng.uniform(0, 1000))], "value": rng.randint(1, 5)}
        for task in range(n_tasks)
    ]
    return {
        "tasks": {"system": "plane", "depot": [500, 500], "tasks": tasks},
        "fleet": {"count": 2, "range_m": 2500},
        "options": {"time_limit": time_limit},
        **changes,
    }


@contextmanager
def served(token: str | None = None, tiles: str | None = None, **limits: Any) -> Iterator[Served]:
    """
    A server in a thread of this process, with worker processes of its own. At the end of the block all of them have ended.

    :param token: As of :class:`~sb3_uav.web.app.Settings`
    :param tiles: As of :class:`~sb3_uav.web.app.Settings`
    :param limits: As of :class:`~sb3_uav.web.limits.Limits`
    """
    import uvicorn

    from sb3_uav.web.app import Settings, create_app

    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        app = create_app(Settings(Limits(**limits), token, (), port, tiles))
        rooms: Rooms = app.state.rooms
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", ws="none", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        processes = []
        try:
            until = time.monotonic() + _PATIENCE
            while not (server.started and rooms.solves.is_ready and rooms.desk.is_ready):
                assert thread.is_alive() and time.monotonic() < until, rooms.solves.start_error
                time.sleep(0.02)
            yield Served(rooms, port)
            processes = [worker.process for pool in (rooms.solves, rooms.desk) for worker in pool.workers if worker]
        finally:
            server.should_exit = True
            thread.join(_PATIENCE)
        assert not any(process.is_alive() for process in processes)
