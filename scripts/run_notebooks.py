"""Runs the notebooks of the docs and stores their outputs: ``python scripts/run_notebooks.py``."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "notebooks"


def run(path: Path) -> nbformat.NotebookNode:
    """
    :param path: A notebook
    :return: The same with the outputs of this run, and without times and names of machines
    :raises nbclient.exceptions.CellExecutionError: If a cell fails; the message holds the cell and the error
    """
    notebook = nbformat.read(path, as_version=4)
    # Figures are shown in the notebook, whatever the caller's backend is.
    env = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    env["PYTHONPATH"] = os.pathsep.join([str(FOLDER.parents[1]), env.get("PYTHONPATH", "")])
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}})
    client.execute(env=env)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    return notebook


def main() -> None:
    """Run all of them."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        nbformat.write(run(path), path)


if __name__ == "__main__":
    main()
