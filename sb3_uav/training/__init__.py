from sb3_uav.policies.freezing import Freezer
from sb3_uav.training.episode_buffer import EpisodeBufferCallback, EpisodeRolloutBuffer, MaskableEpisodeRolloutBuffer
from sb3_uav.training.fixed_set import FixedSetEvalCallback
from sb3_uav.training.its import ITSCallback
from sb3_uav.training.pretrained_router import PretrainedRouterCallback
from sb3_uav.training.size_grid import SizeGridCallback
from sb3_uav.training.stop_at_divergence import StopAtDivergence

__all__ = [
    "EpisodeBufferCallback",
    "EpisodeRolloutBuffer",
    "FixedSetEvalCallback",
    "Freezer",
    "ITSCallback",
    "MaskableEpisodeRolloutBuffer",
    "PretrainedRouterCallback",
    "SizeGridCallback",
    "StopAtDivergence",
]
