"""The map of a plan: what its figure holds, and what its file holds."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mission_plans import DEPOT, Elements, hostile_plan, plan_of_all_kinds, spread_plan

from sb3_uav.missions.labels import ink_on, uav_color, uav_look
from sb3_uav.missions.remarks import REVIEW

pytest.importorskip("pyproj")
pytest.importorskip("plotly")

from sb3_uav.missions.writers.map_html import map_page, plan_figure, write_map_html


def traces(figure: Any, role: str) -> list[Any]:
    return [trace for trace in figure.data if trace.meta["role"] == role]


def without_plotly(plan: Any) -> Elements:
    """The page of a plan, with a stand-in for plotly.js, which takes long to parse."""
    with patch("plotly.offline.get_plotlyjs", lambda: "/* plotly */"):
        return Elements(map_page(plan))


def test_one_entry_of_the_legend_per_uav_is_for_its_tour_and_its_stops():
    figure = plan_figure(plan_of_all_kinds())
    entries = [trace for trace in figure.data if trace.meta.get("uav") is not None and trace.showlegend is not False]
    assert [trace.name.partition(":")[0] for trace in entries] == ["first", "second", "third"]
    assert entries[2].name == "third: stays on the ground"
    for entry in entries:
        group = [trace for trace in figure.data if trace.legendgroup == entry.legendgroup]
        assert {trace.meta["role"] for trace in group} == {"tour", "stops", "entry"}
        assert {trace.meta["uav"] for trace in group} == {entry.meta["uav"]}
    assert figure.layout.legend.groupclick == "togglegroup"


def test_positions_are_meters_from_the_depot_to_scale():
    figure = plan_figure(plan_of_all_kinds())
    first, second, third = traces(figure, "stops")
    # One degree of latitude is 111.2 km there, and one of longitude 76.1 km.
    assert first.y[:2] == pytest.approx((1111.8, 1111.8), rel=1e-3) and first.x[1] == pytest.approx(760.4, rel=1e-3)
    assert (first.x[0], second.y[0]) == pytest.approx((0, -1111.8), rel=1e-3)
    assert third.x == ()
    depot = traces(figure, "depot")[0]
    assert (depot.x, depot.y) == ((0,), (0,))
    assert (figure.layout.yaxis.scaleanchor, figure.layout.yaxis.scaleratio) == ("x", 1)
    assert figure.layout.xaxis.title.text == "meters east of the depot"


def test_stops_are_numbered_and_tell_everything_when_hovered_over():
    plan = plan_of_all_kinds()
    first = traces(plan_figure(plan), "stops")[0]
    assert first.text == ("1", "2", "3")
    legs = plan.routes[0].legs_m
    assert first.hovertext[2].split("<br>") == [
        "<b>c</b>",
        "stop 3 of 3 of first",
        "lat 47.0000000, lon 8.0200000",
        "value 3, 30 s of service",
        f"leg {legs[2]:,.1f} m, {sum(legs[:3]):,.1f} m from the start",
    ]
    assert first.hovertext[1].startswith("<b>b</b>, must be served<br>")
    assert first.marker.symbol == ("circle", "square", "circle")


def test_tours_tell_their_legs_and_start_where_their_uav_is():
    plan = plan_of_all_kinds()
    figure = plan_figure(plan)
    second = traces(figure, "tour")[1]
    assert len(second.x) == 5
    assert (second.y[0], second.y[-1]) == pytest.approx((-555.9, 0), rel=1e-3)
    assert second.text[1] == f"<b>second</b>, leg 1 of 2<br>start → d<br>{plan.routes[1].legs_m[0]:,.1f} m"
    assert second.text[3].split("<br>")[1] == "d → depot"
    entries = traces(figure, "entry")
    assert [len(entry.x) for entry in entries] == [1, 3, 1]
    assert entries[1].marker.symbol[1] == "triangle-right"
    assert "start of a UAV" in {trace.name for trace in traces(figure, "key")}


def test_tasks_that_are_left_out_say_why():
    figure = plan_figure(plan_of_all_kinds())
    found = {trace.name: trace for trace in traces(figure, "skipped")}
    assert list(found) == ["out of reach: 1 task", "worth nothing: 1 task", "did not fit: 1 task"]
    assert len({trace.marker.symbol[0] for trace in found.values()}) == 3
    far = found["out of reach: 1 task"]
    assert far.hovertext[0].startswith("<b>e</b>, must be served<br>out of reach: 39.1 km")
    assert "m of range missing<br>lat 47.2000000, lon 8.0000000<br>value 5" in far.hovertext[0]
    assert far.marker.color != found["did not fit: 1 task"].marker.color
    assert next(trace.name for trace in traces(figure, "key")) == "must be served: 2 tasks, 1 left out"


def test_the_title_has_the_objective_and_its_share():
    title = plan_figure(plan_of_all_kinds(source="<b>.csv")).layout.title.text
    assert title.startswith("&lt;b&gt;.csv<br>")
    assert "Objective 10 of 22 (45.5 %) · 4 of 7 tasks served · 3 UAVs" in title
    assert "1 task that must be served left out" in title


def test_a_plan_across_the_antimeridian_is_in_one_piece():
    figure = plan_figure(spread_plan(20, 2, center=(0.0, 179.999)))
    stops = traces(figure, "stops")
    assert max(abs(x) for trace in stops for x in trace.x) < 6_000
    assert any(text.split("lon ")[1].startswith("-179") for trace in stops for text in trace.hovertext)


def test_a_plane_is_shown_in_meters_and_hovered_over_in_its_own_units():
    plan = spread_plan(5, 1, "plane", (683_000.0, 247_000.0))
    figure = plan_figure(plan)
    stops = traces(figure, "stops")[0]
    x, y = plan.tasks.points[0]
    assert (stops.x[0], stops.y[0]) == pytest.approx((x - 683_000, y - 247_000), abs=1e-3)
    assert f"x {x:.10g}, y {y:.10g}" in stops.hovertext[0]
    assert figure.layout.yaxis.title.text == "meters in y from the depot"


def test_a_map_begins_with_what_is_flown_where_a_task_lies_far_away():
    figure, page = plan_figure(plan_of_all_kinds()), without_plotly(plan_of_all_kinds())
    low, high = figure.layout.yaxis.range
    assert -3_000 < low < -1_000 and 1_112 < high < 3_000
    # The one that is out of reach, and the one that did not fit.
    assert "2 tasks lie far away" in page.text
    assert plan_figure(spread_plan(8, 2)).layout.yaxis.range is None
    assert "far away" not in without_plotly(spread_plan(8, 2)).text


def test_uavs_are_told_apart():
    looks = [(uav_color(uav), uav_look(uav)) for uav in range(64)]
    assert len(set(looks)) == 64
    figure = plan_figure(spread_plan(60, 20))
    drawn = {
        (tour.line.color, tour.line.dash, stops.marker.color)
        for tour, stops in zip(traces(figure, "tour"), traces(figure, "stops"), strict=True)
    }
    assert len(drawn) == 20
    assert (ink_on("#000000"), ink_on("#ffffff"), ink_on("#0072B2"), ink_on("#E69F00")) == (
        "#ffffff",
        "#000000",
        "#ffffff",
        "#000000",
    )


@pytest.mark.parametrize(("n_tasks", "is_numbered"), [(1, True), (30, True), (1_000, False)])
def test_stops_have_numbers_where_there_is_room(n_tasks: int, is_numbered: bool):
    assert ("text" in traces(plan_figure(spread_plan(n_tasks, 1)), "stops")[0].mode) is is_numbered


def test_the_file_holds_everything_and_asks_for_nothing(tmp_path: Path):
    path = tmp_path / "out" / "map.html"
    write_map_html(plan_of_all_kinds(), path)
    page = Elements(path.read_text(encoding="utf-8"))
    assert not [attributes for _, attributes in page.tags if {"src", "href", "srcset", "data", "action"} & set(attributes)]
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert not {"link", "base", "iframe", "object", "form"} & {name for name, _ in page.tags}
    policy = next(tag["content"] for tag in page.named("meta") if tag.get("http-equiv") == "Content-Security-Policy") or ""
    assert policy.startswith("default-src 'none'; ") and "unsafe-eval" not in policy
    allowed = policy.partition("script-src ")[2].partition(";")[0].split()
    runs = [content for attributes, content in page.scripts if attributes.get("type") != "application/json"]
    hashes = [base64.b64encode(hashlib.sha256(content.encode()).digest()).decode() for content in runs]
    assert allowed == [f"'sha256-{digest}'" for digest in hashes]
    assert "plotly.js v" in runs[0][:100]
    assert "url(" not in path.read_text(encoding="utf-8").partition("<style>")[2].partition("</style>")[0]


def test_tables_remarks_and_the_call_for_review_are_on_the_page():
    plan = plan_of_all_kinds()
    page = without_plotly(plan)
    assert REVIEW in page.text and len(plan.remarks) > 1
    for remark in plan.remarks:
        assert page.texts.count(remark) == 1
    assert "Objective 10 of 22 (45.5 %)" in page.text
    assert [button["data-uav"] for button in page.named("button")] == ["0", "1", "2"]
    # Of the range 10 % are kept; the bar says so.
    assert "left:90.00%" in {tag["style"] for tag in page.named("b") if "style" in tag}
    assert "out of reach: 39.1 km" in page.text and "must be served" in page.text
    assert "solver by hand, seed 7" in page.text


def test_the_data_of_the_page_is_that_of_the_figure():
    plan = plan_of_all_kinds()
    text = next(content for attributes, content in without_plotly(plan).scripts if attributes.get("id") == "page")
    # The figure has tags such as <b>; as they are, one could end the script.
    assert not {"<", ">", "&"} & set(text)
    data = json.loads(text)
    assert len(data["figure"]["data"]) == len(plan_figure(plan).data)
    # The page has a headline; a second one would cover the map.
    assert "title" not in data["figure"]["layout"]
    assert data["spacing"] > 0


def shape(page: Elements) -> list[tuple[str, list[str]]]:
    return [(name, sorted(attributes)) for name, attributes in page.tags]


def test_hostile_names_add_no_elements():
    page, hostile = without_plotly(plan_of_all_kinds()), without_plotly(hostile_plan())
    assert {name for name, _ in hostile.tags} <= {name for name, _ in page.tags}
    assert len(hostile.scripts) == 3
    assert "<img src=x onerror=alert(1)>" in hostile.text


@settings(max_examples=15)
@given(names=st.lists(st.text(st.characters(codec=None), max_size=8), min_size=7, max_size=7, unique=True))
def test_no_name_changes_the_structure_of_the_page(names: list[str]):
    plan = plan_of_all_kinds(tuple(names), source=names[0])
    page = without_plotly(plan)
    assert shape(page) == shape(without_plotly(plan_of_all_kinds()))
    assert json.loads(page.scripts[0][1])
    # Half of a pair of surrogates, which JSON can hold, has no bytes in UTF-8.
    " ".join([page.text, page.scripts[0][1]]).encode()


def test_long_names_are_cut():
    page = without_plotly(plan_of_all_kinds(("x" * 10_000_000, *"bcdefg"), source="y" * 1_000_000))
    assert len(page.text) < 10_000 and len(page.scripts[0][1]) < 50_000


def test_an_unwritable_place_leaves_nothing(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError):
        write_map_html(plan_of_all_kinds(), tmp_path / "file" / "map.html")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_depot_is_where_hovering_says():
    depot = traces(plan_figure(plan_of_all_kinds()), "depot")[0]
    assert depot.hovertext[0] == f"<b>depot</b><br>lat {DEPOT[0]:.7f}, lon {DEPOT[1]:.7f}"
    assert not np.any([depot.x, depot.y])
