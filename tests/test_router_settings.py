"""The router's settings: subclasses, seeds, and arguments that are not the user's."""

from typing import Any

import pytest
import torch as th
from its_runs import SMALL, equal, learn, make_allocator, make_env, make_its, snapshot
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.policies import AllocatorPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state
from sb3_uav.training.router_trainer import RouterTrainer

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


# SB3 declares other policies than ours.
make_ppo: Any = PPO


class Mine(REINFORCE):
    """A user's own algorithm."""


class Narrow(REINFORCE):
    """With a constructor that has no instances_per_epoch."""

    def __init__(
        self, policy: Any, env: Any, learning_rate: Any = 1e-2, _init_setup_model: bool = True, **kwargs: Any
    ) -> None:
        assert "instances_per_epoch" not in kwargs
        super().__init__(policy, env, learning_rate, _init_setup_model=_init_setup_model, **kwargs)


@pytest.mark.parametrize("algorithm", [Mine, Narrow])
def test_a_subclass_of_reinforce_has_the_epochs_of_reinforce(algorithm, tmp_path):
    """Decay and baseline updates happen after each, also when the run is resumed."""
    routers: list[Any] = []
    for algo in ("reinforce", f"{__name__}.{algorithm.__name__}"):
        its = make_its(dict(algo=algo, lr_decay=0.5), save_path=str(tmp_path / algo))
        learn(make_allocator(), its)
        routers.append(its.router)
    assert type(routers[1]) is algorithm
    assert routers[0].epoch == routers[1].epoch == 8 and routers[1].instances_per_epoch == 8
    assert equal(routers[0].policy.state_dict(), routers[1].policy.state_dict())
    folder = tmp_path / algo / CHECKPOINT_FOLDER
    model = REINFORCE.load(folder / read_state(folder)["allocator"], env=make_env(), device="cpu")
    again = make_its(dict(algo=algo, lr_decay=0.5), n_epochs=7, resume_from=str(folder))
    learn(model, again)
    assert again.router.epoch == 9 and again.router.policy.optimizer.param_groups[0]["lr"] == 1e-2 * 0.5**8


def test_the_router_may_have_its_own_seed(tmp_path):
    """The same one gives the same router before the allocator learns, another one another; resuming keeps its streams."""
    routers: list[Any] = []
    for number, seed in enumerate((7, 7, 8, None)):
        given = {} if seed is None else dict(seed=seed)
        its = make_its(given, n_epochs=1, n_pretraining_epochs=1, save_path=str(tmp_path / str(number)))
        learn(make_allocator(), its)
        routers.append(its.router)
    assert [router.seed for router in routers] == [7, 7, 8, 1]
    assert equal(routers[0].policy.state_dict(), routers[1].policy.state_dict())
    assert not equal(routers[0].policy.state_dict(), routers[2].policy.state_dict())
    folder = tmp_path / "0" / CHECKPOINT_FOLDER
    model = REINFORCE.load(folder / read_state(folder)["allocator"], env=make_env(), device="cpu")
    again = make_its(dict(seed=9, device="cpu"), n_epochs=1, resume_from=str(folder))
    learn(model, again)
    assert again.router.stream_seed == 7


@pytest.mark.parametrize("algo", ["reinforce", "ppo", "ppo_mask", "a2c"])
def test_seed_device_and_verbose_are_accepted(algo):
    # PPO's default rollouts have 2,048 steps.
    rollout = dict(n_steps=16, batch_size=16) if algo.startswith("ppo") else {}
    its = make_its(dict(algo=algo, seed=3, device="cpu", verbose=0, **rollout), n_epochs=1, n_pretraining_epochs=1)
    learn(make_allocator(), its)
    assert its.router.seed == 3 and its.router.device == th.device("cpu")


@pytest.mark.parametrize(
    ("router", "message"),
    [
        (dict(env="CartPole-v1"), "router: env cannot be set: ITSCallback makes the router's environment"),
        (dict(tensorboard_log="logs"), "router: tensorboard_log cannot be set: the router logs beside the allocator"),
        (dict(_init_setup_model=False), "router: _init_setup_model cannot be set: the router needs its network"),
        (dict(instances_per_epoch=16), "router: instances_per_epoch is 16, .*has 8 instances; set router_instances_per_epoch"),
        (dict(n_envs=9), "router: n_envs is 9, more than the 8 instances of a router epoch.*lower n_envs, or raise"),
        (dict(algo=f"{__name__}.Mine", n_envs=9), "router: n_envs is 9, more than the 8 instances of a router epoch"),
    ],
)
def test_settings_that_are_not_the_users_are_refused(router, message):
    with pytest.raises(ValueError, match=message):
        learn(make_allocator(), make_its(router))


def test_the_routers_default_batch_fits_its_epochs():
    """As many environments as the allocator's, but not more than an epoch has instances."""
    settings = dict(n_epochs=2, n_pretraining_epochs=1, n_intensive_epochs=0, router_instances_per_epoch=3)
    its: Any = ITSCallback(dict(policy="RouterPolicy", policy_kwargs=SMALL), **settings)  # type: ignore[arg-type]
    learn(make_allocator(), its)
    assert its.router.n_envs == 3 and its.router.n_instances == 3 * 3


# ------------------------------------------------------------------------------------------ freezing


@pytest.mark.parametrize("network", [SMALL, dict(SMALL, preset="paper")], ids=["layer", "batch"])
def test_exactly_one_level_learns_at_any_time(network):
    """While the router learns, the allocator's parameters, buffers and mode stay, and the reverse."""
    its = make_its(dict(policy_kwargs=network), n_epochs=4, n_pretraining_epochs=1, n_intensive_epochs=2)
    model = make_allocator(policy_kwargs=network)
    seen: list[str] = []

    class Other(BaseCallback):
        """Compares, at every update of one level, the other one with what it was before."""

        def __init__(self, name: str) -> None:
            super().__init__()
            self.name, self.before = name, dict[str, th.Tensor]()

        def _frozen(self) -> Any:
            return its.router.policy if self.name == "allocator" else model.policy

        def _on_rollout_start(self) -> None:
            self.before = snapshot(self._frozen())

        def _on_rollout_end(self) -> None:
            frozen, learning = self._frozen(), self.model.policy
            assert equal(self.before, frozen.state_dict())
            # Of the allocator before its training starts, nothing is frozen, and nothing changes.
            if its.epoch > 0 or self.name == "allocator":
                assert not frozen.training and not any(parameter.requires_grad for parameter in frozen.parameters())
            assert all(parameter.requires_grad for parameter in learning.parameters())
            seen.append(self.name)

        def _on_step(self) -> bool:
            return True

    learn_router: Any = RouterTrainer.learn
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RouterTrainer, "learn", lambda *args: learn_router(*args[:-1], [*args[-1], Other("router")]))
        learn(model, its, Other("allocator"))
    assert seen.count("allocator") == 8 and seen.count("router") == (1 + 2 + 2) * 2


# ------------------------------------------------------------------------------------------ unseeded runs


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_unseeded_runs_of_sb3s_algorithms_differ(algorithm, tmp_path):
    """Each draws a seed for the streams that it does not have, and keeps it in its zips."""
    seeds, drawn = [], []
    for number in range(2):
        model: Any = algorithm(AllocatorPolicy, make_env(), n_steps=5, policy_kwargs=SMALL, device="cpu")
        its = make_its(n_epochs=1, n_pretraining_epochs=0, instances_per_epoch=8, save_path=str(tmp_path / str(number)))
        model.learn(200, callback=its)
        seeds.append(model.stream_seed)
        drawn.append(its._draw_new_batch(0).tasks)
    assert seeds[0] != seeds[1] and not th.equal(*drawn)
    folder = tmp_path / "1" / CHECKPOINT_FOLDER
    loaded = algorithm.load(folder / read_state(folder)["allocator"], env=make_env(), device="cpu", seed=5)
    again = make_its(n_epochs=2, n_pretraining_epochs=0, instances_per_epoch=8)
    loaded.learn(400, callback=again)
    assert loaded.stream_seed == seeds[1]


def test_a_seeded_run_keeps_its_streams():
    model = make_ppo(AllocatorPolicy, make_env(), n_steps=5, batch_size=10, seed=3, policy_kwargs=SMALL, device="cpu")
    its = make_its(n_epochs=1, n_pretraining_epochs=0, instances_per_epoch=8)
    model.learn(200, callback=its)
    assert model.stream_seed == 3
