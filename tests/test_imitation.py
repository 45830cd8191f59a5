"""Imitation of local search: a router that has only been shown tours beats an untrained one, and starts an ITS run."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from instance_helpers import assert_equal
from solver_helpers import make_policy

from sb3_uav.envs import (
    BatchedVecEnv,
    TaskAllocationEnv,
    UniformGenerator,
    WorldGenerator,
    check_schedule,
    nearest_feasible,
    schedules,
)
from sb3_uav.envs.allocation import plan_tours, split_tasks
from sb3_uav.envs.generators import MixtureGenerator
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.reinforce import REINFORCE
from sb3_uav.training import ITSCallback
from sb3_uav.training.its_checkpoint import CHECKPOINT_FOLDER, WARM_START_FOLDER, read_state

pytest.importorskip("numba")
from sb3_uav.training import imitation
from sb3_uav.training.imitation import Lesson, _search_lessons, _varied, good_tours, imitate
from sb3_uav.training.imitation_progress import ImitationProgress

WARM_START: dict[str, Any] = {"n_subsets": 40, "n_updates": 4, "batch_size": 8}


@pytest.fixture(scope="module")
def allocator() -> Any:
    return make_policy(AllocatorPolicy, 4)


def parameters(policy: Any) -> th.Tensor:
    return th.cat([parameter.flatten() for parameter in policy.parameters()]).detach().clone()


def test_tours_are_feasible_and_good() -> None:
    """At least as good as the nearest feasible task after another, and complete: nothing more can be visited."""
    subsets = UniformGenerator(25, 1, max_distance=1.5)(6, np.random.default_rng(0)).pad(30)
    tours = good_tours(subsets)
    for row, schedule in enumerate(schedules(tours[:, None] - 1)):
        assert check_schedule(subsets, row, schedule).objective == int((tours[row] > 0).sum())
    evaluation = make_policy(RouterPolicy).evaluate_episodes(subsets, tours[:, None])
    assert evaluation.log_prob.isfinite().all()
    assert (tours > 0).sum() > (nearest_feasible(subsets) > 0).sum()


def test_a_router_learns_by_imitation(allocator: Any) -> None:
    """Greedy tours over new instances. Without geometry an untrained router is poor."""
    router = make_policy(RouterPolicy, geometry=False)
    instances = allocator.arrange(UniformGenerator(60, 4)(24, np.random.default_rng(7)))
    assignment = allocator.decode_episodes(instances)

    def tasks() -> float:
        return float(plan_tours(instances, assignment, router.plan).value.mean())

    before = tasks()
    imitate(router, allocator, UniformGenerator(60, 4), np.random.default_rng(0), 800, 150, 32, 5e-3)
    assert not router.training
    assert tasks() > 1.15 * before


def test_the_same_numbers_give_the_same_router(allocator: Any) -> None:
    found = []
    for _ in range(2):
        router = make_policy(RouterPolicy)
        imitate(router, allocator, MixtureGenerator(50, 4), np.random.default_rng(3), 40, 3, 8)
        found.append(parameters(router))
    assert th.equal(*found) and not th.equal(found[0], parameters(make_policy(RouterPolicy)))


@pytest.mark.parametrize(
    "n_searched, n_updated", [(1, 99), (3, 99), (99, 0), (99, 5)], ids=["search", "later", "begin", "updates"]
)
def test_an_interrupted_imitation_goes_on(
    allocator: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_searched: int, n_updated: int
) -> None:
    """With the same result, and without doing anything twice that was saved."""
    monkeypatch.setattr(imitation, "_CHUNK_SIZE", 20)
    monkeypatch.setattr(imitation, "_SAVE_EVERY", 2)

    def learned(folder: Path | None) -> th.Tensor:
        router = make_policy(RouterPolicy)
        imitate(router, allocator, MixtureGenerator(30, 4), np.random.default_rng(3), 90, 7, 8, folder=folder)
        return parameters(router)

    searches, updates = Mock(side_effect=good_tours), Mock(side_effect=_varied)
    with monkeypatch.context() as patch:
        patch.setattr(imitation, "good_tours", searches)
        expected = learned(None)
    n_all = searches.call_count
    with monkeypatch.context() as patch:
        counts = {"good_tours": n_searched, "_varied": n_updated}
        for name, function in (("good_tours", good_tours), ("_varied", _varied)):

            def interrupted(*args: Any, name: str = name, function: Any = function) -> Any:
                counts[name] -= 1
                if counts[name] < 0:
                    raise KeyboardInterrupt
                return function(*args)

            patch.setattr(imitation, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            learned(tmp_path)
    searches.reset_mock()
    monkeypatch.setattr(imitation, "good_tours", searches)
    monkeypatch.setattr(imitation, "_varied", updates)
    assert th.equal(learned(tmp_path), expected)
    n_again = 7 - (4 if n_updated == 5 else 0)
    assert updates.call_count == n_again
    assert searches.call_count == 0 if n_searched == 99 else 0 < searches.call_count <= n_all - (n_searched > 1)
    # And once more, where nothing but the last update is left.
    assert th.equal(learned(tmp_path), expected) and updates.call_count == n_again + 1


def test_wrong_progress(allocator: Any, tmp_path: Path) -> None:
    def learn(n_updates: int = 1, **network: Any) -> None:
        router = make_policy(RouterPolicy, **network)
        imitate(router, allocator, UniformGenerator(5, 4), np.random.default_rng(0), 8, n_updates, 8, folder=tmp_path)

    learn()
    with pytest.raises(ValueError, match=r"lessons_0.pt: belongs to an imitation with .*'n_updates': 1.*; remove"):
        learn(2)
    path = tmp_path / "lessons_0.pt"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"lessons_0.pt: not an intact file"):
        learn()


def test_progress_of_another_network(allocator: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imitation, "_SAVE_EVERY", 1)

    def learn(embed_dim: int) -> None:
        router = make_policy(RouterPolicy, embed_dim=embed_dim)
        imitate(router, allocator, UniformGenerator(5, 4), np.random.default_rng(0), 8, 1, 8, folder=tmp_path)

    learn(8)
    with pytest.raises(ValueError, match=r"updates.pt: of another network"):
        learn(16)


def damage(path: Path, change: Any) -> None:
    """Change the contents of a file of the imitation's progress."""
    content = th.load(path, weights_only=True)
    change(content)
    th.save(content, path)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.pop("lessons"),
        lambda content: content.update(lessons=3),
        lambda content: content.update(lessons=[3]),
        lambda content: content["lessons"][0].pop("tours"),
        lambda content: content["lessons"][0].pop("depot"),
        lambda content: content["lessons"][0].update(depot=None),
        lambda content: content["lessons"][0].update(tours=content["lessons"][0]["tours"][:-1]),
        lambda content: content["lessons"][0].update(tours=content["lessons"][0]["tours"].float()),
        lambda content: content["lessons"][0].update(tours=content["lessons"][0]["tours"] + 1000),
        lambda content: content.update(rng="{}"),
        lambda content: content.update(rng=content["rng"].replace('"state"', '"syate"')),
        lambda content: content.update(rng=content["rng"].replace("PCG64", "MT19937")),
        lambda content: content.pop("rng"),
        lambda content: content.pop("settings"),
    ],
)
def test_damaged_lessons_are_named(change: Any, allocator: Any, tmp_path: Path) -> None:
    """Never a traceback of another kind."""

    def learn() -> None:
        imitate(
            make_policy(RouterPolicy), allocator, UniformGenerator(5, 4), np.random.default_rng(0), 8, 1, 8, folder=tmp_path
        )

    learn()
    damage(tmp_path / "lessons_0.pt", change)
    with pytest.raises(ValueError, match=r"lessons_0.pt: not an intact file .*; remove .* to start again"):
        learn()


@pytest.mark.parametrize("change", [dict(n_updates="many"), dict(router=None), dict(optimizer={"state": 3})])
def test_damaged_updates_are_named(change: Any, allocator: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imitation, "_SAVE_EVERY", 1)

    def learn() -> None:
        imitate(
            make_policy(RouterPolicy), allocator, UniformGenerator(5, 4), np.random.default_rng(0), 8, 1, 8, folder=tmp_path
        )

    learn()
    damage(tmp_path / "updates.pt", lambda content: content.update(change))
    with pytest.raises(ValueError, match=r"updates.pt: "):
        learn()


def test_variants_are_the_same_tours(allocator: Any) -> None:
    """Some of the rows, turned, some of them backwards: as long, and as many tasks."""
    lesson = _search_lessons(allocator, UniformGenerator(30, 4), np.random.default_rng(0), 60, 16)[0]
    for seed in range(4):
        variant = _varied(lesson, np.random.default_rng(seed), 16)
        assert 0 < len(variant.tours) <= len(lesson.tours)
        for row in range(len(variant.tours)):
            length = tour_length(variant, row)
            assert any(length == pytest.approx(tour_length(lesson, other), abs=1e-6) for other in range(len(lesson.tours)))


def whole_lesson() -> Lesson:
    """Feasible tours from a start to another end, with service costs."""
    fleets = WorldGenerator(12, 3, whole_share=1.0)(20, np.random.default_rng(0))
    assert fleets.start is not None and fleets.end is not None and fleets.service is not None
    everything = th.arange(12).expand(20, 1, -1) % 3
    subsets = split_tasks(fleets, everything).instances
    return Lesson(subsets, nearest_feasible(subsets))


def test_tours_flown_backwards_begin_at_the_end() -> None:
    lesson = whole_lesson()
    variant = _varied(lesson, np.random.default_rng(1), 64)
    assert not th.equal(variant.instances.uav_start, lesson.instances.uav_start)
    for row, schedule in enumerate(schedules(variant.tours[:, None] - 1)):
        check_schedule(variant.instances, row, schedule)


def test_progress_keeps_the_whole_problem(tmp_path: Path) -> None:
    lesson, rng = whole_lesson(), np.random.default_rng(0)
    ImitationProgress(tmp_path, {}).save_lessons([lesson], rng)
    (restored,) = ImitationProgress(tmp_path, {}).restore_lessons(rng)
    assert_equal(restored.instances, lesson.instances)
    assert th.equal(restored.tours, lesson.tours)


def test_a_router_learns_from_maps_of_all_kinds(allocator: Any) -> None:
    router = make_policy(RouterPolicy)
    before = parameters(router)
    generator = WorldGenerator(40, 4, whole_share=0.0)
    imitate(router, allocator, generator, np.random.default_rng(3), 40, 3, 8)
    assert not th.equal(parameters(router), before) and parameters(router).isfinite().all()


def tour_length(lesson: Lesson, row: int) -> float:
    tour = [node for node in lesson.tours[row].tolist() if node > 0]
    stops = th.stack([lesson.instances.depot[row], *(lesson.instances.tasks[row, node - 1] for node in tour)])
    return float((stops - stops.roll(-1, 0)).norm(dim=1).sum())


def test_lessons_report_and_count(allocator: Any) -> None:
    told: list[str] = []
    imitate(
        make_policy(RouterPolicy), allocator, UniformGenerator(20, 4), np.random.default_rng(0), 20, 2, 8, report=told.append
    )
    assert told[-1].startswith("imitation: 2 of 2 updates")


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(n_subsets=0), "n_subsets is 0; it must be a whole number of at least 1"),
        (dict(n_updates=1.5), "n_updates is 1.5; it must be a whole number"),
        (dict(learning_rate=0.0), "learning_rate is 0.0; it must be above 0"),
    ],
)
def test_wrong_arguments(kwargs: Any, message: str, allocator: Any) -> None:
    with pytest.raises(ValueError, match=message):
        imitate(make_policy(RouterPolicy), allocator, UniformGenerator(5, 4), np.random.default_rng(0), **kwargs)


def make_its(**kwargs: Any) -> ITSCallback:
    router = dict(policy="RouterPolicy", n_envs=2, policy_kwargs=dict(embed_dim=8, n_layers=1, n_heads=2), baseline="none")
    settings: dict[str, Any] = dict(n_epochs=1, strategy="ITS/pre-training&intensive", warm_start=WARM_START)
    return ITSCallback(router, **{**settings, **kwargs})


def make_model() -> REINFORCE:
    policy: Any = AllocatorPolicy
    env: Any = BatchedVecEnv([lambda: TaskAllocationEnv(8, 2)] * 2)
    return REINFORCE(policy, env, instances_per_epoch=2, baseline="none", seed=0, device="cpu")


def test_its_starts_with_it_once(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """The router has learned before the allocator begins; a resumed run does not repeat it."""
    make_model().learn(10**9, callback=make_its(save_path=str(tmp_path), verbose=1))
    assert "imitation: 4 of 4 updates" in capsys.readouterr().out
    state = read_state(tmp_path / CHECKPOINT_FOLDER)
    model = REINFORCE.load(tmp_path / CHECKPOINT_FOLDER / state["allocator"], env=make_model().env, device="cpu")
    again = make_its(save_path=str(tmp_path), verbose=1, n_epochs=2)
    model.learn(10**9, callback=again, reset_num_timesteps=False)
    assert "imitation" not in capsys.readouterr().out and again.epoch == 2


@pytest.mark.parametrize("room", ["training", "solvers"])
def test_its_goes_on_with_it(room: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was interrupted in its warm start resumes in another folder, and ends like an uninterrupted one."""
    monkeypatch.setattr(imitation, "_SAVE_EVERY", 2)
    expected = make_its(save_path=str(tmp_path / "expected"))
    make_model().learn(10**9, callback=expected)
    calls = []

    def interrupted(*args: Any) -> Any:
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return _varied(*args)

    monkeypatch.setattr(imitation, "_varied", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_model().learn(10**9, callback=make_its(save_path=str(tmp_path / "first")))
    first = tmp_path / "first" / CHECKPOINT_FOLDER
    assert (first / WARM_START_FOLDER / "updates.pt").is_file()
    model = REINFORCE.load(first / read_state(first)["allocator"], env=make_model().env, device="cpu")
    # The dotted path that earlier versions needed means the same, and so does the one of before that.
    again = make_its(save_path=str(tmp_path / "second"), warm_start={f"sb3_uav.{room}.imitation.imitate": WARM_START})
    model.learn(10**9, callback=again)
    # The last two of four updates were not saved, and done again.
    assert len(calls) == 4 + 2 and again.epoch == 1
    assert th.equal(parameters(again.router.policy), parameters(expected.router.policy))
    assert not (tmp_path / "second" / CHECKPOINT_FOLDER / WARM_START_FOLDER).exists()
    assert (first / WARM_START_FOLDER).exists()


def test_a_resumed_warm_start_is_as_long_as_it_began(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever number of steps the run is resumed with."""

    def epochs(callback: ITSCallback) -> list[tuple[str, int, int, float]]:
        return [(record.level, record.epoch, record.n_instances, record.objective) for record in callback.records]

    kwargs: dict[str, Any] = dict(n_epochs=4, strategy="its", n_pretraining_epochs=2, n_intensive_epochs=0)
    unbroken = make_its(**kwargs, save_path=str(tmp_path / "unbroken"))
    with pytest.warns(UserWarning, match=r"cut to 0\.5 of their length"):
        make_model().learn(2 * 2 * 8, callback=unbroken)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(imitation, "_varied", interrupt)
        make_model().learn(2 * 2 * 8, callback=make_its(**kwargs, save_path=str(tmp_path / "broken")))
    folder = tmp_path / "broken" / CHECKPOINT_FOLDER
    state = read_state(folder)
    assert (state["share"], state["warm_started"]) == (0.5, False)
    model = REINFORCE.load(folder / state["allocator"], env=make_model().env, device="cpu")
    resumed = make_its(**kwargs, save_path=str(tmp_path / "broken"), resume_from=str(folder))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="This run has")
        model.learn(3 * 2 * 8, callback=resumed, reset_num_timesteps=False)
    assert read_state(folder)["share"] == 0.5 and resumed.epoch == 3
    assert len(epochs(unbroken)) == 1 + 2 * 2 and epochs(resumed)[:5] == epochs(unbroken)


def interrupt(*args: Any) -> None:
    raise KeyboardInterrupt


def test_a_warm_start_of_the_users_own() -> None:
    """It need not report, nor keep anything."""
    with pytest.warns(UserWarning, match="ITSCallback saves no router"):
        callback = make_its(warm_start={f"{__name__}.zero_router": {"value": 0.5}})
        make_model().learn(10**9, callback=callback)
    assert STARTED == [0.5]


STARTED: list[float] = []


def zero_router(router: Any, allocator: Any, generator: Any, rng: np.random.Generator, value: float) -> None:
    assert isinstance(router, RouterPolicy) and isinstance(allocator, AllocatorPolicy)
    STARTED.append(value)


@pytest.mark.filterwarnings("ignore:ITSCallback saves no router")
@pytest.mark.parametrize(
    "warm_start, message",
    [
        ({}, "warm_start must hold arguments of sb3_uav.training.imitation.imitate"),
        ({"a.b": {}, "c.d": {}}, "warm_start must map the dotted path of one function to its arguments"),
        ({"a.b": {}, "n_updates": 1}, "warm_start must map the dotted path of one function to its arguments"),
        ({"a.b": 3}, "warm_start: the arguments of a.b must be a mapping, found 3"),
        ({"n_tours": 3}, "warm_start: these arguments do not fit .*n_tours"),
        ({"sb3_uav.nothing.at_all": {}}, "warm_start is 'sb3_uav.nothing.at_all', which cannot be imported"),
        ({"sb3_uav.training.imitation._WARM_UP": {}}, "warm_start: these arguments do not fit .*WARM_UP"),
        ({"sb3_uav.training.imitation.imitate": {"n_tours": 3}}, "warm_start: these arguments do not fit .*n_tours"),
    ],
)
def test_wrong_warm_starts(warm_start: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model().learn(10**9, callback=make_its(warm_start=warm_start))
