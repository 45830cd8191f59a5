"""
Policies for ``th.jit.trace``, ``th.export`` and ``th.onnx``: plain tensors in, greedy actions or logits out.

As in SB3's guide to exporting models, but with one input per key of the observation::

    exportable = ExportablePolicy(model.policy)
    th.onnx.export(
        exportable,
        exportable.example_inputs(2),
        "policy.onnx",
        input_names=exportable.input_names,
        output_names=["action"],
        dynamic_shapes=exportable.dynamic_shapes,
        dynamo=True,
    )

The default exporter of ``th.onnx`` needs ``pip install onnxscript``. Every call of the exported network encodes its instances;
encodings kept from earlier calls never become part of it. The number of tasks is that of the observation space; smaller
instances are padded with ``task_mask``, as in the environments. Masks without a legal action are not noticed there.
"""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_uav.policies.masked_policy import MaskedPolicy

_OUTPUTS = ("action", "logits")


class ExportablePolicy(nn.Module):
    """
    A policy as a module with tensors as inputs, in evaluation mode and on the CPU or wherever the policy is.

    :param policy: Any of our policies; it is used, not copied
    :param output: ``"action"`` for the greedy action ``(batch,)`` int64, or ``"logits"`` for the masked logits
        ``(batch, n_actions)``, -inf where an action is illegal
    :raises ValueError: If there is no such output
    """

    def __init__(self, policy: MaskedPolicy, output: str = "action") -> None:
        super().__init__()
        if output not in _OUTPUTS:
            raise ValueError(f"output is {output!r}; choose one of {_OUTPUTS}.")
        self.policy = policy
        self.output = output
        assert isinstance(policy.observation_space, spaces.Dict)
        self._spaces: dict[str, spaces.Space] = dict(policy.observation_space.spaces)
        self.eval()

    @property
    def input_names(self) -> list[str]:
        """The keys of the observation, in the order of the inputs."""
        return list(self._spaces)

    @property
    def dynamic_shapes(self) -> Any:
        """What ``th.export`` and ``th.onnx`` take, so that the batch may have any size."""
        batch = th.export.Dim("batch")
        return (tuple({0: batch} for _ in self._spaces),)

    def example_inputs(self, batch_size: int = 2) -> tuple[th.Tensor, ...]:
        """
        :param batch_size: Number of rows; exporters may take a batch of 1 for a constant
        :return: Inputs in the dtypes of the observation space
        """
        inputs = []
        for space in self._spaces.values():
            shape, dtype = (batch_size, *(space.shape or ())), th.as_tensor(space.sample()).dtype
            inputs.append(th.ones(shape, dtype=dtype, device=self.policy.device))
        return tuple(inputs)

    def forward(self, *observation: th.Tensor) -> th.Tensor:
        """
        :param observation: A tensor ``(batch, ...)`` for each of :attr:`input_names`
        :return: Actions or logits
        """
        logits = self.policy.masked_logits(dict(zip(self._spaces, observation, strict=True)))
        return logits if self.output == "logits" else logits.argmax(-1)
