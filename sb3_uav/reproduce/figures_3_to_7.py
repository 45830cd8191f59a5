"""The data of the paper's Figures 3 to 7, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.reproduce.blocks import Block, make_solvers
from sb3_uav.reproduce.drawings import CURVE_COLUMNS, DEPOT, LOWER_LEVEL, SCHEDULE_COLUMNS, UPPER_LEVEL, is_pair
from sb3_uav.reproduce.evaluator import complete
from sb3_uav.reproduce.methods import DL_DRL, DL_DRL_I, DL_DRL_SHORT, UNTRAINED_PAIR, column, explanations, learned_pairs
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
from sb3_uav.reproduce.scales import Scale, Scenario, scenarios
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.reproduce.table_formats import MISSING, Column, Table, number
from sb3_uav.training.instance_sets import SizeTable
from sb3_uav.training.its_schedule import ITS

_LEVEL_TITLES = {"allocator": UPPER_LEVEL, "router": LOWER_LEVEL}


class LoggedCurve(NamedTuple):
    """
    The epochs of one level of one training.

    :param cost: ``(n_epochs,)``, minus the mean objective of its episodes
    :param phase: Phase of each epoch
    :param minutes: ``(n_epochs,)``, CPU time since the beginning of the training, of both levels; wall time in old logs
    :param generation_minutes: Time spent generating the router's instances
    :param first_epoch: Number of the first of these epochs
    """

    cost: np.ndarray
    phase: list[str]
    minutes: np.ndarray
    generation_minutes: float
    first_epoch: int = 1


def read_logged_curves(its_log: Path) -> dict[str, LoggedCurve]:
    """
    :param its_log: The ``its_log.csv`` of a training, in chronological order
    :return: The curves of both levels
    :raises ValueError: If the file is not such a log
    """
    rows = read_log(its_log)
    # Earlier versions did not record CPU times.
    minutes = np.cumsum([float(row.get("cpu_seconds") or row["seconds"]) for row in rows]) / 60
    generation = sum(float(row.get("generation_seconds") or 0.0) for row in rows) / 60
    curves = {}
    for level in LEVELS:
        mine = [index for index, row in enumerate(rows) if row["level"] == level]
        cost = np.array([-float(rows[index]["objective"]) for index in mine])
        curves[level] = LoggedCurve(cost, [rows[index]["phase"] for index in mine], minutes[mine], generation)
    return curves


# ----------------------------------------------------------------------------------------------------------------- Fig. 3


def fig3(session: Session) -> list[Path]:
    """
    Schedules of the trained pairs on one instance of every situation.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    here = scenarios()
    pairs = learned_pairs(session.models, here, DL_DRL)
    columns = [Column(title) for title in ("Situation", "Tasks", "Visited", "Total length", "Tasks by UAV")]
    table = Table("Fig. 3", "Solution visualization of trained models in corresponding situations", columns)
    points = Table("Fig. 3", "depots, tasks and stops of the schedules", [Column(title) for title in SCHEDULE_COLUMNS])
    notes = Notes(f"Instances of seed {FIG3_SEED}, as in the paper, but not of its random generator. Decoding: sampling.")
    notes.add_stand_ins(session.scale, here)
    for scenario in here:
        model = pairs.get((scenario, DL_DRL))
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
    here = list(dict.fromkeys(map(session.scale.trained_for, scenarios())))
    models = session.models.get([(scenario, ITS) for scenario in here], log_needed=True)
    curves = {s: read_logged_curves(log) for s in here if (s, ITS) in models and (log := models[s, ITS].its_log) is not None}
    notes = Notes("Cost: minus the mean number of tasks completed in the training episodes (lower level: by one UAV).")
    if session.scale.universal:
        notes.add(
            "One training for all sizes and fleets, in place of the paper's twelve. mixture: its training episodes, of random "
            "sizes, with which the cost varies. The situations: both levels before the first epoch (0, after the warm start) "
            f"and after each one, greedy, on {session.scale.recipe.evaluations} fixed instances of each."
        )
        for model in models.values():
            curves |= _read_evaluations(model, session.scale)
    else:
        notes.add("Until the dotted line, the lower level is pre-trained on whole instances.")
    notes.add_stand_ins(session.scale, [])
    missing = [scenario.name for scenario in here if scenario not in curves]
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


def _read_evaluations(model: Model, scale: Scale) -> dict[Scenario, dict[str, LoggedCurve]]:
    """
    :param model: A pair for all situations
    :param scale: The scale
    :return: The curves of its evaluations by situation; none if there were no evaluations
    :raises ValueError: If their file is damaged
    """
    if model.size_table is None:
        return {}
    names = {scenario: f"U{scenario.n_uavs}-N{scale.n_tasks(scenario)}" for scenario in scenarios()}
    rows = SizeTable.load(model.size_table, list(names.values())).rows
    phase, minutes = ["evaluation"] * len(rows), np.array([row["seconds"] / 60 for row in rows])
    costs = {scenario: np.array([-row[name] for row in rows]) for scenario, name in names.items()}
    return {scenario: {"allocator": LoggedCurve(cost, phase, minutes, 0.0, 0)} for scenario, cost in costs.items()}


def _curves_table(label: str, curves: Mapping[str, Mapping[str, LoggedCurve]], notes: Sequence[str]) -> Table:
    table = Table(label, "every epoch", [Column(title) for title in CURVE_COLUMNS], notes=list(notes))
    for name, levels in curves.items():
        for level, curve in levels.items():
            for index, phase in enumerate(curve.phase):
                figures = f"{curve.cost[index]:.4f}", f"{curve.minutes[index]:.4f}"
                table.add([name, _LEVEL_TITLES[level], str(curve.first_epoch + index), phase, *figures])
    return table


# ----------------------------------------------------------------------------------------------------------------- Fig. 5


def fig5(session: Session) -> list[Path]:
    """
    Cost of the upper level with the interactive training strategy and with parts of it left out.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    scenario = Scenario(ABLATION_FLEET, ABLATION_SIZE)
    curves = ablation_curves(session)
    notes = Notes(
        f"{scenario.name}. Cost: minus the mean number of tasks completed in the training episodes of the upper level.",
        "ITS/X is the interactive training strategy without X. Minutes: CPU time of both levels, pre-training included.",
    )
    notes.add_stand_ins(session.scale, [])
    if session.scale.ablation is not None:
        its = session.scale.ablation.its
        notes.add(
            f"Trained for {scenario.name} without a warm start, {its['n_epochs']} epochs, {its['n_pretraining_epochs']} of "
            f"pre-training; E_t = {its['n_intensive_epochs']}, E_c = {its['n_continuous_epochs']}."
        )
    for strategy in ABLATION_STRATEGIES:
        if strategy not in {name for name, _ in curves}:
            title = STRATEGY_TITLES[strategy]
            notes.add(f"{title}: there is no pair with the log of its training, and --no-training forbids training one.")
    titles = ("Strategy", "Seed", "Epochs", "Cost of the first", "Lowest cost", "Cost of the last", "Minutes")
    table = Table("Fig. 5", "Ablation study results of ITS", [*map(Column, titles), Column("Data generation (min)")])
    every = Table("Fig. 5", "every epoch", [*map(Column, CURVE_COLUMNS), Column("Seed")], notes=notes.list())
    for (strategy, seed), levels in curves.items():
        upper = levels["allocator"]
        minutes = max(curve.minutes[-1] for curve in levels.values() if len(curve.minutes) > 0)
        costs = [number(float(cost)) for cost in (upper.cost[0], upper.cost.min(), upper.cost[-1])]
        times = [number(float(minutes), 3), number(upper.generation_minutes, 3)]
        table.add([STRATEGY_TITLES[strategy], str(seed), str(len(upper.cost)), *costs, *times])
        for row in _curves_table("", {STRATEGY_TITLES[strategy]: levels}, ()).rows:
            every.add([*row, str(seed)])
    table.notes = notes.list()
    return session.write(table, "fig5", every)


def ablation_curves(session: Session) -> dict[tuple[str, int], dict[str, LoggedCurve]]:
    """
    :param session: The scale and the trained pairs
    :return: Curves of both levels by strategy and seed
    :raises ValueError: If a log is damaged or has no epochs of the allocator
    """
    models = session.models.ablation(Scenario(ABLATION_FLEET, ABLATION_SIZE), ABLATION_STRATEGIES)
    curves = {}
    for key, model in models.items():
        assert model.its_log is not None
        curves[key] = read_logged_curves(model.its_log)
        if len(curves[key]["allocator"].cost) == 0:
            raise ValueError(
                f"{model.its_log}: has no epochs of the allocator; give the log of a whole training, or take it away."
            )
    return curves


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
    notes = Notes("Columns: the problems that are solved; rows: trained pairs (sampling) and baselines. Mean number of tasks.")
    if session.scale.universal:
        names = "universal: DL-DRL. mixture: DL-DRL short." if session.models.uses_shipped_pair else "mixture: DL-DRL."
        notes.add(f"{names} The pair of one size is that of Fig. 5 (ITS), trained for less time, without a warm start.")
    else:
        notes.add(f"{KMEANS_AM} and {DL_DRL_I}: trained for the problem's size, or the nearest that is trained at this scale.")
    notes.add_stand_ins(session.scale, [])
    notes.add(*explanations(session.models))
    counts = ", ".join(f"{session.scale.n_instances[size]} (N = {size})" for size in SIZES)
    notes.add(f"Instances: {counts}; {session.scale.samples} samples.")
    objectives: dict[str, dict[int, float | None]] = {}
    blocks = generalization_blocks(session, n_uavs, notes)
    for scenario, block in blocks.items():
        for method in block.solvers:
            objective = complete(block.rows.get(method), lambda row: row.objective)
            objectives.setdefault(method, {})[scenario.n_tasks] = objective
    if not any(is_pair(method) for method in objectives):
        notes.add("There are no trained pairs, and --no-training forbids training them.")
    caption = f"Generalization to larger instances on U{n_uavs}"
    table = Table(label, caption, [Column("Method"), *(Column(f"N-{size}") for size in SIZES)])
    for method, found in objectives.items():
        table.add([method, *(number(found.get(size)) for size in SIZES)])
    table.notes = notes.list()
    return session.write(table, name, table)


def generalization_blocks(session: Session, n_uavs: int, notes: Notes) -> dict[Scenario, Block]:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param n_uavs: Number of UAVs
    :param notes: Receives what is left out
    :return: Results of the pairs, by their labels, and of the methods to compare them with, on the paper's sizes
    """
    here = [Scenario(n_uavs, n_tasks) for n_tasks in SIZES]
    pairs = learned_pairs(session.models, here)
    # One pair may serve several sizes.
    ours = {model.label: model for (_, method), model in pairs.items() if method in (DL_DRL, DL_DRL_SHORT)}
    if session.scale.universal and n_uavs == ABLATION_FLEET:
        scenario = Scenario(ABLATION_FLEET, ABLATION_SIZE)
        trained = session.models.ablation(scenario, (ITS,))
        ours |= {model.label: model for (_, seed), model in trained.items() if seed == session.models.seed}
    blocks = {}
    for scenario in here:
        solvers = {label: session.evaluator.pair(model, sampling=True) for label, model in ours.items()}
        others = make_solvers(session, scenario, pairs, notes)
        for name in (KMEANS_VND, KMEANS_AM, *(column(method, sampling=True) for method in (DL_DRL_I, UNTRAINED_PAIR))):
            if name in others:
                solvers[name.removesuffix(column("", sampling=True))] = others[name]
        blocks[scenario] = Block.run(session, scenario, solvers, notes)
    return blocks
