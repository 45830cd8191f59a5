"""
Makes stock rl_zoo3 step all rows of our environments at once: name this module in ``--gym-packages``.

``python -m rl_zoo3.train --algo ppo --env RoutePlanning-N20-v0 --gym-packages sb3_uav.zoo.batched --conf-file ppo.yml``

It registers the environment ids, as ``sb3_uav`` does, and replaces ``DummyVecEnv``, rl_zoo3's default, with
:func:`~sb3_uav.zoo.experiment.make_batched_vec_env`; ``--vec-env`` then has no effect. ``sb3-uav train`` needs no such flag.
"""

from sb3_uav.zoo.experiment import make_batched_vec_env
from sb3_uav.zoo.rl_zoo3_compat import set_default_vec_env

set_default_vec_env(make_batched_vec_env)
