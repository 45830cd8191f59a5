"""ITS and imitation shared by two processes; their files, and the command line."""

import io
import json
import signal
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import numpy as np
import pytest
import torch as th
from ranks import run_ranks
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.logger import configure

from sb3_uav.common import distributed, interruption
from sb3_uav.common.random_streams import random_stream
from sb3_uav.envs.allocation import TaskAllocationEnv
from sb3_uav.envs.generators import UniformGenerator
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import FixedSetEvalCallback, ITSCallback
from sb3_uav.training.imitation import imitate

SMALL: dict[str, Any] = dict(embed_dim=16, n_heads=2, n_layers=1, ff_dim=16)
ROUTER: dict[str, Any] = dict(
    policy="RouterPolicy", policy_kwargs=SMALL, baseline="rollout", baseline_kwargs=dict(n_test_instances=20)
)


def make(seed=2):
    env = BatchedVecEnv([lambda: TaskAllocationEnv(n_tasks=7, n_uavs=2)] * 5)
    settings: dict[str, Any] = dict(n_samples=2, baseline="shared", instances_per_epoch=10, learning_rate=1e-3)
    return REINFORCE("AllocatorPolicy", env, policy_kwargs=SMALL, seed=seed, device="cpu", **settings)


def strategy(folder, n_epochs=2, **kwargs):
    return ITSCallback(
        ROUTER,
        n_epochs,
        1,
        n_intensive_epochs=1,
        n_continuous_epochs=1,
        save_path=None if folder is None else str(folder),
        **kwargs,
    )


def parameters(model):
    return {name: value.double().numpy().copy() for name, value in model.policy.state_dict().items()}


def assert_equal(found, expected, atol=0.0):
    assert found.keys() == expected.keys()
    for name, values in found.items():
        np.testing.assert_allclose(values, expected[name], rtol=0, atol=atol, err_msg=name)


def learn(its, model, *others):
    model.learn(10**6, [its, *others])
    records = [(r.level, r.epoch, r.phase, r.n_instances, r.objective) for r in its.records]
    return parameters(model), parameters(its.router), records


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Both levels and the records after two epochs in a single process."""
    return learn(strategy(tmp_path_factory.mktemp("single")), make())


def test_its_is_shared_and_only_the_first_rank_writes(tmp_path, expected):

    def shared(rank):
        folder = tmp_path / f"rank_{rank}"
        model = make()
        if rank == 0:
            model.set_logger(configure(str(folder / "log"), ["csv"]))
        evaluation = FixedSetEvalCallback(n_instances=4, n_samples=2, save_path=folder)
        return learn(strategy(folder), model, evaluation, CheckpointCallback(1, str(folder)))

    first, second = run_ranks(2, tmp_path / "ranks", shared)
    assert first[2] == second[2]
    assert_equal(first[0], second[0])
    assert_equal(first[1], second[1])
    assert_equal(first[0], expected[0], 1e-4)
    assert_equal(first[1], expected[1], 1e-4)
    for record, other in zip(first[2], expected[2], strict=True):
        assert record[:4] == other[:4]
        assert record[4] == pytest.approx(other[4])
    assert {"its_log.csv", "router.zip", "best_model.zip", "evaluations.npz"} <= {
        p.name for p in (tmp_path / "rank_0").iterdir()
    }
    assert not (tmp_path / "rank_1").exists()


@pytest.mark.parametrize("before, after", [(1, 2), (2, 1)])
def test_any_number_of_ranks_resumes_its(tmp_path, expected, before, after):
    def begin(_):
        return learn(strategy(tmp_path / "run", 1), make())

    def resume(_):
        checkpoint = tmp_path / "run" / "its_checkpoint"
        allocator = checkpoint / json.loads((checkpoint / "its_state.json").read_text())["allocator"]
        return learn(
            strategy(tmp_path / "next", resume_from=str(checkpoint)), REINFORCE.load(allocator, make().env, device="cpu")
        )

    def run(n, name, function):
        return function(0) if n == 1 else run_ranks(n, tmp_path / name, function)[0]

    run(before, "first", begin)
    allocator, router, records = run(after, "second", resume)
    assert_equal(allocator, expected[0], 1e-4)
    assert_equal(router, expected[1], 1e-4)
    assert [record[:4] for record in records] == [record[:4] for record in expected[2]]


def test_other_algorithms_are_refused(tmp_path):
    def its_with_ppo(_):
        its = ITSCallback(dict(algo="ppo", policy="RouterPolicy", policy_kwargs=SMALL, n_steps=8), 1, 1)
        learn(its, make())

    for error in run_ranks(2, tmp_path, its_with_ppo):
        assert isinstance(error, ValueError) and "algo is 'ppo'; several processes" in str(error)


def test_imitation_is_shared(tmp_path):
    pytest.importorskip("numba")

    def start(folder, n_updates=6):
        allocator = AllocatorPolicy(*AllocatorPolicy.placeholder_spaces(2), lambda _: 0.0, **SMALL)
        with th.random.fork_rng():
            th.manual_seed(0)
            router = RouterPolicy(*RouterPolicy.placeholder_spaces(None), lambda _: 0.0, **SMALL)
        noted = []
        settings = dict(n_subsets=30, n_updates=n_updates, batch_size=5)
        generator = UniformGenerator(n_tasks=8, n_uavs=2)
        allocator.load_state_dict(fixed.state_dict())
        imitate(
            router,
            allocator,
            generator,
            random_stream(0),
            **settings,
            folder=folder,
            record=lambda *moves: noted.append(moves),
        )
        return {name: value.double().numpy().copy() for name, value in router.state_dict().items()}, noted

    fixed = AllocatorPolicy(*AllocatorPolicy.placeholder_spaces(2), lambda _: 0.0, **SMALL)
    expected = start(None)
    first, second = run_ranks(2, tmp_path / "ranks", lambda _: start(tmp_path / "progress"))
    assert_equal(first[0], second[0])
    assert_equal(first[0], expected[0], 1e-4)
    assert first[1][0][0] == expected[1][0][0]
    assert first[1][0][1] == pytest.approx(expected[1][0][1], rel=1e-4)
    # Again with its lessons, which both read.
    lessons = (tmp_path / "progress" / "lessons_0.pt").read_bytes()
    again, _ = run_ranks(2, tmp_path / "again", lambda _: start(tmp_path / "progress"))
    assert_equal(again[0], first[0])
    assert (tmp_path / "progress" / "lessons_0.pt").read_bytes() == lessons


YAML = """
TaskAllocation-U2-N7-v0:
  {n_envs: 5, n_timesteps: 1000000, policy: AllocatorPolicy, policy_kwargs: &network {embed_dim: 16, n_heads: 2, n_layers: 1},
   n_samples: 2, baseline: shared, instances_per_epoch: 10, callback: [
    sb3_uav.training.ITSCallback: {n_epochs: 1, n_pretraining_epochs: 1, n_intensive_epochs: 1, n_continuous_epochs: 1,
     router: {policy: RouterPolicy, policy_kwargs: *network}},
    sb3_uav.training.FixedSetEvalCallback: {n_instances: 4, n_samples: 2}]}
"""


def train_as_torchrun(tmp_path, monkeypatch, *arguments):
    """:return: Exit codes, standard outputs and standard errors of two processes that train in ``tmp_path``"""
    train = pytest.importorskip("sb3_uav.zoo.train")
    pytest.importorskip("rl_zoo3")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yml").write_text(YAML)
    own = ["--env", "TaskAllocation-U2-N7-v0", "--conf-file", "small.yml", "-f", "logs", "--device", "cpu"]

    def run(_):
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
            try:
                code = train.main([*own, *arguments])
            except SystemExit as end:
                code = end.code
        return code, out.getvalue(), err.getvalue()

    return zip(*run_ranks(2, tmp_path / "ranks", run, connected=False), strict=True)


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch):
    codes, outputs, errors = train_as_torchrun(tmp_path, monkeypatch, "-tb", "tb")
    assert codes == (0, 0), errors
    # One run folder, one report.
    assert [path.name for path in (tmp_path / "logs" / "reinforce").iterdir()] == ["TaskAllocation-U2-N7-v0_1"]
    assert "Saving to logs/reinforce/TaskAllocation-U2-N7-v0_1" in outputs[0] and outputs[1] == ""
    run = tmp_path / "logs" / "reinforce" / "TaskAllocation-U2-N7-v0_1"
    assert (run / "best_model.zip").is_file() and (run / "router.zip").is_file()
    # 10 instances with 2 samples, each once.
    assert len((run / "0.monitor.csv").read_text().splitlines()) == 2 + 10 * 2
    assert len(list((tmp_path / "tb").rglob("events.*"))) == 2


@pytest.mark.slow
@pytest.mark.parametrize("is_late", [False, True])
def test_command_line_reports_an_interruption_once(is_late, tmp_path, monkeypatch):
    def interrupted(_):
        if is_late and distributed.is_main():
            # The other process ends, and with it the connection, before this one comes to its signal.
            monkeypatch.setattr(interruption, "_received", signal.SIGINT)
            raise RuntimeError("Connection closed by peer")
        raise KeyboardInterrupt

    monkeypatch.setattr(ITSCallback, "_begin_epoch", interrupted)
    codes, _, errors = train_as_torchrun(tmp_path, monkeypatch)
    assert codes == (130, 130) and errors[1] == ""
    line, words = errors[0].splitlines()[-1].split("; continue with ")
    assert line == "sb3-uav train: interrupted" and errors[0].count("interrupted") == 1
    assert words.split()[:6] == ["torchrun", "--nproc-per-node", "2", "-m", "sb3_uav", "train"]
    assert words.split()[-2] == "-i" and (tmp_path / words.split()[-1]).is_file()


def test_command_line_reports_an_error_once(tmp_path, monkeypatch):
    codes, _, errors = train_as_torchrun(tmp_path, monkeypatch, "--algo", "ppo")
    assert codes == (2, 2)
    assert "".join(errors).count("error: torchrun: several processes can only share --algo reinforce") == 1
    assert "" in errors
    assert not (tmp_path / "logs").exists()
