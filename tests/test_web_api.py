"""The JSON API of the served planner: solves, the queue, limits, and what goes wrong."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import shlex
import signal
import zipfile
from pathlib import Path

import pytest
from web_server import Served, problem, served

from sb3_uav.cli.main import main
from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

for module in ("fastapi", "uvicorn", "pyproj", "plotly", "matplotlib", "numba"):
    pytest.importorskip(module)


@pytest.fixture(scope="module")
def server():
    with served(max_waiting=2, max_tasks=50, max_seconds=20.0, max_body_mb=1.0, max_kept=4) as found:
        yield found


def changed(**parts):
    """The usual problem with other parts, such as ``tasks__depot=None``."""
    body = problem()
    for path, value in parts.items():
        *where, last = path.split("__")
        target = body
        for name in where:
            target = target[int(name) if isinstance(target, list) else name]
        target[last] = value
    return body


def test_a_solve_from_tasks_to_a_zip(server: Served):
    name = server.solve()
    found = server.wait(name)
    assert (found["state"], found["error"], found["place"]) == ("done", None, None)
    assert found["objective"] == found["history"][-1][1] > 0
    from sb3_uav.web.answers import PlanOut

    plan = server.ask("GET", f"/api/v1/solves/{name}/plan").json
    assert plan["mission"]["format"] == "sb3-uav mission"
    report = PlanOut.model_validate(plan).report.model_dump()
    # Nothing is undescribed.
    assert set(report) == set(plan["report"])
    assert set(report["routes"][0]) == set(plan["report"]["routes"][0])
    report = plan["report"]
    assert report["objective"] == found["objective"]
    assert [route["stops"] for route in report["routes"]] == plan["mission"]["routes"]
    assert all(sum(route["legs_m"]) == pytest.approx(route["length_m"]) for route in report["routes"])
    served_tasks = {stop for route in report["routes"] for stop in route["stops"]}
    assert served_tasks.isdisjoint(skipped["id"] for skipped in report["skipped"])
    assert len(served_tasks) + len(report["skipped"]) == 12
    features = server.ask("GET", f"/api/v1/solves/{name}/routes.geojson").json["features"]
    assert {feature["geometry"]["type"] for feature in features} == {"LineString", "Point"}
    answer = server.ask("GET", f"/api/v1/solves/{name}/download?altitude_m=80")
    assert (answer.status, answer.headers["content-type"]) == (200, "application/zip")
    with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
        names = set(archive.namelist())
        assert {"mission/mission.json", "mission/routes.csv", "mission/map.html"} <= names
        assert json.loads(archive.read("mission/mission.json"))["routes"] == plan["mission"]["routes"]


def test_the_same_seed_gives_the_same_plan(server: Served):
    body = problem(options={"time_limit": 20.0, "seed": 3, "solver": "insertion"})
    names = [server.ask("POST", "/api/v1/solves", body).json["id"] for _ in range(2)]
    routes = [
        server.ask("GET", f"/api/v1/solves/{name}/plan").json["mission"]["routes"] for name in names if server.wait(name)
    ]
    assert routes[0] == routes[1] != [[], []]


def test_forbidden_tasks_are_left_out(server: Served):
    body = problem()
    body["tasks"]["tasks"][4]["forbidden"] = True
    name = server.ask("POST", "/api/v1/solves", body).json["id"]
    server.wait(name)
    report = server.ask("GET", f"/api/v1/solves/{name}/plan").json["report"]
    assert [one["id"] for one in report["skipped"] if one["reason"] == "forbidden"] == ["t4"]
    assert all("t4" not in route["stops"] for route in report["routes"])


def test_a_file_with_latitudes(server: Served):
    data = b"id;lat;lon;value;depot\nbase;47.0;8.0;;yes\na;47.01;8.0;2;\nb;47.0;8.01;3;\n"
    answer = server.ask("POST", "/api/v1/solves/from-file?name=field.csv&count=1&range_m=9000&time_limit=0.2", data)
    assert answer.status == 202, answer
    name = answer.json["id"]
    assert server.wait(name)["objective"] == 5
    # Longitude comes first in GeoJSON.
    features = server.ask("GET", f"/api/v1/solves/{name}/routes.geojson").json["features"]
    assert [8.0, 47.01] in [feature["geometry"]["coordinates"] for feature in features]
    read = server.ask("POST", "/api/v1/tasks?name=field.csv", data).json
    assert (read["depot"], [task["id"] for task in read["tasks"]]) == ([47.0, 8.0], ["a", "b"])
    # What was downloaded can be uploaded.
    mission = server.ask("GET", f"/api/v1/solves/{name}/plan").json["mission"]
    again = server.ask("POST", "/api/v1/tasks?name=mission.json", json.dumps(mission).encode())
    assert again.status == 200, again.detail
    again = again.json
    assert (again["tasks"], again["uavs"][0]["range_m"]) == (read["tasks"], 9000)
    fleet = server.ask("POST", "/api/v1/fleets?name=fleet.csv", b"id,range_m\nx,500\ny,900\n").json
    assert [uav["id"] for uav in fleet["uavs"]] == ["x", "y"]


def test_cancel_keeps_the_plan_and_the_queue_moves_on(server: Served):
    first, second, third = server.solve(time_limit=20), server.solve(time_limit=20), server.solve()
    assert server.wait(first, "running", with_plan=True)["place"] is None
    assert server.wait(third, "waiting")["place"] == 1
    # Two wait: a fourth is refused with a sentence.
    refused = server.ask("POST", "/api/v1/solves", problem())
    assert refused.status == 429 and "2 solves wait already" in refused.detail
    assert server.ask("DELETE", f"/api/v1/solves/{second}").json["state"] == "canceled"
    found = server.ask("DELETE", f"/api/v1/solves/{first}").json
    assert (found["state"], found["has_plan"]) == ("canceled", True)
    assert server.ask("GET", f"/api/v1/solves/{first}/plan").status == 200
    assert server.ask("GET", f"/api/v1/solves/{second}/plan").status == 404
    assert server.wait(third)["state"] == "done"


def kill_the_solver(server: Served):
    assert server.rooms is not None
    (worker,) = server.rooms.solves.workers
    assert worker is not None
    os.kill(worker.process.pid, signal.SIGKILL)


def test_a_crash_harms_nobody(server: Served):
    crashing, next_one = server.solve(time_limit=20), server.solve()
    server.wait(crashing, "running", with_plan=True)
    kill_the_solver(server)
    found = server.wait(crashing)
    assert found["state"] == "failed" and "ended unexpectedly (exit code -9)" in found["error"]
    assert server.wait(next_one)["state"] == "done"
    # Also one that has nothing to do.
    kill_the_solver(server)
    assert server.wait(server.solve())["state"] in ("done", "failed")
    assert server.wait(server.solve())["state"] == "done"


def test_old_solves_are_dropped(server: Served):
    names = [server.solve(n_tasks=3, time_limit=0.1) for _ in range(1)]
    for _ in range(6):
        server.wait(names[-1])
        names.append(server.solve(n_tasks=3, time_limit=0.1))
    server.wait(names[-1])
    assert server.ask("GET", f"/api/v1/solves/{names[0]}").status == 404
    assert server.ask("GET", f"/api/v1/solves/{names[-1]}").status == 200


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        (changed(tasks__depot=None), "There is no depot; say where the UAVs start and land."),
        (changed(tasks__tasks=[]), "There are no tasks."),
        (problem(n_tasks=51), "This server admits 50 tasks at most."),
        (problem(time_limit=21), "This server solves for 20 s at most."),
        (changed(fleet={"count": 0, "range_m": 1}), "fleet.count: Input should be greater than or equal to 1."),
        (changed(fleet={"count": 1, "range_m": -1}), "fleet.range_m: Input should be greater than 0."),
        (changed(fleet={"count": 1, "range_m": True}), "fleet.range_m: Input should be a valid number."),
        (changed(fleet={}), "fleet: give either a list uavs, or count and range_m."),
        (changed(tasks__tasks__0__id="t1"), "tasks: task 2 has the id 't1' of an earlier task; ids must differ."),
        (changed(tasks__tasks__0__id="a\0"), "tasks.tasks.0.id: this has control characters; leave them out."),
        (changed(tasks__tasks__0__value="1"), "tasks.tasks.0.value: Input should be a valid number."),
        (changed(tasks__tasks__0__service_s=4), "Task 't0' takes time, but UAV 'uav-1' has no speed; give it one."),
        (
            changed(tasks__tasks__0__point=[1]),
            "tasks.tasks.0.point: List should have at least 2 items after validation, not 1.",
        ),
        (changed(tasks__system="mars"), "tasks.system: Input should be 'wgs84' or 'plane'."),
        (changed(tasks__system="wgs84", tasks__tasks__0__point=[91, 0]), "tasks: task 1 ('t0') is at 91, 0; a latitude is"),
        (changed(surprise=1), "surprise: Extra inputs are not permitted."),
        (changed(options={"time_limit": float("nan")}), "options.time_limit: Input should be a finite number."),
        (changed(options={"seed": 10**400}), "options.seed: Input should be less than or equal to 2147483647."),
        (changed(fleet={"count": 1, "range_m": 10**400}), "fleet.range_m: "),
    ],
)
def test_wrong_input_gets_one_sentence(server: Served, body, sentence):
    answer = server.ask("POST", "/api/v1/solves", body)
    assert answer.status == 422
    assert answer.detail.startswith(sentence), answer.detail
    assert "\n" not in answer.detail and len(answer.detail) < 300


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("a.csv", b"id,lat,lon\na,95,8\n", "row 2"),
        ("a.csv", b"", "the file is empty"),
        ("a.xlsx", b"PK", "save the sheet as CSV"),
        ("../../etc/passwd", b"x", "passwd"),
        ("a.json", b"[" * 100_000, "a.json"),
        (
            "a.json",
            b'{"format": "sb3-uav mission", "tasks": 3, "system": "plane"}',
            "this is no intact mission: 'int' object is not iterable",
        ),
        ("a.csv", b"id,x,y\n" + b"".join(b"%d,%d,%d\n" % (i, i, i * i) for i in range(51)), "there are 51 tasks"),
    ],
)
def test_wrong_files_get_one_sentence(server: Served, name, data, sentence):
    answer = server.ask("POST", f"/api/v1/tasks?name={name}", data)
    assert answer.status == 422
    assert sentence in answer.detail and "/" not in answer.detail.split(":")[0]


def test_a_solver_that_refuses_is_quoted(server: Served):
    body = problem()
    body["tasks"]["tasks"][0]["point"] = body["tasks"]["tasks"][1]["point"]
    found = server.wait(server.ask("POST", "/api/v1/solves", body).json["id"])
    assert found["state"] == "failed" and "t1 is where task t0" in found["error"]
    # Not an option of the command line.
    assert "--" not in found["error"]
    body["options"]["allow_duplicates"] = True
    assert server.wait(server.ask("POST", "/api/v1/solves", body).json["id"])["state"] == "done"


def test_bodies_are_measured_while_they_come_in(server: Served):
    sent: list[int] = []

    def blocks():
        while len(sent) < 200:
            sent.append(65_536)
            yield b"x" * 65_536

    # Announced, and not: what follows the limit is thrown away, and the client sees the sentence.
    answer = server.ask("POST", "/api/v1/tasks?name=a.csv", b"", {"content-length": str(2**30)})
    assert (answer.status, answer.detail) == (413, "A request may have 1 MiB at most.")
    answer = server.ask("POST", "/api/v1/tasks?name=a.csv", blocks(), encode_chunked=True)
    assert (answer.status, answer.detail) == (413, "A request may have 1 MiB at most.")
    just_fits = server.ask("POST", "/api/v1/tasks?name=a.csv", b"x" * 2**20)
    assert just_fits.status == 422
    assert server.ask("GET", "/api/v1/limits").status == 200


def test_bound_and_gap_are_reported():
    from sb3_uav.web.plan_view import report_of

    tasks = TaskList.of("ab", [[3, 4], [6, 8]], "plane", [1, 2], depot=(0, 0))
    plan = make_plan(tasks, Fleet.of_equal(1, 12.0), Schedule([[0]]), "by hand")
    assert [report_of(plan)[key] for key in ("bound", "gap")] == [None, None]
    report = report_of(dataclasses.replace(plan, bound=2.0), ["c"])
    assert (report["bound"], report["gap"], report["objective"]) == (2.0, 0.5, 1.0)
    assert [one["text"] for one in report["skipped"]] == ["out of reach: 8 m of range are missing", "forbidden by you"]
    assert "unserved" in report and report["remarks"] and not any("--" in remark for remark in report["remarks"])


def test_requests_of_the_docs(server: Served):
    text = (Path(__file__).parents[1] / "docs" / "serve.md").read_text(encoding="utf-8")
    (problem_json,) = re.findall(r"^```json\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    files = {"@problem.json": problem_json.encode(), "@field.csv": b"id,x,y,depot\nd,0,0,yes\na,10,10,\n"}
    commands = [shlex.split(line) for line in re.findall(r"^curl .*", text, re.MULTILINE)]
    assert len(commands) == 2
    for words in commands:
        (url,) = [word for word in words if word.startswith("http://127.0.0.1:8080/")]
        body = files[words[-1]]
        answer = server.ask("POST", url.removeprefix("http://127.0.0.1:8080"), body, {"content-type": "application/json"})
        assert answer.status == 202, answer
        found = server.wait(answer.json["id"], "running", "done", with_plan=True)
        assert found["objective"] > 0
        server.ask("DELETE", f"/api/v1/solves/{answer.json['id']}")
    # Nothing is left out: every request, and every option.
    schema = server.ask("GET", "/api/v1/openapi.json").json
    known = {re.sub(r"\{name\}", "{id}", path).partition("?")[0]: methods for path, methods in schema["paths"].items()}
    listed = re.findall(r"^\| `(GET|POST|DELETE) ([^`?]+)", text, re.MULTILINE)
    assert sorted(listed) == sorted((method.upper(), path) for path, methods in known.items() for method in methods)
    with pytest.raises(SystemExit), contextlib.redirect_stdout(io.StringIO()) as printed:
        main(["serve", "--help"])
    options = set(re.findall(r"--[a-z-]+", printed.getvalue())) - {"--help"}
    assert options == set(re.findall(r"`(--[a-z-]+)`", text.partition("## Options")[2].partition("##")[0]))


def test_the_api_is_described(server: Served):
    schema = server.ask("GET", "/api/v1/openapi.json").json
    assert {"/api/v1/solves", "/api/v1/solves/{name}", "/api/v1/solves/{name}/plan"} <= set(schema["paths"])
    assert schema["components"]["schemas"]["TaskIn"]["properties"]["value"]["maximum"] == 1e12
    # FastAPI's own pages load scripts from elsewhere.
    assert server.ask("GET", "/docs").status == server.ask("GET", "/redoc").status == 404
