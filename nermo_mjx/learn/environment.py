"""The robot as an environment to learn in: `reset(key)` and `step(state, action)` over a batch of worlds."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.control import Controller
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.learn.acting import ACTIONS, Acting
from nermo_mjx.learn.loop import EpisodeLoop, Observed
from nermo_mjx.learn.task import Episodes, Outcome, Task
from nermo_mjx.physics import Variation, resolve_engine
from nermo_mjx.physics.c_engine import CDriven, CEngine, Threads
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.loop import check_controller
from nermo_mjx.rollout.run import Lanes
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.shapes import Array, Truth


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


class Worlds(Protocol):
    """The worlds of an environment on one engine."""

    def reset(self, key: Any) -> State: ...

    def step(self, state: State, action: Any) -> State: ...


class CWorlds:
    """Worlds of MuJoCo's C engine. The k-th episode of a world depends on key, world and k alone."""

    def __init__(self, loop: EpisodeLoop, episodes: Episodes, worlds: int, staggered: bool, threads: Threads) -> None:
        """
        Args:
            loop: what runs in each.
            episodes: what draws theirs.
            worlds: how many.
            staggered: whether the first episodes are cut short.
            threads: see `CEngine`.
        """
        self.loop, self.episodes, self.worlds = loop, episodes, worlds
        self.engine = CEngine(loop.robot, loop, threads)
        self.variation = Variation(loop.robot)
        self.session: CDriven | None = None
        self.drawn: dict[int, tuple[Any, dict[str, np.ndarray], np.ndarray]] = {}
        self.newest: object = None

        def draw(key: Array, world: Array, episode: Array) -> Any:
            own = jax.random.fold_in(jax.random.fold_in(jax.random.wrap_key_data(key), world), episode)
            return episodes(own, staggered & (episode == 0))

        self.draw = Lanes(draw)

    def reset(self, key: np.ndarray) -> State:
        """See `Worlds`."""
        n = self.worlds
        self.key, self.count, self.drawn = np.asarray(key), np.zeros(n, int), {}
        params, fields, qpos = self._episode(0, np.arange(n))
        self.session = CDriven(self.engine, params, qpos, fields)
        return self._state(self.session.observe(), None)

    def step(self, state: State, action: Any) -> State:
        """See `Worlds`."""
        if self.session is None or state.engine is not self.newest:
            raise ParameterError("state is not the newest one of this environment: on 'c' worlds cannot go back.")
        action = np.asarray(action, np.float32)
        if not np.isfinite(action).all():
            raise ParameterError("action has numbers that are not finite.")
        seen = self.session.drive(action, self.loop.task.decimation)
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
            n = self.worlds
            keys = np.broadcast_to(self.key, (n, *self.key.shape))
            params, model, qpos = self.draw(keys, np.arange(n), np.full(n, k))
            fields = self.variation.batch(model, n, self.episodes.reached)
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
            observation,
            privileged,
            seen.reward,
            seen.terms,
            seen.terminated,
            seen.truncated,
            seen.status,
            seen.observation,
            seen.privileged,
            seen.episode,
            self.newest,
        )


class World(NamedTuple):
    """One world of MJX.

    Attributes:
        key: of its episode, raw (2,).
        params, fields: of the loop, and what differs from the model.
        carry: what the engine carries.
    """

    key: Array
    params: Any
    fields: dict[str, Array]
    carry: Any


class MjxWorlds:
    """Worlds of MJX, in pure functions; `begin`, `act` and `seen` are those of one world."""

    def __init__(self, loop: EpisodeLoop, episodes: Episodes, worlds: int, staggered: bool) -> None:
        """
        Args:
            loop, episodes, worlds, staggered: see `CWorlds`.
        """
        from nermo_mjx.physics.mjx_engine import MjxEngine  # MJX takes a second to start

        self.loop, self.episodes, self.worlds, self.staggered = loop, episodes, worlds, staggered
        self.engine = MjxEngine(loop.robot, loop, 1)
        self.variation = Variation(loop.robot)

    @full_precision
    def reset(self, key: Any) -> State:
        """See `Worlds`."""
        keys = jax.random.split(jax.random.wrap_key_data(key), self.worlds)
        world = jax.vmap(functools.partial(self.begin, cut_short=self.staggered))(jax.random.key_data(keys))
        return self._state(jax.vmap(self.seen)(world), None, world)

    @full_precision
    def step(self, state: State, action: Any) -> State:
        """See `Worlds`."""
        world = jax.vmap(self.act)(state.engine, jnp.asarray(action))
        seen = jax.vmap(self.seen)(world)
        ended = seen.terminated | seen.truncated

        def anew() -> World:
            fresh = jax.vmap(self.begin)(jax.vmap(_next_key)(world.key))
            chosen: World = jax.vmap(picked)(ended, fresh, world)
            return chosen

        world = jax.lax.cond(ended.any(), anew, lambda: world)
        return self._state(seen, jax.vmap(self.seen)(world), world)

    @full_precision
    def begin(self, key: Array, cut_short: bool = False) -> World:
        """A world at the start of the episode of a key, see `Episodes`."""
        params, model, qpos = self.episodes(jax.random.wrap_key_data(key), cut_short)
        fields = self.variation.differentiable(model, self.episodes.reached)
        at_rest = self.loop.robot.sensordata_at_rest(qpos)
        carry = self.engine.start(params, qpos, jnp.zeros((self.engine.model.nv,), qpos.dtype), at_rest)
        return World(key, params, fields, self.engine.playing(carry, fields))

    @full_precision
    def act(self, world: World, action: Array) -> World:
        """A world after a control step under an action (a,)."""
        params = self.loop.with_input(world.params, action.astype(world.params.drawn.dtype))

        def tick(carry: Any, _: None) -> tuple[Any, None]:
            return self.engine.tick(params, world.fields, carry, shown=True)[0], None

        carry, _ = jax.lax.scan(tick, world.carry, None, length=self.loop.task.decimation)
        return world._replace(params=params, carry=carry)

    def seen(self, world: World) -> Observed:
        """What a world's last control step gave."""
        return self.loop.observe(world.params, world.carry.loop, world.carry.sensordata)

    def _state(self, seen: Observed, first: Observed | None, world: World) -> State:
        first = seen if first is None else first
        return State(
            first.observation,
            first.privileged,
            seen.reward,
            seen.terms,
            seen.terminated,
            seen.truncated,
            seen.status,
            seen.observation,
            seen.privileged,
            seen.episode,
            world,
        )


def picked(choice: Truth, one: Any, other: Any) -> Any:
    """One of two trees of a world."""
    return jax.tree.map(functools.partial(jnp.where, choice), one, other)


def _next_key(key: Array) -> Array:
    return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 1))


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
        if not (isinstance(self.controller.base, Controller) and type(self.task.action) in ACTIONS.values()):
            check_controller(self.robot, self.controller)  # the package's own are checked by its tests
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
        # `jax.random.key` would cut it to 32 bits.
        if not 0 <= key < 1 << 64:
            raise ParameterError(f"seed is {key}: allowed is a whole number from 0 to 2^64 - 1.")
        return jnp.asarray([int(key) >> 32, int(key) & 0xFFFFFFFF], jnp.uint32)
    array = jnp.asarray(key)
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(array)
    return array if array.ndim else jax.random.key_data(jax.random.key(array))  # a traced whole number
