"""Every file in `examples/` runs as a user would run it, but for the size of the run, and prints what it says."""

import ast
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
import torch as th
from forked import run_forked
from PIL import Image

from sb3_uav import pretrained
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy

EXAMPLES = Path(__file__).parents[1] / "examples"
NUMBER = r"(\d+\.\d+)"


def play(path: Path, arguments: tuple[str, ...]) -> None:
    sys.argv = [str(path), *arguments]
    runpy.run_path(str(path), run_name="__main__")


def run(name: str, folder: Path, *arguments: str) -> str:
    """What the example printed, started in this folder."""
    return run_forked(play, folder, EXAMPLES / f"{name}.py", arguments)


def numbers(pattern: str, text: str) -> list[float]:
    """The groups of the one match of a pattern."""
    (found,) = re.finditer(pattern, text)
    return [float(group) for group in found.groups()]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_each_is_short_and_says_what_it_shows(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 60 and len(ast.get_docstring(ast.parse(text)) or "") > 80
    tested = re.findall(r'run\("(\w+)"', Path(__file__).read_text())
    assert path.stem in tested and "argparse" in text


@pytest.mark.slow
def test_ppo(tmp_path):
    untrained, trained, n_steps = numbers(
        rf"Tasks on a tour: {NUMBER} untrained, {NUMBER} after (\d+) steps", run("ppo", tmp_path, "--timesteps", "3000")
    )
    assert 2.5 < untrained < 20 and 2.5 < trained < 20 and n_steps >= 3000


@pytest.mark.slow
def test_maskable_ppo(tmp_path):
    n_tasks, illegal = numbers(
        rf"Tasks on a tour: {NUMBER}; illegal actions: (\d+)", run("maskable_ppo", tmp_path, "--timesteps", "1000")
    )
    assert 2.5 < n_tasks < 20 and illegal == 0


@pytest.mark.slow
def test_multi_input_policy(tmp_path):
    printed = run("multi_input_policy", tmp_path, "--timesteps", "1000")
    assert 2 < numbers(rf"Allocator: {NUMBER} tasks visited by the fleet", printed)[0] < 20
    assert 2 < numbers(rf"Router: {NUMBER} tasks on a tour", printed)[0] < 20


@pytest.mark.slow
def test_reinforce(tmp_path):
    printed = run("reinforce", tmp_path, "--timesteps", "10000")
    for n_tasks in (20, 50):
        greedy, sampled = numbers(rf"{n_tasks} tasks: {NUMBER} visited greedily, {NUMBER} by the best of 16 samples", printed)
        assert 2.5 < greedy < sampled < n_tasks


@pytest.mark.slow
def test_both_levels_evaluated_and_drawn(tmp_path):
    """The zips that one example writes are what the other one reads."""
    printed = run("its_ppo", tmp_path, "--timesteps", "2560")
    assert "router epoch 1 (pre-training)" in printed and "allocator epoch 2 (intensive)" in printed
    assert isinstance(load_policy(tmp_path / "pair" / "allocator.zip"), AllocatorPolicy)
    assert isinstance(load_policy(tmp_path / "pair" / "router.zip"), RouterPolicy)
    printed = run("evaluate_and_draw", tmp_path, "--n-instances", "4")
    objectives = {}
    for solver in ("DL-DRL (greedy)", "DL-DRL (sampling 64)", "kmeans-nearest"):
        (line,) = re.findall(rf"{re.escape(solver)}: (.*)", printed)
        objectives[solver], length = numbers(rf"{NUMBER} tasks, tours of {NUMBER} on average", line)
        assert 0 < length <= 1.5
    assert objectives["DL-DRL (greedy)"] <= objectives["DL-DRL (sampling 64)"] <= 20
    assert (tmp_path / "schedule.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_fine_tune(tmp_path):
    small = ("--epochs", "1", "--instances-per-epoch", "16", "--held-out", "3", "--decode", "greedy", "sampling")
    printed = run("fine_tune", tmp_path, *small)
    assert "router epoch 1 (alternate)" in printed
    changed = False
    for level, policy_class in (("allocator", AllocatorPolicy), ("router", RouterPolicy)):
        tuned: Any = load_policy(tmp_path / "fine_tuned" / f"{level}.zip", expected=policy_class)
        before_and_after: Any = (tuned.features_extractor, shipped(level))
        changed |= not th.equal(*(extractor.encoder.embed_task.bias for extractor in before_and_after))
    assert changed
    for decode in ("greedy", "sampling"):
        before, after, gain = numbers(
            rf"{decode}: {NUMBER} tasks as shipped, {NUMBER} fine-tuned, gain (-?\d+\.\d+) \+- \d+\.\d+", printed
        )
        assert 30 < before <= 80 and abs(after - before - gain) < 0.011


def shipped(level):
    return load_policy(pretrained.files()[level == "router"]).features_extractor


@pytest.mark.slow
def test_freeze_extractor(tmp_path):
    printed = run("freeze_extractor", tmp_path, "--timesteps", "2560")
    in_encoder, n_encoder, elsewhere, n_elsewhere = numbers(
        r"Parameters that changed: (\d+) of (\d+) in the encoder,\n(\d+) of (\d+) elsewhere", printed
    )
    assert in_encoder == 0 < n_encoder and elsewhere == n_elsewhere > 0


@pytest.mark.slow
def test_own_coordinates(tmp_path):
    printed = run("own_coordinates", tmp_path, "--timesteps", "3000")
    n_stops = 0
    for uav in range(2):
        (length, stops), *others = re.findall(rf"UAV {uav}, (\d+) m of 5000 m: (.*)", printed)
        assert not others and 0 < float(length) <= 5000
        points = [tuple(map(int, point)) for point in re.findall(r"\((\d+), (\d+)\)", stops)]
        # One UAV flies west of the depot, the other one east of it.
        assert points and all((x < 1200) == (uav == 1) for x, _ in points)
        n_stops += len(points)
    assert f"{n_stops} of 15 tasks visited" in printed


@pytest.mark.slow
def test_watch_training(tmp_path):
    n_maps, n_allocator, n_router = numbers(
        r"(\d+) maps, (\d+) points of the allocator, (\d+) points of the router: watch.png",
        run("watch_training", tmp_path, "--epochs", "2", "--instances", "64"),
    )
    # Two updates of 32 instances make an epoch; the router has four epochs of pre-training, and two after the second of the
    # allocator.
    assert (n_maps, n_allocator, n_router) == (3, 4, 12)
    with Image.open(tmp_path / "watch.png") as picture:
        assert picture.size[0] > 2 * picture.size[1] and len(picture.convert("RGB").getcolors(2**24) or ()) > 100


@pytest.mark.slow
def test_knapsack(tmp_path):
    chance, greedy, learned, illegal = numbers(
        rf"Value packed: {NUMBER} at random, {NUMBER} by value per weight, {NUMBER} learned; illegal: (\d+)",
        run("knapsack", tmp_path, "--timesteps", "10000"),
    )
    assert chance < 4 < 4.8 < learned and 5 < greedy and illegal == 0


@pytest.mark.slow
def test_tsp(tmp_path):
    chance, greedy, learned, illegal = numbers(
        rf"Tour length: {NUMBER} at random, {NUMBER} to the nearest, {NUMBER} learned; illegal: (\d+)",
        run("tsp", tmp_path, "--timesteps", "10000"),
    )
    assert learned < 3.8 < 5 < chance and 3 < greedy < 3.4 and illegal == 0
