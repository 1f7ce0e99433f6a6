"""Adam with an automatic learning rate: it adapts to the objective values after each step.

With Adam's means of the gradients m and of their squares v, corrected for their start (Kingma and Ba, ICLR 2015), a
step is rate * m / sqrt(v). An evaluation that is the best so far makes the rate a fifth larger. After two in a row
that are not, it becomes 0.7 of what it was, and the next step starts from the best point again; after a fall, at once.

The direction is averaged, so the landscape may be rough: a walk's speed has teeth as steep as the overall hill, 0.1 of
a unit of u wide, in which a descent that insists on improvement gets stuck (a trust region with the update of Broyden,
Fletcher, Goldfarb and Shanno, much faster on smooth functions, did so at once).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

#: Initial rate, in coordinates u per step: a thirteenth of a parameter's range in its middle.
RATE: Final = 0.3
_MOST: Final = 1.0
_GROWS, _SHRINKS, _WAITS = 1.2, 0.7, 2
_MEMORY: Final = (0.8, 0.9)


class ControlledAdam(NamedTuple):
    """State of the optimizer.

    Attributes:
        adam: means of the gradients and of their squares.
        rate: length of the next step along each parameter, at most.
        best, best_u: lowest value so far, infinite while there is none, and where it was (p,).
        waited: evaluations since then that were not better.
    """

    adam: optax.ScaleByAdamState
    rate: Float[Array, ""]
    best: Float[Array, ""]
    best_u: Float[Array, " p"]
    waited: Int[Array, ""]


def controlled_adam(rate: float = RATE) -> optax.GradientTransformationExtraArgs:
    """The optimizer, for the vector u of one start; `update` takes `value`, infinite where there is none.

    Args:
        rate: the initial one, in coordinates u per step.

    >>> import jax
    >>> bowl = lambda u: jnp.sum((u - jnp.array([1.0, 3.0])) ** 2 * jnp.array([1.0, 20.0]))
    >>> optimizer, u = controlled_adam(), jnp.zeros(2)
    >>> state = optimizer.init(u)
    >>> for _ in range(60):
    ...     step, state = optimizer.update(jax.grad(bowl)(u), state, u, value=bowl(u))
    ...     u = u + step
    >>> [round(float(each), 2) for each in state.best_u]
    [1.0, 3.0]
    """
    direction = optax.scale_by_adam(*_MEMORY)

    def init(u: Array) -> ControlledAdam:
        most = jnp.asarray(jnp.inf, u.dtype)
        return ControlledAdam(direction.init(u), jnp.asarray(rate, u.dtype), most, u, jnp.zeros((), int))

    def update(
        gradient: Array, state: ControlledAdam, u: Array | None = None, *, value: Array, **_: object
    ) -> tuple[Array, ControlledAdam]:
        assert u is not None
        walked, better = jnp.isfinite(value), value < state.best
        ahead, adam = direction.update(gradient, state.adam)
        before, _ = direction.update(jnp.zeros_like(gradient), state.adam)
        # A fall has no gradient: keep the direction.
        ahead = jnp.where(walked, ahead, before)
        adam = optax.tree.where(walked, adam, state.adam)
        waited = jnp.where(better, 0, state.waited + 1)
        back = ~better & (~walked | (waited >= _WAITS))
        factor = jnp.where(better, _GROWS, jnp.where(back, _SHRINKS, 1.0))
        after = ControlledAdam(
            adam=adam,
            rate=jnp.minimum(state.rate * factor, _MOST).astype(state.rate.dtype),
            best=jnp.where(better, value, state.best).astype(state.best.dtype),
            best_u=jnp.where(better, u, state.best_u),
            waited=jnp.where(back, 0, waited),
        )
        return jnp.where(back, after.best_u, u) - after.rate * ahead - u, after

    return optax.GradientTransformationExtraArgs(init, update)
