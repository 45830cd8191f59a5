"""
What hostile and busy clients do to ``sb3-uav serve``: 10^4 fuzzed uploads, a body of 1 GB, a CSV of 10^6 rows, 50 solves
at one time. Prints what was answered and the memory of the server and its workers; ends with 1 after any 500.

    python benchmarks/web_load.py --uploads 10000
"""

from __future__ import annotations

import argparse
import collections
import http.client
import json
import random
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_NAMES = ("a.csv", "a.json", "a.geojson", "a.plan", "a.waypoints", "a.npz", "a.txt", "a.oplib", "a.tsv", "a")
_SEEDS = (
    b"id,lat,lon,value,depot\nbase,47.0,8.0,1,yes\na,47.01,8.0,2,\nb,47.0,8.01,3,\n",
    b"id;x;y;service_s\na;1,5;2;3\nb;4;5;6\n",
    b'{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"id":"a"},'
    b'"geometry":{"type":"Point","coordinates":[8.0,47.0]}}]}',
    b'{"fileType":"Plan","version":1,"groundStation":"QGroundControl","mission":{"version":2,"items":[{"type":"SimpleItem",'
    b'"command":16,"frame":3,"params":[0,0,0,null,47.0,8.0,50]}],"plannedHomePosition":[47,8,400]}}',
    b"QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t47.0\t8.0\t400\t1\n1\t0\t3\t16\t0\t0\t0\t0\t47.01\t8.0\t50\t1\n",
    b"n 4\nm 2\ntmax 10\n0 0 0\n1 1 5\n2 2 5\n0 0 0\n",
    b'{"format":"sb3-uav mission","version":1,"system":"plane","meters_per_unit":1,"depot":[0,0],"source":"a","tasks":'
    b'[{"id":"a","point":[1,2],"value":1,"service_s":0,"must":false,"altitude_m":null}],"fleet":[],"routes":[]}',
)
_PIECES = (
    b"NaN", b"Infinity", b"-1e999", b"1" * 400, b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"[" * 5000, b'{"a":' * 3000, b"true",
    b"\r\n", b'"', b",,,,", b"'; DROP TABLE", b"<script>", b"../../", b"91", b"181", b"\xe2\x80\xae", b"a" * 100_000,
    b"\\ud800", b"null",
)  # fmt: skip
_JSON_BODIES = ("/api/v1/solves", "/session", "/login")


def main() -> int:
    """:return: Exit code"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uploads", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clients", type=int, default=4)
    args = parser.parse_args()
    command = [sys.executable, "-m", "sb3_uav", "serve", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            found = re.search(r":(\d+)", server.stdout.readline().partition("//")[2])
            assert found is not None
            return _try_all(Client(int(found[1])), server.pid, args)
        finally:
            server.terminate()


class Client:
    """
    :param port: Port of the server
    """

    def __init__(self, port: int) -> None:
        self.port = port

    def ask(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> tuple[int, Any]:
        """:return: Status and content of the answer"""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        try:
            connection.request(method, path, body, headers or {}, encode_chunked=isinstance(body, Iterator))
            answer = connection.getresponse()
            content = answer.read()
            return answer.status, json.loads(content) if content else None
        finally:
            connection.close()


def _try_all(client: Client, server: int, args: argparse.Namespace) -> int:
    while not client.ask("GET", "/api/v1/limits")[1]["ready"]:
        time.sleep(0.1)
    print(f"at rest: {_memory(server)}")
    statuses = _fuzz(client, args.uploads, args.seed, args.clients)
    print(f"{args.uploads} fuzzed uploads: {dict(sorted(statuses.items()))}; {_memory(server)}")
    _timed(
        "1 GB announced", lambda: client.ask("POST", "/api/v1/tasks?name=a.csv", b"", {"content-length": str(2**30)}), server
    )
    _timed("1 GB in chunks", lambda: _chunked(client), server)
    rows = b"id,x,y\n" + b"".join(b"%d,%d,%d\n" % (row, row % 1000, row // 1000) for row in range(10**6))
    _timed(f"10^6 rows, {len(rows) / 2**20:.0f} MiB", lambda: client.ask("POST", "/api/v1/tasks?name=a.csv", rows), server)
    short = b"x,y\n" + b"1,2\n" * 10**6
    _timed(
        f"10^6 short rows, {len(short) / 2**20:.0f} MiB", lambda: client.ask("POST", "/api/v1/tasks?name=a.csv", short), server
    )
    _fifty(client, server)
    return int(any(status >= 500 for status in statuses))


def _fuzz(client: Client, uploads: int, seed: int, clients: int) -> collections.Counter[int]:
    statuses: collections.Counter[int] = collections.Counter()

    def work(number: int) -> None:
        rng = random.Random(f"{seed} {number}")
        for _ in range(uploads // clients):
            data = bytearray(rng.choice(_SEEDS))
            for _ in range(rng.randint(0, 4)):
                place = rng.randrange(len(data) + 1)
                data[place : place + rng.choice((0, 0, 1, 5, 40))] = rng.choice((rng.choice(_PIECES), rng.randbytes(3)))
            is_json = rng.random() < 0.2
            name = rng.choice(_NAMES)
            path = rng.choice(_JSON_BODIES) if is_json else f"/api/v1/tasks?name={name}"
            kind = {"content-type": "application/json" if is_json else "application/octet-stream"}
            method = "PUT" if path == "/session" else "POST"
            status, answer = client.ask(method, path, bytes(data), kind)
            if status >= 500 or "fault of the program" in str(answer):
                print(f"  {status} {answer} from {path} {bytes(data)[:300]!r}")
                status = 500
            statuses[status] += 1

    threads = [threading.Thread(target=work, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return statuses


def _chunked(client: Client) -> tuple[int, Any]:
    sent = [0]

    def blocks() -> Iterator[bytes]:
        while sent[0] < 2**30:
            sent[0] += 2**16
            yield b"x" * 2**16

    try:
        return client.ask("POST", "/api/v1/tasks?name=a.csv", blocks())
    except OSError as error:
        return 413, f"{type(error).__name__} after {sent[0] / 2**20:.0f} MiB"


def _fifty(client: Client, server: int) -> None:
    rng = random.Random(0)
    tasks = [{"id": str(task), "point": [rng.uniform(0, 1e4), rng.uniform(0, 1e4)]} for task in range(1000)]
    body = json.dumps(
        {
            "tasks": {"system": "plane", "depot": [5e3, 5e3], "tasks": tasks},
            "fleet": {"count": 10, "range_m": 2e4},
            "options": {"time_limit": 2},
        }
    ).encode()
    found: list[tuple[int, Any]] = []
    threads = [
        threading.Thread(
            target=lambda: found.append(client.ask("POST", "/api/v1/solves", body, {"content-type": "application/json"}))
        )
        for _ in range(50)
    ]
    start = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    statuses = dict(collections.Counter(status for status, _ in found))
    print(f"50 solves of 1000 tasks: {statuses} in {time.monotonic() - start:.1f} s")
    print(f"  {next((answer['detail'] for status, answer in found if status != 202), 'none refused')}")
    peak = 0
    for _, answer in [entry for entry in found if entry[0] == 202]:
        while client.ask("GET", f"/api/v1/solves/{answer['id']}")[1]["state"] in ("waiting", "running"):
            peak = max(peak, _resident(server))
            time.sleep(0.3)
    print(f"  all done after {time.monotonic() - start:.0f} s; peak {peak / 1024:.0f} MiB; now {_memory(server)}")


def _timed(what: str, call: Callable[[], tuple[int, Any]], server: int) -> None:
    start = time.monotonic()
    status, answer = call()
    print(f"{what}: {status} {answer} in {time.monotonic() - start:.2f} s; {_memory(server)}")


def _family(pid: int) -> list[int]:
    children = [int(child) for file in Path(f"/proc/{pid}/task").glob("*/children") for child in file.read_text().split()]
    return [pid, *(found for child in children for found in _family(child))]


def _proportional(pid: int) -> int:
    """Its share of memory in KiB: pages that several processes have are divided among them."""
    found = re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
    return int(found[1]) if found else 0


def _resident(pid: int) -> int:
    return sum(_proportional(member) for member in _family(pid))


def _memory(pid: int) -> str:
    return f"server {_proportional(pid) / 1024:.0f} MiB, all processes {_resident(pid) / 1024:.0f} MiB"


if __name__ == "__main__":
    sys.exit(main())
