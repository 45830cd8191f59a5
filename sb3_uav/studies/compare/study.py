"""``sb3-uav compare``: trains algorithms at an equal budget and reports how they do at equal steps and at equal time."""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.random_streams import SHARED_SEED

if TYPE_CHECKING:
    from sb3_uav.studies.compare.runs import Training
    from sb3_uav.studies.compare.variants import Variant

SETTINGS_FILE = "settings.json"
VALIDATION_FILE = "validation.npz"
ROUTER_FILE = "router.zip"
N_EVALUATIONS = 20


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav compare",
        description="Train PPO, MaskablePPO and REINFORCE from their YAMLs at an equal budget of environment steps, evaluate "
        "all on one validation set along the way, and write evaluations.csv, comparison.png, comparison.pdf and report.md. "
        "Run it again with the same --out to go on: finished runs are kept, interrupted ones start again.",
    )
    parser.add_argument("--env", required=True, help="id of an environment of sb3_uav")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of everything that is written")
    parser.add_argument(
        "-n", "--n-timesteps", type=int, default=1_000_000, help="environment steps of each run, default: %(default)s"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: 0 1 2")
    parser.add_argument(
        "--variants",
        type=Path,
        metavar="YML",
        help="what to compare instead: a mapping from names to {algo: NAME, KEY: VALUE, ...}, whose keys replace those of the "
        "environment's entry in zoo_configs/NAME.yml (or in conf_file: PATH); null removes one",
    )
    parser.add_argument(
        "--router",
        type=Path,
        metavar="ZIP",
        help="TaskAllocation only: the router of all rewards; one is trained if not given",
    )
    parser.add_argument(
        "--router-subsets",
        type=int,
        default=100_000,
        help="on how many subsets to train the router if none is given, default: %(default)s",
    )
    parser.add_argument(
        "--its", action="store_true", help="leave ITSCallback in the YAML entries: every run trains a router of its own"
    )
    parser.add_argument("--instances", type=Path, metavar="NPZ", help="validation set; drawn once if not given")
    parser.add_argument("--n-instances", type=int, default=256, help="size of a drawn validation set, default: %(default)s")
    parser.add_argument("--samples", type=int, default=16, help="samples per instance, 0 for none, default: %(default)s")
    parser.add_argument("--eval-freq", type=int, help="environment steps between evaluations, default: a 20th of the budget")
    parser.add_argument("--jobs", type=int, default=1, help="trainings side by side, default: %(default)s")
    parser.add_argument("--num-threads", type=int, default=1, help="threads of each training, default: %(default)s")
    parser.add_argument("--device", default="cpu", help="default: %(default)s")
    parser.add_argument("--report-only", action="store_true", help="train nothing; report on the runs that are finished")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train and compare.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(arguments)
    try:
        compare(args, arguments)
    except (ValueError, OSError, ImportError) as error:
        print(f"sb3-uav compare: {error}", file=sys.stderr)
        return 2
    return 0


def compare(args: argparse.Namespace, arguments: Sequence[str]) -> None:
    """
    :param args: Of the command
    :param arguments: The same as text, for the report
    :raises ValueError: If an argument is not allowed, or a training fails
    """
    from sb3_uav.envs.allocation import AllocationProblem
    from sb3_uav.envs.render import require_matplotlib
    from sb3_uav.studies.compare.runs import run_trainings
    from sb3_uav.studies.compare.variants import read_variants

    # What may be missing or wrong is found before the long run, not after it.
    require_matplotlib()
    for name, least in (
        ("n_timesteps", 1),
        ("n_instances", 1),
        ("samples", 0),
        ("router_subsets", 1),
        ("jobs", 1),
        ("num_threads", 1),
    ):
        if getattr(args, name) < least:
            raise ValueError(f"--{name.replace('_', '-')} is {getattr(args, name)}; it must be at least {least}.")
    if args.eval_freq is None:
        args.eval_freq = max(args.n_timesteps // N_EVALUATIONS, 1)
    if args.eval_freq < 1:
        raise ValueError(f"--eval-freq is {args.eval_freq}; it must be at least 1.")
    if len(set(args.seeds)) < len(args.seeds) or min(args.seeds) < 0:
        raise ValueError(f"--seeds are {args.seeds}; give different numbers of at least 0.")
    problem = make_problem(args.env)
    variants = read_variants(args.variants, args.env)
    needs_router = isinstance(problem, AllocationProblem) and not args.its
    if args.router is not None and not needs_router:
        raise ValueError("--router is for TaskAllocation environments without --its; leave it out.")

    args.out.mkdir(parents=True, exist_ok=True)
    make_validation_set(args, problem)
    if needs_router:
        make_router(args, problem)
    check_settings(args, needs_router)
    trainings = plan_trainings([complete(variant, args, needs_router) for variant in variants], args)
    if not args.report_only:
        run_trainings([training for training in trainings if not training.is_finished], args.jobs)
    report(args, arguments, [training for training in trainings if training.is_finished])


def make_problem(env_id: str) -> Any:
    """
    :param env_id: Id of an environment
    :return: The problem behind it
    :raises ValueError: If it is not one of ours
    """
    import gymnasium as gym

    from sb3_uav.envs.gym_env import ProblemEnv

    if env_id not in gym.registry:
        near = [name for name in gym.registry if name.startswith(env_id.split("-")[0])]
        raise ValueError(f"--env {env_id}: there is no such environment; those of sb3_uav of this kind are {near}.")
    environment = gym.make(env_id).unwrapped
    if not isinstance(environment, ProblemEnv):
        raise ValueError(f"--env {env_id}: is not an environment of sb3_uav.")
    return environment.problem


def complete(variant: Variant, args: argparse.Namespace, needs_router: bool) -> Variant:
    """
    Give an entry the common budget, evaluation and router.

    :param variant: As its YAML has it
    :param args: Of the command
    :param needs_router: Whether the common router gives the rewards
    :return: What is trained
    """
    from sb3_uav.studies.compare.variants import callback_name, callbacks_of

    replaced = {"FixedSetEvalCallback", "PretrainedRouterCallback"} | (set() if args.its else {"ITSCallback"})
    callbacks = [callback for callback in callbacks_of(variant.entry) if callback_name(callback) not in replaced]
    if needs_router:
        callbacks.append({"sb3_uav.training.PretrainedRouterCallback": {"router": str(args.out / ROUTER_FILE)}})
    evaluation = {
        "instances": str(args.out / VALIDATION_FILE),
        "n_samples": args.samples,
        "eval_freq": args.eval_freq,
        "seed": SHARED_SEED,
    }
    callbacks.append({"sb3_uav.training.FixedSetEvalCallback": evaluation})
    return variant._replace(entry={**variant.entry, "n_timesteps": args.n_timesteps, "callback": callbacks})


def make_validation_set(args: argparse.Namespace, problem: Any) -> None:
    """
    Put the validation set into the folder, unless it is there.

    :param args: Of the command
    :param problem: Whose instances to draw
    """
    from sb3_uav.envs import Instances
    from sb3_uav.training.fixed_set import draw_fixed_set, fingerprint

    path = args.out / VALIDATION_FILE
    if args.instances is not None:
        instances = Instances.load(args.instances)
    else:
        instances = draw_fixed_set(problem, args.n_instances, SHARED_SEED)
    if not path.is_file():
        instances.save(path)
    elif fingerprint(Instances.load(path), args.samples) != fingerprint(instances, args.samples):
        raise ValueError(f"{path} holds another validation set; choose another --out, or the validation set of before.")


def make_router(args: argparse.Namespace, problem: Any) -> None:
    """
    Put the router of all rewards into the folder, unless it is there; train it if none is given.

    :param args: Of the command
    :param problem: The allocation problem
    """
    from sb3_uav.common.files import write_atomically
    from sb3_uav.policies import RouterPolicy
    from sb3_uav.policies.loading import load_policy
    from sb3_uav.studies.compare.fixed_router import pretrain_router
    from sb3_uav.studies.compare.variants import router_settings

    path = args.out / ROUTER_FILE
    note = path.with_suffix(".txt")
    if args.router is not None:
        load_policy(args.router, "cpu", RouterPolicy)
        if path.is_file() and path.read_bytes() != args.router.read_bytes():
            raise ValueError(f"{path} is another router than {args.router}; choose another --out, or the --router of before.")
        write_atomically(path, args.router.read_bytes())
        write_atomically(note, f"{args.router.name}, given by --router")
        return
    if path.is_file() and note.is_file():
        load_policy(path, "cpu", RouterPolicy)
        return
    import torch as th

    print(f"Training the router on {args.router_subsets:,} subsets ...", flush=True)
    th.set_num_threads(args.num_threads)
    settings = router_settings(args.env)
    done = pretrain_router(problem.generator, settings, args.router_subsets, path, SHARED_SEED, args.device)
    write_atomically(note, done)


def check_settings(args: argparse.Namespace, needs_router: bool) -> None:
    """
    Make sure that all runs in the folder are trained and evaluated alike.

    :param args: Of the command
    :param needs_router: Whether the common router gives the rewards
    :raises ValueError: If earlier runs were not
    """
    from sb3_uav.common.files import write_atomically

    settings = {
        "env": args.env,
        "n_timesteps": args.n_timesteps,
        "eval_freq": args.eval_freq,
        "samples": args.samples,
        "its": args.its,
        "num_threads": args.num_threads,
        "device": args.device,
        "router": hashlib.sha256((args.out / ROUTER_FILE).read_bytes()).hexdigest() if needs_router else None,
    }
    path = args.out / SETTINGS_FILE
    # A folder without runs binds nobody.
    if path.is_file() and any((args.out / "runs").glob("*/seed_*")):
        for key, before in json.loads(path.read_text()).items():
            if settings[key] != before:
                raise ValueError(
                    f"{path}: {key} was {before} in earlier runs and is {settings[key]} now; choose another --out."
                )
    write_atomically(path, json.dumps(settings, indent=1))


def plan_trainings(variants: Sequence[Variant], args: argparse.Namespace) -> list[Training]:
    """
    Write the YAML of every variant.

    :param variants: What is compared
    :param args: Of the command
    :return: All runs, seed by seed, so that an unfinished comparison is balanced
    :raises ValueError: If finished runs had other settings
    """
    import yaml

    from sb3_uav.common.files import write_atomically
    from sb3_uav.studies.compare.runs import FINISHED_FILE, Training

    trainings = []
    for variant in variants:
        config = args.out / "configs" / f"{variant.folder}.yml"
        folder = args.out / "runs" / variant.folder
        text = yaml.safe_dump({args.env: variant.entry}, sort_keys=False)
        if config.is_file() and config.read_text() != text and any(folder.glob(f"*/{FINISHED_FILE}")):
            raise ValueError(f"{config}: {variant.name!r} had other settings in earlier runs; choose another --out or name.")
        write_atomically(config, text)
        for seed in args.seeds:
            trainings.append(
                Training(
                    name=variant.name,
                    algo=variant.algo,
                    env_id=args.env,
                    seed=seed,
                    n_timesteps=args.n_timesteps,
                    config=config,
                    folder=folder / f"seed_{seed}",
                    n_threads=args.num_threads,
                    device=args.device,
                )
            )
    return sorted(trainings, key=lambda training: args.seeds.index(training.seed))


def report(args: argparse.Namespace, arguments: Sequence[str], finished: Sequence[Training]) -> None:
    """
    :param args: Of the command
    :param arguments: The same as text
    :param finished: The runs to report on
    :raises ValueError: If there are none
    """
    from sb3_uav.envs import Instances
    from sb3_uav.studies.compare.report import CSV_FILE, FIGURE_FILES, REPORT_FILE, Run, machine, versions, write_results

    if not finished:
        raise ValueError(f"{args.out}: no run is finished yet; run without --report-only.")
    # In the order of the variants, not of the seeds.
    finished = sorted(finished, key=lambda training: list(dict.fromkeys(t.name for t in finished)).index(training.name))
    runs = [Run(training.name, training.algo, training.seed, training.history) for training in finished]
    validation = Instances.load(args.out / VALIDATION_FILE)
    decoding = f"greedily and as the best of {args.samples} samples" if args.samples > 0 else "greedily"
    source = f"`{args.instances.name}`" if args.instances is not None else "drawn by random numbers that no training uses"
    evaluated = f"{len(validation)} instances ({source}), the same for all, decoded {decoding}, every {args.eval_freq:,} steps"
    notes = [
        f"Environment: `{args.env}`; each run learns from {args.n_timesteps:,} environment steps, and ends with its rollout.",
        f"Runs: {len(runs)}, seeds {', '.join(map(str, sorted({run.seed for run in runs})))}.",
        f"Validation: {evaluated}.",
    ]
    if (args.out / ROUTER_FILE).is_file():
        text = (args.out / ROUTER_FILE).with_suffix(".txt").read_text()
        notes.append(f"Router: the same one for all rewards, which never learns during the runs: {text}.")
    elif args.its:
        notes.append(
            "Router: each run trains its own by ITS, so rewards differ; its episodes take time but are no steps here."
        )
    notes += [f"Machine: {machine(args.num_threads, args.jobs, args.device)}.", f"Versions: {versions()}."]

    def shown(words: Sequence[str]) -> str:
        # The name of the folder, so that the report does not say where it lay.
        return shlex.join(words).replace(str(args.out), args.out.name)

    commands = {"The whole comparison": shown(["sb3-uav", "compare", *arguments])}
    for training in finished:
        what = f"{training.name} (settings: `configs/{training.config.name}`), one of the seeds"
        commands.setdefault(what, shown(["python", *training.flags]))
    title = f"Comparison of algorithms on {args.env}"
    write_results(runs, args.out, title, args.n_timesteps, args.samples, notes, commands)
    for name in (CSV_FILE, *FIGURE_FILES, REPORT_FILE):
        print(args.out / name)


if __name__ == "__main__":
    sys.exit(main())
