"""The results of a comparison: a CSV, figures and a report in Markdown."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th

import sb3_uav
from sb3_uav.common.files import write_atomically
from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.plots.bands import Band, BandPanel, plot_bands
from sb3_uav.training.fixed_set_history import EvaluationHistory

CSV_FILE = "evaluations.csv"
REPORT_FILE = "report.md"
_FIGURE_AXES = {
    "timesteps": "environment steps",
    "train_seconds": "seconds of training",
    "cpu_seconds": "CPU seconds of training",
}
FIGURE_FILES = ("comparison.png", "comparison.pdf")
_CSV_COLUMNS = ("algorithm", "variant", "seed", "timesteps", "wall_seconds", "cpu_seconds", "greedy", "sampled")
_PACKAGES = ("stable-baselines3", "sb3-contrib", "rl-zoo3", "gymnasium", "torch", "numpy")
_GRID_POINTS = 200
_BOOTSTRAP_SAMPLES = 2_000


class Run(NamedTuple):
    """
    One finished training.

    :param variant: Name of its variant
    :param algorithm: rl_zoo3's name of its algorithm
    :param seed: Its seed
    :param history: Its evaluations
    """

    variant: str
    algorithm: str
    seed: int
    history: EvaluationHistory


class _Estimate(NamedTuple):
    """
    :param mean: The mean
    :param half_width: Half of its 95 % confidence interval; NaN for a single value
    """

    mean: float
    half_width: float

    def __str__(self) -> str:
        return f"{self.mean:.2f}" if math.isnan(self.half_width) else f"{self.mean:.2f} ± {self.half_width:.2f}"


class _TableRow(NamedTuple):
    """
    One variant at one time.

    :param variant: Its name
    :param n_seeds: Number of its runs
    :param timesteps: Mean of the steps at that time
    :param seconds: Mean of the wall seconds of training at that time
    :param cpu_seconds: Mean of the CPU seconds, which other processes on the machine disturb less
    :param greedy: Mean objective of greedy decoding; the interval is over seeds
    :param sampled: The same of the best of the samples; None without sampling
    :param difference: Greedy objective minus that of the variant that is best by it, see :func:`_difference`
    :param sampled_difference: The same of the best of the samples; None without sampling
    """

    variant: str
    n_seeds: int
    timesteps: float
    seconds: float
    cpu_seconds: float
    greedy: _Estimate
    sampled: _Estimate | None
    difference: _Estimate
    sampled_difference: _Estimate | None


def _by_variant(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """
    :param runs: Runs
    :return: The runs by variant, in order of appearance
    """
    return {name: [run for run in runs if run.variant == name] for name in dict.fromkeys(run.variant for run in runs)}


def _estimate(values: np.ndarray) -> _Estimate:
    """
    :param values: ``(n,)``
    :return: Their mean and its confidence interval
    """
    return _Estimate(float(values.mean()), float(confidence_halfwidth(values)))


def _difference(values: np.ndarray, others: np.ndarray) -> _Estimate:
    """
    The mean difference of two variants, paired by instance. Its 95 % interval is that of a bootstrap over seeds and instances,
    so that it holds for other seeds and other instances.

    :param values: ``(n_seeds, n_instances)``
    :param others: ``(n_other_seeds, n_instances)``, on the same instances
    :return: The mean, and half of the width of the interval; NaN where one variant has a single seed
    """
    mean = float(values.mean() - others.mean())
    if min(len(values), len(others)) < 2:
        return _Estimate(mean, math.nan)
    if values is others:
        return _Estimate(0.0, 0.0)
    rng = np.random.default_rng(0)
    means = []
    for _ in range(_BOOTSTRAP_SAMPLES):
        columns = rng.integers(values.shape[1], size=values.shape[1])
        rows, other_rows = (rng.integers(len(array), size=len(array)) for array in (values, others))
        # The mean over seeds first: it is much smaller than the table of all.
        means.append(values[rows].mean(0)[columns].mean() - others[other_rows].mean(0)[columns].mean())
    low, high = np.quantile(means, [0.025, 0.975])
    return _Estimate(mean, float(high - low) / 2)


def _interpolate(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """
    Linear between evaluations, constant before the first and after the last.

    :param x: ``(n_evaluations,)``, increasing
    :param values: ``(n_evaluations, n_instances)``
    :param at: ``(n,)``
    :return: ``(n, n_instances)``
    """
    if len(x) == 1:
        return np.repeat(values, len(at), axis=0)
    upper = np.clip(np.searchsorted(x, at), 1, len(x) - 1)
    span = x[upper] - x[upper - 1]
    weight = np.clip((at - x[upper - 1]) / np.where(span > 0, span, 1), 0.0, 1.0)[:, None]
    return (1 - weight) * values[upper - 1] + weight * values[upper]


def _compute_table(runs: Sequence[Run], axis: str, at: float) -> list[_TableRow]:
    """
    :param runs: Finished runs
    :param axis: ``"timesteps"``, ``"train_seconds"`` or ``"cpu_seconds"``
    :param at: Position on that axis
    :return: One row per variant, the best first
    """
    where = np.array([at])

    def of(run: Run, field: str) -> np.ndarray:
        values = np.asarray(getattr(run.history, field), dtype=np.float64)
        values = values[:, None] if values.ndim == 1 else values
        return _interpolate(getattr(run.history, axis), values, where)[0]

    groups = _by_variant(runs)
    # (n_seeds, n_instances) each.
    greedy = {name: np.stack([of(run, "results") for run in group]) for name, group in groups.items()}
    sampled = {name: np.stack([of(run, "sampled") for run in group]) for name, group in groups.items()}
    has_samples = all(values.shape[1] > 0 for values in sampled.values())
    best = max(greedy, key=lambda name: greedy[name].mean())
    best_sampled = max(sampled, key=lambda name: sampled[name].mean()) if has_samples else best
    rows = []
    for name, group in groups.items():
        rows.append(
            _TableRow(
                variant=name,
                n_seeds=len(group),
                timesteps=float(np.mean([of(run, "timesteps") for run in group])),
                seconds=float(np.mean([of(run, "train_seconds") for run in group])),
                cpu_seconds=float(np.mean([of(run, "cpu_seconds") for run in group])),
                greedy=_estimate(greedy[name].mean(1)),
                sampled=_estimate(sampled[name].mean(1)) if has_samples else None,
                difference=_difference(greedy[name], greedy[best]),
                sampled_difference=_difference(sampled[name], sampled[best_sampled]) if has_samples else None,
            )
        )
    return sorted(rows, key=lambda row: -row.greedy.mean)


def _compute_band(group: Sequence[Run], axis: str, field: str, end: float) -> Band:
    """
    :param group: The runs of one variant
    :param axis: ``"timesteps"``, ``"train_seconds"`` or ``"cpu_seconds"``
    :param field: ``"results"`` or ``"sampled"``
    :param end: Upper limit of the horizontal axis; the curve also ends with the shortest run
    :return: Mean over seeds and its confidence interval
    """
    last = min(float(getattr(run.history, axis)[-1]) for run in group)
    grid = np.linspace(0.0, min(last, end), _GRID_POINTS)
    curves = []
    for run in group:
        means = getattr(run.history, field).mean(1)
        curves.append(_interpolate(getattr(run.history, axis), means[:, None], grid)[:, 0])
    stacked = np.stack(curves)
    return Band(grid, stacked.mean(0), confidence_halfwidth(stacked))


def _draw(runs: Sequence[Run], budget: int, n_samples: int, folder: Path) -> None:
    """
    :param runs: Finished runs
    :param budget: Environment steps of each
    :param n_samples: Samples per instance
    :param folder: Output folder of the figures
    """
    groups = _by_variant(runs)
    fields = {"results": "greedy"}
    if n_samples > 0:
        fields["sampled"] = f"best of {n_samples} samples"
    lines = []
    for field, label in fields.items():
        line = []
        for axis, x_label in _FIGURE_AXES.items():
            end = budget if axis == "timesteps" else math.inf
            bands = {name: _compute_band(group, axis, field, end) for name, group in groups.items()}
            line.append(BandPanel(x_label, f"mean objective, {label}", bands))
        lines.append(line)
    for name in FIGURE_FILES:
        plot_bands(lines, folder / name)


def _csv_text(runs: Sequence[Run]) -> str:
    """
    :param runs: Finished runs
    :return: One row per evaluation
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_COLUMNS)
    for run in runs:
        history = run.history
        for i in range(len(history.timesteps)):
            sampled = f"{history.sampled[i].mean():.6f}" if history.sampled.shape[1] > 0 else ""
            seconds = (f"{history.train_seconds[i]:.3f}", f"{history.cpu_seconds[i]:.3f}")
            means = (f"{history.results[i].mean():.6f}", sampled)
            writer.writerow([run.algorithm, run.variant, run.seed, int(history.timesteps[i]), *seconds, *means])
    return text.getvalue()


def _markdown_table(rows: Sequence[_TableRow], n_samples: int) -> str:
    """
    :param rows: Rows, the best first
    :param n_samples: Samples per instance
    :return: A table
    """
    columns = ["", "seeds", "steps", "seconds", "CPU seconds", "greedy"]
    columns += ["difference to the best"] + [f"best of {n_samples}", "difference to the best"] * (n_samples > 0)
    lines = [columns, ["---"] + ["---:"] * (len(columns) - 1)]
    for row in rows:
        times = [f"{row.timesteps:,.0f}", f"{row.seconds:,.1f}", f"{row.cpu_seconds:,.1f}"]
        cells = [row.variant, str(row.n_seeds), *times, str(row.greedy), str(row.difference)]
        cells += [str(row.sampled), str(row.sampled_difference)] * (n_samples > 0)
        lines.append(cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine(n_threads: int, n_jobs: int, device: str) -> str:
    """
    :param n_threads: Threads of each training
    :param n_jobs: Trainings side by side
    :param device: Device of the trainings
    :return: A line about the machine
    """
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        models = [line.partition(":")[2].strip() for line in information.read_text().splitlines() if "model name" in line]
        processor = models[0] if models else processor
    text = f"{os.cpu_count()} logical cores of {processor}, {platform.system()}, {platform.machine()}"
    if device != "cpu" and th.cuda.is_available():
        text += f", {th.cuda.get_device_name()}"
    return f"{text}; {n_jobs} training(s) side by side, {n_threads} thread(s) each, device {device}"


def versions() -> str:
    """:return: Versions of the packages that the figures were made with"""
    found = [f"sb3_uav {sb3_uav.__version__}", f"Python {platform.python_version()}"]
    for package in _PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} of unknown version")
    return ", ".join(found)


def write_results(
    runs: Sequence[Run],
    folder: Path,
    title: str,
    budget: int,
    n_samples: int,
    notes: Sequence[str],
    commands: Mapping[str, str],
) -> None:
    """
    Write the CSV, the figures and the report.

    :param runs: Finished runs, at least one
    :param folder: Output folder
    :param title: Title of the report
    :param budget: Environment steps of each run
    :param n_samples: Samples per instance
    :param notes: Notes on the procedure, one line each
    :param commands: The commands by description
    """
    write_atomically(folder / CSV_FILE, _csv_text(runs))
    _draw(runs, budget, n_samples, folder)
    wall, cpu = (min(float(getattr(run.history, axis)[-1]) for run in runs) for axis in ("train_seconds", "cpu_seconds"))
    lines = [
        f"# {title}",
        "",
        *(f"- {note}" for note in notes),
        "",
        f"![Learning curves]({FIGURE_FILES[0]})",
        "",
        "*Mean objective on the validation set; bands are 95 % confidence intervals over seeds.*",
        "",
        f"## At equal environment steps: {budget:,}",
        "",
        _markdown_table(_compute_table(runs, "timesteps", budget), n_samples),
        "",
        f"## At equal wall time: {wall:,.1f} s of training",
        "",
        "The time of the fastest run.",
        "",
        _markdown_table(_compute_table(runs, "train_seconds", wall), n_samples),
        "",
        f"## At equal CPU time: {cpu:,.1f} s of training",
        "",
        "Other processes on the machine lengthen wall time, by a different factor in each run; they hardly change CPU time.",
        "",
        _markdown_table(_compute_table(runs, "cpu_seconds", cpu), n_samples),
        "",
        "## How to read this",
        "",
        "Objectives: mean over the validation instances, and the 95 % confidence interval over training seeds (Student's t).",
        "Differences: a variant's mean minus that of the variant that is best in the column before, paired instance by",
        "instance, and the 95 % interval of a bootstrap over seeds and instances (none with a single seed). Values between",
        "two evaluations are interpolated.",
        "Seconds are wall time of learning alone, without evaluations, saving and the start of the process. Greedy",
        "episodes of the rollout baseline take time but do not count as environment steps.",
        "",
        "## Commands",
        "",
        *(f"{what}:\n\n```bash\n{command}\n```\n" for what, command in commands.items()),
        f"Data: [{CSV_FILE}]({CSV_FILE}), one row per evaluation.",
        "",
    ]
    write_atomically(folder / REPORT_FILE, "\n".join(lines))
