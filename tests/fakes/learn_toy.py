"""A point mass that is pushed towards the origin, in closed form, in the shape of `nermo_mjx.learn.Environment`."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

LIMIT, EPISODE = 3.0, 60


class State(NamedTuple):
    observation: Any
    privileged: Any
    reward: Any
    terms: dict[str, Any]
    terminated: Any
    truncated: Any
    final_observation: Any
    final_privileged: Any
    body: Any
    tick: Any
    key: Any


class PointMass:
    """Worlds of a mass in a plane; position and velocity are observed; the critic is told the velocity twice.

    Args:
        worlds: in the batch.
        pure: else each step runs on the host and gives numpy arrays, as the engine `c` does.
    """

    observation_size, privileged_size, action_size, step_seconds = 4, 2, 2, 0.05

    def __init__(self, worlds: int = 64, *, pure: bool = True) -> None:
        self.worlds, self.pure = worlds, pure
        self.on_host = jax.jit(self._reset), jax.jit(self._step)

    def reset(self, key: Any) -> State:
        return (
            self._reset(key)
            if self.pure
            else jax.tree.map(np.asarray, self.on_host[0](jax.random.key_data(key)))
        )

    def step(self, state: State, action: Any) -> State:
        return (
            self._step(state, action)
            if self.pure
            else jax.tree.map(np.asarray, self.on_host[1](state, action))
        )

    def _reset(self, key: Any) -> State:
        key = (
            key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)
        )
        body_key, tick_key = jax.random.split(key)
        body = self._drawn(body_key)
        observation, privileged = self._sensed(body)
        zero, no = jnp.zeros(self.worlds), jnp.zeros(self.worlds, bool)
        tick = jax.random.randint(
            tick_key, (self.worlds,), 0, EPISODE
        )  # episodes do not end all at once
        return State(
            observation,
            privileged,
            zero,
            {"near": zero, "push": zero},
            no,
            no,
            observation,
            privileged,
            body,
            tick,
            jax.random.key_data(tick_key),
        )

    def _step(self, state: State, action: Any) -> State:
        push = jnp.clip(action, -1.0, 1.0)
        position, speed = state.body[:, :2], state.body[:, 2:]
        speed = 0.98 * speed + 2.0 * self.step_seconds * push
        position = position + self.step_seconds * speed
        body = jnp.concatenate([position, speed], axis=-1)
        terms = {"near": -(position**2).sum(axis=-1), "push": -0.05 * (push**2).sum(axis=-1)}
        terminated, tick = jnp.abs(position).max(axis=-1) > LIMIT, state.tick + 1
        truncated = (tick >= EPISODE) & ~terminated
        final = self._sensed(body)
        key, next_key = jax.random.split(jax.random.wrap_key_data(state.key))
        is_end = terminated | truncated
        body = jnp.where(is_end[:, None], self._drawn(key), body)
        observation, privileged = self._sensed(body)
        reward = self.step_seconds * (terms["near"] + terms["push"]) - 5.0 * terminated
        return State(
            observation,
            privileged,
            reward,
            terms,
            terminated,
            truncated,
            *final,
            body,
            jnp.where(is_end, 0, tick),
            jax.random.key_data(next_key),
        )

    def _drawn(self, key: Any) -> Any:
        return jax.random.uniform(key, (self.worlds, 4), minval=-1.5, maxval=1.5) * jnp.array(
            [1.0, 1.0, 0.5, 0.5]
        )

    def _sensed(self, body: Any) -> tuple[Any, Any]:
        return body.astype(jnp.float32), body[:, 2:].astype(jnp.float32)
