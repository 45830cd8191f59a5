from sb3_uav.policies.allocator import AllocatorExtractor, AllocatorPolicy
from sb3_uav.policies.base import EpisodicPolicy
from sb3_uav.policies.masked_attention import MaskedAttentionExtractor, MaskedAttentionPolicy
from sb3_uav.policies.router import RouterExtractor, RouterPolicy

__all__ = [
    "AllocatorExtractor",
    "AllocatorPolicy",
    "EpisodicPolicy",
    "MaskedAttentionExtractor",
    "MaskedAttentionPolicy",
    "RouterExtractor",
    "RouterPolicy",
]
