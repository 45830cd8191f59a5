"""The target ``claims``: the paper's claims with our verdicts, every comparison behind them, and every ratio to OR-tools."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_uav.common.statistics import CONFIDENCE
from sb3_uav.reproduce.blocks import exact_block, full_block, make_solvers
from sb3_uav.reproduce.claims import (
    DOES_NOT_HOLD,
    HOLDS,
    LEAST_SAMPLES,
    NOT_DECIDED,
    Cells,
    Claim,
    Comparison,
    Measurements,
    all_claims,
    papers_ratio,
    ratio_to_ortools,
)
from sb3_uav.reproduce.figures_3_to_7 import ablation_curves, generalization_blocks
from sb3_uav.reproduce.methods import explanations, learned_pairs
from sb3_uav.reproduce.paper import FLEETS, LARGER_SIZES, OR_TOOLS
from sb3_uav.reproduce.scales import Scenario, scenarios
from sb3_uav.reproduce.session import Notes, Session
from sb3_uav.reproduce.table_formats import MISSING, Column, Table, number
from sb3_uav.reproduce.tables_1_to_4 import larger_block

_INTERVALS = f"Intervals: {CONFIDENCE:.0%}, of paired differences on the same instances (Fig. 5: same seeds), Student's t."


def claims(session: Session) -> list[Path]:
    """
    What holds of the paper here, with intervals.

    :param session: The scale, the trained pairs, the evaluations and the output folder
    :return: Paths of the written files
    """
    notes = Notes()
    notes.add_stand_ins(session.scale, [])
    notes.add(*explanations(session.models))
    found = _measure(session)
    listed = all_claims(found)
    paths = session.write(_verdicts(listed, notes.list()), "claims")
    paths += session.write(_comparisons(listed, notes.list()), "claims_comparisons")
    return paths + session.write(_ratios(found, notes.list()), "claims_ratios")


def _measure(session: Session) -> Measurements:
    """Collect the results instance by instance; what the tables and figures have evaluated is read from their files."""
    here, larger = scenarios(), scenarios(LARGER_SIZES)
    pairs = learned_pairs(session.models, [*here, *larger])
    notes = Notes()
    full: dict[Scenario, Cells] = {}
    exact: dict[Scenario, Cells] = {}
    generalization: dict[Scenario, Cells] = {}
    for scenario in here:
        solvers = make_solvers(session, scenario, pairs, notes)
        full[scenario] = full_block(session, scenario, solvers, notes).by_instance()
        exact[scenario] = exact_block(session, scenario, solvers, notes).by_instance()
    for n_uavs in FLEETS:
        blocks = generalization_blocks(session, n_uavs, notes)
        generalization |= {scenario: block.by_instance() for scenario, block in blocks.items()}
    others = {scenario: larger_block(session, scenario, pairs, notes).by_instance() for scenario in larger}
    return Measurements(full, exact, others, generalization, ablation_curves(session))


def _verdicts(listed: Sequence[Claim], notes: Sequence[str]) -> Table:
    """
    :param listed: The claims
    :param notes: Notes on the methods
    :return: A row for each claim
    """
    titles = ("Where", "Claim", "For", "Open", "Against", "Verdict", "Weakest comparison")
    table = Table("Claims", "what holds of the paper here", [Column(title) for title in titles])
    for claim in listed:
        weakest = MISSING if claim.weakest is None else _describe(claim.weakest)
        table.add([claim.where, claim.text, *(str(claim.count(sign)) for sign in (1, 0, -1)), claim.verdict, weakest])
    table.notes = [
        f"A claim {HOLDS} if the interval of every comparison is on its side, {DOES_NOT_HOLD} if one is on the other, and "
        f"is {NOT_DECIDED} otherwise. For, open, against: comparisons whose interval is above 0, contains 0, is below 0; with "
        f"fewer than {LEAST_SAMPLES} differences it is open.",
        _INTERVALS + " They are not adjusted for the number of comparisons, all of which are in claims_comparisons.",
        "Claims of ratios: the paper's ratio of means is taken as exact. Where says ours: not a claim of the paper.",
        *notes,
    ]
    return table


def _describe(comparison: Comparison) -> str:
    mean, low, high, n = comparison.interval
    margin = "" if comparison.margin is None else f", margin {comparison.margin:.3f}"
    return f"{comparison.label}: {mean:+.3f} ({low:+.3f} to {high:+.3f}, n = {n}{margin})"


def _comparisons(listed: Sequence[Claim], notes: Sequence[str]) -> Table:
    """
    :param listed: The claims
    :param notes: Notes on the methods
    :return: A row for each comparison
    """
    titles = ("Where", "Claim", "Comparison", "n", "Difference", "Low", "High", "Margin")
    table = Table("Comparisons", "every comparison behind the claims", [Column(title) for title in titles])
    for claim in listed:
        for label, (mean, low, high, n), margin in claim.comparisons:
            figures = [number(figure, 4) for figure in (mean, low, high, margin)]
            table.add([claim.where, claim.text, label, str(n), *figures])
    table.notes = [_INTERVALS, "Margin: the claim is that the difference is nearer to 0 than this.", *notes]
    return table


def _ratios(found: Measurements, notes: Sequence[str]) -> Table:
    """
    :param found: The results
    :param notes: Notes on the methods
    :return: A row for each cell of Tables II to IV
    """
    titles = ("Situation", "Method", "n", "Paper", "Ours", "Low", "High", "Paper in interval")
    table = Table("Ratios", f"mean number of tasks divided by that of {OR_TOOLS}", [Column(title) for title in titles])
    n_inside, n_compared = 0, 0
    for scenario, cells in {**found.full, **found.larger}.items():
        for method in cells:
            ratio, printed = ratio_to_ortools(cells, method), papers_ratio(scenario, method)
            if ratio is None or method == OR_TOOLS:
                continue
            inside = MISSING
            if printed is not None:
                n_compared += 1
                n_inside += (is_inside := ratio.low <= printed <= ratio.high)
                inside = "yes" if is_inside else "no, ours is lower" if ratio.high < printed else "no, ours is higher"
            figures = [number(figure, 3) for figure in (printed, ratio.mean, ratio.low, ratio.high)]
            table.add([scenario.name, method, str(ratio.n), *figures, inside])
    table.notes = [
        f"Intervals of ratios of means: {CONFIDENCE:.0%}, by the delta method, on the same instances.",
        f"{n_inside} of {n_compared} intervals contain the paper's ratio.",
        *notes,
    ]
    return table
