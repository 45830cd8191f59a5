"""The settings of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

_N_EVALUATIONS = 20


@dataclass
class Settings:
    """
    :param env: Id of the environment
    :param out: Folder of everything that is written
    :param n_timesteps: Environment steps of each run
    :param seeds: Seeds of the runs, the same for every variant
    :param variants: YAML of what is compared; the default variants when None
    :param router: Zip of the router that gives all rewards; one is trained when None
    :param router_subsets: Number of subsets that this router is trained on
    :param its: Whether each run trains its own router instead
    :param instances: Validation set; one is drawn when None
    :param n_instances: Size of a drawn validation set
    :param samples: Samples per instance at each evaluation
    :param eval_freq: Environment steps between evaluations; a 20th of the budget when None
    :param jobs: Number of trainings side by side
    :param num_threads: Threads of each training
    :param device: Device of the trainings
    :raises ValueError: If a value is not allowed; the message names the option
    """

    env: str
    out: Path
    n_timesteps: int = 1_000_000
    seeds: Sequence[int] = field(default_factory=lambda: [0, 1, 2])
    variants: Path | None = None
    router: Path | None = None
    router_subsets: int = 100_000
    its: bool = False
    instances: Path | None = None
    n_instances: int = 256
    samples: int = 16
    eval_freq: int | None = None
    jobs: int = 1
    num_threads: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.eval_freq is None:
            self.eval_freq = max(self.n_timesteps // _N_EVALUATIONS, 1)
        least = dict(n_timesteps=1, n_instances=1, samples=0, router_subsets=1, jobs=1, num_threads=1, eval_freq=1)
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least {bound}.")
        if len(set(self.seeds)) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"--seeds are {self.seeds}; give different numbers of at least 0.")
