"""The worlds of an environment on each engine, and what they return after a control step."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.learn.loop import EpisodeLoop, Observed
from nermo_mjx.learn.task import Episodes
from nermo_mjx.physics import Variation
from nermo_mjx.physics.c_driven import CDriven
from nermo_mjx.physics.c_engine import CEngine, Threads
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout.lanes import Lanes
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
            observation, privileged, seen.reward, seen.terms, seen.terminated, seen.truncated, seen.status,
            seen.observation, seen.privileged, seen.episode, self.newest,
        )  # fmt: skip


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
            first.observation, first.privileged, seen.reward, seen.terms, seen.terminated, seen.truncated, seen.status,
            seen.observation, seen.privileged, seen.episode, world,
        )  # fmt: skip


def picked(choice: Truth, one: Any, other: Any) -> Any:
    """One of two trees of a world."""
    return jax.tree.map(functools.partial(jnp.where, choice), one, other)


def _next_key(key: Array) -> Array:
    return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 1))
