"""The last checkpoints of a run are kept, and a run continues from any of them."""

import json
from pathlib import Path
from typing import Any

import pytest
from its_runs import equal, learn, make_allocator, make_env, make_its, snapshot
from stable_baselines3.common.callbacks import CallbackList

from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import kept_checkpoints
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state, router_of, write_checkpoint
from sb3_uav.training.kept_checkpoints import STATE_FILE, earlier_states
from sb3_uav.zoo.checkpoints import PairCheckpointCallback, find_router


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix in (".zip", ".json"))


@pytest.mark.parametrize("keep", [1, 2, 100])
def test_as_many_checkpoints_are_kept_as_asked_for(keep, tmp_path):
    its = make_its(save_path=str(tmp_path), n_epochs=3, keep_checkpoints=keep)
    learn(make_allocator(), its)
    folder = tmp_path / CHECKPOINT_FOLDER
    states = [read_state(folder), *(read_state(folder, path.name) for path in earlier_states(folder))]
    epochs = [state["epoch"] for state in states]
    # Two of pre-training and three of the allocator.
    assert epochs == [3, 2, 1, 0, 0][:keep]
    zips = {state[level] for state in states for level in ("allocator", "router")}
    assert zips == {name for name in names(folder) if name.endswith(".zip")}
    for state in states:
        assert router_of(folder, state["allocator"]) in zips
    assert find_router(folder / "allocator_3.zip") == folder / states[0]["router"]


@pytest.mark.parametrize("value", [0, -1, 1.5])
def test_at_least_one_is_kept(value):
    with pytest.raises(ValueError, match=r"keep_checkpoints is .*; it must be a whole number of at least 1"):
        make_its(keep_checkpoints=value)


def test_a_run_continues_from_an_earlier_checkpoint(tmp_path):
    """Its end is that of the unbroken run, and what came after the earlier checkpoint is replaced."""
    its = make_its(save_path=str(tmp_path), n_epochs=4)
    model = make_allocator()
    learn(model, its)
    folder = tmp_path / CHECKPOINT_FOLDER
    earlier = REINFORCE.load(folder / "allocator_2.zip", env=make_env(), device="cpu")
    assert read_state(folder)["epoch"] == 4
    assert find_router(folder / "allocator_2.zip") == folder / "router_4.zip"
    again = make_its(save_path=str(tmp_path), n_epochs=3)
    learn(earlier, again)
    assert [record.epoch for record in again.records if record.level == "allocator"] == [1, 2, 3]
    assert read_state(folder)["epoch"] == 3 and "allocator_4.zip" not in names(folder)
    finished = make_its(save_path=str(tmp_path), n_epochs=4)
    resumed = REINFORCE.load(folder / "allocator_3.zip", env=make_env(), device="cpu")
    learn(resumed, finished)
    assert equal(snapshot(model.policy), snapshot(resumed.policy))
    assert equal(snapshot(its.router.policy), snapshot(finished.router.policy))


def test_old_ones_are_removed_only_when_the_new_one_is_whole(tmp_path, monkeypatch):
    its = make_its(save_path=str(tmp_path), n_epochs=2, keep_checkpoints=1)
    learn(make_allocator(), its)
    folder = tmp_path / CHECKPOINT_FOLDER
    before = names(folder)
    write = kept_checkpoints.write_atomically

    def full(path: Path, content: Any) -> None:
        if path.name == STATE_FILE:
            raise OSError("No space left on device")
        write(path, content)

    monkeypatch.setattr("sb3_uav.training.its_checkpoint.write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        write_checkpoint(folder, its.model, its.router, 7, its.records, True, 1.0, None)
    assert set(before) <= set(names(folder)) and read_state(folder)["epoch"] == 2
    monkeypatch.undo()
    write_checkpoint(folder, its.model, its.router, 7, its.records, True, 1.0, None)
    assert names(folder) == ["allocator_7.zip", "its_state.json", read_state(folder)["router"]]


def test_a_kept_state_whose_zip_is_gone_is_dropped(tmp_path):
    its = make_its(save_path=str(tmp_path), n_epochs=2)
    learn(make_allocator(), its)
    folder = tmp_path / CHECKPOINT_FOLDER
    (folder / "allocator_1.zip").unlink()
    (folder / "its_state_0_x.json").write_text(json.dumps({}))
    write_checkpoint(folder, its.model, its.router, 3, its.records, True, 1.0, None, keep=3)
    assert [json.loads(path.read_text())["epoch"] for path in earlier_states(folder)] == [2, 0]


def test_checkpoints_of_save_freq_can_be_limited(tmp_path):
    its = make_its(save_path=str(tmp_path), n_epochs=2)
    keeping = PairCheckpointCallback(4, str(tmp_path), keep=2)
    make_allocator().learn(10**9, callback=CallbackList([its, keeping]))
    models = sorted(tmp_path.glob("rl_model_*_steps.zip"), key=lambda path: int(path.stem.split("_")[2]))
    assert len(models) == 2 and keeping.n_calls // 4 > 2
    assert int(models[-1].stem.split("_")[2]) == keeping.n_calls // 4 * 16
    assert {find_router(path) for path in models} == set(tmp_path.glob("router_*_steps.zip"))
