"""Which keys of a foreign environment's observation hold the nodes, the masks and the context."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim

_MASKS = (spaces.Box, spaces.MultiBinary)


@dataclass(frozen=True)
class ObservationKeys:
    """
    The keys of an observation, and the sizes of what they hold.

    :param node: Key of the node set, ``(n_nodes, n_features)``, or flat, ``(n_nodes * n_features,)``
    :param mask: Key of the action mask, ``(n_actions,)``, 1 where an action is legal
    :param context: Key of the context, of any shape; None without one
    :param padding: Key of the padding mask, ``(n_nodes,)``, 1 for real nodes; None without one
    :param n_nodes: Number of nodes, padded ones included
    :param n_features: Number of features of a node
    :param n_context: Number of features of the context; 0 without one
    :param n_actions: Number of actions
    """

    node: str
    mask: str
    context: str | None
    padding: str | None
    n_nodes: int
    n_features: int
    n_context: int
    n_actions: int

    @property
    def static(self) -> tuple[str, ...]:
        """The keys of what is encoded."""
        return (self.node,) if self.padding is None else (self.node, self.padding)

    @classmethod
    def find(
        cls,
        observation_space: spaces.Space,
        node_key: str,
        mask_key: str,
        context_key: str | None,
        padding_key: str | None,
    ) -> ObservationKeys:
        """
        :param observation_space: Observation space of the environment
        :param node_key: Key of the node set
        :param mask_key: Key of the action mask
        :param context_key: Key of the context; ``"context"``, if there is such a key, when None
        :param padding_key: Key of the padding mask; ``"padding_mask"``, if there is such a key, when None
        :return: The keys that are there
        :raises ValueError: If one is missing, or holds something of another type or shape
        """
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(
                f"The observation space is {observation_space}, but masked attention needs a Dict with a node set and an "
                "action mask: observations such as {'nodes': (n_nodes, n_features), 'action_mask': (n_actions,)}."
            )
        found = observation_space.spaces
        context_key = "context" if context_key is None and "context" in found else context_key
        padding_key = "padding_mask" if padding_key is None and "padding_mask" in found else padding_key
        for argument, key, what in (
            ("node_key", node_key, "the node set, a Box of shape (n_nodes, n_features)"),
            ("mask_key", mask_key, "the action mask, a MultiBinary(n_actions), 1 where an action is legal"),
            ("context_key", context_key, "the context, of any shape"),
            ("padding_key", padding_key, "the padding mask, a MultiBinary(n_nodes), 1 for real nodes"),
        ):
            if key is not None and key not in found:
                raise ValueError(
                    f"The observation has no key {key!r}; its keys are {sorted(found)}. Name the key of {what}: "
                    f"policy_kwargs=dict({argument}=...)."
                )
        n_actions = _mask_size(found[mask_key], mask_key, "mask_key", "(n_actions,)")
        n_padded = None
        if padding_key is not None:
            n_padded = _mask_size(found[padding_key], padding_key, "padding_key", "(n_nodes,)")
        n_nodes, n_features = _node_shape(found[node_key], node_key, n_padded or n_actions)
        if n_padded not in (None, n_nodes):
            raise ValueError(
                f"observation[{padding_key!r}] has {n_padded} entries, but observation[{node_key!r}] {n_nodes} nodes; "
                "give the padding mask one entry for each node, or name another key: policy_kwargs=dict(padding_key=...)."
            )
        ignored = sorted(set(found) - {node_key, mask_key, context_key, padding_key})
        if ignored:
            warnings.warn(
                f"The policy does not look at {ignored} of the observation; put what it should see into the context, and name "
                "that key: policy_kwargs=dict(context_key=...).",
                stacklevel=2,
            )
        n_context = 0 if context_key is None else get_flattened_obs_dim(found[context_key])
        return cls(node_key, mask_key, context_key, padding_key, n_nodes, n_features, n_context, n_actions)


def _mask_size(space: spaces.Space, key: str, argument: str, expected: str) -> int:
    """
    :param space: Space of a mask
    :param key: Its key
    :param argument: The argument that names the key
    :param expected: Its shape in words
    :return: Number of entries
    :raises ValueError: If it is no vector of zeros and ones
    """
    shape = space.shape or ()
    if not isinstance(space, _MASKS) or len(shape) != 1 or shape[0] == 0:
        raise ValueError(
            f"observation[{key!r}] is {space}, expected a mask of shape {expected}, MultiBinary or a Box of zeros and "
            f"ones; change its space, or name another key: policy_kwargs=dict({argument}=...)."
        )
    return shape[0]


def _node_shape(space: spaces.Space, key: str, n_nodes: int) -> tuple[int, int]:
    """
    :param space: Space of the node set
    :param key: Its key
    :param n_nodes: Number of nodes that a flat one has
    :return: Number of nodes, number of features of each
    :raises ValueError: If it is no such set
    """
    shape = space.shape or ()
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        if len(shape) == 2 and min(shape) > 0:
            return shape[0], shape[1]
        if len(shape) == 1 and shape[0] > 0 and shape[0] % n_nodes == 0:
            return n_nodes, shape[0] // n_nodes
    raise ValueError(
        f"observation[{key!r}] is {space}, expected a Box of shape (n_nodes, n_features), or a flat one of {n_nodes} "
        "nodes, as many as the padding mask, or without one the action mask, has entries; reshape it in the environment, or "
        "name another key: policy_kwargs=dict(node_key=...)."
    )
