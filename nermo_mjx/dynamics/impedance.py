"""Constraint rows whose derivative is finite, by the impedance as well.

MJX computes an impedance as powers of x, the violation over `width`, and of 1 - x, and selects afterwards. Beyond the
width the latter is a negative number to an exponent that is data: NaN unless it is an integer, and its derivative by
the exponent is NaN anyway; a NaN times zero is a NaN. Here both are computed within their ranges.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float
from mujoco import mjMAXIMP, mjMINIMP, mjMINVAL

from nermo_mjx.dynamics import rows
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.shapes import Array, Scalar


def make_constraint(model: Model, data: mjx.Data) -> mjx.Data:
    """As `mjx.make_constraint`, of a `prepared` model, which may have more rows than the data was made for."""
    return rows.with_addresses(mjx.make_constraint(model, data))


def stiffness_damping_impedance(
    model: Model, solref: Float[Array, " 2"], solimp: Float[Array, " 5"], distance: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """As MJX's `_kbi`: k [1/s^2] and b [1/s] of the reference acceleration, and the impedance.

    Args:
        model: for the time step, a lower limit of the time constant unless MuJoCo's `refsafe` is disabled.
        solref: time constant [s] and damping ratio, or minus stiffness and minus damping.
        solimp: (dmin, dmax, width, midpoint, power), see MuJoCo's documentation, "Modeling: Solver parameters".
        distance: violation of the constraint.
    """
    time, ratio = solref
    if not model.opt.disableflags & mjx.DisableBit.REFSAFE:
        time = jnp.maximum(time, 2 * model.opt.timestep)
    low, high, mid = (jnp.clip(each, mjMINIMP, mjMAXIMP) for each in (solimp[0], solimp[1], solimp[3]))
    power = jnp.maximum(1, solimp[4])
    given, damped = solref[0] <= 0, solref[1] <= 0
    time, ratio = jnp.where(given, 1.0, time), jnp.where(damped, 1.0, ratio)
    k = jnp.where(given, -solref[0] / (high * high), 1 / (high * high * time * time * ratio * ratio))
    b = jnp.where(damped, -solref[1] / high, 2 / (high * time))
    x = jnp.abs(distance) / jnp.maximum(mjMINVAL, solimp[2])
    below, full = x < mid, x > 1.0
    # Selected, not clipped: at a tie the derivative of `clip` is a half.
    inner, outer = jnp.where(below, x, mid), jnp.where(below, mid, jnp.where(full, 1.0, x))
    rises = (1.0 / jnp.power(mid, power - 1)) * jnp.power(inner, power)
    ends = 1 - (1.0 / jnp.power(1 - mid, power - 1)) * jnp.power(1 - outer, power)
    impedance = jnp.where(full, high, low + jnp.where(below, rises, ends) * (high - low))
    return k, b, jnp.where(solimp[2] <= mjMINVAL, 0.5 * (low + high), impedance)
