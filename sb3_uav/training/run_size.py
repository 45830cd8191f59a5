"""How long a run of the interactive training strategy is: its epochs, and the part of the plan that it takes."""

from __future__ import annotations

import warnings
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_uav.common.sb3_compat import total_timesteps
from sb3_uav.reinforce import REINFORCE


def find_epoch_size(allocator: BaseAlgorithm, given: int | None) -> int:
    """
    :param allocator: The allocator's algorithm
    :param given: Instances of an epoch as the callback has them; None to take those of the algorithm
    :return: Instances of an epoch
    :raises ValueError: If neither has them, or they differ
    """
    name = type(allocator).__name__
    own: int | None = getattr(allocator, "instances_per_epoch", None)
    if given is None and own is None:
        raise ValueError(f"{name} has no instances_per_epoch; give it to ITSCallback.")
    if given is not None and own is not None and own != given:
        raise ValueError(f"instances_per_epoch is {given} in ITSCallback and {own} in {name}; give it once, to the algorithm.")
    size = own if given is None else given
    assert size is not None
    return size


def warn_of_large_batches(allocator: BaseAlgorithm, epoch_size: int, n_tasks: int) -> None:
    """
    Warn if an update learns from more instances than an epoch has.

    :param allocator: The allocator's algorithm
    :param epoch_size: Instances of an epoch
    :param n_tasks: Tasks of an instance
    """
    n_envs = allocator.n_envs
    is_reinforce = isinstance(allocator, REINFORCE)
    batch = n_envs if is_reinforce else n_envs * getattr(allocator, "n_steps", 0) // n_tasks
    if batch > epoch_size:
        warnings.warn(
            f"An update learns from {batch} instances, an epoch has {epoch_size}: several epochs will end "
            f"at once, each followed by its router epochs. Lower n_envs{'' if is_reinforce else ' or n_steps'}, or raise "
            "instances_per_epoch, so that an epoch has at least one update.",
            stacklevel=3,
        )


def warn_of_complete_run(folder: Path, epoch: int, n_epochs: int) -> None:
    """
    Warn if a run is resumed that has nothing left to learn.

    :param folder: Its checkpoint
    :param epoch: Epochs of the allocator that it has
    :param n_epochs: Planned ones
    """
    if epoch >= n_epochs:
        warnings.warn(
            f"{folder}: this run already has {epoch} of {n_epochs} epochs, so nothing is left to learn. Raise n_epochs to go "
            "on with it, or start a new run with its weights (sb3_uav.reinforce.transfer.load).",
            stacklevel=3,
        )


def share_of_plan(allocator: BaseAlgorithm, n_epochs: int, epoch_size: int, n_tasks: int, since: int = 0) -> float:
    """
    The part of the planned steps that a run takes, with a warning that says what is cut if it is not all of them.

    :param allocator: The allocator's algorithm, in ``learn``
    :param n_epochs: Planned epochs of the allocator
    :param epoch_size: Instances of an epoch
    :param n_tasks: Tasks of an instance, which are the steps of an episode
    :param since: Steps before the run
    :return: Above 0, at most 1
    """
    n_samples = allocator.n_samples if isinstance(allocator, REINFORCE) else 1
    planned = n_epochs * epoch_size * n_samples * n_tasks
    given = total_timesteps(allocator) - since
    if given >= planned:
        return 1.0
    share = max(given, 1) / planned
    warnings.warn(
        f"This run has {given:,} of the {planned:,} steps that {n_epochs} epochs take: the warm start and the pre-training of "
        f"the router are cut to {share:.2g} of their length, and the run stops after these steps. For a complete strategy in "
        "fewer steps, lower n_epochs or instances_per_epoch.",
        stacklevel=3,
    )
    return share
