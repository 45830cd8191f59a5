"""
What is bit-equal and what is not: the same training and the same solving, done in two ways, and how far the results differ.

    python benchmarks/determinism.py --out docs/determinism.md

writes the page. Each row is measured; a row that is promised to be bit-equal and is not ends the command with 1, as does one
that differs by more than its tolerance. ``--tiny`` is for the tests.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, Schedule, TaskAllocationEnv, UniformGenerator
from sb3_uav.evaluation import evaluate
from sb3_uav.evaluation.merge import merge
from sb3_uav.evaluation.results import read_results
from sb3_uav.evaluation.shard import Shard
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import pair_files
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import make_solver

_NOT_MEASURED = "not measured here"
_NETWORK: dict[str, Any] = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
# In a process of its own, with or without numba.
_WITHOUT = """
import sys
if sys.argv[2] == "without":
    sys.modules["numba"] = None
import numpy as np
from sb3_uav.envs import UniformGenerator
from sb3_uav.solvers import make_solver
instances = UniformGenerator(int(sys.argv[1]), 3)(4, np.random.default_rng(5))
for spec in ("dl-drl", "greedy-insertion", "kmeans-nearest"):
    solver = make_solver(spec, device="cpu", batch_size=4)
    print([result.schedule.routes for result in solver.solve(instances, None, 0)])
"""


@dataclass(frozen=True)
class Row:
    """
    One line of the table.

    :param kind: ``"solving"`` or ``"training"``
    :param what: The two ways
    :param compare: Does it both ways, given the size, and says how far the results differ
    :param promised: Whether they are bit-equal
    :param tolerance: How far they may differ if not: relative to the largest number, or as a share of schedules
    """

    kind: str
    what: str
    compare: Callable[[int], Difference | None]
    promised: bool
    tolerance: float = 0.0


@dataclass(frozen=True)
class Difference:
    """
    :param text: What differs, and how far
    :param size: 0 if nothing does
    """

    text: str
    size: float


def _parameters(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> Difference:
    """How far two sets of parameters are apart, relative to the largest."""
    if all(th.equal(value, other[name]) for name, value in one.items()):
        return Difference("bit-equal", 0.0)
    apart = max(float((value.double() - other[name].double()).abs().max()) for name, value in one.items())
    size = apart / max(float(value.double().abs().max()) for value in one.values())
    return Difference(f"parameters differ by {size:.1e}", size)


def _routes(one: Sequence[Schedule], other: Sequence[Schedule]) -> Difference:
    """On how many instances two lists of schedules differ."""
    n_apart = sum(a.routes != b.routes for a, b in zip(one, other, strict=True))
    if n_apart == 0:
        return Difference("the same routes", 0.0)
    value = [sum(len(route) for schedule in schedules for route in schedule.routes) for schedules in (one, other)]
    text = f"other routes in {n_apart} of {len(one)}, objective {100 * (value[1] / value[0] - 1):+.2f} %"
    return Difference(text, n_apart / len(one))


@contextmanager
def _threads(n: int) -> Any:
    before = th.get_num_threads()
    th.set_num_threads(n)
    try:
        yield
    finally:
        th.set_num_threads(before)


def _instances(size: int) -> Instances:
    return UniformGenerator(size, 3)(8, np.random.default_rng(5))


def _solved(size: int, spec: str = "dl-drl", batch_size: int = 8, n_threads: int = 1, device: str = "cpu") -> list[Schedule]:
    with _threads(n_threads):
        results = make_solver(spec, device=device, batch_size=batch_size).solve(_instances(size), None, 0)
    return [result.schedule for result in results if result.schedule is not None]


def _solve_twice(spec: str, **other: Any) -> Callable[[int], Difference]:
    return lambda size: _routes(_solved(size, spec), _solved(size, spec, **other))


def _log_probs(size: int, batch_size: int, n_threads: int, device: str = "cpu") -> dict[str, th.Tensor]:
    """Log-probabilities of the same allocations, of a policy with fixed weights."""
    instances = _instances(size).to(device)
    actions = th.from_numpy(np.random.default_rng(0).integers(3, size=(8, 2, size))).to(device)
    policy = load_policy(pair_files(None, None)[0], device, AllocatorPolicy)
    with _threads(n_threads), th.no_grad():
        parts = [
            policy.evaluate_episodes(policy.arrange(instances[rows : rows + batch_size]), actions[rows : rows + batch_size])
            for rows in range(0, 8, batch_size)
        ]
    return {"log_prob": th.cat([part.log_prob for part in parts]).cpu()}


def _log_probs_differ(size: int, batch_size: int = 8, n_threads: int = 1) -> Difference:
    found = _parameters(_log_probs(size, 8, 1), _log_probs(size, batch_size, n_threads))
    return Difference(found.text.replace("parameters", "log-probabilities"), found.size)


def _on_gpu(row: Callable[[], Difference]) -> Difference | None:
    return row() if th.cuda.is_available() else None


def _evaluated(size: int, run: Callable[[Path, Instances], Any]) -> list[tuple[Any, ...]]:
    """What an evaluation leaves of each instance, without times."""
    with tempfile.TemporaryDirectory() as folder:
        run(Path(folder), _instances(size))
        return [(row.solver, row.instance, row.objective, row.length) for row in read_results(Path(folder) / "results.csv")]


def _evaluations(size: int, other: Callable[[Path, Instances], Any]) -> Difference:
    rows = [_evaluated(size, run) for run in (_whole, other)]
    return Difference("the same rows", 0.0) if rows[0] == rows[1] else Difference("other rows", 1.0)


def _solvers() -> list[Any]:
    return [make_solver("greedy-insertion"), make_solver("kmeans-nearest"), make_solver("dl-drl", device="cpu", batch_size=1)]


def _whole(folder: Path, instances: Instances, **how: Any) -> None:
    evaluate(_solvers(), instances, folder, **how)


def _resumed(folder: Path, instances: Instances) -> None:
    _whole(folder, instances)
    results = folder / "results.csv"
    # As after a kill: half of the rows are there.
    lines = results.read_text(encoding="utf-8").splitlines(keepends=True)
    results.write_text("".join(lines[: len(lines) // 2]), encoding="utf-8")
    _whole(folder, instances, resume=True)


def _sharded(folder: Path, instances: Instances) -> None:
    for number in (1, 2):
        _whole(folder / str(number), instances, shard=Shard(number, 2))
    merge([folder / "1", folder / "2"], folder, overwrite=True)


def _with_and_without_numba(size: int) -> Difference | None:
    """Solvers that need the compiled kernels say so without numba; the others do not use them."""
    if find_spec("numba") is None:
        return None
    found = [
        subprocess.run([sys.executable, "-c", _WITHOUT, str(size), how], check=True, capture_output=True).stdout
        for how in ("with", "without")
    ]
    return Difference("the same routes", 0.0) if found[0] == found[1] and found[0] else Difference("other routes", 1.0)


def _trained(
    size: int, n_threads: int = 1, device: str = "cpu", stop_at: int | None = None, **settings: Any
) -> dict[str, Any]:
    """Parameters of an allocator after four epochs of REINFORCE; with ``stop_at``, saved then and loaded again."""

    def env() -> Any:
        return BatchedVecEnv([lambda: TaskAllocationEnv(size, 2, max_distance=1.5)] * 8)

    with _threads(n_threads), tempfile.TemporaryDirectory() as folder:
        how: dict[str, Any] = dict(
            n_samples=4, baseline="shared", instances_per_epoch=8, learning_rate=1e-3, policy_kwargs=_NETWORK
        )
        model = REINFORCE(AllocatorPolicy, env(), **how, seed=0, device=device, **settings)
        n_steps = 4 * 8 * size * 4
        model.learn(stop_at or n_steps)
        if stop_at is not None:
            model.save(Path(folder) / "a.zip")
            model = REINFORCE.load(Path(folder) / "a.zip", env=env(), device=device)
            model.learn(n_steps - model.num_timesteps, reset_num_timesteps=False)
    return {name: value.cpu() for name, value in model.policy.state_dict().items()}


def _train_twice(**other: Any) -> Callable[[int], Difference]:
    return lambda size: _parameters(_trained(size), _trained(size, **other))


def _resumed_training(size: int) -> Difference:
    return _parameters(_trained(size), _trained(size, stop_at=2 * 8 * size * 4))


def _ppo(size: int, level: str, use_cache: bool) -> dict[str, th.Tensor]:
    kinds: dict[str, Any] = {
        "allocator": (AllocatorPolicy, lambda: TaskAllocationEnv(size, 2, max_distance=1.5)),
        "router": (RouterPolicy, lambda: RoutePlanningEnv(size, max_distance=1.5)),
    }
    policy, make_env = kinds[level]
    env = BatchedVecEnv([make_env] * 6)
    env.seed(0)
    model = PPO(policy, env, n_steps=size, batch_size=size * 3, n_epochs=2, seed=1, policy_kwargs=_NETWORK, device="cpu")
    extractor: Any = model.policy.features_extractor
    extractor.use_cache = use_cache
    with _threads(1):
        model.learn(size * 6 * 2)
    return model.policy.state_dict()


def _cached(level: str) -> Callable[[int], Difference]:
    return lambda size: _parameters(_ppo(size, level, False), _ppo(size, level, True))


ROWS = [
    Row("solving", "twice, greedy", _solve_twice("dl-drl"), True),
    Row("solving", "twice, 16 samples", _solve_twice("dl-drl:decode=sampling,samples=16"), True),
    Row("solving", "batch of 8 / of 1: log-probabilities", lambda size: _log_probs_differ(size, batch_size=1), False, 1e-3),
    Row("solving", "batch of 8 / of 1: routes", _solve_twice("dl-drl", batch_size=1), False, 0.5),
    Row("solving", "1 thread / 2 threads: log-probabilities", lambda size: _log_probs_differ(size, n_threads=2), False, 1e-3),
    Row("solving", "1 thread / 2 threads: routes", _solve_twice("dl-drl", n_threads=2), False, 0.5),
    Row("solving", "CPU / GPU: routes", lambda n: _on_gpu(lambda: _solve_twice("dl-drl", device="cuda")(n)), False, 0.5),
    Row("solving", "one process / `--jobs 2`", lambda n: _evaluations(n, lambda *a: _whole(*a, n_jobs=2)), True),
    Row("solving", "unbroken / resumed `evaluate`", lambda n: _evaluations(n, _resumed), True),
    Row("solving", "whole / two `--shard`s and `merge`, `--batch-size 1`", lambda n: _evaluations(n, _sharded), True),
    Row("solving", "with numba / without it, solvers that do not need it", _with_and_without_numba, True),
    Row("training", "REINFORCE twice", _train_twice(), True),
    Row("training", "REINFORCE unbroken / saved and loaded", _resumed_training, True),
    Row("training", "REINFORCE, 1 thread / 2 threads", _train_twice(n_threads=2), False, 1e-2),
    Row("training", "REINFORCE, whole batch / `micro_batch_size` 2", _train_twice(micro_batch_size=2), False, 1e-2),
    Row("training", "REINFORCE, CPU / GPU", lambda n: _on_gpu(lambda: _train_twice(device="cuda")(n)), False, 1e-1),
    Row("training", "PPO, allocator: encoded each step / once", _cached("allocator"), True),
    Row("training", "PPO, router: encoded each step / once", _cached("router"), False, 1e-2),
]  # fmt: skip


def kept(row: Row, found: Difference | None) -> bool:
    """
    :param row: A row
    :param found: What was measured, None if it cannot be here
    :return: Whether what the row promises holds
    """
    return found is None or found.size <= (0.0 if row.promised else row.tolerance)


def table(found: Sequence[tuple[Row, Difference | None]]) -> str:
    """:return: The rows in Markdown"""
    lines = ["| | the same, done in two ways | promised | measured |", "| --- | --- | --- | --- |"]
    for row, difference in found:
        limit = "bit-equal" if row.promised else f"within {row.tolerance:g}"
        lines.append(f"| {row.kind} | {row.what} | {limit} | {_NOT_MEASURED if difference is None else difference.text} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: Those of the command line when None
    :return: Exit code
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="the page to write; the figures are printed in any case")
    parser.add_argument("--size", type=int, default=30, help="number of tasks (default: %(default)s)")
    parser.add_argument("--tiny", action="store_true", help="8 tasks")
    args = parser.parse_args(arguments)
    size = 8 if args.tiny else args.size
    found = []
    for row in ROWS:
        found.append((row, row.compare(size)))
        print(row.kind, row.what, "-", _NOT_MEASURED if found[-1][1] is None else found[-1][1].text, flush=True)
    broken = [row.what for row, difference in found if not kept(row, difference)]
    if broken:
        print(f"not as promised: {', '.join(broken)}", file=sys.stderr)
    if args.out is not None:
        template = Path(__file__).with_name("_determinism.md").read_text(encoding="utf-8")
        about = f"Torch {th.__version__}, numpy {np.__version__}, {os.cpu_count()} cores, {size} tasks"
        args.out.write_text(template.replace("TABLE", table(found)).replace("ABOUT", about), encoding="utf-8")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
