"""Any SB3 zip as a solver: schedules, sizes, masks, and what must be trusted."""

from __future__ import annotations

import base64
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO

from sb3_uav import pretrained
from sb3_uav.cli import main as cli
from sb3_uav.common.files import file_hash
from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, check_schedule
from sb3_uav.policies import AllocatorExtractor, AllocatorPolicy, RouterExtractor, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import make_solver

TINY: dict[str, Any] = dict(embed_dim=16, n_layers=1, n_heads=2, ff_dim=16)
N_TASKS, N_UAVS = 12, 3


def draw(n: int = 5, n_tasks: int = N_TASKS, n_uavs: int = N_UAVS, max_distance: float = 1.5) -> Instances:
    return UniformGenerator(n_tasks, n_uavs, max_distance)(n, np.random.default_rng(0))


def draw_reachable(n_uavs: int = N_UAVS) -> Instances:
    """All tasks can count, so that the solver does not leave any out."""
    return draw(n_uavs=n_uavs, max_distance=2.9)


def objectives(solver: Any, instances: Instances) -> list[float]:
    return [check_schedule(instances, row, result.schedule).objective for row, result in enumerate(solver.solve(instances))]


def save(folder: Path, algorithm: Any, level: str, stock: bool = True) -> Path:
    """A model of N_TASKS and N_UAVS with SB3's own MultiInputPolicy or with ours."""
    is_allocator = level == "allocator"
    make = (lambda: TaskAllocationEnv(N_TASKS, N_UAVS)) if is_allocator else (lambda: RoutePlanningEnv(N_TASKS))
    policy: Any = "MultiInputPolicy" if stock else AllocatorPolicy if is_allocator else RouterPolicy
    extractor = AllocatorExtractor if is_allocator else RouterExtractor
    kwargs = dict(features_extractor_class=extractor, features_extractor_kwargs=TINY, net_arch=[16]) if stock else TINY
    model = algorithm(policy, BatchedVecEnv([make] * 2), policy_kwargs=kwargs, n_steps=8, seed=1, device="cpu")
    path = folder / f"{algorithm.__name__}_{level}_{stock}.zip"
    model.save(path)
    return path


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("algo, algorithm", [("ppo", PPO), ("a2c", A2C), ("ppo_mask", MaskablePPO), ("reinforce", REINFORCE)])
@pytest.mark.parametrize("level", ["allocator", "router"])
def test_stock_policies_solve(level: str, algo: str, algorithm: Any, tmp_path: Path, recwarn: Any) -> None:
    """The schedule is what the environment's step loop gives, and feasible."""
    path = save(tmp_path, algorithm, level)
    solver = make_solver(f"sb3:zip={path},algo={algo},trust=1")
    assert solver.files == {"zip": path} and (solver.settings() or {})["policy"] == file_hash(path)
    instances = draw_reachable()
    found = objectives(solver, instances)
    assert min(found) > 0
    model = algorithm.load(path, device="cpu")
    if level == "allocator":
        env, expected = TaskAllocationEnv(N_TASKS, N_UAVS), []
        for row in range(len(instances)):
            observation, _ = env.reset(options={"instance": instances[row]})
            terminated = False
            while not terminated:
                action = model.predict(observation, deterministic=True)[0]
                observation, reward, terminated, _, _ = env.step(action)
            expected.append(reward)
        # Untrained, it gives all tasks to few UAVs.
        assert found == expected and min(found) < N_TASKS
    illegal = [str(warning.message) for warning in recwarn if "actions were illegal" in str(warning.message)]
    # MaskablePPO and REINFORCE have masks; an unmasked router's first illegal action ends the tour.
    assert bool(illegal) == (level == "router" and algo in ("ppo", "a2c"))
    if illegal:
        assert "each sent its UAV home" in illegal[0] and "MaskablePPO" in illegal[0]


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_router_alone_plays_its_environment(tmp_path: Path) -> None:
    path = save(tmp_path, MaskablePPO, "router")
    model, env = MaskablePPO.load(path, device="cpu"), RoutePlanningEnv(N_TASKS)
    instances = draw_reachable(n_uavs=1)
    solver = make_solver(f"sb3:zip={path},algo=ppo_mask,trust=1")
    for row, result in enumerate(solver.solve(instances)):
        observation, _ = env.reset(options={"instance": instances[row]})
        terminated, tour = False, []
        while not terminated:
            action = int(model.predict(observation, deterministic=True, action_masks=env.action_masks())[0])
            observation, _, terminated, _, _ = env.step(action)
            tour += [action - 1] if action > 0 else []
        assert [list(route) for route in result.schedule.routes] == [tour]


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_sizes_of_stock_policies(tmp_path: Path) -> None:
    allocator, router = save(tmp_path, PPO, "allocator"), save(tmp_path, MaskablePPO, "router")
    solver = make_solver(f"sb3:zip={allocator},algo=ppo,trust=1,name=mine")
    with pytest.raises(ValueError, match="mine: its policy was trained on 12 tasks and 3 UAVs, the instances have 13 tasks"):
        solver.check(draw(n_tasks=13))
    with pytest.raises(ValueError, match="12 tasks and 3 UAVs, the instances have 12 tasks and 2 UAVs"):
        solver.solve(draw(n_uavs=2))
    tours = make_solver(f"sb3:zip={router},algo=ppo_mask,trust=1")
    with pytest.raises(ValueError, match="trained on 12 tasks, the instances have 13 tasks; such a policy serves"):
        tours.check(draw(n_tasks=13))
    # Fewer tasks are padded, one by one or in a batch of several sizes; a router serves any fleet.
    small = draw(n_tasks=7)
    mixed = Instances.concatenate([small.pad(N_TASKS), draw()])
    assert objectives(solver, mixed)[:5] == objectives(solver, small) and objectives(solver, mixed)[5:] == objectives(
        solver, draw()
    )
    assert len(objectives(tours, draw(n_uavs=2))) == len(objectives(tours, small)) == 5


def test_our_policies_need_no_trust_and_serve_any_size(tmp_path: Path) -> None:
    """Step by step they give what the fused driver gives."""
    pair = f"sb3:zip={pretrained_zip('allocator')},router=universal"
    instances = draw(6, 30, 4)
    assert objectives(make_solver(pair), instances) == objectives(make_solver("dl-drl"), instances)
    assert (make_solver(pair).settings() or {})["task_order"] == "sweep"
    router = make_solver(f"sb3:zip={pretrained_zip('router')}")
    assert objectives(router, instances) == objectives(make_solver(f"kmeans-am:router={pretrained_zip('router')}"), instances)
    nearest = make_solver(f"sb3:zip={pretrained_zip('allocator')}")
    assert (nearest.settings() or {})["router"] == "nearest task"
    assert sum(objectives(nearest, instances)) <= sum(objectives(make_solver(pair), instances))
    path = save(tmp_path, REINFORCE, "allocator", stock=False)
    assert len(objectives(make_solver(f"sb3:zip={path.with_suffix('')}"), draw(3, 15, 2))) == 3


def pretrained_zip(level: str) -> Path:
    return pretrained.files()[level == "router"]


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_nothing_is_executed_without_trust(tmp_path: Path) -> None:
    proof = tmp_path / "executed"

    class Malicious:
        def __reduce__(self) -> Any:
            return Path.touch, (proof,)

    path, evil = save(tmp_path, PPO, "allocator"), tmp_path / "evil.zip"
    payload = base64.b64encode(pickle.dumps(Malicious())).decode()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(evil, "w") as new:
        data = json.loads(old.read("data"))
        data["policy_class"][":serialized:"] = payload
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    for spec in (f"sb3:zip={evil}", f"sb3:zip={evil},algo=ppo", f"sb3:zip={evil},algo=ppo,trust=0"):
        with pytest.raises(ValueError, match=r"evil\.zip: .*option trust=1, which unpickles .* only for files that you trust"):
            make_solver(spec)
    assert not proof.exists()
    with pytest.raises(ValueError, match=r"evil\.zip: algo 'ppo' cannot load it"):
        make_solver(f"sb3:zip={evil},algo=ppo,trust=1")
    assert proof.exists()


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_wrong_options_are_named(tmp_path: Path) -> None:
    path, router = save(tmp_path, PPO, "allocator"), save(tmp_path, MaskablePPO, "router")
    PPO("MlpPolicy", "CartPole-v1", device="cpu").save(tmp_path / "cart.zip")
    (tmp_path / "text.zip").write_text("no zip")
    cases = [
        (f"zip={path},trust=1", "the option 'algo' is missing; name the algorithm that saved it"),
        (f"zip={path},algo=magic,trust=1", "algo is 'magic'; choose one of reinforce, ppo"),
        (f"zip={tmp_path / 'cart.zip'},algo=ppo,trust=1", "are not those of a TaskAllocation or RoutePlanning environment"),
        (f"zip={tmp_path / 'text.zip'},algo=ppo,trust=1", "is not an intact zip"),
        (f"zip={path},algo=ppo,trust=1,router={path}", "RouterPolicy is needed here"),
        (f"zip={path},algo=ppo,trust=1,task_order=alphabet", "task_order is 'alphabet'"),
        (f"zip={router},algo=ppo_mask,trust=1,router=universal", "option 'router' is for the zip of an allocator"),
        (f"zip={router},algo=ppo_mask,trust=1,task_order=sweep", "option 'task_order' is for the zip of an allocator"),
        ("algo=ppo", "needs the option zip="),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            make_solver(f"sb3:{options}")
    with pytest.raises(FileNotFoundError, match=r"none\.zip: no such file"):
        make_solver("sb3:zip=none.zip,algo=ppo,trust=1")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_beside_other_solvers_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = save(tmp_path, PPO, "allocator")
    draw(3).save(tmp_path / "small.npz")
    draw(3, 13).save(tmp_path / "large.npz")
    flags = ["evaluate", "--out", str(tmp_path / "out"), "--device", "cpu", "--solvers", "kmeans-nearest"]
    solver = f"sb3:zip={path},algo=ppo,trust=1,router=universal,name=mine"
    assert cli.main([*flags, solver, "--instances", str(tmp_path / "small.npz")]) == 0
    rows = (tmp_path / "out" / "results.csv").read_text().splitlines()
    assert sum("mine" in row for row in rows) == 3
    record = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert file_hash(path) in json.dumps(record)
    assert cli.main([*flags, solver, "--instances", str(tmp_path / "large.npz"), "--overwrite"]) == 3
    assert "trained on 12 tasks and 3 UAVs, the instances have 13 tasks" in capsys.readouterr().err
