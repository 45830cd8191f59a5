"""The schedule of epochs of the interactive training strategy (paper, section IV-C, Algorithm 1 and Fig. 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

ITS, NO_PRETRAINING, NO_INTENSIVE, ALTERNATE_ONLY, INDEPENDENT = _STRATEGIES = (
    "its",
    "no-pretraining",
    "no-intensive",
    "alternate-only",
    "independent",
)
# The paper's names (Fig. 5), in which a slash means "without".
PAPER_STRATEGIES = {
    "ITS": ITS,
    "ITS/pre-training": NO_PRETRAINING,
    "ITS/intensive": NO_INTENSIVE,
    "ITS/pre-training&intensive": ALTERNATE_ONLY,
    "DL-DRL-I": INDEPENDENT,
}

PRETRAINING, _INTENSIVE, ALTERNATE = "pre-training", "intensive", "alternate"


def strategy_name(strategy: str) -> str:
    """
    :param strategy: One of :data:`_STRATEGIES`, or its name in the paper
    :return: The former
    :raises ValueError: If there is no such strategy
    """
    name = PAPER_STRATEGIES.get(strategy, strategy) if isinstance(strategy, str) else None
    if name not in _STRATEGIES:
        paper = ", ".join(PAPER_STRATEGIES)
        raise ValueError(
            f"strategy is {strategy!r}; choose one of {', '.join(_STRATEGIES)} (in the paper's words, in this order: {paper})."
        )
    return name


@dataclass(frozen=True)
class EpochSchedule:
    """
    How many epochs the router learns before the allocator's first epoch, and after each of them.

    :param n_epochs: Allocator epochs (the paper's E)
    :param n_pretraining_epochs: Router epochs of pre-training (E_p)
    :param n_intensive_epochs: Allocator epochs of intensive training (E_t)
    :param n_continuous_epochs: Epochs in a row in intensive training (E_c)
    :param is_independent: Whether the router is only pre-trained
    """

    n_epochs: int
    n_pretraining_epochs: int
    n_intensive_epochs: int
    n_continuous_epochs: int
    is_independent: bool = False

    @classmethod
    def of(cls, strategy: str, n_epochs: int, n_pretraining: int, n_intensive: int, n_continuous: int) -> EpochSchedule:
        """
        :param strategy: One of :data:`_STRATEGIES`, or its name in the paper
        :param n_epochs: Allocator epochs
        :param n_pretraining: Router epochs of pre-training, if the strategy has it
        :param n_intensive: Allocator epochs of intensive training, if the strategy has it
        :param n_continuous: Epochs in a row in intensive training
        :return: The schedule
        :raises ValueError: If there is no such strategy
        """
        strategy = strategy_name(strategy)
        if strategy == INDEPENDENT:
            # Both models of DL-DRL-I are trained as long as those of DL-DRL.
            whole = cls.of(ITS, n_epochs, n_pretraining, n_intensive, n_continuous)
            return replace(whole, n_pretraining_epochs=whole.n_router_epochs, is_independent=True)
        return cls(
            n_epochs,
            0 if strategy in (NO_PRETRAINING, ALTERNATE_ONLY) else n_pretraining,
            0 if strategy in (NO_INTENSIVE, ALTERNATE_ONLY) else n_intensive,
            n_continuous,
        )

    @property
    def n_router_epochs(self) -> int:
        """Epochs of the router in all: before the allocator's first epoch, and after each of them."""
        later = sum(self.router_epochs_after(epoch) for epoch in range(1, self.n_epochs + 1))
        return self.n_pretraining_epochs + later

    def pretraining_of(self, share: float, epoch_size: int) -> tuple[int, int]:
        """
        Pre-training of a run that takes only a part of the planned steps.

        :param share: That part, above 0 and at most 1
        :param epoch_size: Instances of a router epoch
        :return: Number of epochs, instances of each
        """
        n_epochs = math.ceil(share * self.n_pretraining_epochs)
        if share == 1 or n_epochs == 0:
            return n_epochs, epoch_size
        return n_epochs, math.ceil(share * self.n_pretraining_epochs * epoch_size / n_epochs)

    def phase(self, epoch: int) -> str:
        """
        :param epoch: Number of an allocator epoch, from 1
        :return: The phase that it belongs to
        """
        return _INTENSIVE if epoch <= self.n_intensive_epochs else ALTERNATE

    def router_epochs_after(self, epoch: int) -> int:
        """
        :param epoch: Number of an allocator epoch, from 1
        :return: How many epochs the router learns after it
        """
        if self.is_independent:
            return 0
        if self.phase(epoch) == ALTERNATE:
            return 1
        return self.n_continuous_epochs if epoch % self.n_continuous_epochs == 0 else 0
