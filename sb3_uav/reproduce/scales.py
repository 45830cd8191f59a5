"""How much of the paper's experiments to run: a smoke test, an afternoon on two cores, or everything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_uav.registration import UNIVERSAL_FLEET, UNIVERSAL_ID, UNIVERSAL_SIZE, allocation_id
from sb3_uav.reproduce.paper import FLEETS, LARGER_SIZES, MAX_DISTANCE, SIZES


@dataclass(frozen=True)
class Scenario:
    """
    One of the paper's situations, or :data:`MIXTURE`.

    :param n_uavs: Number of UAVs
    :param n_tasks: Number of tasks in the paper; a scale may let a smaller number stand in for it
    """

    n_uavs: int
    n_tasks: int

    @property
    def name(self) -> str:
        """Name in the paper."""
        return "mixture" if self == MIXTURE else f"U{self.n_uavs}-{self.n_tasks}"

    @property
    def folder(self) -> str:
        """Name of its folders."""
        return "mixture" if self == MIXTURE else f"U{self.n_uavs}-N{self.n_tasks}"

    @property
    def env_id(self) -> str:
        """Id of the environment of the allocator."""
        return UNIVERSAL_ID if self == MIXTURE else allocation_id(self.n_uavs, self.n_tasks)


# Training batches of mixed sizes and fleets, for one pair that serves all situations.
MIXTURE = Scenario(UNIVERSAL_FLEET, UNIVERSAL_SIZE)


@dataclass(frozen=True)
class Recipe:
    """
    Training settings of pairs: the zoo's YAML entry of the scenario with these changes.

    :param allocator: Changes to the entry itself, i.e., to the allocator's algorithm
    :param router: Changes to the router's algorithm
    :param its: Changes to the interactive training strategy
    :param instances_per_epoch: Instances per epoch by the paper's number of tasks; that of the entry where missing
    :param config: Which of the zoo's YAML files the entry comes from
    :param evaluations: Instances of every situation that the pair solves greedily after each epoch, for Fig. 4 of a training
        for all situations; no evaluations when 0, those of the entry when None
    """

    allocator: Mapping[str, Any] = field(default_factory=dict)
    router: Mapping[str, Any] = field(default_factory=dict)
    its: Mapping[str, Any] = field(default_factory=dict)
    instances_per_epoch: Mapping[int, int] = field(default_factory=dict)
    config: str = "paper"
    evaluations: int | None = None


@dataclass(frozen=True)
class Scale:
    """
    The settings of all tables and figures.

    :param name: Value of ``--scale``
    :param text: Description in one sentence
    :param shrink: The paper's numbers of tasks are divided by this
    :param max_distance: Maximum flight distance
    :param universal: Whether pairs are trained for the mixture of all sizes and fleets, and one serves all situations
    :param trained_sizes: Otherwise the paper's numbers of tasks that pairs are trained for; others are solved by the nearest.
        In any case those that Table I times
    :param recipe: Training settings of these pairs
    :param ablation: Training settings of Fig. 5; those of the other figures when None
    :param n_ablation_seeds: Trainings of each strategy in Fig. 5
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
    ablation: Recipe | None = None
    n_ablation_seeds: int = 1
    universal: bool = False
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
        :return: The scenario whose pair solves it: the mixture, if pairs are universal; itself, if it is trained at this
            scale; else the one of the same fleet whose number of tasks is nearest in proportion
        """
        if self.universal:
            return MIXTURE
        nearest = min(self.trained_sizes, key=lambda size: abs(math.log(size / scenario.n_tasks)))
        return Scenario(scenario.n_uavs, nearest)


def scenarios(sizes: tuple[int, ...] = SIZES) -> list[Scenario]:
    """
    :param sizes: Numbers of tasks
    :return: The paper's situations of these sizes, fleet by fleet
    """
    return [Scenario(n_uavs, n_tasks) for n_uavs in FLEETS for n_tasks in sizes]


_TINY = {"embed_dim": 16, "n_layers": 1, "n_heads": 2, "ff_dim": 16, "use_values": False}


def _tiny_recipe(evaluations: int, **its: Any) -> Recipe:
    """
    :param evaluations: As in :class:`Recipe`
    :param its: Changes to the interactive training strategy
    :return: A training of a second
    """
    settings = {"policy_kwargs": _TINY, "n_envs": 8, "n_samples": 4}
    its |= {"n_epochs": 4, "router_instances_per_epoch": 64, "n_intensive_epochs": 2, "n_continuous_epochs": 2}
    return Recipe({**settings, "instances_per_epoch": 16}, settings, its, config="reinforce", evaluations=evaluations)


def _timing_recipe(n_envs: int, n_instances: int, **settings: Any) -> Recipe:
    """
    :param n_envs: Instances of a batch
    :param n_instances: Instances of an epoch
    :param settings: Further changes to the algorithms of both levels
    :return: Two epochs with the paper's baseline, to be timed
    """
    settings = {"n_envs": n_envs, "baseline_kwargs": {"n_test_instances": n_envs}, **settings}
    its = {"n_epochs": 2, "n_pretraining_epochs": 0, "n_intensive_epochs": 0}
    return Recipe(settings, settings, its, dict.fromkeys(SIZES, n_instances), evaluations=0)


_SMOKE = Scale(
    name="smoke",
    text="a test of the commands, not of the method: tiny networks beside the shipped pair, a tenth of the tasks, a maximum "
    "flight distance of 1",
    shrink=10,
    max_distance=1.0,
    universal=True,
    trained_sizes=(80, 200),
    recipe=_tiny_recipe(4, warm_start={"n_subsets": 32, "n_updates": 2}, n_pretraining_epochs=0),
    # The recipe of cpu has no warm start in Fig. 5 either.
    ablation=_tiny_recipe(0, warm_start=None, n_pretraining_epochs=1),
    n_ablation_seeds=2,
    timing=_timing_recipe(8, 16, policy_kwargs={**_TINY, "preset": "paper"}),
    n_instances=dict.fromkeys((*SIZES, *LARGER_SIZES), 2),
    n_exact_instances=2,
    exact_sizes=(80,),
    exact_backend="highs",
    time_limits={"milp": 1.0, "ortools-gls": 0.2, "pyvrp": 0.2},
    samples=8,
)

_CPU = Scale(
    name="cpu",
    text="an afternoon on two CPU cores with two jobs: the default networks, trained for all situations at once from a warm "
    "start, 24 epochs of 256 instances, eight samples per instance with their mean as baseline; beside them the shipped pair",
    universal=True,
    recipe=Recipe(
        config="reinforce",
        evaluations=8,
        allocator={"lr_decay": 0.9, "instances_per_epoch": 256},
        router={"lr_decay": 0.9},
        its={
            **{"n_epochs": 24, "n_pretraining_epochs": 0, "n_intensive_epochs": 8, "n_continuous_epochs": 4},
            **{"router_instances_per_epoch": 640, "warm_start": {"n_subsets": 12_000, "n_updates": 2_400}},
        },
    ),
    # Without a warm start, which would be a pre-training of another kind in all of them.
    ablation=Recipe(
        config="reinforce",
        evaluations=0,
        allocator={"instances_per_epoch": 192},
        its={
            **{"n_epochs": 16, "n_pretraining_epochs": 5, "n_intensive_epochs": 8, "n_continuous_epochs": 4},
            **{"router_instances_per_epoch": 512, "warm_start": None},
        },
    ),
    n_ablation_seeds=3,
    timing=_timing_recipe(32, 64),
    n_instances={
        **{80: 32, 100: 32, 150: 24, 200: 16, 300: 12, 500: 10},
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
