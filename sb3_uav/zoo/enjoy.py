"""``sb3-uav enjoy`` or ``python -m sb3_uav.zoo.enjoy``: rl_zoo3's replay, with the router trained beside the allocator."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.errors import main_function
from sb3_uav.zoo.dependencies import require_zoo

_PROG = "sb3-uav enjoy"


def enjoy(arguments: Sequence[str]) -> None:
    """
    Replay a trained agent; every flag of ``rl_zoo3.enjoy`` works.

    :param arguments: Command line arguments
    :raises ValueError: If there is no such agent, or another argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that replays need is not installed
    """
    require_zoo("Replaying a trained agent", "rl_zoo3.enjoy")
    from sb3_uav.zoo.experiment import make_batched_vec_env, register_algorithms
    from sb3_uav.zoo.rl_zoo3_compat import command_line, default_vec_env, replay_environment

    register_algorithms()
    import rl_zoo3.enjoy
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import create_test_env, get_model_path

    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="reinforce")
    parser.add_argument("--env", type=EnvironmentName, default="CartPole-v1")
    parser.add_argument("-f", "--folder", default="logs")
    parser.add_argument("--exp-id", default=0, type=int)
    parser.add_argument("--load-best", action="store_true")
    parser.add_argument("--load-checkpoint", type=int)
    parser.add_argument("--load-last-checkpoint", action="store_true")
    parser.add_argument("-h", "--help", action="store_true")
    known, _ = parser.parse_known_args(arguments)
    router, model = None, None
    try:
        if not known.help:
            which = (known.load_best, known.load_checkpoint, known.load_last_checkpoint)
            _, model, run_folder = get_model_path(known.exp_id, known.folder, known.algo, known.env, *which)
            router = _find_router(Path(run_folder), known.load_best)
            if router is not None and (known.load_checkpoint is not None or known.load_last_checkpoint):
                print("Checkpoints of the zoo hold no router: rewards come from the run's last one.")
        make_env = partial(_create_test_env, create_test_env, model, router)
        flags = ["--algo", known.algo, "-f", known.folder, *arguments]
        with default_vec_env(make_batched_vec_env), replay_environment(make_env), command_line(_PROG, flags):
            rl_zoo3.enjoy.enjoy()
    except AssertionError as error:
        # rl_zoo3 raises it for a missing folder.
        raise ValueError(str(error)) from error


def _find_router(run_folder: Path, best: bool) -> Path | None:
    """
    :param run_folder: Folder of the allocator's zip
    :param best: Whether to return the router of the best allocator
    :return: The router's zip, if the run has one
    """
    from sb3_uav.training.best_pair import find_best_router

    best_router = find_best_router(run_folder) if best else None
    router = run_folder / "router.zip"
    return best_router or (router if router.is_file() else None)


def _create_test_env(create_test_env: Any, model: str | None, router: Path | None, env_id: str, **kwargs: Any) -> Any:
    """``rl_zoo3.utils.create_test_env``, passing the router and the allocator's order of tasks to the environment."""
    from sb3_uav.policies import AllocatorPolicy, RouterPolicy
    from sb3_uav.policies.loading import load_policy

    env = create_test_env(env_id, **kwargs)
    if model is not None and env.has_attr("set_task_order"):
        # Stock policies define no order.
        with suppress(ValueError):
            env.env_method("set_task_order", load_policy(model, "cpu", AllocatorPolicy).env_order)
    if router is not None and env.has_attr("set_router"):
        env.env_method("set_router", load_policy(router, expected=RouterPolicy).plan)
        print(f"Rewards come from the router {router}")
    return env


# For ``python -m sb3_uav.zoo.enjoy``, with exit codes in place of exceptions.
main = main_function(_PROG, enjoy)

if __name__ == "__main__":
    sys.exit(main())
