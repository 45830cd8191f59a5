"""Finding trained pairs: the user's own, those trained before, and those still to be trained."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sb3_uav.reproduce.pair_training import (
    ALLOCATOR_FILE,
    ITS_LOG,
    ROUTER_FILE,
    PairTraining,
    check_complete,
    training_entry,
)
from sb3_uav.reproduce.scales import Recipe, Scale, Scenario
from sb3_uav.reproduce.training_processes import train_pairs
from sb3_uav.training.its_schedule import ALTERNATE_ONLY, INDEPENDENT, ITS, NO_INTENSIVE, NO_PRETRAINING

LEVELS = ("allocator", "router")
# Folders of the strategies; those of the ablation without what their names say.
_STRATEGY_FOLDERS = {
    ITS: "ITS",
    NO_PRETRAINING: "ITS-without-pre-training",
    NO_INTENSIVE: "ITS-without-intensive",
    ALTERNATE_ONLY: "ITS-without-both",
    INDEPENDENT: "independent",
}
# Required columns of a log and their types.
_LOG_COLUMNS: dict[str, Callable[[str], object]] = {"n_instances": int, "objective": float, "seconds": float}


@dataclass(frozen=True)
class Model:
    """
    A trained pair.

    :param scenario: The scenario that it was trained for
    :param strategy: Its training strategy
    :param folder: Folder of its files
    :param label: Name in tables and figures: the scenario, the fleet, or ``"universal"``
    """

    scenario: Scenario
    strategy: str
    folder: Path
    label: str

    @property
    def allocator(self) -> Path:
        return self.folder / ALLOCATOR_FILE

    @property
    def router(self) -> Path:
        return self.folder / ROUTER_FILE

    @property
    def its_log(self) -> Path | None:
        """The log of its training, if there is one."""
        path = self.folder / ITS_LOG
        return path if path.is_file() else None


def read_log(its_log: Path) -> list[dict[str, str]]:
    """
    :param its_log: The ``its_log.csv`` of a training
    :return: Its lines, one for every epoch
    :raises ValueError: If the file is not such a log; the message names file and line
    """
    remedy = f"give the {ITS_LOG} that the training wrote, or take the file away"
    try:
        with its_log.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{its_log}: is no log of a training ({error}); {remedy}.") from error
    for number, row in enumerate(rows, start=2):
        try:
            for column, kind in _LOG_COLUMNS.items():
                kind(row[column])
            # Earlier versions did not write it.
            float(row.get("generation_seconds") or 0.0)
            if row["level"] not in LEVELS or not row["phase"] or int(row["n_instances"]) < 1:
                raise ValueError(f"level {row['level']!r}, phase {row['phase']!r}, n_instances {row['n_instances']}")
        except KeyError as error:
            raise ValueError(f"{its_log}: has no column {error}; {remedy}.") from error
        except (TypeError, ValueError) as error:
            raise ValueError(f"{its_log}, line {number}: is damaged ({error}); {remedy}.") from error
    return rows


class Models:
    """
    Finds trained pairs and trains missing ones.

    :param scale: The scale
    :param out: Folder of all results; trained pairs are in ``models`` and, for Table I, in ``timing``
    :param given: The user's own pairs: ``U4-N80/ITS/allocator.zip`` and ``router.zip`` (and the ``its_log.csv`` of their
        training, for Table I and Figs. 4 and 5), or, for all sizes of a fleet, ``U4/ITS/...``, or for everything, ``ITS/...``.
        :data:`_STRATEGY_FOLDERS` are the names in place of ``ITS``
    :param seed: Seed of the trainings
    :param device: Their device
    :param num_threads: Threads of torch; its own choice when None, one if there are several jobs
    :param n_jobs: How many trainings run at once
    :param training: Whether to train what is missing
    :raises FileNotFoundError: If ``given`` is not a folder
    """

    def __init__(
        self,
        scale: Scale,
        out: Path,
        given: Path | None = None,
        seed: int = 0,
        device: str = "auto",
        num_threads: int | None = None,
        n_jobs: int = 1,
        training: bool = True,
    ) -> None:
        if given is not None and not given.is_dir():
            raise FileNotFoundError(f"--models {given}: no such folder; give one that holds U4-N80/ITS/{ALLOCATOR_FILE}, ...")
        self.scale = scale
        self.out = out
        self.given = given
        self.seed = seed
        self.device = device
        self.num_threads = 1 if num_threads is None and n_jobs > 1 else num_threads
        self.n_jobs = n_jobs
        self.training = training

    def get(self, wanted: Iterable[tuple[Scenario, str]], log_needed: bool = False) -> dict[tuple[Scenario, str], Model]:
        """
        :param wanted: Scenarios and strategies
        :param log_needed: Whether to ignore pairs without the log of their training
        :return: The pairs, without those that are missing and may not be trained
        :raises TrainingError: If a training fails
        :raises KeyboardInterrupt: If a training is interrupted
        """
        return self._find(self.scale.recipe, "models", wanted, log_needed)

    def _find(
        self, recipe: Recipe, kind: str, wanted: Iterable[tuple[Scenario, str]], log_needed: bool
    ) -> dict[tuple[Scenario, str], Model]:
        """The user's own pairs, and those that are trained with a recipe; see :meth:`get`."""
        found: dict[tuple[Scenario, str], Model] = {}
        jobs: dict[tuple[Scenario, str], PairTraining] = {}
        for scenario, strategy in wanted:
            model = self._given(scenario, strategy)
            if model is not None and (model.its_log is not None or not log_needed):
                found[scenario, strategy] = model
            else:
                jobs[scenario, strategy] = self._job(recipe, kind, scenario, strategy)
        return found | self._trained(jobs)

    def timed(self, wanted: Iterable[Scenario]) -> dict[Scenario, Model]:
        """
        :param wanted: Scenarios
        :return: Pairs whose logs tell how long epochs take
        """
        recipe = self.scale.timing
        if recipe is None:
            trained = [scenario for scenario in wanted if scenario.n_tasks in self.scale.trained_sizes]
            models = self.get([(scenario, ITS) for scenario in trained], log_needed=True)
        else:
            models = self._find(recipe, "timing", [(scenario, ITS) for scenario in wanted], log_needed=True)
        return {scenario: model for (scenario, _), model in models.items()}

    def _given(self, scenario: Scenario, strategy: str) -> Model | None:
        """The user's own pair, if there is one."""
        if self.given is None:
            return None
        for part, label in ((scenario.folder, scenario.name), (f"U{scenario.n_uavs}",) * 2, (".", "universal")):
            model = Model(scenario, strategy, self.given / part / _STRATEGY_FOLDERS[strategy], label)
            if model.allocator.is_file() and model.router.is_file():
                return model
            if model.allocator.is_file() or model.router.is_file():
                missing = ROUTER_FILE if model.allocator.is_file() else ALLOCATOR_FILE
                raise FileNotFoundError(f"{model.folder / missing}: no such file; --models needs both zips of a pair.")
        return None

    def _job(self, recipe: Recipe, kind: str, scenario: Scenario, strategy: str) -> PairTraining:
        place = Path(scenario.folder) / _STRATEGY_FOLDERS[strategy]
        return PairTraining(
            scenario,
            strategy,
            training_entry(self.scale, recipe, scenario, strategy),
            self.out / "training" / kind / place,
            self.out / kind / place,
            self.seed,
            self.device,
            self.num_threads,
        )

    def _trained(self, jobs: dict[tuple[Scenario, str], PairTraining]) -> dict[tuple[Scenario, str], Model]:
        """The trained pairs, after training missing ones."""
        todo = [job for job in jobs.values() if not check_complete(job)]
        if self.training:
            train_pairs(todo, self.n_jobs)
            todo = []
        trained = {key: job for key, job in jobs.items() if job not in todo}
        return {k: Model(job.scenario, job.strategy, job.model_folder, job.scenario.name) for k, job in trained.items()}
