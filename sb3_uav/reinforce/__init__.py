from sb3_uav.reinforce.reinforce import REINFORCE

__all__ = ["REINFORCE"]
