"""Value and gradient of a scalar function of few or many parameters, in the cheaper mode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.shapes import Array, Scalar

MODES: Final = ("auto", "forward", "reverse")
#: Up to this many parameters forward mode is cheaper by the costs below, and it compiles faster.
MOST_FORWARD: Final = 4
#: Assumed cost of value and gradient relative to the value alone: in forward mode one run, and one more for each
#: parameter (2.6 runs were measured for two); in reverse mode five runs for any number (4.5 were measured).
FORWARD_COST: Final = 1.0
REVERSE_COST: Final = 5.0

#: A scalar function of a point (p,), with auxiliary output.
Function = Callable[[Float[Array, " p"]], tuple[Scalar, Any]]


def choose_mode(parameters: int, mode: str = "auto") -> str:
    """`forward` or `reverse`; `auto` decides by the number of parameters."""
    if mode != "auto":
        return mode
    return "forward" if parameters <= MOST_FORWARD else "reverse"


def cost(parameters: int, mode: str) -> float:
    """Cost of value and gradient, in runs of the function alone."""
    return 1.0 + FORWARD_COST * parameters if mode == "forward" else REVERSE_COST


def value_and_gradient(
    function: Function, mode: str
) -> Callable[[Float[Array, " p"]], tuple[Scalar, Float[Array, " p"], Any]]:
    """The function's value, its gradient, and its auxiliary output, in one pass.

    Args:
        function: point (p,) -> (value, anything).
        mode: `forward` or `reverse`.
    """

    def forward(point: Array) -> tuple[Array, Array, Any]:
        def along(way: Array) -> tuple[Array, Array, Any]:
            value, slope, rest = jax.jvp(function, (point,), (way,), has_aux=True)
            return value, slope, rest

        # Value and auxiliary output do not depend on the direction, so they are computed once.
        return jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(point.shape[0], dtype=point.dtype))

    def reverse(point: Array) -> tuple[Array, Array, Any]:
        (value, rest), gradient = jax.value_and_grad(function, has_aux=True)(point)
        return value, gradient, rest

    return forward if mode == "forward" else reverse
