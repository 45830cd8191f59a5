"""Solvers made from text: names, options and their types."""

from __future__ import annotations

import json
from typing import Any

import pytest

from sb3_uav.solvers import SOLVERS, make_solver
from sb3_uav.solvers.nearest_task import KMeansNearest


def test_options() -> None:
    solver = make_solver("kmeans-nearest:restarts=3")
    assert isinstance(solver, KMeansNearest) and solver.restarts == 3
    assert solver.name == "kmeans-nearest:restarts=3"
    assert make_solver("kmeans-nearest").name == "kmeans-nearest"
    named = make_solver("kmeans-nearest:name=K-means,restarts=4")
    assert isinstance(named, KMeansNearest) and named.name == "K-means" and named.restarts == 4


def test_defaults_are_for_solvers_that_have_them() -> None:
    solver = make_solver("kmeans-nearest", restarts=3, device="cpu")
    assert isinstance(solver, KMeansNearest) and solver.restarts == 3
    solver = make_solver("kmeans-nearest:restarts=2", restarts=3)
    assert isinstance(solver, KMeansNearest) and solver.restarts == 2


@pytest.mark.parametrize(
    "spec, message",
    [
        ("kmeans", r"Unknown solver 'kmeans'; choose one of \['dl-drl', 'dl-drl-i', .*'kmeans-am'"),
        ("kmeans-nearest:k=3", r"has no option 'k=3'; its options are: name=<str>, restarts=<int>"),
        ("kmeans-nearest:restarts", r"has no option 'restarts'"),
        ("random-nearest:restarts=2", r"has no option 'restarts=2'; its options are: name=<str>\."),
        ("kmeans-nearest:restarts=two", r"'restarts=two' of solver 'kmeans-nearest' must be of type int"),
        ("kmeans-nearest:restarts=__import__('os')", "must be of type int"),
        ("kmeans-nearest:restarts=1,restarts=2", "given the option 'restarts' twice"),
        ("kmeans-nearest:restarts=0", "at least 1 start"),
        ('dl-drl:allocator="a,b.zip', r"begins with a quote; end it with another one"),
        ("dl-drl:allocator='a'.zip", r"begins with a quote; end it with another one, followed by a comma"),
        (
            "dl-drl:allocator=a.zip",
            r"a\.zip is one zip of a pair, and its router is missing: give both, or the name of a pair",
        ),
        ("dl-drl:router=r.zip", r"r\.zip is one zip of a pair, and its allocator is missing"),
        ("dl-drl:polish=-1", "polish is -1; give a number of seconds"),
        ("dl-drl:time_limit=0", "time_limit of DL-DRL .greedy. is 0 seconds"),
        ("dl-drl-i:allocator=a.zip,router=r.zip,batch_size=few", "must be of type int"),
        ("kmeans-am:restarts=2", "'kmeans-am' needs the option router=<str>"),
    ],
)
def test_wrong_options(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_solver(spec)


class Typed:
    """A solver with an option of every type."""

    def __init__(self, number: float = 1.0, flag: bool = False, text: str = "") -> None:
        self.options = dict(number=number, flag=flag, text=text)


def test_typed_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOLVERS, "typed", f"{__name__}:Typed")
    solver: Any = make_solver("typed:number=1e-3,flag=true,text=a=b")
    # As JSON, because there True is not 1.
    assert json.dumps(solver.options) == json.dumps(dict(number=1e-3, flag=True, text="a=b"))
    for spec, text in (
        ('typed:text="a,b.zip",flag=1', "a,b.zip"),
        ("typed:text='C:\\a,b\\\"c\".zip',flag=true", 'C:\\a,b\\"c".zip'),
        ("typed:flag=1,text='it''s, \"so\"'", 'it\'s, "so"'),
        ('typed:text="",flag=1', ""),
        ('typed:flag=1,text=5" pipe', '5" pipe'),
        ("typed:text=C:\\a.zip,flag=1", "C:\\a.zip"),
    ):
        solver = make_solver(spec)
        assert solver.options == dict(number=1.0, flag=True, text=text) and solver.name == spec
    assert make_solver('typed:name="a, b",text="c,d"').name == "a, b"
    with pytest.raises(ValueError, match="'flag=yes' of solver 'typed' must be true or false, or 1 or 0"):
        make_solver("typed:flag=yes")
