"""``sb3-uav solve``: from a task list to missions that fly."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import get_args

from sb3_uav.common.interruption import ends_at_once
from sb3_uav.common.optional import require
from sb3_uav.missions.flight import Firmware, FlightOptions, Landing, Vehicle

_EPILOG = """\
TASKS:
  CSV with id, lat, lon (or x, y), value, service_s, must; GeoJSON points; .plan of QGroundControl; QGC WPL 110;
  Chao's and OPLib's benchmark files; .npz. See docs/missions.md.

files in OUT:
  mission.json                    the whole plan, for sb3-uav replan
  routes.csv, routes.geojson      stops in flying order, lengths, skipped tasks
  UAV.plan, UAV.waypoints         a mission per UAV (latitudes and longitudes only), routes.kml
  map.html, map.png               maps, without a network
  summary.json                    objective, lengths, reasons, versions, seed, the checker's verdict, digests of the files
  An earlier mission in OUT is replaced as a whole; other files are never overwritten.

exit code:
  0    a plan that serves something, and all tasks that must be served
  1    the plan is empty, or a task that must be served is not; the files are written all the same
  2    the input was wrong, and nothing was written
  130  interrupted by Ctrl-C; nothing was written
"""


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-uav solve",
        description="Plan missions of UAVs over a list of tasks, check them, and write files that fly and maps.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tasks", type=Path, metavar="TASKS", help="file of the tasks")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="folder of the mission")
    parser.add_argument("--overwrite", action="store_true", help="also replace files of an earlier mission that were changed")
    of_tasks = parser.add_argument_group("tasks")
    of_tasks.add_argument(
        "--depot", metavar="LAT,LON", help="where the UAVs start and land (or X,Y), if the file does not say"
    )
    of_tasks.add_argument("--unit", help="unit of x and y, such as m, km or ft, if the file does not say")
    of_tasks.add_argument("--allow-duplicates", action="store_true", help="several tasks may be at one place")
    of_tasks.add_argument("--row", type=int, metavar="N", help="which instance of an .npz with several, from 0")
    add_fleet_options(parser)
    search = parser.add_argument_group("search")
    search.add_argument("--solver", metavar="SPEC", help="as for sb3-uav evaluate (default: the trained pair, repair, polish)")
    search.add_argument("--time-limit", type=float, default=10.0, metavar="SECONDS", help="default: %(default)g")
    search.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    add_flight_options(parser)
    return parser


def add_fleet_options(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Gets the options that say which UAVs there are
    """
    group = parser.add_argument_group("fleet")
    group.add_argument("--fleet", type=Path, metavar="CSV", help="file with id, range_m or endurance_min and speed_mps, ...")
    group.add_argument("--uavs", type=int, metavar="N", help="number of equal UAVs")
    group.add_argument("--range", metavar="LENGTH", help="how far each of them flies, such as 12km")
    group.add_argument("--endurance", metavar="TIME", help="how long each of them flies, such as 25min; needs --speed")
    group.add_argument("--speed", metavar="SPEED", help="cruise speed, such as 12m/s")
    group.add_argument(
        "--reserve", type=float, default=0.0, metavar="PERCENT", help="part of the range that is kept (default: %(default)g)"
    )


def add_flight_options(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Gets the options that say how missions are flown
    """
    defaults = FlightOptions()
    group = parser.add_argument_group("flight")
    group.add_argument(
        "--altitude",
        dest="altitude_m",
        type=float,
        default=defaults.altitude_m,
        metavar="METERS",
        help="of the first UAV, above the depot (default: %(default)g)",
    )
    group.add_argument(
        "--altitude-step",
        dest="altitude_step_m",
        type=float,
        default=defaults.altitude_step_m,
        metavar="METERS",
        help="how much higher each further UAV flies (default: %(default)g)",
    )
    for name, choices in (("firmware", Firmware), ("vehicle", Vehicle), ("landing", Landing)):
        group.add_argument(
            f"--{name}", choices=get_args(choices), default=getattr(defaults, name), help="default: %(default)s"
        )


def flight_of(args: argparse.Namespace) -> FlightOptions:
    """
    :param args: Parsed with :func:`add_flight_options`
    :return: The options
    :raises ValueError: If one is not allowed
    """
    return FlightOptions(**{field.name: getattr(args, field.name) for field in fields(FlightOptions)})


def _joined(argv: Sequence[str]) -> list[str]:
    """argparse takes a southern latitude for an option: ``--depot -33,151`` becomes ``--depot=-33,151``."""
    joined: list[str] = []
    for word in argv:
        if re.match(r"-[\d.]", word) and joined and re.fullmatch(r"--[a-z-]+", joined[-1]):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def main(argv: Sequence[str]) -> int:
    """
    :param argv: Arguments
    :return: Exit code, see :data:`_EPILOG`
    :raises ValueError: If an argument or a file is wrong
    :raises OSError: If a file cannot be read or written
    :raises ImportError: If a package is missing
    """
    args = _make_parser().parse_args(_joined(argv))
    from sb3_uav.cli.mission_report import Progress, exit_code, print_plan
    from sb3_uav.missions.fleet_options import FleetOptions
    from sb3_uav.missions.read import read_tasks
    from sb3_uav.missions.search import solve
    from sb3_uav.missions.write import check_folder, checked, write_mission
    from sb3_uav.solvers.base import NoScheduleError

    # What may be missing or wrong is found before the long run, not after it.
    require("rich", "The summary of a mission", "missions")
    require("matplotlib", "The map of a mission", "missions")
    require("plotly", "The map of a mission", "missions")
    if not 0 < args.time_limit < math.inf:
        raise ValueError(f"--time-limit is {args.time_limit:g}; give a number of seconds above 0.")
    flight = flight_of(args)
    check_folder(args.out, args.overwrite)
    tasks = read_tasks(args.tasks, unit=args.unit, depot=args.depot, allow_duplicates=args.allow_duplicates, row=args.row)
    options = FleetOptions(args.fleet, args.uavs, args.range, args.endurance, args.speed, args.reserve)
    fleet = options.fleet(tasks)
    again = ["sb3-uav", "solve", *argv]
    with Progress(args.time_limit) as progress, ends_at_once("sb3-uav solve", progress.end, again):
        try:
            plan = solve(tasks, fleet, args.solver, args.time_limit, args.seed, progress, progress.begin)
        except NoScheduleError as error:
            raise ValueError(f"The solver found no plan: {error}") from error
    files = write_mission(plan, args.out, flight, args.overwrite)
    print_plan(checked(plan, flight), files)
    return exit_code(plan)
