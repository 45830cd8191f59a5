"""
Random kills and restarts: what comes out at the end must equal what comes out of a run that nothing has interrupted.

    python benchmarks/soak.py --kills 200 --seed 1

Two commands are killed again and again: ``sb3-uav train`` of a tiny pair (warm start, both levels by ITSCallback, checkpoints,
FixedSetEvalCallback), and ``sb3-uav evaluate``. A kill is SIGKILL before the k-th file operation, or shortly after it, in the
middle of a write, or after a random time. Then the command is run again as a user would: ``train`` with ``-i`` of the newest
checkpoint, or unchanged where there is none; ``evaluate`` unchanged.

Once a command has ended by itself, its files are compared with those of an unbroken run, but for seconds: parameters and
optimizers of the final and best zips, histories of evaluations, logs, results, schedules and summaries. Each process is forked
from one that has imported everything. Ends with 1 if anything differs; the folders of those chains are kept.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
import yaml

from sb3_uav.cli import evaluate
from sb3_uav.envs import UniformGenerator
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER
from sb3_uav.zoo import experiment, train
from sb3_uav.zoo.checkpoints import newest_checkpoint

ENV = "TaskAllocation-U2-N6-v0"
_NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
# Steps of an epoch: 8 instances of 6 tasks.
_EPOCH = 8 * 6
# What writes, renames, makes or removes files, as Python announces it to audit hooks.
_OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "shutil.copyfile")
_KINDS = ("before a file operation", "during or after a file operation", "at a random time")
# Seconds: the longest wait after a file operation, and for a process that hangs.
_LONGEST_DELAY, _LIMIT = 0.02, 120.0
# Of the starts of a command; the others run to the end.
_SHARE_KILLED = 0.8
_MOST_KILLS_OF_A_CHAIN = 8
_SECONDS = ("seconds", "generation_seconds", "cpu_seconds", "train_seconds")


class Kill(NamedTuple):
    """
    :param kind: One of the kinds above
    :param operation: Number of the file operation, from 1
    :param delay: Seconds after it, or after the start
    """

    kind: str
    operation: int
    delay: float


class Outcome(NamedTuple):
    """
    :param code: Exit code; None of a process that was killed
    :param n_operations: Number of its file operations
    :param last: The last one
    :param seconds: Wall time
    """

    code: int | None
    n_operations: int
    last: str
    seconds: float


class Scene(NamedTuple):
    """
    :param name: Name
    :param run: Runs the command in a folder, again if there are files, and returns its exit code
    :param read: Reads what must be equal from a folder of a complete run
    """

    name: str
    run: Callable[[Path], int]
    read: Callable[[Path], dict[str, Any]]


def _announce(folder: Path, kill: Kill | None, pipe: int) -> None:
    """Count the file operations below the folder, tell the pipe of each, and die as planned."""
    count = 0
    root = str(folder)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        if event not in _OPERATIONS or not isinstance(arguments[0], str | os.PathLike):
            return
        path = os.path.abspath(os.fspath(arguments[0]))
        if not path.startswith(root) or (event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return
        count += 1
        os.write(pipe, f"{event} {os.path.relpath(path, root)}\n".encode())
        if kill is not None and count == kill.operation:
            if kill.kind == _KINDS[0]:
                os.kill(os.getpid(), signal.SIGKILL)
            # The default action ends the process without any clean-up, wherever it is.
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, kill.delay)

    sys.addaudithook(hook)


def run_forked(run: Callable[[Path], int], folder: Path, kill: Kill | None = None) -> Outcome:
    """
    :param run: Runs a command
    :param folder: Its folder
    :param kill: When to kill it; never when None
    :return: How it ended
    """
    receiving, sending = os.pipe()
    began = time.perf_counter()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        code = 70
        try:
            log = open(folder.with_suffix(".log"), "a", encoding="utf-8")
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            sys.stdout = sys.stderr = log
            _announce(folder, kill, sending)
            code = run(folder)
        except BaseException:
            traceback.print_exc()
        finally:
            log.flush()
            os._exit(code)
    os.close(sending)
    at_random = kill is not None and kill.kind == _KINDS[2]
    assert kill is None or kill.delay >= 0
    timer = threading.Timer(kill.delay if kill is not None and at_random else _LIMIT, os.kill, (child, signal.SIGKILL))
    timer.start()
    with os.fdopen(receiving, encoding="utf-8") as lines:
        operations = lines.read().splitlines()
    _, status = os.waitpid(child, 0)
    timer.cancel()
    ended = os.WEXITSTATUS(status) if os.WIFEXITED(status) else None
    return Outcome(ended, len(operations), operations[-1] if operations else "none", time.perf_counter() - began)


def _training_config() -> dict[str, Any]:
    router = dict(algo="reinforce", policy="RouterPolicy", n_envs=4, policy_kwargs=_NETWORK, learning_rate=1e-3)
    warm_start = dict(n_subsets=16, n_updates=4, batch_size=4)
    its = dict(router=router, n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=1, n_continuous_epochs=1)
    evaluation = dict(n_instances=4, n_samples=2)
    return dict(
        policy="sb3_uav.policies.AllocatorPolicy",
        policy_kwargs=_NETWORK,
        n_envs=4,
        n_timesteps=3 * _EPOCH,
        instances_per_epoch=8,
        learning_rate=1e-3,
        callback=[
            {"sb3_uav.training.ITSCallback": {**its, "warm_start": warm_start}},
            {"sb3_uav.training.FixedSetEvalCallback": evaluation},
        ],
    )


def _run_folders(folder: Path) -> list[Path]:
    """The run folders of rl_zoo3, the last one first."""
    found = (folder / "logs" / "reinforce").glob(f"{ENV}_*")
    return sorted(found, key=lambda path: int(path.name.rpartition("_")[2]), reverse=True)


def training_scene(inputs: Path) -> Scene:
    """
    :param inputs: Folder for the YAML
    :return: ``sb3-uav train``
    """
    config = inputs / "soak.yml"
    config.write_text(yaml.safe_dump({ENV: _training_config()}), encoding="utf-8")

    def run(folder: Path) -> int:
        checkpoints = (newest_checkpoint(path) for path in _run_folders(folder))
        checkpoint = next((path for path in checkpoints if path is not None), None)
        again = [] if checkpoint is None else ["-i", str(checkpoint)]
        where = ["--conf-file", str(config), "-f", str(folder / "logs")]
        return train.main(["--env", ENV, *where, "--seed", "1", "--eval-freq", "-1", *again])

    def read(folder: Path) -> dict[str, Any]:
        last = _run_folders(folder)[0]
        # A run that is continued after its last epoch leaves them where they are.
        log = next(path for path in _run_folders(folder) if (path / "its_log.csv").is_file())
        zips = [last / f"{ENV}.zip", last / "router.zip", last / "best_model.zip", last / "best_router.zip"]
        with np.load(last / "evaluations.npz") as arrays:
            history = {name: arrays[name].tolist() for name in arrays.files if name not in _SECONDS}
        return {
            **{f"{path.name} {name}": value for path in zips for name, value in _tensors(path).items()},
            "evaluations.npz": history,
            "its_log.csv": _rows(log / "its_log.csv"),
            "checkpoint": json.loads((log / CHECKPOINT_FOLDER / "its_state.json").read_text())["epoch"],
            "leftovers": sorted(path.name for path in last.rglob("*.tmp*")),
        }

    return Scene("train", run, read)


def evaluation_scene(inputs: Path) -> Scene:
    """
    :param inputs: Folder for instances
    :return: ``sb3-uav evaluate``
    """
    instances = inputs / "instances.npz"
    UniformGenerator(n_tasks=8, n_uavs=2)(6, np.random.default_rng(1)).save(instances)

    def run(folder: Path) -> int:
        solvers = ["--solvers", "kmeans-nearest", "random-nearest"]
        return evaluate.main(["--instances", str(instances), *solvers, "--out", str(folder / "out")])

    def read(folder: Path) -> dict[str, Any]:
        out = folder / "out"
        lines = (out / "schedules.jsonl").read_text(encoding="utf-8").splitlines()
        return {
            "results.csv": _rows(out / "results.csv"),
            "summary.csv": _rows(out / "summary.csv"),
            "schedules.jsonl": [json.loads(line) for line in lines],
            "leftovers": sorted(path.name for path in out.rglob("*.tmp*")),
        }

    return Scene("evaluate", run, read)


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV without their seconds."""
    rows = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
    return [{name: cell for name, cell in row.items() if name not in _SECONDS} for row in rows]


def _tensors(path: Path) -> dict[str, Any]:
    """Parameters and optimizers in a zip of SB3."""
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith(".pth")]
        return {name: _plain(th.load(io.BytesIO(archive.read(name)), weights_only=True)) for name in names}


def _plain(value: Any) -> Any:
    """Numbers and lists in place of tensors, bit for bit."""
    if isinstance(value, th.Tensor):
        return [str(value.dtype), list(value.shape), value.cpu().numpy().tobytes()]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@dataclass
class Tally:
    """What has happened so far."""

    kills: Counter[str] = field(default_factory=Counter)
    chains: Counter[str] = field(default_factory=Counter)
    places: Counter[str] = field(default_factory=Counter)
    starts: int = 0
    failures: list[str] = field(default_factory=list)

    @property
    def n_kills(self) -> int:
        """Processes that were killed."""
        return sum(self.kills.values())


def play_chain(
    scene: Scene, whole: Outcome, expected: dict[str, Any], folder: Path, seed: str, left: int, tally: Tally
) -> None:
    """
    Start a command, kill it, and start it again, until it ends by itself.

    :param scene: The command
    :param whole: Its unbroken run
    :param expected: The files of that run
    :param folder: Folder of the chain, removed if all is well
    :param seed: Seed of the kills
    :param left: Most kills
    :param tally: Where to count
    """
    draw = random.Random(seed)
    folder.mkdir(parents=True)
    plan: list[Kill] = []
    n_killed = 0
    while True:
        kill = None
        if n_killed < min(left, _MOST_KILLS_OF_A_CHAIN) and draw.random() < _SHARE_KILLED:
            kind = draw.choice(_KINDS)
            delay = draw.random() * (whole.seconds if kind == _KINDS[2] else _LONGEST_DELAY)
            kill = Kill(kind, 0 if kind == _KINDS[2] else draw.randint(1, whole.n_operations), delay)
            plan.append(kill)
        outcome = run_forked(scene.run, folder, kill)
        tally.starts += 1
        if outcome.code is not None:
            break
        if kill is None:
            tally.failures.append(f"{scene.name}, seed {seed}: takes more than {_LIMIT} s, in {folder}")
            return
        n_killed += 1
        tally.kills[f"{scene.name}: {kill.kind}"] += 1
        tally.places[f"{scene.name}: {_place(outcome.last)}"] += 1
    tally.chains[scene.name] += 1
    if outcome.code != 0:
        differing = [f"exit code {outcome.code}"]
    else:
        try:
            found = scene.read(folder)
            differing = [name for name in {**expected, **found} if expected.get(name) != found.get(name)]
        except (OSError, ValueError, LookupError) as error:
            differing = [repr(error)]
    if differing:
        tally.failures.append(f"{scene.name}, seed {seed}: {differing} differ after {plan}, in {folder}")
    else:
        shutil.rmtree(folder)
        folder.with_suffix(".log").unlink()


def _place(operation: str) -> str:
    """An operation without the numbers of its file, to count by."""
    event, _, path = operation.partition(" ")
    name = "".join("N" if letter.isdigit() else letter for letter in Path(path).name.replace(ENV, "ENV"))
    return f"{event} {name}"


def soak(n_kills: int, seed: int, folder: Path, scenes: Sequence[str] = ("train", "evaluate"), say: bool = True) -> Tally:
    """
    :param n_kills: Number of kills
    :param seed: Seed of all of them
    :param folder: An empty folder
    :param scenes: The commands
    :param say: Whether to print a line for each chain
    :return: What has happened
    """
    folder = folder.resolve()
    th.set_num_threads(1)
    experiment.register_algorithms()
    # What would be imported later; optimizers import half of torch, which takes seconds.
    for module in ("sb3_uav.training.imitation", "sb3_uav.evaluation.run", "sb3_uav.zoo.trust"):
        import_module(module)
    th.optim.Adam([th.nn.Parameter(th.zeros(1))])
    makers = {"train": training_scene, "evaluate": evaluation_scene}
    tally = Tally()
    prepared = []
    for scene in (makers[name](folder) for name in scenes):
        unbroken = folder / f"unbroken_{scene.name}"
        unbroken.mkdir()
        whole = run_forked(scene.run, unbroken)
        if whole.code != 0:
            raise RuntimeError(f"{scene.name} fails unbroken:\n{unbroken.with_suffix('.log').read_text(encoding='utf-8')}")
        prepared.append((scene, whole, scene.read(unbroken)))
        if say:
            print(f"{scene.name}, unbroken: {whole.n_operations} file operations, {whole.seconds:.1f} s", flush=True)
    number = 0
    while tally.n_kills < n_kills:
        # Trainings have more to lose than evaluations.
        scene, whole, expected = prepared[-1 if number % 3 == 0 else 0]
        number += 1
        before, n_failures = tally.n_kills, len(tally.failures)
        name = f"{seed}-{number}"
        play_chain(scene, whole, expected, folder / f"chain_{name}", name, n_kills - before, tally)
        if say:
            state = "differs" if len(tally.failures) > n_failures else "equal"
            print(f"chain {number}, {scene.name}: {tally.n_kills - before} kills, {state}; {tally.n_kills} in all", flush=True)
    return tally


def main() -> int:
    """:return: 1 if anything differed"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenes", nargs="+", choices=("train", "evaluate"), default=["train", "evaluate"])
    parser.add_argument("--out", type=Path, help="an empty folder (default: a temporary one)")
    arguments = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="soak_")) if arguments.out is None else arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    began, usage = time.perf_counter(), os.times()
    tally = soak(arguments.kills, arguments.seed, folder, arguments.scenes)
    now = os.times()
    cpu = sum(now[:4]) - sum(usage[:4])
    for title, counts in (("kills", tally.kills), ("chains", tally.chains), ("last file operations", tally.places)):
        print(f"{title}:", *(f"  {count:4} {name}" for name, count in sorted(counts.items())), sep="\n")
    print(f"{tally.n_kills} kills in {tally.starts} starts; {time.perf_counter() - began:.0f} s, {cpu:.0f} CPU seconds")
    print(f"{len(tally.failures)} of {sum(tally.chains.values())} chains differ from unbroken runs", *tally.failures, sep="\n")
    if not tally.failures and arguments.out is None:
        shutil.rmtree(folder)
    return bool(tally.failures)


if __name__ == "__main__":
    sys.exit(main())
