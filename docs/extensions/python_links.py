"""
References of docstrings to Python objects that have another name on the site, or no place there.

Docstrings name the module that defines an object; the site documents it where users import it. What is not documented, such
as internals and the objects of other packages, is shown without a link. Sphinx reports, with ``-n``, what does not exist.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

PACKAGE = "sb3_uav"
# Other packages; and names that are imported for type checkers only, so that Sphinx finds them as they are written.
FOREIGN = {"collections", "gymnasium", "io", "numpy", "os", "pathlib", "stable_baselines3", "torch", "types"}
SHORT_NAMES = {"GymEnv", "OnPolicyAlgorithm", "spaces.Space"}


def _has(module: str, path: list[str]) -> bool:
    """:return: Whether an object of a module, or the annotation of a field, has this path"""
    found: Any = importlib.import_module(module)
    for name in path:
        if name in getattr(found, "__annotations__", {}):
            return True
        if not hasattr(found, name):
            return False
        found = getattr(found, name)
    return True


def _exists(target: str, room: str) -> bool:
    """
    :param target: A name as a docstring has it: whole, or relative to the module or the class of the docstring
    :param room: The folder of the package that the docstring is in
    :return: Whether there is such an object
    """
    names = target.split(".")
    package = importlib.import_module(f"{PACKAGE}.{room}")
    modules = [package.__name__]
    modules += [found.name for found in pkgutil.walk_packages(getattr(package, "__path__", []), f"{package.__name__}.")]
    if names[0] == PACKAGE:
        owners = [module for module in modules if target == module or target.startswith(f"{module}.")]
        return any(_has(module, names[module.count(".") + 1 :]) for module in owners)
    for module in modules:
        classes = [name for name, found in vars(importlib.import_module(module)).items() if isinstance(found, type)]
        if _has(module, names) or any(_has(module, [name, *names]) for name in classes):
            return True
    return False


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Node) -> nodes.Node | None:
    """
    :param app: Sphinx
    :param env: What it has read
    :param node: A reference that it could not resolve
    :param content: What the reference shows
    :return: A link to the documented object, or the text if there is none; None if no such object exists
    """
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    if target.split(".")[0] in FOREIGN or target in SHORT_NAMES:
        return content
    whole = target if target.startswith(f"{PACKAGE}.") else f"{node.get('py:module') or PACKAGE}.{target}"
    if whole.count(".") < 2:
        return content if _exists(target, "common") else None
    room = whole.split(".")[1]
    objects = env.domains.python_domain.objects
    for depth in (2, 1):
        suffix = "." + ".".join(whole.split(".")[-depth:])
        found = [name for name in objects if name.startswith(f"{PACKAGE}.{room}.") and name.endswith(suffix)]
        if len(found) == 1:
            entry = objects[found[0]]
            return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, found[0])
    return content if _exists(target, room) else None


def skip_fields(app: Sphinx, what: str, name: str, found: Any, skip: bool, options: Any) -> bool | None:
    """Leave out the fields of named tuples, whose docstrings are Python's; the docstring of the tuple has them."""
    text = getattr(found, "__doc__", None) or ""
    return True if text.startswith("Alias for field number") else None


def setup(app: Sphinx) -> dict[str, bool]:
    """
    :param app: Sphinx
    :return: That its processes may work side by side
    """
    app.connect("missing-reference", resolve)
    app.connect("autodoc-skip-member", skip_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
