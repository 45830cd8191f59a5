"""
Every change that we make to rl_zoo3 from outside, with a link to the code that makes it necessary.

Overridden methods of its ``ExperimentManager`` are in :mod:`sb3_uav.zoo.experiment`.
"""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

from sb3_uav.common.optional import install_command

try:
    import optuna  # rl_zoo3 imports it; a missing one is reported here too.
    import rl_zoo3
    import rl_zoo3.train
    import rl_zoo3.utils
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
except ImportError as error:
    raise ImportError(f"Training from YAML needs rl_zoo3 ({error}); run: {install_command('zoo')}") from error

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

_MakeVecEnv = Callable[[list[Any]], VecEnv]


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """
    :param owner: A module or class
    :param name: Its attribute
    :param value: The value of that attribute until the ``with`` block ends
    """
    before = owner.__dict__[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


@contextmanager
def command_line(prog: str, arguments: Sequence[str]) -> Iterator[None]:
    """
    Set the command line that ``rl_zoo3.train`` and ``rl_zoo3.enjoy`` parse, because they take no arguments.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/train.py#L168
    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/enjoy.py (the same call)

    :param prog: Name of the command
    :param arguments: Its arguments
    """
    with _replaced(sys, "argv", [prog, *arguments]):
        yield


@contextmanager
def help_text(module: ModuleType | None, description: str, *more: tuple[str, str]) -> Iterator[None]:
    """
    Add a description to what a command of rl_zoo3 prints for ``--help``; its parser has none.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/train.py#L23

    :param module: The module of the command; None for a script, which imports ``argparse`` when it runs
    :param description: The text, printed as it is
    :param more: Flags of ours, with the name of their value if they have one, and their explanations
    """

    class Parser(argparse.ArgumentParser):
        def __init__(self, *_: Any, **kwargs: Any) -> None:
            kwargs |= {"description": description, "formatter_class": argparse.RawDescriptionHelpFormatter}
            super().__init__(**kwargs, usage="%(prog)s [options]")
            for flag, text in more:
                name, metavar = [*flag.split(" "), ""][:2]
                kind: dict[str, Any] = {"metavar": metavar} if metavar else {"action": "store_true"}
                self.add_argument(name, help=text, **kind)

    # Not in argparse itself, whose class names itself.
    stand_in = ModuleType("argparse")
    vars(stand_in).update(vars(argparse), ArgumentParser=Parser)
    with mock.patch.dict(sys.modules, argparse=stand_in) if module is None else _replaced(module, "argparse", stand_in):
        yield


def run_script(
    module: str,
    make_env: Callable[..., VecEnv] | None = None,
    run_command: Callable[[Sequence[str]], int] | None = None,
) -> None:
    """
    Run a module of rl_zoo3 that has no function to call, as ``python -m`` does.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/record_video.py
    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/benchmark.py

    :param module: Its name
    :param make_env: Takes the place of ``rl_zoo3.utils.create_test_env``
    :param run_command: Takes a command line in place of ``subprocess.call`` and returns an exit code
    """
    make = rl_zoo3.utils.create_test_env if make_env is None else make_env
    call = subprocess.call if run_command is None else run_command
    with _replaced(rl_zoo3.utils, "create_test_env", make), _replaced(subprocess, "call", call):
        runpy.run_module(module, run_name="__main__")


def plot_command(name: str) -> tuple[ModuleType, Callable[[], None]]:
    """
    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/plots/__init__.py

    :param name: Name of a function of ``rl_zoo3.plots``
    :return: Its module, which the package hides behind the function, and the function
    """
    module = import_module(f"rl_zoo3.plots.{name}")
    return module, getattr(module, name)


@contextmanager
def shown_figures(show: bool) -> Iterator[list[Any]]:
    """
    Collect the figures that are open when pyplot should show them.

    :param show: Whether it shows them all the same
    :return: The figures, once the ``with`` block ends
    """
    import matplotlib.pyplot as plt

    figures: list[Any] = []
    before = set(plt.get_fignums())
    with _replaced(plt, "show", plt.show if show else lambda *_, **__: None):
        yield figures
    for number in sorted(set(plt.get_fignums()) - before):
        figures.append(plt.figure(number))
        plt.close(number)


@contextmanager
def experiment_manager(manager: type[ExperimentManager]) -> Iterator[None]:
    """
    Replace the experiment manager that ``rl_zoo3.train`` looks up in its module.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/train.py#L233

    :param manager: The class
    """
    with _replaced(rl_zoo3.train, "ExperimentManager", manager):
        yield


@contextmanager
def replay_environment(make: Callable[..., VecEnv]) -> Iterator[None]:
    """
    Replace the function that ``rl_zoo3.enjoy`` looks up in its module to make its environment.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/enjoy.py#L164

    :param make: Takes the arguments of ``rl_zoo3.utils.create_test_env``
    """
    import rl_zoo3.enjoy

    with _replaced(rl_zoo3.enjoy, "create_test_env", make):
        yield


@contextmanager
def created_studies(opened: Callable[[Any], Any], started: Callable[[optuna.Study], None]) -> Iterator[None]:
    """
    Change how ``-optimize`` opens its study; it passes the URL of a database on as it was given.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L922

    :param opened: Takes the storage, a URL or an object, and returns what to use in its place
    :param started: Called with the study
    """
    create_study = optuna.create_study

    def create(*, storage: Any = None, **kwargs: Any) -> optuna.Study:
        study = create_study(storage=opened(storage), **kwargs)
        started(study)
        return study

    with _replaced(optuna, "create_study", create):
        yield


class _StudyInterrupted(BaseException):
    """Ctrl-C, as rl_zoo3 does not catch it."""


@contextmanager
def interruptible_studies() -> Iterator[None]:
    """
    Pass Ctrl-C on, which rl_zoo3 takes for the end of ``-optimize``: it would report the best trial and end well.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L964

    :raises KeyboardInterrupt: After Ctrl-C in a trial or between trials
    """
    optimize = optuna.Study.optimize

    def pass_on(study: optuna.Study, *args: Any, **kwargs: Any) -> None:
        try:
            optimize(study, *args, **kwargs)
        except KeyboardInterrupt as error:
            raise _StudyInterrupted from error

    try:
        with _replaced(optuna.Study, "optimize", pass_on):
            yield
    except _StudyInterrupted as error:
        raise KeyboardInterrupt from error


@contextmanager
def default_vec_env(make: _MakeVecEnv) -> Iterator[None]:
    """
    Replace rl_zoo3's default vectorized environment while the ``with`` block lasts.

    :param make: Takes one function per row
    """
    # A plain function would become a method of the class that it is set on.
    with _replaced(ExperimentManager, "default_vec_env_cls", staticmethod(make)):
        yield


def set_default_vec_env(make: _MakeVecEnv) -> None:
    """
    Replace rl_zoo3's default vectorized environment.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/exp_manager.py#L139

    :param make: Takes one function per row
    """
    ExperimentManager.default_vec_env_cls = staticmethod(make)  # type: ignore[assignment]


def add_algorithms(algorithms: dict[str, type[BaseAlgorithm]]) -> None:
    """
    Add to the algorithms of rl_zoo3; ``train``, ``enjoy`` and the experiment manager share one dict.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/utils.py#L27

    :param algorithms: Classes by the names that ``--algo`` takes
    """
    rl_zoo3.ALGOS.update(algorithms)


def set_search_space(algo: str, sampler: Callable[..., Any], converter: Callable[..., Any]) -> None:
    """
    Replace the search space of ``-optimize``.

    https://github.com/DLR-RM/rl-baselines3-zoo/blob/v2.9.2/rl_zoo3/hyperparams_opt.py#L492

    :param algo: Name of an algorithm
    :param sampler: Draws hyperparameters
    :param converter: Converts the parameters of a trial
    """
    samplers: dict[str, Any] = HYPERPARAMS_SAMPLER
    converters: dict[str, Any] = HYPERPARAMS_CONVERTER
    samplers[algo], converters[algo] = sampler, converter


def stock_config(algo: str) -> Path:
    """
    https://github.com/DLR-RM/rl-baselines3-zoo/tree/master/hyperparams

    :param algo: Name of an algorithm
    :return: Path of rl_zoo3's YAML for it, which need not exist
    """
    return Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
