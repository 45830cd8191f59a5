"""Training from YAML through rl_zoo3: the files that it leaves, and what a user reads when something is wrong."""

import csv
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.results_plotter import load_results

from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.sb3_compat import linear_schedule
from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.registration import PAPER_FLEETS, PAPER_SIZES, allocation_id
from sb3_uav.reinforce import REINFORCE
from sb3_uav.reinforce.algorithms import resolve_algorithm
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import read_state

pytest.importorskip("rl_zoo3")
from test_policy_contracts import SUBCLASSES
from tiny_zoo import ENV, EPOCH, NETWORK, its_with, run, write_config

from sb3_uav.cli import main as cli
from sb3_uav.studies.demo import evaluate_run, newest_run
from sb3_uav.zoo import enjoy, train
from sb3_uav.zoo.configs import default_config, parse_schedule, plain_numbers


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `python -m sb3_uav.zoo.train` in a separate process; the folder above its logs."""
    folder = tmp_path_factory.mktemp("zoo")
    config = write_config(folder)
    flags = ["--eval-freq", "160", "--eval-episodes", "4", "--save-freq", "320", "-tb", str(folder / "tb"), "--seed", "1"]
    command = [sys.executable, "-m", "sb3_uav.zoo.train", "--algo", "reinforce", "--env", ENV, "--conf-file", str(config)]
    subprocess.run([*command, "-f", str(folder / "logs"), *flags], check=True, capture_output=True, cwd=folder)
    return folder


def run_folder(folder: Path) -> Path:
    return newest_run(folder / "logs" / "reinforce", ENV)


@pytest.mark.slow
def test_log_folder_is_the_zoos(trained):
    """Every file that rl_zoo3 leaves, and the router's."""
    folder = run_folder(trained)
    assert folder.name == f"{ENV}_1"
    expected = {f"{ENV}.zip", "best_model.zip", "evaluations.npz", "0.monitor.csv", ENV, "rl_model_320_steps.zip"}
    ours = {"router.zip", "best_router.zip", "best_pair.json", "its_log.csv", "its_checkpoint", "router_320_steps.zip"}
    assert expected | ours == {path.name for path in folder.iterdir()}
    assert {path.name for path in (folder / ENV).iterdir()} == {"config.yml", "args.yml", "command.txt"}
    saved = yaml.load((folder / ENV / "config.yml").read_text(), Loader=yaml.UnsafeLoader)  # written by rl_zoo3 just now
    assert dict(saved)["instances_per_epoch"] == 8
    evaluations = np.load(folder / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [160, 320, 480] and evaluations["results"].shape == (3, 4)
    assert evaluations["successes"].shape == (3, 4) and evaluations["successes"].dtype == bool
    monitor = load_results(str(folder))
    assert len(monitor) == 24 and (monitor["l"] == 20).all() and (monitor["r"] <= 20).all()
    assert list((trained / "tb").rglob("events.out.tfevents.*"))


@pytest.mark.slow
def test_saved_zips_are_ordinary_and_play_together(trained, tmp_path):
    folder = run_folder(trained)
    model = REINFORCE.load(folder / f"{ENV}.zip")
    assert (model.epoch, model.n_instances, model.num_timesteps) == (3, 24, 480)
    assert model.seed == 1 and isinstance(model.policy, AllocatorPolicy)
    arguments = ["--allocator", str(folder / f"{ENV}.zip"), "--router", str(folder / "router.zip"), "--out", str(tmp_path)]
    test_set = tmp_path / "test.npz"
    TaskAllocationEnv(30, 3).problem.generator(3, np.random.default_rng(0)).save(test_set)
    assert cli.main(["evaluate", *arguments, "--instances", str(test_set)]) == 0
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 4


@pytest.mark.slow
def test_enjoy_replays_with_the_trained_router(trained, capsys):
    arguments = ["--env", ENV, "-f", str(trained / "logs"), "-n", "60", "--no-render"]
    for flags, name in (
        ([], "router.zip"),
        (["--load-best"], "best_router.zip"),
        (["--load-checkpoint", "320"], "router_320_steps.zip"),
        (["--load-last-checkpoint"], "router_320_steps.zip"),
    ):
        assert enjoy.main([*arguments, *flags]) == 0
        printed = capsys.readouterr().out
        assert printed.count("Episode Reward:") == 3 and "3 Episodes" in printed and "Success rate:" in printed
        assert f"Rewards come from the router {run_folder(trained) / name}" in printed
        assert "has no router of its own" not in printed


@pytest.mark.slow
def test_checkpoints_hold_the_router_of_their_moment(trained, tmp_path, capsys):
    """After 320 of 480 steps it has not learned in the last epoch yet. A run without it plays with the last one."""
    folder = run_folder(trained)
    then, last = (load_policy(folder / name).state_dict() for name in ("router_320_steps.zip", "router.zip"))
    assert then.keys() == last.keys() and any(not th.equal(then[key], last[key]) for key in then)
    assert REINFORCE.load(folder / "rl_model_320_steps.zip").num_timesteps == 320
    copied = tmp_path / "reinforce" / folder.name
    shutil.copytree(folder, copied)
    (copied / "router_320_steps.zip").unlink()
    assert enjoy.main(["--env", ENV, "-f", str(tmp_path), "-n", "20", "--no-render", "--load-last-checkpoint"]) == 0
    printed = capsys.readouterr().out
    assert "rl_model_320_steps.zip has no router of its own: rewards come from the run's last one." in printed
    assert f"Rewards come from the router {copied / 'router.zip'}" in printed


@pytest.mark.slow
def test_enjoy_plays_policies_with_code_of_the_user(tmp_path, capsys, monkeypatch):
    """The fault was an error for the router, and for the allocator tasks in the order of the input."""
    networks = {
        level: {**NETWORK, "features_extractor_class": f"{cls.__module__}.{cls.__name__}"} for level, cls in SUBCLASSES.items()
    }
    changes: dict[str, Any] = its_with(n_epochs=1, n_pretraining_epochs=0, n_intensive_epochs=0)
    router = changes["callback"][0][ITS_KEY]["router"]
    router |= dict(algo="ppo", policy_kwargs=networks["router"], batch_size=8, n_steps=4)
    config = write_config(tmp_path, policy_kwargs=networks["allocator"], n_timesteps=EPOCH, **changes)
    assert run(tmp_path, config, "--eval-freq", "-1") == 0
    given: dict[str, Any] = {}

    def spy(name: str) -> Any:
        original = getattr(TaskAllocationEnv, name)
        return lambda env, value: (given.update({name: value}), original(env, value))

    for name in ("set_task_order", "set_router"):
        monkeypatch.setattr(TaskAllocationEnv, name, spy(name))
    replay = ["--env", ENV, "-f", str(tmp_path / "logs"), "-n", "20", "--no-render"]
    assert enjoy.main(replay) == 2
    assert "features_extractor_class" in (error := capsys.readouterr().err) and "Add --trust if you trust" in error
    assert enjoy.main([*replay, "--trust"]) == 0
    assert "1 Episodes" in capsys.readouterr().out and given["set_task_order"] == "sweep"
    assert type(given["set_router"].__self__.features_extractor) is SUBCLASSES["router"]


@pytest.mark.slow
def test_enjoy_names_a_missing_run(tmp_path, capsys):
    assert enjoy.main(["--env", ENV, "-f", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.slow
def test_resumed_run_equals_an_unbroken_one(trained, tmp_path, capsys):
    """`-i` with the checkpoint of an interrupted run, whatever seed the zoo draws."""
    config = write_config(tmp_path, n_timesteps=2 * EPOCH)
    assert run(tmp_path, config, "--eval-freq", "-1") == 0
    first = run_folder(tmp_path)
    state = read_state(first / "its_checkpoint")
    assert state["epoch"] == 2
    config = write_config(tmp_path)
    allocator = first / "its_checkpoint" / state["allocator"]
    arguments = ["--env", ENV, "--conf-file", str(config), "-f", str(tmp_path / "logs"), "-n", str(EPOCH), "--eval-freq", "-1"]
    assert train.main([*arguments, "-i", str(allocator)]) == 0
    second = run_folder(tmp_path)
    assert second != first
    for name in (f"{ENV}.zip", "router.zip"):
        resumed, unbroken = load_policy(second / name), load_policy(run_folder(trained) / name)
        for key, value in unbroken.state_dict().items():
            assert th.equal(value, resumed.state_dict()[key]), (name, key)
    assert len((second / "its_log.csv").read_text().splitlines()) == 1 + 1 + 3 + 3


@pytest.mark.slow
def test_final_zip_continues_too(trained, tmp_path, capsys):
    """`-i` with the zip that the zoo saves last finds the checkpoint below it."""
    config = write_config(tmp_path, **its_with(n_epochs=4))
    final = run_folder(trained) / f"{ENV}.zip"
    assert run(tmp_path, config, "-i", str(final), "-n", str(EPOCH), "--eval-freq", "-1") == 0
    assert read_state(run_folder(tmp_path) / "its_checkpoint")["epoch"] == 4
    lonely = tmp_path / "lonely.zip"
    lonely.write_bytes(final.read_bytes())
    assert run(tmp_path, config, "-i", str(lonely), "-n", str(EPOCH)) == 2
    assert "holds its_state.json, which names its router" in capsys.readouterr().err
    assert run(tmp_path, config, "-i", str(tmp_path / "none.zip")) == 2
    assert "none.zip: no such file; give the zip of a trained agent" in capsys.readouterr().err


@pytest.mark.slow
def test_evaluation_happens_once_per_epoch_on_other_instances(tmp_path):
    """If the command line does not say how often; and the first training instances are not the first evaluated ones."""
    config = write_config(tmp_path)
    config.write_text(config.read_text().replace("sb3_uav.training.ITSCallback", f"{__name__}.Instances"))
    assert run(tmp_path, config, "--eval-episodes", "2") == 0
    assert np.load(run_folder(tmp_path) / "evaluations.npz")["timesteps"].tolist() == [160, 320, 480]
    training, evaluation = (set(map(tuple, depots)) for depots in Instances.depots)
    assert not training & evaluation


@pytest.mark.slow
def test_help(capsys):
    """The name of our command, our defaults, and the flags of rl_zoo3's."""
    for main, prog in ((train.main, "train"), (enjoy.main, "enjoy")):
        with pytest.raises(SystemExit) as done:
            main(["--algo", "ppo_mask", "--help"])
        printed = capsys.readouterr().out
        assert done.value.code == 0 and printed.startswith(f"usage: sb3-uav {prog} [options]")
        assert "--algo is reinforce" in printed and "--algo {a2c," in printed and "reinforce,ppo_mask}" in printed


@pytest.mark.slow
def test_demo_files_from_a_run(trained, tmp_path, capsys):
    assert evaluate_run(run_folder(trained), ENV, tmp_path, 5, 0) == 0
    for name in ("results/results.csv", "results/schedules.jsonl", "learning_curves.png", "schedule.png", "instances.npz"):
        assert (tmp_path / name).stat().st_size > 0
    solvers = {line.split(",")[0] for line in (tmp_path / "results/results.csv").read_text().splitlines()[1:]}
    assert len(solvers) == 5 and {"kmeans-nearest", "random-nearest"} <= solvers
    printed = capsys.readouterr().out
    assert "DL-DRL untrained" in printed
    with (tmp_path / "results/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    mean = {name: np.mean([float(row["objective"]) for row in rows if row["solver"] == name]) for name in solvers}
    gain = mean["DL-DRL (sampling 128)"] - mean["random-nearest"]
    assert f"DL-DRL (sampling 128) against random-nearest: {gain:+.2f} tasks" in printed


class Instances(ITSCallback):
    """Notes the instances that training and evaluation environments begin with."""

    depots: Any = None

    def _on_training_start(self) -> None:
        super()._on_training_start()
        evaluation = self.locals["callback"].callbacks[-1].eval_env
        environments: list[Any] = [self.training_env, evaluation]
        type(self).depots = [env.reset()["depot"].tolist() for env in environments]


class Spy(ITSCallback):
    """Notes the sizes that training and evaluation environments were made with."""

    seen: Any = None

    def _on_training_start(self) -> None:
        super()._on_training_start()
        evaluations = siblings(self, type(self.locals["callback"].callbacks[-1]))
        environments = [self.training_env, evaluations[-1].eval_env]
        type(self).seen = [env.get_attr("problem")[0].generator.max_distance for env in environments]


@pytest.mark.slow
def test_env_kwargs_of_the_yaml_reach_the_evaluation(tmp_path):
    """They do not in stock rl_zoo3 2.9.2; those of the command line replace them, in both."""
    config = write_config(tmp_path, env_kwargs=dict(max_distance=1.25))
    text = config.read_text().replace("sb3_uav.training.ITSCallback", f"{__name__}.Spy")
    config.write_text(text)
    assert run(tmp_path, config, "-n", "80") == 0
    assert Spy.seen == [1.25, 1.25]
    assert run(tmp_path, config, "-n", "80", "--env-kwargs", "max_distance:1.75") == 0
    assert Spy.seen == [1.75, 1.75]


@pytest.mark.slow
@pytest.mark.parametrize("normalize", [{"norm_obs": False, "norm_reward": True}])
def test_zoo_keys_are_honored(tmp_path, normalize):
    """Wrappers, schedules, and numbers that YAML takes for text."""
    its_free = dict(callback=None, n_steps=20, n_timesteps=4 * 20 * 2, learning_rate="lin_1e-3", ent_coef="1e-2")
    config = write_config(tmp_path, normalize=normalize, monitor_kwargs={}, **its_free)
    assert run(tmp_path, config, "--eval-freq", "80", "--log-interval", "1") == 0
    model = REINFORCE.load(run_folder(tmp_path) / f"{ENV}.zip")
    assert model.ent_coef == 0.01 and callable(model.learning_rate)
    assert (run_folder(tmp_path) / ENV / "vecnormalize.pkl").is_file()


@pytest.mark.slow
def test_other_environments_work(tmp_path):
    arguments = ["--env", "CartPole-v1", "-f", str(tmp_path), "-n", "5000", "--seed", "0", "--eval-freq", "-1"]
    assert train.main(["--algo", "reinforce", *arguments]) == 0
    assert REINFORCE.load(tmp_path / "reinforce/CartPole-v1_1/CartPole-v1.zip").num_timesteps >= 5000


@pytest.mark.slow
def test_hyperparameters_of_the_command_line(tmp_path):
    config = write_config(tmp_path)
    assert run(tmp_path, config, "-n", "80", "-params", "learning_rate:0.5", "baseline:'none'", "--eval-freq", "-1") == 0
    model = REINFORCE.load(run_folder(tmp_path) / f"{ENV}.zip")
    assert (model.learning_rate, model.baseline, model.num_timesteps) == (0.5, "none", 80)


@pytest.mark.parametrize(
    ("key", "text", "expected"),
    [("learning_rate", "1e-3", 0.001), ("learning_rate", "const_0.5", 0.5), ("ent_coef", "1e-2", 0.01)],
)
def test_numbers_as_text(key, text, expected):
    assert parse_schedule(key, text) == expected


def test_linear_schedule():
    schedule = parse_schedule("learning_rate", "lin_0.1")
    assert type(schedule) is type(linear_schedule(0.1)) and not isinstance(schedule, float)
    assert [schedule(1.0), schedule(0.5), schedule(0.0)] == pytest.approx([0.1, 0.05, 0.0])
    with pytest.raises(ValueError, match=r"ent_coef is 'lin_0\.1'; write a number"):
        parse_schedule("ent_coef", "lin_0.1")


# ------------------------------------------------------------------------------------------ the shipped YAML


ITS_KEY, EVALUATION_KEY = "sb3_uav.training.ITSCallback", "sb3_uav.training.FixedSetEvalCallback"
SHIPPED = ("reinforce", "ppo", "ppo_mask", "a2c")


def shipped(name: str) -> dict[str, Any]:
    path = default_config(name)
    assert path is not None and default_config("dqn") is None
    return yaml.safe_load(path.read_text())


def its_of(entry: dict[str, Any]) -> dict[str, Any]:
    """The arguments of an entry's ITSCallback."""
    found = [callback[ITS_KEY] for callback in entry["callback"] if isinstance(callback, dict) and ITS_KEY in callback]
    assert len(found) == 1
    return found[0]


@pytest.mark.parametrize("n_uavs", PAPER_FLEETS)
@pytest.mark.parametrize("n_tasks", PAPER_SIZES)
def test_shipped_settings_are_the_papers(n_uavs, n_tasks):
    """Section V-A of the paper."""
    settings = shipped("paper")[allocation_id(n_uavs, n_tasks)]
    batch = 512 if n_tasks < 300 else 256
    assert settings["n_envs"] == batch and settings["policy_kwargs"] == {"preset": "paper"}
    assert settings["n_timesteps"] == 100 * 1_280_000 * n_tasks
    assert (settings["learning_rate"], settings["lr_decay"], settings["max_grad_norm"]) == (1e-4, 0.995, 3.0)
    assert settings["baseline"] == "rollout" and settings["instances_per_epoch"] == 1_280_000
    its, evaluation = (next(iter(callback.values())) for callback in settings["callback"])
    assert [*settings["callback"][1]] == ["sb3_uav.training.FixedSetEvalCallback"] and evaluation["n_instances"] >= batch // 4
    assert ITSCallback(**its).n_epochs == 100
    phases = {4: (5, 8, 4), 6: (5, 12, 6)}[n_uavs]
    assert (its["n_pretraining_epochs"], its["n_intensive_epochs"], its["n_continuous_epochs"]) == phases
    router = its["router"]
    assert (router["learning_rate"], router["max_grad_norm"], router["n_envs"]) == (1e-4, 1.0, batch)
    assert router["baseline"] == "rollout" and router.get("lr_decay", 1.0) == 1.0
    assert router["policy_kwargs"] == {"preset": "paper"}


@pytest.mark.parametrize("algo", SHIPPED)
@pytest.mark.parametrize("n_uavs", PAPER_FLEETS)
@pytest.mark.parametrize("n_tasks", PAPER_SIZES)
def test_entries_for_two_cores(algo, n_uavs, n_tasks):
    """The recipe: imitation first, then the paper's phases, on rollouts of whole episodes; n_timesteps is the whole plan."""
    entry = shipped(algo)[allocation_id(n_uavs, n_tasks)]
    its = its_of(entry)
    size = entry.get("instances_per_epoch") or its["instances_per_epoch"]
    assert entry["n_timesteps"] == its["n_epochs"] * size * entry.get("n_samples", 1) * n_tasks
    assert (its["n_intensive_epochs"], its["n_continuous_epochs"]) == {4: (8, 4), 6: (12, 6)}[n_uavs]
    assert its["warm_start"]["n_updates"] >= 1000 and its["router"]["algo"] == algo
    assert size % entry["n_envs"] == 0 and size >= 8 * entry["n_envs"]
    if algo != "reinforce":
        assert entry["n_steps"] == n_tasks
    if "ppo" in algo:
        assert entry["batch_size"] * 4 == entry["n_steps"] * entry["n_envs"]
    assert "paper" not in str(entry) and any(EVALUATION_KEY in callback for callback in entry["callback"])


@pytest.mark.parametrize("name", [*SHIPPED, "paper"])
def test_shipped_routers_build(name):
    env = BatchedVecEnv([lambda: RoutePlanningEnv(20)] * 2)
    entries = {key: entry for key, entry in shipped(name).items() if key.startswith("TaskAllocation-")}
    assert len(entries) >= len(PAPER_FLEETS) * len(PAPER_SIZES)
    for router in [its_of(entry)["router"] for entry in entries.values()]:
        settings = {key: value for key, value in router.items() if key not in ("algo", "n_envs", "policy")}
        assert router["algo"] == ("reinforce" if name == "paper" else name) and router["policy"] == "RouterPolicy"
        algorithm: Any = resolve_algorithm(router["algo"])
        algorithm(RouterPolicy, env, device="cpu", **settings)


def test_texts_become_numbers():
    """YAML 1.1 takes 1e-3 for a text; rl_zoo3 stops at it, and our nested router would too."""
    given = {"a": "1e-3", "b": [{"c": "2.5e2", "d": "1e3x"}], "policy": "MlpPolicy", "e": "lin_1e-3", "f": 3}
    assert plain_numbers(given) == {"a": 0.001, "b": [{"c": 250, "d": "1e3x"}], "policy": "MlpPolicy", "e": "lin_1e-3", "f": 3}


@pytest.mark.parametrize("name", [ENV, "RoutePlanning-N20-v0"])
def test_shipped_small_entries_build(name):
    import gymnasium as gym

    settings = dict(shipped("reinforce")[name])
    for key in ("callback", "n_timesteps", "policy"):
        settings.pop(key, None)
    env = BatchedVecEnv([lambda: gym.make(name)] * settings.pop("n_envs"))
    policy = "AllocatorPolicy" if name == ENV else "RouterPolicy"
    model = REINFORCE(policy, env, device="cpu", seed=0, **settings).learn_instances(64)
    assert model.n_instances == 64
