from sb3_uav.training.episode_buffer import EpisodeBufferCallback, EpisodeRolloutBuffer, MaskableEpisodeRolloutBuffer
from sb3_uav.training.freezing import Freezer
from sb3_uav.training.its import ITSCallback

__all__ = ["EpisodeBufferCallback", "EpisodeRolloutBuffer", "Freezer", "ITSCallback", "MaskableEpisodeRolloutBuffer"]
