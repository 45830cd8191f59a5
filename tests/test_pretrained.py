"""The pairs that come with the package: intact, small, for any fleet, and found by name."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solver_helpers import objectives

from sb3_uav import pretrained
from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv, UniformGenerator, WorldGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.solvers import make_solver
from sb3_uav.solvers.dl_drl import load_dl_drl
from sb3_uav.solvers.network_solver import parameters_hash
from sb3_uav.solvers.sb3_zip import load_sb3
from scripts import release

NAMES = pretrained.names()


def test_the_default_is_there() -> None:
    assert pretrained.DEFAULT_PAIR in NAMES


@pytest.mark.parametrize("name", NAMES)
def test_zips_are_small_and_load(name: str) -> None:
    """Without pickles; and with SB3's own load, to be trained on."""
    classes: tuple[Any, Any] = (AllocatorPolicy, RouterPolicy)
    for file, policy_class in zip(pretrained.files(name), classes, strict=True):
        assert file.stat().st_size < 4e6
        assert isinstance(load_policy(file, "cpu", policy_class), policy_class)
        model = REINFORCE.load(file, device="cpu")
        assert isinstance(model.policy, policy_class) and not model.policy.optimizer.state_dict()["state"]
        with zipfile.ZipFile(file) as archive:
            # Nothing that tells on whose machine it was made.
            assert "system_info.txt" not in archive.namelist()
            assert not re.search(rb"/(tmp|home|root|work)/", archive.read("data"))


@pytest.mark.parametrize("name", NAMES)
def test_model_cards_tell_what_they_must(name: str) -> None:
    card = (Path(pretrained.__file__).parent / name / "README.md").read_text(encoding="utf-8")
    for heading in ("## Training", "## Results", "## Limits"):
        assert heading in card
    assert "sb3_uav.zoo.train" in card and "seed" in card


def test_a_pair_serves_fleets_of_unlike_uavs() -> None:
    """Better than K-means and the nearest task."""
    instances = WorldGenerator(40, 4, whole_share=1.0, paper_share=0.0)(16, np.random.default_rng(0))
    assert not instances.has_equal_uavs
    trained = objectives(make_solver("dl-drl:allocator=world,decode=sampling,samples=16"), instances).mean()
    assert trained > 1.1 * objectives(make_solver("kmeans-nearest"), instances).mean()


@pytest.mark.parametrize("n_uavs, n_tasks, max_distance", [(1, 1, 0.5), (2, 20, 2.0), (5, 60, 1.0), (8, 120, 3.0)])
def test_one_pair_serves_any_fleet(n_uavs: int, n_tasks: int, max_distance: float) -> None:
    """Better than K-means and the nearest task, which random allocations are not."""
    instances = UniformGenerator(n_tasks, n_uavs, max_distance)(12, np.random.default_rng(0))
    trained = objectives(make_solver("dl-drl:decode=sampling,samples=16"), instances).mean()
    assert trained >= objectives(make_solver("kmeans-nearest"), instances).mean()


def test_names_and_zips() -> None:
    allocator, router = pretrained.files()
    assert pretrained.pair_files() == pretrained.pair_files("universal") == (allocator, router)
    assert pretrained.pair_files("universal", "r.zip") == (allocator, Path("r.zip"))
    assert pretrained.pair_files("a.zip", "r.zip") == (Path("a.zip"), Path("r.zip"))
    assert load_dl_drl("universal").settings() == load_dl_drl(str(allocator), str(router)).settings()
    with pytest.raises(ValueError, match=r"a\.zip is one zip of a pair, and its router is missing"):
        pretrained.pair_files("a.zip")
    with pytest.raises(ValueError, match=r"There is no trained pair 'magic'; choose one of \['universal', 'world'\]"):
        pretrained.files("magic")


def test_routers_by_name_or_zip(tmp_path: Path) -> None:
    """The same in every place that takes a router."""
    shipped = pretrained.files()[1]
    assert pretrained.router_file("universal") == pretrained.router_file(shipped) == shipped
    assert pretrained.router_file(str(shipped.with_suffix(""))) == shipped
    env = TaskAllocationEnv(8, 2)
    model = pretrained.load("universal", env=env, router="universal", device="cpu")
    other = pretrained.load("universal", env=env, router=shipped, device="cpu")
    plans = [found.env.get_attr("problem")[0].router.__self__ for found in (model, other)]
    assert parameters_hash(plans[0]) == parameters_hash(plans[1]) == parameters_hash(load_policy(shipped, "cpu"))
    known = r"\['universal', 'world'\]"
    message = rf"^router: magic: no such file; give the zip of a router that was trained before, or one of {known}\.$"
    with pytest.raises(FileNotFoundError, match=message):
        pretrained.load("universal", env=env, router="magic")
    with pytest.raises(FileNotFoundError, match=message):
        load_sb3(str(pretrained.files()[0]), router="magic")
    assert load_sb3(str(pretrained.files()[0]), router="universal").files["router"] == shipped


def test_release(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is shipped plays as what was trained, is smaller, and can be trained on."""
    env = BatchedVecEnv([lambda: RoutePlanningEnv(12, max_distance=1.0)] * 2)
    policy: Any = RouterPolicy
    model: Any = REINFORCE(policy, env, n_samples=4, baseline="shared", device="cpu", seed=0, policy_kwargs=dict(embed_dim=16))
    model.learn_instances(4)
    model.save(tmp_path / "trained.zip")
    arguments = ["--allocator", tmp_path / "trained.zip", "--router", tmp_path / "trained.zip", "--out", tmp_path / "out"]
    release.main([str(argument) for argument in arguments])
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"allocator.zip", "router.zip"}
    assert str(tmp_path / "out" / "router.zip") in capsys.readouterr().out
    small = tmp_path / "out" / "router.zip"
    assert small.stat().st_size < (tmp_path / "trained.zip").stat().st_size
    again: Any = REINFORCE.load(small, env=env, device="cpu")
    assert parameters_hash(again.policy) == parameters_hash(model.policy)
    again.learn_instances(8)
    assert parameters_hash(again.policy) != parameters_hash(model.policy)
    release.release(REINFORCE, tmp_path / "trained.zip", tmp_path / "twice.zip")
    assert (tmp_path / "twice.zip").read_bytes() == small.read_bytes()
    with pytest.raises(FileNotFoundError, match=r"none\.zip: no such file"):
        release.release(REINFORCE, tmp_path / "none.zip", tmp_path / "x.zip")
