"""Where the router of a training comes from: settings, a zip, a pair that comes with the package, or zip and settings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sb3_uav.pretrained import files, router_file

_ZIP, _PAIR = "zip", "pretrained"


def router_source(router: dict[str, Any] | str | os.PathLike[str]) -> tuple[Path | None, dict[str, Any]]:
    """
    :param router: A mapping with the settings of an algorithm, among them ``policy``; or the zip of a router or the name of a
        pair; or a mapping with one of these under the key ``zip`` or ``pretrained``, and any settings of the algorithm
    :return: The zip of the router, if one is given, and the settings without it
    :raises FileNotFoundError: If there is no such zip
    :raises ValueError: If it is none of these
    """
    if isinstance(router, str | os.PathLike):
        return router_file(router), {}
    if not isinstance(router, dict) or not router.keys() & {"policy", _ZIP, _PAIR}:
        raise ValueError(
            "router must be the zip of a router, the name of a trained pair, or a mapping with at least one of the keys "
            f"'policy', '{_ZIP}' and '{_PAIR}', found {router!r:.80}."
        )
    settings = dict(router)
    zip_file, pair = settings.pop(_ZIP, None), settings.pop(_PAIR, None)
    if zip_file is not None and pair is not None:
        raise ValueError(f"router: '{_ZIP}' is {zip_file!r} and '{_PAIR}' is {pair!r}; give one of them.")
    if pair is not None:
        return files(str(pair))[1], settings
    return (None if zip_file is None else router_file(zip_file)), settings
