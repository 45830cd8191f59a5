"""Evaluations in several processes: same results, and what happens to those that die or never end."""

from __future__ import annotations

from multiprocessing.connection import wait
from pathlib import Path

import pytest
from evaluation_helpers import Mortal, Nearest, Stub, contents, figures, places

from sb3_uav.envs import Instances
from sb3_uav.evaluation.parallel import Failure, Runner
from sb3_uav.evaluation.run import evaluate
from sb3_uav.solvers import Solver, SolverResult, make_solver

# ---------------------------------------------------------------------------------------------------------------- failures


def test_failures_are_named() -> None:
    assert Failure.of(ValueError("Give\n  more.")).message == "Give more."
    assert Failure.of(ImportError("Run: pip")).message == "Run: pip"
    assert Failure.of(OSError(2, "gone")).message == "FileNotFoundError: [Errno 2] gone"
    assert Failure.of(ValueError()).message == "ValueError: "


# --------------------------------------------------------------------------------------------------------------- processes


@pytest.mark.slow
def test_two_processes_find_the_same_as_one(instances: Instances, tmp_path: Path) -> None:
    """
    Same schedules, same files; random numbers follow the row also for the rows of an interrupted run, and a failing instance
    fails alone.
    """
    solvers: list[Solver] = [make_solver("kmeans-nearest"), Nearest(places(instances)[3:4]), Stub()]
    sets = {"a": instances, "b": instances[1:4]}
    alone = evaluate(solvers, sets, tmp_path / "one", seed=5)
    with pytest.raises(KeyboardInterrupt):
        halting = Nearest(places(instances)[2:3], KeyboardInterrupt())
        evaluate([make_solver("random-nearest"), halting], sets, tmp_path / "two", seed=5)
    both = evaluate(solvers, sets, tmp_path / "two", seed=5, n_jobs=2)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    assert figures(both) == figures(alone)


@pytest.mark.slow
def test_processes_that_die_or_never_end(instances: Instances) -> None:
    """One that dies takes only its own instance with it; leaving ends those that would go on for ever."""
    deadly = Mortal(deadly=places(instances)[1:2])
    unsendable = Nearest()
    unsendable.solve_row = lambda *_: None  # type: ignore[assignment, method-assign]
    with Runner(2) as runner:
        for _, failure in runner.run(unsendable, instances, [0, 1]):
            assert isinstance(failure, Failure) and "pickle" in failure.message
        found = dict(runner.run(deadly, instances, [0, 1]))
        assert found[1] == Failure("its process died; was it out of memory?")
        assert isinstance(found[0], SolverResult) and found[0].schedule == deadly.solve_row(instances[0], 0).schedule
        endless = runner.run(Mortal(endless=places(instances)[:1]), instances, [0, 1])
        row, _ = next(endless)
        assert row == 1
        # Not by their exit codes: a thread of the executor collects them, at a time of its own.
        handles = {process.sentinel for process in runner.processes}
        assert len(handles) == 2 and wait(handles, timeout=0) == []
    assert set(wait(handles, timeout=0)) == handles
