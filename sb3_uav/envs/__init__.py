from sb3_uav.envs.allocation import AllocationProblem, TaskAllocationEnv, plan_tours, schedules, split_tasks
from sb3_uav.envs.generators import ClusteredGenerator, FixedGenerator, InstanceGenerator, MixtureGenerator, UniformGenerator
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.routing import RoutePlanningEnv, Router, RoutingProblem, collected_value, nearest_feasible
from sb3_uav.envs.schedule import InfeasibleScheduleError, Schedule, ScheduleReport, check_schedule
from sb3_uav.envs.vec_env import BatchedVecEnv
from sb3_uav.envs.world import WorldGenerator

__all__ = [
    "AllocationProblem",
    "BatchedVecEnv",
    "ClusteredGenerator",
    "FixedGenerator",
    "InfeasibleScheduleError",
    "InstanceGenerator",
    "Instances",
    "MixtureGenerator",
    "RoutePlanningEnv",
    "Router",
    "RoutingProblem",
    "Schedule",
    "ScheduleReport",
    "TaskAllocationEnv",
    "UniformGenerator",
    "WorldGenerator",
    "check_schedule",
    "collected_value",
    "nearest_feasible",
    "plan_tours",
    "schedules",
    "split_tasks",
]
