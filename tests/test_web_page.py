"""The served page in a real browser."""

from __future__ import annotations

import http.server
import re
import threading
import zipfile
from collections.abc import Iterator
from typing import Any

import pytest
from browser import Visit, running_browser, visit_in
from web_server import Served, problem, served

for module in ("fastapi", "uvicorn", "pyproj", "plotly", "matplotlib", "numba"):
    pytest.importorskip(module)

# Chromium reports every answer from 400 on.
REFUSED = r"status of 4\d\d"
HOSTILE = "<img src=x onerror=alert(1)>"
FIELD = "id,lat,lon,value,depot\nbase,47.0,8.0,,yes\n" + "".join(
    f"p{task},{47 + (task % 5 - 2) / 200},{8 + (task // 5 - 2) / 200 + 0.001},{1 + task % 3},\n" for task in range(24)
)


@pytest.fixture(scope="module")
def server() -> Iterator[Served]:
    with served(max_body_mb=1.0) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with running_browser() as found:
        yield found


def opened(visit: Visit, server: Served) -> Any:
    visit.page.goto(server.url)
    visit.page.wait_for_selector("body[data-ready]")
    return visit.page


def drop(page: Any, name: str, content: str) -> None:
    """Drop a file anywhere on the page, as a person does."""
    transfer = page.evaluate_handle(
        "([name, content]) => { const t = new DataTransfer(); t.items.add(new File([content], name)); return t; }",
        [name, content],
    )
    page.dispatch_event("#stage", "drop", {"dataTransfer": transfer})


def plan(page: Any, seconds: str = "0.5") -> None:
    page.fill("#time", seconds)
    page.click("#solve")
    page.wait_for_selector("#state[data-state=done]")


def click_map(page: Any, x: float, y: float) -> None:
    page.click("#map", position={"x": x, "y": y})


def click_task(page: Any, task: str) -> None:
    # After the next frame: the map draws what was changed then.
    place = page.evaluate(
        """(id) => new Promise((done) => requestAnimationFrame(
            () => done(document.getElementById("map").mission.pixelOfTask(id))))""",
        task,
    )
    click_map(page, *place)


@pytest.mark.slow
def test_from_a_file_to_a_zip(server: Served, browser: Any, tmp_path):
    with visit_in(browser) as visit:
        page = opened(visit, server)
        drop(page, "field.csv", FIELD)
        page.get_by_text("24 tasks").wait_for()
        page.fill("#count", "2")
        page.fill("#range", "6")
        plan(page)
        routes = page.locator("#routes button")
        assert routes.count() == 2
        # A tour, and a stop of it.
        routes.first.click()
        details = page.locator("#details")
        assert "Used of the range" in details.inner_text()
        stop = details.locator("ol button").first.inner_text()
        details.locator("ol button").first.click()
        assert details.locator("h3").inner_text() == f"Task {stop}"
        assert "1 of" in details.inner_text()
        # Forbid it, and plan again.
        details.get_by_role("button", name="Forbid").click()
        assert page.locator("#stale").is_visible()
        plan(page)
        page.locator("#skipped-box summary").click()
        assert f"{stop} forbidden by you" in page.locator("#skipped").inner_text()
        assert not page.locator("#stale").is_visible()
        # A reload loses nothing.
        figures = page.locator("#figures").inner_text()
        page.reload()
        page.wait_for_selector("#routes button")
        assert page.locator("#figures").inner_text() == figures
        assert (page.input_value("#count"), page.input_value("#range")) == ("2", "6")
        assert "24 tasks · 1 forbidden" in page.locator("#tasks-summary").inner_text()
        page.get_by_text("Download", exact=True).click()
        with page.expect_download() as download:
            page.click("#download")
        download.value.save_as(tmp_path / "mission.zip")
    with zipfile.ZipFile(tmp_path / "mission.zip") as archive:
        assert "mission/routes.geojson" in archive.namelist()


def test_by_clicks_on_the_map(server: Served, browser: Any):
    with visit_in(browser) as visit:
        page = opened(visit, server)
        page.click("#depot")
        click_map(page, 400, 400)
        page.click("#add")
        for x, y in ((300, 300), (500, 350), (450, 500)):
            click_map(page, x, y)
        page.keyboard.press("Escape")
        assert page.locator("#tasks-summary").inner_text().startswith("3 tasks · x, y in meters")
        page.fill("#range", "2")
        plan(page)
        # A click on a stop of the map shows it; Move puts it where the next click is.
        click_task(page, "t2")
        details = page.locator("#details")
        assert details.locator("h3").inner_text() == "Task t2"
        before = details.locator("input").nth(2).input_value()
        details.get_by_role("button", name="Move").click()
        click_map(page, 600, 200)
        assert page.locator("#stale").is_visible()
        click_task(page, "t2")
        assert details.locator("input").nth(2).input_value() != before
        details.get_by_role("button", name="Delete").click()
        assert page.locator("#tasks-summary").inner_text().startswith("2 tasks")


def test_across_the_antimeridian(server: Served, browser: Any):
    with visit_in(browser) as visit:
        page = opened(visit, server)
        drop(page, "field.csv", "id,lat,lon,depot\nbase,-17,179.99,yes\nwest,-17,179.98,\neast,-17.001,-179.99,\n")
        page.get_by_text("2 tasks").wait_for()
        west, east = (
            page.evaluate("(id) => document.getElementById('map').mission.pixelOfTask(id)", id) for id in ("west", "east")
        )
        # 0.03 degrees, over most of the width of the map.
        assert 500 < east[0] - west[0] < 1000
        page.click("#add")
        click_map(page, east[0] - 40, east[1] - 100)
        page.keyboard.press("Escape")
        plan(page, "0.2")
        assert page.locator("#figures").inner_text().split("\n")[1] == "3 of 3"
        click_task(page, "t3")
        longitude = float(page.locator("#details input").nth(3).input_value())
        assert -180 < longitude < -179.99
        # A fleet, dropped too.
        drop(page, "my fleet.csv", "id,range_m\nkestrel,9000\nheron,5000\n")
        page.get_by_label("Name").nth(1).wait_for()
        assert [page.get_by_label("Name").nth(row).input_value() for row in range(2)] == ["kestrel", "heron"]
        # What nothing brings back is asked for twice.
        page.click("#clear")
        assert "3 tasks" in page.locator("#tasks-summary").inner_text()
        page.click("#clear")
        assert page.locator("#tasks-summary").inner_text() == "No tasks yet."


@pytest.mark.slow
def test_a_second_browser_waits_in_the_queue(server: Served, browser: Any):
    with visit_in(browser) as first, visit_in(browser) as second:
        for visit in (first, second):
            opened(visit, server).get_by_text("Load an example").click()
            visit.page.fill("#time", "60")
        asked: list[str] = []
        first.page.on("request", lambda request: asked.append(request.url) if request.method == "POST" else None)
        first.page.dblclick("#solve")
        first.page.locator("#state", has_text="getting better").wait_for()
        assert sum(url.endswith("/solves") for url in asked) == 1
        second.page.click("#solve")
        second.page.locator("#state", has_text="next in the queue").wait_for()
        # A reload while it runs: the page goes on where it was.
        first.page.reload()
        first.page.locator("#state", has_text="getting better").wait_for()
        first.page.click("#cancel")
        first.page.locator("#state", has_text="Stopped; the best plan so far is shown").wait_for()
        assert first.page.locator("#routes button").count() == 3
        second.page.locator("#state", has_text="getting better").wait_for()
        second.page.click("#cancel")
        second.page.wait_for_selector("#state[data-state=canceled]")


@pytest.mark.slow
def test_a_solve_that_is_left_ends(server: Served, browser: Any):
    assert server.rooms is not None
    with visit_in(browser) as visit:
        page = opened(visit, server)
        blocking = server.solve(n_tasks=40, time_limit=60.0)
        server.wait(blocking, "running")
        drop(page, "field.csv", FIELD)
        page.get_by_text("24 tasks").wait_for()
        page.fill("#time", "60")
        page.click("#solve")
        page.wait_for_selector("#state[data-state=waiting]")
        # There is no plan yet, but what comes will be one of the old tasks.
        page.fill("#count", "7")
        page.locator("#count").blur()
        page.wait_for_selector("#stale:not([hidden])", state="attached", timeout=5000)
        with page.expect_response(lambda answer: answer.request.method == "DELETE", timeout=5000) as left:
            drop(page, "field.csv", FIELD)
        assert left.value.json()["state"] == "canceled" and server.rooms.solves.n_waiting == 0
        server.ask("DELETE", f"/api/v1/solves/{blocking}")
        seconds = "import('/static/tools.js').then(({ minutes }) => [59.7, 119.6, 61].map(minutes))"
        assert page.evaluate(seconds) == ["1 min 0 s", "2 min 0 s", "1 min 1 s"]


def test_errors_are_sentences(server: Served, browser: Any):
    with visit_in(browser, allowed=(REFUSED,)) as visit:
        page = opened(visit, server)
        error = page.locator("#error span")
        drop(page, "a.csv", "id,lat,lon\nx,95,8\n")
        page.wait_for_selector("#error:not([hidden])")
        assert "row 2" in error.inner_text()
        drop(page, "large.csv", "x" * 2**21)
        page.locator("#error", has_text="this server admits 1").wait_for()
        drop(page, "field.csv", FIELD.replace(",,yes", ",1,"))
        page.get_by_text("no depot yet").wait_for()
        page.click("#solve")
        page.locator("#error", has_text="There is no depot").wait_for()
        page.fill("#range", "")
        page.click("#solve")
        page.locator("#error", has_text="The range is missing").wait_for()


def test_names_are_never_html(server: Served, browser: Any):
    with visit_in(browser, allowed=(REFUSED,)) as visit:
        page = opened(visit, server)
        quoted = HOSTILE.replace('"', '""')
        drop(page, f"{HOSTILE[:9]}.csv", f'id,x,y,depot\nd,0,0,yes\n"{quoted}",50,50,\nfar,90000,0,\n')
        page.get_by_text("2 tasks").wait_for()
        page.get_by_text("Set each UAV by itself").click()
        page.get_by_label("Name").first.fill(HOSTILE)
        page.keyboard.press("Tab")
        plan(page, "0.2")
        click_task(page, HOSTILE)
        assert page.locator("#details h3").inner_text() == f"Task {HOSTILE}"
        assert HOSTILE in page.locator("#routes").inner_text()
        assert page.locator("aside img").count() == page.locator("#stage img").count() == 0


def test_the_login_form(browser: Any):
    with served(token="a-token-of-these-tests") as guarded, visit_in(browser, allowed=(REFUSED,)) as visit:
        page = visit.page
        page.goto(guarded.url)
        assert page.url.endswith("/login")
        page.fill("#token", "wrong")
        page.click("button")
        page.get_by_text("This is not the token.").wait_for()
        page.fill("#token", "a-token-of-these-tests")
        page.click("button")
        page.wait_for_selector("body[data-ready]")


def test_tiles_come_from_their_server_alone(browser: Any):
    asked: list[str] = []

    class Tiles(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.send_header("content-type", "image/svg+xml")
            self.end_headers()
            self.wfile.write(
                b'<svg xmlns="http://www.w3.org/2000/svg" width="256" height="256"><rect width="256" height="256"/></svg>'
            )

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Tiles) as tiles:
        threading.Thread(target=tiles.serve_forever).start()
        try:
            with served(tiles=f"http://127.0.0.1:{tiles.server_port}/{{z}}/{{x}}/{{y}}.svg") as server:
                with visit_in(browser) as visit:
                    page = opened(visit, server)
                    page.locator("#attribution", has_text="Map tiles: 127.0.0.1").wait_for()
                    drop(page, "field.csv", FIELD)
                    page.get_by_text("24 tasks").wait_for()
                    # A canvas with pictures from elsewhere can no longer be read: they have been drawn.
                    page.wait_for_timeout(500)
                    read = "document.getElementById('map').getContext('2d').getImageData(3, 3, 1, 1)"
                    with pytest.raises(Exception, match="tainted by cross-origin data"):
                        page.evaluate(read)
        finally:
            tiles.shutdown()
    levels = {int(path.split("/")[1]) for path in asked}
    assert 0 <= min(levels) <= 3 and 12 <= max(levels) <= 19
    # Tile 8 degrees east and 47 degrees north of level 13, see https://wiki.openstreetmap.org/wiki/Slippy_map_tilenames.
    assert any(path.startswith(f"/{level}/{int((8 + 180) / 360 * 2**level)}/") for path in asked for level in levels)


def test_a_narrow_window_shows_everything(server: Served, browser: Any):
    with visit_in(browser, width=390, height=800) as visit:
        page = opened(visit, server)
        page.get_by_text("Load an example").click()
        plan(page, "0.3")
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390
        assert re.search(r"of 80", page.locator("#figures").inner_text())


def test_a_draft_of_the_api_opens_in_the_page(server: Served, browser: Any):
    with visit_in(browser) as visit:
        page = opened(visit, server)
        page.get_by_text("Load an example").click()
        page.get_by_text("80 tasks").wait_for()
        page.wait_for_load_state("networkidle")
        cookies = "; ".join(f"{cookie['name']}={cookie['value']}" for cookie in visit.context.cookies())
        draft = {"tasks": problem()["tasks"], "form": {"count": "5"}}
        assert server.ask("PUT", "/session", draft, {"cookie": cookies}).status == 200
        page.reload()
        page.get_by_text("12 tasks").wait_for()
        assert page.input_value("#count") == "5"
