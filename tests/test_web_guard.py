"""Who may ask the served planner: tokens, names of the server, other sites; and that no input breaks it."""

from __future__ import annotations

import json
import multiprocessing
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from web_server import Served, problem, served

from sb3_uav.cli.main import main
from sb3_uav.cli.serve import _checked_tiles, _checked_token
from sb3_uav.web.limits import Limits
from sb3_uav.web.workers import send_message

for module in ("fastapi", "uvicorn", "pyproj", "numba"):
    pytest.importorskip(module)

TOKEN = "a-token-of-these-tests"
LIMITS = "/api/v1/limits"


@pytest.fixture(scope="module")
def server():
    with served(token=TOKEN, tiles="https://tiles.example.org/{z}/{x}/{y}.png", max_waiting=1, max_body_mb=0.2) as found:
        yield found


def bearer(token: str = TOKEN) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


def test_nothing_without_the_token(server: Served):
    for method, path in [("GET", LIMITS), ("POST", "/api/v1/solves"), ("GET", "/session"), ("GET", "/api/v1/openapi.json")]:
        answer = server.ask(method, path, problem() if method == "POST" else None)
        assert answer.status == 401 and "Authorization: Bearer TOKEN" in answer.detail
        assert server.ask(method, path, problem() if method == "POST" else None, bearer(TOKEN + "x")).status == 401
    assert server.ask("GET", "/").headers["location"] == "/login"
    assert server.ask("GET", LIMITS, headers=bearer()).status == 200


def test_login_gives_a_cookie_that_scripts_cannot_read(server: Served):
    assert server.ask("POST", "/login", {"token": "wrong"}).status == 403
    assert server.ask("GET", "/login").status == server.ask("GET", "/static/login.js").status == 200
    cookie = server.ask("POST", "/login", {"token": TOKEN}).headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    value = cookie.partition(";")[0]
    assert TOKEN not in value
    assert server.ask("GET", LIMITS, headers={"cookie": value}).status == 200
    assert server.ask("GET", LIMITS, headers={"cookie": value[:-1]}).status == 401


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 202),
        ({"origin": "http://127.0.0.1:{port}"}, 202),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "http://127.0.0.1:1"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": "http://["}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"sec-fetch-site": "same-site"}, 403),
        ({"host": "evil.example"}, 421),
        ({"host": "127.0.0.1.evil.example"}, 421),
        ({"host": ""}, 421),
        ({"host": "localhost:{port}"}, 202),
        ({"host": "[::1]:{port}"}, 202),
    ],
)
def test_other_sites_cannot_send_anything(server: Served, headers, status):
    filled = {name: value.format(port=server.port) for name, value in headers.items()}
    answer = server.ask("POST", "/api/v1/solves", problem(time_limit=0.1), {**bearer(), **filled})
    assert answer.status == status, answer
    if status == 202:
        server.ask("DELETE", f"/api/v1/solves/{answer.json['id']}", headers=bearer())


def test_every_answer_tells_browsers_what_is_allowed(server: Served):
    for path in ("/login", "/static/app.js", LIMITS, "/nothing"):
        headers = server.ask("GET", path, headers=bearer()).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
        assert "img-src 'self' data: https://tiles.example.org;" in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


def test_a_request_has_one_end(server: Served):
    head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
    first = f"POST /login HTTP/1.1\r\n{head}Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as client:
        client.sendall(f"{first}GET {LIMITS} HTTP/1.1\r\n{head}\r\n".encode())
        answers = b"".join(iter(lambda: client.recv(65_536), b""))
    assert answers.startswith(b"HTTP/1.1 400") and answers.count(b"HTTP/1.1") == 1


def test_strangers_cannot_take_the_places_of_others(server: Served):
    assert server.ask("POST", "/login", {"token": "x" * 5000}).status == 413
    begun = f"POST /login HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: 100\r\n\r\n".encode()
    with ExitStack() as stack:
        for _ in range(8):
            client = stack.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            client.sendall(begun)
        time.sleep(0.2)
        assert server.ask("PUT", "/session", {"tasks": problem()["tasks"]}, bearer()).status == 200


def test_paths_stay_in_the_folder(server: Served):
    for path in ("/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "/static//etc/passwd"):
        assert server.ask("GET", path, headers=bearer()).status == 404


def test_sessions_are_kept_apart(server: Served):
    draft = {"tasks": problem()["tasks"], "form": {"count": "7"}}
    first = server.ask("PUT", "/session", draft, bearer())
    cookie = first.headers["set-cookie"].partition(";")[0]
    mine = server.ask("GET", "/session", headers={**bearer(), "cookie": cookie})
    assert mine.json["form"] == {"count": "7"} and len(mine.json["tasks"]["tasks"]) == 12
    assert server.ask("GET", "/session", headers=bearer()).json is None
    assert server.ask("PUT", "/session", {**draft, "form": {"a": "x" * 201}}, bearer()).status == 422


def test_sessions_keep_no_more_tasks_than_can_be_solved():
    pytest.importorskip("httpx")
    from fastapi.testclient import TestClient

    from sb3_uav.web.app import Settings, create_app

    client = TestClient(create_app(Settings(Limits(max_tasks=11))), base_url="http://127.0.0.1")
    answer = client.put("/session", json={"tasks": problem()["tasks"]})
    assert answer.status_code == 422 and "admits 11 tasks" in answer.json()["detail"]
    assert client.put("/session", json={"tasks": problem(11)["tasks"]}).status_code == 200


@pytest.mark.parametrize("text", [b"no JSON", b"[]", b'{"blocks": 0}'])
def test_a_worker_that_sends_nonsense_is_replaced(text):
    from sb3_uav.web.jobs import Job, Pool

    ours, theirs = multiprocessing.Pipe()
    process = SimpleNamespace(join=lambda _: None, exitcode=None, sentinel=theirs)
    job = Job({"kind": "solve"}, [], 10.0)
    with ours, theirs:
        theirs.send_bytes(text)
        worker: Any = SimpleNamespace(connection=ours, waitable=[ours], process=process)
        assert not Pool(1, 1, 1, "solves")._run(worker, job)
    assert job.state == "failed" and "ended unexpectedly" in str(job.error)


def test_a_killed_fork_server_ends_no_thread(monkeypatch):
    from sb3_uav.web import jobs

    def killed() -> None:
        raise EOFError("unexpected EOF")

    monkeypatch.setattr(jobs, "Worker", killed)
    pool = jobs.Pool(1, 1, 1, "solves")
    pool._pause = 0.0
    assert pool._start(0) is None and "cannot be started" in str(pool.start_error)


def test_oldest_sessions_are_dropped():
    from sb3_uav.web.sessions import Sessions

    sessions = Sessions(2)
    old, other = sessions.save("", b"old"), sessions.save("", b"other")
    assert sessions.save(old, b"new") == old
    # The one that was not used for longest goes; its id is not taken over by whoever shows it.
    sessions.save("", b"third")
    assert (sessions.load(old), sessions.load(other)) == (b"new", None)
    assert sessions.save(other, b"x") != other


JUNK = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(10**40), 10**40) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@st.composite
def broken_problems(draw):
    """The usual problem, with junk somewhere."""
    body = problem(n_tasks=3, time_limit=0.1)
    target = body
    while True:
        keys = list(target) if isinstance(target, dict) else list(range(len(target)))
        key = draw(st.sampled_from(keys))
        if draw(st.booleans()) and isinstance(target[key], dict | list) and target[key]:
            target = target[key]
        else:
            target[key] = draw(JUNK)
            return body


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(body=broken_problems())
def test_junk_in_a_problem_is_refused(server: Served, body):
    answer = server.ask("POST", "/api/v1/solves", body, bearer())
    assert answer.status in (202, 422, 429), answer
    if answer.status == 202:
        server.ask("DELETE", f"/api/v1/solves/{answer.json['id']}", headers=bearer())
    else:
        assert "\n" not in answer.detail


NAMES = st.sampled_from(["a.csv", "a.json", "a.geojson", "a.plan", "a.waypoints", "a.npz", "a.txt", "a.oplib", "a", "a.exe"])
STARTS = st.sampled_from(
    [
        b"",
        b"id,lat,lon\n",
        b"id;x;y\na;1;2\n",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"QGC WPL 110\n",
        b"PK\x03\x04",
        b'{"fileType":"Plan"',
        b"n 3\nm 2\ntmax 5\n",
    ]
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=NAMES, start=STARTS, rest=st.binary(max_size=200) | JUNK.map(lambda data: json.dumps(data).encode()))
def test_junk_in_a_file_is_refused(server: Served, name, start, rest):
    answer = server.ask("POST", f"/api/v1/tasks?name={name}", start + rest, bearer())
    assert answer.status in (200, 422), answer
    if answer.status == 422:
        assert "\n" not in answer.detail and "fault of the program" not in answer.detail, answer


def test_another_address_needs_a_token(capsys):
    assert main(["serve", "--host", "0.0.0.0"]) == 2
    assert "--host is 0.0.0.0, which others can reach; give a --token" in capsys.readouterr().err
    assert main(["serve", "--token", "short"]) == 2
    assert main(["serve", "--tiles", "ftp://x/{z}"]) == 2
    assert main(["serve", "--max-tasks", "0"]) == 2
    assert _checked_token(TOKEN, "0.0.0.0") == TOKEN
    assert _checked_token(None, "127.0.0.1") is _checked_token(None, "localhost") is None
    with pytest.raises(ValueError, match="give a --token"):
        _checked_token(None, "::")
    # It becomes a part of a header.
    with pytest.raises(ValueError, match="tiles is"):
        _checked_tiles("https://x; script-src */{z}/{x}/{y}")


def test_without_the_extra(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert main(["serve", "--port", "0"]) == 2
    assert "[web]" in capsys.readouterr().err


def test_workers_that_cannot_start_are_explained(monkeypatch):
    from sb3_uav.web import jobs
    from sb3_uav.web.jobs import Job, Pool

    class Broken:
        """A worker that says what it lacks, and ends."""

        def __init__(self):
            self.connection, theirs = multiprocessing.Pipe()
            send_message(theirs, {"event": "broken", "error": "numba is missing"}, [])
            theirs.close()
            self.waitable = [self.connection]

        def end(self):
            self.connection.close()

    monkeypatch.setattr(jobs, "Worker", Broken)
    pool = Pool(1, 4, 4, "solves")
    job = pool.submit(Job({}, [], 1.0))
    pool.open()
    try:
        until = time.monotonic() + 20
        while pool.start_error is None and time.monotonic() < until:
            time.sleep(0.01)
        assert pool.start_error == "numba is missing"
        assert (job.state, pool.is_ready) == ("waiting", False)
    finally:
        pool.close()
    assert job.state == "canceled"


def family(pid: int) -> list[int]:
    children = [int(child) for file in Path(f"/proc/{pid}/task").glob("*/children") for child in file.read_text().split()]
    return [pid, *(member for child in children for member in family(child))]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="no /proc")
@pytest.mark.usefixtures("ctrl_c_works")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_behind(end):
    command = [sys.executable, "-m", "sb3_uav", "serve", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline().partition("//127.0.0.1:")[2].partition(" ")[0])
            server = Served(None, port)
            name = server.solve(time_limit=60)
            server.wait(name, "running", with_plan=True)
            members = family(process.pid)
            assert len(members) >= 4
        finally:
            process.send_signal(end)
        assert process.wait(30) == (130 if end == signal.SIGINT else -9)
        assert process.stderr is not None
        if end == signal.SIGINT:
            assert process.stderr.read().splitlines()[-1:] == ["sb3-uav serve: interrupted"]
    until = time.monotonic() + 20
    while left := [pid for pid in members if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < until, left
        time.sleep(0.05)


def test_a_port_in_use_is_one_line(server: Served, capsys):
    assert main(["serve", "--port", str(server.port)]) == 2
    assert "cannot listen there" in capsys.readouterr().err
