"""Which epochs the interactive training strategy has (paper, section IV-C, Algorithm 1 and Fig. 5)."""

from __future__ import annotations

from dataclasses import dataclass

# The paper's names (Fig. 5); "independent" is DL-DRL-I.
STRATEGIES = ("ITS", "ITS/pre-training", "ITS/intensive", "ITS/pre-training&intensive", "independent")

PRETRAINING, INTENSIVE, ALTERNATE = "pre-training", "intensive", "alternate"


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
    is_independent: bool

    @classmethod
    def of(cls, strategy: str, n_epochs: int, n_pretraining: int, n_intensive: int, n_continuous: int) -> EpochSchedule:
        """
        :param strategy: One of :data:`STRATEGIES`
        :param n_epochs: Allocator epochs
        :param n_pretraining: Router epochs of pre-training, if the strategy has it
        :param n_intensive: Allocator epochs of intensive training, if the strategy has it
        :param n_continuous: Epochs in a row in intensive training
        :return: The schedule
        :raises ValueError: If there is no such strategy
        """
        if strategy not in STRATEGIES:
            raise ValueError(f"strategy is {strategy!r}; choose one of {STRATEGIES}.")
        return cls(
            n_epochs,
            0 if strategy.startswith("ITS/pre-training") else n_pretraining,
            0 if strategy.endswith("intensive") else n_intensive,
            n_continuous,
            strategy == "independent",
        )

    def phase(self, epoch: int) -> str:
        """
        :param epoch: Number of an allocator epoch, from 1
        :return: The phase that it belongs to
        """
        return INTENSIVE if epoch <= self.n_intensive_epochs else ALTERNATE

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
