"""A router that was trained before, for training an allocator without ITS."""

from __future__ import annotations

import os
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_uav.common import distributed
from sb3_uav.common.callback_tree import siblings
from sb3_uav.common.files import write_atomically
from sb3_uav.common.random_state import undisturbed_random_state
from sb3_uav.envs.allocation import AllocationProblem
from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.pretrained import router_file
from sb3_uav.training.fixed_set_returns import evaluated_problem
from sb3_uav.training.its import ROUTER_FILE, ITSCallback
from sb3_uav.training.router_handover import hand_over_router
from sb3_uav.training.run_folder import find_run_folder


class PretrainedRouterCallback(BaseCallback):
    """
    Computes the rewards of the allocator's training with a router that does not learn.

    It is handed to the training environment and to that of SB3's ``EvalCallback``, and copied into the run folder, where
    ``sb3_uav.zoo.enjoy`` finds it. Without this callback or ``ITSCallback``, the UAVs fly to the nearest task. In the YAML of
    a zoo::

        callback:
          - sb3_uav.training.PretrainedRouterCallback: {router: router.zip}

    :param router: Zip of any SB3 algorithm with a ``RouterPolicy``, or the name of a pair such as ``"universal"``
    :param save_path: Folder of the copy; the run folder when None
    :param verbose: Verbosity level: 0 for no output
    :raises FileNotFoundError: If there is no such zip
    """

    def __init__(
        self, router: str | os.PathLike[str], save_path: str | os.PathLike[str] | None = None, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.router = router_file(router)
        self.save_path = None if save_path is None else Path(save_path)

    def _on_training_start(self) -> None:
        if siblings(self, ITSCallback):
            raise ValueError("PretrainedRouterCallback and ITSCallback both provide a router; use one of them.")
        if not isinstance(evaluated_problem(self.training_env), AllocationProblem):
            raise ValueError(f"PretrainedRouterCallback needs a TaskAllocation environment, found {self.training_env}.")
        with undisturbed_random_state():
            router = load_policy(self.router, self.model.device, RouterPolicy)
        hand_over_router(self, router.plan)
        folder = distributed.on_main(lambda: self.save_path or find_run_folder(self))
        if folder is not None and distributed.is_main():
            write_atomically(folder / ROUTER_FILE, self.router.read_bytes())

    def _on_step(self) -> bool:
        return True
