"""The rooms of the package: who may import whom, how large they are, and what they export."""

import ast
import importlib
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sb3_uav"
# From the lowest to the highest. A room may import those before it.
ROOMS = (
    "common",
    "distributions",
    "envs",
    "registration",
    "local_search",
    "bounds",
    "policies",
    "reinforce",
    "pretrained",
    "training",
    "solvers",
    "evaluation",
    "plots",
    "missions",
    "web",
    "zoo",
    "studies",
    "reproduce",
    "cli",
    "__main__",
)
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
# Names that older scripts import from a lower room: a module __getattr__ looks them up when somebody asks for them.
OLD_NAMES = {("sb3_uav.solvers", "sb3_uav.evaluation")}
MAX_LINES = 450
# Of the package: one folder, and a room with the folders in it.
MAX_SHARE, MAX_ROOM_SHARE = 0.15, 0.2


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def imports_of(path: Path, module: str, top_level: bool = False) -> set[str]:
    """
    :param path: A file of the package
    :param module: Its dotted name
    :param top_level: Whether to leave out imports inside functions
    :return: The modules of the package that it imports, also in strings that name one
    """
    found: set[str] = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    inside = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if top_level and id(node) in inside:
            continue
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                found.add(name if name in MODULES else str(node.module))
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings and not top_level:
            name = re.split(r"[:\s]", node.value)[0]
            while name.startswith("sb3_uav.") and name not in MODULES:
                name = name.rpartition(".")[0]
            found |= {name} if name.startswith("sb3_uav.") else set()
    return {name for name in found if name in MODULES and name != module}


def test_every_file_is_in_a_room():
    assert {room_of(module) for module in MODULES if module != "sb3_uav"} == set(ROOMS)


@pytest.mark.parametrize("module", [name for name in MODULES if "." in name])
def test_no_room_imports_a_higher_one(module):
    higher = ROOMS[ROOMS.index(room_of(module)) + 1 :]
    upward = {name for name in imports_of(MODULES[module], module) if room_of(name) in higher}
    assert {(module, name) for name in upward} <= OLD_NAMES


def test_local_search_needs_no_networks():
    for module in MODULES:
        if room_of(module) == "local_search":
            assert {room_of(name) for name in imports_of(MODULES[module], module)} <= {"common", "envs", "local_search"}


def test_there_is_no_import_circle():
    graph = {module: imports_of(path, module, top_level=True) for module, path in MODULES.items()}
    # Importing a module of a package runs the package's __init__, which is how circles come about that no file shows.
    while graph:
        leaves = {module for module, needed in graph.items() if not needed & set(graph)}
        assert leaves, f"a circle among {sorted(graph)}"
        graph = {module: needed for module, needed in graph.items() if module not in leaves}


def test_no_file_is_long():
    files = [
        path for folder in ("sb3_uav", "tests", "benchmarks", "examples", "scripts") for path in (ROOT / folder).rglob("*.py")
    ]
    lengths = {path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert {name for name, length in lengths.items() if length > MAX_LINES} <= {"sb3_uav/local_search/kernels.py"}


def test_no_folder_is_large():
    """A folder within a room counts on its own, but no room grows without end by folders in it."""
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in MODULES.items()}
    folders = {path.parent for path in MODULES.values()}
    parts = {
        str(folder.relative_to(ROOT)): ([m for m in lines if MODULES[m].parent == folder], MAX_SHARE) for folder in folders
    }
    parts |= {f"room {room}": ([module for module in lines if room_of(module) == room], MAX_ROOM_SHARE) for room in ROOMS}
    for name, (modules, most) in parts.items():
        share = sum(lines[module] for module in modules) / sum(lines.values())
        assert 0 < share <= most, f"{name} holds {share:.1%} of the package"


EXPORTS: dict[str, list[str]] = json.loads((ROOT / "tests" / "exports.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("package", sorted(EXPORTS))
def test_exports_stay_importable(package):
    module = importlib.import_module(package)
    for name in EXPORTS[package]:
        assert getattr(module, name) is not None


@pytest.mark.parametrize("package", sorted(EXPORTS))
def test_exports_are_declared(package):
    module = importlib.import_module(package)
    assert module.__all__ and all(hasattr(module, name) for name in module.__all__)
