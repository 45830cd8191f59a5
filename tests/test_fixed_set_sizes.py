"""Evaluation on fixed instances of several sizes during training, and its file formats."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from fixed_set_runs import NETWORK, ROLLOUT, allocation_env, load, make_callback, make_model

from sb3_uav.envs import BatchedVecEnv, Instances, UniformGenerator
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, SizeGridCallback
from sb3_uav.training.fixed_set_history import EvaluationHistory
from sb3_uav.training.fixed_set_returns import draw_fixed_set, evaluate_fixed_set
from sb3_uav.training.instance_sets import InstanceSets, SizeTable

SIZES = [[2, 9, 4], [3, 12, 2]]


def make_sized(folder: Path | None, **kwargs: Any) -> FixedSetEvalCallback:
    return make_callback(folder, sizes=SIZES, max_distance=1.5, **kwargs)


def test_several_sizes_are_evaluated_set_after_set(tmp_path):
    callback = make_sized(tmp_path)
    make_model(REINFORCE).learn(3 * ROLLOUT, callback=callback)
    history = load(tmp_path)
    assert history.results.shape == history.sampled.shape == (4, 6) and history.timesteps.tolist() == [0, 20, 40, 60]
    with (tmp_path / "size_grid.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert list(rows[0]) == ["updates", "seconds", "U2-N9", "U3-N12", "score"] and len(rows) == 4
    for row, results in zip(rows, history.results, strict=True):
        means = results[:4].mean(), results[4:].mean()
        assert (row["U2-N9"], row["U3-N12"]) == pytest.approx(means)
        assert row["score"] == pytest.approx(np.log(means).mean())
    assert callback.best_mean_reward == max(row["score"] for row in rows)
    # From the files alone.
    policy, problem = load_policy(tmp_path / "best_model.zip"), allocation_env().problem
    parts = [Instances.load(tmp_path / f"evaluation_instances-{name}.npz") for name in ("U2-N9", "U3-N12")]
    again = [evaluate_fixed_set(policy, problem, part, 0).greedy for part in parts]
    assert np.array_equal(np.concatenate(again), history.results[int(np.argmax([row["score"] for row in rows]))])


def test_sizes_are_the_same_for_every_training_and_differ_by_seed():
    tasks = []
    for seed in (0, 0, 1):
        sets = FixedSetEvalCallback(sizes=SIZES, seed=seed).sets
        assert sets is not None
        tasks.append(sets.sets["U2-N9"].tasks)
    assert th.equal(tasks[0], tasks[1]) and not th.equal(tasks[0], tasks[2])


def test_several_given_sets_are_named_by_size(tmp_path):
    parts = [UniformGenerator(n_tasks, 2)(2, np.random.default_rng(n_tasks)) for n_tasks in (5, 7)]
    parts[0].save(tmp_path / "a.npz")
    callback = FixedSetEvalCallback(instances=[str(tmp_path / "a.npz"), parts[1], parts[1]])
    assert callback.sets is not None and list(callback.sets.sets) == ["U2-N5", "U2-N7", "U2-N7/2"]
    assert callback.sets.is_grid and callback.instances is None


def test_updates_between_evaluations(tmp_path):
    """At the start, whenever a multiple is reached, and at the end."""
    callback = make_sized(tmp_path, eval_freq=None, eval_updates=2)
    make_model(REINFORCE).learn(5 * ROLLOUT, callback=callback)
    assert [row["updates"] for row in callback.table.rows] == [0, 2, 4, 5]


def test_a_resumed_run_continues_histories_of_several_sizes(tmp_path):
    model = make_model(REINFORCE)
    model.learn(2 * ROLLOUT, callback=make_sized(tmp_path / "first"))
    model.save(tmp_path / "model")
    model = REINFORCE.load(tmp_path / "model", env=BatchedVecEnv([allocation_env] * 4), device="cpu")
    callback = make_sized(tmp_path / "second")
    model.learn(2 * ROLLOUT, callback=callback)
    assert load(tmp_path / "second").timesteps.tolist() == [0, 20, 40, 60, 80]
    assert [row["updates"] for row in callback.table.rows] == [0, 1, 2, 3, 4]


@pytest.mark.filterwarnings("ignore:SizeGridCallback is deprecated")
def test_a_run_that_wrote_nothing_but_the_table_is_continued(tmp_path):
    """As versions did that had no history beside size_grid.csv, and kept the best pair as best_allocator.zip."""
    first = tmp_path / "first"
    model = make_model(REINFORCE)
    model.learn(4 * ROLLOUT, callback=SizeGridCallback(SIZES, freq=2, save_path=str(first)))
    old = SizeTable.load(first / "size_grid.csv", ["U2-N9", "U3-N12"]).rows
    for name in ("size_grid.npz", "best_model.zip", "best_pair.json"):
        (first / name).unlink(missing_ok=True)
    best = (first / "best_allocator.zip").read_bytes()
    del model.fixed_set_evaluations
    # None of what follows is as good.
    text = (first / "size_grid.csv").read_text().splitlines()
    rows = [line.rpartition(",")[0] + (",9.5" if number == 1 else ",1.0") for number, line in enumerate(text[1:], 1)]
    (first / "size_grid.csv").write_text("\n".join([text[0], *rows]) + "\n")
    callback = SizeGridCallback(SIZES, freq=2, save_path=str(first))
    model.learn(2 * ROLLOUT, callback=callback)
    updates = [row["updates"] for row in callback.records]
    assert updates == [row["updates"] for row in old] + [6] and callback.best_score == 9.5
    assert (first / "best_model.zip").read_bytes() == best


def test_size_grid_callback_says_what_replaces_it():
    with pytest.warns(DeprecationWarning, match="use FixedSetEvalCallback with sizes and eval_updates"):
        SizeGridCallback(SIZES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(sizes=[]), "sizes is empty; give at least one triple"),
        (dict(sizes=[[2, 9]]), r"sizes: \[2, 9\] must be three whole numbers"),
        (dict(sizes=[[2, 9, 0]]), r"sizes: \[2, 9, 0\] must be three whole numbers of at least 1"),
        (dict(sizes=[[2, 9, 4], [2, 9, 8]]), "sizes: 2 UAVs and 9 tasks stand twice"),
        (dict(sizes=[[2, 9, 4], [2, 9, 4, "uniform"]]), r"2 UAVs and 9 tasks stand twice \(uniform\); name every set once"),
        (dict(sizes=[[2, 9, 4, "clustered"], [2, 9, 8, "clustered"]]), r"tasks stand twice \(clustered\)"),
        (dict(sizes=SIZES, instances="set.npz"), "instances and sizes are both given"),
        (dict(instances=[]), "instances is empty"),
        (dict(eval_updates=0), "eval_updates is 0; it must be a whole number of at least 1"),
        (dict(eval_updates=5, eval_freq=5), "eval_freq and eval_updates are both given"),
    ],
)
def test_bad_sizes_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        FixedSetEvalCallback(**arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("updates,seconds,U2-N9,score\n0,1.0,many,2\n", "not an intact table of numbers"),
        ("updates,seconds,U2-N9,score\n0,1.0,3\n", "not an intact table of numbers"),
        ("updates,seconds,U2-N9,score\n0,1.0,3,4,5\n", "not an intact table of numbers"),
        ("updates,seconds,U4-N80,score\n0,1.0,3,4\n", "has columns .*belongs to other sizes"),
    ],
)
def test_damaged_tables_are_named(text, message, tmp_path):
    (tmp_path / "size_grid.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"size_grid\.csv: {message}"):
        SizeTable.load(tmp_path / "size_grid.csv", ["U2-N9"])


@pytest.mark.parametrize(
    "change",
    [
        dict(cpu_seconds=np.zeros((3, 3))),
        dict(timesteps=np.zeros((2, 1), dtype=np.int64)),
        dict(timesteps=np.int64(3)),
        dict(results=np.zeros(2)),
        dict(results=np.zeros((2, 7))),
        dict(sampled=np.zeros((2, 3))),
        dict(sampled=np.zeros((0, 0))),
        dict(ep_lengths=np.array([["a"] * 6] * 2)),
        dict(train_seconds=np.zeros(5)),
    ],
)
def test_histories_of_wrong_shapes_are_named(change, tmp_path):
    """No IndexError later on, and a training with them begins a new history."""
    model = make_model()
    model.learn(ROLLOUT, callback=make_callback(tmp_path))
    path = tmp_path / "evaluations.npz"
    arrays = {**EvaluationHistory.load(path)._asdict(), **change}
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=rf"evaluations\.npz: {'ep_lengths|' * ('results' in change)}\w+ is .* of shape"):
        EvaluationHistory.load(path)
    with pytest.warns(UserWarning, match=r"cannot be continued, new ones begin: .*evaluations\.npz: "):
        model.learn(ROLLOUT, callback=make_callback(tmp_path))
    assert load(tmp_path).timesteps.tolist() == [20, 40]


@pytest.mark.parametrize("n_instances", [4, 6])
def test_a_history_of_other_instances_is_not_continued(n_instances, tmp_path):
    """Files that were exchanged: with another number of instances, or without samples."""
    model = make_model()
    model.learn(ROLLOUT, callback=make_callback(tmp_path))
    EvaluationHistory.empty(n_instances, 0).save(tmp_path / "evaluations.npz", 0)
    with pytest.warns(UserWarning, match="are of other instances"):
        model.learn(ROLLOUT, callback=make_callback(tmp_path))


def test_default_dtype_and_device_do_not_matter():
    """The set and what a policy achieves on it are the same in a program with other defaults of torch."""
    policy, problem = make_model(policy_kwargs=NETWORK).policy, allocation_env().problem
    instances = draw_fixed_set(problem, 5, 0)
    expected = evaluate_fixed_set(policy, problem, instances, 3)
    defaults: list[Any] = [(th.set_default_dtype, th.float64, th.float32), (th.set_default_device, "meta", "cpu")]
    for set_default, value, usual in defaults:
        set_default(value)
        try:
            found = evaluate_fixed_set(policy, problem, draw_fixed_set(problem, 5, 0), 3)
            drawn = InstanceSets.draw(SIZES, 1.5, lambda n_uavs, n_tasks: np.random.default_rng([n_uavs, n_tasks]))
        finally:
            set_default(usual)
        assert np.array_equal(found.greedy, expected.greedy) and np.array_equal(found.sampled, expected.sampled)
        assert {part.tasks.dtype for part in drawn.sets.values()} == {th.float64}
