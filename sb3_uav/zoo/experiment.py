"""rl_zoo3 with our algorithms, environments and YAMLs."""

from __future__ import annotations

import difflib
import inspect
import math
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

try:
    import optuna
    import rl_zoo3
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
except ImportError as error:
    raise ImportError(f"Training from YAML needs rl_zoo3 ({error}); run: pip install 'sb3-uav[zoo]'") from error

from sb3_contrib import MaskablePPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_uav
from sb3_uav.common.random_streams import EVALUATION_SEED
from sb3_uav.envs.vec_env import BatchedVecEnv, unwrap_problem_env
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, STATE_FILE
from sb3_uav.zoo.tuning import StopWhenDiverged, register_search_spaces

OUR_ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"reinforce": REINFORCE, "ppo_mask": MaskablePPO}
# What rl_zoo3 takes out of a YAML entry before the rest goes to the algorithm (rl_zoo3/exp_manager.py).
ZOO_KEYS = {
    "n_envs",
    "n_timesteps",
    "normalize",
    "env_wrapper",
    "vec_env_wrapper",
    "callback",
    "env_kwargs",
    "monitor_kwargs",
    "frame_stack",
    "noise_type",
    "noise_std",
}


def register_algorithms() -> None:
    """Make our algorithms known to rl_zoo3; train, enjoy and the experiment manager share this dict."""
    rl_zoo3.ALGOS.update(OUR_ALGORITHMS)


def default_config(algo: str, env_id: str | None = None) -> Path | None:
    """
    :param algo: Name of an algorithm
    :param env_id: What to train on
    :return: Our YAML for it, from the installed package or from the source checkout; None if we ship none, or if rl_zoo3 has
        one and ours does not know this environment
    """
    package = Path(sb3_uav.__file__).parent
    candidates = (folder / "zoo_configs" / f"{algo}.yml" for folder in (package, package.parent))
    ours = next((path for path in candidates if path.is_file()), None)
    theirs = Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
    if ours is not None and env_id is not None and theirs.is_file() and env_id not in yaml.safe_load(ours.read_text()):
        return None
    return ours


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
    rl_zoo3's experiment manager, with our vectorized environment and without these traps of rl_zoo3 2.9.2:

    - ``env_kwargs`` of a YAML reach the evaluation environment too;
    - ``const_X`` is a constant, and numbers that YAML reads as strings (``1e-3``) are numbers;
    - a misspelled key is named, with the nearest known one;
    - the evaluation environment is not seeded like the training environment, whose instances it would get;
    - ``-optimize`` has search spaces that keep the network and whole episodes (:mod:`sb3_uav.zoo.tuning`), and prunes a trial
      that diverges, however it does.
    """

    # Whether the command line says how often to evaluate; if not, FixedSetEvalCallback decides, and without it, it is done
    # once per epoch where there are epochs.
    eval_freq_given = False

    def __init__(self, args: Any, *positional: Any, **kwargs: Any) -> None:
        super().__init__(args, *positional, **kwargs)
        if kwargs.get("vec_env_type", "dummy") == "dummy":
            self.vec_env_class = make_batched_vec_env  # type: ignore[assignment]
        register_search_spaces(self.env_name.gym_id)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            hyperparams, saved = super().read_hyperparameters()
        except (yaml.YAMLError, FileNotFoundError) as error:
            raise ValueError(f"{self.config}: cannot be read: {error}") from error
        if not isinstance(hyperparams, dict) or "n_timesteps" not in hyperparams:
            raise ValueError(f"{self.config}: the entry of {self.env_name.gym_id} needs at least n_timesteps and policy.")
        check_keys(set(hyperparams), rl_zoo3.ALGOS[self.algo], f"{self.config}, {self.env_name.gym_id}")
        return {key: plain_numbers(value) for key, value in hyperparams.items()}, saved

    def setup_experiment(self) -> Any:
        try:
            return super().setup_experiment()
        except (TypeError, AttributeError, AssertionError, ModuleNotFoundError) as error:
            raise ValueError(f"{self.config}, {self.env_name.gym_id}: {error}") from error

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        env = super().create_envs(n_envs, eval_env, no_log)
        if eval_env:
            env.seed(self.seed + EVALUATION_SEED)
        return env

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        try:
            processed = super()._preprocess_hyperparams(hyperparams)
        except TypeError as error:
            raise ValueError(f"{self.config}: an argument of 'callback' does not fit: {error}") from error
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        if not self.eval_freq_given:
            self._choose_eval_freq(hyperparams, processed[2])
        return processed

    def _choose_eval_freq(self, hyperparams: dict[str, Any], callbacks: list[BaseCallback]) -> None:
        """
        Evaluate as the YAML entry suggests.

        :param hyperparams: Of the algorithm
        :param callbacks: Those of the entry
        """
        n_tasks = gym.spec(self.env_name.gym_id).kwargs.get("n_tasks")
        if any(isinstance(callback, FixedSetEvalCallback) for callback in callbacks):
            # It does what rl_zoo3's EvalCallback would do, on more than a few random episodes.
            self.eval_freq = -1
        elif n_tasks and "instances_per_epoch" in hyperparams:
            self.eval_freq = hyperparams["instances_per_epoch"] * hyperparams.get("n_samples", 1) * n_tasks

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        for key in ("learning_rate", "clip_range", "clip_range_vf", "delta_std", "ent_coef"):
            if isinstance(hyperparams.get(key), str):
                hyperparams[key] = parse_schedule(key, hyperparams[key])
        return hyperparams

    def create_callbacks(self) -> None:
        super().create_callbacks()
        for callback in self.callbacks:
            if isinstance(callback, ITSCallback):
                callback.save_path = callback.save_path or Path(self.save_path)
                if self.continue_training and callback.resume_from is None:
                    callback.resume_from = find_checkpoint(Path(self.trained_agent))

    def hyperparameters_optimization(self) -> None:
        given = self.specified_callbacks or []
        kept = [entry for entry in (given if isinstance(given, list) else [given]) if not is_fixed_set_evaluation(entry)]
        # By name, so that every trial gets an instance of its own.
        self.specified_callbacks = [*kept, f"{StopWhenDiverged.__module__}.{StopWhenDiverged.__name__}"]
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise ValueError("-optimize: all trials were pruned, there is no best one; allow more trials.") from error

    def objective(self, trial: optuna.Trial) -> float:
        try:
            mean_reward = super().objective(trial)
        except (RuntimeError, FloatingPointError) as error:
            # rl_zoo3 takes ValueError and AssertionError in training for divergence; torch also raises these.
            raise optuna.exceptions.TrialPruned(str(error)) from error
        except (TypeError, AttributeError, AssertionError, ModuleNotFoundError) as error:
            raise ValueError(f"{self.config}, {self.env_name.gym_id}: {error}") from error
        if not math.isfinite(mean_reward):
            raise optuna.exceptions.TrialPruned(f"the mean reward is {mean_reward}")
        return mean_reward

    @property
    def its(self) -> ITSCallback | None:
        """The interactive training strategy of this run, if it has one."""
        found = [callback for callback in self.callbacks if isinstance(callback, ITSCallback)]
        return found[0] if found else None


def is_fixed_set_evaluation(entry: Any) -> bool:
    """
    :param entry: Of a YAML's ``callback`` list: a dotted name, or a mapping from it to arguments
    :return: Whether it is a :class:`~sb3_uav.training.FixedSetEvalCallback`, which a trial has no use for
    """
    name = next(iter(entry)) if isinstance(entry, dict) else entry
    return str(name).rpartition(".")[2] == FixedSetEvalCallback.__name__


def find_checkpoint(trained_agent: Path) -> Path:
    """
    :param trained_agent: The allocator's zip to go on from
    :return: The folder with the state of its interactive training
    :raises FileNotFoundError: If there is none; the message names the zip to use if there is one near
    """
    beside, below = trained_agent.parent, trained_agent.parent / CHECKPOINT_FOLDER
    if (beside / STATE_FILE).is_file():
        return beside
    if (below / STATE_FILE).is_file():
        return below
    raise FileNotFoundError(f"-i {trained_agent}: neither {beside} nor {below} holds {STATE_FILE}, which knows its router.")


def plain_numbers(value: Any) -> Any:
    """
    :param value: From a YAML file
    :return: The same with numbers for texts such as ``1e-3``, which YAML 1.1 does not take for numbers
    """
    if isinstance(value, dict):
        return {key: plain_numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain_numbers(item) for item in value]
    if isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d*)?[eE][+-]?\d+", value):
        number = float(value)
        return int(number) if number.is_integer() else number
    return value


def check_keys(found: set[str], algorithm: type, where: str) -> None:
    """
    :param found: Keys of a YAML entry
    :param algorithm: The class that gets what rl_zoo3 does not take
    :param where: File and entry, named in the error
    :raises ValueError: On a key that neither knows
    """
    known = ZOO_KEYS | set(inspect.signature(algorithm).parameters) - {"_init_setup_model", "env"}
    for key in sorted(found - known):
        nearest = difflib.get_close_matches(key, known, n=1)
        advice = f"did you mean {nearest[0]!r}?" if nearest else f"known keys: {', '.join(sorted(known))}."
        raise ValueError(f"{where}: unknown key {key!r}; {advice}")


def parse_schedule(key: str, text: str) -> float | LinearSchedule:
    """
    :param key: Name of the hyperparameter
    :param text: ``lin_X``, ``const_X`` or a number
    :return: A linear decay from X to 0, or a number
    :raises ValueError: If it is neither, or a schedule where SB3 takes none
    """
    kind, _, number = text.rpartition("_")
    try:
        value = float(number)
    except ValueError:
        raise ValueError(f"{key} is {text!r}; write a number, lin_X or const_X.") from None
    if kind in ("", "const"):
        return value
    if kind != "lin" or key == "ent_coef":
        raise ValueError(f"{key} is {text!r}; write a number{'' if key == 'ent_coef' else ', lin_X or const_X'}.")
    return LinearSchedule(start=value, end=0.0, end_fraction=1.0)
