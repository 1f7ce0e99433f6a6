"""The robot as an environment to learn in: `reset(key)` and `step(state, action)` over a batch of worlds."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.learn.acting import Acting
from nermo_mjx.learn.loop import EpisodeLoop, Observed
from nermo_mjx.learn.task import Episodes, Outcome, Task
from nermo_mjx.physics import Variation, resolve_engine
from nermo_mjx.physics.c_driven import CDriven
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.lanes import Lanes
from nermo_mjx.rollout.loop import check_controller
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.shapes import Array

#: The sentences of `State.status`, by code.
SENTENCES = tuple(outcome.value for outcome in Outcome)


class State(NamedTuple):
    """A batch of n worlds after a control step. Worlds whose episode ended have begun the next one.

    Attributes:
        observation: for the policy (n, o), of the new episode where one ended.
        privileged: for a critic only (n, p).
        reward: of the step (n,).
        terms: name -> value of each term of the reward, in its unit, unweighted (n,).
        terminated: whether the episode failed (n,) bool.
        truncated: whether it was only cut off: its time is over, or its distance walked (n,) bool.
        status: how the episode stood after the step, place in `SENTENCES` (n,) int.
        final_observation, final_privileged: as they were after the step, before new episodes began.
        episode: `distance` [m], `duration` [s] and `servo_work` [J] of the episode that the step belongs to (n,).
        engine: what the engine carries.
    """

    observation: Array
    privileged: Array
    reward: Array
    terms: dict[str, Array]
    terminated: Array
    truncated: Array
    status: Array
    final_observation: Array
    final_privileged: Array
    episode: dict[str, Array]
    engine: Any


class _Worlds(Protocol):
    """The worlds of an environment on one engine."""

    def reset(self, key: Any) -> State: ...

    def step(self, state: State, action: Any) -> State: ...


class Environment:
    """A batch of worlds in which a policy drives the robot.

    >>> environment = Environment(worlds=2, task=Task(duration=0.05))
    >>> state = environment.reset(0)
    >>> state = environment.step(state, np.zeros((2, environment.action_size)))
    >>> state.observation.shape == (2, environment.observation_size), environment.step_seconds
    (True, 0.01)

    On the engine `mjx`, `reset` and `step` are pure functions of arrays, for `jax.jit`, `jax.vmap`, `jax.lax.scan` and
    `jax.grad`, whose derivatives are those of `physics.step`. On `c` they are calls of this machine's processors, the
    state is NumPy's, and only the newest one can be stepped on. Equal keys and actions give equal numbers, on `c` bit
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
        threads: int | None = None,
    ) -> None:
        """
        Args:
            setup: what is chosen by name: robot, scene, gait, pilot, physics.
            engine: `c`, `mjx`, or `auto`.
            worlds: how many.
            task: what the policy does there.
            seed: of `reset()` without a key.
            threads: processors that `c` uses; None for `$NERMO_MJX_THREADS`, or all of them.

        Raises:
            ParameterError: an unknown engine or one that cannot be driven, no world, or a task that does not fit.
        """
        name = resolve_engine(engine)
        if name not in _ENGINES:
            raise ParameterError(f"engine is {engine!r}: an environment runs on {' or '.join(_ENGINES)}.")
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
        self._worlds: _Worlds = _ENGINES[name](self, threads)

    @property
    def pure(self) -> bool:
        """Whether `reset` and `step` are pure functions, which can be traced."""
        return isinstance(self._worlds, _MjxWorlds)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Of every number that a policy observes, such as `gyro.x`."""
        return self.loop.observation_names

    @property
    def privileged_names(self) -> tuple[str, ...]:
        """Of every number that a critic is told."""
        return self.loop.privileged_names

    @property
    def action_names(self) -> tuple[str, ...]:
        """Of every number of an action."""
        return self.task.action.names

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return len(self.observation_names)

    @property
    def privileged_size(self) -> int:
        """Length of what a critic is told."""
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
            action: (n, a), in [-1, 1]; what is beyond counts as the bound.

        Raises:
            ParameterError: an action of another shape; on `c` also one that is not finite, or an old state.
        """
        if np.shape(action) != (self.worlds, self.action_size):
            raise ParameterError(
                f"action has shape {np.shape(action)}: expected {(self.worlds, self.action_size)}, a row a world."
            )
        return self._worlds.step(state, action)


class _CWorlds:
    """Worlds of MuJoCo's C engine. The k-th episode of a world depends on key, world and k alone."""

    def __init__(self, environment: Environment, threads: int | None) -> None:
        self.of = environment
        self.engine = CEngine(environment.robot, environment.loop, threads)
        self.variation = Variation(environment.robot)
        self.session: CDriven | None = None
        self.drawn: dict[int, tuple[Any, dict[str, np.ndarray], np.ndarray]] = {}
        self.newest: object = None

        def draw(key: Array, world: Array, episode: Array) -> Any:
            own = jax.random.fold_in(jax.random.fold_in(jax.random.wrap_key_data(key), world), episode)
            return environment.episodes(own)

        self.draw = Lanes(draw)

    def reset(self, key: np.ndarray) -> State:
        n = self.of.worlds
        self.key, self.count, self.drawn = np.asarray(key), np.zeros(n, int), {}
        params, fields, qpos = self._episode(0, np.arange(n))
        self.session = CDriven(self.engine, params, qpos, fields)
        return self._state(self.session.observe(), None)

    def step(self, state: State, action: Any) -> State:
        if self.session is None or state.engine is not self.newest:
            raise ParameterError("state is not the newest one of this environment: on 'c' worlds cannot go back.")
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():
            raise ParameterError("action has numbers that are not finite.")
        seen = self.session.drive(action, self.of.task.decimation)
        ended = np.flatnonzero(seen.terminated | seen.truncated)
        return self._state(seen, self._anew(ended) if len(ended) else None, ended)

    def _anew(self, ended: np.ndarray) -> Observed:
        """What worlds see that begin their next episode."""
        assert self.session is not None
        self.count[ended] += 1
        parts = []
        for k in np.unique(self.count[ended]):
            worlds = ended[self.count[ended] == k]
            parts.append((worlds, self._episode(k, worlds)))
        order = np.argsort(np.concatenate([worlds for worlds, _ in parts]))
        params, fields, qpos = jax.tree.map(
            lambda *leaves: np.concatenate(leaves)[order], *(episode for _, episode in parts)
        )
        first: Observed = self.session.restart(ended, params, qpos, fields)
        return first

    def _episode(self, k: int, worlds: np.ndarray) -> tuple[Any, dict[str, np.ndarray], np.ndarray]:
        """Parameters, model fields and first positions of the k-th episode of some worlds.

        It is drawn for all worlds at once, since that costs hardly more than for one.
        """
        if k not in self.drawn:
            n = self.of.worlds
            keys = np.broadcast_to(self.key, (n, *self.key.shape))
            params, model, qpos = self.draw(keys, np.arange(n), np.full(n, k))
            fields = self.variation.batch(model, n, self.of.episodes.reached)
            self.drawn[k] = params, fields, np.asarray(qpos, float)
            for old in [each for each in self.drawn if each <= self.count.min() and each != k]:
                del self.drawn[old]
        chosen: tuple[Any, dict[str, np.ndarray], np.ndarray] = jax.tree.map(lambda leaf: leaf[worlds], self.drawn[k])
        return chosen

    def _state(self, seen: Observed, first: Observed | None, ended: Any = ()) -> State:
        observation, privileged = seen.observation, seen.privileged
        if first is not None:
            observation, privileged = observation.copy(), privileged.copy()
            observation[ended], privileged[ended] = first.observation, first.privileged
        self.newest = object()
        return State(
            observation, privileged, seen.reward, seen.terms, seen.terminated, seen.truncated, seen.status,
            seen.observation, seen.privileged, seen.episode, self.newest,
        )  # fmt: skip


class _MjxWorlds:
    """Worlds of MJX, in pure functions."""

    def __init__(self, environment: Environment, threads: int | None) -> None:
        from nermo_mjx.physics.mjx_engine import MjxEngine

        self.of = environment
        self.engine = MjxEngine(environment.robot, environment.loop, 1)
        self.variation = Variation(environment.robot)

    @full_precision
    def reset(self, key: Any) -> State:
        keys = jax.random.split(jax.random.wrap_key_data(key), self.of.worlds)
        carried = jax.vmap(self._begin)(jax.random.key_data(keys))
        return self._state(self._seen(carried), None, carried)

    @full_precision
    def step(self, state: State, action: Any) -> State:
        keys, params, fields, carry = state.engine
        params = jax.vmap(self.of.loop.with_input)(params, jnp.asarray(action, params.drawn.dtype))

        def tick(carry: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(functools.partial(self.engine.tick, shown=True))(params, fields, carry)[0], None

        carry, _ = jax.lax.scan(tick, carry, None, length=self.of.task.decimation)
        carried = keys, params, fields, carry
        seen = self._seen(carried)
        ended = seen.terminated | seen.truncated

        def anew() -> Any:
            fresh = jax.vmap(self._begin)(jax.vmap(_next_key)(keys))

            def pick(new: Array, old: Array) -> Array:
                return jnp.where(jnp.reshape(ended, (-1,) + (1,) * (new.ndim - 1)), new, old)

            return jax.tree.map(pick, fresh, carried)

        carried = jax.lax.cond(ended.any(), anew, lambda: carried)
        return self._state(seen, self._seen(carried), carried)

    def _begin(self, key: Array) -> tuple[Array, Any, dict[str, Array], Any]:
        """Key, parameters, model fields and carry of a world at the start of an episode."""
        params, model, qpos = self.of.episodes(jax.random.wrap_key_data(key))
        fields = self.variation.differentiable(model, self.of.episodes.reached)
        at_rest = self.of.robot.sensordata_at_rest(qpos)
        carry = self.engine.start(params, qpos, jnp.zeros((self.engine.model.nv,), qpos.dtype), at_rest)
        return key, params, fields, carry

    def _seen(self, carried: Any) -> Observed:
        _, params, _, carry = carried
        seen: Observed = jax.vmap(self.of.loop.observe)(params, carry.loop, carry.sensordata)
        return seen

    def _state(self, seen: Observed, first: Observed | None, carried: Any) -> State:
        first = seen if first is None else first
        return State(
            first.observation, first.privileged, seen.reward, seen.terms, seen.terminated, seen.truncated, seen.status,
            seen.observation, seen.privileged, seen.episode, carried,
        )  # fmt: skip


_ENGINES: dict[str, Any] = {"c": _CWorlds, "mjx": _MjxWorlds}


def _next_key(key: Array) -> Array:
    return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 1))


def _raw_key(key: Any) -> Any:
    """A key as JAX keeps it, (2,) uint32."""
    if isinstance(key, (int, np.integer)):
        return jax.random.key_data(jax.random.key(int(key)))
    array = jnp.asarray(key)
    return jax.random.key_data(array) if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) else array
