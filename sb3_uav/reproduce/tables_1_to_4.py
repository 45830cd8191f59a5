"""Tables I to IV of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sb3_uav.evaluation.summary import SummaryRow, gaps
from sb3_uav.reproduce.blocks import Block, Pairs, exact_block, full_block, make_solvers
from sb3_uav.reproduce.evaluator import complete
from sb3_uav.reproduce.methods import column, explanations, learned_methods, learned_pairs, other_columns, other_methods
from sb3_uav.reproduce.pairs import Model, read_log
from sb3_uav.reproduce.paper import (
    EXACT_BLOCK,
    EXACT_COLUMNS,
    FULL_BLOCK,
    FULL_COLUMNS,
    INSTANCES_PER_EPOCH,
    LARGER_METHODS,
    LARGER_SIZES,
    MEASURES,
    PHASES,
    SIZES,
    paper_figure,
    paper_tables,
)
from sb3_uav.reproduce.scales import Scenario, scenarios
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.reproduce.table_formats import Column, Table, number

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
        networks = "" if "policy_kwargs" in session.scale.timing.allocator else "networks and "
        notes.add(f"Our runs have the paper's {networks}baseline, but batches of {_batch_size(session)} instances.")
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
    pairs = learned_pairs(session.models, here)
    further = (*other_columns(session.models), *session.extra_solvers)
    blocks = {EXACT_BLOCK: EXACT_COLUMNS, FULL_BLOCK: (*FULL_COLUMNS, *further)}
    columns = [Column(column, block) for block, methods in blocks.items() for column in methods]
    heading = [Column("Number of tasks"), Column("Measure"), Column("Source")]
    table = Table(label, paper_tables()[name]["caption"], [*heading, *columns])
    notes = Notes("Gap: to the best method of the same block, in percent. Time: wall time per instance.")
    notes.add_stand_ins(session.scale, here)
    _say_how_many(session, notes)
    notes.add(*explanations(session.models))
    errors: list[float] = []
    for scenario in here:
        solvers = make_solvers(session, scenario, pairs, notes)
        found = {
            EXACT_BLOCK: exact_block(session, scenario, solvers, notes).rows,
            FULL_BLOCK: full_block(session, scenario, solvers, notes).rows,
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
    pairs = learned_pairs(session.models, here)
    methods = larger_methods(session)
    columns = [Column(title, f"N={size}") for size in LARGER_SIZES for title in ("Obj.", "Time(s)")]
    heading = [Column("Fleet"), Column("Method"), Column("Source")]
    table = Table("Table IV", paper_tables()["table4"]["caption"], [*heading, *columns])
    labels = dict.fromkeys(model.label for model in pairs.values())
    notes = Notes(
        f"Learned methods: sampling, with the pairs {', '.join(labels) or '(none)'} (the paper's: U4-500, U6-500).",
        "The paper's table ends at 1000 tasks. Time: wall time per instance.",
    )
    notes.add_stand_ins(session.scale, [])
    notes.add(*explanations(session.models))
    counts = ", ".join(f"{session.scale.n_instances[size]} (N = {size})" for size in LARGER_SIZES)
    notes.add(f"Our instances: {counts}; the paper does not say how many it has.")
    errors: list[float] = []
    for n_uavs in dict.fromkeys(scenario.n_uavs for scenario in here):
        ours = {size: larger_block(session, Scenario(n_uavs, size), pairs, notes).rows for size in LARGER_SIZES}
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
                if source == _PAPER and method not in LARGER_METHODS:
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


def larger_methods(session: Session) -> list[str]:
    """
    :param session: The trained pairs and the solvers
    :return: The rows of Table IV
    """
    return [*LARGER_METHODS, *other_methods(session.models), *session.extra_solvers]


def larger_block(session: Session, scenario: Scenario, pairs: Pairs, notes: Notes) -> Block:
    """
    :param session: The scale, the trained pairs, the evaluations and the output folder
    :param scenario: The scenario to solve
    :param pairs: The trained pairs by scenario and method
    :param notes: Receives what is left out
    :return: Results of the methods of Table IV
    """
    learned = learned_methods(session.models)
    all_solvers = make_solvers(session, scenario, pairs, Notes())
    names = {method: column(method, sampling=True) if method in learned else method for method in larger_methods(session)}
    for method, name in names.items():
        if name not in all_solvers:
            notes.add(f"{method} was not requested (--solvers), or --no-training forbids training its pair.")
    return Block.run(session, scenario, {m: all_solvers[name] for m, name in names.items() if name in all_solvers}, notes)
