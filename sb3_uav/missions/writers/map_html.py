"""Write a plan as a map in one HTML file, which works without a network."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from importlib.resources import files
from pathlib import Path
from typing import Any

from sb3_uav.common.files import write_atomically
from sb3_uav.common.optional import require
from sb3_uav.missions.drawing import uav_sample
from sb3_uav.missions.labels import (
    count,
    duration,
    escaped,
    headline,
    meters,
    number,
    percent,
    why_skipped,
)
from sb3_uav.missions.map_points import map_points
from sb3_uav.missions.plan import Plan, Route
from sb3_uav.missions.remarks import REVIEW
from sb3_uav.missions.writers.map_figure import (
    LARGEST_SKIPPED,
    LARGEST_STOP,
    NUMBERED_STOP,
    SMALLEST_STOP,
    STOP_SHARE,
    plan_figure,
)

# Sentences are not cut where names are.
_SENTENCE = 2_000
_MAX_REMARKS = 200


def write_map_html(plan: Plan, path: str | os.PathLike[str]) -> None:
    """
    Write a plan as a page with an interactive map and a table of the routes.

    The page holds plotly.js. It makes no request. Its Content-Security-Policy would stop any, and every script that a hostile
    file smuggles in by a name: see https://www.w3.org/TR/CSP3/.

    :param plan: A plan
    :param path: The ``.html`` to write
    :raises ImportError: If plotly is not installed
    :raises OSError: If the file cannot be written
    """
    write_atomically(Path(path), map_page(plan))


def map_page(plan: Plan) -> str:
    """
    :param plan: A plan
    :return: The page of :func:`write_map_html`
    :raises ImportError: If plotly is not installed
    """
    plotly = _normalized(require("plotly.offline", "The map", "missions").get_plotlyjs())
    script = _normalized(_resource("map.js"))
    # Only these two scripts may run: not even plotly's rarely used compilers of code need more.
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src {_source_hash(plotly)} {_source_hash(script)}",
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    title = escaped(Path(plan.tasks.source).name)
    body = "\n".join(
        [
            f"<h1>{title}</h1>",
            f'<p class="headline">{escaped(headline(plan), _SENTENCE)}</p>',
            _remarks(plan),
            '<div class="frame"><div id="map"></div><div id="scale" class="scale"></div></div>',
            "<noscript><p>The map needs JavaScript; the tables do not.</p></noscript>",
            _outside(plan),
            '<p class="hint">Click a tour or a stop to light up its UAV, and again to reset. Click the legend to hide a UAV. '
            "Scroll to zoom: stops that lie close together get their numbers then. Drag to move, double-click to see all.</p>",
            _routes_table(plan),
            _skipped_table(plan),
            f'<p class="made">{_made_by(plan)}</p>',
        ]
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{_resource("map.css")}</style>
</head>
<body>
{body}
<script id="page" type="application/json">{_page_data(plan)}</script>
<script>{plotly}</script>
<script>{script}</script>
</body>
</html>
"""


def _resource(name: str) -> str:
    return files("sb3_uav.missions.writers").joinpath(name).read_text(encoding="utf-8")


def _normalized(script: str) -> str:
    """The text that a browser hashes, which has replaced the ends of lines."""
    return script.replace("\r\n", "\n").replace("\r", "\n")


def _source_hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _page_data(plan: Plan) -> str:
    """What the script of the page reads, without a character that could end the element around it."""
    figure: dict[str, Any] = json.loads(plan_figure(plan).to_json())
    # The page has a headline of its own.
    del figure["layout"]["title"]
    figure["layout"]["margin"]["t"] = 34
    data = {
        "figure": figure,
        "spacing": map_points(plan).spacing,
        "sizes": [SMALLEST_STOP, LARGEST_STOP, NUMBERED_STOP, STOP_SHARE],
        "largestSkipped": LARGEST_SKIPPED,
    }
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _remarks(plan: Plan) -> str:
    others = [remark for remark in plan.remarks if remark != REVIEW]
    lines = [f'<p class="review">{escaped(REVIEW, _SENTENCE)}</p>']
    lines += [f"<p>{escaped(remark, _SENTENCE)}</p>" for remark in others[:_MAX_REMARKS]]
    if len(others) > _MAX_REMARKS:
        lines.append(f"<p>And {count(len(others) - _MAX_REMARKS, 'more remark')}, in summary.json.</p>")
    return f'<div class="remarks" role="note">{"".join(lines)}</div>'


def _outside(plan: Plan) -> str:
    n_outside = map_points(plan).n_outside
    if not n_outside:
        return ""
    verb = "lies" if n_outside == 1 else "lie"
    return f'<p class="outside">{count(n_outside, "task")} {verb} far away, outside of this view. Double-click to see all.</p>'


def _routes_table(plan: Plan) -> str:
    has_service = any(route.service_m > 0 for route in plan.routes)
    has_time = any(route.seconds is not None for route in plan.routes)
    words = ' class="words"'
    head = [
        "UAV",
        "Stops",
        "Value",
        "Length",
        *["Service"] * has_service,
        "Range",
        "Used of it",
        *["Time in the air"] * has_time,
    ]
    rows = []
    for uav, route in enumerate(plan.routes):
        value = float(plan.tasks.values[list(route.stops)].sum())
        cells = [
            f'{uav_sample(uav)}<button class="name" type="button" data-uav="{uav}" aria-pressed="false">'
            f"{escaped(route.uav.id)}</button>",
            f"{len(route.stops):,}",
            number(value),
            meters(route.length_m),
            *[meters(route.service_m)] * has_service,
            meters(route.uav.range_m),
            _share(route),
            *[duration(route.seconds) if route.seconds and route.flies else ""] * has_time,
        ]
        rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    titles, lines = "".join(f"<th{words * (name == 'Used of it')}>{name}</th>" for name in head), "\n".join(rows)
    foot = ["All", f"{plan.n_served:,}", number(plan.objective), meters(plan.length_m)]
    foot += [""] * (len(head) - len(foot))
    return (
        '<h2>Routes</h2>\n<div class="wide"><table id="routes"><thead><tr>'
        f"{titles}</tr></thead>\n<tbody>{lines}</tbody>\n"
        f"<tfoot><tr>{''.join(f'<td>{cell}</td>' for cell in foot)}</tr></tfoot></table></div>"
    )


def _share(route: Route) -> str:
    """The part of the range that is used, with a mark where the reserve begins."""
    usable = 100 - route.uav.reserve_percent
    mark = f'<b style="left:{usable:.2f}%" title="reserve"></b>' if route.uav.reserve_percent > 0 else ""
    width = min(100 * route.share_of_range, 100)
    return f'{percent(route.share_of_range)}<span class="share"><i style="width:{width:.2f}%"></i>{mark}</span>'


def _skipped_table(plan: Plan) -> str:
    if not plan.skipped:
        return ""
    tasks = plan.tasks
    ranked = sorted(plan.skipped, key=lambda one: (not tasks.must[one.task], one.reason, one.missing_m or 0.0, one.task))
    rows = []
    for one in ranked:
        must = ' <span class="must">must be served</span>' if tasks.must[one.task] else ""
        cells = (
            f"<td>{escaped(tasks.ids[one.task])}{must}</td>",
            f"<td>{number(float(tasks.values[one.task]))}</td>",
            f'<td class="words">{escaped(why_skipped(one))}</td>',
        )
        rows.append(f"<tr>{''.join(cells)}</tr>")
    lines = "\n".join(rows)
    return (
        f'<details id="skipped"><summary>{count(len(plan.skipped), "task")} left out</summary>\n<div class="wide"><table>'
        '<thead><tr><th>Task</th><th>Value</th><th class="words">Reason</th></tr></thead>\n'
        f"<tbody>{lines}</tbody></table></div></details>"
    )


def _made_by(plan: Plan) -> str:
    # Not at the top: a room's version is a detail of the whole package.
    from sb3_uav import __version__

    return f"sb3-uav {escaped(__version__)}, solver {escaped(plan.solver, 200)}, seed {plan.seed}, {plan.seconds:.1f} s"
