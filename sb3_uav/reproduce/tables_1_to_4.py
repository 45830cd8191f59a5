"""Tables I to IV of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_uav.evaluation.summary import SummaryRow, gaps
from sb3_uav.reproduce.evaluator import BASELINES, complete
from sb3_uav.reproduce.pairs import Model, read_log
from sb3_uav.reproduce.paper import (
    EXACT_BLOCK,
    EXACT_COLUMNS,
    FULL_BLOCK,
    FULL_COLUMNS,
    GREEDY,
    GUROBI,
    INDEPENDENT_GREEDY,
    INDEPENDENT_SAMPLING,
    INSTANCES_PER_EPOCH,
    KMEANS_AM,
    LARGER_METHODS,
    LARGER_SIZES,
    MEASURES,
    PHASES,
    SAMPLING,
    SIZES,
    paper_figure,
    paper_tables,
)
from sb3_uav.reproduce.scales import Scenario, scenarios
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.reproduce.table_formats import Column, Table, number
from sb3_uav.solvers.base import Solver
from sb3_uav.training.its_schedule import INDEPENDENT, ITS

_PAPER, _OURS = "paper", "ours"
_FASTEST_SHOWN = 0.1


class _PhaseTimes(NamedTuple):
    """
    Seconds per instance; NaN where the log does not contain them.

    :param upper: Seconds of the allocator's epochs
    :param lower: Seconds of the router's epochs, without generating its instances
    :param generation: Seconds spent generating the router's instances
    :param n_instances: Instances per epoch
    """

    upper: float
    lower: float
    generation: float
    n_instances: int


def _seconds(value: float | None) -> str:
    """
    :param value: A time
    :return: Text for a cell, with more digits for short times
    """
    return number(value, 2 if value is None or math.isnan(value) or value >= _FASTEST_SHOWN else 4)


# ---------------------------------------------------------------------------------------------------------------- Table I


def table1(session: Session) -> list[Path]:
    """
    Time of training per epoch: upper level, lower level, generation of the lower level's data.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    models = session.models.timed(scenarios())
    groups = [Column(source, phase) for phase in PHASES for source in (_PAPER, _OURS)]
    table = Table("Table I", paper_tables()["table1"]["caption"], [Column("Situation"), *groups])
    notes = Notes(
        f"Minutes per epoch of {INSTANCES_PER_EPOCH:,} instances. The paper's: one RTX 3090, two from 300 tasks on. Ours are "
        "measured over fewer instances and multiplied; the first epoch, whose baseline is cheaper, is left out.",
        "Lower-level and data generation: epochs of the alternate phase, where all subsets of an epoch are newly generated.",
    )
    given = session.models.given
    own = [scenario.name for scenario, model in models.items() if given is not None and model.folder.is_relative_to(given)]
    if own:
        notes.add(f"Trainings of the given pairs (--models): {', '.join(own)}.")
    if session.scale.timing is not None and len(own) < len(models):
        notes.add(f"Our runs have the paper's networks and baseline, but batches of {_batch_size(session)} instances.")
    notes.add_stand_ins(session.scale, [])
    measured: dict[int, list[str]] = {}
    missing: list[str] = []
    for scenario in scenarios():
        times = _phase_times(models[scenario]) if scenario in models else None
        if times is None:
            missing.append(scenario.name)
        else:
            measured.setdefault(times.n_instances, []).append(scenario.name)
        cells = [scenario.name]
        for phase, ours in zip(PHASES, times or (math.nan,) * 3, strict=False):
            cells += [number(paper_figure("table1", scenario.name, phase)), number(ours * INSTANCES_PER_EPOCH / 60)]
        table.add(cells)
    notes.add(*(f"Epochs of {count:,} instances: {', '.join(names)}." for count, names in measured.items()))
    if missing:
        notes.add(f"Not trained at scale {session.scale.name}, or without the log of the training: {', '.join(missing)}.")
    table.notes = [*notes.list(), *paper_tables()["table1"]["faults"]]
    return session.write(table, "table1")


def _batch_size(session: Session) -> int:
    assert session.scale.timing is not None
    return session.scale.timing.allocator["n_envs"]


def _phase_times(model: Model) -> _PhaseTimes:
    """
    :param model: A trained pair with the log of its training
    :return: Durations of the phases of an epoch
    :raises ValueError: If the file is not such a log
    """
    assert model.its_log is not None
    rows = read_log(model.its_log)
    upper = [row for row in rows if row["level"] == "allocator"]
    upper = upper[1:] or upper
    alternate = [row for row in rows if row["level"] == "router" and row["phase"] == "alternate"]
    lower = alternate[1:] or alternate
    nothing = {"seconds": "nan", "generation_seconds": "nan", "n_instances": "1"}
    # Logs of earlier versions do not separate generation from training.
    generation = _per_instance(lower or [nothing], "generation_seconds")
    return _PhaseTimes(
        _per_instance(upper or [nothing], "seconds"),
        _per_instance(lower or [nothing], "seconds") - generation,
        generation,
        int(upper[-1]["n_instances"]) if upper else 0,
    )


def _per_instance(rows: Sequence[Mapping[str, str]], column: str) -> float:
    total = math.fsum(float(row.get(column) or "nan") for row in rows)
    return total / sum(int(row["n_instances"]) for row in rows)


# -------------------------------------------------------------------------------------------------------- Tables II and III


def table2(session: Session) -> list[Path]:
    """
    Experiment results with 4 UAVs.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    return _results_table(session, "table2", "Table II", 4)


def table3(session: Session) -> list[Path]:
    """
    Experiment results with 6 UAVs.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    return _results_table(session, "table3", "Table III", 6)


def _results_table(session: Session, name: str, label: str, n_uavs: int) -> list[Path]:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param name: Name of the files, and of the table in the paper's data
    :param label: Its number
    :param n_uavs: Number of UAVs
    :return: Paths of the written files
    """
    here = [Scenario(n_uavs, n_tasks) for n_tasks in SIZES]
    pairs = trained_pairs(session, here)
    extras = session.extra_solvers
    blocks = {EXACT_BLOCK: EXACT_COLUMNS, FULL_BLOCK: (*FULL_COLUMNS, *extras)}
    columns = [Column(column, block) for block, methods in blocks.items() for column in methods]
    heading = [Column("Number of tasks"), Column("Measure"), Column("Source")]
    table = Table(label, paper_tables()[name]["caption"], [*heading, *columns])
    notes = Notes("Gap: to the best method of the same block, in percent. Time: wall time per instance.")
    notes.add_stand_ins(session.scale, here)
    _say_how_many(session, notes)
    errors: list[float] = []
    for scenario in here:
        solvers = _solvers(session, scenario, pairs, notes)
        found = {
            EXACT_BLOCK: _exact_block(session, scenario, solvers, notes),
            FULL_BLOCK: _block(session, scenario, {c: s for c, s in solvers.items() if c != GUROBI}, notes),
        }
        ours = {block: _measures(found[block], methods) for block, methods in blocks.items()}
        errors += [row.standard_error for rows in found.values() for row in rows.values()]
        papers = {
            block: {
                measure: [paper_figure(name, str(scenario.n_tasks), block, method, measure) for method in methods]
                for measure in MEASURES.values()
            }
            for block, methods in blocks.items()
        }
        for title, measure in MEASURES.items():
            for source, figures in ((_PAPER, papers), (_OURS, ours)):
                cells = [str(scenario.n_tasks), title, source]
                for block in blocks:
                    show = _seconds if measure == "seconds" and source == _OURS else number
                    cells += [show(value) for value in figures[block][measure]]
                table.add(cells)
    _say_how_exact(errors, notes)
    faults = [f"The paper's table: {fault}" for fault in paper_tables()[name]["faults"]]
    table.notes = [*notes.list(), *faults]
    return session.write(table, name)


def trained_pairs(
    session: Session, wanted: Sequence[Scenario], strategies: Sequence[str] = (ITS, INDEPENDENT)
) -> dict[tuple[Scenario, str], Model]:
    """
    :param session: The session, which finds or trains the pairs
    :param wanted: The scenarios to solve
    :param strategies: Training strategies
    :return: The pairs that solve the scenarios; without those that are missing and may not be trained
    """
    given = [(scenario, strategy) for scenario in wanted for strategy in strategies]
    trained = dict.fromkeys((session.scale.trained_for(scenario), strategy) for scenario, strategy in given)
    return session.models.get(trained)


def _solvers(
    session: Session, scenario: Scenario, pairs: Mapping[tuple[Scenario, str], Model], notes: Notes
) -> dict[str, Solver]:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param scenario: The scenario to solve
    :param pairs: The trained pairs
    :param notes: Receives what is left out
    :return: The solvers by column
    """
    found: dict[str, Solver] = {}
    trained = session.scale.trained_for(scenario)
    independent, ours = pairs.get((trained, INDEPENDENT)), pairs.get((trained, ITS))
    for solver, column in BASELINES.items():
        if solver not in session.solvers:
            notes.add(f"{column} was not requested (--solvers).")
        elif solver != "kmeans-am":
            found[column] = session.evaluator.baseline(solver)
        elif independent is not None:
            found[column] = session.evaluator.baseline(solver, independent)
    if KMEANS_AM in found:
        notes.add(
            f"{KMEANS_AM} uses the router of DL-DRL-I, which is trained on whole uniform instances only, for as many "
            "epochs as that of DL-DRL."
        )
    for column, model, sampling in (
        (INDEPENDENT_GREEDY, independent, False),
        (INDEPENDENT_SAMPLING, independent, True),
        (GREEDY, ours, False),
        (SAMPLING, ours, True),
    ):
        if model is not None:
            found[column] = session.evaluator.pair(model, sampling)
        else:
            notes.add(f"{column.split()[0]} has no trained pair for {trained.name}, and --no-training forbids training one.")
    found |= {solver: session.evaluator.baseline(solver) for solver in session.extra_solvers}
    return found


def _say_how_many(session: Session, notes: Notes) -> None:
    scale = session.scale
    counts = ", ".join(f"{scale.n_instances[size]} (N = {size})" for size in SIZES)
    if len({scale.n_instances[size] for size in SIZES}) == 1:
        counts = str(scale.n_instances[SIZES[0]])
    limits = [f"{solver} {scale.time_limits[solver]:g} s" for solver in session.solvers if solver in scale.time_limits]
    notes.add(f"Ours: {counts} instances in place of 500, {scale.n_exact_instances} in place of 30, {scale.samples} samples.")
    if limits:
        notes.add(f"Our time limits per instance: {', '.join(limits)}.")


def _say_how_exact(errors: Sequence[float], notes: Notes) -> None:
    known = [error for error in errors if not math.isnan(error)]
    if known:
        notes.add(
            f"Our instances are not the paper's: the standard errors of our mean objectives go up to {max(known):.2f}. "
            "Methods of the same block solve the same instances, and are comparable more precisely."
        )


def _exact_block(session: Session, scenario: Scenario, solvers: Mapping[str, Solver], notes: Notes) -> dict[str, SummaryRow]:
    """Summaries of the solvers of the exact block, by column."""
    scale = session.scale
    chosen = {column: solvers[column] for column in EXACT_COLUMNS if column in solvers}
    if GUROBI in chosen:
        notes.add(f"{GUROBI}: ours is the paper's model, equations (1) to (8), solved by {scale.exact_backend}.")
        if scenario.n_tasks not in scale.exact_sizes:
            del chosen[GUROBI]
            left_out = ", ".join(str(size) for size in SIZES if size not in scale.exact_sizes)
            notes.add(f"The exact solver does not run with {left_out} tasks at scale {scale.name}.")
    instances = session.evaluator.instances(scenario, n_instances=scale.n_exact_instances)
    results = session.evaluator.run(scenario, list(chosen.values()), instances, folder="-exact")
    notes.add(*results.failures)
    return {column: results.rows[solver.name] for column, solver in chosen.items() if solver.name in results.rows}


def _block(session: Session, scenario: Scenario, solvers: Mapping[str, Solver], notes: Notes) -> dict[str, SummaryRow]:
    """Summaries of solvers on the test instances, by column."""
    results = session.evaluator.run(scenario, list(solvers.values()))
    notes.add(*results.failures)
    return {column: results.rows[solver.name] for column, solver in solvers.items() if solver.name in results.rows}


def _measures(rows: Mapping[str, SummaryRow], methods: Sequence[str]) -> dict[str, list[float | None]]:
    """The figures of a block: for each measure, one per method."""
    objectives = [complete(rows.get(method), lambda row: row.objective) for method in methods]
    shown = [math.nan if objective is None else objective for objective in objectives]
    return {
        "objective": objectives,
        "gap": list(gaps(shown)),
        "seconds": [complete(rows.get(method), lambda row: row.seconds) for method in methods],
    }


# --------------------------------------------------------------------------------------------------------------- Table IV


def table4(session: Session) -> list[Path]:
    """
    Generalization of pairs trained with 500 tasks to 600 and more.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    here = scenarios(LARGER_SIZES)
    pairs = trained_pairs(session, here)
    methods = (*LARGER_METHODS, *session.extra_solvers)
    columns = [Column(title, f"N={size}") for size in LARGER_SIZES for title in ("Obj.", "Time(s)")]
    heading = [Column("Fleet"), Column("Method"), Column("Source")]
    table = Table("Table IV", paper_tables()["table4"]["caption"], [*heading, *columns])
    labels = dict.fromkeys(model.label for model in pairs.values())
    notes = Notes(
        f"DL-DRL and DL-DRL-I: sampling, with the pairs {', '.join(labels) or '(none)'} (the paper's: U4-500, U6-500).",
        "The paper's table ends at 1000 tasks. Time: wall time per instance.",
    )
    notes.add_stand_ins(session.scale, [])
    counts = ", ".join(f"{session.scale.n_instances[size]} (N = {size})" for size in LARGER_SIZES)
    notes.add(f"Our instances: {counts}; the paper does not say how many it has.")
    errors: list[float] = []
    for n_uavs in dict.fromkeys(scenario.n_uavs for scenario in here):
        ours = {size: _larger(session, Scenario(n_uavs, size), pairs, notes) for size in LARGER_SIZES}
        errors += [row.standard_error for rows in ours.values() for row in rows.values()]
        found = {
            _OURS: {
                size: {
                    "objective": [complete(ours[size].get(method), lambda row: row.objective) for method in methods],
                    "seconds": [complete(ours[size].get(method), lambda row: row.seconds) for method in methods],
                }
                for size in LARGER_SIZES
            },
            _PAPER: {
                size: {
                    measure: [paper_figure("table4", f"U{n_uavs}", str(size), method, measure) for method in methods]
                    for measure in ("objective", "seconds")
                }
                for size in LARGER_SIZES
            },
        }
        for position, method in enumerate(methods):
            for source in (_PAPER, _OURS):
                if source == _PAPER and method in session.extra_solvers:
                    continue
                cells = [f"U{n_uavs}", method, source]
                for size in LARGER_SIZES:
                    figures = found[source][size]
                    for measure in ("objective", "seconds"):
                        show = _seconds if measure == "seconds" and source == _OURS else number
                        cells.append(show(figures[measure][position]))
                table.add(cells)
    _say_how_exact(errors, notes)
    table.notes = [*notes.list(), *paper_tables()["table4"]["faults"]]
    return session.write(table, "table4")


def _larger(
    session: Session, scenario: Scenario, pairs: Mapping[tuple[Scenario, str], Model], notes: Notes
) -> dict[str, SummaryRow]:
    """Summaries of the methods of Table IV, by name."""
    columns = {"DL-DRL-I": INDEPENDENT_SAMPLING, "DL-DRL": SAMPLING}
    all_solvers = _solvers(session, scenario, pairs, Notes())
    solvers = {
        method: all_solvers[column]
        for method in (*LARGER_METHODS, *session.extra_solvers)
        if (column := columns.get(method, method)) in all_solvers
    }
    for method in LARGER_METHODS:
        if method not in solvers:
            notes.add(f"{method} was not requested (--solvers), or --no-training forbids training its pair.")
    return _block(session, scenario, solvers, notes)
