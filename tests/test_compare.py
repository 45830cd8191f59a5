"""`sb3-uav compare`: what is trained, that finished runs are kept, and what the files say."""

from __future__ import annotations

import csv
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.envs import Instances, TaskAllocationEnv, UniformGenerator
from sb3_uav.plots.bands import Band, BandPanel, _visible_range, plot_bands
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.training import fixed_set
from sb3_uav.training.fixed_set_history import EvaluationHistory, FixedSetResult

pytest.importorskip("rl_zoo3")
from sb3_uav.cli import main as cli
from sb3_uav.cli.compare import _make_parser
from sb3_uav.studies.compare.common_ground import make_validation_set
from sb3_uav.studies.compare.fixed_router import _DividedSubsets, pretrain_router
from sb3_uav.studies.compare.report import Run, _compute_band, _compute_table, _csv_text, _difference, _estimate, _interpolate
from sb3_uav.studies.compare.runs import ZooTraining, train_all
from sb3_uav.studies.compare.settings import Settings
from sb3_uav.studies.compare.study import _with_common_ground
from sb3_uav.studies.compare.variants import callback_name, callbacks_of, read_variants, router_settings

ALLOCATION, ROUTING = "TaskAllocation-U3-N20-v0", "RoutePlanning-N20-v0"
NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)


def make_history(timesteps: list[int], results: list[list[float]], seconds: list[float]) -> EvaluationHistory:
    history = EvaluationHistory.empty(len(results[0]), 1)
    for steps, row, second in zip(timesteps, results, seconds, strict=True):
        values = np.array(row)
        history = history.append(steps, FixedSetResult(values, values, values + 1), np.array([second, second / 2]))
    return history


@pytest.fixture
def runs() -> list[Run]:
    """Two variants with two seeds on two instances; the second is better and half as fast."""
    return [
        Run("A", "ppo", 0, make_history([0, 100], [[0, 0], [4, 8]], [0, 10])),
        Run("A", "ppo", 1, make_history([0, 110], [[0, 0], [6.6, 11]], [0, 10])),
        Run("B", "reinforce", 0, make_history([0, 100], [[0, 0], [7, 9]], [0, 20])),
        Run("B", "reinforce", 1, make_history([0, 100], [[0, 0], [9, 13]], [0, 20])),
    ]


# ------------------------------------------------------------------------------------------ numbers


def test_table_at_equal_steps(runs):
    """By hand: seeds of A have means 6 and 8 at 100 steps (110 steps interpolated), seeds of B 8 and 11."""
    best, other = _compute_table(runs, "timesteps", 100)
    assert (best.variant, other.variant) == ("B", "A") and (best.n_seeds, best.timesteps) == (2, 100)
    assert best.greedy.mean == 9.5 and other.greedy.mean == pytest.approx(7.0)
    # t(0.975, 1) = 12.706; the standard error of (8, 11) is 1.5, that of (6, 8) is 1.
    assert best.greedy.half_width == pytest.approx(12.706 * 1.5) and other.greedy.half_width == pytest.approx(12.706)
    assert best.sampled is not None and best.sampled.mean == 10.5
    assert other.difference.mean == pytest.approx(-2.5) and other.difference.half_width > 0
    assert best.difference == best.sampled_difference == (0.0, 0.0)
    assert other.seconds == pytest.approx((10 + 1000 / 110) / 2) and other.cpu_seconds == pytest.approx(other.seconds / 2)


def test_table_at_equal_time(runs):
    """After 10 s the slower variant stands half-way."""
    best, other = _compute_table(runs, "train_seconds", 10)
    assert (best.variant, other.variant) == ("A", "B")
    assert best.greedy.mean == pytest.approx((6 + 8.8) / 2) and other.greedy.mean == pytest.approx(9.5 / 2)
    assert (best.timesteps, other.timesteps) == (105, 50)


def test_one_seed_has_no_interval(runs):
    row = _compute_table(runs[:1], "timesteps", 100)[0]
    assert np.isnan(row.greedy.half_width) and str(row.greedy) == "6.00"
    assert str(_estimate(np.array([1.0, 3.0, 2.0]))) == "2.00 ± 2.48"


@pytest.mark.parametrize(("shared", "expected"), [(True, 1.96 * (2 / 40) ** 0.5), (False, 1.96 * (2 / 40 + 8 / 200) ** 0.5)])
def test_interval_of_a_difference(shared, expected):
    """Seeds have variance 1, instances 4. What two variants have in common in an instance cancels out, the rest does not."""
    rng = np.random.default_rng(3)
    instances = rng.normal(0, 2, (2, 1, 200))
    first, second = rng.normal(0, 1, (2, 40, 1)) + (instances[:1] if shared else instances)
    found = _difference(first, second)
    assert found.mean == pytest.approx(first.mean() - second.mean())
    assert found.half_width == pytest.approx(expected, rel=0.25)
    assert np.isnan(_difference(first[:1], second).half_width)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=8), st.floats(-1.0, 9.0))
def test_interpolation_is_numpys(values, at):
    x = np.arange(len(values))
    found = _interpolate(x, np.array(values)[:, None], np.array([at]))[0, 0]
    assert found == pytest.approx(np.interp(at, x, values), abs=1e-9)


def test_bands(runs):
    band = _compute_band(runs[:2], "timesteps", "results", 200)
    assert band.x[[0, -1]].tolist() == [0, 100] and band.mean[-1] == pytest.approx(7.0)
    assert band.half_width[-1] == pytest.approx(12.706)
    assert _compute_band(runs[:2], "timesteps", "sampled", 50).mean[0] == 1.0


def test_csv_has_a_row_per_evaluation(runs):
    rows = list(csv.DictReader(_csv_text(runs).splitlines()))
    assert len(rows) == 8
    expected = {"algorithm": "reinforce", "variant": "B", "seed": "1", "timesteps": "100", "wall_seconds": "20.000"}
    assert {key: rows[-1][key] for key in expected} == expected
    assert (float(rows[-1]["greedy"]), float(rows[-1]["sampled"]), float(rows[-1]["cpu_seconds"])) == (11, 12, 10)


def test_wide_bands_do_not_flatten_the_curves(tmp_path):
    x = np.arange(3.0)
    narrow, wide = Band(x, x, x * 0 + 0.5), Band(x, x, x * 0 + 100)
    assert _visible_range([narrow]) == pytest.approx((-0.6, 2.6))
    assert _visible_range([narrow, wide]) == pytest.approx((-2.1, 4.1))
    single = Band(x, x, x * np.nan)
    assert _visible_range([single]) == pytest.approx((-0.1, 2.1))
    plot_bands([[BandPanel("x", "y", {"a": narrow, "b": wide}), BandPanel("x", "y", {"a": single})]], tmp_path / "bands.pdf")
    assert (tmp_path / "bands.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(ValueError, match="at least one curve"):
        plot_bands([[BandPanel("x", "y", {})]], tmp_path / "none.png")


# ------------------------------------------------------------------------------------------ variants


def make_settings(folder: Path, *flags: str) -> Settings:
    args = vars(_make_parser().parse_args(["--env", ALLOCATION, "--out", str(folder), "--eval-freq", "100", *flags]))
    del args["report_only"]
    return Settings(**args)


@pytest.mark.parametrize("env_id", [ALLOCATION, ROUTING])
def test_default_variants_come_from_the_shipped_yamls(env_id):
    variants = {variant.name: variant for variant in read_variants(None, env_id)}
    assert [variant.algo for variant in variants.values()] == ["ppo", "ppo_mask", "reinforce", "reinforce"]
    shared, rollout = (variants[f"REINFORCE, {name} baseline"].entry for name in ("shared", "rollout"))
    assert (shared["baseline"], rollout["baseline"]) == ("shared", "rollout")
    # As many episodes per update and per epoch, so that learning rates decay alike.
    for key in ("n_envs", "instances_per_epoch"):
        assert shared[key] * shared["n_samples"] == rollout[key] * rollout["n_samples"]


def test_both_baselines_have_equally_many_episodes():
    variants = {variant.name: variant.entry for variant in read_variants(None, "TaskAllocation-U4-N80-v0")}
    shared, rollout = variants["REINFORCE, shared baseline"], variants["REINFORCE, rollout baseline"]
    assert (shared["n_samples"], shared["n_envs"], shared["instances_per_epoch"]) == (8, 32, 512)
    assert (rollout["n_samples"], rollout["n_envs"], rollout["instances_per_epoch"]) == (1, 256, 4096)


def test_variants_of_a_file(tmp_path):
    path = tmp_path / "variants.yml"
    path.write_text("Slow PPO: {algo: ppo, learning_rate: 1e-5, vf_coef: null}\nother: {algo: reinforce}")
    slow, other = read_variants(path, ALLOCATION)
    shipped = read_variants(None, ALLOCATION)[0].entry
    assert slow.folder == "slow-ppo" and slow.entry["learning_rate"] == 1e-5 and "vf_coef" not in slow.entry
    assert {key: slow.entry[key] for key in ("n_envs", "policy")} == {key: shipped[key] for key in ("n_envs", "policy")}
    assert other.algo == "reinforce"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", r"variants\.yml: holds \[1, 2\] \(list\) instead of a mapping"),
        ("{}", "must be a mapping from names"),
        ("a: {n_envs: 3}", "at least the key 'algo'"),
        ("a: {algo: dqn}", r"algo 'dqn': there is no YAML zoo_configs/dqn\.yml; name one as conf_file"),
        ("a: {algo: ppo, conf_file: none.yml}", r"there is no YAML none\.yml"),
        ("a: {algo: ppo, conf_file: variants.yml}", "has no entry for TaskAllocation-U3-N20-v0"),
        ("a b: {algo: ppo}\nA-b: {algo: ppo}", "names must differ in their letters and digits"),
        ("a: [", "cannot be read"),
    ],
)
def test_bad_variants_are_named(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("variants.yml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_variants(Path("variants.yml"), ALLOCATION)


def test_all_variants_get_the_same_ground(tmp_path):
    """ITS and evaluations of the YAMLs make room for the common router and set; other callbacks stay."""
    settings = make_settings(tmp_path, "-n", "1234", "--samples", "5")
    for variant in read_variants(None, ALLOCATION):
        entry = _with_common_ground(variant, settings, True).entry
        names = [callback_name(callback) for callback in callbacks_of(entry)]
        assert entry["n_timesteps"] == 1234 and names[-2:] == ["PretrainedRouterCallback", "FixedSetEvalCallback"]
        assert "ITSCallback" not in names and len(set(names)) == len(names)
        kept = {callback_name(callback) for callback in callbacks_of(variant.entry)} - {"ITSCallback", "FixedSetEvalCallback"}
        assert kept <= set(names)
        (evaluation,) = callbacks_of(entry)[-1].values()
        assert evaluation["instances"] == str(tmp_path / "validation.npz")
        fixed_set.FixedSetEvalCallback(**{**evaluation, "instances": None})
        with_its = _with_common_ground(variant, make_settings(tmp_path, "--its"), False).entry
        assert [callback_name(callback) for callback in callbacks_of(with_its)].count("ITSCallback") == 1


# ------------------------------------------------------------------------------------------ the common router


@given(st.integers(1, 6), st.integers(1, 12), st.integers(1, 9), st.integers(0, 99))
def test_subsets_are_parts_of_instances(n_uavs, n_tasks, batch_size, seed):
    """Every task of a subset is one of its instance, once; the same random numbers give the same subsets."""
    generator = UniformGenerator(n_tasks, n_uavs, 1.5)
    subsets = _DividedSubsets(generator)(batch_size, np.random.default_rng(seed))
    assert len(subsets) == batch_size and subsets.n_uavs == 1 and (subsets.max_distance == 1.5).all()
    again = _DividedSubsets(generator)(batch_size, np.random.default_rng(seed))
    assert th.equal(subsets.tasks, again.tasks)
    originals = generator(-(-batch_size // n_uavs), np.random.default_rng(seed))
    for row in range(batch_size):
        whole = (originals.depot == subsets.depot[row]).all(1).nonzero()[0, 0]
        real = subsets.tasks[row][subsets.task_mask[row]]
        matches = (real[:, None] == originals.tasks[whole][None]).all(-1)
        assert (matches.sum(1) == 1).all() and (matches.sum(0) <= 1).all()


def test_half_of_the_instances_are_cut_into_sectors():
    """Four UAVs in the middle of many tasks: a sector of a quarter spans a right angle, a random subset all directions."""
    instances = Instances.from_arrays(
        np.zeros((200, 2)), np.random.default_rng(0).normal(size=(200, 80, 2)), max_distance=9.0, n_uavs=4
    )

    class Given(UniformGenerator):
        def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
            return instances

    subsets = _DividedSubsets(Given(80, 4))(800, np.random.default_rng(0))
    directions = subsets.tasks / subsets.tasks.norm(dim=-1, keepdim=True).clamp(min=1e-9) * subsets.task_mask[..., None]
    concentration = directions.sum(1).norm(dim=-1) / subsets.task_mask.sum(1)
    # 0.9 is the mean length of unit vectors over a right angle.
    in_sectors = concentration > 0.75
    assert 0.4 < in_sectors.double().mean() < 0.6
    assert concentration[~in_sectors].mean() < 0.3


def test_pretrained_router_is_saved(tmp_path):
    generator = UniformGenerator(8, 2, 1.5)
    done = pretrain_router(generator, dict(policy_kwargs=NETWORK, n_envs=4), 16, tmp_path / "router.zip")
    assert isinstance(load_policy(tmp_path / "router.zip"), RouterPolicy)
    assert done.startswith("REINFORCE (baseline shared, 8 sample(s) per subset) on 16 subsets")
    with pytest.raises(ValueError, match="pass it as --router"):
        pretrain_router(generator, dict(algo="ppo"), 16, tmp_path / "router.zip")
    with pytest.raises(ValueError, match="these arguments do not fit REINFORCE"):
        pretrain_router(generator, dict(n_stepz=3), 16, tmp_path / "router.zip")


def test_router_recipe_is_that_of_the_yaml():
    assert router_settings(ALLOCATION)["policy"] == "RouterPolicy" and router_settings(ROUTING) == {}


# ------------------------------------------------------------------------------------------ trainings


class Fake(ZooTraining):
    """Leaves evaluations in place of a training; its config says in Python what to do before."""

    @property
    def flags(self) -> list[str]:
        target = self.folder / self.algo / f"{self.env_id}_1"
        script = f"""
import os, signal, sys, time, numpy as np
{self.config.read_text()}
os.makedirs({str(target)!r})
one, seconds = np.ones((2, 3)), [0.0, 1.0]
np.savez({str(target / "evaluations.npz")!r}, timesteps=[0, steps], results=one, ep_lengths=one, sampled=one,
         train_seconds=seconds, cpu_seconds=seconds)
"""
        self.config.with_suffix(".run.py").write_text(script)
        return ["-m", str(self.config.with_suffix(".run.py"))]


def fake(folder: Path, behavior: str = "", steps: int = 100, seed: int = 0) -> Fake:
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / f"behavior_{seed}.py"
    config.write_text(f"steps = {steps}\n{behavior}")
    return Fake("A", "ppo", ROUTING, seed, 100, config, folder / f"seed_{seed}")


def test_finished_runs_are_marked_and_others_start_again(tmp_path):
    training = fake(tmp_path)
    training.folder.mkdir()
    (training.folder / "half").write_text("an interrupted run")
    train_all([training], 1)
    assert training.is_finished and not (training.folder / "half").exists()
    assert training.history.timesteps.tolist() == [0, 100]
    assert json.loads((training.folder / "finished.json").read_text())["command"].startswith("python -m ")


@pytest.mark.parametrize(
    ("behavior", "steps", "message"),
    [
        ("sys.exit('no such key')", 100, r"train\.log: no such key"),
        ("os._exit(3)", 100, r"train\.log: exit code 3"),
        ("sys.exit(0)", 100, r"evaluations\.npz: no such file"),
        ("", 60, "stopped after 60 of 100 steps"),
    ],
)
def test_failed_runs_are_named_after_the_others_are_through(behavior, steps, message, tmp_path):
    bad, good = fake(tmp_path, behavior, steps), fake(tmp_path, seed=1)
    with pytest.raises(ValueError, match=f"1 of 2 trainings failed: .*{message}"):
        train_all([bad, good], 1)
    assert good.is_finished and not bad.is_finished


def test_jobs_run_side_by_side(tmp_path):
    """Each of two waits for the other to begin; one after the other they would wait for ever."""
    wait = "open({0!r}, 'w')\nfor _ in range(12000):\n    if os.path.exists({1!r}):\n        break\n    time.sleep(0.05)\n"
    wait += "else:\n    sys.exit('alone')"
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    train_all([fake(tmp_path, wait.format(a, b)), fake(tmp_path, wait.format(b, a), seed=1)], 2)


def test_termination_ends_the_trainings_too(tmp_path):
    started = tmp_path / "started"
    training = fake(tmp_path, f"open({str(started)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)")

    def terminate() -> None:
        while not started.exists() or not started.read_text():
            time.sleep(0.02)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

    threading.Thread(target=terminate).start()
    with pytest.raises(KeyboardInterrupt):
        train_all([training], 1)
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)
    assert not training.is_finished
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


# ------------------------------------------------------------------------------------------ the command


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "TaskAllocation-U3-v0"], "which no environment has; did you mean TaskAllocation-v0 or"),
        (["--env", "CartPole-v1"], "is not an environment of sb3_uav"),
        (["--seeds", "1", "1"], "give different numbers"),
        (["--jobs", "0"], "--jobs is 0; it must be at least 1"),
        (["-n", "0"], "--n-timesteps is 0"),
        (["--eval-freq", "0"], "--eval-freq is 0"),
        (["--env", ROUTING, "--router", "router.zip"], "--router is for TaskAllocation environments"),
        (["--instances", "none.npz"], "none.npz: no such instance file"),
        (["--variants", "none.yml"], "none.yml: no such file"),
        (["--router", "none.zip"], "none.zip: no such file"),
        (["--env", ROUTING, "--report-only"], "no run is finished yet"),
    ],
)
def test_bad_arguments_are_named(flags, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["compare", "--env", ALLOCATION, "--out", "out", "--n-instances", "2", *flags]) == 2
    assert message in capsys.readouterr().err


def test_settings_of_one_folder_are_one(tmp_path, capsys):
    flags = ["compare", "--env", ROUTING, "--out", str(tmp_path / "out"), "--report-only", "--n-instances", "2"]
    # Without runs, nothing binds the next call.
    for n_timesteps in ("50", "100"):
        assert cli.main([*flags, "-n", n_timesteps]) == 2
        assert "no run is finished yet" in capsys.readouterr().err
    (tmp_path / "out" / "runs" / "ppo" / "seed_0").mkdir(parents=True)
    for change, message in (
        (["-n", "200"], "settings.json: n_timesteps was 100 in earlier runs and is 200 now; choose another --out"),
        (["-n", "100", "--n-instances", "3"], "holds another validation set"),
    ):
        assert cli.main([*flags, *change]) == 2
        assert message in capsys.readouterr().err


def test_validation_set_is_given_or_drawn_once(tmp_path):
    given_set = tmp_path / "given.npz"
    problem = TaskAllocationEnv(20, 3).problem
    problem.generator(4, np.random.default_rng(0)).save(given_set)
    settings = make_settings(tmp_path / "out", "--instances", str(given_set))
    settings.out.mkdir()
    make_validation_set(settings, problem)
    assert th.equal(Instances.load(settings.out / "validation.npz").tasks, Instances.load(given_set).tasks)


@pytest.mark.slow
def test_compare_trains_and_reports(tmp_path, monkeypatch, capsys):
    """PPO and REINFORCE on the allocator with a router that is trained first; again without training anything."""
    monkeypatch.chdir(tmp_path)
    ppo = dict(n_envs=4, n_steps=20, batch_size=40, n_epochs=1)
    variants = {
        "PPO": dict(algo="ppo", policy_kwargs=NETWORK, **ppo),
        "REINFORCE": dict(algo="reinforce", policy_kwargs=NETWORK, n_envs=2, n_samples=2),
    }
    Path("variants.yml").write_text(yaml.safe_dump(variants))
    flags = ["compare", "--env", ALLOCATION, "--out", "out", "-n", "320", "--seeds", "3", "--variants", "variants.yml"]
    flags += ["--eval-freq", "160", "--n-instances", "5", "--samples", "2", "--router-subsets", "64", "--jobs", "2"]
    assert cli.main(flags) == 0, capsys.readouterr().err
    out = Path("out")
    rows = list(csv.DictReader((out / "evaluations.csv").open()))
    assert {(row["variant"], row["algorithm"], row["seed"]) for row in rows} == {
        ("PPO", "ppo", "3"),
        ("REINFORCE", "reinforce", "3"),
    }
    for name in variants:
        assert [int(row["timesteps"]) for row in rows if row["variant"] == name] == [0, 160, 320]
    assert all(0 < float(row["greedy"]) <= 20 and 0 < float(row["sampled"]) <= 20 for row in rows)
    assert all(float(row["wall_seconds"]) >= 0 for row in rows)
    report = (out / "report.md").read_text()
    for text in (
        f"# Comparison of algorithms on {ALLOCATION}",
        "At equal environment steps: 320",
        "At equal wall time",
        "At equal CPU time",
        "REINFORCE (baseline shared, 8 sample(s) per subset) on 64 subsets",
        "sb3-uav compare --env",
        "python -m sb3_uav.zoo.train --algo ppo",
        "stable-baselines3 2.",
    ):
        assert text in report
    assert str(tmp_path) not in report
    for name in ("comparison.png", "comparison.pdf", "router.zip", "validation.npz"):
        assert (out / name).stat().st_size > 0
    for algo, name in (("ppo", "ppo"), ("reinforce", "reinforce")):
        folder = out / "runs" / name / "seed_3" / algo / f"{ALLOCATION}_1"
        # The same router and the same instances for all.
        assert (folder / "router.zip").read_bytes() == (out / "router.zip").read_bytes()
        used, common = (Instances.load(path) for path in (folder / "evaluation_instances.npz", out / "validation.npz"))
        assert th.equal(used.tasks, common.tasks)
        saved = yaml.safe_load((out / "configs" / f"{name}.yml").read_text())[ALLOCATION]
        assert saved["n_timesteps"] == 320 and "ITSCallback" not in str(saved)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("finished.json")}
    assert len(before) == 2
    capsys.readouterr()
    assert cli.main(flags) == 0
    assert "seed 3" not in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in out.rglob("finished.json")} == before
    variants["PPO"]["n_epochs"] = 2
    Path("variants.yml").write_text(yaml.safe_dump(variants))
    assert cli.main(flags) == 2
    assert "'PPO' had other settings in earlier runs" in capsys.readouterr().err
