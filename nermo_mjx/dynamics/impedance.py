"""Constraint rows whose derivative with respect to the contacts' impedance is finite.

MJX computes the impedance of a contact as a power of its depth over `width`, with an exponent that is data. The
derivative of x^n with respect to n is NaN for x < 0, which occurs at depths beyond `width`, and a NaN times the zero
tangent of the exponent is a NaN. So the rows are computed from constant impedances, and the missing part of their
derivative is added here: D = imp / (w (1 - imp)) and aref = -b J v - k imp d (MuJoCo's documentation, "Modeling: Solver
parameters") depend on the impedance through imp, k and b.
"""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Float
from mujoco import mjMAXIMP, mjMINIMP

from nermo_mjx.dynamics import rows
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.shapes import Array, Scalar

#: Impedances of rows other than contacts; they have no derivatives.
OTHERS: Final = ("jnt_solimp", "dof_solimp", "tendon_solimp_lim", "tendon_solimp_fri", "eq_solimp")


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.make_constraint`, with derivatives to the contacts' `solimp`; those to its exponent and mid are zero."""
    constant = model.tree_replace({name: jax.lax.stop_gradient(getattr(model, name)) for name in OTHERS})
    solimp = rows.contact_solimp(data)
    made = mjx.make_constraint(constant, rows.with_contact_solimp(data, jax.lax.stop_gradient(solimp)))
    contacts = rows.contact_rows(model, data)
    if contacts is None or rows.is_unconstrained(made):
        return made
    stiffness, aref, jacobian = rows.row_arrays(made)
    others = len(aref) - len(contacts.solimp)
    distance = jnp.where(contacts.pushes & (contacts.distance < 0.0), contacts.distance, 0.0)
    shortest = 0.0 if model.opt.disableflags & mjx.DisableBit.REFSAFE else 2.0 * model.opt.timestep
    constants = contacts.solref, contacts.distance, distance, jacobian[others:] @ data.qvel, shortest
    changed = _with_impedance(stiffness[others:], aref[others:], contacts.solimp, *jax.lax.stop_gradient(constants))
    # Concatenated instead of updated in place, which XLA compiles to a loop on a CPU.
    joined = (jnp.concatenate([old[:others], new]) for old, new in zip((stiffness, aref), changed, strict=True))
    return rows.with_row_arrays(made, *joined)


@jax.custom_jvp
def _with_impedance(
    stiffness: Array,
    aref: Array,
    solimp: Array,
    solref: Array,
    depth: Array,
    pushed: Array,
    velocity: Array,
    shortest: Array,
) -> tuple[Array, Array]:
    """D and aref of the contacts' rows, unchanged; their derivatives include those by the impedance."""
    return stiffness, aref


@_with_impedance.defjvp
def _(primals: Any, tangents: Any) -> Any:
    stiffness, aref, solimp, solref, depth, pushed, velocity, shortest = primals

    def missing(solimp: Array) -> tuple[Array, Array]:
        spring, damper, imp = jax.vmap(reference, in_axes=(0, 0, 0, None))(solref, solimp, depth, shortest)
        return jnp.log(imp) - jnp.log1p(-imp), -damper * velocity - spring * imp * pushed

    _, (growth, shift) = jax.jvp(missing, (solimp,), (tangents[2],))
    return (stiffness, aref), (tangents[0] + stiffness * growth, tangents[1] + shift)


def reference(
    solref: Float[Array, " 2"], solimp: Float[Array, " 5"], distance: Scalar, shortest: Scalar
) -> tuple[Array, Array, Array]:
    """(k, b, imp): stiffness [1/s^2] and damping [1/s] of the reference acceleration, and the impedance.

    Args:
        solref: time constant [s] and damping ratio, or minus stiffness and minus damping.
        solimp: (dmin, dmax, width, mid, power).
        distance: of the surfaces, negative in contact [m].
        shortest: lower limit of the time constant [s]: two time steps, or 0 without MuJoCo's `refsafe`.
    """
    low, high = (jnp.clip(limit, mjMINIMP, mjMAXIMP) for limit in solimp[:2])
    mid, power = jax.lax.stop_gradient((jnp.clip(solimp[3], mjMINIMP, mjMAXIMP), jnp.maximum(solimp[4], 1.0)))
    x = jnp.clip(jnp.abs(distance) / jnp.maximum(solimp[2], 1e-15), 0.0, 1.0)
    first, second = jnp.minimum(x, mid), jnp.maximum(x, mid)
    share = jnp.where(
        x < mid, mid * (first / mid) ** power, 1.0 - (1.0 - mid) * ((1.0 - second) / (1.0 - mid)) ** power
    )
    standard = solref[0] > 0.0
    time, ratio = (jnp.where(standard, value, 1.0) for value in (jnp.maximum(solref[0], shortest), solref[1]))
    spring = jnp.where(standard, 1.0 / (high * time * ratio) ** 2, -solref[0] / high**2)
    damper = jnp.where(standard, 2.0 / (high * time), -solref[1] / high)
    return spring, damper, jnp.clip(low + share * (high - low), low, high)
