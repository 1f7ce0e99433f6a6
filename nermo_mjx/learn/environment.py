"""The robot as an environment to learn in: `reset(key)` and `step(state, action)` over a batch of worlds."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.learn.acting import Acting
from nermo_mjx.learn.loop import EpisodeLoop
from nermo_mjx.learn.task import Episodes, Outcome, Task
from nermo_mjx.learn.worlds import CWorlds, MjxWorlds, State, Worlds
from nermo_mjx.physics import resolve_engine
from nermo_mjx.physics.c_engine import Threads
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.loop import check_controller
from nermo_mjx.rollout.setup import Setup

#: The sentences of `State.status`, by code.
SENTENCES = tuple(outcome.value for outcome in Outcome)


class Environment:
    """A batch of worlds in which a policy drives the robot.

    >>> environment = Environment(worlds=2, task=Task(duration=0.05))
    >>> state = environment.reset(0)
    >>> state = environment.step(state, np.zeros((2, environment.action_size)))
    >>> state.observation.shape == (2, environment.observation_size), environment.step_seconds
    (True, 0.01)

    On the engine `mjx`, `reset` and `step` are pure functions of arrays, for `jax.jit`, `jax.vmap`, `jax.lax.scan` and
    `jax.grad`, whose derivatives are those of `physics.step`. On `c` they are calls of this machine's processors, the
    state is NumPy's, and only the latest one can be stepped on. Equal keys and actions give equal numbers, on `c` bit
    for bit, whatever the number of threads.
    """

    def __init__(
        self,
        setup: Setup | None = None,
        *,
        engine: str = "c",
        worlds: int = 128,
        task: Task | None = None,
        seed: int = 0,
        staggered: bool = False,
        threads: Threads = None,
    ) -> None:
        """
        Args:
            setup: what is chosen by name: robot, scene, gait, pilot, physics.
            engine: `c`, `mjx`, or `auto`.
            worlds: how many.
            task: what the policy does there.
            seed: for `reset()` without a key.
            staggered: after `reset`, the time of each world's first episode is over after a random share of the
                task's duration, so that episodes do not end together in all worlds.
            threads: processors that `c` uses, or a pool that several environments share; None for
                `$NERMO_MJX_THREADS`, or all of them.

        Raises:
            ParameterError: an unknown engine or one that cannot be driven, no world, or a task that does not fit.
        """
        name = resolve_engine(engine)
        if name not in ("c", "mjx"):
            raise ParameterError(f"engine is {engine!r}: an environment runs on c or mjx.")
        if not (isinstance(worlds, int) and worlds >= 1):
            raise ParameterError(f"worlds is {worlds!r}: allowed is a whole number from 1 on.")
        self.setup, self.task, self.worlds, self.seed = setup or Setup(), task or Task(), worlds, seed
        self.task.check(self.setup)
        self.robot = self.setup.load()
        self.controller = Acting(self.setup.make_controller(), self.task.action)
        check_controller(self.robot, self.controller)
        self.episodes = Episodes(self.setup, self.robot, self.controller, self.task)
        self.loop = EpisodeLoop(self.robot, self.controller, self.task, self.episodes.drawn)
        self.engine = name
        shared = self.loop, self.episodes, worlds, staggered
        self._worlds: Worlds = CWorlds(*shared, threads) if name == "c" else MjxWorlds(*shared)

    @property
    def pure(self) -> bool:
        """Whether `reset` and `step` are pure functions, which can be traced."""
        return isinstance(self._worlds, MjxWorlds)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Labels of all values that a policy observes, such as `gyro.x`."""
        return self.loop.observation_names

    @property
    def privileged_names(self) -> tuple[str, ...]:
        """Labels of all values that a critic receives."""
        return self.loop.privileged_names

    @property
    def action_names(self) -> tuple[str, ...]:
        """Labels of all values of an action."""
        return self.task.action.names

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return len(self.observation_names)

    @property
    def privileged_size(self) -> int:
        """Length of a critic's input."""
        return len(self.privileged_names)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return len(self.action_names)

    @property
    def step_seconds(self) -> float:
        """Simulated seconds of a control step."""
        return self.controller.dt * self.task.decimation

    def reset(self, key: Any = None) -> State:
        """Begin an episode in every world.

        Args:
            key: a `jax.random.key`, a raw key (2,), or a whole number; the environment's seed by default.
        """
        return self._worlds.reset(_raw_key(self.seed if key is None else key))

    def step(self, state: State, action: Any) -> State:
        """One control step of all worlds.

        Args:
            state: the last one.
            action: (n, a), clipped to [-1, 1].

        Raises:
            ParameterError: an action of another shape; on `c` also one that is not finite, or an old state.
        """
        if np.shape(action) != (self.worlds, self.action_size):
            raise ParameterError(
                f"action has shape {np.shape(action)}: expected {(self.worlds, self.action_size)}, a row per world."
            )
        return self._worlds.step(state, action)


def _raw_key(key: Any) -> Any:
    """A key as JAX keeps it, (2,) uint32."""
    if isinstance(key, (int, np.integer)):
        return jax.random.key_data(jax.random.key(int(key)))
    array = jnp.asarray(key)
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(array)
    return array if array.ndim else jax.random.key_data(jax.random.key(array))  # a traced whole number
