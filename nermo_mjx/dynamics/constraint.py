"""The constraint problem that MuJoCo's solver solves, as a differentiable function of its arrays.

The acceleration a minimises a convex function whose gradient is

    g(a) = M a - q - J^T f(r),    r = J a - aref,

with the inertia M, the smooth forces q, and the constraint force f of each row (MuJoCo's documentation, "Computation:
Constraint model").
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.dynamics.own_derivative import own_derivative
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout
from nermo_mjx.shapes import Array, Dofs, Efc

#: Multiple of a number's precision that sums of some dozens of terms lose.
ROUNDING_MULTIPLE: Final = 4.0


def gradient(
    layout: Layout, problem: ConstraintProblem, qacc: Dofs, known_residual: Efc | None = None
) -> Dofs:
    """g(a), zero at the solution; `known_residual` is a more exact value of the residual."""
    force = forces(layout, problem, residual(problem, qacc, known_residual))
    return problem.inertia @ qacc - problem.smooth - problem.jacobian.T @ force


def rounding(
    layout: Layout, problem: ConstraintProblem, sizes: ConstraintProblem, qacc: Dofs
) -> Dofs:
    """The size of g(a) at the solution due to rounding of its terms; `sizes` is |problem|."""
    force = jnp.abs(forces(layout, problem, residual(problem, qacc)))
    terms = sizes.inertia @ jnp.abs(qacc) + sizes.smooth + sizes.jacobian.T @ force
    return ROUNDING_MULTIPLE * jnp.finfo(qacc.dtype).eps * terms


def hessian(
    layout: Layout, problem: ConstraintProblem, qacc: Dofs, known_residual: Efc | None = None
) -> Float[Array, "nv nv"]:
    """dg/da = M - J^T f'(r) J, positive definite and, up to rounding, symmetric; see `gradient`."""
    jacobian, residuals = problem.jacobian, residual(problem, qacc, known_residual)
    springs, _ = _simple(layout, problem, residuals)
    end = _first_cone(layout, residuals)
    parts = [jnp.where(springs, problem.stiffness, 0.0)[:end, None] * jacobian[:end]]
    for first, dim, contact_residual, stiffness, scale in _contacts(layout, problem, residuals):
        slopes = jax.vmap(_cone_slope)(contact_residual, stiffness, scale)
        rows = jacobian[first : first + contact_residual.size].reshape(-1, dim, jacobian.shape[1])
        # Sums of products instead of a matrix product, which XLA would turn into a library call for each contact.
        weighted = sum(slopes[:, :, k, None] * rows[:, None, k] for k in range(dim))
        parts.append(jnp.reshape(weighted, (contact_residual.size, jacobian.shape[1])))
    return problem.inertia + jacobian.T @ jnp.concatenate(parts)


def residual(problem: ConstraintProblem, qacc: Dofs, known_residual: Efc | None = None) -> Efc:
    """r = J a - aref, or a more exact value of it, with the same derivatives."""
    plain = problem.jacobian @ qacc - problem.aref
    return plain if known_residual is None else _known(known_residual, plain)


def exact_residual(problem: ConstraintProblem, qacc: Dofs) -> Efc:
    """As `residual`, to the rounding of the result rather than that of its terms.

    The force of a stiff row is the small difference of large accelerations, times up to 1e8. J and a are split into
    parts with so few digits that their products' sums are exact, and rests (Ozaki's scheme).
    """
    kind = jnp.finfo(qacc.dtype)
    digits = (kind.nmant + 1 - qacc.size.bit_length()) // 2
    share, power = jnp.frexp(qacc)
    jacobian = problem.jacobian * jnp.ldexp(jnp.ones_like(qacc), power)
    _, largest = jnp.frexp(jnp.max(jnp.abs(jacobian), axis=1, keepdims=True))
    grid = jnp.ldexp(jnp.ones_like(problem.aref)[:, None], largest - digits)
    front = jax.lax.reduce_precision(share, kind.nexp, digits - 1)
    coarse = grid * jnp.round(jacobian / grid)
    rest = coarse @ (share - front) + (jacobian - coarse) @ share
    return (coarse @ front - problem.aref) + rest


#: (a more exact value of something, something) -> the value, with the derivatives of the other.
_known: Final = own_derivative("more_exact", lambda _, value, plain, changes: changes[0])


def forces(layout: Layout, problem: ConstraintProblem, residual: Efc) -> Efc:
    """Constraint force f of each row at the residual r.

    Equalities are two-sided springs, f = -D r. Dry friction is a spring that yields at +-frictionloss. Limits,
    frictionless contacts and the edges of pyramids can only push: f = -D r where r < 0. An elliptic contact lies in one
    of three zones, see `_cone`.
    """
    springs, loss = _simple(layout, problem, residual)
    spring = -problem.stiffness * residual
    simple = jnp.where(springs, spring, jnp.sign(spring) * loss)
    parts = [simple[: _first_cone(layout, residual)]]
    parts += [
        jax.vmap(_cone)(*contact).ravel() for _, _, *contact in _contacts(layout, problem, residual)
    ]
    return jnp.concatenate(parts)


def zones(layout: Layout, problem: ConstraintProblem, residual: Efc) -> Int[Array, " zones"]:
    """The linear or smooth piece of the force that each row, or each contact with a cone, is in."""
    springs, _ = _simple(layout, problem, residual)
    parts = [springs[: _first_cone(layout, residual)].astype(int)]
    for _, _, apart, _, scale in _contacts(layout, problem, residual):
        zone = jax.vmap(_zone)(apart, scale)
        parts.append(2 * zone.apart + zone.sticks)
    return jnp.concatenate(parts)


def _simple(layout: Layout, problem: ConstraintProblem, residual: Efc) -> tuple[Array, Array]:
    """For rows outside cones: whether each is a spring, and otherwise its constant force in either direction."""
    row = np.arange(residual.shape[0])
    dry = (row >= layout.equality) & (row < layout.equality + layout.frictionloss)
    loss = jnp.where(dry, problem.frictionloss, 0.0)
    holds = (row < layout.equality) | (jnp.abs(problem.stiffness * residual) < loss)
    return jnp.where(row < layout.equality + layout.frictionloss, holds, residual < 0.0), loss


def _first_cone(layout: Layout, residual: Efc) -> int:
    return residual.shape[0] - sum(dim * count for dim, count in layout.cones)


def _contacts(
    layout: Layout, problem: ConstraintProblem, residual: Efc
) -> Iterator[tuple[int, int, Array, Array, Array]]:
    """(first row, dim, r, D, scale) of the contacts with cones of one dimension; the arrays are (count, dim)."""
    first, contact = _first_cone(layout, residual), 0
    for dim, count in layout.cones:
        end = first + dim * count
        apart, stiffness = (
            array[first:end].reshape(count, dim) for array in (residual, problem.stiffness)
        )
        yield first, dim, apart, stiffness, problem.cone[contact : contact + count, :dim]
        first, contact = end, contact + count


def _cone(
    residual: Float[Array, " dim"], stiffness: Float[Array, " dim"], scale: Float[Array, " dim"]
) -> Array:
    """Force of one contact with an elliptic cone.

    With u = scale * r, n = u_0 and t = |u_1..|: it sticks where mu n + t <= 0 (f = -D r), is separated where n >= mu t
    (f = 0), and slides between them, with the force on the surface of the cone.
    """
    zone = _zone(residual, scale)
    mu, direction = scale[0], zone.direction
    normal = -stiffness[0] / (mu * (1.0 + mu * mu)) * zone.outside
    slides = normal * jnp.concatenate([jnp.ones_like(mu)[None], -direction * scale[1:]])
    return jnp.where(zone.apart, 0.0, jnp.where(zone.sticks, -stiffness * residual, slides))


def _cone_slope(
    residual: Float[Array, " dim"], stiffness: Float[Array, " dim"], scale: Float[Array, " dim"]
) -> Array:
    """-df/dr of one contact with an elliptic cone, symmetric and positive semidefinite."""
    zone = _zone(residual, scale)
    mu, direction = scale[0], zone.direction
    across = jnp.concatenate([jnp.ones_like(mu)[None], -mu * direction])
    turns = jnp.zeros((len(scale), len(scale)), scale.dtype)
    turns = turns.at[1:, 1:].set(jnp.eye(len(direction)) - jnp.outer(direction, direction))
    slides = jnp.outer(across, across) - mu * zone.outside / zone.length * turns
    slides *= stiffness[0] / (mu * mu * (1.0 + mu * mu)) * jnp.outer(scale, scale)
    return jnp.where(zone.apart, 0.0, jnp.where(zone.sticks, jnp.diag(stiffness), slides))


class _Zone(NamedTuple):
    """Zone quantities of a contact's u = scale * r: n - mu t, the length t (1 for 0) and the direction of u_1.. ."""

    apart: Array
    sticks: Array
    outside: Array
    length: Array
    direction: Array


def _zone(residual: Float[Array, " dim"], scale: Float[Array, " dim"]) -> _Zone:
    mu, u = scale[0], scale * residual
    # Added one by one: a sum over an axis would be a separate kernel launch on a GPU.
    n, square = u[0], sum(component * component for component in u[1:])
    moves = square > 0.0
    t = jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)
    length = jnp.where(moves, t, 1.0)
    return _Zone(n >= mu * t, mu * n + t <= 0.0, n - mu * t, length, u[1:] / length)
