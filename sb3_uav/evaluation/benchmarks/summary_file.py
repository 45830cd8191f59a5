"""``summary.md`` of a benchmark run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sb3_uav.evaluation.benchmarks.collection import BenchmarkFolder
from sb3_uav.evaluation.benchmarks.gaps import GAPS_FILE, ROUTES_FILE, GapRow, failures
from sb3_uav.evaluation.benchmarks.report import ABOUT_PARTIAL, markdown_table, report
from sb3_uav.evaluation.benchmarks.rounding import RULE
from sb3_uav.evaluation.results import RESULTS_FILE

SUMMARY_FILE = "summary.md"


def notes(benchmark: BenchmarkFolder, best_known: Mapping[str, float]) -> list[str]:
    """
    :param benchmark: The benchmark
    :param best_known: Best-known values
    :return: What a reader of the table has to know of the files, one sentence each
    """
    lines = []
    if benchmark.skipped:
        lines.append(f"Skipped, because no benchmark files: {_some([path.name for path in benchmark.skipped])}.")
    for metric in sorted(set(benchmark.unsupported.values())):
        names = [name for name, found in benchmark.unsupported.items() if found == metric]
        lines.append(f"Left out, because EDGE_WEIGHT_TYPE is {metric} and only EUC_2D can be solved: {_some(names)}.")
    unknown = [name for name in benchmark.instances if name not in best_known]
    if unknown:
        lines.append(f"Solved, but without a best-known value: {_some(unknown)}.")
    if any(instance.is_rounded for instance in benchmark.instances.values()):
        lines.append(
            f"OPLib's lengths are those of TSPLIB's {RULE}. Solvers see Euclidean lengths; tours that are too long by the "
            "rule are shortened before they count."
        )
    return lines


def _some(names: Sequence[str]) -> str:
    """:return: The names, or how many and the first ones"""
    shown = ", ".join(names[:5])
    return shown if len(names) <= 5 else f"{len(names)} ({shown}, ...)"


def repairs(rows: Sequence[GapRow]) -> list[str]:
    """
    :param rows: Gaps
    :return: How much the rounding rule took from each solver, or added, one sentence each
    """
    lines = []
    for solver in dict.fromkeys(row.solver for row in rows):
        own = [row for row in rows if row.solver == solver]
        for counts, what in (
            ([row.n_dropped for row in own], "had to be left out of"),
            ([row.n_added for row in own], "could be put into"),
        ):
            n_tasks, n_tours = sum(counts), sum(count > 0 for count in counts)
            if n_tours:
                tasks = "1 task" if n_tasks == 1 else f"{n_tasks} tasks"
                lines.append(f"{solver}: by the rounding rule {tasks} {what} {n_tours} of its tours.")
    return lines


def omissions(rows: Sequence[GapRow]) -> list[str]:
    """
    :param rows: Gaps
    :return: Which solvers leave out tasks that must be served, because means of values do not show that, one sentence each
    """
    lines = []
    for solver in dict.fromkeys(row.solver for row in rows):
        own = [row for row in rows if row.solver == solver]
        count = sum((row.unserved or 0) > 0 for row in own)
        if count:
            what = "results leave out tasks that must be served, which gaps do not show and no value makes up for"
            lines.append(f"{solver}: {count} of {len(own)} {what}; see unserved in {GAPS_FILE}.")
    return lines


def summary_text(benchmark: BenchmarkFolder, best_known: Mapping[str, float], rows: Sequence[GapRow]) -> str:
    """
    :param benchmark: The benchmark
    :param best_known: Best-known values
    :param rows: Gaps
    :return: The text of ``summary.md``
    """
    table = report(rows)
    n_known = len(set(benchmark.instances) & set(best_known))
    seeds = ", ".join(str(seed) for seed in sorted({row.seed for row in rows}))
    lines = [
        f"# Benchmark: {benchmark.path.resolve().name}",
        "",
        f"{len(benchmark.instances)} instances, {n_known} of them with a best-known value; seed {seeds}.",
        "",
        *markdown_table(table),
        "",
        "Gap: (best known - objective) / best known, mean over the results that have both; negative where the objective is",
        "more, 0 where the best-known value is 0. Reached: objective at least the best-known value. Better: more than that.",
    ]
    if any(0 < row.n_compared < row.n_results for row in table):
        # The star is none of Markdown's.
        lines += ["", "\\" + ABOUT_PARTIAL + "."]
    for line in (*notes(benchmark, best_known), *repairs(rows), *omissions(rows)):
        lines += ["", line]
    better = [row for row in rows if row.better]
    if better:
        lines += ["", "## Better than the best-known value", ""]
        lines += [f"- {row.instance}: {row.objective:g} against {row.best_known:g}, by {row.solver}" for row in better]
    problems = failures(rows)
    if problems:
        lines += ["", "## Failures", "", *(f"- {line}" for line in problems)]
    lines += [
        "",
        f"Files: `{GAPS_FILE}` (all results), `{ROUTES_FILE}` (the routes that count, by the numbers of their nodes in",
    ]
    lines += [f"the files, from 1; of `.npz` by task, from 0), `{RESULTS_FILE}` and the others of `sb3-uav evaluate`."]
    return "\n".join(lines) + "\n"
