"""What a command prints of a mission, and how it shows that a solver is at work."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from sb3_uav.evaluation.table import require_rich
from sb3_uav.missions.labels import at_least, count, meters, number, percent, proof, shown
from sb3_uav.missions.plan import Plan, Reason
from sb3_uav.missions.remarks import named

_OK, _NOT_DONE = 0, 1
# Characters of the bar that shows the time.
_BAR = 20


def exit_code(plan: Plan) -> int:
    """:return: 0 for a plan that serves something and everything that must be served, otherwise 1"""
    return _OK if plan.n_served > 0 and not plan.unserved else _NOT_DONE


def print_plan(plan: Plan, files: Sequence[Path], console: Any = None) -> None:
    """
    Print what a plan does, what it leaves out, and what a person should know.

    :param plan: The plan, with its remarks
    :param files: The files that were written
    :param console: A rich console; the standard output when None
    :raises ImportError: If rich is not installed
    """
    rich = require_rich()
    console = rich.console.Console(highlight=False) if console is None else console

    def write(text: str, style: str = "") -> None:
        # Text, because rich would take brackets in a name for markup.
        console.print(rich.text.Text(text, style=style, overflow="fold"))

    tasks = plan.tasks
    write(
        f"{plan.n_served:,} of {count(len(tasks), 'task')} served, value {number(plan.objective)} of "
        f"{number(float(tasks.values.sum()))}, {meters(plan.length_m)} flown{'; ' * bool(proof(plan))}{proof(plan)}",
        "bold",
    )
    console.print(_table(rich, plan))
    for reason in get_args(Reason):
        skipped = [skipped for skipped in plan.skipped if skipped.reason == reason]
        if skipped:
            names = named([_missing(plan, one.task, one.missing_m) for one in skipped])
            write(f"{count(len(skipped), 'task')} skipped, {reason}: {names}")
    if plan.n_served == 0:
        write(f"The plan is empty: {why_empty(plan)}", "bold red")
    for remark in plan.remarks:
        write(f"! {remark}", "yellow" if console.is_terminal else "")
    if tasks.system != "wgs84":
        write("Coordinates of a plane: no .plan, .waypoints and KML, which need latitudes and longitudes.")
    if files:
        write(f"Written to {files[0].parent}: {', '.join(path.name for path in files)}")


def why_empty(plan: Plan) -> str:
    """
    :param plan: A plan that serves nothing
    :return: The reason, and what is missing most narrowly
    """
    near = [skipped for skipped in plan.skipped if skipped.missing_m is not None and skipped.reason != "worth nothing"]
    if not near:
        return "every task is worth nothing."
    best = min(near, key=lambda skipped: skipped.missing_m or 0.0)
    name, missing = shown(plan.tasks.ids[best.task]), best.missing_m or 0.0
    if best.reason == "did not fit":
        return f"the solver found no route, though task {name} alone is in reach; give it more time or choose another."
    return f"all tasks are out of reach; the nearest, {name}, needs {at_least(missing)} more range than any UAV may use."


def _table(rich: Any, plan: Plan) -> Any:
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD)
    is_timed = any(route.seconds is not None for route in plan.routes)
    keeps_reserve = any(uav.reserve_percent > 0 for uav in plan.fleet)
    table.add_column("UAV", overflow="fold", min_width=5)
    columns = ["Stops", "Length", "Used", "Of range"]
    for heading in (*columns, *(["Reserve"] if keeps_reserve else []), *(["Time"] if is_timed else [])):
        table.add_column(heading, justify="right", no_wrap=True)
    for route in plan.routes:
        cells = [str(len(route.stops)), meters(route.length_m), meters(route.used_m), percent(route.share_of_range)]
        cells += [f"{route.uav.reserve_percent:.3g} %"] if keeps_reserve else []
        cells += ["-" if route.seconds is None else _time(route.seconds)] if is_timed else []
        table.add_row(rich.text.Text(shown(route.uav.id)), *cells)
    return table


def _missing(plan: Plan, task: int, missing: float | None) -> str:
    name = shown(plan.tasks.ids[task])
    return name if not missing else f"{name} ({at_least(missing)} short)"


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d} min"


class Progress:
    """
    One line on a terminal: elapsed time against the limit, and the best plan so far. Use it as a context manager, as
    ``on_plan`` of :func:`~sb3_uav.missions.search.solve`, and :meth:`begin` as its ``on_start``. Without a terminal it shows
    nothing.

    :param time_limit: Seconds that the solver has, above 0
    :param console: A rich console; the standard error when None
    :raises ImportError: If rich is not installed
    """

    def __init__(self, time_limit: float, console: Any = None) -> None:
        rich = require_rich()
        from rich.live import Live

        self._rich = rich
        self._limit = time_limit
        self._start: float | None = None
        self._best = "no plan yet"
        self._lock = threading.Lock()
        console = rich.console.Console(file=sys.stderr) if console is None else console
        self._live = Live(console=console, get_renderable=self._line, refresh_per_second=5, transient=True)
        self._is_shown = console.is_terminal

    def begin(self) -> None:
        """The solver is loaded, its time begins."""
        self._start = time.perf_counter()

    def __enter__(self) -> Progress:
        if self._is_shown:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Clear the line and show the cursor again."""
        if self._is_shown:
            self._live.stop()

    def __call__(self, plan: Plan) -> None:
        """
        :param plan: A better plan than before
        """
        best = f"{plan.n_served} of {len(plan.tasks)} tasks, value {number(plan.objective)}"
        with self._lock:
            self._best = best

    def _line(self) -> Any:
        if self._start is None:
            return self._rich.text.Text("loading the solver")
        elapsed = time.perf_counter() - self._start
        full = int(_BAR * min(elapsed / self._limit, 1.0))
        with self._lock:
            text = f"{'━' * full}{' ' * (_BAR - full)} {elapsed:4.1f} of {self._limit:g} s: {self._best}"
        return self._rich.text.Text(text, no_wrap=True, overflow="ellipsis")
