"""
Fine-tune the pair that comes with the package to another distribution: clustered tasks, which it was not trained on.

Both levels go on learning from its weights by the interactive training strategy. The gain is measured on held-out instances,
the same for the pair as shipped and as fine-tuned.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse
from pathlib import Path

import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from sb3_uav import pretrained
from sb3_uav.common.statistics import confidence_halfwidth
from sb3_uav.envs import BatchedVecEnv, check_schedule
from sb3_uav.envs.generators import ClusteredGenerator
from sb3_uav.solvers import make_solver
from sb3_uav.training import ITSCallback

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--epochs", type=int, default=30, help="default: %(default)s")
parser.add_argument("--learning-rate", type=float, default=1e-4, help="default: %(default)s")
parser.add_argument("--instances-per-epoch", type=int, default=128, help="default: %(default)s")
parser.add_argument("--held-out", type=int, default=512, metavar="N", help="instances to measure on, default: %(default)s")
parser.add_argument("--decode", nargs="+", default=["greedy"], help="greedy and/or sampling, default: greedy")
parser.add_argument("--out", type=Path, default=Path("fine_tuned"), help="folder of the zips, default: %(default)s")
args = parser.parse_args()

env = make_vec_env(
    "TaskAllocation-U4-N80-v0", n_envs=16, seed=1, env_kwargs=dict(distribution="clustered"), vec_env_cls=BatchedVecEnv
)
n = args.instances_per_epoch
model = pretrained.load("universal", env=env, instances_per_epoch=n, learning_rate=args.learning_rate, seed=1)
router = {"pretrained": "universal", "learning_rate": args.learning_rate}
its = ITSCallback(
    router, args.epochs, router_instances_per_epoch=4 * n, strategy="alternate-only", save_path=str(args.out), verbose=1
)
model.learn(args.epochs * n * 8 * 80, callback=its)
model.save(args.out / "allocator.zip")

# Training draws from random streams of its own seed; these instances come from another one.
instances = ClusteredGenerator(80, n_uavs=4)(args.held_out, np.random.default_rng(2_000_000))
tuned = f"allocator={args.out / 'allocator.zip'},router={args.out / 'router.zip'}"
for decode in args.decode:
    objectives = []
    for pair in ("allocator=universal", tuned):
        results = make_solver(f"dl-drl:{pair},decode={decode}").solve(instances)
        objectives.append([check_schedule(instances, row, r.schedule).objective for row, r in enumerate(results)])
    before, after = np.array(objectives)
    gain, margin = (after - before).mean(), float(confidence_halfwidth(after - before))
    print(f"{decode}: {before.mean():.2f} tasks as shipped, {after.mean():.2f} fine-tuned, gain {gain:.2f} +- {margin:.2f}")
