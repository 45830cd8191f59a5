"""``sb3-uav record-video`` or ``python -m sb3_uav.zoo.record_video``: rl_zoo3's video of a trained agent."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.errors import main_function
from sb3_uav.common.optional import require
from sb3_uav.zoo.dependencies import require_zoo

_PROG = "sb3-uav record-video"
_HELP = """\
Record a trained agent with rl_zoo3. An allocator's rewards, and the tours in the last picture of an episode, come from the
router of its run, as in `sb3-uav enjoy`.

Agents are read as in `sb3-uav enjoy`, without unpickling them unless --trust is given.

The defaults below are rl_zoo3's, but for these: --algo is reinforce; --folder is logs; --n-timesteps is one episode of the
environments of sb3_uav; --output-folder is videos in the folder of the run.
"""


def record_video(arguments: Sequence[str]) -> None:
    """
    Record a trained agent; every flag of ``rl_zoo3.record_video`` works.

    :param arguments: Command line arguments
    :raises ValueError: If there is no such agent, or another argument is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package that recording needs is not installed
    """
    require_zoo("Recording a video", "rl_zoo3.enjoy")
    from sb3_uav.zoo.experiment import register_algorithms
    from sb3_uav.zoo.replay import agent_parser, environment_of, episode_length, find_agent, without_flag, without_packages
    from sb3_uav.zoo.rl_zoo3_compat import command_line, help_text, run_script
    from sb3_uav.zoo.trust import TRUST_FLAG, reading

    register_algorithms()
    chosen, _ = agent_parser().parse_known_args(arguments)
    # What rl_zoo3's command does not know.
    arguments, trust = without_flag(without_packages(arguments), "--trust")
    if chosen.help:
        with command_line(_PROG, ["--help"]), help_text(None, _HELP, TRUST_FLAG):
            run_script("rl_zoo3.record_video")
    require("moviepy", "Recording a video", "video")
    require("matplotlib", "Recording a video", "plots")
    agent = find_agent(chosen, trust)
    length = episode_length(agent, chosen.env)
    flags = ["--algo", chosen.algo, "-f", chosen.folder, *([] if length is None else ["-n", str(length)]), *arguments]
    with reading(trust, agent.run_folder), command_line(_PROG, flags):
        run_script("rl_zoo3.record_video", environment_of(agent))


# For ``python -m sb3_uav.zoo.record_video``, with exit codes in place of exceptions.
main = main_function(_PROG, record_video)

if __name__ == "__main__":
    sys.exit(main())
