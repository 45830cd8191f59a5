"""``sb3-uav train`` or ``python -m sb3_uav.zoo.train``: rl_zoo3's training with our algorithms, environments and YAMLs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from importlib import import_module
from pathlib import Path

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common import distributed
from sb3_uav.common.errors import main_function
from sb3_uav.common.interruption import Interruption
from sb3_uav.common.optional import require
from sb3_uav.common.random_streams import draw_seed
from sb3_uav.pretrained import names
from sb3_uav.registration import ensure_registered
from sb3_uav.zoo.dependencies import require_zoo

_PROG = "sb3-uav train"
_HELP = """\
Train or tune with rl_zoo3 and the algorithms reinforce and ppo_mask beside its own.

The defaults below are rl_zoo3's, but for these: --algo is reinforce; --conf-file is the YAML of sb3_uav for the algorithm,
where it knows the environment; --eval-freq is once per epoch, or left to the YAML's FixedSetEvalCallback; --save-freq saves
the router beside each checkpoint. --env is any TaskAllocation-U{V}-N{N}-v0 or RoutePlanning-N{N}-v0, TaskAllocation-v0 or
RoutePlanning-v0 with --env-kwargs, or what --gym-packages registers.
"""


def train(arguments: Sequence[str]) -> None:
    """
    Train or tune with rl_zoo3; every flag of ``rl_zoo3.train`` works. Under ``torchrun`` the processes share the training.

    :param arguments: Command line arguments
    :raises ValueError: If an argument or the YAML is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that training needs is not installed
    :raises Interruption: After Ctrl-C, with the command that continues
    """
    if not distributed.is_launched():
        _train(arguments)
        return
    with distributed.process_group(), distributed.quiet_unless_main():
        _train([*arguments, *_shared_seed(arguments)])


def _shared_seed(arguments: Sequence[str]) -> list[str]:
    """:return: A seed for all processes, as rl_zoo3 draws one in each of them, unless there is one among the arguments"""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--seed", type=int, default=-1)
    given = parser.parse_known_args(arguments)[0].seed
    return [] if given >= 0 else ["--seed", str(distributed.on_main(draw_seed))]


def _train(arguments: Sequence[str]) -> None:
    """:param arguments: Command line arguments"""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="reinforce")
    parser.add_argument("--env")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("--eval-freq")
    parser.add_argument("-i", "--trained-agent")
    parser.add_argument("-tb", "--tensorboard-log")
    parser.add_argument("-P", "--progress", action="store_true")
    parser.add_argument("--track", action="store_true")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--storage")
    parser.add_argument("--study-name")
    parser.add_argument("--trust", action="store_true")
    parser.add_argument("-h", "--help", action="store_true")
    known, _ = parser.parse_known_args(arguments)
    given = list(arguments)
    arguments = [argument for argument in arguments if argument != "--trust"]
    require_zoo("Training from YAML")
    if known.progress:
        require_zoo("The progress bar", "tqdm.rich", "rich")
    if known.tensorboard_log or known.track:
        require_zoo("--track" if known.track else "--tensorboard-log", "tensorboard")
    if known.track:
        require("wandb", "--track", "track")
    from huggingface_sb3 import EnvironmentName

    from sb3_uav.zoo.configs import default_config
    from sb3_uav.zoo.experiment import UAVExperimentManager, register_algorithms
    from sb3_uav.zoo.fine_tuning import zip_of_pair
    from sb3_uav.zoo.rl_zoo3_compat import command_line, experiment_manager, help_text, rl_zoo3
    from sb3_uav.zoo.trust import TRUST_FLAG, reading, require_plain_neighbors

    register_algorithms()
    if known.help:
        with command_line(_PROG, ["--help"]), help_text(rl_zoo3.train, _HELP, TRUST_FLAG):
            rl_zoo3.train.train()
    for module in known.gym_packages:
        import_module(module)
    if known.env is not None:
        ensure_registered(known.env)
    shipped = None if known.trained_agent is None else zip_of_pair(known.trained_agent, known.env)
    if known.trained_agent is not None and shipped is None and not Path(known.trained_agent).is_file():
        raise FileNotFoundError(
            f"-i {known.trained_agent}: no such file; give the zip of a trained agent, or one of {names()}."
        )
    if known.trained_agent is not None and shipped is None:
        require_plain_neighbors(Path(known.trained_agent), EnvironmentName(known.env or "CartPole-v1"), known.trust)
    # The last one counts.
    agent = [] if shipped is None else ["-i", str(shipped)]
    UAVExperimentManager.eval_freq_given = known.eval_freq is not None
    defaults = []
    if known.conf_file is None and (config := default_config(known.algo, known.env)) is not None:
        defaults = ["--conf-file", str(config)]
    words = ["--algo", known.algo, *defaults, *arguments, *agent]
    safely = nullcontext() if known.trained_agent is None else reading(known.trust, Path(known.trained_agent).parent)
    with safely, experiment_manager(UAVExperimentManager), command_line(_PROG, words), _readable_errors():
        try:
            rl_zoo3.train.train()
        except Interruption as error:
            is_kept = known.trained_agent is not None or None not in (known.storage, known.study_name)
            raise _continued(given, is_kept, error.changes) from error


@contextmanager
def _readable_errors() -> Iterator[None]:
    """Turn errors of rl_zoo3 and of what it calls into those that commands report."""
    try:
        yield
    except AssertionError as error:
        # rl_zoo3 raises it for wrong arguments.
        raise ValueError(str(error)) from error
    except FileNotFoundError:
        raise
    except OSError as error:
        raise OSError(f"could not write: {error}. Earlier files are intact.") from error
    except Exception as error:
        # wandb is not imported here, so that its classes cannot be named.
        if type(error).__module__.partition(".")[0] != "wandb":
            raise
        raise ValueError(f"--track: {error} Or set WANDB_MODE=offline.") from error


def _continued(arguments: Sequence[str], is_kept: bool, changes: Sequence[str]) -> Interruption:
    """
    :param arguments: Of the interrupted command
    :param is_kept: Whether what it began with is still there: its ``-i``, or a study in a storage
    :param changes: That of the command that continues; empty if nothing was saved
    :return: What says how to go on
    """
    if not changes:
        # From where it began.
        return Interruption([*_PROG.split(), *arguments] if is_kept else [])
    from sb3_uav.zoo.interrupted import with_changes

    return Interruption([*_PROG.split(), *with_changes(arguments, changes)], changes)


# For ``python -m sb3_uav.zoo.train``, with exit codes in place of exceptions.
main = main_function(_PROG, train)

if __name__ == "__main__":
    sys.exit(main())
