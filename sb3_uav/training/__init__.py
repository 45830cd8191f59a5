from sb3_uav.training.fixed_set import FixedSetCallback
from sb3_uav.training.freezing import Freezer
from sb3_uav.training.its import ITSCallback

__all__ = ["FixedSetCallback", "Freezer", "ITSCallback"]
