"""Reading a policy back from an SB3 zip without executing anything that the file contains."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_uav.common.checked_zip import MIB, CheckedZip, ZipDamageError
from sb3_uav.common.json_text import read_plain_json
from sb3_uav.common.tensor_file import MAX_TENSOR_BYTES, read_tensor_file
from sb3_uav.policies.allocator import AllocatorPolicy
from sb3_uav.policies.base import EpisodicPolicy
from sb3_uav.policies.router import RouterPolicy
from sb3_uav.policies.stored_shapes import check_settings, check_shapes

PolicyT = TypeVar("PolicyT", bound=EpisodicPolicy)

# A parameter that only one of the policies has.
_SIGNATURES: dict[str, type[EpisodicPolicy]] = {
    "features_extractor.project_context.weight": AllocatorPolicy,
    "features_extractor.scorer.project_uav.weight": AllocatorPolicy,
    "features_extractor.project_graph.weight": RouterPolicy,
}
# Stock A2C adds its optimizer class, which JSON cannot hold, to policy_kwargs; acting needs no optimizer.
_IGNORED_KWARGS = {":type:", ":serialized:", "optimizer_class", "optimizer_kwargs"}
# Largest size of the JSON: pickles of the last observations of 512 environments take 4 MB in it.
MAX_DATA = 16 * MIB
_MAX_MEMBERS, _MAX_TOTAL = 100, 512 * MIB


class NotOurPolicyError(ValueError):
    """An intact SB3 zip whose policy is not one of ours, or cannot be rebuilt without unpickling."""


@dataclass(frozen=True)
class StoredPolicy:
    """
    What an SB3 zip says of one of our policies, read without unpickling.

    :param file: The zip
    :param policy_class: ``AllocatorPolicy`` or ``RouterPolicy``
    :param parameters: Its state dict, on the CPU, all numbers finite
    :param attributes: The attributes of the algorithm as the JSON of the zip holds them
    """

    file: Path
    policy_class: type[EpisodicPolicy]
    parameters: dict[str, th.Tensor]
    attributes: dict[str, Any]

    @property
    def policy_kwargs(self) -> dict[str, Any]:
        """
        What it was built with, apart from its optimizer.

        :raises NotOurPolicyError: If some of it is stored as a pickle
        """
        return _plain_policy_kwargs(self.attributes, self.file)

    def build(
        self, observation_space: spaces.Space, action_space: spaces.Space, device: th.device | str = "cpu"
    ) -> EpisodicPolicy:
        """
        :param observation_space: Observation space of an environment of the policy's level, of any size
        :param action_space: Its action space
        :param device: Device of the policy
        :return: The policy for the step loop of that environment, in evaluation mode
        """
        policy = self.policy_class(observation_space, action_space, lambda _: 0.0, **self.policy_kwargs)
        policy.load_state_dict(self.parameters)
        policy.set_training_mode(False)
        return policy.to(device)

    @property
    def n_uavs(self) -> int | None:
        """The only fleet size that the network serves; None if it serves any."""
        bound = "features_extractor.project_context.weight" in self.parameters
        return len(self.parameters["action_net.weight"]) if bound and "action_net.weight" in self.parameters else None


@overload
def load_policy(path: str | os.PathLike[str], device: th.device | str = "auto", expected: None = None) -> EpisodicPolicy: ...
@overload
def load_policy(path: str | os.PathLike[str], device: th.device | str, expected: type[PolicyT]) -> PolicyT: ...
@overload
def load_policy(path: str | os.PathLike[str], device: th.device | str = "auto", *, expected: type[PolicyT]) -> PolicyT: ...


def load_policy(
    path: str | os.PathLike[str], device: th.device | str = "auto", expected: type[EpisodicPolicy] | None = None
) -> EpisodicPolicy:
    """
    Load the allocator or the router from the zip of any SB3 algorithm (REINFORCE, PPO, A2C, MaskablePPO).

    Unlike the algorithm's own ``load``, this unpickles nothing, so that a zip from a stranger is safe to open: it reads the
    plain JSON of the zip and its tensors, see :mod:`sb3_uav.common.tensor_file`.

    :param path: The zip; ``.zip`` is appended if there is no such file, as SB3 does
    :param device: Device on which the policy should run
    :param expected: The class that the policy must have; any of ours when None
    :return: The policy, in evaluation mode
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If the file is damaged, is not the zip of one of our policies or of another one than expected, or
        holds numbers that are not finite; the message names the file and the remedy
    """
    stored = read_policy(path, expected)
    policy_kwargs = stored.policy_kwargs
    try:
        policy = stored.policy_class.from_parameters(stored.parameters, policy_kwargs, "cpu")
    except (ValueError, TypeError, AssertionError, RuntimeError) as error:
        raise misfit(stored, policy_kwargs, error) from error
    try:
        return policy.to(get_device(device))
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {str(device)!r}, which cannot be used ({reason}); try 'cpu' or 'auto'.") from error


def read_policy(path: str | os.PathLike[str], expected: type[EpisodicPolicy] | None = None) -> StoredPolicy:
    """
    Read what :func:`load_policy` builds a policy from.

    :param path: As of :func:`load_policy`
    :param expected: As of :func:`load_policy`
    :return: The stored policy
    :raises FileNotFoundError: If there is no such file
    :raises NotOurPolicyError: If an intact zip holds another kind of policy
    :raises ValueError: As :func:`load_policy`
    """
    file = _existing_file(Path(path))
    data, parameters = _read_zip(file)
    policy_class = next((cls for key, cls in _SIGNATURES.items() if key in parameters), None)
    if "features_extractor.encoder.embed_node.weight" in parameters:
        raise NotOurPolicyError(
            f"{file}: holds a MaskedAttentionPolicy, whose spaces are stored as a pickle, which is not executed here; if you "
            "trust the file, load it with the algorithm's own load() and use model.policy."
        )
    if policy_class is None:
        raise NotOurPolicyError(
            f"{file}: holds the policy of another kind (its first parameter is {next(iter(parameters), 'missing')!r}); "
            "give a zip that was trained with AllocatorPolicy or RouterPolicy."
        )
    if expected is not None and not issubclass(policy_class, expected):
        raise ValueError(
            f"{file}: holds the policy of class {policy_class.__name__}, but {expected.__name__} is needed here; "
            "have the allocator's and the router's zip been exchanged?"
        )
    _check_stock_code(data, file)
    stored = StoredPolicy(file, policy_class, parameters, data)
    try:
        _check_fit(stored, stored.policy_kwargs)
    except NotOurPolicyError:
        # Its arguments cannot be had without a pickle, so that nobody can build it from here either.
        pass
    for name, parameter in parameters.items():
        if not th.isfinite(parameter).all():
            found = parameter[~th.isfinite(parameter)].flatten()[0].item()
            raise ValueError(f"{file}: parameter '{name}' holds {found}; the training diverged, use an earlier checkpoint.")
    return stored


def _check_fit(stored: StoredPolicy, policy_kwargs: dict[str, Any]) -> None:
    """
    :param stored: A stored policy
    :param policy_kwargs: Its arguments
    :raises ValueError: If they do not fit its parameters; nothing of the size that they claim is allocated
    """
    try:
        check_settings(policy_kwargs, len(stored.parameters))
        check_shapes(stored.policy_class, policy_kwargs, stored.parameters)
    except (ValueError, TypeError, AssertionError, RuntimeError, OverflowError, LookupError, AttributeError) as error:
        raise misfit(stored, policy_kwargs, error) from error


def misfit(stored: StoredPolicy, policy_kwargs: dict[str, Any], error: Exception) -> ValueError:
    """
    :param stored: A stored policy
    :param policy_kwargs: The arguments that it was built with now
    :param error: What went wrong then
    :return: The error to raise
    """
    reason = " ".join(str(error).split())
    return ValueError(
        f"{stored.file}: parameters and policy_kwargs {policy_kwargs!s:.500} do not fit together ({reason:.300}); "
        "the zip was edited, or was written by another version of sb3_uav."
    )


def _existing_file(path: Path) -> Path:
    """
    :param path: Path with or without ``.zip``
    :return: The existing file
    :raises FileNotFoundError: If there is none
    """
    for candidate in (path, path.with_name(path.name + ".zip")):
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"{path}: no such file; give the path of a zip that was saved by an SB3 algorithm.")


def _read_zip(file: Path) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    :param file: An SB3 zip
    :return: The attributes of the algorithm as its JSON holds them, and the state dict of its policy on the CPU
    :raises ValueError: If the file is not one
    """
    text, tensors = read_members(file, {"data": MAX_DATA, "policy.pth": MAX_TENSOR_BYTES}).values()
    try:
        data = read_plain_json(text)
    except ValueError as error:
        raise ValueError(f"{file}: 'data' in it cannot be read safely ({error!s:.200}); save it again.") from error
    parameters = read_state(file, "policy.pth", tensors)
    whole = isinstance(parameters, dict) and all(
        isinstance(name, str) and isinstance(value, th.Tensor) for name, value in parameters.items()
    )
    if not whole or not isinstance(data, dict):
        raise ValueError(f"{file}: 'policy.pth' must hold named tensors and 'data' an object; save it again with SB3.")
    return data, parameters


def read_members(file: Path, wanted: dict[str, int], optional: frozenset[str] = frozenset()) -> dict[str, bytes]:
    """
    :param file: An SB3 zip
    :param wanted: Names of members, with the largest size of each
    :param optional: Those that may be missing
    :return: Their contents by name
    :raises ValueError: If the file is not one, or not harmless
    """
    try:
        with CheckedZip(file, _MAX_MEMBERS, _MAX_TOTAL) as archive:
            missing = wanted.keys() - optional - archive.members.keys()
            if missing:
                raise ValueError(
                    f"{file}: is not the zip of an SB3 algorithm ({sorted(missing)} missing in it); "
                    "give a zip that was written by model.save()."
                )
            return {name: archive.read(name, most) for name, most in wanted.items() if name in archive.members}
    except (ZipDamageError, OSError) as error:
        raise ValueError(
            f"{file}: is not an intact zip ({error}); it is damaged or incomplete, save or copy it again."
        ) from error


def read_state(file: Path, member: str, content: bytes) -> Any:
    """
    :param file: An SB3 zip, named in errors
    :param member: Name of a member that ``th.save`` has written
    :param content: Its content
    :return: Plain data and dense tensors
    :raises ValueError: If it holds something else
    """
    try:
        return read_tensor_file(content)
    except ValueError as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{file}: '{member}' in it cannot be read safely ({reason:.300}); save it again.") from error


def _plain_policy_kwargs(data: dict[str, Any], file: Path) -> dict[str, Any]:
    """
    :param data: The JSON of an SB3 zip
    :param file: The zip, named in errors
    :return: ``policy_kwargs`` without those for the optimizer
    :raises ValueError: If some of them are not plain data and are therefore stored as a pickle
    """
    stored = data.get("policy_kwargs", {})
    if not isinstance(stored, dict):
        raise ValueError(f"{file}: 'policy_kwargs' is {stored!r:.80}, expected a dictionary; save it again with SB3.")
    policy_kwargs = {key: value for key, value in stored.items() if key not in _IGNORED_KWARGS}
    if ":serialized:" in stored:
        # Beside the pickle of a dictionary, SB3 writes its plain items as they are and the others as their repr.
        pickled = sorted(key for key, value in policy_kwargs.items() if isinstance(value, str) and "<" in value)
        if pickled or "dict" not in str(stored.get(":type:")):
            raise NotOurPolicyError(
                f"{file}: policy_kwargs {pickled or stored.get(':type:')} are Python objects, stored as a pickle, which is "
                "not executed here; train with plain numbers, strings and lists in policy_kwargs, or, if you trust the file, "
                "load it with the algorithm's own load() and use model.policy."
            )
    return policy_kwargs


def _check_stock_code(data: dict[str, Any], file: Path) -> None:
    """
    :param data: The JSON of an SB3 zip
    :param file: The zip, named in errors
    :raises NotOurPolicyError: If the policy or its extractor is a class of a user, which acts otherwise and is not imported
    """
    policy_class, policy_kwargs = data.get("policy_class"), data.get("policy_kwargs")
    module = policy_class.get("__module__") if isinstance(policy_class, dict) else None
    extractor = policy_kwargs.get("features_extractor_class") if isinstance(policy_kwargs, dict) else None
    for what, found in (("policy is a class of the module", module), ("features_extractor_class is", extractor)):
        name = str(found).removeprefix("<class '")
        if found is not None and name.partition(".")[0] not in ("sb3_uav", "stable_baselines3", "sb3_contrib"):
            raise NotOurPolicyError(
                f"{file}: its {what} {found!r}, which is not imported here; if you trust the file, load it with the "
                "algorithm's own load() and use model.policy."
            )
