"""``python -m sb3_uav.zoo.demo``: the whole job on a small scenario in a few minutes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_uav.registration import DEMO_FLEET, DEMO_SIZE, allocation_id

# Far from every stream of the training, which starts from the seed that the user gives.
TEST_SEED = 20_000_003


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train a pair with all phases of the ITS, evaluate it beside simple heuristics, draw learning curves and a schedule.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code
    """
    parser = argparse.ArgumentParser(prog="sb3_uav.zoo.demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder of all results (default: %(default)s)")
    parser.add_argument("--env", default=allocation_id(DEMO_FLEET, DEMO_SIZE), help="default: %(default)s")
    parser.add_argument("--n-instances", type=int, default=200, help="test instances (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    args, train_args = parser.parse_known_args(argv)

    from sb3_uav.zoo import cli, train

    logs = args.out / "logs"
    code = train.main(
        ["--algo", "reinforce", "--env", args.env, "--log-folder", str(logs), "--seed", str(args.seed)]
        + ["--tensorboard-log", str(args.out / "tensorboard"), "--log-interval", "80", "--eval-freq", "500000"]
        + ["--eval-episodes", "50", *(["--progress"] if sys.stdout.isatty() else []), *train_args]
    )
    if code != 0:
        return code
    run = newest_run(logs / "reinforce", args.env)
    return evaluate_run(cli, run, args)


def newest_run(folder: Path, env_id: str) -> Path:
    """
    :param folder: rl_zoo3's folder of an algorithm
    :param env_id: Id of an environment
    :return: Its run with the highest number
    """
    runs = [path for path in folder.glob(f"{env_id}_*") if path.name.rpartition("_")[2].isdigit()]
    return max(runs, key=lambda path: int(path.name.rpartition("_")[2]))


def evaluate_run(cli, run: Path, args: argparse.Namespace) -> int:  # type: ignore[no-untyped-def]
    """Evaluate and draw what the training left in ``run``."""
    import gymnasium as gym

    from sb3_uav.envs import Instances, TaskAllocationEnv
    from sb3_uav.plots.learning_curves import plot_learning_curves
    from sb3_uav.plots.schedule_map import plot_best_and_worst_solver
    from sb3_uav.training.its import LOG_FILE

    environment = gym.make(args.env).unwrapped
    assert isinstance(environment, TaskAllocationEnv)
    instances: Instances = environment.problem.generator(args.n_instances, np.random.default_rng(TEST_SEED))
    test_set = args.out / "instances.npz"
    instances.save(test_set)

    results = args.out / "results"
    pair = ["--allocator", str(run / f"{args.env}.zip"), "--router", str(run / "router.zip")]
    code = cli.main(
        ["evaluate", *pair, "--instances", str(test_set), "--decode", "sampling", "--untrained", "--out", str(results)]
        + ["--solvers", "kmeans-nearest", "random-nearest", "--seed", str(args.seed)]
    )
    if code != 0:
        return code
    plot_learning_curves(run / LOG_FILE, args.out / "learning_curves.png")
    print(f"Learning curves: {args.out / 'learning_curves.png'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
