"""Solution of a linear system whose derivative costs no more than the solution."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Float

from nermo_mjx.shapes import Array


def solve_definite(matrix: Float[Array, "n n"], vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """x with A x = b for a symmetric positive definite A.

    Its derivative is A dx = db - dA x. That of a Cholesky decomposition, by which MJX solves, costs ten times as much.
    """

    def solve(_: Callable[[Array], Array], right: Array) -> Array:
        solution: Array = cho_solve(cho_factor(jax.lax.stop_gradient(matrix)), right)
        return solution

    found: Array = jax.lax.custom_linear_solve(lambda x: matrix @ x, vector, solve, symmetric=True)
    return found
