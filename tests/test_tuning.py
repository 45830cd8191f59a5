"""`-optimize` with our search spaces: what they draw, what trials do with it, and the reports that they leave."""

import csv
import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv
from sb3_uav.policies import RouterPolicy

pytest.importorskip("rl_zoo3")
import optuna
import rl_zoo3
import rl_zoo3.exp_manager
from rl_zoo3.callbacks import TrialEvalCallback
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER, sample_ppo_params

from sb3_uav.zoo import train
from sb3_uav.zoo.experiment import _OUR_ALGORITHMS
from sb3_uav.zoo.tuning import _OTHER_SPACES, _OUR_SPACES, problem_env_class, register_search_spaces

ROUTING, ALLOCATION = "RoutePlanning-N20-v0", "TaskAllocation-U3-N20-v0"
NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
ALGORITHMS = {**rl_zoo3.ALGOS, **_OUR_ALGORITHMS}


def draw(algo: str, seed: int) -> tuple[optuna.Trial, dict[str, Any]]:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    trial = study.ask()
    return trial, _OUR_SPACES[algo][0](trial, 0, 4, {})


@pytest.mark.parametrize("algo", sorted(_OUR_SPACES))
def test_spaces_leave_network_and_rollout_alone(algo):
    accepted = set(inspect.signature(ALGORITHMS[algo]).parameters)
    for seed in range(20):
        trial, hyperparams = draw(algo, seed)
        assert set(hyperparams) <= accepted - {"policy", "policy_kwargs", "gamma", "n_steps", "n_envs"}
        assert {"learning_rate", "max_grad_norm", "ent_coef"} < set(hyperparams)
        # What --trial-id will make of the same trial.
        assert _OUR_SPACES[algo][1](trial.params) == hyperparams
        assert 1e-4 <= hyperparams["learning_rate"] <= 5e-3 and 1e-5 <= hyperparams["ent_coef"] <= 0.03
        assert hyperparams.get("batch_size", 256) in [2**power for power in range(8, 14)]
        assert hyperparams.get("gae_lambda", 1.0) >= 0.9 and hyperparams.get("n_samples", 2) in (2, 4, 8, 16)


@pytest.mark.parametrize("algo", sorted(_OUR_SPACES))
def test_every_draw_makes_an_algorithm(algo):
    env = BatchedVecEnv([lambda: RoutePlanningEnv(5)] * 2)
    for seed in range(8):
        # With arguments of a baseline, which do not go with another one.
        given = dict(baseline_kwargs={"alpha": 0.1}) if algo == "reinforce" else dict(n_steps=5)
        # A2C writes into policy_kwargs.
        model = ALGORITHMS[algo](RouterPolicy, env, policy_kwargs=dict(NETWORK), **{**given, **draw(algo, seed)[1]})
        assert model.policy_kwargs["embed_dim"] == 8


class Narrower(RoutePlanningEnv):
    """A user's own environment of our kind."""


def test_other_environments_keep_the_spaces_of_rl_zoo3():
    if "Narrower-v0" not in gym.registry:
        gym.register("Narrower-v0", entry_point=f"{__name__}:Narrower")
    assert all(problem_env_class(env_id) for env_id in (ROUTING, ALLOCATION, "Narrower-v0"))
    assert problem_env_class("CartPole-v1") is None
    register_search_spaces("CartPole-v1")
    assert HYPERPARAMS_SAMPLER["ppo"] is sample_ppo_params is HYPERPARAMS_SAMPLER["ppo_mask"]
    register_search_spaces(ROUTING)
    assert HYPERPARAMS_SAMPLER["ppo"] is _OUR_SPACES["ppo"][0] and HYPERPARAMS_CONVERTER["ppo"] is _OUR_SPACES["ppo"][1]
    assert _OTHER_SPACES.keys() == _OUR_SPACES.keys() <= HYPERPARAMS_SAMPLER.keys()


# ------------------------------------------------------------------------------------------ trials


class Poison(BaseCallback):
    """Breaks the parameters of some trials in the middle of their training, as a divergence does."""

    trials = 0
    broken: tuple[int, ...] = ()

    def _on_training_start(self) -> None:
        type(self).trials += 1

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if type(self).trials in self.broken:
            next(iter(self.model.policy.parameters())).data.fill_(np.nan)


class Spy(TrialEvalCallback):
    """Notes the illegal actions and returns of all evaluations."""

    illegal: list[int]
    means: list[float]

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        self.illegal.append(locals_["info"]["illegal_actions"])
        super()._log_success_callback(locals_, globals_)

    def _on_step(self) -> bool:
        n_done = len(self.evaluations_results)
        continuing = super()._on_step()
        self.means += [float(np.mean(results)) for results in self.evaluations_results[n_done:]]
        return continuing


@pytest.fixture
def evaluations(monkeypatch: pytest.MonkeyPatch) -> type[Spy]:
    Spy.illegal, Spy.means = [], []
    monkeypatch.setattr(rl_zoo3.exp_manager, "TrialEvalCallback", Spy)
    return Spy


def write_config(folder: Path, algo: str, env_id: str, **changes: Any) -> Path:
    level = "Allocator" if env_id == ALLOCATION else "Router"
    entry: dict[str, Any] = dict(policy=f"sb3_uav.policies.{level}Policy", policy_kwargs=NETWORK, n_envs=4, n_timesteps=320)
    entry.update(dict(n_steps=20, gamma=1.0) if algo != "reinforce" else dict(instances_per_epoch=8, baseline_kwargs=None))
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump({env_id: {**entry, **changes}}))
    return path


def optimize(folder: Path, algo: str, env_id: str, config: Path, *flags: str) -> int:
    return train.main(
        [
            *("--algo", algo, "--env", env_id, "--conf-file", str(config), "-f", str(folder / "logs"), "--seed", "1"),
            *("-optimize", "--n-trials", "2", "--pruner", "none", "--sampler", "random", "--n-evaluations", "2"),
            *("--eval-episodes", "4", "--no-optim-plots", "--optimization-log-path", str(folder / "trials"), *flags),
        ]
    )


def report(folder: Path, algo: str, env_id: str) -> list[dict[str, str]]:
    (path,) = (folder / "logs" / algo).glob(f"report_{env_id}_2-trials-320-random-none_*.csv")
    assert path.with_suffix(".pkl").stat().st_size > 0
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["reinforce", "ppo", "ppo_mask"])
def test_report_of_two_trials(tmp_path, evaluations, algo):
    """Where rl_zoo3 puts it; the trials had the network of the YAML, and played no illegal action."""
    fixed_set = {"sb3_uav.training.FixedSetEvalCallback": dict(n_instances=4, n_samples=0)}
    config = write_config(tmp_path, algo, ROUTING, callback=[fixed_set])
    assert optimize(tmp_path, algo, ROUTING, config) == 0
    trials = report(tmp_path, algo, ROUTING)
    assert [trial["state"] for trial in trials] == ["COMPLETE", "COMPLETE"]
    assert {f"params_{name}" for name in ("learning_rate", "ent_coef", "max_grad_norm")} < set(trials[0])
    assert trials[0]["params_learning_rate"] != trials[1]["params_learning_rate"]
    for number, trial in enumerate(trials):
        folder = tmp_path / "trials" / f"trial_{number}"
        model: Any = ALGORITHMS[algo].load(folder / "best_model.zip", device="cpu")
        assert model.policy_kwargs == NETWORK and model.gamma == 1.0
        assert model.learning_rate == pytest.approx(float(trial["params_learning_rate"]))
        results = np.load(folder / "evaluations.npz")
        # The mean of the last evaluation, of fractions that are exact.
        assert float(trial["value"]) == results["results"][-1].mean()
        # Whole epochs of 8 instances are played. How long their episodes are depends on rounding: one evaluation more may fit.
        n_evaluations, n_episodes = results["results"].shape
        assert n_evaluations in (2, 3) and n_episodes == 4
        # Our own evaluation is for the final training.
        assert "sampled" not in results
    assert len(evaluations.illegal) >= 2 * 2 * 4 * 2 and not any(evaluations.illegal)
    # A masked policy visits all that it can reach; one that is not soon flies where it must not, and home.
    assert np.mean(evaluations.means) > 2.5


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["reinforce", "ppo"])
def test_both_levels_in_a_trial(tmp_path, evaluations, algo):
    settings = dict(n_steps=20, batch_size=40) if algo == "ppo" else {}
    router = dict(algo=algo, policy="RouterPolicy", n_envs=4, policy_kwargs=NETWORK, **settings)
    its = dict(router=router, n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=1, n_continuous_epochs=1)
    if algo == "ppo":
        its["instances_per_epoch"] = 8
    config = write_config(tmp_path, algo, ALLOCATION, callback=[{"sb3_uav.training.ITSCallback": its}])
    assert optimize(tmp_path, algo, ALLOCATION, config) == 0
    for number, trial in enumerate(report(tmp_path, algo, ALLOCATION)):
        assert trial["state"] == "COMPLETE" and 0 < float(trial["value"]) <= 20
        names = {path.name for path in (tmp_path / "trials" / f"trial_{number}").iterdir()}
        assert {"best_model.zip", "best_router.zip", "router.zip", "its_log.csv"} <= names
    assert not any(evaluations.illegal)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "message"),
    [
        ("reinforce", "The weight features_extractor.encoder.embed_depot.weight is nan in update 1"),
        ("ppo", "The score of an action is nan"),
    ],
)
def test_a_trial_that_diverges_is_pruned(tmp_path, monkeypatch, capsys, algo, message):
    config = write_config(tmp_path, algo, ROUTING, callback=f"{__name__}.Poison")
    monkeypatch.setattr(Poison, "trials", 0)
    monkeypatch.setattr(Poison, "broken", (1,))
    assert optimize(tmp_path, algo, ROUTING, config) == 0
    assert [trial["state"] for trial in report(tmp_path, algo, ROUTING)] == ["PRUNED", "COMPLETE"]
    assert message in capsys.readouterr().out
    monkeypatch.setattr(Poison, "broken", (3, 4))
    assert optimize(tmp_path, algo, ROUTING, config) == 2
    assert "all trials were pruned, there is no best one" in capsys.readouterr().err


@pytest.mark.slow
def test_a_trial_can_be_trained(tmp_path):
    """`--trial-id` takes its hyperparameters, and the network of the YAML."""
    config = write_config(tmp_path, "ppo", ROUTING)
    study = ["--storage", str(tmp_path / "study.log"), "--study-name", "tuning"]
    assert optimize(tmp_path, "ppo", ROUTING, config, *study) == 0
    trial = report(tmp_path, "ppo", ROUTING)[1]
    arguments = ["--algo", "ppo", "--env", ROUTING, "--conf-file", str(config), "-f", str(tmp_path / "logs"), "-n", "80"]
    assert train.main([*arguments, *study, "--trial-id", "1", "--eval-freq", "-1"]) == 0
    model = PPO.load(tmp_path / "logs" / "ppo" / f"{ROUTING}_2" / f"{ROUTING}.zip")
    assert model.batch_size == 2 ** int(trial["params_batch_size_pow"]) == int(float(trial["user_attrs_batch_size"]))
    assert model.vf_coef == pytest.approx(float(trial["params_vf_coef"])) and model.policy_kwargs == NETWORK


@pytest.mark.slow
def test_mistakes_in_the_yaml_stop_the_study(tmp_path, capsys):
    config = write_config(tmp_path, "ppo", ROUTING, policy_kwargs=dict(embed_dims=8))
    assert optimize(tmp_path, "ppo", ROUTING, config) == 2
    error = capsys.readouterr().err
    assert "embed_dims" in error and "tiny.yml" in error


@pytest.mark.slow
def test_reinforce_is_tuned_on_other_environments(tmp_path):
    config = tmp_path / "tiny.yml"
    config.write_text(yaml.safe_dump({"CartPole-v1": dict(policy="MlpPolicy", n_envs=2, n_timesteps=320)}))
    assert optimize(tmp_path, "reinforce", "CartPole-v1", config) == 0
    trials = report(tmp_path, "reinforce", "CartPole-v1")
    assert {trial["params_baseline"] for trial in trials} <= {"exponential", "critic"} and "params_n_steps_pow" in trials[0]
