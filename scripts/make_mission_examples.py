"""Makes the data of ``examples/missions``, the same at every run: ``python scripts/make_mission_examples.py``."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "missions"
_METERS_PER_DEGREE = 111_320.0


def main(folder: Path = FOLDER) -> None:
    """
    :param folder: Where to write
    """
    folder.mkdir(parents=True, exist_ok=True)
    _orchard(folder / "orchard.csv")
    _city(folder / "city.geojson")
    _city_fleet(folder / "city_fleet.csv")
    _lattice(folder / "lattice.csv")
    _lattice_status(folder / "lattice_status.csv")


def _degrees(center: Sequence[float], meters: np.ndarray) -> list[list[float]]:
    """:return: Latitudes and longitudes of points ``(n, 2)`` east and north of a center"""
    scale = _METERS_PER_DEGREE * np.array([1.0, math.cos(math.radians(center[0]))])
    return [[round(float(x), 6) for x in point] for point in np.array(center) + meters[:, ::-1] / scale]


def _turned(points: np.ndarray, degrees: float) -> np.ndarray:
    angle = math.radians(degrees)
    turned: np.ndarray = points @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return turned


def _write(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]], delimiter: str = ",") -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _orchard(path: Path) -> None:
    """120 survey points over the rows of an orchard, photographed for 8 s each; the shed is the depot."""
    rng = np.random.default_rng(1)
    grid = np.array([(60.0 * column, 55.0 * row) for row in range(10) for column in range(12)])
    points = _degrees((47.5312, 9.2874), _turned(grid + rng.uniform(-9, 9, grid.shape), 17.0))
    shed = _degrees((47.5312, 9.2874), np.array([[-70.0, 120.0]]))[0]
    rows = [
        ["shed", *shed, "", "yes"],
        *([f"R{n // 12 + 1:02d}-{n % 12 + 1:02d}", *point, 8, ""] for n, point in enumerate(points)),
    ]
    _write(path, ("id", "lat", "lon", "service_s", "depot"), rows, ";")


def _city(path: Path) -> None:
    """400 roofs and facades to inspect, in districts, with priorities from 1 to 10; twelve of them must be visited."""
    rng = np.random.default_rng(2)
    centers = rng.uniform(-2600, 2600, (9, 2))
    district = rng.integers(0, len(centers), 320)
    places = np.vstack([centers[district] + rng.normal(0, 330, (320, 2)), rng.uniform(-3200, 3200, (80, 2))])
    priorities = np.clip(rng.geometric(0.28, 400), 1, 10)
    must = set(rng.choice(np.flatnonzero(np.abs(places).max(axis=1) < 2500), 12, replace=False).tolist())
    center = (40.4168, -3.7038)
    features: list[dict[str, Any]] = [_feature(center, {"id": "base", "depot": True})]
    for number, point in enumerate(_degrees(center, places)):
        fields: dict[str, Any] = {"id": f"B{number + 1:03d}", "priority": int(priorities[number]), "service_s": 20}
        features.append(_feature(point, {**fields, "must": True} if number in must else fields))
    lines = ",\n".join(json.dumps(feature) for feature in features)
    path.write_text(f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n', encoding="utf-8")


def _feature(point: Sequence[float], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": "Point", "coordinates": [point[1], point[0]]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _city_fleet(path: Path) -> None:
    rows = [
        ("heavy-1", 38, 14, 15),
        ("heavy-2", 38, 14, 15),
        ("light-1", 26, 14, 15),
        ("light-2", 26, 14, 15),
        ("light-3", 26, 14, 15),
    ]
    _write(path, ("id", "endurance_min", "speed_mps", "reserve_percent"), rows)


def _lattice(path: Path) -> None:
    """100 points of a lattice in a plane, in meters; the depot is beside the middle of its lower side."""
    rows = [(f"p{i}{j}", 100 * i, 100 * j, "") for i in range(10) for j in range(10)]
    _write(path, ("id", "x_m", "y_m", "depot"), [("depot", 450, -60, "yes"), *rows])


def _lattice_status(path: Path) -> None:
    """At the launch one UAV is lost and another one is weak; tasks are done, new and not wanted, whatever the plan was."""
    rows = [
        ("lost", "uav-3", "", "", "", "", "", "battery does not charge"),
        ("uav", "uav-2", "", "", 60, "", "", "old battery"),
        ("done", "p40", "", "", "", "", "", "seen from the depot"),
        ("done", "p50", "", "", "", "", "", "seen from the depot"),
        ("drop", "p09", "", "", "", "", "", "owner does not agree"),
        ("task", "gate", 520, 330, "", 5, "yes", "reported this morning"),
    ]
    _write(path, ("what", "id", "x", "y", "remaining_percent", "value", "must", "note"), rows)


if __name__ == "__main__":
    main()
