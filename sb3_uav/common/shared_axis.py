"""One x-axis for the logs of algorithms that learn in turn."""

from __future__ import annotations

from collections.abc import Callable

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from sb3_uav.common.sb3_compat import replace_logger

# An attribute of the algorithm that the run belongs to, so that every zip of it says where its axis continues.
_STEPS = "shared_axis_steps"


class SharedAxis:
    """
    Counts the steps that several algorithms of a run have learned from, all together.

    SB3 logs every algorithm at its own ``num_timesteps``. If they learn in turn, one waits at a step of its axis while the
    other moves on. Here all of them are logged at the sum, which grows whoever learns.

    :ivar extra: Steps that were learned from outside of these algorithms since the axis began
    """

    def __init__(self) -> None:
        self.extra = 0
        self._start = 0
        self._counts: list[tuple[Callable[[], int], int]] = []
        self._owner: BaseAlgorithm

    def begin(self, owner: BaseAlgorithm) -> None:
        """
        Begin the axis of a training, where the training that the algorithm has behind it ended.

        :param owner: An algorithm that has set up its logger; its zips keep the length of the axis
        """
        self.extra = 0
        self._start = getattr(owner, _STEPS, owner.num_timesteps)
        self._counts = []
        self._owner = owner
        self.join(lambda: owner)

    def join(self, algorithm: Callable[[], BaseAlgorithm]) -> None:
        """
        Let an algorithm log on this axis from now on.

        :param algorithm: Returns the algorithm, which may be replaced by one that has its logger and its ``num_timesteps``
        """

        def count() -> int:
            return algorithm().num_timesteps

        self._counts.append((count, count()))
        logger = algorithm().logger
        replace_logger(algorithm(), _AxisLogger(getattr(logger, "replaced", logger), self, count))

    @property
    def total(self) -> int:
        """The present length of the axis."""
        return self._start + self.extra + sum(count() - start for count, start in self._counts)

    def note(self) -> None:
        """Store the length in the owner, before it is saved."""
        setattr(self._owner, _STEPS, self.total)


class _AxisLogger(Logger):
    """
    Writes to the outputs of another logger, at the steps of a shared axis.

    :param replaced: The other logger, whose values that are still to be written it takes over
    :param axis: The axis
    :param count: Returns the steps of the algorithm that logs here
    """

    def __init__(self, replaced: Logger, axis: SharedAxis, count: Callable[[], int]) -> None:
        super().__init__(replaced.dir, replaced.output_formats)
        self.replaced = replaced
        self.axis = axis
        self.count = count
        self.level = replaced.level
        self.name_to_value = replaced.name_to_value
        self.name_to_count = replaced.name_to_count
        self.name_to_excluded = replaced.name_to_excluded

    def dump(self, step: int = 0) -> None:
        """:param step: A step of the algorithm's own axis"""
        super().dump(self.axis.total + step - self.count())
