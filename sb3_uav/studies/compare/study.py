"""Trains algorithms at an equal budget and reports how they do at equal steps and at equal time."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import yaml

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_streams import SHARED_SEED
from sb3_uav.envs import Instances
from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.studies.compare.common_ground import (
    ROUTER_FILE,
    VALIDATION_FILE,
    check_settings,
    make_problem,
    make_router,
    make_validation_set,
)
from sb3_uav.studies.compare.report import CSV_FILE, FIGURE_FILES, REPORT_FILE, Run, machine, versions, write_results
from sb3_uav.studies.compare.runs import FINISHED_FILE, ZooTraining, train_all
from sb3_uav.studies.compare.settings import Settings
from sb3_uav.studies.compare.variants import Variant, callback_name, callbacks_of, read_variants


def run_study(settings: Settings, arguments: Sequence[str], report_only: bool = False) -> list[Path]:
    """
    Train what is not trained yet, and report on all runs.

    :param settings: Settings of the comparison
    :param arguments: Arguments of the command, quoted in the report
    :param report_only: Whether to report on the finished runs without training
    :return: The files of the report
    :raises ValueError: If a setting does not fit the environment or earlier runs, or a training fails
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If matplotlib is not installed
    """
    problem = make_problem(settings.env)
    variants = read_variants(settings.variants, settings.env)
    needs_router = isinstance(problem, AllocationProblem) and not settings.its
    if settings.router is not None and not needs_router:
        raise ValueError("--router is for TaskAllocation environments without --its; leave it out.")

    settings.out.mkdir(parents=True, exist_ok=True)
    make_validation_set(settings, problem)
    if needs_router:
        make_router(settings, problem)
    check_settings(settings, needs_router)
    trainings = _plan_trainings([_with_common_ground(variant, settings, needs_router) for variant in variants], settings)
    if not report_only:
        train_all([training for training in trainings if not training.is_finished], settings.jobs)
    return _write_report(settings, arguments, [training for training in trainings if training.is_finished])


def _with_common_ground(variant: Variant, settings: Settings, needs_router: bool) -> Variant:
    """
    Give an entry the common budget, evaluation and router.

    :param variant: The variant as its YAML has it
    :param settings: Settings of the comparison
    :param needs_router: Whether the common router gives the rewards
    :return: The variant with the common settings
    """

    replaced = {"FixedSetEvalCallback", "PretrainedRouterCallback"} | (set() if settings.its else {"ITSCallback"})
    callbacks = [callback for callback in callbacks_of(variant.entry) if callback_name(callback) not in replaced]
    if needs_router:
        callbacks.append({"sb3_uav.training.PretrainedRouterCallback": {"router": str(settings.out / ROUTER_FILE)}})
    evaluation = {
        "instances": str(settings.out / VALIDATION_FILE),
        "n_samples": settings.samples,
        "eval_freq": settings.eval_freq,
        "seed": SHARED_SEED,
    }
    callbacks.append({"sb3_uav.training.FixedSetEvalCallback": evaluation})
    return variant._replace(entry={**variant.entry, "n_timesteps": settings.n_timesteps, "callback": callbacks})


def _plan_trainings(variants: Sequence[Variant], settings: Settings) -> list[ZooTraining]:
    """
    Write the YAML of every variant.

    :param variants: The variants to compare
    :param settings: Settings of the comparison
    :return: All runs, ordered by seed, so that an unfinished comparison is balanced
    :raises ValueError: If finished runs had other settings
    """
    trainings = []
    for variant in variants:
        config = settings.out / "configs" / f"{variant.folder}.yml"
        folder = settings.out / "runs" / variant.folder
        text = yaml.safe_dump({settings.env: variant.entry}, sort_keys=False)
        if config.is_file() and config.read_text() != text and any(folder.glob(f"*/{FINISHED_FILE}")):
            raise ValueError(f"{config}: {variant.name!r} had other settings in earlier runs; choose another --out or name.")
        write_atomically(config, text)
        for seed in settings.seeds:
            trainings.append(
                ZooTraining(
                    name=variant.name,
                    algo=variant.algo,
                    env_id=settings.env,
                    seed=seed,
                    n_timesteps=settings.n_timesteps,
                    config=config,
                    folder=folder / f"seed_{seed}",
                    n_threads=settings.num_threads,
                    device=settings.device,
                )
            )
    return sorted(trainings, key=lambda training: settings.seeds.index(training.seed))


def _write_report(settings: Settings, arguments: Sequence[str], finished: Sequence[ZooTraining]) -> list[Path]:
    """
    :param settings: Settings of the comparison
    :param arguments: Arguments of the command, quoted in the report
    :param finished: The runs to report on
    :return: Paths of the written files
    :raises ValueError: If there are none
    """

    if not finished:
        raise ValueError(f"{settings.out}: no run is finished yet; run without --report-only.")
    # In the order of the variants, not of the seeds.
    finished = sorted(finished, key=lambda training: list(dict.fromkeys(t.name for t in finished)).index(training.name))
    runs = [Run(training.name, training.algo, training.seed, training.history) for training in finished]
    validation = Instances.load(settings.out / VALIDATION_FILE)
    decoding = f"greedily and as the best of {settings.samples} samples" if settings.samples > 0 else "greedily"
    source = f"`{settings.instances.name}`" if settings.instances is not None else "drawn from a stream that no training uses"
    evaluated = (
        f"{len(validation)} instances ({source}), the same for all, decoded {decoding}, every {settings.eval_freq:,} steps"
    )
    notes = [
        f"Environment: `{settings.env}`; each run learns from {settings.n_timesteps:,} environment steps, "
        "and ends with its rollout.",
        f"Runs: {len(runs)}, seeds {', '.join(map(str, sorted({run.seed for run in runs})))}.",
        f"Validation: {evaluated}.",
    ]
    if (settings.out / ROUTER_FILE).is_file():
        text = (settings.out / ROUTER_FILE).with_suffix(".txt").read_text()
        notes.append(f"Router: the same one for all rewards, which is not trained during the runs: {text}.")
    elif settings.its:
        notes.append(
            "Router: each run trains its own by ITS, so rewards differ; its episodes take time but do not count as steps."
        )
    notes += [f"Machine: {machine(settings.num_threads, settings.jobs, settings.device)}.", f"Versions: {versions()}."]

    def shown(words: Sequence[str]) -> str:
        # Only the name of the folder, so that the report contains no absolute path.
        return shlex.join(words).replace(str(settings.out), settings.out.name)

    commands = {"The whole comparison": shown(["sb3-uav", "compare", *arguments])}
    for training in finished:
        what = f"{training.name} (settings: `configs/{training.config.name}`), one of the seeds"
        commands.setdefault(what, shown(["python", *training.flags]))
    title = f"Comparison of algorithms on {settings.env}"
    write_results(runs, settings.out, title, settings.n_timesteps, settings.samples, notes, commands)
    return [settings.out / name for name in (CSV_FILE, *FIGURE_FILES, REPORT_FILE)]
