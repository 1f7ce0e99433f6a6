"""The environment as a `VecEnv` of Stable-Baselines3, for its trainers and the trainers of sbx, which you install."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    message = f"{error.name} is not installed: pip install stable-baselines3 gymnasium."
    raise ModuleNotFoundError(message, name=error.name) from None

from nermo_mjx.learn.environment import Environment
from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

__all__ = ["NermoVecEnv"]


class NermoVecEnv(VecEnv):
    """A batch of worlds on MuJoCo's C engine, with the interface of Stable-Baselines3, which is older than Gymnasium's.

    A world whose episode has ended begins the next one in the same step. Its info then contains the last observation
    (`terminal_observation`), whether the episode was cut off (`TimeLimit.truncated`), its return, length in control
    steps and time (`r`, `l`, `t` in `episode`), and the entries of `NermoVectorEnv`: `status`, `distance`, `duration`,
    `servo_work`, `unsolved`, and each term of the reward of the last step. In other steps the infos are empty.
    """

    def __init__(self, environment: Environment | None = None, **options: Any) -> None:
        """
        Args:
            environment: Environment on the engine `c`.
            options: Arguments of an environment, if none is given.

        Raises:
            ValueError: The environment uses another engine.
        """
        self.door = NermoVectorEnv(environment, **options)
        self.environment, self.render_mode = self.door.environment, None
        self._began = time.monotonic()
        self._returns = np.zeros(self.door.num_envs)
        self._lengths = np.zeros(self.door.num_envs, int)
        super().__init__(
            self.door.num_envs, self.door.single_observation_space, self.door.single_action_space
        )

    def reset(self) -> np.ndarray:
        """Begin an episode in all worlds; the seed of `seed()` applies to one call."""
        observation, _ = self.door.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (n, a) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Simulate one control step of all worlds under the stored actions."""
        observation, reward, terminated, truncated, info = self.door.step(self._actions)
        self._returns += reward
        self._lengths += 1
        is_ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(is_ended):
            episode = {
                "r": float(self._returns[world]),
                "l": int(self._lengths[world]),
                "t": time.monotonic() - self._began,
            }
            final = {
                name: column[world]
                for name, column in info["final_info"].items()
                if not name.startswith("_")
            }
            infos[world] = final | {
                "terminal_observation": info["final_obs"][world],
                "episode": episode,
                "TimeLimit.truncated": bool(truncated[world] and not terminated[world]),
            }
        self._returns[is_ended], self._lengths[is_ended] = 0.0, 0
        return observation, reward.astype(np.float32), is_ended, infos

    def close(self) -> None:
        """Do nothing, because the environment has no resources to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The value of an attribute of the environment for each world; all worlds share it."""
        shared = (
            getattr(self, attr_name)
            if attr_name == "render_mode"
            else getattr(self.door, attr_name)
        )
        return [shared] * len(self._world_indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an error: worlds differ only in the sampled parameters of their episodes."""
        raise NotImplementedError(
            f"{attr_name} cannot be set: worlds share one environment, see `Task`."
        )

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **options: Any
    ) -> list[Any]:
        """Raise an error: worlds are not separate objects."""
        raise NotImplementedError(f"{method_name} cannot be called: worlds share one environment.")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No world is wrapped; `VecMonitor` and similar wrap all of them."""
        return [False] * len(self._world_indices(indices))

    def _world_indices(self, indices: int | Sequence[int] | None) -> Sequence[int]:
        return (
            range(self.num_envs)
            if indices is None
            else [indices]
            if isinstance(indices, int)
            else indices
        )
