"""Numbers that are not finite stop every training, name their cause, and reach no file."""

import math
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from its_runs import SMALL, learn, make_allocator, make_env, make_its
from reinforce_models import make_env as make_level_env
from reinforce_models import make_model
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_uav.common.divergence import DivergenceError, last_saved
from sb3_uav.common.saving import save_atomically
from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.training import FixedSetEvalCallback, StopAtDivergence
from sb3_uav.training.best_pair import BestPair
from sb3_uav.training.imitation import imitate
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER
from sb3_uav.training.kept_checkpoints import STATE_FILE
from sb3_uav.zoo.checkpoints import PairCheckpointCallback

pytestmark = pytest.mark.filterwarnings("ignore:.*has grown to", "ignore:.*saves no router", "ignore:.*saves nothing")
ALLOCATOR: Any = AllocatorPolicy
ROUTER: Any = RouterPolicy


def stepped() -> dict[str, Any]:
    # New ones each time, because A2C writes into its policy_kwargs.
    return dict(n_steps=8, seed=0, device="cpu", policy_kwargs=dict(SMALL))


def assert_finite(model: Any) -> None:
    for name, value in model.policy.state_dict().items():
        assert th.isfinite(value).all(), name


def spoil(model: Any, value: float = math.nan) -> None:
    with th.no_grad():
        next(model.policy.parameters()).view(-1)[0] = value


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ------------------------------------------------------------------------------------------ what stops a training


@pytest.mark.parametrize(("field", "name"), [("returns", "return"), ("_baseline", "baseline")])
def test_reinforce_names_level_quantity_and_update(field, name, monkeypatch):
    model = make_model("router").learn_instances(4)
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    if name == "return":
        monkeypatch.setattr(type(model.problem), "returns", lambda self, instances, actions: th.full((4, 3), math.inf))
    else:
        monkeypatch.setattr(model._baseline, "of_episodes", lambda problem, instances, returns: returns * math.nan)
    message = rf"^router: The {name} is (nan|inf) in update 2, after \d+ steps; this update was not applied. No checkpoint"
    with pytest.raises(DivergenceError, match=message):
        model.learn_instances(4)
    assert all(th.equal(value, before[key]) for key, value in model.policy.state_dict().items())


@pytest.mark.parametrize("algorithm", [PPO, A2C, MaskablePPO])
@pytest.mark.parametrize("level", ["router", "allocator"])
def test_stock_algorithms_stop_before_the_update(algorithm, level):
    policy = RouterPolicy if level == "router" else AllocatorPolicy
    model = algorithm(policy, make_level_env(level), **stepped())
    hook = lambda gradient: gradient * math.nan  # noqa: E731
    model.policy.value_net.weight.register_hook(hook)
    with pytest.raises(
        DivergenceError, match=rf"^{level}: The gradient norm is nan in update 1, after 32 steps; .*not applied"
    ):
        model.learn(100, StopAtDivergence())
    assert_finite(model)


class BadReward(gym.Wrapper):
    """CartPole with one reward that is not a number."""

    def step(self, action: Any) -> Any:
        observation, _, *others = self.env.step(action)
        return observation, math.nan, *others


@pytest.mark.parametrize("normalize", [False, True])
def test_rewards_of_any_environment_are_checked_before_statistics_are_saved(normalize, tmp_path):
    env: Any = DummyVecEnv([lambda: BadReward(gym.make("CartPole-v1"))])
    env = VecNormalize(env) if normalize else env
    model = A2C("MlpPolicy", env, n_steps=4, device="cpu")
    with pytest.raises(DivergenceError, match=r"ActorCriticPolicy|A2C: The reward is nan in update 1, after 1 steps"):
        model.learn(100, [StopAtDivergence(), PairCheckpointCallback(1, str(tmp_path), save_vecnormalize=True)])
    assert not list(tmp_path.iterdir())


def test_without_the_callback_the_reward_behind_a_gradient_is_found():
    from sb3_uav.reinforce.finite import watch

    model = A2C("MlpPolicy", DummyVecEnv([lambda: BadReward(gym.make("CartPole-v1"))]), n_steps=4, device="cpu")
    watch(model)
    with pytest.raises(DivergenceError, match=r"The reward is nan in update 1, after 4 steps; .*train with finite rewards"):
        model.learn(100)
    assert_finite(model)


class BadGenerator:
    """Uniform instances, from some call on with a number that is not finite."""

    def __init__(self, first_bad: int, field: str = "tasks") -> None:
        self.good = UniformGenerator(5, 2)
        self.n_tasks, self.n_uavs, self.left, self.field = 5, 2, first_bad, field

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Any:
        instances = self.good(batch_size, rng)
        self.left -= 1
        if self.left < 0:
            getattr(instances, self.field).view(-1)[-1] = math.inf
        return instances


@pytest.mark.parametrize("field", ["tasks", "values", "max_distance", "depot"])
@pytest.mark.parametrize("algorithm", ["reinforce", "ppo"])
def test_an_instance_that_is_not_finite_stops_the_training(field, algorithm):
    env: Any = make_env()
    model: Any = make_allocator(baseline="none") if algorithm == "reinforce" else PPO(ALLOCATOR, env, **stepped())
    model.env.env_method("set_generator", BadGenerator(7, field))
    message = rf"BadGenerator drew an instance whose field '{field}' holds inf at index \(.*mend the generator"
    with pytest.raises(ValueError, match=message):
        model.learn(10_000)
    assert_finite(model)


def test_imitation_stops_and_keeps_its_progress(tmp_path):
    router = make_model("router").policy
    allocator = make_model("allocator").policy
    arguments: dict[str, Any] = dict(n_subsets=8, n_updates=6, batch_size=4)
    message = r"^router: The (imitation loss|weight .*|gradient norm of the imitation) is (nan|-?inf) in update \d; .*smaller"
    with pytest.raises(DivergenceError, match=message):
        imitate(router, allocator, UniformGenerator(5, 2), np.random.default_rng(0), **arguments, learning_rate=1e34)
    router = make_model("router").policy
    next(router.parameters()).register_hook(lambda gradient: gradient * math.nan)
    with pytest.raises(DivergenceError, match=rf"gradient norm of the imitation is nan in update 1; .*{tmp_path.name}"):
        imitate(router, allocator, UniformGenerator(5, 2), np.random.default_rng(0), **arguments, folder=tmp_path)
    assert all(th.isfinite(parameter).all() for parameter in router.parameters())
    assert not (tmp_path / "updates.pt").exists()


# ------------------------------------------------------------------------------------------ both levels


def bad_start(router: Any, allocator: Any, generator: Any, rng: Any) -> None:
    with th.no_grad():
        next(router.parameters()).fill_(math.nan)


@pytest.mark.parametrize("algo", ["reinforce", "ppo", "a2c", "ppo_mask"])
def test_a_router_that_diverges_leaves_the_last_checkpoint(algo, tmp_path):
    """The second epoch of pre-training begins with a good router and ends with an error; nothing is overwritten."""
    saved: dict[str, bytes] = {}

    class Sabotage(BaseCallback):
        def _on_step(self) -> bool:
            return True

    settings: dict[str, Any] = dict(algo=algo) if algo == "reinforce" else dict(algo=algo, n_steps=8)
    its = make_its(settings, save_path=str(tmp_path), n_pretraining_epochs=3)
    record = its._record

    def after_first(level: str, *args: Any) -> None:
        record(level, *args)
        if len(its.records) == 2:
            saved.update(contents(tmp_path / CHECKPOINT_FOLDER))
            its.router.policy.value_net.weight.register_hook(lambda gradient: gradient * math.nan)
            parameter = next(p for p in its.router.policy.features_extractor.parameters())
            parameter.register_hook(lambda gradient: gradient * math.nan)

    its._record = after_first
    message = rf"^Router epoch \d \(pre-training\), router: The gradient norm is nan .* is {tmp_path}.*allocator_0.zip"
    with pytest.raises(DivergenceError, match=message):
        learn(make_allocator(), its, Sabotage())
    assert saved and STATE_FILE in saved
    now = contents(tmp_path / CHECKPOINT_FOLDER)
    assert {name: now[name] for name in saved if name.startswith("router")} == {
        name: content for name, content in saved.items() if name.startswith("router")
    }
    before = (tmp_path / "router.zip").read_bytes()
    its.on_training_end()
    assert (tmp_path / "router.zip").read_bytes() == before
    assert_finite(its.router)


def test_a_warm_start_of_the_user_cannot_spoil_files(tmp_path):
    its = make_its(save_path=str(tmp_path), warm_start={f"{__name__}.bad_start": {}})
    with pytest.raises(DivergenceError, match="holds nan"):
        learn(make_allocator(), its)
    assert sorted(contents(tmp_path / CHECKPOINT_FOLDER)) == ["allocator_0.zip", STATE_FILE, "router_start.zip"]


def test_the_error_of_the_allocator_names_the_checkpoint_of_both(tmp_path):
    class Spoil(BaseCallback):
        def _on_rollout_end(self) -> None:
            algorithm: Any = self.model
            if algorithm.n_instances >= 16:
                algorithm.policy.features_extractor.scorer.score.weight.register_hook(lambda gradient: gradient * math.nan)

        def _on_step(self) -> bool:
            return True

    its = make_its(save_path=str(tmp_path))
    fixed = FixedSetEvalCallback(n_instances=4, n_samples=0, save_path=tmp_path)
    with pytest.raises(
        DivergenceError, match=r"^allocator: The gradient norm is nan in update 5.*its_checkpoint/allocator_2.zip"
    ):
        learn(make_allocator(), its, fixed, Spoil())
    assert last_saved(its.model) == tmp_path / CHECKPOINT_FOLDER / "allocator_2.zip"


# ------------------------------------------------------------------------------------------ files


@pytest.mark.parametrize("part", ["weight", "optimizer", "rate"])
@pytest.mark.parametrize("save", ["save", "save_atomically", "best_pair", "save_freq", "router_of_best_pair"])
def test_no_file_is_replaced_by_numbers_that_are_not_finite(part, save, tmp_path):
    model = make_model("router").learn_instances(4)
    other = make_model("allocator")
    writers: dict[str, Any] = {
        "save": lambda: model.save(tmp_path / "model"),
        "save_atomically": lambda: save_atomically(model, tmp_path / "model.zip"),
        "best_pair": lambda: BestPair(tmp_path).save(model, None),
        "router_of_best_pair": lambda: BestPair(tmp_path).save(other, model),
        "save_freq": lambda: PairCheckpointCallback(1, str(tmp_path)).init_callback(model),
    }

    def write() -> None:
        if save == "save_freq":
            callback = PairCheckpointCallback(1, str(tmp_path))
            callback.init_callback(model)
            callback.update_locals({"callback": None})
            callback.on_step()
        else:
            writers[save]()

    write()
    before = contents(tmp_path)
    if part == "weight":
        spoil(model)
    elif part == "optimizer":
        next(iter(model.policy.optimizer.state.values()))["exp_avg_sq"].view(-1)[0] = math.inf
    else:
        model.policy.optimizer.param_groups[0]["lr"] = math.inf
    with pytest.raises(DivergenceError, match=r"was not written.*holds (nan|inf) after \d+ steps"):
        write()
    assert before and contents(tmp_path) == before


def test_weights_that_explode_are_reported_once():
    model = make_model("router", learning_rate=2e3)
    with pytest.warns(
        UserWarning, match=r"^router: The weight .* has grown to \d\S* after \d+ steps, more than 1000"
    ) as found:
        model.learn_instances(8)
    assert len([w for w in found if "has grown" in str(w.message)]) == 1
    assert model.logger.name_to_value["train/max_weight"] > 1000
    stock = A2C("MlpPolicy", "CartPole-v1", learning_rate=1e5, n_steps=4, device="cpu")
    with pytest.warns(UserWarning, match="ActorCriticPolicy|A2C: The weight"):
        stock.learn(8, StopAtDivergence())


def test_a_weight_that_overflows_stops_and_is_not_saved(tmp_path):
    network = dict(SMALL, optimizer_class=th.optim.SGD, optimizer_kwargs={})
    model = make_model("router", learning_rate=1e34, max_grad_norm=1e9, normalize_advantage=True, policy_kwargs=network)
    next(model.policy.parameters()).register_hook(lambda gradient: gradient + 1e8)
    with pytest.raises(DivergenceError, match=r"^router: The weight .* is inf in update 1.*no file holds these weights"):
        model.learn_instances(12)
    with pytest.raises(DivergenceError, match="was not written"):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rate", [1e39, math.inf])
def test_an_impossible_learning_rate_has_a_message(rate):
    for learn_once in (
        lambda: make_model("router", learning_rate=rate).learn_instances(4),
        lambda: A2C("MlpPolicy", "CartPole-v1", learning_rate=rate, n_steps=4, device="cpu").learn(8, StopAtDivergence()),
    ):
        with pytest.raises(DivergenceError, match=rf"The learning rate is {re.escape(str(rate))} in update 1, .*not applied"):
            learn_once()


def test_ordinary_training_is_neither_stopped_nor_warned(recwarn):
    env = BatchedVecEnv([lambda: TaskAllocationEnv(5, 2)] * 4)
    PPO(ALLOCATOR, env, **stepped()).learn(64, StopAtDivergence())
    PPO(ROUTER, BatchedVecEnv([lambda: RoutePlanningEnv(5)] * 4), **stepped()).learn(64, StopAtDivergence())
    assert not [warning for warning in recwarn if "grown" in str(warning.message)]
