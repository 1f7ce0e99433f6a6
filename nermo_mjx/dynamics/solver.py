"""The constraint solver: Newton's method with a fixed number of rounds, each of fixed length.

`mjx.solve` runs every round of its line search in every iteration until the slowest world of a batch has converged, in
loops whose length only the device knows, and compares costs, which near the minimum are equal to the last digit while
the acceleration is still off by the square root of that digit. Here a round is: gradient and Hessian in closed form
(see `constraint`), one Cholesky decomposition, and the full step; where the slope of the cost along it shows that it
went too far, the step to where the slope vanishes, interpolated between shares of it that are evaluated at once. A
world whose last step was so small that one more would converge to rounding stops; `differentiable` takes that one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Float

from nermo_mjx.dynamics import constraint
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout
from nermo_mjx.shapes import Array, Count, Dofs, Efc, Scalar, Truth

#: Maximum number of rounds. Walks, falls and impacts need 3.5 on average and 12 at most; light links in stiff contacts
#: up to 40 in float64.
MAX_ROUNDS: Final = 100
#: Rounds on an accelerator, where a loop with a stopping criterion would wait for the host in each round.
ACCELERATOR_ROUNDS: Final = 11
#: Shares of a step at which the slope along it is evaluated, all at once, on a finer grid than a single step would
#: need. Fewer shares need more rounds.
STEP_SHARES: Final = (0.0, *(2.0 ** (-k / 2) for k in range(24, -1, -1)))
#: A full step is accepted if it leaves no more than this share of the initial slope.
ACCEPTED_SLOPE_SHARE: Final = 0.25


class Solution(NamedTuple):
    """The solver's result.

    Attributes:
        qacc: acceleration.
        converged: whether the last step was so small that another one converges to rounding.
        small: whether it was small; a row that changed its zone may still require another one.
        rounds: number of rounds.
    """

    qacc: Dofs
    converged: Truth
    small: Truth
    rounds: Count

    @property
    def needed(self) -> Count:
        """Number of rounds; `MAX_ROUNDS` + 1 where it has not converged."""
        return jnp.where(self.converged, self.rounds, MAX_ROUNDS + 1)


class Step(NamedTuple):
    """A step of Newton's method: where it leads, the change of the residual, whether to take all of it, else how much,
    whether it was small, and whether all rows stay in their zones."""

    step: Dofs
    along: Efc
    full: Truth
    share: Scalar
    small: Truth
    stays: Truth


def minimum(layout: Layout, problem: ConstraintProblem, start: Dofs) -> Solution:
    """The acceleration at which the gradient of the problem vanishes.

    Args:
        layout, problem: the constraint problem.
        start: initial guess; the solution does not depend on it.
    """
    no, sizes = jnp.zeros((), bool), jax.tree.map(jnp.abs, problem)
    first = Solution(start, no, no, jnp.zeros((), jnp.int32))

    def next_round(solution: Solution) -> Solution:
        newton_step = newton(layout, problem, sizes, solution.qacc)
        qacc = solution.qacc + newton_step.share * newton_step.step
        next_solution = Solution(
            qacc,
            newton_step.small & (newton_step.stays | solution.small),
            newton_step.small,
            solution.rounds + 1,
        )
        return jax.tree.map(
            lambda old, new: jnp.where(solution.converged, old, new), solution, next_solution
        )

    def to_the_end(solution: Solution) -> Solution:
        return jax.lax.fori_loop(
            0, ACCELERATOR_ROUNDS, lambda _, current: next_round(current), solution
        )

    def until_all_have_converged(solution: Solution) -> Solution:
        return jax.lax.while_loop(
            lambda current: ~current.converged & (current.rounds < MAX_ROUNDS), next_round, solution
        )

    # Both branches give the same result where `ACCELERATOR_ROUNDS` rounds suffice. Only on a CPU does checking whether all
    # worlds have finished cost nothing.
    converged_solution: Solution = jax.lax.platform_dependent(
        first, cpu=until_all_have_converged, default=to_the_end
    )
    return converged_solution


def newton(
    layout: Layout,
    problem: ConstraintProblem,
    sizes: ConstraintProblem,
    qacc: Dofs,
    known_residual: Efc | None = None,
    shares: Sequence[float] = STEP_SHARES,
) -> Step:
    """A step of Newton's method, and how much of it to take.

    Args:
        layout, problem: the constraint problem.
        sizes: |problem|.
        qacc: acceleration from which it leads.
        known_residual: a more exact value of the residual there.
        shares: of the step at which the slope along it is evaluated, from 0 to 1.
    """
    factor = cho_factor(constraint.hessian(layout, problem, qacc, known_residual))
    gradient = constraint.gradient(layout, problem, qacc, known_residual)
    step = -cho_solve(factor, gradient)
    start_residual, along = (
        constraint.residual(problem, qacc, known_residual),
        problem.jacobian @ step,
    )
    energy, initial_slope = step @ (problem.inertia @ step), step @ gradient

    def at(share: Array) -> tuple[Array, Array]:
        """The constraint forces' part of the slope of the cost along the step, and the rows' zones."""
        residual_at_share = start_residual + share * along
        return along @ constraint.forces(layout, problem, residual_at_share), constraint.zones(
            layout, problem, residual_at_share
        )

    grid = jnp.asarray(shares, qacc.dtype)
    slopes_on_grid, zones = jax.vmap(at)(grid)
    slopes = initial_slope + grid * energy - (slopes_on_grid - slopes_on_grid[0])
    # Newton's method squares the error, so another step would converge to rounding, unless a row changes its zone on
    # the way: beyond the change the next step may be longer. A world with NaNs, which compare as false, need not
    # continue.
    small = ~(energy > jnp.finfo(qacc.dtype).eps ** 1.5 * (qacc @ (problem.inertia @ qacc)))
    full = small | (slopes[-1] <= -ACCEPTED_SLOPE_SHARE * initial_slope)
    # At rest the acceleration itself is rounding, and no step is small beside it. Such a step may still be long: on
    # the border of a zone in which the Hessian is soft.
    dof_index = np.arange(len(qacc))
    weight = 1.0 / problem.inertia[dof_index, dof_index]
    small |= weight @ gradient**2 <= weight @ constraint.rounding(layout, problem, sizes, qacc) ** 2
    share = jnp.where(full, 1.0, _zero(grid, slopes))
    return Step(step, along, full, share, small, jnp.all(zones[0] == zones[-1]))


def _zero(shares: Float[Array, " n"], slopes: Float[Array, " n"]) -> Scalar:
    """Approximate zero of a rising function, by the chord across its change of sign.

    Args:
        shares, slopes: where it was evaluated, and its values; below zero at the first.
    """
    upper_index = jnp.clip(jnp.sum(slopes < 0.0), 1, len(shares) - 1)
    (low, high), (under, over) = (
        (samples[upper_index - 1], samples[upper_index]) for samples in (shares, slopes)
    )
    rise = over - under
    return low + (high - low) * jnp.clip(-under / jnp.where(rise > 0.0, rise, 1.0), 0.05, 0.95)
