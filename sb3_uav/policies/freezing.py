"""Freezing a network while another one learns."""

from __future__ import annotations

from torch import nn


class Freezer:
    """
    Freezes a module: no gradients, and evaluation mode, so that buffers such as batch statistics stay too.

    :param module: The module
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        self._learning: list[nn.Parameter] = []

    def freeze(self) -> None:
        """Freeze; freezing twice changes nothing."""
        self._learning += [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        self.module.requires_grad_(False)
        self.module.eval()

    def thaw(self) -> None:
        """Let those parameters learn again that did before :meth:`freeze`. The algorithm sets the mode itself."""
        for parameter in self._learning:
            parameter.requires_grad_(True)
        self._learning = []
