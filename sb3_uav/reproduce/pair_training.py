"""Training one pair through the zoo; an interrupted training resumes from its checkpoint."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_uav.common.files import replaced_when_complete
from sb3_uav.common.interruption import is_interruption
from sb3_uav.evaluation.provenance import describe_machine
from sb3_uav.reproduce.scales import Recipe, Scale, Scenario, scenarios
from sb3_uav.training.its_schedule import INDEPENDENT, EpochSchedule, strategy_name

ALLOCATOR_FILE, ROUTER_FILE, ITS_LOG = "allocator.zip", "router.zip", "its_log.csv"
# Of FixedSetEvalCallback: means of the evaluations by situation.
SIZE_TABLE = "size_grid.csv"
_TRAINING_FILE = "training.json"
_CONFIG_FILE, _OUTPUT_FILE = "config.yml", "output.txt"
ITS_KEY, _EVALUATION_KEY = "sb3_uav.training.ITSCallback", "sb3_uav.training.FixedSetEvalCallback"


class TrainingError(ValueError):
    """A failed training."""


@dataclass(frozen=True)
class PairTraining:
    """
    One training.

    :param scenario: The paper's name of the situation
    :param strategy: One of :data:`~sb3_uav.training.its_schedule.STRATEGIES`
    :param entry: The zoo's YAML entry
    :param run_folder: Where the zoo writes
    :param model_folder: Where the zips go when the training is complete
    :param seed: Seed
    :param device: Device, as SB3 names it
    :param num_threads: Threads of torch; its own choice when None
    """

    scenario: Scenario
    strategy: str
    entry: dict[str, Any]
    run_folder: Path
    model_folder: Path
    seed: int
    device: str
    num_threads: int | None

    @property
    def env_id(self) -> str:
        return self.scenario.env_id

    @property
    def title(self) -> str:
        seed = f", seed {self.seed}" if self.seed > 0 else ""
        return f"{self.scenario.name}, {self.strategy}{seed}"

    @property
    def its(self) -> Mapping[str, Any]:
        """The arguments of the interactive training strategy."""
        return self.entry["callback"][0][ITS_KEY]

    @property
    def schedule(self) -> EpochSchedule:
        """The epochs of both levels."""
        its = self.its
        names = ("n_epochs", "n_pretraining_epochs", "n_intensive_epochs", "n_continuous_epochs")
        return EpochSchedule.of(self.strategy, *(its[name] for name in names))

    def newest_run(self) -> Path | None:
        """:return: The zoo's folder of the latest run with a checkpoint, if there is one"""
        from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, STATE_FILE

        runs = [state.parents[1] for state in self.run_folder.glob(f"reinforce/*/{CHECKPOINT_FOLDER}/{STATE_FILE}")]
        return max(runs, key=lambda run: int(run.name.rpartition("_")[2]), default=None)


def training_entry(scale: Scale, recipe: Recipe, scenario: Scenario, strategy: str) -> dict[str, Any]:
    """
    :param scale: The scale
    :param recipe: Training settings
    :param scenario: The scenario to train for
    :param strategy: The training strategy
    :return: The zoo's YAML entry of the scenario with the changes of the recipe
    :raises FileNotFoundError: If the zoo's YAML is missing
    """
    from sb3_uav.zoo.configs import default_config, plain_numbers, read_yaml

    config = default_config(recipe.config)
    if config is None:
        raise FileNotFoundError(f"{recipe.config}.yml: not found; install sb3-uav again.")
    shipped = read_yaml(config)[scenario.env_id]
    entry: dict[str, Any] = plain_numbers(deepcopy(shipped)) | dict(recipe.allocator)
    its = entry["callback"][0][ITS_KEY]
    its |= {**recipe.its, "strategy": strategy, "verbose": 1}
    its["router"] |= recipe.router
    if recipe.evaluations is not None:
        del entry["callback"][1:]
    if recipe.evaluations:
        sets = [[each.n_uavs, scale.n_tasks(each), recipe.evaluations] for each in scenarios()]
        evaluation = {"sizes": sets, "n_samples": 0, "max_distance": scale.max_distance}
        entry["callback"].append({_EVALUATION_KEY: evaluation})
    if scenario.n_tasks in recipe.instances_per_epoch:
        entry["instances_per_epoch"] = recipe.instances_per_epoch[scenario.n_tasks]
    sizes = {"n_tasks": scale.n_tasks(scenario), "max_distance": scale.max_distance}
    entry["env_kwargs"] = sizes
    # An upper bound: the strategy ends the training after its last epoch.
    n_instances = entry["instances_per_epoch"] + entry["n_envs"]
    entry["n_timesteps"] = its["n_epochs"] * n_instances * entry.get("n_samples", 1) * sizes["n_tasks"]
    # Independent of what YAML anchors share.
    return json.loads(json.dumps(entry))


def train_pair(job: PairTraining) -> None:
    """
    Train a pair, or resume its training, and copy its zips to the folder of models.

    :param job: The training
    :raises TrainingError: If it fails; the message names the file with its output
    :raises KeyboardInterrupt: If it was interrupted
    """
    from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state

    job.run_folder.mkdir(parents=True, exist_ok=True)
    config = job.run_folder / _CONFIG_FILE
    text = yaml.safe_dump({job.env_id: job.entry}, sort_keys=False)
    run = job.newest_run()
    if run is not None and config.is_file() and config.read_text(encoding="utf-8") != text:
        raise TrainingError(
            f"{job.run_folder}: holds an unfinished training with other settings; delete it, or choose another --out."
        )
    with replaced_when_complete(config) as file:
        file.write(text)
    if run is None or read_state(run / CHECKPOINT_FOLDER)["epoch"] < job.schedule.n_epochs:
        _run_zoo(job, config, run)
        run = job.newest_run()
    if run is None or (state := read_state(run / CHECKPOINT_FOLDER))["epoch"] < job.schedule.n_epochs:
        raise TrainingError(f"Training {job.title} ended early (all of its output is in {job.run_folder / _OUTPUT_FILE})")
    _publish(job, run, state)


def _run_zoo(job: PairTraining, config: Path, interrupted: Path | None) -> None:
    """
    :param job: The training
    :param config: Its YAML
    :param interrupted: The zoo's folder of the run to resume
    :raises TrainingError: If it fails
    :raises KeyboardInterrupt: If it was interrupted
    """
    from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state
    from sb3_uav.zoo import train as zoo_train

    arguments = ["--algo", "reinforce", "--env", job.env_id, "--conf-file", str(config), "--log-folder", str(job.run_folder)]
    arguments += ["--seed", str(job.seed), "--device", job.device, "--eval-freq", "-1", "--verbose", "0"]
    if job.num_threads is not None:
        arguments += ["--num-threads", str(job.num_threads)]
    if interrupted is not None:
        checkpoint = interrupted / CHECKPOINT_FOLDER
        arguments += ["--trained-agent", str(checkpoint / read_state(checkpoint)["allocator"])]
    output = job.run_folder / _OUTPUT_FILE
    with output.open("a", encoding="utf-8") as file, redirect_stdout(file), redirect_stderr(file):
        code = zoo_train.main(arguments)
    if is_interruption(code):
        raise KeyboardInterrupt
    if code != 0:
        last = output.read_text(encoding="utf-8").strip().splitlines()[-1:]
        raise TrainingError(f"Training {job.title} failed: {''.join(last)} (all of its output is in {output})")


def _publish(job: PairTraining, run: Path, state: Mapping[str, Any]) -> None:
    """
    Copy the files of a complete training to the folder of models.

    :param job: The training
    :param run: The zoo's folder of the run
    :param state: State of its checkpoint
    """
    from sb3_uav.common.epoch_log import LOG_FILE
    from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER

    temporary = job.model_folder.with_name(job.model_folder.name + ".tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    shutil.copyfile(run / CHECKPOINT_FOLDER / state["allocator"], temporary / ALLOCATOR_FILE)
    shutil.copyfile(run / CHECKPOINT_FOLDER / state["router"], temporary / ROUTER_FILE)
    shutil.copyfile(run / LOG_FILE, temporary / ITS_LOG)
    if (run / SIZE_TABLE).is_file():
        shutil.copyfile(run / SIZE_TABLE, temporary / SIZE_TABLE)
    n_router_epochs = job.schedule.n_router_epochs
    about = {
        "seed": job.seed,
        "strategy": job.strategy,
        "n_router_epochs": n_router_epochs,
        "entry": job.entry,
        "run": str(run),
        **describe_machine(),
    }
    (temporary / _TRAINING_FILE).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    os.replace(temporary, job.model_folder)


def check_complete(job: PairTraining) -> bool:
    """
    :param job: A training
    :return: Whether it is complete
    :raises TrainingError: If the existing pair was trained with other settings
    """
    path = job.model_folder / _TRAINING_FILE
    if not path.is_file():
        return False
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        same = _same_training(about, job)
    except (ValueError, LookupError, TypeError) as error:
        raise TrainingError(f"{path}: is damaged ({error}); delete {job.model_folder}.") from error
    if not same:
        raise TrainingError(
            f"{job.model_folder}: was trained with other settings or another seed; delete it, choose another --out, or "
            "name its folder by --models to use it as it is."
        )
    return True


def _same_training(about: Mapping[str, Any], job: PairTraining) -> bool:
    """
    :param about: What :data:`_TRAINING_FILE` says of a trained pair
    :param job: A training
    :return: Whether the pair is its result. Earlier versions used the paper's names of the strategies, and trained the router
        of DL-DRL-I in the epochs of pre-training only
    """
    its = {**about["entry"]["callback"][0][ITS_KEY]}
    its["strategy"] = strategy_name(its["strategy"])
    entry = {**about["entry"], "callback": [{ITS_KEY: its}, *about["entry"]["callback"][1:]]}
    n_router_epochs = job.schedule.n_router_epochs
    earlier = its["n_pretraining_epochs"] if job.strategy == INDEPENDENT else n_router_epochs
    return entry == job.entry and about["seed"] == job.seed and about.get("n_router_epochs", earlier) == n_router_epochs
