from sb3_uav.training.freezing import Freezer
from sb3_uav.training.its import ITSCallback

__all__ = ["Freezer", "ITSCallback"]
