"""Figures 3 to 7 of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_uav.common.files import replaced_when_complete
from sb3_uav.envs.render import require_matplotlib
from sb3_uav.envs.schedule import check_schedule
from sb3_uav.evaluation.summary import gaps
from sb3_uav.plots.figure_files import new_figure
from sb3_uav.plots.schedule_map import MapPanel, schedules_figure
from sb3_uav.plots.style import MARKERS, MAX_MARKERS, ORANGE, PURPLE, SERIES_COLORS, VERMILION, style_axes
from sb3_uav.solvers.base import Solver
from sb3_uav.studies.reproduce.evaluator import complete
from sb3_uav.studies.reproduce.pairs import INDEPENDENT, ITS, LEVELS, Model, read_log
from sb3_uav.studies.reproduce.paper import (
    ABLATION_FLEET,
    ABLATION_SIZE,
    ABLATION_STRATEGIES,
    FIG3_SEED,
    FLEETS,
    KMEANS_AM,
    KMEANS_VND,
    SIZES,
)
from sb3_uav.studies.reproduce.scales import Scenario, scenarios
from sb3_uav.studies.reproduce.session import Notes, Session
from sb3_uav.studies.reproduce.table_formats import Column, Table, best, number, to_csv
from sb3_uav.studies.reproduce.tables_1_to_4 import trained_pairs

MAPS_PER_LINE = 3
LEVEL_TITLES = {"allocator": "Upper level", "router": "Lower level"}
STRATEGY_TITLES = {"ITS": "ITS (ours)"}
CURVES_SUFFIX = "_curves.csv"


class Curve(NamedTuple):
    """
    The epochs of one level of one training.

    :param cost: ``(n_epochs,)``, minus the mean objective of its episodes
    :param phase: Phase of each epoch
    :param minutes: ``(n_epochs,)``, time since the beginning of the training, of both levels
    :param generation_minutes: How much of all that time went into the router's instances
    """

    cost: np.ndarray
    phase: list[str]
    minutes: np.ndarray
    generation_minutes: float

    @property
    def n_pretraining(self) -> int:
        return self.phase.count("pre-training")


def read_curves(its_log: Path) -> dict[str, Curve]:
    """
    :param its_log: The ``its_log.csv`` of a training, whose lines stand in the order of time
    :return: The curves of both levels
    :raises ValueError: If it is something else
    """
    rows = read_log(its_log)
    minutes = np.cumsum([float(row["seconds"]) for row in rows]) / 60
    generation = sum(float(row.get("generation_seconds") or 0.0) for row in rows) / 60
    curves = {}
    for level in LEVELS:
        mine = [index for index, row in enumerate(rows) if row["level"] == level]
        cost = np.array([-float(rows[index]["objective"]) for index in mine])
        curves[level] = Curve(cost, [rows[index]["phase"] for index in mine], minutes[mine], generation)
    return curves


def _shades(n: int) -> list[Any]:
    """As many colors of one scale, for things that have an order."""
    return [require_matplotlib().colormaps["viridis"](position) for position in np.linspace(0.0, 0.9, n)]


def _write_curves(session: Session, table: Table, name: str) -> Path:
    path = session.out / f"{name}{CURVES_SUFFIX}"
    with replaced_when_complete(path) as file:
        file.write(to_csv(table, session.origin.lines()))
    return path


# ----------------------------------------------------------------------------------------------------------------- Fig. 3


def fig3(session: Session) -> list[Path]:
    """
    Schedules of the trained pairs on one instance of every situation.

    :param session: What to do it with
    :return: The files
    """
    here = scenarios()
    pairs = trained_pairs(session, here, (ITS,))
    columns = [Column(title) for title in ("Situation", "Tasks", "Visited", "Total length", "Tasks by UAV")]
    table = Table("Fig. 3: Solution visualization of trained models in corresponding situations", columns)
    notes = Notes(f"Instances of seed {FIG3_SEED}, as in the paper, but not of its random generator. Decoding: sampling.")
    notes.add_stand_ins(session.scale, here)
    panels = []
    for scenario in here:
        model = pairs.get((session.scale.trained_for(scenario), ITS))
        if model is None:
            notes.add(f"There is no pair for {scenario.name}, and --no-training forbids to train one.")
            continue
        instances = session.evaluator.instances(scenario, FIG3_SEED, 1)
        (result,) = session.evaluator.pair(model, sampling=True).solve(instances, seed=session.origin.seed)
        report = check_schedule(instances, 0, result.schedule)
        n_tasks, counts = int(instances.task_mask.sum()), [len(route) for route in result.schedule.routes]
        title = f"{scenario.name}: {sum(counts)} of {n_tasks} tasks"
        panels.append(MapPanel(instances, 0, result.schedule, title))
        cells = [scenario.name, str(n_tasks), str(sum(counts)), number(sum(report.lengths)), " ".join(map(str, counts))]
        table.add(cells)
    table.notes = notes.list()
    paths = session.write_table(table, "fig3")
    return [*paths, *session.write_figure(schedules_figure(panels, MAPS_PER_LINE), "fig3")] if panels else paths


# ----------------------------------------------------------------------------------------------------------------- Fig. 4


def fig4(session: Session) -> list[Path]:
    """
    Learning curves of both levels in all situations.

    :param session: What to do it with
    :return: The files
    """
    here = [scenario for scenario in scenarios() if scenario.n_tasks in session.scale.trained_sizes]
    models = session.models.get([(scenario, ITS) for scenario in here], log_needed=True)
    curves = {s: read_curves(log) for s in here if (s, ITS) in models and (log := models[s, ITS].its_log) is not None}
    notes = Notes("Cost: minus the mean number of tasks completed in the training episodes (lower level: by one UAV).")
    notes.add("Until the dotted line, the lower level is pre-trained on whole instances.")
    notes.add_stand_ins(session.scale, [])
    missing = [scenario.name for scenario in scenarios() if scenario not in curves]
    if missing:
        notes.add(f"Not trained at scale {session.scale.name}, or without the log of the training: {', '.join(missing)}.")
    titles = ("Situation", "Level", "Epochs", "Cost of the first", "Lowest cost", "Cost of the last")
    table = Table("Fig. 4: Learning curves of DL-DRL", [Column(title) for title in titles])
    for scenario, levels in curves.items():
        for level, curve in levels.items():
            if len(curve.cost) > 0:
                costs = (curve.cost[0], curve.cost.min(), curve.cost[-1])
                table.add([scenario.name, LEVEL_TITLES[level], str(len(curve.cost)), *(number(float(c)) for c in costs)])
    table.notes = notes.list()
    paths = session.write_table(table, "fig4")
    paths.append(_write_curves(session, _curves_table("Fig. 4", {s.name: c for s, c in curves.items()}, table.notes), "fig4"))
    return [*paths, *session.write_figure(_draw_fig4(curves), "fig4")] if curves else paths


def _curves_table(caption: str, curves: Mapping[str, Mapping[str, Curve]], notes: Sequence[str]) -> Table:
    titles = ("Training", "Level", "Epoch", "Phase", "Cost", "Minutes")
    table = Table(f"{caption}: every epoch", [Column(title) for title in titles], notes=list(notes))
    for name, levels in curves.items():
        for level, curve in levels.items():
            for index, phase in enumerate(curve.phase):
                figures = f"{curve.cost[index]:.4f}", f"{curve.minutes[index]:.4f}"
                table.add([name, LEVEL_TITLES[level], str(index + 1), phase, *figures])
    return table


def _draw_fig4(curves: Mapping[Scenario, Mapping[str, Curve]]) -> Any:
    fleets = [n_uavs for n_uavs in FLEETS if any(scenario.n_uavs == n_uavs for scenario in curves)]
    figure = new_figure(5.5 * len(fleets), 7.0)
    colors = dict(zip(SIZES, _shades(len(SIZES)), strict=True))
    grid = figure.subplots(len(LEVELS), len(fleets), squeeze=False)
    for line, level in zip(grid, LEVELS, strict=True):
        for axes, n_uavs in zip(line, fleets, strict=True):
            style_axes(axes, f"U{n_uavs}: {LEVEL_TITLES[level].lower()}", "epoch", "cost")
            mine = {scenario: levels[level] for scenario, levels in curves.items() if scenario.n_uavs == n_uavs}
            for scenario, curve in mine.items():
                epochs = np.arange(1, len(curve.cost) + 1)
                look = {"color": colors[scenario.n_tasks], "label": scenario.name}
                axes.plot(epochs, curve.cost, linewidth=1.5, **look, **_markers(len(epochs), 0))
            n_pretraining = max((curve.n_pretraining for curve in mine.values()), default=0)
            if n_pretraining > 0:
                axes.axvline(n_pretraining + 0.5, color="0.4", linestyle=":", linewidth=1.2)
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.legend(fontsize=8.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _markers(n_points: int, position: int) -> dict[str, Any]:
    """Markers where they do not hide the line."""
    return {"marker": MARKERS[position % len(MARKERS)], "markersize": 4} if n_points <= MAX_MARKERS else {}


# ----------------------------------------------------------------------------------------------------------------- Fig. 5


def fig5(session: Session) -> list[Path]:
    """
    Cost of the upper level with the interactive training strategy and with parts of it left out.

    :param session: What to do it with
    :return: The files
    """
    scenario = Scenario(ABLATION_FLEET, ABLATION_SIZE)
    models = session.models.get([(scenario, strategy) for strategy in ABLATION_STRATEGIES], log_needed=True)
    curves = {
        strategy: read_curves(log)
        for strategy in ABLATION_STRATEGIES
        if (scenario, strategy) in models and (log := models[scenario, strategy].its_log) is not None
    }
    notes = Notes(
        f"{scenario.name}. Cost: minus the mean number of tasks completed in the training episodes of the upper level.",
        "ITS/X is the interactive training strategy without X. Minutes: of both levels, pre-training included.",
    )
    notes.add_stand_ins(session.scale, [])
    for strategy in ABLATION_STRATEGIES:
        if strategy not in curves:
            notes.add(f"{strategy}: there is no pair with the log of its training, and --no-training forbids to train one.")
    titles = ("Strategy", "Epochs", "Cost of the first", "Lowest cost", "Cost of the last", "Minutes", "Data generation (min)")
    table = Table("Fig. 5: Ablation study results of ITS", [Column(title) for title in titles])
    for strategy, levels in curves.items():
        upper = levels["allocator"]
        if len(upper.cost) == 0:
            log = models[scenario, strategy].its_log
            raise ValueError(f"{log}: has no epochs of the allocator; give the log of a whole training, or take it away.")
        minutes = max(curve.minutes[-1] for curve in levels.values() if len(curve.minutes) > 0)
        costs = [number(float(cost)) for cost in (upper.cost[0], upper.cost.min(), upper.cost[-1])]
        table.add([strategy, str(len(upper.cost)), *costs, number(float(minutes), 3), number(upper.generation_minutes, 3)])
    table.notes = notes.list()
    paths = session.write_table(table, "fig5")
    paths.append(_write_curves(session, _curves_table("Fig. 5", curves, table.notes), "fig5"))
    return [*paths, *session.write_figure(_draw_fig5(curves), "fig5")] if curves else paths


def _draw_fig5(curves: Mapping[str, Mapping[str, Curve]]) -> Any:
    figure = new_figure(11.0, 4.2)
    left, right = figure.subplots(1, 2, sharey=True)
    style_axes(left, "by epoch", "epoch of the upper level", "cost")
    style_axes(right, "by training time", "minutes", "")
    for position, (strategy, levels) in enumerate(curves.items()):
        curve = levels["allocator"]
        look = {"color": SERIES_COLORS[position], "linewidth": 1.5, "label": STRATEGY_TITLES.get(strategy, strategy)}
        look |= _markers(len(curve.cost), position)
        left.plot(np.arange(1, len(curve.cost) + 1), curve.cost, **look)
        right.plot(curve.minutes, curve.cost, **look)
    left.xaxis.get_major_locator().set_params(integer=True)
    right.set_xlim(left=0)
    right.legend(fontsize=8.5, frameon=False, loc="upper right")
    return figure


# ----------------------------------------------------------------------------------------------------------- Figs. 6 and 7


def fig6(session: Session) -> list[Path]:
    """
    Every pair of 4 UAVs on the instances of all sizes.

    :param session: What to do it with
    :return: The files
    """
    return _generalisation(session, "fig6", "Fig. 6: Generalization to larger instances on U4", 4)


def fig7(session: Session) -> list[Path]:
    """
    Every pair of 6 UAVs on the instances of all sizes.

    :param session: What to do it with
    :return: The files
    """
    return _generalisation(session, "fig7", "Fig. 7: Generalization to larger instances on U6", 6)


def _generalisation(session: Session, name: str, caption: str, n_uavs: int) -> list[Path]:
    """
    :param session: What to do it with
    :param name: Of the files
    :param caption: Of the figure
    :param n_uavs: The fleet
    :return: The files
    """
    here = [Scenario(n_uavs, n_tasks) for n_tasks in SIZES]
    pairs = trained_pairs(session, here)
    # The user may have one pair for several sizes.
    ours = list({model.label: model for (_, strategy), model in pairs.items() if strategy == ITS}.values())
    notes = Notes(
        "Columns: the problems that are solved; rows: trained pairs (sampling) and baselines. Mean number of tasks.",
        f"{KMEANS_AM} and DL-DRL-I: trained for the problem's size, or the nearest size that is trained at this scale.",
    )
    notes.add_stand_ins(session.scale, [])
    counts = ", ".join(f"{session.scale.n_instances[size]} (N = {size})" for size in SIZES)
    notes.add(f"Instances: {counts}; {session.scale.samples} samples.")
    objectives: dict[str, dict[int, float | None]] = {model.label: {} for model in ours}
    for scenario in here:
        solvers = {model.label: session.evaluator.pair(model, sampling=True) for model in ours}
        solvers |= _baselines(session, scenario, pairs, notes)
        results = session.evaluator.run(scenario, list(solvers.values()))
        notes.add(*results.failures)
        for method, solver in solvers.items():
            objective = complete(results.rows.get(solver.name), lambda row: row.objective)
            objectives.setdefault(method, {})[scenario.n_tasks] = objective
    if not ours:
        notes.add("There are no trained pairs, and --no-training forbids to train them.")
    table = Table(caption, [Column("Method"), *(Column(f"N-{size}") for size in SIZES)])
    winners = {size: best([found.get(size) for found in objectives.values()]) for size in SIZES}
    for position, (method, found) in enumerate(objectives.items()):
        bold = [1 + index for index, size in enumerate(SIZES) if position in winners[size]]
        table.add([method, *(number(found.get(size)) for size in SIZES)], bold)
    table.notes = notes.list()
    paths = session.write_table(table, name)
    trained = [model.label for model in ours]
    return [*paths, *session.write_figure(_draw_generalisation(objectives, trained), name)] if objectives else paths


def _baselines(
    session: Session, scenario: Scenario, pairs: Mapping[tuple[Scenario, str], Model], notes: Notes
) -> dict[str, Solver]:
    """The methods of Figs. 6 and 7 that the pairs are compared with, by their names."""
    found: dict[str, Solver] = {}
    independent = pairs.get((session.scale.trained_for(scenario), INDEPENDENT))
    if "kmeans-vnd" in session.solvers:
        found[KMEANS_VND] = session.evaluator.baseline("kmeans-vnd")
    else:
        notes.add(f"{KMEANS_VND} was not asked for (--solvers).")
    if independent is None:
        notes.add("DL-DRL-I has no trained pair, and --no-training forbids to train one.")
        return found
    if "kmeans-am" in session.solvers:
        found[KMEANS_AM] = session.evaluator.baseline("kmeans-am", independent)
    else:
        notes.add(f"{KMEANS_AM} was not asked for (--solvers).")
    return {**found, "DL-DRL-I": session.evaluator.pair(independent, sampling=True)}


def _draw_generalisation(objectives: Mapping[str, Mapping[int, float | None]], trained: Sequence[str]) -> Any:
    figure = new_figure(11.5, 4.6)
    left, right = figure.subplots(1, 2)
    style_axes(left, "Objective", "problem", "tasks completed (mean)")
    style_axes(right, "Gap to the best of these methods", "problem", "gap (%)")
    values = np.array([[found.get(size) for size in SIZES] for found in objectives.values()], dtype=np.float64)
    shortfalls = np.array([gaps(column) for column in values.T.tolist()]).T
    shades = iter(_shades(len(trained)))
    others = iter((VERMILION, PURPLE, ORANGE))
    for position, method in enumerate(objectives):
        ours = method in trained
        look = {"color": next(shades) if ours else next(others), "linestyle": "-" if ours else (0, (4, 2))}
        look |= {"marker": MARKERS[position % len(MARKERS)], "markersize": 5, "linewidth": 1.5, "label": method}
        left.plot(range(len(SIZES)), values[position], **look)
        right.plot(range(len(SIZES)), shortfalls[position], **look)
    for axes in (left, right):
        axes.set_xticks(range(len(SIZES)), [f"N-{size}" for size in SIZES])
    right.legend(fontsize=8.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
