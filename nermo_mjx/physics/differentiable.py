"""A step of MJX with exact derivatives: replaces `mjx.step` for any model that MJX-JAX can run.

`mjx.solve` iterates in a `while_loop`. Reverse mode refuses more than one iteration of it, and forward mode
differentiates an iteration that was stopped before its end. Here `solver` runs with no derivative, and the derivative
of its result is that of the fixed point it has found (implicit function theorem): with g(a, p) = 0 for the acceleration
a and all that it depends on, p,

    H da = -(dg/dp) dp,    H = dg/da = M - J^T f'(r) J.

The rule is linear in dp, so that JAX transposes it: it serves forward and reverse mode and `vmap`, for any number of
iterations. Every kind of row that MJX has is written out.

One more step of Newton's method ends at rounding. It is taken from what the solver came to, which reverse mode keeps,
and from the problem of the state that reverse mode makes anew.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name
from jax.scipy.linalg import cho_factor, cho_solve

from nermo_mjx.physics import constraint, rows, solver, stages
from nermo_mjx.physics.checkpointing import KEPT
from nermo_mjx.physics.integration import integrate
from nermo_mjx.physics.mjx_import import mjx
from nermo_mjx.physics.precision import full_precision
from nermo_mjx.physics.rows import Layout, Problem
from nermo_mjx.shapes import Array, Dofs


@full_precision
def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advance the simulation by one time step, as `mjx.step`, with its derivatives in both modes.

    Derivatives flow from the new state to the old one (`qpos`, `qvel`, `act`), to `ctrl`, applied forces and mocap
    poses, and to the real fields of the model that MJX's step reads, except the impedances of rows that are not
    contacts and the exponents of those that are. None flows through the warm start, on which the solution does not
    depend.

    Args:
        model: MJX model of `impl="jax"`, any solver, integrator, cone and constraint.
        data: unbatched; use `jax.vmap` for a batch.

    Raises:
        ValueError: a model of another implementation.
    """
    if model.impl != mjx.Impl.JAX:
        raise ValueError(f"impl is {model.impl.value!r}: allowed is 'jax', the others have no derivatives.")
    after = integrate(model, forward(model, data), forward)
    return after.replace(qacc_warmstart=jax.lax.stop_gradient(after.qacc_warmstart))


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Forward dynamics with exact derivatives, as `mjx.forward`: accelerations, constraint forces and sensors."""
    data = mjx.sensor_pos(model, stages.position(model, data))
    data = mjx.sensor_vel(model, stages.velocity(model, data))
    data = stages.acceleration(model, mjx.fwd_actuation(model, data))
    return mjx.sensor_acc(model, solve(model, data))


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.solve`, after `stages.acceleration`, to the last digit and with the derivative of the solution.

    `rows.solver_rounds` of the result is more than `solver.ROUNDS` where the solver did not come to its end.
    """
    if rows.is_unconstrained(data):
        return data.replace(qacc=data.qacc_smooth)
    layout, problem = rows.read(model, data)
    starts_warm = not model.opt.disableflags & mjx.DisableBit.WARMSTART
    start = data.qacc_warmstart if starts_warm else data.qacc_smooth
    found = solver.solve(layout, *jax.lax.stop_gradient((problem, start)))
    qacc = checkpoint_name(found.qacc, KEPT)
    qacc = _solution(layout, _newton(layout, qacc, jax.lax.stop_gradient(problem)), problem)
    force = constraint.forces(layout, problem, constraint.residual(problem, qacc))
    return rows.with_solution(data, qacc, force, problem.jacobian.T @ force, found.needed)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solution(layout: Layout, qacc: Dofs, problem: Problem) -> Dofs:
    """The solution `qacc` of a problem, as it is; its derivative is that of the problem's solution."""
    return qacc


@_solution.defjvp
@full_precision
def _(layout: Layout, primals: Any, tangents: Any) -> tuple[Array, Array]:
    qacc, problem = primals
    _, change = tangents
    _, residual = jax.jvp(lambda p: constraint.gradient(layout, p, qacc), (problem,), (change,))
    return qacc, -cho_solve(cho_factor(constraint.hessian(layout, problem, qacc)), residual)


def _newton(layout: Layout, qacc: Dofs, problem: Problem) -> Dofs:
    """One step of Newton's method from `qacc`."""
    factor = cho_factor(constraint.hessian(layout, problem, qacc))
    return qacc - cho_solve(factor, constraint.gradient(layout, problem, qacc))
