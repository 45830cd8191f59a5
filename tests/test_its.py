"""The interactive training strategy: order of the epochs, freezing, both levels, and bad input."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from its_runs import N_TASKS, PAPER, SMALL, equal, learn, make_allocator, make_env, make_its, snapshot, trace
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure

from sb3_uav.envs import UniformGenerator, plan_tours
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.training import Freezer, ITSCallback
from sb3_uav.training.imitation import imitate
from sb3_uav.training.router_trainer import RouterTrainer

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


@pytest.mark.parametrize(("n_uavs", "n_intensive", "n_continuous"), [(4, 8, 4), (6, 12, 6)])
def test_order_of_epochs_is_algorithm_1(n_uavs, n_intensive, n_continuous):
    """U4: 5 + (4 + 4) + 92 router epochs, U6: 5 + (6 + 6) + 88, for 100 allocator epochs."""
    model = make_allocator(n_uavs, instances_per_epoch=4)
    its = make_its(n_epochs=100, n_pretraining_epochs=5, n_intensive_epochs=n_intensive, n_continuous_epochs=n_continuous)
    learn(model, its)
    block = "a" * n_continuous + "i" * n_continuous
    assert trace(its) == "p" * 5 + block * 2 + "at" * (100 - n_intensive)
    router_epochs = [record for record in its.records if record.level == "router"]
    assert [record.epoch for record in router_epochs] == list(range(1, 106))
    assert len(router_epochs) == 5 + 2 * n_continuous + {4: 92, 6: 88}[n_uavs]
    assert model.epoch == 100 and model.n_instances == 400
    assert its.router.n_instances == 105 * 4


@pytest.mark.parametrize(
    ("strategy", "expected"),
    [
        ("its", "pp" + "aaii" * 2 + "atat"),
        ("no-pretraining", "aaii" * 2 + "atat"),
        ("no-intensive", "pp" + "at" * 6),
        ("alternate-only", "at" * 6),
        ("independent", "p" * 8 + "a" * 6),
    ],
)
def test_ablations_are_one_switch(strategy, expected):
    its = make_its(strategy=strategy)
    learn(make_allocator(), its)
    assert trace(its) == expected


def test_stops_early_when_the_steps_are_over():
    """n_timesteps binds too: the epoch that it completes is closed, the rest does not happen."""
    its = make_its()
    with pytest.warns(UserWarning, match=r"This run has 80 of the 240 steps that 6 epochs take: .* cut to 0\.33 of"):
        make_allocator().learn(8 * N_TASKS * 2, callback=its)
    # A third of two epochs of pre-training.
    assert trace(its) == "p" + "aaii"
    assert [record.n_instances for record in its.records] == [8, 8, 8, 8, 8]


def test_steps_bound_warm_start_and_pretraining():
    """A run of a hundredth of the plan pre-trains for a hundredth of it."""
    its = make_its(n_epochs=100, n_pretraining_epochs=50, instances_per_epoch=80, warm_start={f"{__name__}.note_share": {}})
    with pytest.warns(UserWarning, match="cut to 0\\.01 of their length"):
        make_allocator(instances_per_epoch=80).learn(80 * N_TASKS, callback=its)
    assert SHARES == [pytest.approx(0.01)]
    assert trace(its) == "pa" and its.records[0].n_instances == 40


def test_router_epochs_after_a_cut_pretraining_are_whole():
    its = make_its(n_epochs=4, n_pretraining_epochs=1, n_intensive_epochs=0, instances_per_epoch=80)
    with pytest.warns(UserWarning, match=r"cut to 0\.5 of"):
        make_allocator(instances_per_epoch=80).learn(160 * N_TASKS, callback=its)
    assert trace(its) == "p" + "at" * 2
    assert [record.n_instances for record in its.records if record.level == "router"] == [40, 80, 80]


def test_share_of_the_imitation(monkeypatch):
    """The share cuts both the tours and the updates."""
    pytest.importorskip("numba")
    lines: list[str] = []
    router = RouterPolicy(*RouterPolicy.placeholder_spaces(2), lambda _: 0.0, **SMALL)
    allocator = AllocatorPolicy(*AllocatorPolicy.placeholder_spaces(2), lambda _: 0.0, **SMALL)
    generator = UniformGenerator(n_tasks=6, n_uavs=2)
    imitate(router, allocator, generator, np.random.default_rng(0), 400, 300, batch_size=4, report=lines.append, share=0.01)
    assert lines[-1].startswith("imitation: 3 of 3 updates") and " of 4 tours" in lines[0]


SHARES: list[float] = []


def note_share(router, allocator, generator, rng, share):
    """A warm start of a user."""
    SHARES.append(share)


class Watch(BaseCallback):
    """Notes, at every rollout of the allocator, what the router looks like, and the reverse."""

    def __init__(self, its: ITSCallback) -> None:
        super().__init__()
        self.its = its
        self.router_states: list[tuple[int, dict[str, th.Tensor]]] = []

    def _on_rollout_end(self) -> None:
        router = self.its.router.policy
        assert not router.training and not any(p.requires_grad for p in router.parameters())
        assert all(p.requires_grad for p in self.model.policy.parameters())
        self.router_states.append((self.its.epoch, snapshot(router)))

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("network", [SMALL, PAPER])
def test_frozen_models_stay_bit_equal(network, monkeypatch):
    """Parameters and buffers, such as the paper preset's batch statistics, of whichever level does not learn."""
    model = make_allocator(policy_kwargs=network)
    its = make_its()
    its.router_kwargs["policy_kwargs"] = network
    original = ITSCallback._train_on_subsets
    blocks = []

    def train_on_subsets(self, n_epochs, fraction, phase):
        before, router_before = snapshot(model.policy), snapshot(self.router.policy)
        moments = {key: {k: v.clone() for k, v in value.items()} for key, value in model.policy.optimizer.state.items()}
        original(self, n_epochs, fraction, phase)
        assert equal(before, model.policy.state_dict())
        assert not equal(router_before, self.router.policy.state_dict())
        for key, value in moments.items():
            assert all(th.equal(v, model.policy.optimizer.state[key][k]) for k, v in value.items())
        blocks.append(phase)

    monkeypatch.setattr(ITSCallback, "_train_on_subsets", train_on_subsets)
    watch = Watch(its)
    start = snapshot(model.policy)
    learn(model, its, watch)
    assert blocks == ["intensive"] * 2 + ["alternate"] * 2
    assert not equal(start, model.policy.state_dict())
    for epoch, state in watch.router_states:
        assert equal(state, next(other for e, other in watch.router_states if e == epoch))
    states = [state for epoch, state in watch.router_states if epoch in (0, 2)]
    assert not equal(states[0], states[-1])
    if network is PAPER:
        assert any("running_mean" in name for name in start)


def test_freezer_restores_only_what_learned_before():
    policy = make_allocator().policy
    policy.value_net.requires_grad_(False)
    freezer = Freezer(policy)
    freezer.freeze()
    freezer.freeze()
    assert not policy.training and not any(p.requires_grad for p in policy.parameters())
    freezer.thaw()
    assert policy.features_extractor.scorer.score.weight.requires_grad and not policy.value_net.weight.requires_grad


def test_router_epochs_may_have_their_own_size():
    its = make_its(n_epochs=2, n_pretraining_epochs=1, router_instances_per_epoch=12)
    learn(make_allocator(), its)
    sizes = {(record.level, record.n_instances) for record in its.records}
    assert sizes == {("allocator", 8), ("router", 12)}


def test_router_reaches_training_and_evaluation_env():
    env = make_env(2)
    its = make_its(n_epochs=1, n_pretraining_epochs=1)
    model = make_allocator()
    learn(model, its, EvalCallback(env, n_eval_episodes=2, eval_freq=3, verbose=0))
    instances = model.draw_batch(0)
    actions = model.policy.decode_episodes(instances)
    expected = plan_tours(instances, actions, its.router.policy.plan).value
    for vec_env in (model.env, env):
        assert vec_env.problem.router == its.router.policy.plan and vec_env.problem.task_order == "sweep"
        assert th.equal(vec_env.problem.returns(instances, actions), expected)


def test_pretraining_leaves_the_allocator_alone():
    model = make_allocator(policy_kwargs=PAPER)
    start = snapshot(model.policy)
    its = make_its(n_epochs=1, n_pretraining_epochs=2, n_intensive_epochs=2, strategy="independent")
    seed = th.initial_seed()

    class Compare(BaseCallback):
        def _on_training_start(self) -> None:
            assert trace(its) == "pp" and equal(start, self.model.policy.state_dict())
            # Nor is the run's global random state touched by making the router.
            assert th.initial_seed() == seed

        def _on_step(self) -> bool:
            return True

    learn(model, its, Compare())
    assert not equal(start, model.policy.state_dict())


def test_models_can_continue_learning_afterwards():
    """Neither a limit nor frozen parameters stay behind."""
    model, its = make_allocator(), make_its(n_epochs=2)
    learn(model, its)
    assert model.max_instances is None
    model.learn_instances(8)
    its.router.learn_instances(8)
    assert model.n_instances == 24
    # A limit of the caller binds too.
    model, its = make_allocator(), make_its()
    model.learn_instances(16, its)
    assert trace(its) == "pp" + "aaii" and model.n_instances == 16


@pytest.mark.parametrize("algo", ["ppo", "ppo_mask", "a2c"])
def test_router_of_another_algorithm(algo, monkeypatch):
    """Any on-policy algorithm of SB3 can be the router's, and learns in every epoch, however long its rollouts are."""
    router: dict[str, Any] = dict(algo=algo, n_steps=64)
    if algo != "a2c":
        router.update(batch_size=16, n_epochs=1)
    its = make_its(router, n_epochs=2, n_pretraining_epochs=1, n_intensive_epochs=0)
    snapshots = []

    original = RouterTrainer.learn

    def learn_router(self, *args):
        snapshots.append(snapshot(self.policy))
        return original(self, *args)

    monkeypatch.setattr(RouterTrainer, "learn", learn_router)
    learn(make_allocator(), its)
    assert trace(its) == "p" + "at" * 2
    snapshots.append(snapshot(its.router.policy))
    assert len(snapshots) == 4 and not any(equal(a, b) for a, b in itertools.pairwise(snapshots))
    assert its.router._n_updates >= 3
    assert all(0 < record.objective <= N_TASKS and record.n_instances >= 8 for record in its.records)


@pytest.mark.filterwarnings("error:This AllocatorPolicy expects the tasks")
@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
def test_allocator_of_another_algorithm(algorithm):
    model = algorithm(
        AllocatorPolicy, make_env(), n_steps=N_TASKS, batch_size=10, n_epochs=1, policy_kwargs=SMALL, seed=0, device="cpu"
    )
    its = make_its(n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=2, instances_per_epoch=8)
    # SB3 counts steps from 0 again in every call of learn.
    model.learn(8 * N_TASKS, callback=its)
    assert trace(its) == "pa"
    model.learn(10**6, callback=its)
    assert trace(its) == "p" + "aaii" + "at"
    assert [record.n_instances for record in its.records if record.level == "allocator"] == [8, 8, 8]
    with pytest.raises(ValueError, match="The allocator has been trained before"):
        model.learn(8, callback=make_its(instances_per_epoch=8))


def test_its_writes_tensorboard_for_both_levels(tmp_path):
    tensorboard = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    model = make_allocator()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    learn(model, make_its(n_epochs=2))
    for folder, key in ((tmp_path, "its/router_objective"), (tmp_path / "router", "train/loss")):
        events = tensorboard.EventAccumulator(str(folder)).Reload()
        assert key in events.Tags()["scalars"]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(strategy="none"), "strategy is 'none'; choose one of its, .*independent.*ITS/pre-training"),
        (dict(n_epochs=0), "n_epochs is 0; it must be a whole number of at least 1"),
        (dict(n_continuous_epochs=1.5), "n_continuous_epochs is 1.5"),
        (dict(n_pretraining_epochs=-1), "n_pretraining_epochs is -1"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_its(**kwargs)


@pytest.mark.parametrize(
    ("router", "message"),
    [
        (dict(learnin_rate=1), "these arguments do not fit algorithm 'reinforce'.*learnin_rate"),
        (dict(algo="reinforced"), "algo is 'reinforced'; choose one of reinforce, ppo"),
        (dict(algo="stable_baselines3.SAC"), "is not an on-policy algorithm"),
        (dict(n_envs=0), "n_envs is 0; it must be a whole number of at least 1"),
        (dict(learning_rate="lin_0.1"), "learning_rate is 'lin_0.1'; write a number"),
    ],
)
def test_bad_router_is_named(router, message):
    with pytest.raises(ValueError, match=message):
        learn(make_allocator(), make_its(router))


def test_epochs_of_two_lengths_are_refused():
    with pytest.raises(ValueError, match="instances_per_epoch is 16 in ITSCallback and 8 in REINFORCE"):
        learn(make_allocator(), make_its(instances_per_epoch=16))


def test_needs_our_env_and_policy():
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match="needs an AllocatorPolicy on a TaskAllocation environment"):
        model.learn(8, callback=make_its())
