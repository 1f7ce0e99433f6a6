"""The stages of MJX's forward dynamics, without terms that are known to be zero at trace time.

MJX computes the inertia and the bias of tendons with armature, and the joint forces of wrenches on bodies, even if
there are none; for this robot that is a third of the operations. XLA cannot know that a product with zero is zero.
"""

from __future__ import annotations

from nermo_mjx.dynamics import impedance, rows, tree
from nermo_mjx.dynamics.forces import actuated, passive
from nermo_mjx.dynamics.impedance import make_constraint
from nermo_mjx.dynamics.jacobians import with_point_jacobians
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.dynamics.preparing import is_zero
from nermo_mjx.dynamics.spatial import solve_definite


@with_point_jacobians
def position(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_position`, with constraint rows whose derivatives are finite (see `impedance`)."""
    data = mjx.camlight(model, tree.com_pos(model, tree.kinematics(model, data)))
    data = tree.crb(model, mjx.tendon(model, data))
    if not is_zero(model.tendon_armature):
        data = rows.with_tendon_inertia(model, data)
    if model.opt.solver == mjx.SolverType.CG:  # Newton's method never reads the factors
        data = mjx.factor_m(model, data)
    return mjx.transmission(model, make_constraint(model, mjx.collision(model, data)))


@with_point_jacobians
def velocity(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_velocity`, with the rates of equalities' Jacobians (see `impedance`)."""
    inner = rows.inner(data)
    rates = {"actuator_velocity": inner.actuator_moment @ data.qvel, "ten_velocity": inner.ten_J @ data.qvel}
    data = data.tree_replace({f"_impl.{name}": rate for name, rate in rates.items()})
    data = impedance.with_rates(model, tree.com_vel(model, data))
    data = tree.rne(model, passive(model, data))
    return data if is_zero(model.tendon_armature) else mjx.tendon_bias(model, data)


@with_point_jacobians
def actuation(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_actuation`, with early activations, and a derivative where a tendon's force is zero."""
    return actuated(model, data)


def acceleration(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.fwd_acceleration`: the sum of all forces but the constraints', and the acceleration they would give."""
    if is_zero(data.xfrc_applied):
        force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied
    else:
        force = mjx.fwd_acceleration(model, data).qfrc_smooth
    return data.replace(qfrc_smooth=force, qacc_smooth=solve_definite(mjx.full_m(model, data), force))
