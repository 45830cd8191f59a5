"""
PPO, MaskablePPO, A2C or REINFORCE: the study behind docs/comparison, which states its protocol.

Each part of the study has an environment, a preset and a number of environment steps. For each algorithm of it, Optuna tries
equally many settings; then every algorithm trains with several seeds for equally many steps, and all but PPO once more for as
long as PPO takes. The router is tuned and trained alone. Under ITS the allocator's algorithm trains it, with the settings that
were found for it alone.

    python benchmarks/algorithm_study.py --out docs/comparison/study --parts router-N20 allocator-N20
    python benchmarks/algorithm_study.py --out docs/comparison/study --report-only

Rerun an interrupted call to resume it: finished trials and runs are kept.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.files import write_atomically
from sb3_uav.studies.compare.common_ground import make_problem
from sb3_uav.studies.compare.report import Run, machine, versions, write_results
from sb3_uav.studies.compare.runs import ZooTraining, train_all
from sb3_uav.training.fixed_set_history import EvaluationHistory
from sb3_uav.training.fixed_set_returns import draw_fixed_set
from sb3_uav.zoo.tuning import register_search_spaces

# Seeds of the instances on which settings are chosen, and of those on which the algorithms are compared.
TUNING_SET, TEST_SET, TUNING_SEED = 1_001, 1_002, 100
N_SAMPLES = 16
# Episodes in an update of REINFORCE and A2C, and in a rollout of PPO, which makes several updates of one; tuned.
EPISODES = (32, 64, 128, 256)
N_EVALUATIONS = 10
# The budget of PPO's time is reached by training longer, at most by this factor.
LONGEST = 10.0


class Part(NamedTuple):
    """
    :param env: Id of the environment
    :param steps: Environment steps of a run
    :param tuning_steps: Environment steps of a trial
    :param n_seeds: Number of seeds
    :param network: Arguments of the policies, without the preset
    :param router: Name of the part that tunes the router; None if the router itself is trained
    :param n_instances: Instances of each of the two fixed sets
    """

    env: str
    steps: int
    tuning_steps: int
    n_seeds: int
    network: dict[str, Any]
    router: str | None = None
    n_instances: int = 256


SMALL: dict[str, Any] = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
PARTS: dict[str, Part] = {
    "router-N20": Part("RoutePlanning-N20-v0", 400_000, 200_000, 5, SMALL),
    "allocator-N20": Part("TaskAllocation-U3-N20-v0", 1_000_000, 400_000, 5, SMALL, "router-N20"),
    "router-N80": Part("RoutePlanning-N80-v0", 1_000_000, 250_000, 3, {}, n_instances=128),
    "allocator-U4-N80": Part("TaskAllocation-U4-N80-v0", 4_000_000, 800_000, 3, {}, "router-N80", 128),
}
# Name of an arm: rl_zoo3's name of its algorithm, and the baseline of REINFORCE.
ARMS: dict[str, tuple[str, str | None]] = {
    "PPO": ("ppo", None),
    "A2C": ("a2c", None),
    "REINFORCE, shared": ("reinforce", "shared"),
    "REINFORCE, rollout": ("reinforce", "rollout"),
}
# MaskablePPO is run with PPO's settings and these seeds, to see whether it differs from PPO at all.
MASKABLE_SEEDS = (0,)
ITS: dict[str, Any] = dict(n_epochs=10, n_pretraining_epochs=4, n_intensive_epochs=4, n_continuous_epochs=2)


class Study:
    """
    One part with one preset.

    :param name: Name of the part
    :param preset: ``"default"`` or ``"paper"``
    :param out: Folder of all parts
    :param scratch: Folder of what is not worth keeping
    :param n_trials: Trials of each arm
    :param jobs: Trainings at once
    """

    def __init__(self, name: str, preset: str, out: Path, scratch: Path, n_trials: int, jobs: int) -> None:
        self.part, self.preset, self.n_trials, self.jobs = PARTS[name], preset, n_trials, jobs
        self.name = f"{name}-{preset}"
        self.folder, self.scratch = out / self.name, scratch / self.name
        router = self.part.router
        self.router = None if router is None else Study(router, preset, out, scratch, n_trials, jobs)
        self.n_tasks: int = make_problem(self.part.env).generator.n_tasks

    # ------------------------------------------------------------------------------------------------------ settings

    def entry(self, arm: str, settings: dict[str, Any], n_steps: int, fixed_set: int) -> tuple[str, dict[str, Any]]:
        """
        :param arm: Name of an arm
        :param settings: What tuning found, or tries
        :param n_steps: Environment steps
        :param fixed_set: Seed of the instances for the evaluation
        :return: rl_zoo3's name of the algorithm, and the YAML entry
        """
        algo, _ = ARMS[arm]
        level = "Router" if self.router is None else "Allocator"
        entry = self.algorithm(arm, settings)
        entry |= {"policy": f"sb3_uav.policies.{level}Policy", "n_timesteps": n_steps}
        # Falls to 0 during the run, for all alike.
        entry["learning_rate"] = f"lin_{entry['learning_rate']}"
        callbacks: list[Any] = [] if algo == "reinforce" else ["sb3_uav.training.EpisodeBufferCallback"]
        n_samples = entry.get("n_samples", 1)
        # Equally many episodes for all, so that an epoch has equally many steps.
        n_episodes = n_steps // (ITS["n_epochs"] * self.n_tasks)
        if algo == "reinforce":
            entry["instances_per_epoch"] = max(n_episodes // n_samples, entry["n_envs"])
        if self.router is not None:
            router = self.router.algorithm(arm, self.router.best(arm))
            router |= {"algo": algo, "policy": "RouterPolicy"}
            its = {**ITS, "router": router}
            router_episodes = n_episodes // router.get("n_samples", 1)
            its["router_instances_per_epoch"] = max(router_episodes, router["n_envs"] if algo == "reinforce" else 1)
            if algo != "reinforce":
                its["instances_per_epoch"] = n_episodes
            callbacks.append({"sb3_uav.training.ITSCallback": its})
        evaluation = dict(n_instances=self.part.n_instances, n_samples=N_SAMPLES, seed=fixed_set)
        callbacks.append({"sb3_uav.training.FixedSetEvalCallback": {**evaluation, "eval_freq": n_steps // N_EVALUATIONS}})
        return algo, {**entry, "callback": callbacks}

    def algorithm(self, arm: str, settings: dict[str, Any]) -> dict[str, Any]:
        """
        :param arm: Name of an arm
        :param settings: What tuning found, or tries
        :return: The arguments of its algorithm, without its policy
        """
        algo, baseline = ARMS[arm]
        kwargs: dict[str, Any] = {"policy_kwargs": {"preset": self.preset, **self.part.network}}
        settings = {name: value for name, value in settings.items() if value is not None}
        n_episodes = settings.pop("episodes")
        if algo != "reinforce":
            # Rollouts of whole episodes of the allocator; the router's episodes are shorter, and continue in the next rollout.
            n_steps = self.n_tasks if self.router is not None else min(self.n_tasks, 40)
            if "batch_size" in settings:
                settings["batch_size"] = min(settings["batch_size"], n_episodes * n_steps)
            return {**kwargs, "n_envs": n_episodes, "n_steps": n_steps, "gamma": 1.0, **settings}
        n_samples = settings.pop("n_samples", 1) if baseline == "shared" else 1
        kwargs["n_envs"] = max(n_episodes // n_samples, 1)
        if baseline == "rollout":
            settings["baseline_kwargs"] = {"n_test_instances": 1_000}
        return {**kwargs, **settings, "n_samples": n_samples, "baseline": baseline}

    # ------------------------------------------------------------------------------------------------------ tuning

    def tune(self) -> None:
        """Try settings of every arm until each has had its number of trials."""
        register_search_spaces(self.part.env)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        for arm, (algo, baseline) in ARMS.items():
            storage = self._trials(arm)
            sampler: optuna.samplers.BaseSampler = optuna.samplers.TPESampler(n_startup_trials=4, seed=TUNING_SEED)
            if baseline is not None:
                sampler = optuna.samplers.PartialFixedSampler({"baseline": baseline}, sampler)
            study = optuna.create_study(
                storage=storage, sampler=sampler, study_name=arm, direction="maximize", load_if_exists=True
            )
            while (number := len(self._finished(study))) < self.n_trials:
                trial = study.ask()
                settings = dict(HYPERPARAMS_SAMPLER[algo](trial, 0, 0, {}))
                settings["episodes"] = trial.suggest_categorical("episodes", EPISODES)
                trial.set_user_attr("settings", settings)
                score = self._try(arm, settings, f"{_slug(arm)}-{number}")
                if score is None:
                    study.tell(trial, state=optuna.trial.TrialState.FAIL)
                    raise ValueError(f"{self.name}, {arm}: a trial failed with {settings}.")
                study.tell(trial, score)
                print(f"{self.name}: {arm}, trial {number + 1} of {self.n_trials}: {score:.3f} with {settings}", flush=True)

    def _trials(self, arm: str) -> JournalStorage:
        self.folder.mkdir(parents=True, exist_ok=True)
        return JournalStorage(JournalFileBackend(str(self.folder / f"trials-{_slug(arm)}.log")))

    @staticmethod
    def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
        return study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))

    def _try(self, arm: str, settings: dict[str, Any], name: str) -> float | None:
        """:return: The greedy mean at the end of a short training; None if it failed"""
        algo, entry = self.entry(arm, settings, self.part.tuning_steps, TUNING_SET)
        training = self._training(name, arm, algo, entry, TUNING_SEED, self.part.tuning_steps, "tuning")
        try:
            train_all([training], 1)
        except ValueError as error:
            if "not finite" in str(error):
                # Diverged: as bad as visiting nothing.
                return 0.0
            print(error, file=sys.stderr)
            return None
        return float(training.history.results[-1].mean())

    def best(self, arm: str) -> dict[str, Any]:
        """
        :param arm: Name of an arm
        :return: The settings of its best trial
        """
        study = optuna.load_study(storage=self._trials(arm), study_name=arm)
        return dict(study.best_trial.user_attrs["settings"])

    # ------------------------------------------------------------------------------------------------------ runs

    def _training(
        self, name: str, arm: str, algo: str, entry: dict[str, Any], seed: int, n_steps: int, kind: str
    ) -> ZooTraining:
        """A training, with its YAML written."""
        config = self.scratch / kind / f"{name}.yml"
        config.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(config, yaml.safe_dump({self.part.env: entry}, sort_keys=False))
        return ZooTraining(arm, algo, self.part.env, seed, n_steps, config, self.scratch / kind / name)

    def arms(self) -> Iterator[tuple[str, str, int, tuple[int, ...]]]:
        """:return: Title, arm, steps and seeds of all trainings, those first that others depend on"""
        seeds = tuple(range(self.part.n_seeds))
        for arm in ARMS:
            yield arm, arm, self.part.steps, seeds
        yield "MaskablePPO", "PPO", self.part.steps, MASKABLE_SEEDS
        for arm in list(ARMS)[1:]:
            ratio = self._cpu_seconds("PPO", 0) / self._cpu_seconds(arm, 0)
            steps = int(self.part.steps * min(max(ratio, 1.0), LONGEST))
            yield f"{arm}, PPO's time", arm, steps, seeds

    def _cpu_seconds(self, title: str, seed: int) -> float:
        return float(EvaluationHistory.load(self._history_file(title, seed)).cpu_seconds[-1])

    def _history_file(self, title: str, seed: int) -> Path:
        return self.folder / "histories" / f"{_slug(title)}-{seed}.npz"

    def train(self) -> None:
        """Train every arm with every seed; keep the evaluations of each run."""
        self.folder.mkdir(parents=True, exist_ok=True)
        validation = draw_fixed_set(make_problem(self.part.env), self.part.n_instances, TEST_SET)
        validation.save(self.folder / "validation.npz")
        for title, arm, steps, seeds in self.arms():
            algo, entry = self.entry(arm, self.best(arm), steps, TEST_SET)
            if title == "MaskablePPO":
                algo, entry = "ppo_mask", json.loads(json.dumps(entry).replace('"algo": "ppo"', '"algo": "ppo_mask"'))
            config = self.folder / f"{_slug(title)}.yml"
            write_atomically(config, yaml.safe_dump({self.part.env: entry}, sort_keys=False))
            waiting = [seed for seed in seeds if not self._history_file(title, seed).is_file()]
            for first in range(0, len(waiting), self.jobs):
                chosen = waiting[first : first + self.jobs]
                runs = {s: self._training(f"{_slug(title)}-{s}", title, algo, entry, s, steps, "runs") for s in chosen}
                train_all(list(runs.values()), self.jobs)
                for seed, run in runs.items():
                    self._keep(run.history, self._history_file(title, seed))

    @staticmethod
    def _keep(history: EvaluationHistory, path: Path) -> None:
        """Keep an evaluation history in a tenth of the space; objectives are whole numbers in all parts."""
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: np.asarray(array) for name, array in history._asdict().items()}
        for name in ("results", "ep_lengths", "sampled"):
            whole = np.rint(arrays[name]).astype(np.int16)
            assert np.array_equal(whole, arrays[name])
            arrays[name] = whole
        temporary = path.with_suffix(".tmp.npz")
        np.savez_compressed(temporary, n_samples=N_SAMPLES, **arrays)  # type: ignore[arg-type]
        temporary.replace(path)

    # ------------------------------------------------------------------------------------------------------ report

    def report(self, command: str) -> None:
        """
        Write the report on all finished runs, if there are any.

        :param command: The command line of the study
        """
        files = [(title, ARMS[arm][0], seed) for title, arm, _, seeds in self._known_arms() for seed in seeds]
        runs = [
            Run(title, "ppo_mask" if title == "MaskablePPO" else algo, seed, EvaluationHistory.load(path))
            for title, algo, seed in files
            if (path := self._history_file(title, seed)).is_file()
        ]
        if not runs:
            return
        notes = [
            f"Environment: `{self.part.env}`, {'the router alone' if self.router is None else 'the allocator under ITS'}, "
            f"preset `{self.preset}`{f' with {self.part.network}' if self.part.network else ''}.",
            f"Settings: the best of {self.n_trials} trials of {self.part.tuning_steps:,} steps each, in `*.yml`; "
            "the trials are in `trials-*.log`. Learning rates fall linearly to 0; those of the router under ITS are constant.",
            f"Evaluation: {self.part.n_instances} instances that neither training nor tuning saw, greedily and as the best of "
            f"{N_SAMPLES} samples.",
            "`PPO's time`: trained for as many steps as fit into the CPU time of PPO with seed 0, at most "
            f"{LONGEST:.0f} times as many.",
            f"Machine: {machine(1, self.jobs, 'cpu')}.",
            f"Versions: {versions()}.",
        ]
        title = f"Comparison of algorithms: {self.name}"
        write_results(runs, self.folder, title, self.part.steps, N_SAMPLES, notes, {"The study": command})
        print(self.folder / "report.md")

    def _known_arms(self) -> list[tuple[str, str, int, tuple[int, ...]]]:
        """Those arms whose number of steps is known yet."""
        known = []
        try:
            for arm in self.arms():
                known.append(arm)
        except FileNotFoundError:
            pass
        return known


def _slug(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name.lower()).replace("--", "-")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--scratch", type=Path, default=Path("algorithm_study"), help="folder of logs and zips")
    parser.add_argument("--parts", nargs="+", choices=sorted(PARTS), default=list(PARTS))
    parser.add_argument("--presets", nargs="+", choices=("default", "paper"), default=["default", "paper"])
    parser.add_argument("--n-trials", type=int, default=8, help="trials of each algorithm, default: %(default)s")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once, default: %(default)s")
    parser.add_argument("--report-only", action="store_true", help="train nothing")
    args = parser.parse_args()
    command = shlex.join(["python", "benchmarks/algorithm_study.py", *sys.argv[1:]])
    for preset in args.presets:
        for name in (name for name in PARTS if name in args.parts):
            study = Study(name, preset, args.out, args.scratch, args.n_trials, args.jobs)
            if not args.report_only:
                for stage in (study.router, study):
                    if stage is not None:
                        stage.tune()
                study.train()
            study.report(command)


if __name__ == "__main__":
    main()
