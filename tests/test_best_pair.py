"""The best pair of a run: whatever evaluates and whenever it is interrupted, its zips were evaluated together."""

import itertools
import json
import os
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from its_runs import N_TASKS, learn, make_allocator, make_env, make_its
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, StopTrainingOnRewardThreshold

from sb3_uav.common.files import write_atomically
from sb3_uav.training import FixedSetEvalCallback, SizeGridCallback, best_pair
from sb3_uav.training.best_pair import BestPair, find_best_router
from sb3_uav.training.size_grid import _BEST_ALLOCATOR_FILE

pytest.importorskip("rl_zoo3")
from rl_zoo3.callbacks import TrialEvalCallback

from sb3_uav.zoo.checkpoints import find_router

pytestmark = [
    pytest.mark.filterwarnings("ignore:SizeGridCallback is deprecated"),
    pytest.mark.filterwarnings("ignore:ITSCallback saves no router"),
]


class Trial:
    """As much of an optuna trial as rl_zoo3's callback needs."""

    def report(self, value: float, step: int) -> None:
        pass

    def should_prune(self) -> bool:
        return False


class Forget(BaseCallback):
    """Makes every evaluation of SB3's a new best one."""

    def _on_step(self) -> bool:
        assert isinstance(self.parent, EvalCallback)
        self.parent.best_mean_reward = -np.inf
        return True


def evaluation(folder: Path, kind: Any = EvalCallback, **kwargs: Any) -> Any:
    settings: dict[str, Any] = dict(n_eval_episodes=2, eval_freq=7, verbose=0, best_model_save_path=str(folder))
    if kind is TrialEvalCallback:
        trial: Any = Trial()
        made = kind(make_env(2), trial, n_eval_episodes=2, eval_freq=7, best_model_save_path=str(folder))
        made.callback = Forget()
        made.callback.parent = made
        return made
    return kind(make_env(2), **{**settings, "callback_after_eval": Forget(), **kwargs})


def evaluating(names: tuple[str, ...], folder: Path) -> list[BaseCallback]:
    """Callbacks that evaluate, each at its own times."""
    made: dict[str, Any] = {
        "fixed": lambda: FixedSetEvalCallback(n_instances=3, n_samples=0, eval_freq=30, save_path=folder),
        "grid": lambda: SizeGridCallback(sizes=((2, 5, 3),), max_distance=1.5, freq=1, save_path=str(folder)),
        "eval": lambda: evaluation(folder),
        "maskable": lambda: evaluation(folder, MaskableEvalCallback, use_masking=False),
        "trial": lambda: evaluation(folder, TrialEvalCallback),
    }
    return [made[name]() for name in names]


def instances_of_pair(folder: Path) -> tuple[int, int]:
    """How many instances allocator and router of the best pair have learned from, as ``enjoy --load-best`` finds them."""
    router = find_router(folder / "best_model.zip")
    assert router is not None
    zips = [zipfile.ZipFile(path) for path in (folder / "best_model.zip", router)]
    data = [json.loads(file.read("data")) for file in zips]
    return data[0]["n_instances"], data[1]["n_instances"]


class Watch(BaseCallback):
    """
    After every rollout: the best pair is of one time.

    The router has learned from 8 instances before the allocator's first epoch, and from 8 more after each, of 8 instances.
    """

    def __init__(self, folder: Path, callbacks_first: bool) -> None:
        super().__init__()
        self.folder, self.callbacks_first = folder, callbacks_first
        self.found, self.evaluators = set[int](), set[str]()

    def _on_rollout_end(self) -> None:
        if not (self.folder / "best_model.zip").is_file():
            return
        allocator, router = instances_of_pair(self.folder)
        # At the start of a rollout, callbacks in front of ITS see the router before its epoch.
        earlier = self.callbacks_first and allocator > 0 and allocator % 8 == 0
        assert router in ((allocator, 8 + allocator) if earlier else (8 + allocator // 8 * 8,))
        self.found.add(allocator)
        self.evaluators.add(json.loads((self.folder / "best_pair.json").read_text())["evaluated_by"])

    def _on_step(self) -> bool:
        return True


KINDS = ("fixed", "grid", "eval")
ORDERS = [names for n in (1, 2, 3) for names in itertools.permutations(KINDS, n)]
SETS = [names for n in (1, 2, 3) for names in itertools.combinations(KINDS, n)]
ZOO: list[tuple[str, ...]] = [("maskable",), ("trial",), ("trial", "grid"), ("eval", "fixed", "maskable")]


@pytest.mark.parametrize(
    ("names", "callbacks_first"),
    [*((names, False) for names in (*ORDERS, *ZOO)), *((names, True) for names in SETS)],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else {True: "first", False: "last"}[value],
)
def test_best_pair_was_evaluated_together(names, callbacks_first, tmp_path, monkeypatch):
    """In every combination and order of callbacks, with every evaluation a new best one."""
    monkeypatch.setattr(FixedSetEvalCallback, "_scores", lambda self, history: history.timesteps + 1.0)
    its = make_its(n_epochs=3, n_pretraining_epochs=1, n_intensive_epochs=0, save_path=str(tmp_path))
    callbacks, watch = evaluating(names, tmp_path), Watch(tmp_path, callbacks_first)
    model = make_allocator()
    model.learn(10**9, callback=[*callbacks, its, watch] if callbacks_first else [its, *callbacks, watch])
    assert len(watch.found) >= 3
    owner = next((kind for kind in KINDS if kind in names), "eval")
    evaluators = {"fixed": {"FixedSetEvalCallback"}, "grid": {"SizeGridCallback"}}
    # One callback decides on the best pair, all the time.
    assert watch.evaluators == evaluators.get(owner, watch.evaluators)
    assert (tmp_path / _BEST_ALLOCATOR_FILE).is_file() == (owner == "grid")
    if owner == "grid":
        assert (tmp_path / _BEST_ALLOCATOR_FILE).read_bytes() == (tmp_path / "best_model.zip").read_bytes()


def test_two_folders_have_two_pairs(tmp_path):
    """An EvalCallback with a folder of its own keeps its own best model there, with its router."""
    its = make_its(n_epochs=2, n_pretraining_epochs=1, n_intensive_epochs=0, save_path=str(tmp_path))
    fixed, elsewhere = *evaluating(("fixed",), tmp_path), evaluation(tmp_path / "elsewhere")
    learn(make_allocator(), its, fixed, elsewhere)
    assert json.loads((tmp_path / "elsewhere" / "best_pair.json").read_text())["evaluated_by"] == "EvalCallback"
    allocator, router = instances_of_pair(tmp_path / "elsewhere")
    assert router == 8 + allocator // 8 * 8
    assert json.loads((tmp_path / "best_pair.json").read_text())["evaluated_by"] == "FixedSetEvalCallback"


def test_best_router_when_the_last_evaluation_is_the_best(tmp_path):
    """The last call of on_step may be the one that finds the best allocator."""
    its = make_its(n_epochs=2)
    make_allocator().learn(2 * 8 * N_TASKS, callback=[its, evaluation(tmp_path, eval_freq=20)])
    assert (tmp_path / "best_model.zip").is_file() and (tmp_path / "best_router.zip").is_file()


def test_callbacks_on_a_new_best_model_still_run(tmp_path):
    """After the zips are in place; that of SB3 asks its parent, also in a second call of `learn`."""
    seen = []

    class Read(StopTrainingOnRewardThreshold):
        def _on_step(self) -> bool:
            seen.append((tmp_path / "best_model.zip").is_file() and find_best_router(tmp_path) is not None)
            return super()._on_step()

    stock = evaluation(tmp_path, callback_on_new_best=Read(reward_threshold=1e9), callback_after_eval=None)
    its, model = make_its(n_epochs=4, n_pretraining_epochs=1, n_intensive_epochs=0), make_allocator()
    for _ in range(2):
        stock.best_mean_reward = -np.inf
        model.learn(2 * 8 * N_TASKS, callback=[its, stock])
    assert len(seen) >= 2 and all(seen)
    # Which is why find_run_folder still finds the folder.
    assert its.save_path == tmp_path and stock.best_model_save_path is None


def test_without_its_sb3_saves_its_own_best_model(tmp_path):
    stock = evaluation(tmp_path)
    make_allocator().learn(2 * 8 * N_TASKS, callback=stock)
    assert stock.best_model_save_path == str(tmp_path) and not (tmp_path / "best_pair.json").exists()
    assert find_router(tmp_path / "best_model.zip") is None


# ------------------------------------------------------------------------------------------ interruptions


def save(folder: Path, number: int) -> None:
    """Save a pair whose zips hold this number."""
    allocator, router = Zip(number), Zip(number)
    BestPair(folder, copies=("best_allocator.zip",)).save(allocator, router, number=number)  # type: ignore[arg-type]


class Zip:
    """Stands for an algorithm: its zip is its number."""

    def __init__(self, number: int) -> None:
        self.number = number


def numbers(folder: Path) -> tuple[str, str]:
    router = find_best_router(folder)
    assert router is not None
    return (folder / "best_model.zip").read_text(), router.read_text()


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("first", range(7))
def test_an_interruption_between_the_writes_leaves_one_pair(first, failure, tmp_path, monkeypatch):
    """Whichever rename is the last one that happens; and so does an interruption of the next save, wherever that is."""
    monkeypatch.setattr(best_pair, "save_atomically", lambda model, path: write_atomically(path, str(model.number)))

    def save_interrupted(folder: Path, number: int, at: int) -> None:
        """Save, but fail at one of the renames."""
        replace, calls = os.replace, itertools.count()

        def interrupted(source: Any, target: Any) -> None:
            if next(calls) == at:
                raise failure
            replace(source, target)

        with monkeypatch.context() as patched, suppress(failure):
            patched.setattr(os, "replace", interrupted)
            save(folder, number)

    for second in range(8):
        folder = tmp_path / str(second)
        save(folder, 1)
        assert numbers(folder) == ("1", "1")
        save_interrupted(folder, 2, first)
        pair = numbers(folder)
        assert pair in (("1", "1"), ("2", "2"))
        save_interrupted(folder, 3, second)
        assert numbers(folder) in (pair, ("3", "3"))
        save(folder, 4)
        assert numbers(folder) == ("4", "4")
        assert (folder / "best_router.zip").read_text() == (folder / "best_allocator.zip").read_text() == "4"


def test_the_renames_are_few_enough_for_the_test_above(tmp_path, monkeypatch):
    monkeypatch.setattr(best_pair, "save_atomically", lambda model, path: write_atomically(path, str(model.number)))
    with patch.object(os, "replace", side_effect=os.replace) as replace:
        save(tmp_path, 1)
    assert 5 <= replace.call_count <= 6


def test_a_model_without_router_has_none(tmp_path, monkeypatch):
    """Also in a folder where an earlier run has left one."""
    monkeypatch.setattr(best_pair, "save_atomically", lambda model, path: write_atomically(path, str(model.number)))
    pair = BestPair(tmp_path)
    pair.save(Zip(1), None)  # type: ignore[arg-type]
    assert find_best_router(tmp_path) is None and [path.name for path in tmp_path.iterdir()] == ["best_model.zip"]
    save(tmp_path, 2)
    pair.save(Zip(3), None)  # type: ignore[arg-type]
    assert find_best_router(tmp_path) is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"model": 1}', "null", "\xff"])
def test_runs_of_earlier_versions_and_damaged_notes(text, tmp_path):
    """The names decide, as they did before there was a note."""
    (tmp_path / "best_pair.json").write_bytes(text.encode("latin-1"))
    assert find_best_router(tmp_path) is None
    for name in ("best_router.zip", "best_model.zip"):
        (tmp_path / name).write_text(name)
        assert find_best_router(tmp_path) == tmp_path / "best_router.zip"
