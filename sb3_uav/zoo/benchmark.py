"""``sb3-uav benchmark`` or ``python -m sb3_uav.zoo.benchmark``: rl_zoo3's table of all agents of a log folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.errors import main_function
from sb3_uav.zoo.dependencies import require_zoo

_PROG = "sb3-uav benchmark"
_HELP = """\
Replay the last agent of every algorithm and environment of a log folder with rl_zoo3, and write their mean rewards into
benchmark.md, in --benchmark-dir and, without --test-mode, in the current folder. Allocators play with the routers of their
runs. Finished replays in --benchmark-dir are kept. For confidence intervals and other solvers use `sb3-uav evaluate`.

The defaults below are rl_zoo3's, but for these: --log-dir is logs, and agents come from there only (--no-hub).
"""


def benchmark(arguments: Sequence[str]) -> None:
    """
    Replay all agents of a log folder; every flag of ``rl_zoo3.benchmark`` works.

    :param arguments: Command line arguments
    :raises ValueError: If an argument is wrong, or no agent could be replayed
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that this needs is not installed
    """
    require_zoo("A benchmark", "rl_zoo3.enjoy", "pytablewriter", "pandas")
    from sb3_uav.zoo.enjoy import main as enjoy_main
    from sb3_uav.zoo.experiment import register_algorithms
    from sb3_uav.zoo.replay import without_flag
    from sb3_uav.zoo.rl_zoo3_compat import command_line, help_text, run_script
    from sb3_uav.zoo.trust import TRUST_FLAG, require_plain_run

    register_algorithms()
    arguments, trust = without_flag(arguments, "--trust")
    codes: list[int] = []

    def replay(command: Sequence[str]) -> int:
        # python enjoy.py ARGUMENT ..., which works in a checkout of rl_zoo3 only.
        codes.append(enjoy_main([*command[2:], *(["--trust"] if trust else [])]))
        return codes[-1]

    if {"-h", "--help"} & set(arguments):
        with command_line(_PROG, ["--help"]), help_text(None, _HELP, TRUST_FLAG):
            run_script("rl_zoo3.benchmark")
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--benchmark-dir", type=Path, default=Path("logs/benchmark"))
    parser.add_argument("--log-dir", type=Path, default=Path("logs"))
    given = parser.parse_known_args(arguments)[0]
    for path in given.log_dir.glob("*/*/*/args.yml"):
        # rl_zoo3 reads them with a loader that creates any object they name.
        require_plain_run(path.parent.parent, path.parent.name, trust)
    # rl_zoo3 writes there even if no replay has made it.
    given.benchmark_dir.mkdir(parents=True, exist_ok=True)
    with command_line(_PROG, ["--log-dir", "logs", "--no-hub", *arguments]):
        run_script("rl_zoo3.benchmark", run_command=replay)
    if codes and any(codes):
        raise ValueError(f"{sum(map(bool, codes))} of {len(codes)} agents could not be replayed; see above.")


# For ``python -m sb3_uav.zoo.benchmark``, with exit codes in place of exceptions.
main = main_function(_PROG, benchmark)

if __name__ == "__main__":
    sys.exit(main())
