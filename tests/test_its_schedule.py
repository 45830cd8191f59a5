"""Which epochs there are: strategies and their names, several epochs in one batch, and the length of DL-DRL-I."""

import warnings
from typing import Any

import numpy as np
import pytest
from its_runs import N_TASKS, N_UAVS, SMALL, equal, learn, make_allocator, make_env, make_its, snapshot, trace
from stable_baselines3 import PPO

from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state
from sb3_uav.training.its_schedule import _STRATEGIES, PAPER_STRATEGIES, EpochSchedule
from sb3_uav.training.subsets import AllocatedSubsets

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


# ------------------------------------------------------------------------------------------ strategies


def test_the_papers_names_of_strategies_mean_the_same():
    assert set(PAPER_STRATEGIES.values()) == set(_STRATEGIES)
    for paper, readable in PAPER_STRATEGIES.items():
        assert make_its(strategy=paper).strategy == readable
        assert make_its(strategy=paper).schedule == make_its(strategy=readable).schedule
    assert ITSCallback(dict(policy="RouterPolicy")).strategy == "its"


@pytest.mark.parametrize("strategy", ["none", "", None, ["its"], "ITS/"])
def test_an_unknown_strategy_is_named_with_all_names(strategy):
    with pytest.raises(ValueError, match=r"strategy is .*choose one of its, no-pretraining.*ITS/pre-training&intensive"):
        make_its(strategy=strategy)


@pytest.mark.parametrize(("fleet", "n_intensive", "n_continuous", "expected"), [("U4", 8, 4, 105), ("U6", 12, 6, 105)])
def test_the_router_of_dl_drl_i_is_trained_as_long_as_that_of_its(fleet, n_intensive, n_continuous, expected):
    """The paper's settings: 5 epochs of pre-training, 100 of the allocator."""
    settings = (100, 5, n_intensive, n_continuous)
    its, independent = EpochSchedule.of("its", *settings), EpochSchedule.of("independent", *settings)
    assert its.n_router_epochs == independent.n_router_epochs == independent.n_pretraining_epochs == expected
    assert not any(independent.router_epochs_after(epoch) for epoch in range(1, 101))
    # An intensive phase that is no multiple of its blocks, or longer than the training.
    for odd in ((7, 2, 5, 2), (3, 2, 8, 4), (1, 0, 0, 1)):
        assert EpochSchedule.of("its", *odd).n_router_epochs == EpochSchedule.of("independent", *odd).n_router_epochs


def test_dl_drl_i_is_not_the_pair_of_its():
    """Same seed and settings: another router, which never sees the allocator's subsets."""
    pairs = {}
    for strategy in ("its", "independent"):
        model, its = make_allocator(), make_its(strategy=strategy)
        learn(model, its)
        pairs[strategy] = its
    independent = pairs["independent"]
    assert not equal(pairs["its"].router.policy.state_dict(), independent.router.policy.state_dict())
    assert [record.phase for record in independent.records if record.level == "router"] == ["pre-training"] * 8
    # As many instances for either router.
    assert independent.router.n_instances == pairs["its"].router.n_instances == 8 * 8


# ------------------------------------------------------------------------------------------ several epochs in a batch


def test_all_epochs_happen_when_a_batch_holds_several():
    """64 instances in a batch, 8 in an epoch: 6 epochs end at once, and the router learns after each of them."""
    model = REINFORCE(
        AllocatorPolicy, make_env(64), baseline="exponential", instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL
    )
    its = make_its(n_epochs=6, n_pretraining_epochs=1, n_intensive_epochs=0)
    with pytest.warns(UserWarning, match="learns from 64 instances, an epoch has 8: .*Lower n_envs, or raise"):
        learn(model, its)
    assert its.epoch == 6 and trace(its) == "p" + "at" * 6
    sizes = [record.n_instances for record in its.records if record.level == "allocator"]
    assert sum(sizes) == model.n_instances == 64 and sizes[:5] == [8] * 5
    assert its.router.n_instances == 7 * 8 and all(record.objective > 0 for record in its.records)


def test_batches_that_end_one_epoch_or_two():
    """20 instances in a batch, 8 in an epoch: every epoch learns from some, none is lost."""
    model = REINFORCE(AllocatorPolicy, make_env(20), instances_per_epoch=8, seed=0, device="cpu", policy_kwargs=SMALL)
    its = make_its(n_epochs=5, n_pretraining_epochs=0, n_intensive_epochs=2, n_continuous_epochs=2)
    with pytest.warns(UserWarning, match="several epochs will end at once"):
        learn(model, its)
    assert trace(its) == "aaii" + "at" * 3
    assert [r.n_instances for r in its.records if r.level == "allocator"] == [8, 12, 4, 8, 8]


@pytest.mark.parametrize("at", range(1, 6))
def test_resumed_between_two_epochs_of_a_batch(at, tmp_path, monkeypatch):
    """The checkpoint has fewer epochs than the allocator has completed."""

    def make() -> tuple[Any, Any]:
        model = REINFORCE(
            AllocatorPolicy, make_env(24), baseline="exponential", instances_per_epoch=8, seed=0, device="cpu",
            policy_kwargs=SMALL,
        )  # fmt: skip
        return model, make_its(n_epochs=6, n_pretraining_epochs=1, n_intensive_epochs=2, save_path=str(tmp_path))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        unbroken, its = make()
        learn(unbroken, its)
        expected = snapshot(unbroken.policy), snapshot(its.router.policy), [(r.level, r.n_instances) for r in its.records]
        original = ITSCallback._end_epoch

        def interrupted(self: ITSCallback) -> None:
            if self.epoch == at:
                raise KeyboardInterrupt
            original(self)

        broken, its = make()
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(ITSCallback, "_end_epoch", interrupted)
            learn(broken, its)
        folder = tmp_path / CHECKPOINT_FOLDER
        state = read_state(folder)
        assert state["epoch"] == at
        resumed = REINFORCE.load(folder / state["allocator"], env=make_env(24), device="cpu")
        again = make_its(n_epochs=6, n_pretraining_epochs=1, n_intensive_epochs=2, resume_from=str(folder))
        resumed.learn(10**9, callback=again, reset_num_timesteps=False)
    assert equal(expected[0], resumed.policy.state_dict()) and equal(expected[1], again.router.policy.state_dict())
    assert expected[2] == [(record.level, record.n_instances) for record in again.records]


def test_all_epochs_happen_under_ppo_too():
    """A rollout of 16 instances, 4 in an epoch."""
    algorithm: Any = PPO
    model = algorithm(
        AllocatorPolicy, make_env(8), n_steps=2 * N_TASKS, batch_size=20, n_epochs=1, policy_kwargs=SMALL, seed=0, device="cpu"
    )
    its = make_its(n_epochs=6, n_pretraining_epochs=1, n_intensive_epochs=2, instances_per_epoch=4)
    with pytest.warns(UserWarning, match="learns from 16 instances, an epoch has 4: .*Lower n_envs or n_steps"):
        model.learn(10**6, callback=its)
    assert its.epoch == 6 and trace(its) == "p" + "aaii" + "at" * 4
    assert sum(record.n_instances for record in its.records if record.level == "allocator") == 32


# ------------------------------------------------------------------------------------------ what the router learns from


def test_alternate_epochs_draw_from_a_share_of_one_in_v(monkeypatch):
    """Intensive epochs draw from all subsets, alternate ones from a V-th part of them."""
    fractions = []
    original = AllocatedSubsets.__init__

    def noted(self: Any, allocator: Any, generator: Any, draw: Any, batches: Any, fraction: float, *args: Any) -> None:
        fractions.append(fraction)
        original(self, allocator, generator, draw, batches, fraction, *args)

    monkeypatch.setattr(AllocatedSubsets, "__init__", noted)
    learn(make_allocator(), make_its(n_epochs=4, n_pretraining_epochs=0, n_intensive_epochs=2))
    assert fractions == [1.0, 1 / N_UAVS, 1 / N_UAVS]


def test_the_routers_subsets_are_sampled_from_the_allocator(monkeypatch):
    """A second pass over the same instances gives other subsets, which greedy allocations would not."""
    greedy, passes = [], []
    original = AllocatorPolicy.decode_episodes

    def noted(self: Any, instances: Any, n_samples: int = 1, deterministic: bool = True, *args: Any, **kwargs: Any) -> Any:
        greedy.append(deterministic)
        return original(self, instances, n_samples, deterministic, *args, **kwargs)

    model, its = make_allocator(), make_its(n_epochs=2, n_pretraining_epochs=0, n_intensive_epochs=2)
    monkeypatch.setattr(AllocatorPolicy, "decode_episodes", noted)
    learn(model, its)
    assert greedy and not any(greedy)
    subsets = its._subsets
    assert subsets is not None
    rows = sum(len(subsets.draw_batch(batch)) for batch in subsets.batches) * N_UAVS
    monkeypatch.undo()
    for _ in range(2):
        drawn = subsets(rows, np.random.default_rng(0))
        passes.append({tuple(map(tuple, drawn.tasks[row][drawn.task_mask[row]].tolist())) for row in range(rows)})
    assert passes[0] != passes[1]
