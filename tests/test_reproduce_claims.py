"""The claims page of `sb3-uav reproduce`: verdicts on results that are made up."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_uav.common.statistics import Interval
from sb3_uav.reproduce.claims import (
    DOES_NOT_HOLD,
    HOLDS,
    NO_DATA,
    NOT_DECIDED,
    Cells,
    Claim,
    Comparison,
    Measurements,
    all_claims,
    papers_ratio,
    ratio_to_ortools,
)
from sb3_uav.reproduce.claims_tables import _comparisons, _ratios, _verdicts
from sb3_uav.reproduce.figures_3_to_7 import LoggedCurve
from sb3_uav.reproduce.paper import FULL_COLUMNS, GREEDY, KMEANS_AM, KMEANS_VND, OR_TOOLS, SAMPLING
from sb3_uav.reproduce.scales import Scenario
from sb3_uav.reproduce.table_formats import MISSING
from sb3_uav.training.its_schedule import ITS, NO_INTENSIVE, NO_PRETRAINING

# Differences between methods have this noise, so that their intervals are not points.
NOISE = np.array([0.0, 0.3, -0.2, 0.1, -0.1, 0.2, -0.3, 0.0])

HALFWIDTH = 2.365 * float(NOISE.std(ddof=1)) / np.sqrt(8)


def cells(seconds: float = 1.0, **means: float) -> Cells:
    """Eight instances, of which each has its own difficulty; every method has its own noise."""
    difficulty = np.linspace(-10, 10, 8)
    return {
        name: (mean + difficulty + np.roll(NOISE, position), np.full(8, seconds * (1 + position)))
        for position, (name, mean) in enumerate(means.items())
    }


def claim(found: Measurements, text: str, where: str = "Table II") -> Claim:
    (only,) = (claim for claim in all_claims(found) if claim.text == text and claim.where.partition(",")[0] == where)
    return only


def test_intervals() -> None:
    interval = Interval.of_mean(5 + NOISE)
    assert interval == pytest.approx((5.0, 5 - HALFWIDTH, 5 + HALFWIDTH, 8))
    assert [Interval.of_mean(shift + NOISE).sign for shift in (1.0, 0.1, -1.0)] == [1, 0, -1]
    assert Interval.of_mean(np.array([3.0])).sign == 0 and np.isnan(Interval.of_mean(np.array([3.0])).low)
    # The same instances twice as large: the ratio is exact. The noise alone, relative to a mean of 10, is that of the mean.
    base = np.array([8.0, 9.0, 10.0, 11.0, 12.0, 10.0, 9.0, 11.0])
    assert Interval.of_ratio(2 * base, base) == pytest.approx((2.0, 2.0, 2.0, 8))
    noisy = Interval.of_ratio(base + NOISE, base)
    assert noisy.mean == pytest.approx(1.0) and noisy.high - noisy.mean == pytest.approx(HALFWIDTH / 10)
    assert noisy.minus(0.5) == pytest.approx((0.5, noisy.low - 0.5, noisy.high - 0.5, 8))


def test_verdicts_follow_from_the_intervals() -> None:
    above, zero, below = (Comparison(str(shift), Interval.of_mean(shift + NOISE)) for shift in (1.0, 0.1, -1.0))
    assert Claim("", "", [above, above]).verdict == HOLDS
    assert Claim("", "", [above, zero]).verdict == NOT_DECIDED
    assert Claim("", "", [above, zero, below]).verdict == DOES_NOT_HOLD
    assert Claim("", "", []).verdict == NO_DATA and Claim("", "", []).weakest is None
    assert Claim("", "", [above, below, zero]).weakest is below
    # Too few, although equal differences have a narrow interval.
    for n, verdict in ((1, NOT_DECIDED), (2, NOT_DECIDED), (3, HOLDS)):
        assert Claim("", "", [above, Comparison("", Interval.of_mean(np.full(n, 3.0)))]).verdict == verdict


def test_similar_is_within_a_margin() -> None:
    near = Interval.of_mean(0.1 + NOISE)
    assert [Comparison("", near, margin).sign for margin in (1.0, 0.2, 0.05)] == [1, 0, 0]
    assert Comparison("", near.minus(2.0), 1.0).sign == Comparison("", near.minus(-2.0), 1.0).sign == -1


def test_order_of_methods() -> None:
    """Of the same training: DL-DRL-I is compared with the pair that was trained as long as it, not with the shipped one."""
    means = dict(zip(FULL_COLUMNS, (66.0, 56.0, 60.0, 64.0, 66.0, 68.0, 70.0), strict=True))
    means |= {"DL-DRL short (Greedy)": 63.0, "DL-DRL short (Sampling)": 66.05, "Untrained (Greedy)": 69.0}
    found = Measurements(full={Scenario(4, 80): cells(**means)}, larger={Scenario(4, 600): cells(**{"DL-DRL short": 1.0})})
    assert claim(found, f"{GREEDY} visits more tasks than {KMEANS_VND}").verdict == HOLDS
    assert claim(found, f"{KMEANS_AM} visits more tasks than {KMEANS_VND}").verdict == HOLDS
    assert claim(found, "DL-DRL short (Greedy) visits more tasks than DL-DRL-I (Greedy)").verdict == DOES_NOT_HOLD
    assert claim(found, "DL-DRL short (Sampling) visits more tasks than DL-DRL-I (Sampling)").verdict == NOT_DECIDED
    assert claim(found, f"{GREEDY} visits more tasks than Untrained (Greedy)").verdict == DOES_NOT_HOLD
    # The paper has OR-tools first with 80 tasks; there is no larger size here.
    assert claim(found, f"{OR_TOOLS} visits more tasks than {SAMPLING} up to 80 tasks").verdict == DOES_NOT_HOLD
    assert claim(found, f"{SAMPLING} visits more tasks than {OR_TOOLS} on more than 80 tasks").verdict == NO_DATA
    assert claim(found, f"{SAMPLING} takes less time than {OR_TOOLS}").verdict == DOES_NOT_HOLD
    assert {c.verdict for c in all_claims(found) if c.where.startswith("Table III")} == {NO_DATA}
    (difference,) = claim(found, f"{GREEDY} visits more tasks than {KMEANS_VND}").comparisons
    assert difference.label == "U4-80" and difference.interval.mean == pytest.approx(12.0)
    # Without the shipped pair there is one DL-DRL.
    means = {name: mean for name, mean in means.items() if "short" not in name}
    found = Measurements(full={Scenario(4, 80): cells(**means)}, larger={})
    assert claim(found, f"{GREEDY} visits more tasks than DL-DRL-I (Greedy)").verdict == HOLDS


def test_larger_instances() -> None:
    """Of the sizes that the paper has."""
    sizes = {size: cells(**{OR_TOOLS: 300.0, "DL-DRL": 320.0 if size <= 1000 else 200.0}) for size in (600, 1000, 1500)}
    found = Measurements(larger={Scenario(4, size): results for size, results in sizes.items()})
    exceeds = claim(found, "U4: DL-DRL visits more tasks than OR-tools", "Table IV")
    assert [comparison.label for comparison in exceeds.comparisons] == ["U4-600", "U4-1000"] and exceeds.verdict == HOLDS
    assert claim(found, "U6: DL-DRL visits more tasks than OR-tools", "Table IV").verdict == NO_DATA


def test_order_on_six_uavs_is_the_papers() -> None:
    """With 80 tasks and 6 UAVs, K-means+VND is above K-means+AM in the paper."""
    full = {
        Scenario(6, 80): cells(**{KMEANS_VND: 69.0, KMEANS_AM: 68.0}),
        Scenario(6, 100): cells(**{KMEANS_VND: 81.0, KMEANS_AM: 83.0}),
    }
    found = claim(
        Measurements(full=full),
        "K-means+AM visits more tasks than K-means+VND (the paper's order, but for U6-80)",
        "Table III",
    )
    assert [comparison.label for comparison in found.comparisons] == ["U6-100"] and found.verdict == HOLDS


def test_ratios() -> None:
    assert papers_ratio(Scenario(4, 80), SAMPLING) == pytest.approx(65.28 / 65.44)
    assert papers_ratio(Scenario(6, 1000), "DL-DRL") == pytest.approx(443.20 / 437.17)
    assert papers_ratio(Scenario(4, 80), "Untrained (Greedy)") is None and papers_ratio(Scenario(4, 1500), "DL-DRL") is None
    here = cells(**{OR_TOOLS: 65.44, SAMPLING: 65.3, GREEDY: 60.0, KMEANS_AM: 64.0, "Untrained (Greedy)": 50.0})
    ratio = ratio_to_ortools(here, SAMPLING)
    assert ratio is not None and ratio.mean == pytest.approx(65.3 / 65.44)
    assert ratio_to_ortools({SAMPLING: here[SAMPLING]}, SAMPLING) is None
    found = Measurements(full={Scenario(4, 80): here})
    table = _ratios(found, ["a note"])
    inside = {row[1]: row[-1] for row in table.rows}
    assert inside == {
        SAMPLING: "yes",
        GREEDY: "no, ours is lower",
        KMEANS_AM: "no, ours is higher",
        "Untrained (Greedy)": MISSING,
    }
    assert table.rows[0] == ["U4-80", SAMPLING, "8", "0.998", "0.998", *table.rows[0][5:]]
    assert "1 of 3 intervals contain the paper's ratio." in table.notes and table.notes[-1] == "a note"
    greedy = claim(found, f"{GREEDY} has a larger ratio to OR-tools than the paper's {SAMPLING}")
    assert greedy.verdict == DOES_NOT_HOLD and greedy.comparisons[0].interval.mean == pytest.approx((60.0 - 65.28) / 65.44)


def test_the_trained_size() -> None:
    """The pair of Fig. 5 against the one of all sizes; the shipped pair was trained for longer and does not count."""
    generalization = {
        Scenario(4, 80): cells(**{"universal": 69.0, "mixture": 62.0, "U4-80": 64.0, KMEANS_VND: 70.0}),
        Scenario(4, 100): cells(**{"universal": 69.0, "mixture": 72.0, "U4-80": 64.0}),
    }
    text = "A pair trained for a size visits more tasks there than pairs trained for others"
    found = claim(Measurements(generalization=generalization), text, "Fig. 6")
    assert [comparison.label for comparison in found.comparisons] == ["U4-80: over mixture"] and found.verdict == HOLDS
    generalization[Scenario(4, 100)] = cells(**{"U4-100": 70.0, "U4-80": 71.0})
    found = claim(Measurements(generalization=generalization), text, "Fig. 6")
    assert found.comparisons[1].label == "U4-100: over U4-80" and found.verdict == DOES_NOT_HOLD


def levels(objectives: list[float], minutes: float, generation: float, phases: str = "iiaa") -> dict[str, LoggedCurve]:
    names = {"i": "intensive", "a": "alternate"}
    times = np.arange(1, len(objectives) + 1) * minutes / len(objectives)
    upper = LoggedCurve(-np.array(objectives), [names[phase] for phase in phases], times, generation)
    return {"allocator": upper, "router": LoggedCurve(np.zeros(0), [], np.zeros(0), generation)}


def test_ablation() -> None:
    """Three seeds, paired: at the end ITS is like the training without intensive phase, and takes less time."""
    curves = {}
    for seed, shift in enumerate((0.0, 0.1, -0.1)):
        curves[ITS, seed] = levels([50 + shift, 60, 60 + shift, 60], 4.0, 1.0)
        curves[NO_INTENSIVE, seed] = levels([50, 60.1, 60.2, 60], 8.0, 3.0, "aaaa")
        curves[NO_PRETRAINING, seed] = levels([40, 50, 55, 57], 3.0, 1.0)
    found = Measurements(curves=curves)
    assert claim(found, "With pre-training, the first epoch visits more tasks", "Fig. 5").verdict == HOLDS
    similar = claim(found, "In the end ITS is within 1% of ITS without intensive training", "Fig. 5")
    assert similar.verdict == HOLDS and similar.comparisons[0].margin == pytest.approx(0.6)
    faster = claim(found, "The training of ITS takes less time than without intensive training", "Fig. 5")
    assert faster.verdict == HOLDS and faster.comparisons[0].interval == pytest.approx((4.0, 4.0, 4.0, 3))
    assert claim(found, "ITS generates data for less time than without intensive training", "Fig. 5").verdict == HOLDS
    by_epoch = claim(found, "In the end ITS visits more tasks than its ablations", "Fig. 5")
    assert [c.label for c in by_epoch.comparisons] == ["ITS over ITS/pre-training", "ITS over ITS/intensive"]
    assert by_epoch.verdict == DOES_NOT_HOLD and by_epoch.comparisons[0].interval.mean == pytest.approx(6.0)
    # After 4 minutes the training without intensive phase is at its second epoch; after 3, ITS at its third.
    by_time = claim(found, "At equal CPU time ITS visits more tasks than its ablations", "Fig. 5")
    assert [c.interval.mean for c in by_time.comparisons] == pytest.approx([3.0, -0.1])
    slow = claim(found, "Intensive training slows the convergence: its epochs visit fewer tasks", "Fig. 5")
    assert slow.verdict == NO_DATA


def test_tables_of_claims() -> None:
    means = dict(zip(FULL_COLUMNS, (66.0, 56.0, 60.0, 64.0, 66.0, 68.0, 70.0), strict=True))
    listed = all_claims(Measurements(full={Scenario(4, 80): cells(**means), Scenario(4, 100): cells(**means)}))
    table = _verdicts(listed, ["a note"])
    rows = {(row[0], row[1]): row[2:] for row in table.rows}
    *counts, verdict, weakest = rows["Table II", f"{GREEDY} visits more tasks than {KMEANS_VND}"]
    assert (counts, verdict) == (["2", "0", "0"], HOLDS)
    assert weakest.startswith("U4-80: +12.000 (+11.") and weakest.endswith(", n = 8)")
    assert rows["Fig. 5", "In the end ITS visits more tasks than its ablations"] == ["0", "0", "0", NO_DATA, MISSING]
    comparisons = [row for row in _comparisons(listed, []).rows if row[1] == f"{GREEDY} visits more tasks than {KMEANS_VND}"]
    assert [row[2:5] for row in comparisons] == [["U4-80", "8", "12.0000"], ["U4-100", "8", "12.0000"]]
