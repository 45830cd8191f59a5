"""The learned methods of the tables, and which pair stands for each of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sb3_uav.reproduce.pairs import SHIPPED, UNTRAINED, Model, Models
from sb3_uav.reproduce.scales import Scenario
from sb3_uav.training.its_schedule import INDEPENDENT, ITS

DL_DRL, DL_DRL_I = "DL-DRL", "DL-DRL-I"
# Beside the shipped pair: the pair of this command, which is trained as long as DL-DRL-I.
DL_DRL_SHORT = "DL-DRL short"
UNTRAINED_PAIR = "Untrained"
METHOD_NAMES = {SHIPPED: DL_DRL, ITS: DL_DRL, INDEPENDENT: DL_DRL_I, UNTRAINED: UNTRAINED_PAIR}
# Those that the paper does not have.
_OTHERS = (DL_DRL_SHORT, UNTRAINED_PAIR)
_DECODINGS = {False: "Greedy", True: "Sampling"}


def learned_methods(models: Models) -> dict[str, str]:
    """
    :param models: The trained pairs
    :return: The training strategy of each method, or what
        :class:`~sb3_uav.reproduce.pairs.Model` has in its place, in the order of the tables
    """
    if models.uses_shipped_pair:
        return {DL_DRL_I: INDEPENDENT, DL_DRL: SHIPPED, DL_DRL_SHORT: ITS, UNTRAINED_PAIR: UNTRAINED}
    return {DL_DRL_I: INDEPENDENT, DL_DRL: ITS, UNTRAINED_PAIR: UNTRAINED}


def fair_method(methods: Collection[str]) -> str:
    """
    :param methods: Names of methods
    :return: The one to compare DL-DRL-I with: that of the same recipe and length of training
    """
    return DL_DRL_SHORT if DL_DRL_SHORT in methods else DL_DRL


def other_methods(models: Models) -> list[str]:
    """
    :param models: The trained pairs
    :return: Learned methods that the paper does not have
    """
    return [method for method in learned_methods(models) if method in _OTHERS]


def column(method: str, sampling: bool) -> str:
    """
    :param method: A learned method
    :param sampling: Whether it samples
    :return: Its column in Tables II and III
    """
    return f"{method} ({_DECODINGS[sampling]})"


def other_columns(models: Models) -> list[str]:
    """
    :param models: The trained pairs
    :return: Further columns of Tables II and III
    """
    return [column(method, sampling) for method in other_methods(models) for sampling in _DECODINGS]


def explanations(models: Models) -> list[str]:
    """
    :param models: The trained pairs
    :return: Notes on what the learned methods are
    """
    notes = [f"{UNTRAINED_PAIR}: random parameters (seed {models.seed}) and the heuristics that the networks begin with."]
    if not models.scale.universal:
        return notes
    independent = (
        f"{DL_DRL_I}: router and allocator trained apart, on all sizes and fleets at once; the router begins with the same "
        "warm start, and learns on whole instances."
    )
    if not models.uses_shipped_pair:
        return [*notes, f"One pair serves all sizes and fleets. {independent}"]
    return [
        *notes,
        f"{DL_DRL}: the pair that comes with the package, one for all sizes and fleets, trained for longer than the others.",
        f"{DL_DRL_SHORT}: trained by this command with the recipe, epochs and instances of {DL_DRL_I}; compare these two.",
        independent,
    ]


def learned_pairs(models: Models, wanted: Sequence[Scenario], *methods: str) -> dict[tuple[Scenario, str], Model]:
    """
    :param models: The trained pairs, which finds or trains them
    :param wanted: The scenarios to solve
    :param methods: Learned methods; all when there are none
    :return: The pairs by scenario and method; without those that are missing and may not be trained
    """
    kinds = {method: kind for method, kind in learned_methods(models).items() if not methods or method in methods}
    found = models.serving(wanted, kinds.values())
    keys = [(scenario, method) for method in kinds for scenario in wanted]
    return {(s, method): found[s, kinds[method]] for s, method in keys if (s, kinds[method]) in found}
