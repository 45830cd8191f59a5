"""The Gymnasium environment of a problem: a batch of one, with numpy at the edges."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_uav.envs.episodes import Episodes, given_instance
from sb3_uav.envs.instances import Instances
from sb3_uav.envs.problem import Problem


class ProblemEnv(gym.Env[Any, Any]):
    """
    One episode of a problem at a time.

    ``reset(options={"instance": instances[i]})`` plays a given instance. The legal actions are available in the observation
    (``action_mask``) and from :meth:`action_masks`. An illegal action does not raise an error: it is counted in
    ``info["illegal_actions"]``, and the dynamics define its effect. The last ``info`` of an episode holds its return
    (``objective``) and ``is_success``: whether every task that can count is visited (:meth:`Problem.successes`).

    :param problem: The problem
    :param render_mode: ``"human"``, ``"rgb_array"`` or None
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  (as declared by gymnasium)
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(self, problem: Problem, render_mode: str | None = None) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; choose one of {self.metadata['render_modes']} or None.")
        self.problem = problem
        self.observation_space = problem.observation_space
        self.action_space = problem.action_space
        self.render_mode = render_mode
        self.episodes = Episodes(problem, 1)
        self._figure: Any = None
        self._return = 0.0
        self._n_illegal = 0

    def set_generator(self, generator: Any) -> None:
        """
        Draw the instances of the next episodes from another source of the same size.

        :raises ValueError: If its instances do not fit the observation space
        """
        self.problem.set_generator(generator)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.episodes.rngs[0] = self.np_random
        given = given_instance(options)
        self.episodes.reset(given=None if given is None else {0: given})
        self._return, self._n_illegal = 0.0, 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        result = self.episodes.step(np.array([action]))
        reward, terminated = float(result.rewards[0]), bool(result.dones[0])
        self._return += reward
        self._n_illegal += int(result.illegal[0])
        info: dict[str, Any] = {"illegal_actions": self._n_illegal}
        if terminated:
            info["objective"] = self._return
            successes = self.problem.successes(self.instance, th.tensor([[self._return]], dtype=th.float64, device="cpu"))
            if successes is not None:
                info["is_success"] = bool(successes)
        if self.render_mode == "human":
            self.render()
        return self._observation(), reward, terminated, False, info

    def _observation(self) -> dict[str, np.ndarray]:
        return {key: value[0] for key, value in self.episodes.observation().items()}

    def action_masks(self) -> np.ndarray:
        """``(n_actions,)`` bool, True where an action is legal (the protocol of sb3-contrib's ``MaskablePPO``)."""
        return self.episodes.action_masks()[0]

    @property
    def instance(self) -> Instances:
        """The instance of the running episode, a batch of one."""
        return self.episodes.instances

    def render(self) -> np.ndarray | None:
        """
        Draw the map of the running episode.

        :return: ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``, else None
        """
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode; make the environment with render_mode='rgb_array'.")
            return None
        from sb3_uav.envs.render import MapFigure

        if self._figure is None:
            self._figure = MapFigure(interactive=self.render_mode == "human")
        self._figure.draw(self.episodes, 0)
        return self._figure.rgb_array() if self.render_mode == "rgb_array" else self._figure.show()

    def close(self) -> None:
        if self._figure is not None:
            self._figure.close()
            self._figure = None
