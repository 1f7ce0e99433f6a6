"""The environment as a `gymnasium.vector.VectorEnv`, for trainers with this interface; needs the extra `gymnasium`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    message = f"{error.name} is not installed: pip install gymnasium, or nermo-mjx with its extra gymnasium."
    raise ModuleNotFoundError(message, name=error.name) from None

from nermo_mjx.learn.environment import SENTENCES, Environment, State
from nermo_mjx.robot.quantity import ParameterError

__all__ = ["NermoVectorEnv"]


class NermoVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of worlds on MuJoCo's C engine.

    A world whose episode has ended begins the next one in the same step (`AutoresetMode.SAME_STEP`): `infos["final_obs"]`
    contains the last observation, and `infos["final_info"]` describes the episode: `status` (its sentence), `distance`
    [m], `duration` [s], `servo_work` [J], `unsolved` (see `State.episode`), and each term of the reward of the last step.
    In every step, `infos` contains the terms, and `privileged`, the additional input of a critic.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, environment: Environment | None = None, **options: Any) -> None:
        """
        Args:
            environment: Environment on the engine `c`.
            options: Arguments of an environment, if none is given.

        Raises:
            ValueError: The environment uses another engine.
        """
        self.environment = Environment(**options) if environment is None else environment
        if self.environment.engine != "c":
            raise ValueError(
                f"engine is {self.environment.engine!r}: Gymnasium's form runs on 'c'."
            )
        self.num_envs = self.environment.worlds
        bound = np.full(self.environment.observation_size, np.inf, np.float32)
        ones = np.ones(self.environment.action_size, np.float32)
        self.single_observation_space = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)
        self.single_action_space = gymnasium.spaces.Box(-ones, ones, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._state: State | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in all worlds; without a seed the episodes differ each time.

        Args:
            seed: Number from 0 to 2^64 - 1 for all worlds, or one for each world, whose episodes depend only on this
                number; a world with None gets a random one.
            options: Must be empty.

        Raises:
            ParameterError: A seed is out of range, the number of seeds is wrong, or there are options, such as a mask
                of the worlds to reset.
        """
        if options:
            raise ParameterError(
                f"options has {', '.join(options)}: none are known, and all worlds are reset."
            )
        seeds_given: Any = seed.tolist() if isinstance(seed, np.ndarray) else seed
        seeds = list(seeds_given) if isinstance(seeds_given, (list, tuple)) else [seeds_given]
        for world_seed in seeds:
            if world_seed is not None and (
                not isinstance(world_seed, (int, np.integer)) or not 0 <= world_seed < 1 << 64
            ):
                raise ParameterError(
                    f"seed is {world_seed!r}: allowed is a whole number from 0 to 2^64 - 1."
                )
        first = next((world_seed for world_seed in seeds if world_seed is not None), None)
        super().reset(seed=None if first is None else int(first))
        # The generator of Gymnasium determines the episodes, so that a seed makes all later episodes repeatable.
        keys = [
            int(self.np_random.integers(1 << 31)) if world_seed is None else world_seed
            for world_seed in seeds
        ]
        self._state = self.environment.reset(
            keys if isinstance(seeds_given, (list, tuple)) else keys[0]
        )
        return np.asarray(self._state.observation), {"privileged": self._state.privileged}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate one control step of all worlds under the actions (n, a)."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step was called before reset.")
        state = self._state = self.environment.step(self._state, actions)
        infos: dict[str, Any] = {"privileged": state.privileged, **state.terms}
        is_ended = state.terminated | state.truncated
        if is_ended.any():
            info = {
                **state.episode,
                **state.terms,
                "status": np.array(SENTENCES)[np.asarray(state.status)],
            }
            final = {
                name: np.where(is_ended, column, np.zeros_like(column))
                for name, column in info.items()
            }
            final |= {f"_{name}": is_ended for name in info}
            rows = np.empty(self.num_envs, object)
            for world in np.flatnonzero(is_ended):
                rows[world] = state.final_observation[world]
            infos |= {
                "final_obs": rows,
                "_final_obs": is_ended,
                "final_info": final,
                "_final_info": is_ended,
            }
        reward = np.asarray(state.reward, np.float64)
        return (
            np.asarray(state.observation),
            reward,
            np.asarray(state.terminated),
            np.asarray(state.truncated),
            infos,
        )
