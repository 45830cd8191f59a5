"""``python -m sb3_uav.zoo.train``: rl_zoo3's training, knowing our algorithms, environments and YAMLs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import sb3_uav  # noqa: F401  (registers the environment ids)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train or tune with rl_zoo3; every flag of ``rl_zoo3.train`` works.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _train(arguments)
    except (ValueError, FileNotFoundError, ImportError) as error:
        print(f"sb3_uav.zoo.train: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"sb3_uav.zoo.train: could not write: {error}. Earlier files are intact.", file=sys.stderr)
        return 2


def _train(arguments: list[str]) -> int:
    from sb3_uav.zoo.experiment import UAVExperimentManager, default_config, register_algorithms, rl_zoo3

    register_algorithms()
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="reinforce")
    parser.add_argument("--env")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("--eval-freq")
    parser.add_argument("-i", "--trained-agent")
    known, _ = parser.parse_known_args(arguments)
    if known.trained_agent is not None and not Path(known.trained_agent).is_file():
        raise FileNotFoundError(f"-i {known.trained_agent}: no such file; give the zip of a trained agent.")
    UAVExperimentManager.eval_freq_given = known.eval_freq is not None
    defaults = []
    if known.conf_file is None and (config := default_config(known.algo, known.env)) is not None:
        defaults = ["--conf-file", str(config)]
    # rl_zoo3.train.train makes its manager by this name, reads sys.argv and takes no arguments.
    with (
        patch.object(rl_zoo3.train, "ExperimentManager", UAVExperimentManager),
        patch.object(sys, "argv", ["sb3_uav.zoo.train", "--algo", known.algo, *defaults, *arguments]),
    ):
        rl_zoo3.train.train()
    return 0


if __name__ == "__main__":
    sys.exit(main())
