"""
Draws the diagrams of the docs, the same at every run: ``python scripts/draw_diagrams.py``.

Each is one SVG with a background of its own and the colors of the reader's system, light or dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch as th

from sb3_uav.envs import Instances, UniformGenerator, nearest_feasible, plan_tours
from sb3_uav.envs.distances import euclidean
from sb3_uav.envs.routing import RoutingDynamics
from sb3_uav.training.its_schedule import EpochSchedule

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"
_WIDTH = 520
_STYLE = """
svg { font: 15px system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif }
.paper { fill: #fbfbfc } .panel { fill: #fff; stroke: #d5d9e0 }
text { fill: #1f2430 } .soft { fill: #545b6b } .small { font-size: 13px } .strong { font-weight: 600 }
.middle { text-anchor: middle } .end { text-anchor: end }
.line { fill: none; stroke: #6b7280; stroke-width: 1.5 } .head { fill: #6b7280 }
.task { fill: #fff; stroke: #8a90a0; stroke-width: 1.5 } .gone { fill: none; stroke: #b9bec9; stroke-dasharray: 2 2 }
.depot { fill: #1f2430 } .now { fill: none; stroke: #1f2430; stroke-width: 2 }
.a { fill: #2563c9 } .b { fill: #b85a00 } .c { fill: #1d7f49 }
.la { stroke: #2563c9 } .lb { stroke: #b85a00 } .lc { stroke: #1d7f49 }
.tour { fill: none; stroke-width: 2 } .on { fill: #fff } .rest { fill: #e3e6ec }
@media (prefers-color-scheme: dark) {
.paper { fill: #16191f } .panel { fill: #1d2129; stroke: #3a4150 }
text { fill: #e8eaf0 } .soft { fill: #aab1c0 }
.line { stroke: #98a0b0 } .head { fill: #98a0b0 }
.task { fill: #1d2129; stroke: #8f97a8 } .gone { stroke: #596173 }
.depot { fill: #e8eaf0 } .now { stroke: #e8eaf0 }
.a { fill: #6ea2ff } .b { fill: #f0a050 } .c { fill: #5cc98b }
.la { stroke: #6ea2ff } .lb { stroke: #f0a050 } .lc { stroke: #5cc98b }
.on { fill: #10131a } .rest { fill: #343b49 }
}
"""
_UAVS = "abc"


def main(folder: Path = FOLDER) -> None:
    """
    :param folder: Where to write
    """
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "two_levels.svg", 300, "An allocation of tasks to three UAVs, and their tours", _two_levels())
    _write(folder / "allocation_mdp.svg", 318, "One step of task allocation", _allocation())
    _write(folder / "routing_mdp.svg", 318, "One step of route planning", _routing())
    _write(folder / "its.svg", 330, "Epochs of the interactive training strategy", _its())


def _write(path: Path, height: int, title: str, parts: Sequence[str]) -> None:
    """
    :param path: The file
    :param height: Height of the picture
    :param title: What it shows
    :param parts: Its elements
    """
    size = f'viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">',
        f"<title>{title}</title>",
        f"<style>{_STYLE}</style>",
        f'<rect class="paper" width="{_WIDTH}" height="{height}" rx="8"/>',
        *parts,
        "</svg>",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


# ------------------------------------------------------------------------------------------------------ elements


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    text = text.replace("&", "&amp;").replace("<", "&lt;")
    return f'<text x="{x:g}" y="{y:g}" class="{kind}">{text}</text>'


def _arrow(x: float, y: float, to_x: float, to_y: float) -> str:
    """An arrow from one point to another."""
    angle = math.atan2(to_y - y, to_x - x)
    head = " ".join(f"{to_x + 9 * math.cos(angle + turn):.1f},{to_y + 9 * math.sin(angle + turn):.1f}" for turn in (2.7, -2.7))
    return f'<path class="line" d="M{x:g} {y:g} L{to_x:g} {to_y:g}"/><polygon class="head" points="{to_x:g},{to_y:g} {head}"/>'


def _panel(x: float, y: float, width: float, height: float) -> str:
    return f'<rect class="panel" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="5"/>'


def _dot(point: np.ndarray, kind: str, radius: float = 5) -> str:
    return f'<circle class="{kind}" cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="{radius:g}"/>'


def _depot(point: np.ndarray) -> str:
    return f'<rect class="depot" x="{point[0] - 6:.1f}" y="{point[1] - 6:.1f}" width="12" height="12"/>'


def _tour(points: Sequence[np.ndarray], uav: int, is_dashed: bool = False) -> str:
    """A line through points in the color of a UAV."""
    path = " L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    dashes = ' stroke-dasharray="4 4"' if is_dashed else ""
    return f'<path class="tour l{_UAVS[uav]}" d="M{path}"{dashes}/>'


# ------------------------------------------------------------------------------------------------------ the example


def _example() -> tuple[Instances, np.ndarray, list[list[list[int]]]]:
    """:return: An instance, the UAV of each of its tasks ``(n_tasks,)`` by sectors around the depot, and a tour per UAV"""
    instances = UniformGenerator(24, n_uavs=3, max_distance=1.35)(1, np.random.default_rng(11))
    instances.depot[:] = th.tensor([0.5, 0.45], dtype=th.float64)
    offset = (instances.tasks - instances.depot[:, None])[0].numpy()
    rank = np.arctan2(offset[:, 1], offset[:, 0]).argsort().argsort()
    uav = rank * 3 // len(rank)
    planned = plan_tours(instances, th.from_numpy(uav)[None, None], nearest_feasible)
    return instances, uav, [[task for task in tour if task >= 0] for tour in planned.tours[0, 0].tolist()]


def _placed(instances: Instances, x: float, y: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    """:return: Depot ``(2,)`` and tasks ``(n_tasks, 2)`` inside a panel"""
    corner, scale = np.array([x, y]) + 0.07 * size, 0.86 * size
    return corner + scale * instances.depot[0].numpy(), corner + scale * instances.tasks[0].numpy()


def _two_levels() -> list[str]:
    instances, uav, tours = _example()
    parts = []
    for x, title in ((16, "Allocator: UAVs for tasks"), (284, "Router: tours for UAVs")):
        parts += [_text(x + 110, 28, title, "middle strong"), _panel(x, 40, 220, 200)]
    depot, tasks = _placed(instances, 26, 40, 200)
    parts += [_dot(task, _UAVS[v]) for task, v in zip(tasks, uav, strict=True)] + [_depot(depot)]
    depot, tasks = _placed(instances, 294, 40, 200)
    for v, tour in enumerate(tours):
        parts.append(_tour([depot, *tasks[tour], depot], v))
        parts += [_dot(tasks[task], _UAVS[v]) for task in tour]
    parts += [_dot(tasks[task], "task") for task in set(range(len(tasks))).difference(*tours)]
    parts += [_depot(depot), _arrow(240, 140, 278, 140)]
    parts += ['<path class="line" d="M394 240 L394 274 L126 274"/>', _arrow(126, 274, 126, 246)]
    n_visited = sum(len(tour) for tour in tours)
    return [*parts, _text(260, 266, f"reward: {n_visited} tasks on the tours", "middle small")]


def _allocation() -> list[str]:
    instances, uav, _ = _example()
    depot, tasks = _placed(instances, 16, 40, 200)
    order = np.arange(len(tasks))
    now = 13
    parts = [_text(16, 28, f"State: task {now + 1} of {len(tasks)} has no UAV yet", "strong"), _panel(16, 40, 200, 200)]
    parts += [_dot(tasks[task], _UAVS[uav[task]] if task < now else "task") for task in order]
    parts += [_depot(depot), _dot(tasks[now], "now", 10)]
    parts.append(_text(300, 60, "Action: a UAV", "strong"))
    chosen = int(uav[now])
    for v, name in enumerate(("UAV 1", "UAV 2", "UAV 3")):
        y = 92 + 44 * v
        parts += [_arrow(222, 140, 294, y), _dot(np.array([312, y]), _UAVS[v], 11), _text(332, y + 5, name)]
        if v == chosen:
            parts += [_dot(np.array([312, y]), "now", 15), _text(388, y + 5, "chosen", "soft small")]
    parts.append(_text(300, 226, "then the next task, in order", "soft small"))
    parts.append(_text(16, 272, "Reward", "strong"))
    for step in range(len(tasks)):
        x = 92 + 13 * step
        is_last = step == len(tasks) - 1
        parts.append(f'<rect class="{"a" if is_last else "rest"}" x="{x}" y="{258 if is_last else 268}" width="9" '
                     f'height="{18 if is_last else 8}" rx="2"/>')  # fmt: skip
    return [
        *parts,
        _text(92, 300, "0 in every step", "soft small"),
        _text(504, 300, "value of all tours, at the end", "small end"),
    ]


def _routing() -> list[str]:
    v = 0
    one = UniformGenerator(14, n_uavs=1, max_distance=2.0)(1, np.random.default_rng(45))
    depot, tasks = _placed(one, 16, 40, 200)
    dynamics = RoutingDynamics(one)
    state = dynamics.reset()
    flown: list[int] = []
    while len(flown) < 5:
        here = dynamics.points(state.position)
        distance = euclidean(dynamics.nodes[:, None], here[:, :, None])
        action = distance.masked_fill(~state.action_mask, th.inf).argmin(-1)
        flown.append(int(action) - 1)
        state, _ = dynamics.step(state, action)
    legal = state.action_mask[0, 0, 1:].numpy()
    share = float(state.traveled[0, 0] / one.max_distance[0])
    parts = [_text(16, 28, "State: where the UAV is, what it visited", "strong"), _panel(16, 40, 200, 200)]
    parts.append(_tour([depot, *tasks[flown]], v))
    parts += [_tour([tasks[flown[-1]], tasks[task]], v, is_dashed=True) for task in np.flatnonzero(legal)]
    for task, point in enumerate(tasks):
        kind = _UAVS[v] if task in flown else "task" if legal[task] else "gone"
        parts.append(_dot(point, kind))
    parts += [_depot(depot), _dot(tasks[flown[-1]], "now", 10)]
    parts.append(_text(240, 60, "Action: the next task", "strong"))
    for y, kind, text in (
        (92, _UAVS[v], "visited"),
        (118, "task", "legal: there, and then home"),
        (144, "gone", "masked: too far for what is left"),
    ):
        parts += [_dot(np.array([248, y]), kind), _text(264, y + 5, text, "small")]
    parts += [
        _text(240, 178, "Only if no task is legal,", "small"),
        _text(240, 196, "the depot is: the UAV flies home", "small"),
        _text(240, 214, "and the episode ends.", "small"),
        _text(16, 272, "Range", "strong"),
        '<rect class="rest" x="92" y="260" width="412" height="14" rx="3"/>',
        f'<rect class="{_UAVS[v]}" x="92" y="260" width="{412 * share:.1f}" height="14" rx="3"/>',
        _text(92, 298, "flown", "soft small"),
        _text(504, 298, "left; reward: value of the task", "small end"),
    ]
    return parts


def _its() -> list[str]:
    """The schedule of the paper's U4 scenarios, as the callback computes it: E_p = 5, E_t = 8, E_c = 4."""
    schedule = EpochSchedule.of("its", 11, 5, 8, 4)
    cell, left = 15, 92
    rows = {"allocator": 112, "router": 176}
    cells: list[tuple[str, str]] = [("router", "pre-training")] * schedule.n_pretraining_epochs
    for epoch in range(1, schedule.n_epochs + 1):
        phase = schedule.phase(epoch)
        cells.append(("allocator", phase))
        cells += [("router", phase)] * schedule.router_epochs_after(epoch)
    parts = [_text(16, 30, "One level learns, the other is frozen", "strong")]
    for name, y in rows.items():
        parts.append(_text(16, y + 19, name))
        parts.append(f'<rect class="rest" x="{left}" y="{y + 9}" width="{cell * len(cells)}" height="10" rx="2"/>')
    for number, (level, _) in enumerate(cells):
        kind = "a" if level == "allocator" else "b"
        parts.append(
            f'<rect class="{kind}" x="{left + cell * number + 1}" y="{rows[level]}" width="{cell - 2}" height="28" rx="2"/>'
        )
    phases = [phase for _, phase in cells]
    for phase in ("pre-training", "intensive", "alternate"):
        first, n_cells = phases.index(phase), phases.count(phase)
        x, end = left + cell * first + 1, left + cell * (first + n_cells) - 1
        parts += [
            f'<path class="line" d="M{x} 92 L{x} 84 L{end} 84 L{end} 92"/>',
            _text((x + end) / 2, 74, phase, "middle small"),
        ]
    notes = (
        ("pre-training", "router: whole uniform instances, E_p = 5 epochs"),
        ("intensive", "up to epoch E_t = 8: E_c = 4 epochs each, in turn"),
        ("alternate", "after that: 1 epoch each, router on a V-th of the subsets"),
    )
    for number, (phase, text) in enumerate(notes):
        y = 236 + 24 * number
        parts += [_text(16, y, phase, "small strong"), _text(118, y, text, "small")]
    parts += [_text(16, 312, "A box is an epoch. The router learns from subsets of the allocator.", "soft small")]
    return parts


if __name__ == "__main__":
    main()
