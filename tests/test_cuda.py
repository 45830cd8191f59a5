"""What runs on a GPU runs as on a CPU: the same tests on both, and models that move between them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import instance_batches, random_legal, seeds
from hypothesis import given, settings
from torch import nn

from sb3_uav.envs import (
    AllocationProblem,
    BatchedVecEnv,
    FixedGenerator,
    Instances,
    RoutePlanningEnv,
    RoutingProblem,
    TaskAllocationEnv,
    UniformGenerator,
    check_schedule,
    nearest_feasible,
)
from sb3_uav.envs.problem import Problem
from sb3_uav.policies import AllocatorPolicy, EpisodicPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import DLDRL
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state

TINY: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
N_TASKS, N_UAVS, N_ENVS = 6, 2, 4
# How far two actions may be apart, in log-probability, that devices rank differently.
NEAR_TIE = 1e-3

needs_cuda = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
devices = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_cuda)])
presets = pytest.mark.parametrize("preset", ["default", "paper"])
learners = pytest.mark.parametrize(("level", "baseline"), [("allocator", "rollout"), ("router", "critic")])


def make_env(level: str) -> Any:
    if level == "allocator":
        return BatchedVecEnv([lambda: TaskAllocationEnv(N_TASKS, N_UAVS, max_distance=1.2)] * N_ENVS)
    return BatchedVecEnv([lambda: RoutePlanningEnv(N_TASKS, max_distance=1.2)] * N_ENVS)


def make_model(level: str, baseline: str, device: str, preset: str = "default") -> Any:
    kwargs: dict[str, Any] = dict(n_samples=2, instances_per_epoch=2 * N_ENVS, learning_rate=1e-2, seed=0)
    if baseline == "rollout":
        kwargs["baseline_kwargs"] = dict(n_test_instances=16)
    policy = AllocatorPolicy if level == "allocator" else RouterPolicy
    return REINFORCE(
        policy, make_env(level), baseline=baseline, device=device, policy_kwargs=dict(TINY, preset=preset), **kwargs
    )


def draw(level: str, n: int, n_tasks: int = 20) -> Instances:
    generator = UniformGenerator(n_tasks, N_UAVS if level == "allocator" else 1)
    return generator(n, np.random.default_rng(0))


def assert_on(module: nn.Module, device: str) -> None:
    assert {tensor.device.type for tensor in (*module.parameters(), *module.buffers())} == {device}


def assert_equal_states(expected: Any, found: Any) -> None:
    """Equal tensors and numbers in nested dictionaries and lists, on whatever devices."""
    if isinstance(expected, th.Tensor):
        assert th.equal(expected.cpu(), found.cpu())
    elif isinstance(expected, dict):
        assert expected.keys() == found.keys()
        for key, value in expected.items():
            assert_equal_states(value, found[key])
    elif isinstance(expected, list):
        assert len(expected) == len(found)
        for one, two in zip(expected, found, strict=True):
            assert_equal_states(one, two)
    else:
        assert expected == found


def pad_steps(actions: th.Tensor, n_steps: int, padding: int = 0) -> th.Tensor:
    return nn.functional.pad(actions, (0, n_steps - actions.shape[-1]), value=padding)


def assert_same_decisions(expected: Any, found: Any, instances: Instances) -> None:
    """
    Greedy episodes are the same up to the first near-tie.

    :param expected: A policy on any device
    :param found: The same policy on any device
    :param instances: What they play, on the CPU
    """
    one = expected.decode_episodes(instances.to(expected.device)).cpu()
    two = found.decode_episodes(instances.to(found.device)).cpu()
    n_steps = max(one.shape[-1], two.shape[-1])
    one, two = pad_steps(one, n_steps), pad_steps(two, n_steps)
    with th.no_grad():
        log_probs = [
            expected.evaluate_episodes(instances.to(expected.device), actions.to(expected.device)).log_prob.cpu()
            for actions in (one, two)
        ]
    differs = one != two
    first = differs & (differs.cumsum(-1) == 1)
    # Up to there the episodes are the same, so the log-probabilities are those of two actions in one state.
    assert ((log_probs[0] - log_probs[1])[first].abs() < NEAR_TIE).all()
    assert differs.any(-1).double().mean() < 0.1


# ------------------------------------------------------------------------------------------------------------ REINFORCE


@devices
@presets
@learners
def test_reinforce_trains_and_moves_between_devices(
    level: str, baseline: str, preset: str, device: str, tmp_path: Path
) -> None:
    """Train, save, load on both devices, decide alike there, and go on training."""
    model = make_model(level, baseline, device, preset)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    # Three epochs: the rollout baseline stops warming up after the first.
    model.learn_instances(6 * N_ENVS)
    assert model._n_updates == 6 and model.epoch == 3
    assert_on(model.policy, device)
    changed = [not th.equal(value, before[name]) for name, value in model.policy.state_dict().items()]
    assert sum(changed) > len(changed) / 2
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    model.save(tmp_path / "model")

    instances = draw(level, 40)
    for target in dict.fromkeys(["cpu", device]):
        loaded = REINFORCE.load(tmp_path / "model", env=make_env(level), device=target)
        assert_on(loaded.policy, target)
        assert_equal_states(model.get_parameters(), loaded.get_parameters())
        assert_same_decisions(model.policy, loaded.policy, instances)
        if baseline == "rollout":
            assert loaded.baseline_policy is not None
            assert_on(loaded.baseline_policy, target)
            assert_same_decisions(model.baseline_policy, loaded.baseline_policy, instances)
        alone = load_policy(tmp_path / "model.zip", device=target)
        assert_on(alone, target)
        assert_same_decisions(model.policy, alone, instances)
        loaded.learn_instances(2 * N_ENVS)
        assert loaded.epoch == 4 and loaded._n_updates == 8
        assert all(th.isfinite(value).all() for value in loaded.policy.state_dict().values())


@devices
@pytest.mark.parametrize("level", ["allocator", "router"])
def test_step_loop_on_the_device(level: str, device: str) -> None:
    """``predict`` and ``evaluate_actions`` take observations from the CPU's environment and agree with the fused decode."""
    policy: EpisodicPolicy = make_model(level, "none", device).policy
    policy.set_training_mode(False)
    instances = draw(level, N_ENVS, N_TASKS)
    actions = policy.decode_episodes(instances.to(device), deterministic=False)
    evaluation = policy.evaluate_episodes(instances.to(device), actions)
    env = make_env(level)
    env.set_options([{"instance": instances[i]} for i in range(N_ENVS)])
    observation = env.reset()
    running = np.ones(N_ENVS, dtype=bool)
    for step in range(actions.shape[-1]):
        chosen, _ = policy.predict(observation)
        assert env.action_masks()[np.arange(N_ENVS), chosen].all()
        tensor, _ = policy.obs_to_tensor(observation)
        with th.no_grad():
            values, log_prob, entropy = policy.evaluate_actions(tensor, actions[:, 0, step])
        assert entropy is not None
        rows = th.from_numpy(running).to(device)
        for fused, looped in (
            (evaluation.log_prob, log_prob),
            (evaluation.values, values[:, 0]),
            (evaluation.entropy, entropy),
        ):
            th.testing.assert_close(fused[rows, 0, step], looped[rows], atol=1e-4, rtol=0)
        played = np.where(running, actions[:, 0, step].cpu().numpy(), env.action_masks().argmax(1))
        observation, _, dones, _ = env.step(played)
        running &= ~dones
    assert not running.any()


# ------------------------------------------------------------------------------------------------------------------ ITS


@devices
@presets
def test_its_trains_both_levels_on_the_device(preset: str, device: str, tmp_path: Path) -> None:
    """Pre-training, intensive and alternate training; the checkpoint resumes on the CPU."""
    router: dict[str, Any] = dict(
        policy="RouterPolicy",
        n_envs=N_ENVS,
        learning_rate=1e-2,
        baseline="rollout",
        baseline_kwargs=dict(n_test_instances=8),
        policy_kwargs=dict(TINY, preset=preset),
    )
    schedule: dict[str, Any] = dict(n_pretraining_epochs=1, n_intensive_epochs=1, n_continuous_epochs=1)
    its = ITSCallback(router, n_epochs=2, save_path=str(tmp_path), **schedule)
    model = make_model("allocator", "rollout", device, preset)
    model.learn(10**9, callback=its)
    expected = [("router", "pre-training"), ("allocator", "intensive"), ("router", "intensive")]
    expected += [("allocator", "alternate"), ("router", "alternate")]
    assert [(record.level, record.phase) for record in its.records] == expected
    assert all(np.isfinite(record.objective) for record in its.records)
    policies: list[Any] = [model.policy, its.router.policy]
    for policy in policies:
        assert_on(policy, device)
        assert all(th.isfinite(value).all() for value in policy.state_dict().values())

    folder = tmp_path / CHECKPOINT_FOLDER
    state = read_state(folder)
    for policy, level in zip(policies, ("allocator", "router"), strict=True):
        assert_equal_states(policy.state_dict(), load_policy(folder / state[level], device="cpu").state_dict())
    resumed = REINFORCE.load(folder / state["allocator"], env=make_env("allocator"), device="cpu")
    resumed_its = ITSCallback(router, n_epochs=3, save_path=str(tmp_path), resume_from=str(folder), **schedule)
    resumed.learn(10**9, callback=resumed_its, reset_num_timesteps=False)
    assert len(resumed_its.records) == 7 and resumed.epoch == 3
    assert_on(resumed_its.router.policy, "cpu")


# -------------------------------------------------------------------------------------------------------------- solvers


@devices
@presets
@pytest.mark.parametrize("decode", ["greedy", "sampling"])
def test_solver_on_the_device(decode: str, preset: str, device: str, tmp_path: Path) -> None:
    """Zips from the CPU, run on the device, give feasible schedules of instances of any size, padded ones too."""
    for level in ("allocator", "router"):
        make_model(level, "none", "cpu", preset).save(tmp_path / level)
    allocator = load_policy(tmp_path / "allocator.zip", device, AllocatorPolicy)
    router = load_policy(tmp_path / "router.zip", device, RouterPolicy)
    assert_on(allocator, device)
    assert_on(router, device)
    instances = Instances.concatenate([draw("allocator", 3, n_tasks) for n_tasks in (25, 9, 1)])
    # More than one block of samples.
    solver = DLDRL(allocator, router, decode, samples=100, batch_size=4)
    results = solver.solve(instances, seed=1)
    assert len(results) == len(instances)
    reachable = instances.reachable().any(1).tolist()
    for row, result in enumerate(results):
        report = check_schedule(instances, row, result.schedule)
        assert (report.objective > 0) == reachable[row]
    assert instances.device.type == "cpu"
    again = solver.solve(instances, seed=1)
    assert [result.schedule for result in again] == [result.schedule for result in results]


# ------------------------------------------------------------------------------------------------------------- dynamics


def assert_close_states(expected: Any, found: Any, device: str) -> None:
    for name, one in expected._asdict().items():
        two = getattr(found, name)
        assert two.device.type == device and two.dtype == one.dtype, name
        if one.is_floating_point():
            th.testing.assert_close(two.cpu(), one, rtol=1e-12, atol=0)
        else:
            assert th.equal(two.cpu(), one), name


@devices
@settings(max_examples=25)
@given(instances=instance_batches(), seed=seeds)
def test_dynamics_on_the_device_equal_those_on_the_cpu(device: str, instances: Instances, seed: int) -> None:
    """States, rewards and the batched answers of both problems, in random episodes on any instances."""
    moved = instances.to(device)
    assert moved.device.type == device
    assert th.equal(nearest_feasible(moved).cpu(), nearest_feasible(instances))
    generator = np.random.default_rng(seed)
    problems: list[Problem] = [AllocationProblem(FixedGenerator(instances)), RoutingProblem(FixedGenerator(instances))]
    for problem in problems:
        allocates = isinstance(problem, AllocationProblem)
        # What stands in actions after the end of an episode.
        padding = -1 if allocates else 0
        here, there = problem.dynamics(instances), problem.dynamics(moved)
        state, other = here.reset(2), there.reset(2)
        assert_close_states(state, other, device)
        played: list[th.Tensor] = []
        while not state.done.all():
            action = random_legal(state.action_mask, generator)
            played.append(action.masked_fill(state.done, padding))
            state, reward = here.step(state, action)
            other, other_reward = there.step(other, action.to(device))
            assert_close_states(state, other, device)
            th.testing.assert_close(other_reward.cpu(), reward, rtol=1e-12, atol=0)
        actions = pad_steps(th.stack(played, dim=-1), instances.n_tasks if allocates else len(played), padding)
        returns, other_returns = problem.returns(instances, actions), problem.returns(moved, actions.to(device))
        th.testing.assert_close(other_returns.cpu(), returns, rtol=1e-12, atol=0)
        assert th.equal(problem.lengths(moved, actions.to(device)).cpu(), problem.lengths(instances, actions))
        rewards = problem.step_rewards(instances, actions, returns)
        other_rewards = problem.step_rewards(moved, actions.to(device), other_returns)
        th.testing.assert_close(other_rewards.cpu(), rewards, rtol=1e-12, atol=0)
