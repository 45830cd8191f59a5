"""
How long `-n 4000` takes with every shipped entry, through our front end and, where it can, through stock rl_zoo3.

    python benchmarks/short_runs.py --out short_runs.csv
    python benchmarks/short_runs.py --out short_runs.csv --match U4-N80 --front-ends sb3_uav.zoo.train

Rerun an interrupted call to resume it.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

CONFIGS = Path(__file__).parents[1] / "zoo_configs"
# Stock rl_zoo3 knows these algorithms only.
STOCK = ("ppo", "a2c")
FRONT_ENDS = ("sb3_uav.zoo.train", "rl_zoo3.train")
COLUMNS = ("front_end", "file", "env", "exit_code", "wall_seconds", "cpu_seconds")


def run(front_end: str, config: Path, env_id: str, n_steps: int) -> tuple[int, float, float]:
    """
    :param front_end: Module of the command
    :param config: The YAML
    :param env_id: Name of the entry
    :param n_steps: Value of ``-n``
    :return: Exit code, wall seconds and CPU seconds
    """
    algo = "reinforce" if config.stem == "paper" else config.stem
    with tempfile.TemporaryDirectory() as folder:
        flags = [
            "--algo",
            algo,
            "--env",
            env_id,
            "--conf-file",
            str(config),
            "-n",
            str(n_steps),
            "-f",
            folder,
            "--device",
            "cpu",
        ]
        if front_end != FRONT_ENDS[0] and env_id != "CartPole-v1":
            flags += ["--gym-packages", "sb3_uav.zoo.batched"]
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run([sys.executable, "-m", front_end, *flags], capture_output=True, text=True, env=dict(os.environ))
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        print(done.stderr.strip().splitlines()[-1], file=sys.stderr)
    return done.returncode, wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="CSV")
    parser.add_argument("--match", default="", help="only entries whose name contains this")
    parser.add_argument("--front-ends", nargs="+", choices=FRONT_ENDS, default=FRONT_ENDS)
    parser.add_argument("-n", "--n-timesteps", type=int, default=4000, help="default: %(default)s")
    args = parser.parse_args()
    rows = list(csv.DictReader(args.out.open())) if args.out.is_file() else []
    known = {tuple(row[column] for column in COLUMNS[:3]) for row in rows}
    with args.out.open("a", newline="") as file:
        writer = csv.writer(file)
        if not rows:
            writer.writerow(COLUMNS)
        for config in sorted(CONFIGS.glob("*.yml")):
            names = [name for name in yaml.safe_load(config.read_text()) if name.endswith("-v0") or name.endswith("-v1")]
            for name in (name for name in names if args.match in name):
                for front_end in args.front_ends:
                    if (front_end == FRONT_ENDS[0] or config.stem in STOCK) and (front_end, config.name, name) not in known:
                        code, wall, cpu = run(front_end, config, name, args.n_timesteps)
                        print(f"{front_end} {config.name} {name}: exit code {code}, {wall:.0f} s, {cpu:.0f} CPU s", flush=True)
                        writer.writerow([front_end, config.name, name, code, f"{wall:.1f}", f"{cpu:.1f}"])
                        file.flush()


if __name__ == "__main__":
    main()
