"""Commands without the packages that extras bring: each ends in one line that names the extra."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmark_files import BEST_KNOWN, FILES

pytest.importorskip("rl_zoo3")

# Runs each command in a process forked from one that has imported what the core needs, with some packages hidden.
SCRIPT = """
import contextlib, io, json, os, sys, traceback
import stable_baselines3, sb3_contrib, torch

class Hidden:
    def __init__(self, names):
        self.names = names

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

def run(hidden, argv):
    for name in list(sys.modules):
        if name.partition(".")[0] in hidden:
            del sys.modules[name]
    sys.meta_path.insert(0, Hidden(hidden))
    from sb3_uav.cli.main import main
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(argv)
        except BaseException:
            code = traceback.format_exc()
    return code, err.getvalue()

for hidden, argv in json.load(sys.stdin):
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        print(json.dumps(run(hidden, argv)))
        sys.stdout.flush()
        os._exit(0)
    os.waitpid(child, 0)
"""

EVERYTHING = ["yaml", "rl_zoo3", "optuna", "huggingface_sb3", "matplotlib", "rich", "tqdm", "tensorboard", "numba", "ortools"]
ROUTING = ["--env", "RoutePlanning-N20-v0", "-n", "20"]
CASES: list[tuple[list[str], list[str], str]] = [
    (EVERYTHING, ["train", *ROUTING], "zoo"),
    (EVERYTHING, ["enjoy", *ROUTING], "zoo"),
    (EVERYTHING, ["demo"], "zoo"),
    (EVERYTHING, ["compare", *ROUTING, "--out", "out"], "zoo"),
    (EVERYTHING, ["reproduce", "table1"], "plots"),
    (EVERYTHING, ["anytime", "."], "plots"),
    (EVERYTHING, ["bench", ".", "--best-known", "b.csv", "--out", "out", "--solvers", "random-nearest"], "bench"),
    (
        ["vrplib"],
        ["bench", str(FILES), "--best-known", str(BEST_KNOWN), "--out", "out", "--solvers", "random-nearest"],
        "bench",
    ),
    (["yaml"], ["train", *ROUTING], "zoo"),
    (["rl_zoo3"], ["train", *ROUTING], "zoo"),
    (["optuna"], ["train", *ROUTING], "zoo"),
    (["requests"], ["enjoy", *ROUTING], "zoo"),
    (["huggingface_sb3"], ["enjoy", *ROUTING], "zoo"),
    (["tqdm"], ["train", *ROUTING, "--progress"], "zoo"),
    (["rich"], ["train", *ROUTING, "-P"], "zoo"),
    (["tensorboard"], ["train", *ROUTING, "-tb", "logs"], "zoo"),
    (["matplotlib"], ["demo"], "plots"),
    (["rich"], ["demo"], "zoo"),
    (["matplotlib"], ["compare", *ROUTING, "--out", "out"], "plots"),
    (["optuna"], ["reproduce", "table1"], "zoo"),
    (["matplotlib"], ["reproduce", "fig5", "--redraw"], "plots"),
    (EVERYTHING, ["record-video", *ROUTING], "zoo"),
    (EVERYTHING, ["benchmark"], "zoo"),
    (EVERYTHING, ["all-plots"], "zoo"),
    (EVERYTHING, ["push-to-hub", "-orga", "me", "--env", "RoutePlanning-N20-v0"], "zoo"),
    (EVERYTHING, ["load-from-hub", "-orga", "me", "--env", "RoutePlanning-N20-v0"], "zoo"),
    (["moviepy"], ["record-video", *ROUTING], "video"),
    (["moviepy"], ["push-to-hub", "-orga", "me", *ROUTING], "video"),
    (["seaborn"], ["all-plots"], "zoo-plots"),
    (["scipy"], ["plot-train"], "zoo-plots"),
    (["matplotlib"], ["plot-from-file"], "zoo-plots"),
    (["pytablewriter"], ["benchmark"], "zoo"),
    (["wandb"], ["train", *ROUTING, "--track"], "track"),
    ([*EVERYTHING, "plotly"], ["solve", "tasks.csv", "-o", "out"], "missions"),
    (["plotly"], ["solve", "tasks.csv", "-o", "out"], "missions"),
]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[object, str]]:
    """Exit code, or traceback, and standard error of every case."""
    folder: Path = tmp_path_factory.mktemp("core")
    given = json.dumps([case[:2] for case in CASES])
    done = subprocess.run([sys.executable, "-c", SCRIPT], input=given, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.skipif(not hasattr(sys, "getdlopenflags"), reason="needs fork")
@pytest.mark.parametrize("number", range(len(CASES)), ids=[f"{argv[0]}-{hidden[0]}" for hidden, argv, _ in CASES])
def test_a_missing_package_is_one_line_that_names_the_extra(number: int, outcomes: list[tuple[object, str]]) -> None:
    """The fault was `sb3-uav train` ending in "No module named 'yaml'"."""
    hidden, argv, extra = CASES[number]
    code, error = outcomes[number]
    assert code == 2, code or error
    assert error.startswith(f"sb3-uav {argv[0]}: error: ") and error.count("\n") == 1
    assert "pip install" in error and f"[{extra}]" in error and any(name in error for name in hidden)
