"""What TensorBoard shows of a training, read from the event files: both levels on one axis, maps and hyperparameters."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from fixed_set_runs import NETWORK, ROLLOUT, make_callback, make_model
from its_runs import N_TASKS, SMALL, make_allocator, make_its
from PIL import Image
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure

from sb3_uav.common import tensorboard as our_tensorboard
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import imitation
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, read_state

accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

EVERYTHING = {"scalars": 0, "images": 0, "tensors": 0}


def events(folder: Path) -> Any:
    """All events of the one run in this folder, without those of folders inside it."""
    return accumulators.EventAccumulator(str(folder), size_guidance=EVERYTHING).Reload()


def scalars(folder: Path) -> dict[str, list[tuple[float, int, float]]]:
    """By key: time, step and value, in the order of writing."""
    read = events(folder)
    return {key: [(e.wall_time, e.step, e.value) for e in read.Scalars(key)] for key in read.Tags()["scalars"]}


def steps(found: dict[str, list[tuple[float, int, float]]], key: str) -> list[int]:
    return [step for _, step, _ in found[key]]


def pictures(folder: Path, key: str = "eval/schedule") -> tuple[list[int], list[np.ndarray]]:
    """Steps and pixels."""
    found = events(folder).Images(key)
    return [e.step for e in found], [np.asarray(Image.open(io.BytesIO(e.encoded_image_string))) for e in found]


def shown_hyperparameters(folder: Path) -> tuple[list[dict[str, Any]], set[str]]:
    """The lines of the HPARAMS tab that this run writes, and the keys of the values beside them."""
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.plugins.hparams import metadata

    lines: list[dict[str, Any]] = []
    metrics: set[str] = set()
    for path in sorted(folder.glob("events.out.tfevents.*")):
        for event in accumulators.event_file_loader.LegacyEventFileLoader(str(path)).Load():
            assert isinstance(event, Event)
            for value in event.summary.value:
                if value.metadata.plugin_data.plugin_name != metadata.PLUGIN_NAME:
                    continue
                content = value.metadata.plugin_data.content
                if value.tag == metadata.EXPERIMENT_TAG:
                    metrics |= {info.name.tag for info in metadata.parse_experiment_plugin_data(content).metric_infos}
                elif value.tag == metadata.SESSION_START_INFO_TAG:
                    given = metadata.parse_session_start_info_plugin_data(content).hparams
                    lines.append({name: getattr(v, str(v.WhichOneof("kind"))) for name, v in given.items()})
    return lines, metrics


def learn_its(folder: Path, model: Any = None, **kwargs: Any) -> Any:
    """A run of both levels with evaluations, which logs into this folder."""
    model = model or make_allocator(policy_kwargs=SMALL)
    model.set_logger(configure(str(folder), ["tensorboard", "csv"]))
    its = make_its(save_path=str(folder / "zips"), **kwargs)
    model.learn(10**9, callback=[its, make_callback(eval_freq=None)])
    return its


# ------------------------------------------------------------------------------------------------------ one axis


def test_both_levels_are_on_one_axis(tmp_path: Path) -> None:
    """Steps grow with the time of writing across pre-training, allocator and router, and end at the sum of both."""
    its = learn_its(tmp_path)
    allocator, router = scalars(tmp_path), scalars(tmp_path / "router")
    everything = sorted((time, step) for found in (allocator, router) for rows in found.values() for time, step, _ in rows)
    assert all(a[1] <= b[1] for a, b in itertools.pairwise(everything))
    total = its.model.num_timesteps + its.router.num_timesteps
    assert everything[-1][1] == total and its.model.shared_axis_steps == total
    # 6 allocator epochs of 8 instances with one step per task; SB3's keys are where they were.
    assert its.model.num_timesteps == 6 * 8 * N_TASKS
    assert {"rollout/ep_rew_mean", "train/loss", "eval/fixed_greedy", "its/router_objective"} <= allocator.keys()
    assert {"rollout/ep_rew_mean", "train/loss", "train/learning_rate"} <= router.keys()
    # Pre-training: each of its epochs has a point, all before the first evaluation of the allocator, and the router's
    # losses of these epochs are below it too.
    pretraining = steps(allocator, "its/router_objective")[: its.schedule.n_pretraining_epochs]
    first_evaluation = steps(allocator, "eval/fixed_greedy")[0]
    assert 0 < pretraining[0] < pretraining[1] == first_evaluation < steps(allocator, "rollout/ep_rew_mean")[0]
    assert steps(router, "train/loss")[0] < first_evaluation
    # The levels take turns on the axis: pre-training, then four blocks of each.
    both = (("a", allocator), ("r", router))
    turns = sorted((step, name) for name, found in both for step in steps(found, "rollout/ep_rew_mean"))
    assert "".join(name for name, _ in itertools.groupby(name for _, name in turns)) == "r" + "ar" * 4


def test_the_axis_counts_what_each_level_has_learned_from(tmp_path: Path) -> None:
    """At every point of a level, the axis is ahead of its own steps by exactly the other level's."""
    seen: list[tuple[int, int, int]] = []

    class Note(BaseCallback):
        def _on_rollout_end(self) -> None:
            seen.append((its._axis.total, self.model.num_timesteps, its.router.num_timesteps))

        def _on_step(self) -> bool:
            return True

    model, its = make_allocator(), make_its(save_path=str(tmp_path))
    model.learn(10**9, callback=[its, Note()])
    assert len(seen) == 12 and all(total == own + other for total, own, other in seen)
    assert seen[0][2] > 0 and len({other for *_, other in seen}) > 3


def test_a_resumed_run_continues_the_axis(tmp_path: Path) -> None:
    """From the zip of the checkpoint, in another folder, at the step where that zip was written."""
    learn_its(tmp_path / "first", n_epochs=3)
    checkpoint = tmp_path / "first" / "zips" / CHECKPOINT_FOLDER
    zipped = checkpoint / read_state(checkpoint)["allocator"]
    model = REINFORCE.load(zipped, env=make_allocator().env, device="cpu")
    length = model.shared_axis_steps  # type: ignore[attr-defined]
    its = learn_its(tmp_path / "second", model, resume_from=str(checkpoint))
    first = [scalars(tmp_path / "first" / name) for name in ("", "router")]
    second = [scalars(tmp_path / "second" / name) for name in ("", "router")]
    assert max(step for found in first for rows in found.values() for _, step, _ in rows) == length
    assert min(step for found in second for rows in found.values() for _, step, _ in rows) >= length
    # Three more epochs of the allocator and those of the router beside them.
    assert its._axis.total == length + 3 * 8 * N_TASKS + (its.router.num_timesteps - router_steps(checkpoint))


def router_steps(checkpoint: Path) -> int:
    return REINFORCE.load(checkpoint / read_state(checkpoint)["router"], device="cpu").num_timesteps


def test_a_second_call_of_learn_continues_the_axis(tmp_path: Path) -> None:
    """SB3 counts steps from 0 again, and makes another logger."""
    model = make_allocator(tensorboard_log=str(tmp_path))
    its = make_its(n_epochs=4, save_path=str(tmp_path / "zips"))
    model.learn(2 * 8 * N_TASKS, callback=its)
    length = its._axis.total
    model.learn(10**9, callback=its)
    runs = [scalars(tmp_path / name) for name in ("REINFORCE_1", "REINFORCE_2")]
    assert steps(runs[0], "rollout/ep_rew_mean")[-1] <= length < steps(runs[1], "rollout/ep_rew_mean")[0]


def test_the_router_may_be_another_algorithm(tmp_path: Path) -> None:
    router = dict(algo="ppo", n_steps=16, batch_size=16, n_epochs=1)
    its = learn_its(tmp_path, router=router, n_epochs=2)
    allocator, found = scalars(tmp_path), scalars(tmp_path / "router")
    assert steps(found, "train/approx_kl")[-1] <= its._axis.total
    assert steps(found, "rollout/ep_rew_mean")[-1] > steps(allocator, "eval/fixed_greedy")[0]


def test_sb3s_evaluation_is_on_the_axis_too(tmp_path: Path) -> None:
    model = make_allocator()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    its = make_its(n_epochs=2, save_path=str(tmp_path / "zips"))
    env = make_allocator().env
    model.learn(10**9, callback=[its, EvalCallback(env, n_eval_episodes=2, eval_freq=5, verbose=0)])
    found = scalars(tmp_path)
    assert steps(found, "eval/mean_reward")[0] > steps(found, "its/router_objective")[0] > 0


def test_other_trainings_keep_sb3s_axis(tmp_path: Path) -> None:
    model = make_model(PPO, "routing")
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(3 * ROLLOUT, callback=make_callback())
    assert steps(scalars(tmp_path), "eval/fixed_greedy") == [0, ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT]


def test_the_imitation_logs_its_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes the first part of the axis, as long as the number of moves that it learns from."""
    pytest.importorskip("numba")
    monkeypatch.setattr(imitation, "_REPORT_EVERY", 2)
    warm_start = dict(n_subsets=8, n_updates=6, batch_size=8, learning_rate=1e-2)
    its = learn_its(tmp_path, n_epochs=1, n_pretraining_epochs=1, warm_start=warm_start)
    router = scalars(tmp_path / "router")
    losses = router["imitation/nats_per_move"]
    assert len(losses) == 3 and all(0 < value < 3 for *_, value in losses)
    positions = [step for _, step, _ in losses]
    assert 0 < positions[0] < positions[1] < positions[2] < steps(router, "train/loss")[0]
    assert its._axis.total == positions[-1] + its.model.num_timesteps + its.router.num_timesteps


# ------------------------------------------------------------------------------------------------------ maps


@pytest.mark.parametrize("level", ["allocation", "routing"])
def test_every_evaluation_has_a_map(level: str, tmp_path: Path) -> None:
    """Of the same instance each time; it changes when the policy does, and only then."""
    pytest.importorskip("matplotlib")
    model = make_model(REINFORCE, level, policy_kwargs=dict(NETWORK, preset="paper"))
    model.set_logger(configure(str(tmp_path), ["tensorboard", "csv", "json", "log"]))
    callback = make_callback(eval_freq=ROLLOUT, save_path=tmp_path / "files")
    model.learn(2 * ROLLOUT, callback=callback)
    shown, drawn = pictures(tmp_path)
    assert shown == steps(scalars(tmp_path), "eval/fixed_greedy") and len(shown) >= 3
    assert all(picture.shape == drawn[0].shape and picture.shape[2] == 3 and picture.std() > 10 for picture in drawn)
    callback.evaluate()
    with undisturbed_random_state(), th.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    callback.evaluate()
    last, again, changed = pictures(tmp_path)[1][-3:]
    assert np.array_equal(last, again) and not np.array_equal(again, changed)


def test_the_title_has_the_objective(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one of the fixed set's first instance, which the picture shows."""
    matplotlib = pytest.importorskip("matplotlib")
    titles: list[str] = []
    original = matplotlib.axes.Axes.set_title

    def set_title(self: Any, label: str, *args: Any, **kwargs: Any) -> Any:
        titles.append(label)
        return original(self, label, *args, **kwargs)

    monkeypatch.setattr(matplotlib.axes.Axes, "set_title", set_title)
    model = make_model(REINFORCE)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    callback = make_callback()
    model.learn(2 * ROLLOUT, callback=callback)
    assert titles == [f"greedy: objective {value:g} of 5" for value in callback.history.results[:, 0]]


def test_no_map_without_tensorboard_or_matplotlib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither is an error, nor costs time."""

    def fail(*args: Any) -> Any:
        raise AssertionError("a map was drawn")

    monkeypatch.setattr("sb3_uav.training.fixed_set.greedy_map", fail)
    model = make_model(REINFORCE)
    model.set_logger(configure(str(tmp_path / "csv"), ["csv", "json", "log"]))
    model.learn(ROLLOUT, callback=make_callback())
    assert "eval/fixed_greedy" in (tmp_path / "csv" / "progress.csv").read_text()
    monkeypatch.setattr(our_tensorboard, "find_spec", lambda name: None)
    model = make_model(REINFORCE)
    model.set_logger(configure(str(tmp_path / "events"), ["tensorboard"]))
    model.learn(ROLLOUT, callback=make_callback())
    tags = events(tmp_path / "events").Tags()
    assert "eval/fixed_greedy" in tags["scalars"] and tags["images"] == []


def test_maps_do_not_change_the_training(tmp_path: Path) -> None:
    trained = []
    for name, outputs in (("with", ["tensorboard"]), ("without", ["csv"])):
        model = make_model(REINFORCE, policy_kwargs=dict(NETWORK, preset="paper"))
        model.set_logger(configure(str(tmp_path / name), outputs))
        model.learn(3 * ROLLOUT, callback=make_callback())
        trained.append(model.policy.state_dict())
    assert all(th.equal(value, trained[1][name]) for name, value in trained[0].items())


# ------------------------------------------------------------------------------------------------------ hyperparameters


def test_hyperparameters_of_both_levels(tmp_path: Path) -> None:
    """Once per run, beside values that the run writes under these names."""
    learn_its(tmp_path)
    (line,), metrics = shown_hyperparameters(tmp_path)
    expected = {
        "algo": "REINFORCE",
        "policy": "AllocatorPolicy",
        "preset": "default",
        "n_envs": 4,
        "n_samples": 1,
        "baseline": "exponential",
        "learning_rate": 0.01,
        "instances_per_epoch": 8,
        "seed": 0,
        "network/embed_dim": 8,
        "its/strategy": "its",
        "its/n_epochs": 6,
        "its/n_pretraining_epochs": 2,
        "its/n_continuous_epochs": 2,
        "router/algo": "REINFORCE",
        "router/learning_rate": 0.01,
        "router/network/embed_dim": 8,
    }
    assert {name: line.get(name) for name in expected} == pytest.approx(expected)
    assert metrics == {"eval/fixed_greedy", "eval/fixed_sampled", "eval/fixed_best"} <= scalars(tmp_path).keys()


def test_the_order_of_the_callbacks_does_not_matter(tmp_path: Path) -> None:
    """The router is made by the other callback, when the training starts."""
    model, its = make_allocator(), make_its(n_epochs=1, save_path=str(tmp_path / "zips"))
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(10**9, callback=[make_callback(eval_freq=None, save_path=tmp_path), its])
    (line,), _ = shown_hyperparameters(tmp_path)
    assert line["router/algo"] == "REINFORCE" and line["its/n_epochs"] == 1


def test_hyperparameters_of_ppo(tmp_path: Path) -> None:
    """Its constructor makes schedules of numbers; without sampling there is no such value."""
    model = make_model(PPO, "routing", policy_kwargs=dict(NETWORK, preset="paper"))
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(2 * ROLLOUT, callback=make_callback(n_samples=0))
    (line,), metrics = shown_hyperparameters(tmp_path)
    expected = {"algo": "PPO", "preset": "paper", "clip_range": 0.2, "learning_rate": 0.01, "n_steps": 5, "gamma": 1.0}
    assert {name: line.get(name) for name in expected} == pytest.approx(expected)
    assert not any(name.startswith(("its/", "router/")) for name in line)
    assert metrics == {"eval/fixed_greedy", "eval/fixed_best"} <= scalars(tmp_path).keys()


def test_each_run_has_its_own_line(tmp_path: Path) -> None:
    """A second call of `learn` that continues in the same folder adds none, one in a new folder does."""
    model = make_model(REINFORCE, tensorboard_log=str(tmp_path))
    callback = make_callback()
    model.learn(ROLLOUT, callback=callback)
    model.learn(ROLLOUT, callback=callback, reset_num_timesteps=False)
    model.learn(ROLLOUT, callback=callback)
    assert [len(shown_hyperparameters(tmp_path / f"REINFORCE_{number}")[0]) for number in (1, 2)] == [1, 1]
