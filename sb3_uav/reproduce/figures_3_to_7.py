"""The data of the paper's Figures 3 to 7, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.reproduce.drawings import CURVE_COLUMNS, DEPOT, LOWER_LEVEL, SCHEDULE_COLUMNS, UPPER_LEVEL
from sb3_uav.reproduce.evaluator import complete
from sb3_uav.reproduce.pairs import LEVELS, Model, read_log
from sb3_uav.reproduce.paper import (
    ABLATION_FLEET,
    ABLATION_SIZE,
    ABLATION_STRATEGIES,
    FIG3_SEED,
    KMEANS_AM,
    KMEANS_VND,
    SIZES,
    STRATEGY_TITLES,
)
from sb3_uav.reproduce.scales import Scenario, scenarios
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.reproduce.table_formats import MISSING, Column, Table, number
from sb3_uav.reproduce.tables_1_to_4 import trained_pairs
from sb3_uav.solvers.base import Solver
from sb3_uav.training.its_schedule import INDEPENDENT, ITS

_LEVEL_TITLES = {"allocator": UPPER_LEVEL, "router": LOWER_LEVEL}


class _LoggedCurve(NamedTuple):
    """
    The epochs of one level of one training.

    :param cost: ``(n_epochs,)``, minus the mean objective of its episodes
    :param phase: Phase of each epoch
    :param minutes: ``(n_epochs,)``, time since the beginning of the training, of both levels
    :param generation_minutes: Time spent generating the router's instances
    """

    cost: np.ndarray
    phase: list[str]
    minutes: np.ndarray
    generation_minutes: float


def _read_logged_curves(its_log: Path) -> dict[str, _LoggedCurve]:
    """
    :param its_log: The ``its_log.csv`` of a training, in chronological order
    :return: The curves of both levels
    :raises ValueError: If the file is not such a log
    """
    rows = read_log(its_log)
    minutes = np.cumsum([float(row["seconds"]) for row in rows]) / 60
    generation = sum(float(row.get("generation_seconds") or 0.0) for row in rows) / 60
    curves = {}
    for level in LEVELS:
        mine = [index for index, row in enumerate(rows) if row["level"] == level]
        cost = np.array([-float(rows[index]["objective"]) for index in mine])
        curves[level] = _LoggedCurve(cost, [rows[index]["phase"] for index in mine], minutes[mine], generation)
    return curves


# ----------------------------------------------------------------------------------------------------------------- Fig. 3


def fig3(session: Session) -> list[Path]:
    """
    Schedules of the trained pairs on one instance of every situation.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    here = scenarios()
    pairs = trained_pairs(session, here, (ITS,))
    columns = [Column(title) for title in ("Situation", "Tasks", "Visited", "Total length", "Tasks by UAV")]
    table = Table("Fig. 3", "Solution visualization of trained models in corresponding situations", columns)
    points = Table("Fig. 3", "depots, tasks and stops of the schedules", [Column(title) for title in SCHEDULE_COLUMNS])
    notes = Notes(f"Instances of seed {FIG3_SEED}, as in the paper, but not of its random generator. Decoding: sampling.")
    notes.add_stand_ins(session.scale, here)
    for scenario in here:
        model = pairs.get((session.scale.trained_for(scenario), ITS))
        if model is None:
            notes.add(f"There is no pair for {scenario.name}, and --no-training forbids training one.")
            continue
        instances = session.evaluator.instances(scenario, FIG3_SEED, 1)
        (result,) = session.evaluator.pair(model, sampling=True).solve(instances, seed=session.evaluator.seed)
        report = check_schedule(instances, 0, result.schedule)
        n_tasks, counts = int(instances.task_mask.sum()), [len(route) for route in result.schedule.routes]
        cells = [scenario.name, str(n_tasks), str(sum(counts)), number(sum(report.lengths)), " ".join(map(str, counts))]
        table.add(cells)
        _add_points(points, scenario.name, instances, result.schedule)
    table.notes = points.notes = notes.list()
    return session.write(table, "fig3", points)


def _add_points(points: Table, name: str, instances: Instances, schedule: Schedule) -> None:
    """
    :param points: The table that receives a row for the depot and for each task
    :param name: Name of the situation
    :param instances: One instance
    :param schedule: Its schedule
    """
    stops = {task: (uav, stop) for uav, route in enumerate(schedule.routes, 1) for stop, task in enumerate(route, 1)}
    max_distance = f"{float(instances.max_distance[0]):g}"

    def cells(point: str, coordinates: Iterable[float], stop: tuple[int, int] | None = None) -> list[str]:
        uav_and_stop = (MISSING, MISSING) if stop is None else map(str, stop)
        return [name, point, *(f"{x:.6f}" for x in coordinates), max_distance, *uav_and_stop]

    points.add(cells(DEPOT, instances.depot[0].tolist()))
    for task, coordinates in enumerate(instances.tasks[0][instances.task_mask[0]].tolist()):
        points.add(cells(str(task), coordinates, stops.get(task)))


# ----------------------------------------------------------------------------------------------------------------- Fig. 4


def fig4(session: Session) -> list[Path]:
    """
    Learning curves of both levels in all situations.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    here = [scenario for scenario in scenarios() if scenario.n_tasks in session.scale.trained_sizes]
    models = session.models.get([(scenario, ITS) for scenario in here], log_needed=True)
    curves = {s: _read_logged_curves(log) for s in here if (s, ITS) in models and (log := models[s, ITS].its_log) is not None}
    notes = Notes("Cost: minus the mean number of tasks completed in the training episodes (lower level: by one UAV).")
    notes.add("Until the dotted line, the lower level is pre-trained on whole instances.")
    notes.add_stand_ins(session.scale, [])
    missing = [scenario.name for scenario in scenarios() if scenario not in curves]
    if missing:
        notes.add(f"Not trained at scale {session.scale.name}, or without the log of the training: {', '.join(missing)}.")
    titles = ("Situation", "Level", "Epochs", "Cost of the first", "Lowest cost", "Cost of the last")
    table = Table("Fig. 4", "Learning curves of DL-DRL", [Column(title) for title in titles])
    for scenario, levels in curves.items():
        for level, curve in levels.items():
            if len(curve.cost) > 0:
                costs = (curve.cost[0], curve.cost.min(), curve.cost[-1])
                table.add([scenario.name, _LEVEL_TITLES[level], str(len(curve.cost)), *(number(float(c)) for c in costs)])
    table.notes = notes.list()
    return session.write(table, "fig4", _curves_table("Fig. 4", {s.name: c for s, c in curves.items()}, table.notes))


def _curves_table(label: str, curves: Mapping[str, Mapping[str, _LoggedCurve]], notes: Sequence[str]) -> Table:
    table = Table(label, "every epoch", [Column(title) for title in CURVE_COLUMNS], notes=list(notes))
    for name, levels in curves.items():
        for level, curve in levels.items():
            for index, phase in enumerate(curve.phase):
                figures = f"{curve.cost[index]:.4f}", f"{curve.minutes[index]:.4f}"
                table.add([name, _LEVEL_TITLES[level], str(index + 1), phase, *figures])
    return table


# ----------------------------------------------------------------------------------------------------------------- Fig. 5


def fig5(session: Session) -> list[Path]:
    """
    Cost of the upper level with the interactive training strategy and with parts of it left out.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    scenario = Scenario(ABLATION_FLEET, ABLATION_SIZE)
    models = session.models.get([(scenario, strategy) for strategy in ABLATION_STRATEGIES], log_needed=True)
    curves = {
        strategy: _read_logged_curves(log)
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
            title = STRATEGY_TITLES[strategy]
            notes.add(f"{title}: there is no pair with the log of its training, and --no-training forbids training one.")
    titles = ("Strategy", "Epochs", "Cost of the first", "Lowest cost", "Cost of the last", "Minutes", "Data generation (min)")
    table = Table("Fig. 5", "Ablation study results of ITS", [Column(title) for title in titles])
    for strategy, levels in curves.items():
        upper = levels["allocator"]
        if len(upper.cost) == 0:
            log = models[scenario, strategy].its_log
            raise ValueError(f"{log}: has no epochs of the allocator; give the log of a whole training, or take it away.")
        minutes = max(curve.minutes[-1] for curve in levels.values() if len(curve.minutes) > 0)
        costs = [number(float(cost)) for cost in (upper.cost[0], upper.cost.min(), upper.cost[-1])]
        times = [number(float(minutes), 3), number(upper.generation_minutes, 3)]
        table.add([STRATEGY_TITLES[strategy], str(len(upper.cost)), *costs, *times])
    table.notes = notes.list()
    return session.write(
        table, "fig5", _curves_table("Fig. 5", {STRATEGY_TITLES[s]: c for s, c in curves.items()}, table.notes)
    )


# ----------------------------------------------------------------------------------------------------------- Figs. 6 and 7


def fig6(session: Session) -> list[Path]:
    """
    Every pair of 4 UAVs on the instances of all sizes.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    return _generalization(session, "fig6", "Fig. 6", 4)


def fig7(session: Session) -> list[Path]:
    """
    Every pair of 6 UAVs on the instances of all sizes.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    return _generalization(session, "fig7", "Fig. 7", 6)


def _generalization(session: Session, name: str, label: str, n_uavs: int) -> list[Path]:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param name: Name of the files, without suffix
    :param label: Number of the figure
    :param n_uavs: Number of UAVs
    :return: Paths of the written files
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
        notes.add("There are no trained pairs, and --no-training forbids training them.")
    caption = f"Generalization to larger instances on U{n_uavs}"
    table = Table(label, caption, [Column("Method"), *(Column(f"N-{size}") for size in SIZES)])
    for method, found in objectives.items():
        table.add([method, *(number(found.get(size)) for size in SIZES)])
    table.notes = notes.list()
    return session.write(table, name, table)


def _baselines(
    session: Session, scenario: Scenario, pairs: Mapping[tuple[Scenario, str], Model], notes: Notes
) -> dict[str, Solver]:
    """The methods that Figs. 6 and 7 compare the pairs with, by name."""
    found: dict[str, Solver] = {}
    independent = pairs.get((session.scale.trained_for(scenario), INDEPENDENT))
    if "kmeans-vnd" in session.solvers:
        found[KMEANS_VND] = session.evaluator.baseline("kmeans-vnd")
    else:
        notes.add(f"{KMEANS_VND} was not requested (--solvers).")
    if independent is None:
        notes.add("DL-DRL-I has no trained pair, and --no-training forbids training one.")
        return found
    if "kmeans-am" in session.solvers:
        found[KMEANS_AM] = session.evaluator.baseline("kmeans-am", independent)
    else:
        notes.add(f"{KMEANS_AM} was not requested (--solvers).")
    return {**found, "DL-DRL-I": session.evaluator.pair(independent, sampling=True)}
