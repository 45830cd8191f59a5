"""
DL-DRL task scheduling of UAV fleets for Stable-Baselines3.

Importing it registers the environment ids, and says what loads the trained routers that environments name; nothing else.
"""

from pathlib import Path

from sb3_uav.common.imports import offer
from sb3_uav.registration import register_envs

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

register_envs()
offer("load_router", "sb3_uav.pretrained.routers.load_router")
