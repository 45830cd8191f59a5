"""
``python scripts/release.py``: small zips of a trained pair, to be shipped.

Without the state of the optimizers, the last observations, and what tells of the machine. SB3 loads them as it loads others.
"""

from __future__ import annotations

import argparse
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_uav.common.saving import save_atomically
from sb3_uav.pretrained import ALLOCATOR_FILE, ROUTER_FILE
from sb3_uav.reinforce.algorithms import ALGORITHMS, resolve_algorithm
from sb3_uav.training.fixed_set import EVALUATIONS
from sb3_uav.training.its_checkpoint import CHECKPOINT

# Attributes that only the training that wrote them needs.
LEFT_OUT = (
    CHECKPOINT,
    EVALUATIONS,
    "tensorboard_log",
    "_last_obs",
    "_last_episode_starts",
    "_last_original_obs",
    "ep_info_buffer",
    "ep_success_buffer",
    "start_time",
)
SYSTEM_INFO = "system_info.txt"


def release(algorithm: type[OnPolicyAlgorithm], source: Path, target: Path) -> None:
    """
    :param algorithm: Class of the algorithm that was saved
    :param source: Its zip, which must be your own: SB3 unpickles parts of it
    :param target: The small one
    :raises FileNotFoundError: If there is no such zip
    :raises OSError: If the small one cannot be written
    """
    if not source.is_file():
        raise FileNotFoundError(f"{source}: no such file; give the zip of a trained allocator or router.")
    model = algorithm.load(source, device="cpu")
    model.policy.optimizer.state.clear()
    whole = target.with_name(f"{target.stem}.whole.zip")
    small = target.with_name(f"{target.stem}.small.zip")
    try:
        save_atomically(model, whole, exclude=LEFT_OUT)
        with zipfile.ZipFile(whole) as archive, zipfile.ZipFile(small, "w", zipfile.ZIP_DEFLATED) as compressed:
            for name in archive.namelist():
                if name != SYSTEM_INFO:
                    # A fixed date, so that the same networks make the same file.
                    compressed.writestr(zipfile.ZipInfo(name), archive.read(name), zipfile.ZIP_DEFLATED)
        os.replace(small, target)
    finally:
        for file in (whole, small):
            file.unlink(missing_ok=True)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Arguments; those of the process when None
    :return: Exit code 0
    :raises OSError: If a file is missing or cannot be written
    """
    parser = argparse.ArgumentParser(prog="python scripts/release.py", description=__doc__)
    parser.add_argument("--allocator", type=Path, required=True, metavar="ZIP", help="zip of the trained allocator")
    parser.add_argument("--router", type=Path, required=True, metavar="ZIP", help="zip of the trained router")
    parser.add_argument("--algo", choices=sorted(ALGORITHMS), default="reinforce", help="of both (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where to write both")
    args = parser.parse_args(argv)
    for source, name in ((args.allocator, ALLOCATOR_FILE), (args.router, ROUTER_FILE)):
        release(resolve_algorithm(args.algo), source, args.out / name)
        print(f"{args.out / name}: {(args.out / name).stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    main()
