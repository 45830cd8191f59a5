"""``sb3-uav load-from-hub`` or ``python -m sb3_uav.zoo.load_from_hub``: an agent of the Hugging Face Hub with its router."""

from __future__ import annotations

import argparse
import shutil
import sys
import zipfile
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import sb3_uav  # noqa: F401  (registers the environment ids)
from sb3_uav.common.errors import main_function
from sb3_uav.common.files import write_atomically
from sb3_uav.zoo.dependencies import require_zoo
from sb3_uav.zoo.push_to_hub import METRICS_FILE, METRICS_PATTERNS, VEC_NORMALIZE_FILE

_PROG = "sb3-uav load-from-hub"


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_PROG,
        description="Download an agent, for an allocator together with its router, into a log folder, where `sb3-uav enjoy` "
        "and `record-video` find it. Nothing is unpickled, by those commands neither unless --trust is given.",
    )
    parser.add_argument("--env", required=True, help="environment ID")
    parser.add_argument("--algo", default="reinforce", help="default: %(default)s")
    parser.add_argument("-f", "--folder", default="logs", help="log folder (default: %(default)s)")
    parser.add_argument("-orga", "--organization", metavar="NAME", help="owner of the repository")
    parser.add_argument("-name", "--repo-name", metavar="NAME", help="name of the repository (default: ALGO-ENV)")
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run; 0 for a new one (default: %(default)s)")
    parser.add_argument("--force", action="store_true", help="replace a run that exists")
    parser.add_argument("--local-dir", type=Path, metavar="DIR", help="read a repository in this folder, not on the Hub")
    return parser


def load_from_hub(arguments: Sequence[str]) -> None:
    """
    Load an agent into a log folder.

    :param arguments: Command line arguments
    :raises ValueError: If an argument is wrong, or a file of the repository is missing or damaged
    :raises OSError: If a file cannot be read or written, or the Hub cannot be reached
    :raises ImportError: If a package that this needs is not installed
    """
    args = _make_parser().parse_args(arguments)
    require_zoo("Loading from the Hugging Face Hub", "huggingface_hub")
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import get_latest_run_id

    from sb3_uav.zoo.hub import download, list_files, repository_id
    from sb3_uav.zoo.trust import note_download

    if (args.organization is None) == (args.local_dir is None):
        raise ValueError("give either --organization, the owner of the repository, or --local-dir.")
    env_name = EnvironmentName(args.env)
    if args.local_dir is not None:
        source, names = str(args.local_dir), {path.name for path in args.local_dir.iterdir()}
        fetch: Callable[[str], Path] = args.local_dir.joinpath
    else:
        source = repository_id(args.organization, args.repo_name, args.algo, args.env)
        names, fetch = list_files(source), partial(download, source)
    runs = Path(args.folder) / args.algo
    number = args.exp_id or get_latest_run_id(str(runs), env_name) + 1
    run = runs / f"{env_name}_{number}"
    if run.exists() and not args.force:
        raise ValueError(f"{run} exists; replace it with --force, or leave --exp-id out for a new run.")
    new = run.with_name(f".{run.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    try:
        _write_run(new, args.algo, env_name, source, names, fetch)
        note_download(new, source)
        shutil.rmtree(run, ignore_errors=True)
        new.rename(run)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    print(f"Loaded {source} into {run}. `sb3-uav enjoy` and `sb3-uav evaluate` find it there.")


def _write_run(run: Path, algo: str, env_name: str, source: str, names: set[str], fetch: Callable[[str], Path]) -> None:
    """
    :param run: The run folder to write
    :param algo: rl_zoo3's name of the algorithm
    :param env_name: rl_zoo3's name of the environment
    :param source: The repository, for errors
    :param names: Names of its files
    :param fetch: Gets a file by its name
    """
    import yaml

    from sb3_uav.zoo.saved import read_saved

    settings = run / env_name
    settings.mkdir(parents=True)
    zips = {f"{algo}-{env_name}.zip": run / f"{env_name}.zip", "router.zip": run / "router.zip"}
    required = {*list(zips)[:1], "config.yml", "args.yml"}
    if not required <= names:
        raise ValueError(f"{source}: {', '.join(sorted(required - names))} is missing; choose another --algo or --env.")
    for name, path in zips.items():
        if name in names:
            shutil.copy(fetch(name), path)
            if not zipfile.is_zipfile(path):
                raise ValueError(f"{source}: {name} is not a zip; it is damaged.")
    for name in ("config.yml", "args.yml", "env_kwargs.yml"):
        if name in names:
            # Written anew, because rl_zoo3 reads these files with a loader that creates any object they name.
            write_atomically(settings / name, yaml.safe_dump(read_saved(fetch(name))))
    if VEC_NORMALIZE_FILE in names:
        shutil.copy(fetch(VEC_NORMALIZE_FILE), settings / "vecnormalize.pkl")
    if METRICS_FILE in names:
        try:
            with zipfile.ZipFile(fetch(METRICS_FILE)) as archive:
                for name in archive.namelist():
                    # No paths, which might lead out of the folder.
                    if "/" not in name and "\\" not in name and any(fnmatch(name, pattern) for pattern in METRICS_PATTERNS):
                        write_atomically(run / name, archive.read(name))
        except zipfile.BadZipFile as error:
            raise ValueError(f"{source}: {METRICS_FILE} is not a zip ({error}); it is damaged.") from error


# For ``python -m sb3_uav.zoo.load_from_hub``, with exit codes in place of exceptions.
main = main_function(_PROG, load_from_hub)

if __name__ == "__main__":
    sys.exit(main())
