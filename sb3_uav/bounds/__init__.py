"""How good any plan can be: upper bounds of the total value."""

from sb3_uav.bounds.bound import Bound, upper_bound, warm_up

__all__ = ["Bound", "upper_bound", "warm_up"]
