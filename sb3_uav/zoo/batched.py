"""
Makes stock rl_zoo3 step all rows of our environments at once: name this module in ``--gym-packages``.

``python -m rl_zoo3.train --algo ppo --env RoutePlanning-N20-v0 --gym-packages sb3_uav.zoo.batched --conf-file ppo.yml``

It registers the environment ids, as ``sb3_uav`` does, and replaces ``DummyVecEnv``, rl_zoo3's default, by
:func:`~sb3_uav.zoo.experiment.make_batched_vec_env`; ``--vec-env`` has no effect then. ``python -m sb3_uav.zoo.train`` does
the same by itself.
"""

from rl_zoo3.exp_manager import ExperimentManager

from sb3_uav.zoo.experiment import make_batched_vec_env

# A plain function would become a method of the class that it is set on.
ExperimentManager.default_vec_env_cls = staticmethod(make_batched_vec_env)  # type: ignore[assignment]
