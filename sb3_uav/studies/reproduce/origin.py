"""What every file says of its origin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_uav.evaluation.provenance import describe_machine
from sb3_uav.plots.figure_files import save_figure
from sb3_uav.studies.reproduce.paper import paper_tables
from sb3_uav.studies.reproduce.scales import Scale

FIGURE_SUFFIXES = (".png", ".pdf")


@dataclass(frozen=True)
class Origin:
    """
    :param command: The command line
    :param scale: The scale
    :param seed: The seed
    """

    command: str
    scale: Scale
    seed: int

    def lines(self) -> list[str]:
        """:return: Command, scale, seed, versions and machine, one line each"""
        machine = describe_machine()
        versions = ", ".join(f"{package} {version}" for package, version in machine["versions"].items())
        return [
            f"Command: {self.command}",
            f"Scale: {self.scale.name}, {self.scale.text}",
            f"Seed: {self.seed}",
            f"Versions: {versions}",
            f"Machine: {machine['platform']}, {machine['cpu_count']} CPUs",
            f"Figures of the paper: {paper_tables()['source']}",
        ]

    def metadata(self) -> dict[str, str]:
        """:return: The same for pictures"""
        return {"Title": self.command, "Subject": " | ".join(self.lines())}

    def footer(self) -> str:
        """:return: What a picture says of itself"""
        return f"sb3-uav reproduce, scale {self.scale.name}, seed {self.seed}"


def write_figure(figure: Any, origin: Origin, stem: Path) -> list[Path]:
    """
    :param figure: A matplotlib figure
    :param origin: Where it comes from
    :param stem: Path of the files without their suffix
    :return: The files
    """
    figure.supxlabel(origin.footer(), fontsize=7, color="0.45", x=0.995, ha="right")
    paths = []
    for suffix in FIGURE_SUFFIXES:
        path = stem.with_name(stem.name + suffix)
        save_figure(figure, path, metadata_of(suffix, origin.metadata()))
        paths.append(path)
    return paths


def metadata_of(suffix: str, metadata: Mapping[str, str]) -> dict[str, str]:
    """
    :param suffix: Of a picture
    :param metadata: Title and subject
    :return: The same under the keys that its format has
    """
    return dict(metadata) if suffix == ".pdf" else {"Title": metadata["Title"], "Description": metadata["Subject"]}
