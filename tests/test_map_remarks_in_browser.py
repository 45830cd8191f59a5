"""What a person should know before a flight is all in sight above the map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from browser import open_browser
from mission_plans import plan_of_all_kinds

pytest.importorskip("pyproj")
pytest.importorskip("plotly")

from sb3_uav.missions.writers.map_html import write_map_html

HIDDEN = "() => { const box = document.querySelector('.remarks'); return box.scrollHeight - box.clientHeight; }"


@pytest.mark.slow
def test_remarks_are_seen_without_scrolling(tmp_path: Path) -> None:
    plan = plan_of_all_kinds()
    plan = replace(plan, remarks=(*plan.remarks, *(f"Remark {number} of a plan with many." for number in range(6))))
    write_map_html(plan, tmp_path / "map.html")
    with open_browser() as visit:
        visit.page.goto((tmp_path / "map.html").as_uri())
        assert visit.page.evaluate(HIDDEN) <= 0
