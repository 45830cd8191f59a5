"""Tasks and plans to write to mission files, and files of strangers to read."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

DEPOT = (-17.0, 179.995)
Reader = Callable[[bytes, str], TaskList]

places = st.tuples(st.floats(-90, 90), st.floats(-180, 180)).filter(any)
names = st.text(st.characters(exclude_categories=["Cc", "Cs"]), min_size=1, max_size=200).filter(str.strip)
amounts = st.floats(0, 1e9)
altitudes = st.just(float("nan")) | st.floats(-1000, 10_000).filter(bool)


@st.composite
def task_lists(draw: st.DrawFn, system: Any = "wgs84") -> TaskList:
    """Tasks anywhere on earth, with a depot."""
    ids = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    each: dict[str, Any] = {"min_size": len(ids), "max_size": len(ids)}
    return TaskList.of(
        ids,
        draw(st.lists(places, **each)),
        system,
        draw(st.lists(amounts, **each)),
        draw(st.lists(amounts, **each)),
        draw(st.lists(st.booleans(), **each)),
        depot=draw(places),
        altitudes=np.array(draw(st.lists(altitudes, **each)), float),
        meters_per_unit=draw(st.floats(1e-3, 1e3)) if system == "plane" else 1.0,
    )


def plan_at_the_antimeridian() -> Plan:
    """
    Two UAVs from a depot west of the antimeridian, the first over it and back; a third starts and lands elsewhere, a fourth
    stays at home. One task is out of reach.
    """
    tasks = TaskList.of(
        ["a", "b & <b>", "c", "far", "d"],
        [(-17.0, 179.99), (-17.01, -179.99), (-17.0, 179.98), (-16.0, 178.0), (-17.02, 179.9)],
        "wgs84",
        [1, 2, 3, 4, 5],
        service_s=[0, 10, 2.5, 0, 0],
        depot=DEPOT,
        altitudes=np.array([np.nan, 30, np.nan, np.nan, np.nan]),
    )
    fleet = Fleet(
        (
            Uav("one", 20_000.0, 10.0),
            Uav("two", 20_000.0, 10.0),
            Uav("three", 30_000.0, 8.0, start=(-17.0, 179.9), end=(-17.01, 179.9)),
            Uav("four", 1_000.0, 10.0),
        )
    )
    return make_plan(tasks, fleet, Schedule([[0, 1], [2], [4], []]), "by hand")


def plane_plan() -> Plan:
    tasks = TaskList.of(["a", "b"], [(300.0, 0.0), (300.0, 400.0)], "plane", depot=(0.0, 0.0), meters_per_unit=2.0)
    return make_plan(tasks, Fleet.of_equal(1, 5_000), Schedule([[0, 1]]), "by hand")


def read_back(reader: Reader, path: Path) -> TaskList:
    return reader(path.read_bytes(), path.name)


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.just(10**400)
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from([0, 1, -1, 16, 180.0, -90.0, "Point", "SimpleItem", "ComplexItem"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=5,
)


@st.composite
def mutated(draw: st.DrawFn, document: Any) -> bytes:
    """A document with a few of its values replaced, removed or doubled."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        holder = document
        while True:
            keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(holder[key], dict | list) and holder[key] and draw(st.integers(0, 3)):
                holder = holder[key]
                continue
            change = draw(st.sampled_from(["replace", "remove", "double"]))
            if change == "remove":
                del holder[key]
            elif change == "double" and isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
            else:
                holder[key] = draw(json_values)
            break
    return json.dumps(document).encode()


def accepts_or_refuses(reader: Reader, data: bytes) -> None:
    """Whatever comes, a reader returns tasks that hold together, or says in one line what is wrong."""
    try:
        tasks = reader(data, "upload")
    except ValueError as error:
        message = str(error)
        assert message.startswith("upload: ")
        assert len(message) < 600
        assert message.isprintable()
    else:
        assert len(tasks) == len(tasks.points) == len(tasks.values) == len(tasks.service_s) == len(tasks.places) > 0
        assert np.isfinite(tasks.points).all()
        assert np.isfinite(tasks.values).all()
        assert (tasks.service_s >= 0).all()
        assert not np.isinf(tasks.altitudes).any()
        assert tasks.depot is None or np.isfinite(tasks.depot).all()
