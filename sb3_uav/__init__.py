"""DL-DRL task scheduling of UAV fleets for Stable-Baselines3. Importing it registers the environment ids, and nothing else."""

from pathlib import Path

from sb3_uav.registration import register_envs

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

register_envs()
