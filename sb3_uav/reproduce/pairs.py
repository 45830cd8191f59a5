"""Finding trained pairs: the user's own, those trained before, and those still to be trained."""

from __future__ import annotations

import csv
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sb3_uav.pretrained import DEFAULT_PAIR, pair_files
from sb3_uav.reproduce.pair_training import (
    ALLOCATOR_FILE,
    ITS_LOG,
    ROUTER_FILE,
    SIZE_TABLE,
    PairTraining,
    check_complete,
    training_entry,
)
from sb3_uav.reproduce.scales import MIXTURE, Recipe, Scale, Scenario
from sb3_uav.reproduce.training_processes import train_pairs
from sb3_uav.training.its_schedule import ALTERNATE_ONLY, INDEPENDENT, ITS, NO_INTENSIVE, NO_PRETRAINING

LEVELS = ("allocator", "router")
# In place of a training strategy: the pair that comes with the package, and a pair before its training.
SHIPPED, UNTRAINED = "shipped", "untrained"
# Folders of the strategies; those of the ablation without what their names say.
_STRATEGY_FOLDERS = {
    ITS: "ITS",
    NO_PRETRAINING: "ITS-without-pre-training",
    NO_INTENSIVE: "ITS-without-intensive",
    ALTERNATE_ONLY: "ITS-without-both",
    INDEPENDENT: "independent",
}
_Key = TypeVar("_Key", bound=Hashable)
# Required columns of a log and their types.
_LOG_COLUMNS: dict[str, Callable[[str], object]] = {"n_instances": int, "objective": float, "seconds": float}


@dataclass(frozen=True)
class Model:
    """
    A trained pair.

    :param scenario: The scenario that it was trained for
    :param strategy: Its training strategy, :data:`SHIPPED` or :data:`UNTRAINED`
    :param folder: Folder of its files
    :param label: Name in tables and figures: the scenario, the fleet, ``"mixture"`` or ``"universal"``
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

    @property
    def size_table(self) -> Path | None:
        """The evaluations in the course of its training, if there were any."""
        path = self.folder / SIZE_TABLE
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
    :param out: Folder of all results; trained pairs are in ``models``, of Fig. 5 in ``ablation``, of Table I in ``timing``
    :param given: The user's own pairs: ``U4-N80/ITS/allocator.zip`` and ``router.zip`` (and the ``its_log.csv`` of their
        training, for Table I and Figs. 4 and 5), or, for all sizes of a fleet, ``U4/ITS/...``, or for everything, ``ITS/...``.
        :data:`_STRATEGY_FOLDERS` are the names in place of ``ITS``
    :param seed: Seed of the trainings; the first one of Fig. 5
    :param device: Their device
    :param num_threads: Threads of torch; its own choice when None, one if there are several jobs
    :param n_jobs: How many trainings run at once
    :param training: Whether to train what is missing
    :param train_pair: Whether DL-DRL is a pair that is trained, where the scale would use the shipped one
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
        train_pair: bool = False,
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
        self.uses_shipped_pair = scale.universal and given is None and not train_pair

    def get(self, wanted: Iterable[tuple[Scenario, str]], log_needed: bool = False) -> dict[tuple[Scenario, str], Model]:
        """
        :param wanted: Scenarios that pairs are trained for, and strategies
        :param log_needed: Whether to ignore pairs without the log of their training
        :return: The pairs, without those that are missing and may not be trained
        :raises TrainingError: If a training fails
        :raises KeyboardInterrupt: If a training is interrupted
        """
        return self._find(self.scale.recipe, "models", wanted, log_needed)

    def serving(self, wanted: Iterable[Scenario], strategies: Iterable[str]) -> dict[tuple[Scenario, str], Model]:
        """
        :param wanted: Scenarios to solve
        :param strategies: Training strategies, :data:`SHIPPED` or :data:`UNTRAINED`
        :return: The pairs that solve them; see :meth:`get`
        """
        keys = [(scenario, strategy) for strategy in dict.fromkeys(strategies) for scenario in wanted]
        found, trained_for = {}, {}
        for scenario, strategy in keys:
            if strategy == SHIPPED:
                found[scenario, strategy] = Model(MIXTURE, SHIPPED, pair_files()[0].parent, DEFAULT_PAIR)
            elif strategy == UNTRAINED:
                found[scenario, strategy] = self._untrained(self.scale.trained_for(scenario))
            elif (own := self._given(scenario, strategy)) is not None:
                found[scenario, strategy] = own
            else:
                trained_for[scenario, strategy] = self.scale.trained_for(scenario), strategy
        trained = self.get(dict.fromkeys(trained_for.values()))
        found |= {key: trained[source] for key, source in trained_for.items() if source in trained}
        return {key: found[key] for key in keys if key in found}

    def _untrained(self, scenario: Scenario) -> Model:
        from sb3_uav.reproduce.untrained import make_untrained_pair

        folder = self.out / "models" / scenario.folder / f"{UNTRAINED}-seed{self.seed}"
        make_untrained_pair(training_entry(self.scale, self.scale.recipe, scenario, ITS), scenario.env_id, folder, self.seed)
        return Model(scenario, UNTRAINED, folder, scenario.name)

    def ablation(self, scenario: Scenario, strategies: Iterable[str]) -> dict[tuple[str, int], Model]:
        """
        :param scenario: The scenario of Fig. 5
        :param strategies: Training strategies
        :return: Pairs with the logs of their trainings by strategy and seed; of the user's own, one for a strategy
        """
        if self.scale.ablation is None:
            found = self.get([(scenario, strategy) for strategy in strategies], log_needed=True)
            return {(strategy, self.seed): model for (_, strategy), model in found.items()}
        own: dict[tuple[str, int], Model] = {}
        jobs: dict[tuple[str, int], PairTraining] = {}
        for strategy in strategies:
            model = self._given(scenario, strategy)
            if model is not None and model.its_log is not None:
                own[strategy, self.seed] = model
                continue
            for seed in range(self.seed, self.seed + self.scale.n_ablation_seeds):
                jobs[strategy, seed] = self._job(self.scale.ablation, "ablation", scenario, strategy, seed)
        return own | self._trained(jobs)

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
        recipe, kind = (self.scale.recipe, "models") if self.scale.timing is None else (self.scale.timing, "timing")
        timed = [(scenario, ITS) for scenario in wanted if scenario.n_tasks in self.scale.trained_sizes]
        return {scenario: model for (scenario, _), model in self._find(recipe, kind, timed, log_needed=True).items()}

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

    def _job(self, recipe: Recipe, kind: str, scenario: Scenario, strategy: str, seed: int | None = None) -> PairTraining:
        place = Path(scenario.folder) / _STRATEGY_FOLDERS[strategy]
        if seed is not None:
            place /= f"seed{seed}"
        return PairTraining(
            scenario,
            strategy,
            training_entry(self.scale, recipe, scenario, strategy),
            self.out / "training" / kind / place,
            self.out / kind / place,
            self.seed if seed is None else seed,
            self.device,
            self.num_threads,
        )

    def _trained(self, jobs: Mapping[_Key, PairTraining]) -> dict[_Key, Model]:
        """The trained pairs, after training missing ones."""
        todo = [job for job in jobs.values() if not check_complete(job)]
        if self.training:
            train_pairs(todo, self.n_jobs)
            todo = []
        trained = {key: job for key, job in jobs.items() if job not in todo}
        return {k: Model(job.scenario, job.strategy, job.model_folder, job.scenario.name) for k, job in trained.items()}
