"""rl_zoo3 with our algorithms, environments and YAMLs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from sb3_contrib import MaskablePPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EventCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_uav.common import distributed
from sb3_uav.common.divergence import DivergenceError, note_saved, require_finite_model, with_checkpoint
from sb3_uav.common.interruption import Interruption, continued_by, was_received
from sb3_uav.common.random_streams import EVALUATION_SEED
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs.vec_env import BatchedVecEnv, unwrap_problem_env
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.finite import watch
from sb3_uav.reinforce.transfer import load
from sb3_uav.training import FixedSetEvalCallback, ITSCallback, StopAtDivergence
from sb3_uav.zoo.checkpoints import PairCheckpointCallback, find_checkpoint, newest_checkpoint, remove_leftovers_of
from sb3_uav.zoo.configs import check_keys, check_values, parse_schedule, plain_numbers, read_yaml
from sb3_uav.zoo.entries import find_entry, scaled_values
from sb3_uav.zoo.fine_tuning import Weights, start_from, weights_to_start_from
from sb3_uav.zoo.interrupted import Watched, open_bars, steps_of
from sb3_uav.zoo.rl_zoo3_compat import ExperimentManager, add_algorithms, interruptible_studies, optuna, rl_zoo3
from sb3_uav.zoo.run_folders import RunFolderGuard, make_run_folder, require_folder
from sb3_uav.zoo.shared_study import SeedPerTrial, fail_trials_of_dead_workers, note_worker, shared_studies
from sb3_uav.zoo.tuning import StopWhenDiverged, has_success, register_search_spaces

# Errors that values of the wrong kind cause while callbacks, environments and the algorithm are created.
_SETUP_ERRORS = (
    *(TypeError, AttributeError, AssertionError, ModuleNotFoundError, NameError, SyntaxError, LookupError, ArithmeticError),
    *(RuntimeError, MemoryError),
)
_OUR_ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"reinforce": REINFORCE, "ppo_mask": MaskablePPO}


def register_algorithms() -> None:
    """Add our algorithms to those of rl_zoo3."""
    add_algorithms(_OUR_ALGORITHMS)


def make_batched_vec_env(env_fns: list[Any]) -> VecEnv:
    """
    ``BatchedVecEnv`` for our environments, ``DummyVecEnv`` for all others and for wrapped ones.

    :param env_fns: One function per row
    """
    env = env_fns[0]()
    if unwrap_problem_env(env) is None:
        env.close()
        return DummyVecEnv(env_fns)
    return BatchedVecEnv([lambda: env, *env_fns[1:]])


class UAVExperimentManager(ExperimentManager):
    """
    rl_zoo3's experiment manager, with our vectorized environment and without these traps of rl_zoo3 2.9.2
    (https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L443):

    - ``env_kwargs`` of a YAML reach the evaluation environment too;
    - ``const_X`` is a constant, and numbers that YAML reads as strings (``1e-3``) are numbers;
    - a misspelled key is named, with the nearest known one;
    - the evaluation environment is not seeded like the training environment, whose instances it would get;
    - ``-optimize`` has search spaces that keep the network and whole episodes (:mod:`sb3_uav.zoo.tuning`), and prunes a trial
      that diverges, however it does.
    """

    # Whether --eval-freq was given. If not, FixedSetEvalCallback determines the frequency; without it, evaluations take place
    # once per epoch.
    eval_freq_given = False

    def __init__(self, args: Any, *positional: Any, **kwargs: Any) -> None:
        super().__init__(args, *positional, **kwargs)
        self._share()
        self._weights: Weights | None = None
        self._eval_env_kwargs_given = getattr(args, "eval_env_kwargs", None) is not None
        if kwargs.get("vec_env_type", "dummy") == "dummy":
            self.vec_env_class = make_batched_vec_env  # type: ignore[assignment]
        register_search_spaces(self.env_name.gym_id)

    def _share(self) -> None:
        """
        Let all but the first of several processes be silent.

        :raises ValueError: If several processes cannot share what it asks for
        """
        if distributed.world_size() > 1 and (self.algo != "reinforce" or self.optimize_hyperparameters):
            found = "-optimize" if self.optimize_hyperparameters else f"--algo {self.algo}"
            raise ValueError(
                f"torchrun: several processes can only share --algo reinforce, found {found}; start a single one."
            )
        if not distributed.is_main():
            self.verbose, self.tensorboard_log, self.show_progress = 0, None, False

    @property
    def _where(self) -> str:
        """File and entry, as errors name them."""
        return f"{self.config}, {self.env_name.gym_id}"

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        entry = self.env_name.gym_id
        found = read_yaml(Path(self.config)) if str(self.config).endswith((".yml", ".yaml")) else {}
        entry = find_entry(found, entry, self.env_kwargs) or entry
        with self._reading(entry):
            hyperparams, saved = super().read_hyperparameters()
        if not isinstance(hyperparams, dict) or "n_timesteps" not in hyperparams:
            raise ValueError(f"{self.config}: the entry of {self.env_name.gym_id} needs at least n_timesteps and policy.")
        check_keys(set(hyperparams), rl_zoo3.ALGOS[self.algo], self._where)
        hyperparams = {key: plain_numbers(value) for key, value in hyperparams.items()}
        check_values(hyperparams, self._where)
        # rl_zoo3 has replaced the entry's env_kwargs by those of the command line, but its numbers of steps are for its own:
        # https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L368
        read = found.get(entry, found.get("default"))
        own = {**hyperparams, "env_kwargs": read.get("env_kwargs")} if isinstance(read, dict) else hyperparams
        scaled = scaled_values(own, entry, self.env_name.gym_id, self.env_kwargs)
        for key, value in scaled.items():
            if key not in (self.custom_hyperparams or {}):
                print(f"{key} is for another number of tasks: {hyperparams[key]} becomes {value}")
                hyperparams[key] = saved[key] = value
        return hyperparams, saved

    @contextmanager
    def _reading(self, entry: str) -> Iterator[None]:
        """:param entry: What rl_zoo3 reads of the YAML in the ``with`` block; it looks for the entry of its environment"""
        env_name = self.env_name
        if entry != env_name.gym_id:
            print(f"{self.config} has no entry for {env_name.gym_id}; using that of {entry}")
        self.env_name = EnvironmentName(entry)
        try:
            yield
        finally:
            self.env_name = env_name

    @contextmanager
    def _missing_files(self) -> Iterator[None]:
        """Name the YAML in the error about a missing file, which it names."""
        try:
            yield
        except FileNotFoundError as error:
            # The system's own errors have a number.
            if error.errno is not None or str(self.config) in str(error):
                raise
            raise FileNotFoundError(f"{self._where}: {error}") from error

    def setup_experiment(self) -> Any:
        try:
            with self._missing_files():
                return super().setup_experiment()
        except _SETUP_ERRORS as error:
            raise ValueError(f"{self._where}: {_described(error)}") from error
        except ValueError as error:
            if str(self.config) in str(error):
                raise
            raise ValueError(f"{self._where}: {error}") from error

    def learn(self, model: BaseAlgorithm) -> None:
        watch(model)
        if self.continue_training:
            note_saved(model, Path(self.trained_agent))
        callbacks = self.callbacks
        # Of these, rl_zoo3 calls the end even after a failure.
        watched = Watched(model, on_failure=lambda: setattr(self, "callbacks", open_bars(callbacks)))
        try:
            with self._missing_files():
                super().learn(watched)  # type: ignore[arg-type]
        except (KeyboardInterrupt, RuntimeError) as error:
            # While rl_zoo3 released what the training had used, or as a lost connection: another process has ended first.
            if isinstance(error, RuntimeError) and not was_received():
                raise
            watched.interruption = error
        except (TypeError, OverflowError, AssertionError) as error:
            # Some values are first used in training.
            raise ValueError(f"{self._where}: training failed: {_described(error)}") from error
        except DivergenceError as error:
            raise DivergenceError(f"{self._where}: {with_checkpoint(error, model)}") from error
        except ValueError as error:
            # Others as well, those of the router above all, which is made then.
            if str(self.config) in str(error):
                raise
            raise ValueError(f"{self._where}: {error}") from error
        finally:
            self.callbacks = callbacks
        if watched.interruption is not None:
            raise Interruption((), self._how_to_continue(model)) from watched.interruption

    def _how_to_continue(self, model: BaseAlgorithm) -> tuple[str, ...]:
        """:return: Arguments that continue an interrupted run; without ``ITSCallback``, its state is saved for that"""
        its = self.its
        if its is None and model.num_timesteps > 0 and distributed.is_main():
            save_atomically(model, Path(self.save_path) / f"rl_model_{model.num_timesteps}_steps.zip")
            if self.normalize and (statistics := model.get_vec_normalize_env()) is not None:
                statistics.save(f"{self.params_path}/vecnormalize.pkl")
        checkpoint = newest_checkpoint(Path(self.save_path))
        if checkpoint is None:
            return ()
        # ITS ends after its epochs, unless it was given fewer steps; SB3 counts from 0 again.
        remaining = max(int(self.n_timesteps) - steps_of(checkpoint), 1)
        return ("-i", str(checkpoint), *(() if its is not None and its.share == 1 else ("-n", str(remaining))))

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        require_finite_model(model, self.save_path)
        if distributed.is_main():
            require_folder(Path(self.params_path))
            super().save_trained_model(Watched(model))  # type: ignore[arg-type]

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        env = super().create_envs(n_envs, eval_env, no_log or not distributed.is_main())
        if eval_env:
            env.seed(self.seed + EVALUATION_SEED)
        return env

    # https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L443
    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if self.continue_training:
            env = gym.spec(self.env_name.gym_id).make(**(hyperparams.get("env_kwargs") or self.env_kwargs or {}))
            env_spaces = (env.observation_space, env.action_space)
            env.close()
            callbacks, algorithm = hyperparams.get("callback"), rl_zoo3.ALGOS[self.algo]
            self._weights = weights_to_start_from(Path(self.trained_agent), algorithm, *env_spaces, callbacks)
            if self._weights is not None:
                hyperparams = start_from(self._weights, hyperparams)
        try:
            processed = super()._preprocess_hyperparams(hyperparams)
        except TypeError as error:
            raise ValueError(f"{self._where}: an argument of 'callback' does not fit: {error}") from error
        if not isinstance(hyperparams.get("policy_kwargs") or {}, dict):
            raise ValueError(f"{self._where}: policy_kwargs is {hyperparams['policy_kwargs']!r}; write a mapping.")
        if not self._eval_env_kwargs_given:
            self.eval_env_kwargs = self.env_kwargs
        self._choose_info_keywords()
        if not self.eval_freq_given:
            self._choose_eval_freq(hyperparams, processed[2])
        return processed

    def _choose_info_keywords(self) -> None:
        """
        Log in the monitor files what rl_zoo3 logs of robots: whether an episode was a success.

        https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L697
        """
        given = self.monitor_kwargs.get("info_keywords")
        if given is not None:
            # Monitor joins it to a tuple.
            self.monitor_kwargs = {**self.monitor_kwargs, "info_keywords": tuple(given)}
        elif all(has_success(self.env_name.gym_id, kwargs) for kwargs in (self.env_kwargs, self.eval_env_kwargs)):
            self.monitor_kwargs = {**self.monitor_kwargs, "info_keywords": ("is_success",)}

    def _choose_eval_freq(self, hyperparams: dict[str, Any], callbacks: list[BaseCallback]) -> None:
        """
        Evaluate as the YAML entry suggests.

        :param hyperparams: Hyperparameters of the algorithm
        :param callbacks: Callbacks of the entry
        """
        n_tasks = {**gym.spec(self.env_name.gym_id).kwargs, **self.env_kwargs}.get("n_tasks")
        if any(isinstance(callback, FixedSetEvalCallback) for callback in callbacks):
            # It replaces rl_zoo3's EvalCallback, with more than a few random episodes.
            self.eval_freq = -1
        elif n_tasks and "instances_per_epoch" in hyperparams:
            self.eval_freq = hyperparams["instances_per_epoch"] * hyperparams.get("n_samples", 1) * n_tasks

    # https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L401
    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        for key in ("learning_rate", "clip_range", "clip_range_vf", "delta_std", "ent_coef"):
            if isinstance(hyperparams.get(key), str):
                hyperparams[key] = parse_schedule(key, hyperparams[key])
        return hyperparams

    def create_log_folder(self) -> None:
        # The first of several processes chooses and makes it.
        self.save_path = distributed.on_main(self._make_log_folder)
        self.params_path = f"{self.save_path}/{self.env_name}"

    def _make_log_folder(self) -> str:
        if self.continue_training:
            remove_leftovers_of(Path(self.trained_agent))
        # As rl_zoo3 writes it, whose numbers two runs can get at the same moment.
        self.save_path = os.path.join(self.log_path, make_run_folder(Path(self.save_path)).name)
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()
        return self.save_path

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        if distributed.is_main():
            super()._save_config(saved_hyperparams)

    def create_callbacks(self) -> None:
        super().create_callbacks()
        # Before what saves files, but not in the place of the progress bar, whose end rl_zoo3 calls.
        saves = bool(self.callbacks) and isinstance(self.callbacks[0], EventCallback | CheckpointCallback)
        self.callbacks.insert(0 if saves else 1, StopAtDivergence())
        if distributed.is_main():
            self.callbacks.insert(0 if saves else 1, RunFolderGuard(Path(self.params_path)))
        self.callbacks = [
            PairCheckpointCallback.of(callback) if type(callback) is CheckpointCallback else callback
            for callback in self.callbacks
        ]
        for callback in self.callbacks:
            if isinstance(callback, ITSCallback):
                callback.save_path = callback.save_path or Path(self.save_path)
                if self.continue_training and self._weights is None and callback.resume_from is None:
                    callback.resume_from = find_checkpoint(Path(self.trained_agent))

    # https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L679
    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self._weights is None:
            return super()._load_pretrained_agent(hyperparams, env)
        rewards = "" if self._weights.router is None else f" and the router {self._weights.router}"
        print(f"Starting a new run with the weights of {self._weights.zip_file}{rewards}")
        settings = {key: value for key, value in hyperparams.items() if key not in ("policy", "policy_kwargs")}
        settings |= dict(seed=self.seed, tensorboard_log=self.tensorboard_log, verbose=self.verbose, device=self.device)
        algorithm: Any = rl_zoo3.ALGOS[self.algo]
        return load(self._weights.zip_file, env, algorithm, **settings)

    def hyperparameters_optimization(self) -> None:
        given = self.specified_callbacks or []
        kept = [entry for entry in (given if isinstance(given, list) else [given]) if not _is_fixed_set_evaluation(entry)]
        # By name, so that every trial gets its own instance.
        self.specified_callbacks = [*kept, f"{StopWhenDiverged.__module__}.{StopWhenDiverged.__name__}"]
        try:
            with shared_studies(), continued_by(()), interruptible_studies():
                super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise ValueError("-optimize: all trials were pruned, there is no best one; allow more trials.") from error

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        if self.storage is None:
            return super()._create_sampler(sampler_method)

        def make(seed: int) -> optuna.samplers.BaseSampler:
            # A copy, because several trials may begin at once.
            stand_in = copy(self)
            stand_in.seed = seed
            return super(UAVExperimentManager, stand_in)._create_sampler(sampler_method)

        return SeedPerTrial(make, self.seed)

    def objective(self, trial: optuna.Trial) -> float:
        note_worker(trial)
        fail_trials_of_dead_workers(trial.study)
        try:
            mean_reward = super().objective(trial)
        except (RuntimeError, FloatingPointError) as error:
            # rl_zoo3 treats ValueError and AssertionError in training as divergence; torch raises these errors too.
            raise optuna.exceptions.TrialPruned(str(error)) from error
        except _SETUP_ERRORS as error:
            raise ValueError(f"{self._where}: {_described(error)}") from error
        if not math.isfinite(mean_reward):
            raise optuna.exceptions.TrialPruned(f"the mean reward is {mean_reward}")
        return mean_reward

    @property
    def its(self) -> ITSCallback | None:
        """The interactive training strategy of this run, if it has one."""
        found = [callback for callback in self.callbacks if isinstance(callback, ITSCallback)]
        return found[0] if found else None


def _described(error: Exception) -> str:
    """The message of an error, with its type where the text alone is unclear."""
    clear = isinstance(error, TypeError | AssertionError | ImportError) and str(error)
    return str(error) if clear else f"{type(error).__name__}: {error}"


def _is_fixed_set_evaluation(entry: Any) -> bool:
    """
    :param entry: An item of a YAML's ``callback`` list: a dotted name, or a mapping from it to arguments
    :return: Whether it is a :class:`~sb3_uav.training.FixedSetEvalCallback`, which trials do not need
    """
    name = next(iter(entry)) if isinstance(entry, dict) else entry
    return str(name).rpartition(".")[2] == FixedSetEvalCallback.__name__
