"""Training the router before anything else: by imitation, or by a function of the user."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_uav.common import distributed
from sb3_uav.common.imports import import_object

_IMITATION_PATH = "sb3_uav.training.imitation.imitate"
# The end of that path in every version; YAML files of 0.1.0 name another package.
_IMITATION_SUFFIX = ".imitation.imitate"


class WarmStart:
    """
    A call of a function with the policies of router and allocator, the generator of the instances and a random generator.

    :param given: Arguments of :func:`~sb3_uav.training.imitation.imitate`, or ``{dotted path: arguments}`` of another function
    :raises ValueError: If it is neither
    """

    def __init__(self, given: dict[str, Any]) -> None:
        if not isinstance(given, dict) or not given:
            raise ValueError(
                "warm_start must hold arguments of sb3_uav.training.imitation.imitate, such as n_updates, or map the dotted "
                f"path of one function to its arguments, found {given!r:.80}."
            )
        paths = [key for key in given if "." in str(key)]
        if len(paths) > 1 or (paths and len(given) > 1):
            raise ValueError(f"warm_start must map the dotted path of one function to its arguments, found {given!r:.80}.")
        self.path: str = paths[0] if paths else _IMITATION_PATH
        arguments = given[self.path] if paths else given
        if self.path.startswith("sb3_uav.") and self.path.endswith(_IMITATION_SUFFIX):
            self.path = _IMITATION_PATH
        if arguments is not None and not isinstance(arguments, dict):
            raise ValueError(f"warm_start: the arguments of {self.path} must be a mapping, found {arguments!r:.80}.")
        self.arguments: dict[str, Any] = dict(arguments or {})

    def bind(self, positional: tuple[Any, ...], offered: dict[str, Any]) -> Callable[[], None]:
        """
        :param positional: Positional arguments of the function, the router's policy first
        :param offered: Arguments passed if the function has parameters of these names
        :return: A function that makes the call
        :raises ValueError: If there is no such function, or the arguments do not fit
        """
        try:
            function = import_object(self.path)
        except ValueError as error:
            raise ValueError(
                f"warm_start is {self.path!r}, which cannot be imported ({error}); give its dotted path."
            ) from error
        try:
            signature = inspect.signature(function)
            known = {name: value for name, value in offered.items() if name in signature.parameters}
            call = signature.bind(*positional, **{**known, **self.arguments})
        except TypeError as error:
            raise ValueError(f"warm_start: these arguments do not fit {self.path}: {error}") from error

        def start() -> None:
            function(*call.args, **call.kwargs)
            # A function of the user may know nothing of other processes.
            distributed.share_tensors(positional[0].state_dict().values() if distributed.world_size() > 1 else ())

        return start


def bring_progress(folder: Path, earlier: Path | None) -> None:
    """
    Replace any progress in the folder by that of the checkpoint from which this run resumes.

    :param folder: Folder of the warm start's progress
    :param earlier: The same folder of the checkpoint; None if there is no checkpoint
    """
    is_there = earlier is not None and earlier.resolve() == folder.resolve()
    if distributed.is_main() and not is_there:
        if folder.is_dir():
            shutil.rmtree(folder)
        if earlier is not None and earlier.is_dir():
            shutil.copytree(earlier, folder)
    distributed.barrier()
