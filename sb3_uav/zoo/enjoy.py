"""``sb3-uav enjoy`` or ``python -m sb3_uav.zoo.enjoy``: rl_zoo3's replay, with the router trained beside the allocator."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.errors import main_function
from sb3_uav.zoo.dependencies import require_zoo

_PROG = "sb3-uav enjoy"
_HELP = """\
Replay a trained agent with rl_zoo3. An allocator's rewards come from the router of its run: that of the best pair with
--load-best, that of the same moment with --load-checkpoint and --load-last-checkpoint.

Agents with the policies of sb3_uav are read without unpickling them. Others, and runs with pickles or code in their settings,
need --trust: rl_zoo3 unpickles them, which runs any code that their author put there.

The defaults below are rl_zoo3's, but for these: --algo is reinforce, --folder is logs.
"""


def enjoy(arguments: Sequence[str]) -> None:
    """
    Replay a trained agent; every flag of ``rl_zoo3.enjoy`` works.

    :param arguments: Command line arguments
    :raises ValueError: If there is no such agent, or another argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that replays need is not installed
    """
    require_zoo("Replaying a trained agent", "rl_zoo3.enjoy")
    from sb3_uav.zoo.experiment import make_batched_vec_env, register_algorithms
    from sb3_uav.zoo.replay import agent_parser, environment_of, find_agent, without_flag
    from sb3_uav.zoo.rl_zoo3_compat import command_line, default_vec_env, help_text, replay_environment
    from sb3_uav.zoo.trust import TRUST_FLAG, reading

    register_algorithms()
    import rl_zoo3.enjoy

    arguments, trust = without_flag(arguments, "--trust")
    chosen, _ = agent_parser().parse_known_args(arguments)
    if chosen.help:
        with command_line(_PROG, ["--help"]), help_text(rl_zoo3.enjoy, _HELP, TRUST_FLAG):
            rl_zoo3.enjoy.enjoy()
    agent = find_agent(chosen, trust)
    make_env = environment_of(agent)
    flags = ["--algo", chosen.algo, "-f", chosen.folder, *arguments]
    with (
        reading(trust, agent.run_folder),
        default_vec_env(make_batched_vec_env),
        replay_environment(make_env),
        command_line(_PROG, flags),
    ):
        rl_zoo3.enjoy.enjoy()


# For ``python -m sb3_uav.zoo.enjoy``, with exit codes in place of exceptions.
main = main_function(_PROG, enjoy)

if __name__ == "__main__":
    sys.exit(main())
