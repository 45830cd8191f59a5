"""Where results come from: the solver, the versions of packages, and the machine."""

from __future__ import annotations

import json
import os
import platform
from importlib import metadata
from typing import Any

import sb3_uav
from sb3_uav.common.files import file_hash
from sb3_uav.solvers.base import Solver

# Packages whose version may change the schedules of a solver.
_PACKAGES = ("torch", "numpy", "stable-baselines3", "scipy", "numba", "ortools", "pyvrp", "highspy", "gurobipy")


def describe_solver(solver: Solver) -> dict[str, Any]:
    """
    :param solver: A solver
    :return: Its entry in ``evaluation.json``
    """
    files = {purpose: {"path": str(path), "sha256": file_hash(path)} for purpose, path in solver.files.items()}
    # As it is read back from the file, without tuples.
    return json.loads(json.dumps({"spec": solver.spec, "settings": solver.settings(), "files": files}))


def describe_machine() -> dict[str, Any]:
    """
    :return: Versions of all packages that take part in an evaluation, and the machine
    """
    versions = {"sb3-uav": sb3_uav.__version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {"versions": versions, "platform": platform.platform(), "cpu_count": os.cpu_count()}
