from sb3_uav.training.size_grid import SizeGridCallback
from sb3_uav.training.freezing import Freezer
from sb3_uav.training.its import ITSCallback

__all__ = ["SizeGridCallback", "Freezer", "ITSCallback"]
