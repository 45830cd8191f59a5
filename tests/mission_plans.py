"""Plans for tests of what is drawn and written: made by hand, so that no solver has to run."""

from __future__ import annotations

from collections.abc import Iterator
from html.parser import HTMLParser
from typing import Any

import numpy as np

from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.plan import Plan
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList

DEPOT = (47.0, 8.0)
HOSTILE = "<img src=x onerror=alert(1)>"
HOSTILES = (
    HOSTILE,
    "</script><script>alert(2)</script>",
    "\"'><svg onload=alert(3)>",
    "<a href='javascript:alert(4)'>a</a>",
    "]]>",
)


def plan_of_all_kinds(names: tuple[str, ...] = ("a", "b", "c", "d", "e", "f", "g"), **others: Any) -> Plan:
    """
    Two UAVs fly, one from a start of its own; one stays. Of seven tasks, one is out of reach and must be served, one is worth
    nothing, and one did not fit.

    :param names: Of the tasks
    :param others: Other fields of the tasks
    :return: The plan
    """
    places = [(47.01, 8.0), (47.01, 8.01), (47.0, 8.02), (46.99, 8.0), (47.2, 8.0), (47.001, 8.0), (46.98, 7.99)]
    tasks = TaskList.of(
        names,
        places,
        "wgs84",
        values=[1, 2, 3, 4, 5, 0, 7],
        service_s=[0, 0, 30, 0, 0, 0, 0],
        must=[0, 1, 0, 0, 1, 0, 0],
        depot=DEPOT,
        **others,
    )
    fleet = Fleet(
        (
            Uav("first", 6_000.0, 10.0, reserve_percent=10),
            Uav("second", 5_000.0, 12.0, start=(46.995, 8.0)),
            Uav("third", 1_000.0, 9.0),
        )
    )
    return make_plan(tasks, fleet, Schedule([[0, 1, 2], [3], []]), "by hand", seed=7)


def hostile_plan() -> Plan:
    """:return: A plan with a name that is an attack wherever a file may say one"""
    names = tuple(f"{attack}{task}" for task, attack in enumerate((*HOSTILES, *HOSTILES)[:7]))
    plan = plan_of_all_kinds(names, source=HOSTILE)
    uavs = tuple(Uav(attack, 9_000.0, 10.0) for attack in HOSTILES[1:4])
    return make_plan(plan.tasks, Fleet(uavs, HOSTILE), Schedule([[0, 1], [2, 3], []]), HOSTILE)


def spread_plan(n_tasks: int, n_uavs: int, system: str = "wgs84", center: tuple[float, float] = DEPOT) -> Plan:
    """
    :param n_tasks: Number of tasks, in sectors around the depot
    :param n_uavs: Number of UAVs, each with a sector
    :param system: ``"wgs84"`` or ``"plane"``
    :param center: The depot
    :return: A plan that serves everything
    """
    rng = np.random.default_rng(n_tasks)
    angles, radii = np.sort(rng.uniform(0, 2 * np.pi, n_tasks)), rng.uniform(0.005, 0.05, n_tasks)
    offsets = radii[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    points = np.array(center) + (offsets if system == "wgs84" else offsets * 1e5)
    if system == "wgs84":
        points[:, 1] = (points[:, 1] + 180) % 360 - 180
    tasks = TaskList.of([f"t{task}" for task in range(n_tasks)], points, system, depot=center)  # type: ignore[arg-type]
    routes = [part.tolist() for part in np.array_split(np.arange(n_tasks), n_uavs)]
    return make_plan(tasks, Fleet.of_equal(n_uavs, 3e6, 10.0, reserve_percent=20), Schedule(routes), "by hand")


class Elements(HTMLParser):
    """
    What a browser would see in a text of HTML.

    :param text: The text
    :ivar tags: Every element, and its attributes
    :ivar scripts: Attributes and content of every script
    :ivar texts: What stands between tags, without scripts and styles
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.texts: list[str] = []
        self._inside = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = tag
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts[-1] = (self.scripts[-1][0], self.scripts[-1][1] + data)
        elif self._inside != "style":
            self.texts.append(data)

    def named(self, tag: str) -> Iterator[dict[str, str | None]]:
        """:return: Attributes of every element of this name"""
        return (attributes for name, attributes in self.tags if name == tag)

    @property
    def text(self) -> str:
        return " ".join(self.texts)
