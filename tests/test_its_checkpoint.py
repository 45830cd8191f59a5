"""Files of an ITS run, and resuming it."""

import csv
import json
from typing import Any

import pytest
from its_runs import N_TASKS, PAPER, equal, learn, make_allocator, make_env, make_its, trace
from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common.epoch_log import LOG_FILE
from sb3_uav.envs import (
    check_schedule,
    plan_tours,
    schedules,
)
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state
from sb3_uav.training.router_trainer import RouterTrainer

pytestmark = pytest.mark.filterwarnings("ignore:ITSCallback saves no router")


def test_zips_and_log_are_left_in_the_folder(tmp_path):
    its = make_its(save_path=str(tmp_path))
    model = make_allocator()
    learn(model, its)
    router = REINFORCE.load(tmp_path / "router.zip")
    assert isinstance(router.policy, RouterPolicy) and equal(router.policy.state_dict(), its.router.policy.state_dict())
    with (tmp_path / LOG_FILE).open() as file:
        rows = list(csv.DictReader(file))
    assert [row["level"] for row in rows] == [record.level for record in its.records]
    columns = ["epoch", "level", "phase", "n_instances", "objective", "seconds", "generation_seconds", "cpu_seconds"]
    assert list(rows[0]) == columns
    for record in rows:
        assert float(record["cpu_seconds"]) > 0
        generated = float(record["generation_seconds"])
        assert 0 <= generated <= float(record["seconds"])
        # The first epoch of an intensive block may have left enough for the second.
        if record["level"] == "allocator" or record["phase"] != "intensive":
            assert (generated > 0) == (record["level"] == "router" and record["phase"] == "alternate")
    assert all(0 <= float(row["objective"]) <= N_TASKS and int(row["n_instances"]) == 8 for row in rows)
    folder = tmp_path / CHECKPOINT_FOLDER
    kept = ["allocator_4.zip", "allocator_5.zip", "allocator_6.zip", "its_state.json", "its_state_4_6.json"]
    kept += ["its_state_5_7.json", "router_6.zip", "router_7.zip", "router_8.zip"]
    assert sorted(path.name for path in folder.iterdir()) == kept
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
    """Interrupted in any phase, after pre-training included: allocator, router and log equal those of an unbroken run."""
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
    original = RouterTrainer.learn

    def interrupted(self, size, planned, *args):
        if planned == 3 * size:
            raise KeyboardInterrupt
        return original(self, size, planned, *args)

    with monkeypatch.context() as patch:
        patch.setattr(RouterTrainer, "learn", interrupted)
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


def test_a_complete_run_has_nothing_left_to_learn(tmp_path):
    learn(make_allocator(), make_its(n_epochs=1, save_path=str(tmp_path)))
    folder = tmp_path / CHECKPOINT_FOLDER
    resumed = REINFORCE.load(folder / read_state(folder)["allocator"], env=make_env())
    with pytest.warns(UserWarning, match=r"its_checkpoint: this run already has 1 of 1 epochs.*Raise n_epochs"):
        learn(resumed, make_its(n_epochs=1, save_path=str(tmp_path)))
    assert resumed.n_instances == 8


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


def test_trained_allocator_without_its_router_is_refused():
    model = make_allocator().learn_instances(8)
    with pytest.raises(ValueError, match="set resume_from to the its_checkpoint folder"):
        model.learn(100, callback=make_its(), reset_num_timesteps=False)


INTACT: dict[str, Any] = dict(epoch=3, allocator="allocator_3.zip", router="router_5.zip", records=[])
RECORD: dict[str, Any] = dict(epoch=1, level="router", phase="alternate", n_instances=8, objective=1.5, seconds=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"epoch": 3', "not an intact state file"),
        ("\xff", "not an intact state file"),
        ("[1]", r"it holds \[1\] in place of a mapping"),
        ("null", "it holds None in place of a mapping"),
        (json.dumps(dict(epoch=3)), r"fields \['allocator', 'records', 'router'\] are missing"),
        (json.dumps({**INTACT, "epoch": "3"}), "epoch is '3'"),
        (json.dumps({**INTACT, "epoch": -1}), "epoch is -1"),
        (json.dumps({**INTACT, "router": 5}), "router is 5, not the name of a zip"),
        (json.dumps({**INTACT, "allocator": "../other/model.zip"}), "allocator is '../other/model.zip', not the name"),
        (json.dumps({**INTACT, "warm_started": "yes"}), "warm_started is 'yes'"),
        (json.dumps({**INTACT, "share": 0}), "share is 0"),
        (json.dumps({**INTACT, "share": "half"}), "share is 'half'"),
        (json.dumps({**INTACT, "records": {"epoch": 1}}), "records is {'epoch': 1}"),
        (json.dumps({**INTACT, "records": [1]}), "record 0 is 1"),
        (json.dumps({**INTACT, "records": [RECORD, dict(epoch=1)]}), "record 1 is {'epoch': 1}"),
        (json.dumps({**INTACT, "records": [{**RECORD, "epoch": None}]}), "record 0 is"),
        (json.dumps({**INTACT, "records": [{**RECORD, "objective": "many"}]}), "record 0 is"),
    ],
)
def test_damaged_state_files_are_named(text, message, tmp_path):
    """Never a traceback of another kind, whatever JSON the file holds."""
    (tmp_path / "its_state.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=rf"its_state\.json: .*{message}"):
        read_state(tmp_path)


def test_intact_state_files_are_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"its_state.json: no such file; give the its_checkpoint folder"):
        read_state(tmp_path)
    state = {**INTACT, "records": [{**RECORD, "objective": float("nan")}]}
    (tmp_path / "its_state.json").write_text(json.dumps(state))
    assert read_state(tmp_path)["router"] == "router_5.zip"


def test_allocator_of_another_epoch_is_refused(tmp_path):
    its = make_its(save_path=str(tmp_path), n_epochs=2)
    learn(make_allocator(), its)
    model = make_allocator()
    with pytest.raises(ValueError, match="the checkpoint is of epoch 2, the allocator of epoch 0; train the allocator of"):
        learn(model, make_its(resume_from=str(tmp_path / CHECKPOINT_FOLDER)))
