"""A step of MJX with exact derivatives: replaces `mjx.step` for any model that MJX-JAX can run.

`mjx.solve` iterates in a `while_loop`. Reverse mode rejects more than one iteration of it, and forward mode
differentiates an iteration that was stopped before convergence. Here `solver` runs without derivatives, and the
derivative of its result is that of the fixed point it has found (implicit function theorem): with g(a, p) = 0 for the
acceleration a and all that it depends on, p,

    H da = -(dg/dp) dp,    H = dg/da = M - J^T f'(r) J.

The rule is linear in dp, so JAX can transpose it: it works in forward and reverse mode and under `vmap`, for any number
of iterations. It covers every kind of row that MJX has. In the rule, a depends on p by the rule itself, so that it can
be differentiated any number of times.

One more step of Newton's method converges to rounding. It starts from the solver's result, which reverse mode stores,
and uses the problem of the state, which reverse mode recomputes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from nermo_mjx.dynamics import constraint, impedance, rows, solver, tree
from nermo_mjx.dynamics.checkpointing import STORED_NAME
from nermo_mjx.dynamics.forces import actuation, passive
from nermo_mjx.dynamics.integration import INTEGRATORS, integrate
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.dynamics.mjx_import import Model, Solved, mjx
from nermo_mjx.dynamics.own_derivative import own_derivative
from nermo_mjx.dynamics.precision import full_precision
from nermo_mjx.dynamics.preparing import is_zero, prepared
from nermo_mjx.dynamics.rows import ConstraintProblem, Layout
from nermo_mjx.dynamics.spatial import solve_definite
from nermo_mjx.shapes import Array, Count, Dofs, Efc, Scalar, Truth


class Verdict(NamedTuple):
    """Convergence of the constraint solver in a step; with RK4, the worst of its four stages.

    Attributes:
        rounds: Number of rounds of the solver.
        residual: Size of the last step of Newton's method, as a share of accelerations or, where that is larger, of
            forces over inertias: each joint weighed by its inertia, or the largest alone. What is left is its square.
        converged: Whether the solver finished, and the residual is less than the root of the number's precision.
    """

    rounds: Count
    residual: Scalar
    converged: Truth


@full_precision
def step_with_verdict(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Data, Verdict]:
    """Advance the simulation as `step`, and return the convergence of the constraint solver as well.

    >>> import jax, mujoco
    >>> from nermo_mjx.dynamics import make_data, put_model
    >>> model = put_model(mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint range="-1 1"/>
    ... <geom size=".1" pos="1 0 0"/></body></worldbody></mujoco>'''))
    >>> after, verdict = jax.jit(step_with_verdict)(model, make_data(model))
    >>> bool(verdict.converged), int(verdict.rounds)
    (True, 1)

    Args:
        model, data: Arguments of `step`.

    Raises:
        ValueError: as `step`.
    """
    whole = _checked(model, data)
    after = integrate(whole, _forward(whole, data), _forward)
    rounds = rows.inner(after).solver_niter
    verdict = Verdict(
        jnp.minimum(rounds, solver.MAX_ROUNDS), after.residual, rounds <= solver.MAX_ROUNDS
    )
    after = after.replace(qacc_warmstart=jax.lax.stop_gradient(after.qacc_warmstart))
    return rows.as_made(model, whole, after), verdict


@full_precision
def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Advance the simulation by one time step, as `mjx.step`, with its derivatives in both modes.

    >>> import mujoco, jax
    >>> from nermo_mjx.dynamics import make_data, put_model
    >>> ball = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
    ... <body pos="0 0 .0999"><freejoint/><geom size=".1"/></body></worldbody></mujoco>''')
    >>> model = put_model(ball)
    >>> data = make_data(model)
    >>> def speed(friction):
    ...     rough = model.replace(geom_friction=model.geom_friction.at[:, 0].set(friction))
    ...     return step(rough, data.replace(qvel=data.qvel.at[0].set(1.0))).qvel[0]
    >>> bool(jax.jit(jax.grad(speed))(0.1) < 0.0)  # friction slows it
    True

    Derivatives flow from the new state to the old one (`qpos`, `qvel`, `act`), to `ctrl`, applied forces and mocap
    poses, and to the real fields of the model that MJX's step reads, `solref` and `solimp` among them. None flows
    through the warm start, since the solution does not depend on it. The model's `solver`, `iterations` and `tolerance`
    are ignored; `step_with_verdict` returns the convergence.

    Args:
        model: Result of `put_model`, with any solver, integrator, cone and constraint that MJX supports.
        data: Result of `make_data` or `put_data` for this model, of one world; use `jax.vmap` for a batch.

    Raises:
        ValueError: a model of `mjx.put_model`, data with another number of contacts or of another kind, an integrator
            that MJX lacks, a model without joints, a batch.
    """
    return step_with_verdict(model, data)[0]


@full_precision
def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Forward dynamics with exact derivatives, as `mjx.forward`: accelerations, constraint forces and sensors.

    Args:
        model, data: Arguments of `step`.

    Raises:
        ValueError: as `step`.
    """
    whole = _checked(model, data)
    return rows.as_made(model, whole, _forward(whole, data))


def _forward(model: Model, data: mjx.Data) -> Solved:
    data = mjx.sensor_pos(model, position(model, Solved.of(data)))
    data = mjx.sensor_vel(model, velocity(model, data))
    data = acceleration(model, actuation(model, data))
    solved: Solved = mjx.sensor_acc(model, solve(model, data))
    return solved


# ---
# The stages of MJX's forward dynamics, without terms that are known to be zero at trace time.
#
# MJX computes the inertia and the bias of tendons with armature, and the joint forces of wrenches on bodies, even if
# there are none; for this robot that is a third of the operations. XLA cannot know that a product with zero is zero.


def position(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_position`, with constraint rows whose derivatives are finite (see `impedance`)."""
    data = adapted.smooth.camlight(model, tree.com_pos(model, tree.kinematics(model, data)))
    data = tree.crb(model, adapted.smooth.tendon(model, data))
    if not is_zero(model.tendon_armature):
        data = rows.with_tendon_inertia(model, data)
    if model.opt.solver == mjx.SolverType.CG:  # Newton's method never reads the factors
        data = mjx.factor_m(model, data)
    data = make_constraint(model, adapted.collision_driver.collision(model, data))
    placed: mjx.Data = adapted.smooth.transmission(model, data)
    return placed


def make_constraint(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.make_constraint`, of a `prepared` model, which may have more rows than the data was made for."""
    data = adapted.constraint.make_constraint(model, data)
    data_jax = rows.inner(data)
    row_count = len(data_jax.efc_J) - data_jax.nefc
    if row_count and data_jax.ncon and len(data_jax.efc_J):  # the contacts' rows follow all others
        data = data.tree_replace(
            {"_impl.contact.efc_address": data_jax.contact.efc_address + row_count}
        )
    return data


def velocity(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_velocity`, with the rates of equalities' Jacobians (see `impedance`)."""
    inner = rows.inner(data)
    rates = {
        "actuator_velocity": inner.actuator_moment @ data.qvel,
        "ten_velocity": inner.ten_J @ data.qvel,
    }
    data = data.tree_replace({f"_impl.{name}": rate for name, rate in rates.items()})
    data = impedance.with_rates(model, tree.com_vel(model, data))
    data = tree.rne(model, passive(model, data))
    return data if is_zero(model.tendon_armature) else adapted.smooth.tendon_bias(model, data)


def acceleration(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_acceleration`: the sum of all forces but the constraints', and the acceleration they would give."""
    if is_zero(data.xfrc_applied):
        force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied
    else:
        force = mjx.fwd_acceleration(model, data).qfrc_smooth
    return data.replace(
        qfrc_smooth=force, qacc_smooth=solve_definite(mjx.full_m(model, data), force)
    )


def _checked(model: mjx.Model, data: mjx.Data) -> Model:
    """The model as the stages take it. Rejects, at trace time, what is not simulated or would fail deep inside MJX."""
    data_makers = "nermo_mjx.dynamics.make_data or put_data"
    for argument, kind, maker in (
        (
            model,
            Model,
            "nermo_mjx.dynamics.put_model; mjx.put_model omits fields that this step reads",
        ),
        (data, mjx.Data, data_makers),
    ):
        if not isinstance(argument, kind):
            type_name = f"{type(argument).__module__.partition('.')[0]}.{type(argument).__name__}"
            raise ValueError(
                f"{kind.__name__.lower()} is of {type_name}: allowed is a result of {maker}."
            )
    if data.impl != mjx.Impl.JAX:
        raise ValueError(
            f"impl of the data is {data.impl.value!r}: allowed is 'jax', the others have no derivatives."
        )
    if model.opt.integrator not in INTEGRATORS:
        allowed = ", ".join(integrator.name for integrator in INTEGRATORS)
        raise ValueError(
            f"integrator is {model.opt.integrator.name}: allowed is one of {allowed}, which MJX has."
        )
    if not model.nv:
        raise ValueError(
            "the model has no joints: allowed is one that can move, which MJX asks for, too."
        )
    for name, size in (
        ("qpos", model.nq),
        ("qvel", model.nv),
        ("ctrl", model.nu),
        ("act", model.na),
    ):
        shape = jax.numpy.shape(getattr(data, name))
        if shape != (size,):
            raise ValueError(
                f"{name} has the shape {shape}: allowed is {(size,)}, that of one world; use jax.vmap for a batch."
            )
    contacts = adapted.collision_driver.make_condim(model).size
    if data._impl.ncon != contacts:
        raise ValueError(
            f"data has {data._impl.ncon} contacts: allowed are {contacts}, those of the model; use {data_makers}."
        )
    return prepared(model)


def solve(model: mjx.Model, data: mjx.Data) -> Solved:
    """As `mjx.solve`, after `acceleration`, converged to the last digit, with the derivative of the solution.

    `solver_niter` of the result is more than `solver.MAX_ROUNDS` if the solver did not converge.
    """
    if rows.inner(data).efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth)
    layout, problem = rows.read_problem(model, data)
    starts_warm = not model.opt.disableflags & mjx.DisableBit.WARMSTART
    fixed, start = jax.lax.stop_gradient(
        (problem, data.qacc_warmstart if starts_warm else data.qacc_smooth)
    )
    solution = solver.minimum(layout, fixed, start)
    last = _newton(layout, checkpoint_name(solution.qacc, STORED_NAME), fixed)
    qacc = _solution(last.qacc, last.residual, problem, static=layout)
    force = constraint.forces(layout, problem, constraint.residual(problem, qacc, last.residual))
    inertia_diagonal = jnp.diag(fixed.inertia)
    size = jnp.maximum(jnp.abs(last.qacc), jnp.abs(fixed.smooth) / inertia_diagonal)
    # Weighed by the inertia, and by the largest entry, which is that of a light body.
    parts = jnp.stack(
        [
            inertia_diagonal @ last.step**2 / (inertia_diagonal @ size**2),
            (jnp.abs(last.step).max() / size.max()) ** 2,
        ]
    )
    share = jnp.where(size.max() > 0.0, jnp.sqrt(parts.max()), 0.0)
    settled = share < jnp.finfo(share.dtype).eps ** 0.5
    solved: Solved = data.tree_replace(
        {
            "qacc": qacc,
            "qfrc_constraint": problem.jacobian.T @ force,
            "residual": share,
            "_impl.efc_force": force,
            "_impl.solver_niter": jnp.where(settled, solution.needed, solver.MAX_ROUNDS + 1),
        }
    )
    return solved


@full_precision
def _change(layout: Layout, qacc: Dofs, arguments: Any, changes: Any) -> Array:
    """The change of the solution with the problem, by the implicit function theorem; the residual has no derivative."""
    (acceleration, problem), (_, change) = arguments, changes
    _, slope = jax.jvp(
        lambda p: constraint.gradient(layout, p, qacc, acceleration), (problem,), (change,)
    )
    return -solve_definite(constraint.hessian(layout, problem, qacc, acceleration), slope)


#: (qacc, residual there, problem) -> qacc, with the derivative of the problem's solution.
_solution = own_derivative("solution", _change)


class _Last(NamedTuple):
    """The last step of Newton's method, the acceleration after it, and the residual there without rounding of the latter."""

    step: Dofs
    qacc: Dofs
    residual: Efc


def _newton(layout: Layout, qacc: Dofs, problem: ConstraintProblem) -> _Last:
    """One step of Newton's method from `qacc`, or none where it would go too far.

    Rounding of `qacc` may put a row that is on the border of two zones into the softer one, from where the full step
    is thousands of times longer than the error.
    """
    exact = constraint.exact_residual(problem, qacc)
    last = solver.newton(layout, problem, jax.tree.map(jnp.abs, problem), qacc, exact, (0.0, 1.0))
    return _Last(
        last.step,
        jnp.where(last.full, qacc + last.step, qacc),
        jnp.where(last.full, exact + last.along, exact),
    )
