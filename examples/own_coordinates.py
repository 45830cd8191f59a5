"""
Your own coordinates: arrays in meters, scaled for the networks, used for training and planning, and read back in meters.

Training uses variants of the site with slightly moved tasks. Instances may also come from a file
(``instances="tasks.npz"``, written by ``Instances.save``), or from any function of this form.
"""

# SB3 accepts more types than its annotations state.
# mypy: disable-error-code="arg-type"
import argparse

import numpy as np

from sb3_uav.envs import BatchedVecEnv, Instances, RoutePlanningEnv, check_schedule, plan_tours, schedules
from sb3_uav.policies import RouterPolicy
from sb3_uav.reinforce import REINFORCE

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=300_000, help="default: %(default)s")
args = parser.parse_args()

rng = np.random.default_rng(3)
depot_m = np.array([1200.0, 800.0])
tasks_m = rng.uniform([0.0, 0.0], [3000.0, 2000.0], size=(15, 2))
range_m, n_uavs = 5000.0, 2

# Networks expect roughly the unit square; the flight distance is scaled with the coordinates.
scale = 1.0 / 3000.0
site = Instances.from_arrays(depot_m * scale, tasks_m * scale, max_distance=range_m * scale, n_uavs=n_uavs)


class Variants:
    """Draws the site with every task moved by 5 % of its extent, for one UAV."""

    n_tasks, n_uavs = 15, 1

    def __call__(self, batch_size: int, rng: np.random.Generator) -> Instances:
        moved = tasks_m * scale + rng.normal(0.0, 0.05, size=(batch_size, 15, 2))
        depot = np.repeat(depot_m[None] * scale, batch_size, axis=0)
        return Instances.from_arrays(depot, moved, max_distance=range_m * scale, n_uavs=1)


env = BatchedVecEnv([lambda: RoutePlanningEnv(generator=Variants())] * 64)
network = dict(embed_dim=32, n_layers=2, n_heads=4, ff_dim=64)
model = REINFORCE("RouterPolicy", env, n_samples=8, baseline="shared", learning_rate=1e-3, policy_kwargs=network, seed=0)
model.learn(args.timesteps)
assert isinstance(model.policy, RouterPolicy)

# The tasks west of the depot for one UAV, those east of it for the other.
west = (site.tasks[..., 0] < site.depot[:, None, 0]).long()[:, None]
schedule = schedules(plan_tours(site, west, model.policy.plan).tours[:, 0])[0]
report = check_schedule(site, 0, schedule)
for uav, (route, length) in enumerate(zip(schedule.routes, report.lengths, strict=True)):
    stops = " -> ".join(f"({x:.0f}, {y:.0f})" for x, y in tasks_m[list(route)])
    print(f"UAV {uav}, {length / scale:.0f} m of {range_m:.0f} m: {stops}")
print(f"{schedule.n_visited} of {site.n_tasks} tasks visited")
