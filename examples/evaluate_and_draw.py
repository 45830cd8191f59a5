"""
Evaluates a trained pair on new instances against K-means with nearest-task tours, checks all schedules and draws one.

``python its_ppo.py`` writes the two zips; those of ``sb3-uav train`` work too. Needs the extra ``plots``.
"""

import argparse
from pathlib import Path

import numpy as np

from sb3_uav.envs import UniformGenerator, check_schedule
from sb3_uav.plots.schedule_map import MapPanel, plot_schedules
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers import DLDRL, Solver, make_solver

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--allocator", type=Path, default=Path("pair/allocator.zip"), help="default: %(default)s")
parser.add_argument("--router", type=Path, default=Path("pair/router.zip"), help="default: %(default)s")
parser.add_argument("--n-instances", type=int, default=100, help="default: %(default)s")
parser.add_argument("--out", type=Path, default=Path("schedule.png"), help="default: %(default)s")
args = parser.parse_args()

# Zips are read without unpickling, so it is safe to load those of other people.
allocator = load_policy(args.allocator, expected=AllocatorPolicy)
router = load_policy(args.router, expected=RouterPolicy)
instances = UniformGenerator(20, n_uavs=3, max_distance=1.5)(args.n_instances, np.random.default_rng(7))

solvers: list[Solver] = [
    DLDRL(allocator, router),
    DLDRL(allocator, router, "sampling", samples=64),
    make_solver("kmeans-nearest"),
]
panels = []
for solver in solvers:
    schedules = [result.schedule for result in solver.solve(instances, seed=0)]
    # Raises InfeasibleScheduleError if a tour is too long or a task is visited twice.
    reports = [check_schedule(instances, row, schedule) for row, schedule in enumerate(schedules)]
    objective = np.mean([report.objective for report in reports])
    print(f"{solver.name}: {objective:.2f} tasks, tours of {np.mean([report.lengths for report in reports]):.2f} on average")
    panels.append(MapPanel(instances, 0, schedules[0], f"{solver.name}: {schedules[0].n_visited} tasks"))
plot_schedules(panels, args.out)
print(f"Drew the first instance into {args.out}")
