"""How much of the paper's experiments to run: a smoke test, an afternoon on two cores, or everything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_uav.reproduce.paper import FLEETS, LARGER_SIZES, MAX_DISTANCE, SIZES


@dataclass(frozen=True)
class Scenario:
    """
    One of the paper's situations.

    :param n_uavs: Number of UAVs
    :param n_tasks: Number of tasks in the paper; a scale may let a smaller number stand in for it
    """

    n_uavs: int
    n_tasks: int

    @property
    def name(self) -> str:
        """Name in the paper."""
        return f"U{self.n_uavs}-{self.n_tasks}"

    @property
    def folder(self) -> str:
        """Name of its folders."""
        return f"U{self.n_uavs}-N{self.n_tasks}"


@dataclass(frozen=True)
class Recipe:
    """
    Training settings of pairs: the zoo's YAML entry of the scenario with these changes.

    :param allocator: Changes to the entry itself, i.e., to the allocator's algorithm
    :param router: Changes to the router's algorithm
    :param its: Changes to the interactive training strategy
    :param instances_per_epoch: Instances per epoch by the paper's number of tasks; that of the entry where missing
    """

    allocator: Mapping[str, Any] = field(default_factory=dict)
    router: Mapping[str, Any] = field(default_factory=dict)
    its: Mapping[str, Any] = field(default_factory=dict)
    instances_per_epoch: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Scale:
    """
    The settings of all tables and figures.

    :param name: Value of ``--scale``
    :param text: Description in one sentence
    :param shrink: The paper's numbers of tasks are divided by this
    :param max_distance: Maximum flight distance
    :param trained_sizes: The paper's numbers of tasks that pairs are trained for; others are solved by the nearest pair
    :param recipe: Training settings of these pairs
    :param timing: Training settings of the runs that Table I times; those of the other tables when None
    :param n_instances: Test instances by the paper's number of tasks (Tables II to IV, Figs. 6 and 7)
    :param n_exact_instances: Test instances of the exact solver
    :param exact_sizes: Numbers of tasks that it is run on
    :param exact_backend: Backend of the exact solver
    :param time_limits: Seconds per instance by solver; the others run to their end, as all but the exact one do in the paper
    :param samples: Samples per instance of "Sampling"
    """

    name: str
    text: str
    recipe: Recipe
    n_instances: Mapping[int, int]
    n_exact_instances: int
    exact_sizes: tuple[int, ...]
    exact_backend: str
    time_limits: Mapping[str, float]
    samples: int
    timing: Recipe | None = None
    trained_sizes: tuple[int, ...] = SIZES
    shrink: int = 1
    max_distance: float = MAX_DISTANCE

    def n_tasks(self, scenario: Scenario) -> int:
        """
        :param scenario: One of the paper's
        :return: The number of tasks of its instances at this scale
        """
        return scenario.n_tasks // self.shrink

    def trained_for(self, scenario: Scenario) -> Scenario:
        """
        :param scenario: The scenario to solve
        :return: The scenario, of the same fleet, whose pair solves it: itself if it is trained at this scale, else the one
            whose number of tasks is nearest in proportion
        """
        nearest = min(self.trained_sizes, key=lambda size: abs(math.log(size / scenario.n_tasks)))
        return Scenario(scenario.n_uavs, nearest)


def scenarios(sizes: tuple[int, ...] = SIZES) -> list[Scenario]:
    """
    :param sizes: Numbers of tasks
    :return: The paper's situations of these sizes, fleet by fleet
    """
    return [Scenario(n_uavs, n_tasks) for n_uavs in FLEETS for n_tasks in sizes]


# The paper's networks, smaller. Its batch normalization needs larger batches than these scales have.
_TINY = {"preset": "paper", "normalization": "instance", "embed_dim": 16, "n_layers": 1, "n_heads": 2, "ff_dim": 16}
_SMALL = {"preset": "paper", "normalization": "instance", "embed_dim": 64, "n_layers": 2, "n_heads": 4, "ff_dim": 128}
# Eight samples per instance with their mean as the baseline: no second rollout and far fewer instances.
_SHARED_BASELINE = {"baseline": "shared", "n_samples": 8, "normalize_advantage": True, "learning_rate": 1e-3}

_SMOKE = Scale(
    name="smoke",
    text="a test of the commands, not of the method: tiny networks, a tenth of the tasks, a maximum flight distance of 1",
    shrink=10,
    max_distance=1.0,
    trained_sizes=(80, 200),
    recipe=Recipe(
        allocator={**_SHARED_BASELINE, "policy_kwargs": _TINY, "n_envs": 8, "n_samples": 4},
        router={**_SHARED_BASELINE, "policy_kwargs": _TINY, "n_envs": 8, "n_samples": 4},
        its={"n_epochs": 4, "n_pretraining_epochs": 1, "n_intensive_epochs": 2, "n_continuous_epochs": 2},
        instances_per_epoch=dict.fromkeys(SIZES, 16),
    ),
    n_instances=dict.fromkeys((*SIZES, *LARGER_SIZES), 2),
    n_exact_instances=1,
    exact_sizes=(80,),
    exact_backend="highs",
    time_limits={"milp": 1.0, "ortools-gls": 0.2, "pyvrp": 0.2},
    samples=8,
)

_CPU = Scale(
    name="cpu",
    text="an afternoon on two CPU cores with two jobs: networks of width 64 with two layers, 24 epochs of 640 instances and "
    "fewer, eight samples per instance with their mean as baseline in place of the greedy rollout",
    recipe=Recipe(
        allocator={**_SHARED_BASELINE, "policy_kwargs": _SMALL, "n_envs": 32, "lr_decay": 0.92},
        router={**_SHARED_BASELINE, "policy_kwargs": _SMALL, "n_envs": 32, "lr_decay": 0.95},
        its={"n_epochs": 24},
        instances_per_epoch={80: 640, 100: 640, 150: 640, 200: 640, 300: 320, 500: 192},
    ),
    timing=Recipe(
        allocator={"n_envs": 32, "baseline_kwargs": {"n_test_instances": 32}},
        router={"n_envs": 32, "baseline_kwargs": {"n_test_instances": 32}},
        its={"n_epochs": 2, "n_pretraining_epochs": 0, "n_intensive_epochs": 0},
        instances_per_epoch=dict.fromkeys(SIZES, 64),
    ),
    n_instances={
        **{80: 50, 100: 50, 150: 30, 200: 20, 300: 10, 500: 10},
        **{600: 4, 700: 4, 800: 4, 900: 4, 1000: 4, 1500: 2},
    },
    n_exact_instances=3,
    exact_sizes=(80, 100, 150),
    exact_backend="highs",
    time_limits={"milp": 60.0, "ortools-gls": 10.0, "pyvrp": 10.0},
    samples=128,
)

_PAPER = Scale(
    name="paper",
    text="the paper's own settings: 100 epochs of 1,280,000 instances for every one of twelve situations; meant for GPUs",
    recipe=Recipe(),
    n_instances=dict.fromkeys((*SIZES, *LARGER_SIZES), 500),
    n_exact_instances=30,
    exact_sizes=SIZES,
    exact_backend="gurobi",
    time_limits={"milp": 1800.0, "ortools-gls": 60.0, "pyvrp": 60.0},
    samples=128,
)

SCALES = {scale.name: scale for scale in (_SMOKE, _CPU, _PAPER)}
