"""An instance in many views, encoded no more often than necessary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch as th

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.symmetries import reflect
from sb3_uav.policies import AllocatorPolicy
from sb3_uav.policies.extractor import Cache


class View(NamedTuple):
    """
    A way to look at an instance.

    :param symmetry: Symmetry of the square, 0 for none
    :param sweep: Where the sweep starts and in which direction, as of the allocator's ``task_order``
    """

    symmetry: int
    sweep: int


class Shown(NamedTuple):
    """
    An instance in several views.

    :param instances: ``n_views`` instances, tasks in the allocator's order
    :param order: ``(n_views, n_tasks)`` int64, which task stands in each place
    :param cache: Their encodings
    :param symmetry: ``(n_views,)`` int64
    :param reflected: The same instances, tasks in the order of the input
    """

    instances: Instances
    order: th.Tensor
    cache: Cache
    symmetry: th.Tensor
    reflected: Instances


class SeenInstance:
    """
    One instance, and its encodings so far. The order of the tasks means nothing to an encoder, so that every symmetry is
    encoded once for all sweeps.

    :param allocator: The allocator
    :param instance: A batch of one on the allocator's device
    """

    def __init__(self, allocator: AllocatorPolicy, instance: Instances) -> None:
        self.allocator = allocator
        self.instance = instance
        self._nodes: dict[int, th.Tensor] = {}

    def show(self, views: Sequence[View]) -> Shown:
        """
        :param views: Some views
        :return: The instance in these
        """
        reflected = [reflect(self.instance, view.symmetry) for view in views]
        missing = {
            view.symmetry: seen for view, seen in zip(views, reflected, strict=True) if view.symmetry not in self._nodes
        }
        if missing:
            nodes = self.allocator.encode_nodes(Instances.concatenate(list(missing.values())))
            self._nodes.update(zip(missing, nodes.split(1), strict=True))
        order = th.cat([self.allocator.task_order(seen, view.sweep) for view, seen in zip(views, reflected, strict=True)])
        together = Instances.concatenate(reflected)
        arranged = together.reorder(order)
        nodes = th.cat([self._nodes[view.symmetry] for view in views])
        symmetry = th.tensor([view.symmetry for view in views], device=order.device)
        return Shown(arranged, order, self.allocator.arranged_cache(nodes, order, arranged), symmetry, together)
