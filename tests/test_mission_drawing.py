"""What tasks, fleets and plans show in a notebook."""

from __future__ import annotations

import sys
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mission_plans import HOSTILE, Elements, hostile_plan, plan_of_all_kinds, spread_plan

from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.labels import duration, meters, number, percent, shown
from sb3_uav.missions.tasks import TaskList

pytest.importorskip("pyproj")


def parsed(shown: Any) -> ElementTree.Element:
    """The HTML of an object, which is well-formed XML too."""
    text = shown._repr_html_()
    assert "<script" not in text and "onload" not in text.replace("&lt;svg onload", "").replace("onload=alert(3)&gt;", "")
    return ElementTree.fromstring(text)


def all_named(root: ElementTree.Element, tag: str) -> list[ElementTree.Element]:
    return [element for element in root.iter() if element.tag.rpartition("}")[2] == tag]


def test_a_plan_shows_its_tours_to_scale():
    root = parsed(plan_of_all_kinds())
    lines = [
        np.array([corner.split(",") for corner in line.attrib["points"].split()], float)
        for line in all_named(root, "polyline")
    ]
    assert [len(line) for line in lines] == [5, 3, 2]
    first, second, third = lines
    # North is up, and both directions have one scale: 1111.8 m north, then 760.4 m east.
    assert first[1][1] < first[0][1] and first[2][0] > first[1][0]
    assert (first[2][0] - first[1][0]) / (first[0][1] - first[1][1]) == pytest.approx(760.4 / 1111.8, rel=0.01)
    assert second[0][1] == pytest.approx((second[1][1] + second[2][1]) / 2, abs=0.2)
    assert (third[0] == third[1]).all()
    words = " ".join(root.itertext())
    assert "Objective 10 of 22" in words and "stays on the ground" in words and "A person must review" in words
    assert "2 tasks lie far away" in words
    assert "c: stop 3 of first" in {title.text for title in all_named(root, "title")}


def test_a_plan_shows_what_is_left_out():
    titles = {title.text for title in all_named(parsed(plan_of_all_kinds()), "title")}
    assert any(title and title.startswith("e: out of reach") for title in titles)
    assert "f: worth nothing" in titles
    # Squares must be served: one is, one is not.
    assert len(all_named(parsed(plan_of_all_kinds()), "rect")) == 2


def test_a_large_plan_stays_light():
    text = spread_plan(5_000, 40)._repr_html_()
    assert len(text) < 1_000_000 and "<title>t1" not in text
    assert "and 20 more UAVs" in text


def test_tasks_show_where_they_are_and_how_many():
    tasks = plan_of_all_kinds().tasks
    words = " ".join(parsed(tasks).itertext())
    assert "7 tasks, value 22 in all, 2 must be served, 1 take time, depot at lat 47.0000000, lon 8.0000000" in words
    assert len(all_named(parsed(tasks), "circle")) + len(all_named(parsed(tasks), "rect")) == 7


@pytest.mark.parametrize("depot", [None, (0.0, 0.0), (np.nan, 0.0), (1e9, 3.0), (90.0, 180.0)])
@pytest.mark.parametrize("system", ["wgs84", "plane"])
def test_tasks_that_nobody_has_checked_are_shown_as_far_as_possible(system: Any, depot: Any):
    points = [[1, 2], [np.nan, 2], [np.inf, -np.inf], [91, 8], [-90, 360], [1e300, 1e300]]
    tasks = TaskList.of(range(6), points, system, values=[1, np.nan, np.inf, -1, 0, 1e300], depot=depot)
    root = parsed(tasks)
    drawn = len(all_named(root, "circle"))
    assert drawn == (2 if system == "wgs84" else 3)
    assert "nan" not in "".join(ElementTree.tostring(svg, "unicode") for svg in all_named(root, "svg")).replace(
        "value nan", ""
    )


@pytest.mark.parametrize("system", ["wgs84", "plane"])
def test_no_tasks_show_nothing(system: Any):
    root = parsed(TaskList.of([], [], system))
    assert not all_named(root, "svg") and "0 tasks" in "".join(root.itertext())


def test_many_tasks_are_thinned_out():
    points = np.random.default_rng(0).uniform(0, 1, (100_000, 2))
    root = parsed(TaskList.of(range(100_000), points, "plane"))
    assert 1_000 < len(all_named(root, "circle")) <= 2_000
    assert "one of 50 tasks is drawn" in "".join(root.itertext())


def test_without_pyproj_tasks_show_their_counts(monkeypatch: pytest.MonkeyPatch):
    tasks = plan_of_all_kinds().tasks
    monkeypatch.setitem(sys.modules, "pyproj", None)
    root = parsed(tasks)
    assert not all_named(root, "svg") and "7 tasks" in "".join(root.itertext())


def test_a_fleet_shows_a_table():
    fleet = Fleet((Uav("a", 12_000.0, 12.5, reserve_percent=10), Uav("b", 900.0, start=(47.1, 8.1))), "fleet.csv")
    rows = [[cell.text for cell in all_named(row, "td")] for row in all_named(parsed(fleet), "tr")[1:]]
    assert rows == [
        ["a", "12.00 km", "10 %", "10.80 km", "12.5 m/s", "depot", "depot"],
        ["b", "900 m", "0 %", "900 m", None, "47.1, 8.1", "depot"],
    ]


def test_hostile_names_are_text():
    plan = hostile_plan()
    for one in (plan, plan.tasks, plan.fleet):
        page = Elements(one._repr_html_())
        assert not {"img", "script", "a"} & {name for name, _ in page.tags}
        assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
        assert HOSTILE in page.text


@settings(max_examples=30)
@given(st.lists(st.text(st.characters(codec=None), max_size=8), min_size=7, max_size=7, unique=True))
def test_any_names_give_well_formed_text(names: list[str]):
    plan = plan_of_all_kinds(tuple(names), source=names[0])
    fleet = Fleet(tuple(Uav(name, 1.0) for name in names), names[1])
    for one in (plan, plan.tasks, fleet):
        parsed(one)
        one._repr_html_().encode()


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (shown("a\x00b\u202ec\ud800"), "a\ufffdb\ufffdc\ufffd"),
        (shown("abcdef", 4), "abc…"),
        (shown("\u0645\u06cc\u200c\u062e"), "\u0645\u06cc\u200c\u062e"),
        (meters(999.6), "1.00 km"),
        (meters(0.4), "0 m"),
        (meters(123_456), "123 km"),
        (percent(0.99999), "99.9 %"),
        (percent(1.0), "100 %"),
        (duration(3_599.6), "60 min 00 s"),
        (number(12), "12"),
        (number(0.1 + 0.2), "0.3"),
        (number(1_234_567.8), "1,234,568"),
    ],
)
def test_words(said: str, expected: str):
    assert said == expected
