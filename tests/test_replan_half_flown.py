"""Half-flown missions of 200 tasks: UAVs in the air, one lost, ten new tasks, solved by replanning and from scratch."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.missions.problem import make_instance
from sb3_uav.missions.replan import replan
from sb3_uav.solvers import make_solver

pytest.importorskip("numba")
pytest.importorskip("pyproj")

NETWORKS = "dl-drl:allocator=world,decode=greedy,repair=1"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "replan.py"
    specification = importlib.util.spec_from_file_location("benchmark_of_replan", path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(("source", "seed"), [("local-search", 0), ("local-search", 1), (NETWORKS, 2), (NETWORKS, 3)])
def test_half_flown_missions(benchmark, source, seed):
    plan = benchmark.some_plan(200, 5, seed, source)
    status = benchmark.half_flown(plan, seed)
    assert len(status.uavs) == 4 and len(status.lost) == 1 and len(status.tasks) == 10 and status.done
    found = replan(plan, status, 0.5, seed)
    new = found.plan
    assert [uav.start for uav in new.fleet] == [report.position for report in status.uavs]
    assert [uav.range_m for uav in new.fleet] == [report.remaining for report in status.uavs]
    assert len(new.tasks) == 210 - len(status.done)
    assert 0 < found.kept_share <= 1
    instance = make_instance(new.tasks, new.fleet)
    report = check_schedule(instance, 0, Schedule([route.stops for route in new.routes]))
    assert (report.objective, report.unserved) == (new.objective, new.unserved)
    # Not less than what was left of the routes, without the stops that the wind has made too far.
    kept = replan(plan, status, 0.0, min_gain=1e9).plan
    assert (-len(new.unserved), new.objective) >= (-len(kept.unserved), kept.objective)
    for spec in (NETWORKS, "local-search:time_limit=0.5"):
        schedule = make_solver(spec, device="cpu").solve(instance, seed=seed)[0].schedule
        assert check_schedule(instance, 0, schedule).objective > 0.5 * new.objective


def test_the_benchmark_prints_a_row(benchmark, capsys):
    benchmark.main(["--n-tasks", "20", "--n-uavs", "2", "--seeds", "2", "--sources", "local-search", "--time-limits", "0.05"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2].startswith("| local-search | 0.05 | 0.")
