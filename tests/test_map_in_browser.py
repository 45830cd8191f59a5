"""The map of a plan in a real browser, opened as a file. Opening takes a second, so each test looks at several things."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from browser import Visit, running_browser, visit_in
from mission_plans import HOSTILE, hostile_plan, plan_of_all_kinds, spread_plan

pytest.importorskip("pyproj")
pytest.importorskip("plotly")

from sb3_uav.missions.plan import Plan
from sb3_uav.missions.writers.map_html import write_map_html

if TYPE_CHECKING:
    from playwright.sync_api import Browser

Opener = Callable[..., AbstractContextManager[Visit]]

# Where a point of a trace is in the window.
PLACE = """([role, uav, row]) => {
    const map = document.getElementById("map");
    const box = map.querySelector(".nsewdrag").getBoundingClientRect();
    const trace = map.data.find(({ meta }) => meta.role === role && (meta.uav ?? null) === uav);
    const { xaxis, yaxis } = map._fullLayout;
    return [box.left + xaxis.d2p(trace.x[row]), box.top + yaxis.d2p(trace.y[row])];
}"""

PAUSE_MS = 400


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as running:
        yield running


@pytest.fixture
def opened(browser: Browser, tmp_path: Path) -> Opener:
    @contextmanager
    def open_map(plan: Plan, allowed: tuple[str, ...] = (), **window: int) -> Iterator[Visit]:
        path = tmp_path / "map.html"
        write_map_html(plan, path)
        with visit_in(browser, allowed, **window) as visit:
            visit.page.goto(path.as_uri())
            visit.page.wait_for_selector("#map[data-ready=yes]")
            yield visit
            # Pictures of the page's own, such as the one that is downloaded, are no requests.
            assert {url for url in visit.requests if not url.startswith(("blob:", "data:"))} == {path.as_uri()}

    return open_map


def place(visit: Visit, role: str, uav: int | None, row: int) -> tuple[float, float]:
    x, y = visit.page.evaluate(PLACE, [role, uav, row])
    return x, y


def click(visit: Visit, x: float, y: float) -> None:
    # Two clicks in quick succession are a double click.
    visit.page.wait_for_timeout(PAUSE_MS)
    visit.page.mouse.click(x, y)


def of_traces(visit: Visit, field: str, role: str) -> dict[int, Any]:
    """A field of the traces of this role, by UAV."""
    command = f"() => map.data.filter((t) => t.meta.role === '{role}').map((t) => [t.meta.uav, t.{field}])"
    return dict(visit.page.evaluate(command))


def lit(visit: Visit) -> str | None:
    return visit.page.get_attribute("#map", "data-lit")


@pytest.mark.slow
def test_all_tours_are_there_and_the_legend_hides_them(opened: Opener):
    with opened(plan_of_all_kinds()) as visit:
        page = visit.page
        assert page.title() == "tasks"
        assert page.locator(".scatterlayer .js-line[d^=M]").count() >= 2
        numbers = page.locator(".scatterlayer .textpoint").all_text_contents()
        assert sorted(text.strip() for text in numbers) == ["1", "1", "2", "3"]
        assert page.locator("#routes tbody tr").count() == 3
        assert page.get_by_text("A person must review this plan").is_visible()
        assert page.locator(".legendtoggle").count() == 3 + 3 + 2 + 1
        page.locator(".legendtoggle").first.click()
        page.wait_for_function("() => map.data[0].visible === 'legendonly'")
        for role in ("tour", "stops", "entry"):
            hidden = of_traces(visit, "visible", role)
            assert hidden[0] == "legendonly" and "legendonly" not in (hidden[1], hidden[2])
        # What is hidden cannot be hit.
        page.mouse.click(*place(visit, "stops", 0, 1))
        assert lit(visit) == ""
        page.locator(".legendtoggle").first.click()
        page.wait_for_function("() => map.data[0].visible === true")
        page.mouse.click(*place(visit, "stops", 0, 1))
        assert lit(visit) == "0"


@pytest.mark.slow
def test_a_click_lights_a_tour_up_and_another_resets(opened: Opener):
    with opened(plan_of_all_kinds()) as visit:
        page = visit.page
        click(visit, *place(visit, "stops", 0, 1))
        assert lit(visit) == "0"
        assert of_traces(visit, "opacity", "tour") == {0: 1, 1: 0.12, 2: 0.12}
        assert of_traces(visit, "opacity", "stops") == {0: 1, 1: 0.12, 2: 0.12}
        assert of_traces(visit, "line.width", "tour")[0] > of_traces(visit, "line.width", "tour")[1]
        assert page.locator("button[data-uav='0']").get_attribute("aria-pressed") == "true"
        click(visit, *place(visit, "stops", 0, 2))
        assert lit(visit) == ""
        assert set(of_traces(visit, "opacity", "tour").values()) == {1}
        # The middle of a leg, where no stop is.
        click(visit, *place(visit, "tour", 1, 3))
        assert lit(visit) == "1"
        page.keyboard.press("Escape")
        assert lit(visit) == ""
        page.locator("button[data-uav='1']").click()
        assert lit(visit) == "1"
        page.evaluate("() => window.scrollTo(0, 0)")
        click(visit, *place(visit, "stops", 0, 0))
        assert lit(visit) == "0"
        # Empty ground resets, and whoever moves the map has not clicked.
        box = page.locator(".nsewdrag").bounding_box()
        assert box is not None
        x, y = box["x"] + 40, box["y"] + 200
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 100, y - 30, steps=3)
        page.mouse.up()
        assert lit(visit) == "0"
        click(visit, x, y)
        assert lit(visit) == ""
        # One task is 22 km in the north.
        assert page.evaluate("() => map._fullLayout.yaxis.range[1]") < 3_000
        page.wait_for_timeout(PAUSE_MS)
        page.mouse.dblclick(x, y)
        page.wait_for_function("() => map._fullLayout.yaxis.range[1] > 20000")
        assert lit(visit) == ""


def test_hovering_shows_names_as_text(opened: Opener):
    with opened(hostile_plan()) as visit:
        page = visit.page
        assert page.title() == HOSTILE
        for uav, row in ((0, 0), (0, 1), (1, 0), (1, 1)):
            page.mouse.move(0, 0)
            page.mouse.move(*place(visit, "stops", uav, row))
            page.wait_for_function(f"() => document.querySelector('.hoverlayer')?.textContent.includes('stop {row + 1} of 2')")
            shown = page.locator(".hoverlayer").text_content() or ""
            assert hostile_plan().tasks.ids[2 * uav + row] in shown
        for tag in ("img", "svg[onload]", "a[href^=javascript]"):
            assert page.locator(tag).count() == 0
        assert page.locator("script").count() == 3
        assert page.locator("#routes tbody td").first.inner_text().strip() == "</script><script>alert(2)</script>"


def test_the_picture_can_be_saved_and_the_policy_stops_scripts_and_requests(opened: Opener, tmp_path: Path):
    with opened(plan_of_all_kinds(), allowed=("Content Security Policy",)) as visit:
        page = visit.page
        titles = page.locator(".modebar-btn").evaluate_all("buttons => buttons.map((button) => button.dataset.title)")
        assert len(titles) == 6 and not any("hare" in title or "loud" in title for title in titles)
        page.mouse.move(*place(visit, "depot", None, 0))
        with page.expect_download() as download:
            page.locator(".modebar-btn").first.click()
        download.value.save_as(tmp_path / "map.png")
        assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
        assert not visit.errors
        page.evaluate(
            """() => {
                document.body.insertAdjacentHTML("beforeend", "<img src='data:,' onerror='window.ran = 1'>");
                const script = document.createElement("script");
                script.textContent = "window.ran = 2";
                document.body.append(script);
            }"""
        )
        assert page.evaluate("() => fetch('data:,').then(() => 'sent', () => 'stopped')") == "stopped"
        page.wait_for_function("() => document.images[0].complete")
        assert page.evaluate("() => window.ran ?? null") is None
        assert sum("Content Security Policy" in error for error in visit.errors) >= 3


@pytest.mark.slow
def test_a_small_window_in_which_stops_get_their_numbers_when_zoomed(opened: Opener):
    with opened(spread_plan(400, 12), width=390, height=800) as visit:
        page = visit.page
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        box = page.locator(".nsewdrag").bounding_box()
        assert box is not None and min(box["width"], box["height"]) > 150
        assert page.locator(".scatterlayer .textpoint").count() == 0
        before = page.locator("#scale").inner_text()
        page.evaluate("() => Plotly.relayout(map, { 'xaxis.range': [0, 500], 'yaxis.range': [0, 500] })")
        page.wait_for_selector(".scatterlayer .textpoint", state="attached")
        after = page.locator("#scale").inner_text()
        assert after != before
        ruler = page.locator("#scale").bounding_box()
        pixels = page.evaluate("() => { const x = map._fullLayout.xaxis; return x._length / (x.range[1] - x.range[0]); }")
        assert ruler is not None and ruler["width"] == pytest.approx(float(after.removesuffix(" m")) * pixels, abs=1)


@pytest.mark.slow
def test_a_thousand_tasks(opened: Opener):
    with opened(spread_plan(1_000, 10)) as visit:
        points = visit.page.locator(".scatterlayer .point").count()
        assert points >= 1_000
        visit.page.mouse.click(*place(visit, "stops", 7, 40))
        assert lit(visit) == "7"
        opacity = of_traces(visit, "opacity", "stops")
        assert json.dumps(sorted(opacity.values())) == json.dumps([0.12] * 9 + [1])
