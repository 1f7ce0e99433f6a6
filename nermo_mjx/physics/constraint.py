"""The constraint problem that MuJoCo's solver solves, as a differentiable function of its arrays.

The acceleration a minimises a convex function whose gradient is

    g(a) = M a - q - J^T f(r),    r = J a - aref,

with the inertia M, the smooth forces q, and the constraint force f of each row (MuJoCo's documentation, "Computation:
Constraint model").
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.physics.rows import Layout, Problem


def gradient(layout: Layout, problem: Problem, qacc: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """g(a), zero at the solution."""
    force = forces(layout, problem, residual(problem, qacc))
    return problem.inertia @ qacc - problem.smooth - problem.jacobian.T @ force


def hessian(layout: Layout, problem: Problem, qacc: Float[Array, " nv"]) -> Float[Array, "nv nv"]:
    """dg/da = M - J^T f'(r) J, symmetric and positive definite."""
    at = residual(problem, qacc)

    def along(column: Array) -> Array:
        slope: Array = jax.jvp(lambda r: forces(layout, problem, r), (at,), (column,))[1]
        return slope

    change = problem.jacobian.T @ jax.vmap(along, in_axes=1, out_axes=1)(problem.jacobian)
    return problem.inertia - 0.5 * (change + change.T)


def residual(problem: Problem, qacc: Float[Array, " nv"]) -> Float[Array, " nefc"]:
    """r = J a - aref."""
    return problem.jacobian @ qacc - problem.aref


def forces(layout: Layout, problem: Problem, residual: Float[Array, " nefc"]) -> Float[Array, " nefc"]:
    """Constraint force f of each row at the residual r.

    Equalities are two-sided springs, f = -D r. Dry friction is a spring that yields at +-frictionloss. Limits,
    frictionless contacts and the edges of pyramids only push: f = -D r where r < 0. An elliptic contact lies in one of
    three zones, see `_cone`.
    """
    spring = -problem.stiffness * residual
    row = np.arange(residual.shape[0])
    dry = row < layout.equality + layout.frictionloss
    # To MuJoCo a row of dry friction without loss, which a batch may contain, is a spring.
    yields = dry & (row >= layout.equality) & (problem.frictionloss > 0.0)
    yielding = jnp.clip(spring, -problem.frictionloss, problem.frictionloss)
    simple = jnp.where(yields, yielding, jnp.where(dry | (residual < 0.0), spring, 0.0))
    first, contact = residual.shape[0] - sum(dim * count for dim, count in layout.cones), 0
    parts = [simple[:first]]
    for dim, count in layout.cones:
        end = first + dim * count
        apart, stiffness = (array[first:end].reshape(count, dim) for array in (residual, problem.stiffness))
        parts.append(jax.vmap(_cone)(apart, stiffness, problem.cone[contact : contact + count, :dim]).ravel())
        first, contact = end, contact + count
    return jnp.concatenate(parts)


def _cone(residual: Float[Array, " dim"], stiffness: Float[Array, " dim"], scale: Float[Array, " dim"]) -> Array:
    """Force of one contact with an elliptic cone.

    With u = scale * r, n = u_0 and t = |u_1..|: it sticks where mu n + t <= 0 (f = -D r), is apart where n >= mu t
    (f = 0), and slides between them, with the force on the surface of the cone.
    """
    mu, u = scale[0], scale * residual
    n, square = u[0], jnp.sum(u[1:] ** 2)
    moves = square > 0.0
    t = jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)
    sticks, apart = mu * n + t <= 0.0, n >= mu * t
    normal = -stiffness[0] / (mu * (1.0 + mu * mu)) * (n - mu * t)
    direction = u[1:] / jnp.where(moves, t, 1.0)
    slides = normal * jnp.concatenate([jnp.ones_like(u[:1]), -direction * scale[1:]])
    return jnp.where(apart, 0.0, jnp.where(sticks, -stiffness * residual, slides))
