import csv
import itertools
import json
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure

from sb3_uav.envs import (
    BatchedVecEnv,
    Instances,
    MixtureGenerator,
    TaskAllocationEnv,
    UniformGenerator,
    check_schedule,
    plan_tours,
    schedules,
)
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import Freezer, ITSCallback
from sb3_uav.training.its import CHECKPOINT_FOLDER, LOG_FILE, read_state
from sb3_uav.training.subsets import AllocatedSubsets, WholeInstances

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")

SMALL: dict[str, Any] = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
PAPER: dict[str, Any] = dict(SMALL, preset="paper")
N_TASKS, N_UAVS, N_ENVS = 5, 2, 4


def make_env(n_envs: int = N_ENVS, n_uavs: int = N_UAVS) -> Any:
    return BatchedVecEnv([lambda: TaskAllocationEnv(N_TASKS, n_uavs, max_distance=1.5)] * n_envs)


def make_allocator(n_uavs: int = N_UAVS, **kwargs) -> Any:
    settings: dict[str, Any] = dict(
        baseline="exponential", instances_per_epoch=8, learning_rate=1e-2, seed=0, device="cpu", policy_kwargs=SMALL
    )
    return REINFORCE(AllocatorPolicy, make_env(n_uavs=n_uavs), **{**settings, **kwargs})


def make_its(router: dict | None = None, **kwargs) -> Any:
    default_router: dict[str, Any] = dict(policy="RouterPolicy", n_envs=4, learning_rate=1e-2, policy_kwargs=SMALL)
    settings: dict[str, Any] = dict(n_epochs=6, n_pretraining_epochs=2, n_intensive_epochs=4, n_continuous_epochs=2)
    return ITSCallback({**default_router, **(router or {})}, **{**settings, **kwargs})


def learn(model: REINFORCE, its: ITSCallback, *others: BaseCallback) -> Any:
    return model.learn(10**9, callback=[its, *others])


def snapshot(policy) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in policy.state_dict().items()}


def equal(a: dict[str, th.Tensor], b: dict[str, th.Tensor]) -> bool:
    return all(th.equal(value, b[name]) for name, value in a.items())


def trace(its: ITSCallback) -> str:
    """The order of the epochs: a for allocator, p, i and t for the router's phases."""
    letters = {"pre-training": "p", "intensive": "i", "alternate": "t"}
    return "".join("a" if record.level == "allocator" else letters[record.phase] for record in its.records)


# ------------------------------------------------------------------------------------------ Algorithm 1


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
        ("ITS", "pp" + "aaii" * 2 + "atat"),
        ("ITS/pre-training", "aaii" * 2 + "atat"),
        ("ITS/intensive", "pp" + "at" * 6),
        ("ITS/pre-training&intensive", "at" * 6),
        ("independent", "pp" + "a" * 6),
    ],
)
def test_ablations_are_one_switch(strategy, expected):
    its = make_its(strategy=strategy)
    learn(make_allocator(), its)
    assert trace(its) == expected


def test_stops_early_when_the_steps_are_over():
    """n_timesteps binds too: the epoch that it completes is closed, the rest does not happen."""
    its = make_its()
    make_allocator().learn(8 * N_TASKS * 2, callback=its)
    assert trace(its) == "pp" + "aaii"


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


# ------------------------------------------------------------------------------------------ the router's data


def make_subsets(fraction: float, n_batches: int = 3, **kwargs) -> tuple[AllocatedSubsets, Any]:
    model = make_allocator(**kwargs)
    subsets = AllocatedSubsets(
        model.policy,
        model.problem.generator,
        model.draw_batch,
        range(n_batches),
        fraction,
        lambda chunk: np.random.default_rng(chunk),
    )
    return subsets, model


def points(instances: Instances) -> set[tuple[float, float]]:
    return {tuple(point) for point in instances.tasks[instances.task_mask].tolist()}


def test_intensive_data_are_all_subsets_of_the_epochs_instances():
    """One pass gives every task of the epoch's instances to exactly one subset, with its own depot and D."""
    subsets, model = make_subsets(1.0)
    rng = np.random.default_rng(0)
    drawn = Instances.concatenate([subsets(4, rng) for _ in range(3 * N_ENVS * N_UAVS // 4)])
    originals = Instances.concatenate([model.draw_batch(i) for i in range(3)])
    assert len(drawn) == 3 * N_ENVS * N_UAVS and drawn.n_uavs == 1
    assert int(drawn.task_mask.sum()) == 3 * N_ENVS * N_TASKS and points(drawn) == points(originals)
    depots = [tuple(depot) for depot in drawn.depot.tolist()]
    for i in range(len(originals)):
        rows = [j for j, depot in enumerate(depots) if depot == tuple(originals.depot[i].tolist())]
        assert len(rows) == N_UAVS
        assert points(drawn[rows]) == points(originals[i])
    assert (drawn.max_distance == 1.5).all()
    # Shuffled: the subsets of an instance do not follow each other.
    assert depots != sorted(depots, key=depots.index)


def test_alternate_data_are_a_random_part():
    subsets, _ = make_subsets(1 / N_UAVS)
    drawn = subsets(3 * N_ENVS, np.random.default_rng(0))
    assert len(drawn) == 3 * N_ENVS
    # A fixed UAV per instance would give every depot once.
    assert len({tuple(depot) for depot in drawn.depot.tolist()}) < 3 * N_ENVS


def test_subsets_follow_the_current_allocator():
    subsets, model = make_subsets(1.0, policy_kwargs=dict(SMALL, shared_scorer=False))
    model.policy.action_net.bias.data = th.tensor([50.0, -50.0])
    sizes = subsets(8, np.random.default_rng(0)).task_mask.sum(1)
    assert set(sizes.tolist()) <= {0, N_TASKS} and N_TASKS in sizes


def test_held_out_subsets_are_not_training_subsets():
    subsets, _ = make_subsets(1.0)
    held_out = subsets.held_out(7, np.random.default_rng(5))
    assert len(held_out) == 7 and held_out.n_uavs == 1
    assert not points(held_out) & points(subsets(3 * N_ENVS * N_UAVS, np.random.default_rng(0)))


def test_pretraining_instances_are_whole():
    generator = WholeInstances(UniformGenerator(6, 4, 1.5))
    drawn = generator(3, np.random.default_rng(0))
    assert (drawn.n_tasks, drawn.n_uavs, generator.n_uavs) == (6, 1, 1)
    assert th.equal(drawn.tasks, UniformGenerator(6, 4, 1.5)(3, np.random.default_rng(0)).tasks)


def make_mixture() -> tuple[AllocatedSubsets, Any]:
    env = BatchedVecEnv([lambda: TaskAllocationEnv(60, 3, distribution="mixture")] * 8)
    model: Any = REINFORCE(AllocatorPolicy, env, seed=0, device="cpu", policy_kwargs=SMALL, instances_per_epoch=8)
    generator = MixtureGenerator(60, 3, min_tasks=24)
    env.set_generator(generator)
    stream = np.random.default_rng
    return AllocatedSubsets(model.policy, generator, model.draw_batch, range(5), 1.0, lambda chunk: stream(chunk)), model


def test_mixed_subsets_come_from_one_batch_each():
    """So that small ones are not padded to large ones; of small ones there are more."""
    subsets, model = make_mixture()
    batches = [model.draw_batch(i) for i in range(5)]
    assert len({(batch.n_tasks, batch.n_uavs) for batch in batches}) > 1
    rng = np.random.default_rng(0)
    for _ in range(10):
        drawn = subsets.training_batch(6, rng)
        owners = [i for i, batch in enumerate(batches) if points(drawn) <= points(batch)]
        assert len(owners) == 1 and drawn.n_uavs == 1
        assert 2 <= len(drawn) <= 6 * 24 and drawn.task_mask.any(0).all()


def test_router_epochs_may_have_their_own_size():
    its = make_its(n_epochs=2, n_pretraining_epochs=1, router_instances_per_epoch=12)
    learn(make_allocator(), its)
    sizes = {(record.level, record.n_instances) for record in its.records}
    assert sizes == {("allocator", 8), ("router", 12)}


def test_updates_of_a_mixture_have_one_size_each():
    """An epoch is over after its number of instances, not of batches."""
    _, model = make_mixture()
    model.learn_instances(20)
    batches = [len(model.draw_batch(i)) for i in range(model.n_batches)]
    assert model.n_instances == sum(batches) >= 20 > sum(batches[:-1]) and len(set(batches)) > 1


# ------------------------------------------------------------------------------------------ router, zips, resuming


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


def test_zips_and_log_are_left_in_the_folder(tmp_path):
    its = make_its(save_path=str(tmp_path))
    model = make_allocator()
    learn(model, its)
    router = REINFORCE.load(tmp_path / "router.zip")
    assert isinstance(router.policy, RouterPolicy) and equal(router.policy.state_dict(), its.router.policy.state_dict())
    with (tmp_path / LOG_FILE).open() as file:
        rows = list(csv.DictReader(file))
    assert [row["level"] for row in rows] == [record.level for record in its.records]
    assert list(rows[0]) == ["epoch", "level", "phase", "n_instances", "objective", "seconds", "generation_seconds"]
    for record in rows:
        generated = float(record["generation_seconds"])
        assert 0 <= generated <= float(record["seconds"])
        # The first epoch of an intensive block may have left enough for the second.
        if record["level"] == "allocator" or record["phase"] != "intensive":
            assert (generated > 0) == (record["level"] == "router" and record["phase"] == "alternate")
    assert all(0 <= float(row["objective"]) <= N_TASKS and int(row["n_instances"]) == 8 for row in rows)
    folder = tmp_path / CHECKPOINT_FOLDER
    assert sorted(path.name for path in folder.iterdir()) == ["allocator_6.zip", "its_state.json", "router_8.zip"]
    assert REINFORCE.load(folder / "allocator_6.zip").epoch == 6
    # The zips give feasible schedules.
    instances = model.draw_batch(0)
    planned = plan_tours(instances, model.policy.decode_episodes(instances), router.policy.plan)
    for row, schedule in enumerate(schedules(planned.tours[:, 0])):
        assert check_schedule(instances, row, schedule).objective == planned.value[row, 0]


class Interrupt(BaseCallback):
    """Ctrl-C in the middle of an epoch."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.at:
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize("baseline", ["exponential", "rollout"])
@pytest.mark.parametrize("epochs", [0, 1, 2, 3, 5])
def test_resumed_run_equals_an_unbroken_one(baseline, epochs, tmp_path):
    """Interrupted in any phase, after pre-training included: allocator, router and log go on as if nothing had happened."""
    settings: dict[str, Any] = dict(baseline=baseline, policy_kwargs=PAPER, lr_decay=0.9)
    router: dict[str, Any] = dict(baseline=baseline, lr_decay=0.9, policy_kwargs=PAPER)
    if baseline == "rollout":
        settings["baseline_kwargs"] = router["baseline_kwargs"] = dict(n_test_instances=20)
    unbroken, its = make_allocator(**settings), make_its(router)
    learn(unbroken, its)

    broken = make_allocator(**settings)
    with pytest.raises(KeyboardInterrupt):
        learn(broken, make_its(router, save_path=str(tmp_path)), Interrupt((8 * epochs + 6) * N_TASKS))
    folder = tmp_path / CHECKPOINT_FOLDER
    state = read_state(folder)
    assert state["epoch"] == epochs
    resumed = REINFORCE.load(folder / state["allocator"], env=make_env())
    resumed_its = make_its(router, save_path=str(tmp_path), resume_from=str(folder))
    resumed.learn(10**9, callback=resumed_its, reset_num_timesteps=False)
    assert equal(unbroken.policy.state_dict(), resumed.policy.state_dict())
    assert equal(its.router.policy.state_dict(), resumed_its.router.policy.state_dict())
    assert [(r.level, r.epoch, r.objective) for r in its.records] == [
        (r.level, r.epoch, r.objective) for r in resumed_its.records
    ]


def test_a_resumed_router_has_the_settings_of_now(tmp_path):
    """As rl_zoo3 gives the allocator those of the YAML, not those of the zip."""
    learn(make_allocator(), make_its(save_path=str(tmp_path)))
    folder = tmp_path / CHECKPOINT_FOLDER
    resumed = REINFORCE.load(folder / read_state(folder)["allocator"], env=make_env())
    its = make_its(dict(learning_rate=5e-3, max_grad_norm=0.5), n_epochs=7, resume_from=str(folder), save_path=str(tmp_path))
    resumed.learn(10**9, callback=its, reset_num_timesteps=False)
    assert its.epoch == 7 and its.router.max_grad_norm == 0.5
    assert {group["lr"] for group in its.router.policy.optimizer.param_groups} == {5e-3}


def test_interrupted_during_the_router_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    its = make_its(save_path=str(tmp_path))
    original = ITSCallback._train_router

    def interrupted(self, n_epochs, phase, first=0):
        if phase == "alternate":
            raise KeyboardInterrupt
        original(self, n_epochs, phase, first)

    monkeypatch.setattr(ITSCallback, "_train_router", interrupted)
    model = make_allocator()
    with pytest.raises(KeyboardInterrupt):
        learn(model, its)
    assert read_state(tmp_path / CHECKPOINT_FOLDER)["epoch"] == 4
    # rl_zoo3 calls this after Ctrl-C; it must not start the router's training again.
    its.on_training_end()
    assert trace(its).endswith("a") and all(p.requires_grad for p in model.policy.parameters())


def test_resumed_in_pretraining_equals_an_unbroken_run(tmp_path, monkeypatch):
    unbroken, its = make_allocator(), make_its(n_pretraining_epochs=3)
    learn(unbroken, its)
    original = ITSCallback._learn_router

    def interrupted(self, number, *args):
        if number == 3:
            raise KeyboardInterrupt
        return original(self, number, *args)

    with monkeypatch.context() as patch:
        patch.setattr(ITSCallback, "_learn_router", interrupted)
        with pytest.raises(KeyboardInterrupt):
            learn(make_allocator(), make_its(n_pretraining_epochs=3, save_path=str(tmp_path)))
    folder = tmp_path / CHECKPOINT_FOLDER
    state = read_state(folder)
    assert (state["epoch"], state["router"], len(state["records"])) == (0, "router_2.zip", 2)
    resumed = REINFORCE.load(folder / state["allocator"], env=make_env())
    resumed_its = make_its(n_pretraining_epochs=3, save_path=str(tmp_path), resume_from=str(folder))
    learn(resumed, resumed_its)
    assert trace(resumed_its) == trace(its)
    assert equal(unbroken.policy.state_dict(), resumed.policy.state_dict())
    assert equal(its.router.policy.state_dict(), resumed_its.router.policy.state_dict())


def test_pretraining_leaves_the_allocator_alone():
    model = make_allocator(policy_kwargs=PAPER)
    start = snapshot(model.policy)
    its = make_its(n_epochs=1, strategy="independent")
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


def test_models_can_go_on_learning_afterwards():
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


def test_foreign_files_in_the_checkpoint_folder_stay(tmp_path):
    folder = tmp_path / CHECKPOINT_FOLDER
    folder.mkdir()
    (folder / "mine.zip").write_text("not yours")
    learn(make_allocator(), make_its(n_epochs=1, save_path=str(tmp_path)))
    assert {"mine.zip", "allocator_1.zip"} <= {path.name for path in folder.iterdir()}


def test_says_when_nothing_is_saved():
    with pytest.warns(UserWarning, match="ITSCallback saves no router: set save_path to a folder"):
        learn(make_allocator(), make_its(n_epochs=1))


def test_router_zip_is_current_between_checkpoints(tmp_path):
    its = make_its(save_path=str(tmp_path), checkpoint_freq=4)
    make_allocator().learn(3 * 8 * N_TASKS, callback=its)
    assert equal(REINFORCE.load(tmp_path / "router.zip").policy.state_dict(), its.router.policy.state_dict())
    assert read_state(tmp_path / CHECKPOINT_FOLDER)["epoch"] == 0


def test_best_router_when_the_last_evaluation_is_the_best(tmp_path):
    """The last call of on_step may be the one that finds the best allocator."""
    evaluation = EvalCallback(make_env(2), n_eval_episodes=4, eval_freq=20, best_model_save_path=str(tmp_path), verbose=0)
    its = make_its(n_epochs=2)
    make_allocator().learn(2 * 8 * N_TASKS, callback=[its, evaluation])
    assert (tmp_path / "best_model.zip").is_file() and (tmp_path / "best_router.zip").is_file()


def test_best_router_is_kept_with_the_best_allocator(tmp_path):
    its = make_its(n_epochs=2)
    evaluation = EvalCallback(
        make_env(2), n_eval_episodes=4, eval_freq=5, best_model_save_path=str(tmp_path), log_path=str(tmp_path), verbose=0
    )
    learn(make_allocator(), its, evaluation)
    assert its.save_path == tmp_path and (tmp_path / "best_model.zip").is_file()
    assert isinstance(REINFORCE.load(tmp_path / "best_router.zip").policy, RouterPolicy)


@pytest.mark.parametrize("algo", ["ppo", "ppo_mask", "a2c"])
def test_router_of_another_algorithm(algo):
    """Any on-policy algorithm of SB3 can be the router's, and learns in every epoch, however long its rollouts are."""
    router: dict[str, Any] = dict(algo=algo, n_steps=64)
    if algo != "a2c":
        router.update(batch_size=16, n_epochs=1)
    its = make_its(router, n_epochs=2, n_pretraining_epochs=1, n_intensive_epochs=0)
    snapshots = []

    original = its._learn_router

    def learn_router(*args):
        snapshots.append(snapshot(its.router.policy))
        return original(*args)

    its._learn_router = learn_router
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


# ------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(strategy="its"), "strategy is 'its'; choose one of"),
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


def test_trained_allocator_without_its_router_is_refused():
    model = make_allocator().learn_instances(8)
    with pytest.raises(ValueError, match="set resume_from to the its_checkpoint folder"):
        model.learn(100, callback=make_its(), reset_num_timesteps=False)


def test_needs_our_env_and_policy():
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match="needs an AllocatorPolicy on a TaskAllocation environment"):
        model.learn(8, callback=make_its())


def test_damaged_checkpoints_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"its_state.json: no such file; give the its_checkpoint folder"):
        read_state(tmp_path)
    (tmp_path / "its_state.json").write_text('{"epoch": 3')
    with pytest.raises(ValueError, match="not an intact state file"):
        read_state(tmp_path)
    (tmp_path / "its_state.json").write_text(json.dumps(dict(epoch=3, records=[dict(epoch=1)])))
    with pytest.raises(ValueError, match="not an intact state file"):
        read_state(tmp_path)
    (tmp_path / "its_state.json").write_text(json.dumps(dict(epoch=3)))
    with pytest.raises(ValueError, match=r"fields \['allocator', 'records', 'router'\] are missing"):
        read_state(tmp_path)


def test_allocator_of_another_epoch_is_refused(tmp_path):
    its = make_its(save_path=str(tmp_path), n_epochs=2)
    learn(make_allocator(), its)
    model = make_allocator()
    with pytest.raises(ValueError, match="the checkpoint is of epoch 2, the allocator of epoch 0; train the allocator of"):
        learn(model, make_its(resume_from=str(tmp_path / CHECKPOINT_FOLDER)))
