"""
``sb3-uav push-to-hub`` or ``python -m sb3_uav.zoo.push_to_hub``: a trained agent with its router to the Hugging Face Hub.

The repository has the files of rl_zoo3's command of this name, and ``router.zip``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from copy import deepcopy
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sb3_uav
from sb3_uav.common.errors import main_function
from sb3_uav.common.optional import require
from sb3_uav.common.random_streams import TEST_SEED
from sb3_uav.zoo.dependencies import require_zoo
from sb3_uav.zoo.trust import TRUST_FLAG, reading

if TYPE_CHECKING:
    from sb3_uav.zoo.model_card import Results
    from sb3_uav.zoo.replay import Agent

_PROG = "sb3-uav push-to-hub"
METRICS_FILE, METRICS_PATTERNS = "train_eval_metrics.zip", ("*.monitor.csv", "evaluations*.npz", "its_log.csv")
VEC_NORMALIZE_FILE = "vec_normalize.pkl"


def _make_parser(parent: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_PROG,
        parents=[parent],
        description="Evaluate a trained agent, write a model card, and push both to the Hugging Face Hub, for an allocator "
        "together with its router. Log in with `hf auth login` first.",
    )
    parser.add_argument("-orga", "--organization", required=True, metavar="NAME", help="owner of the repository")
    parser.add_argument("-name", "--repo-name", metavar="NAME", help="name of the repository (default: ALGO-ENV)")
    parser.add_argument("-m", "--commit-message", default="Initial commit", help="default: %(default)s")
    parser.add_argument("--local-dir", type=Path, metavar="DIR", help="write the repository here, and push nothing")
    parser.add_argument("--n-eval-episodes", type=int, default=100, metavar="N", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=TEST_SEED, help="of the evaluation (default: %(default)s)")
    parser.add_argument("--stochastic", action="store_true", help="sample actions in the evaluation")
    parser.add_argument("--no-render", action="store_true", help="record no video")
    parser.add_argument("-n", "--n-timesteps", type=int, help="steps of the video (default: one episode)")
    parser.add_argument("--device", default="auto", help="default: %(default)s")
    parser.add_argument("--trust", action="store_true", help=TRUST_FLAG[1])
    return parser


def push_to_hub(arguments: Sequence[str]) -> None:
    """
    Push an agent.

    :param arguments: Command line arguments
    :raises ValueError: If there is no such agent, or another argument is wrong
    :raises OSError: If a file cannot be read or written, or the Hub cannot be reached
    :raises ImportError: If a package that this needs is not installed
    """
    require_zoo("Pushing to the Hugging Face Hub", "rl_zoo3.enjoy", "huggingface_hub")
    from sb3_uav.zoo.experiment import register_algorithms
    from sb3_uav.zoo.hub import repository_id, upload
    from sb3_uav.zoo.replay import agent_parser, find_agent

    register_algorithms()
    args = _make_parser(agent_parser(with_help=False)).parse_args(arguments)
    if args.n_eval_episodes < 1:
        raise ValueError(f"--n-eval-episodes is {args.n_eval_episodes}; it must be at least 1.")
    if not args.no_render:
        require("moviepy", "Recording a video (leave it out with --no-render)", "video")
    if args.local_dir is not None and args.local_dir.exists() and any(args.local_dir.iterdir()):
        raise ValueError(f"--local-dir {args.local_dir}: is not empty; choose another folder.")
    repo_id = repository_id(args.organization, args.repo_name, args.algo, args.env)
    agent = find_agent(args, args.trust)
    with reading(args.trust, agent.run_folder), tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "repository"
        _write_repository(folder, agent, args)
        if args.local_dir is not None:
            shutil.copytree(folder, args.local_dir, dirs_exist_ok=True)
            print(f"Written to {args.local_dir}; nothing was pushed.")
        else:
            print(f"Pushed to {upload(repo_id, folder, args.commit_message)}")


def _write_repository(folder: Path, agent: Agent, args: argparse.Namespace) -> None:
    """
    :param folder: Where to write it; it does not exist yet
    :param agent: What to push
    :param args: Arguments of the command
    """
    import yaml
    from huggingface_sb3 import EnvironmentName, ModelName
    from rl_zoo3 import ALGOS

    from sb3_uav.zoo.model_card import Card
    from sb3_uav.zoo.record_video import record_video
    from sb3_uav.zoo.saved import saved_env_kwargs

    folder.mkdir(parents=True)
    env_name = EnvironmentName(args.env)
    settings = agent.run_folder / env_name
    model_file = ModelName(args.algo, env_name).filename
    shutil.copy(agent.model, folder / model_file)
    if agent.router is not None:
        shutil.copy(agent.router, folder / "router.zip")
    for name in ("config.yml", "args.yml"):
        shutil.copy(settings / name, folder / name)
    if (settings / "vecnormalize.pkl").is_file():
        shutil.copy(settings / "vecnormalize.pkl", folder / VEC_NORMALIZE_FILE)
    env_kwargs = saved_env_kwargs(agent.run_folder, env_name)
    (folder / "env_kwargs.yml").write_text(yaml.safe_dump(env_kwargs), encoding="utf-8")
    with zipfile.ZipFile(folder / METRICS_FILE, "w") as archive:
        for pattern in METRICS_PATTERNS:
            for path in sorted(agent.run_folder.glob(pattern)):
                archive.write(path, arcname=path.name)
    results, hyperparams, n_timesteps = _evaluate(agent, args, env_kwargs)
    about = {**results._asdict(), "eval_datetime": datetime.now(timezone.utc).isoformat(timespec="seconds")}
    (folder / "results.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    if not args.no_render:
        videos = folder.parent / "videos"
        record_video([*_chosen(args), "-o", str(videos)])
        shutil.move(next(videos.glob("*.mp4")), folder / "replay.mp4")
    card = Card(
        args.algo,
        ALGOS[args.algo].__name__,
        args.env,
        env_kwargs,
        args.organization,
        args.repo_name,
        model_file,
        agent.router is not None,
        not args.no_render,
        hyperparams,
        n_timesteps,
        results,
        sb3_uav.__version__,
    )
    (folder / "README.md").write_text(card.text(), encoding="utf-8")


def _chosen(args: argparse.Namespace) -> list[str]:
    """:return: The arguments that choose the agent of the video"""
    flags = ["--algo", args.algo, "--env", args.env, "-f", args.folder, "--exp-id", str(args.exp_id), "--no-render"]
    flags += [flag for flag, given in (("--load-best", args.load_best), ("--trust", args.trust)) if given]
    flags += ["--load-last-checkpoint"] if args.load_last_checkpoint else []
    flags += [] if args.load_checkpoint is None else ["--load-checkpoint", str(args.load_checkpoint)]
    flags += ["--gym-packages", *args.gym_packages] if args.gym_packages else []
    return flags + ([] if args.n_timesteps is None else ["-n", str(args.n_timesteps)])


def _evaluate(agent: Agent, args: argparse.Namespace, env_kwargs: dict[str, Any]) -> tuple[Results, dict[str, Any], int]:
    """
    :param agent: What to evaluate
    :param args: Arguments of the command
    :param env_kwargs: Arguments of the environment
    :return: The results, and the hyperparameters and number of steps of the training
    """
    import numpy as np
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import get_saved_hyperparams
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.utils import set_random_seed

    from sb3_uav.zoo.model_card import Results
    from sb3_uav.zoo.replay import environment_of, load_model

    set_random_seed(args.seed)
    hyperparams, stats_path = get_saved_hyperparams(str(agent.run_folder / EnvironmentName(args.env)), test_mode=True)
    given = dict(n_envs=1, stats_path=stats_path, seed=args.seed, should_render=False, hyperparams=deepcopy(hyperparams))
    env = environment_of(agent)(args.env, **given, env_kwargs=env_kwargs)
    model = load_model(args.algo, agent.model, args.device)
    successes: list[bool] = []

    def note_success(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(local["info"]["is_success"])

    returns: Any = evaluate_policy(
        model, env, args.n_eval_episodes, not args.stochastic, callback=note_success, return_episode_rewards=True
    )[0]
    env.close()
    rate = float(np.mean(successes)) if successes else None
    results = Results(float(np.mean(returns)), float(np.std(returns)), rate, len(returns), not args.stochastic, args.seed)
    unsaved = ("normalize_kwargs",) if hyperparams.get("normalize") else ("normalize",)
    return results, {key: value for key, value in hyperparams.items() if key not in unsaved}, model.num_timesteps


# For ``python -m sb3_uav.zoo.push_to_hub``, with exit codes in place of exceptions.
main = main_function(_PROG, push_to_hub)

if __name__ == "__main__":
    sys.exit(main())
