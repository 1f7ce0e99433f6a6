"""The reference of constraint rows as MuJoCo C has it, with a derivative by the impedance as well.

MJX computes an impedance as powers of x, the violation over `width`, and of 1 - x, and selects afterwards. Beyond the
width the latter is a negative number to an exponent that is data: NaN unless it is an integer, and its derivative by
the exponent is NaN anyway; a NaN times zero is a NaN. Here both are computed within their ranges.

A row of an equality asks for J a + J' v = -b J v - k imp r. MJX leaves out J' v, the acceleration of the difference
while the joints' accelerations are zero: closed linkages in motion are wrong by as much.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from mujoco import mjMAXIMP, mjMINIMP, mjMINVAL

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.dynamics.tree import tree_of
from nermo_mjx.shapes import Array, Scalar


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
    low, high, mid = (
        jnp.clip(each, mjMINIMP, mjMAXIMP) for each in (solimp[0], solimp[1], solimp[3])
    )
    power = jnp.maximum(1, solimp[4])
    given, damped = solref[0] <= 0, solref[1] <= 0
    time, ratio = jnp.where(given, 1.0, time), jnp.where(damped, 1.0, ratio)
    k = jnp.where(
        given, -solref[0] / (high * high), 1 / (high * high * time * time * ratio * ratio)
    )
    b = jnp.where(damped, -solref[1] / high, 2 / (high * time))
    x = jnp.abs(distance) / jnp.maximum(mjMINVAL, solimp[2])
    below, full = x < mid, x > 1.0
    # Selected, not clipped: at a tie the derivative of `clip` is a half.
    inner, outer = jnp.where(below, x, mid), jnp.where(below, mid, jnp.where(full, 1.0, x))
    rises = (1.0 / jnp.power(mid, power - 1)) * jnp.power(inner, power)
    ends = 1 - (1.0 / jnp.power(1 - mid, power - 1)) * jnp.power(1 - outer, power)
    impedance = jnp.where(full, high, low + jnp.where(below, rises, ends) * (high - low))
    return k, b, jnp.where(solimp[2] <= mjMINVAL, 0.5 * (low + high), impedance)


def with_rates(model: Model, data: mjx.Data) -> mjx.Data:
    """Data with J' v subtracted from the reference accelerations; after the position stage and `com_vel`."""
    kinds = np.asarray(model.eq_type)
    connects, welds = (
        np.flatnonzero(kinds == each) for each in (mjx.EqType.CONNECT, mjx.EqType.WELD)
    )
    off = mjx.DisableBit.CONSTRAINT | mjx.DisableBit.EQUALITY
    if not (connects.size or welds.size) or model.opt.disableflags & off:
        return data
    motion = tree_of(model).moves.astype(data.qvel.dtype) @ (data.cdof_dot * data.qvel[:, None])
    rates = []
    for chosen in (connects, welds):
        if chosen.size:
            parts = [_points(model, data, motion, chosen)]
            if chosen is welds:
                parts.append(_turns(model, data, motion, chosen))
            active = data.eq_active[chosen].astype(motion.dtype)[:, None]
            rates.append((jnp.concatenate(parts, 1) * active).ravel())
    rate = jnp.concatenate(rates)
    data = data.tree_replace(
        {"_impl.efc_aref": rows.inner(data).efc_aref.at[: rate.size].add(-rate)}
    )
    return data


def _bodies(
    model: Model, chosen: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """The objects and the bodies of equalities, and which of them are about sites."""
    objects = [np.asarray(each)[chosen] for each in (model.eq_obj1id, model.eq_obj2id)]
    sites = np.asarray(model.eq_objtype)[chosen] == mjx.ObjType.SITE
    of_site = np.asarray(model.site_bodyid)
    return (
        objects,
        [np.where(sites, of_site[np.where(sites, o, 0)], o) if sites.any() else o for o in objects],
        sites,
    )


def _points(model: Model, data: mjx.Data, motion: Array, chosen: np.ndarray) -> Float[Array, "n 3"]:
    """Acceleration of the first anchors relative to the second."""
    objects, bodies, sites = _bodies(model, chosen)
    anchors = model.eq_data[chosen, 0:3], model.eq_data[chosen, 3:6]
    if model.eq_type[chosen[0]] == mjx.EqType.WELD:  # in the other order
        anchors = anchors[::-1]
    found = []
    for thing, body, anchor in zip(objects, bodies, anchors, strict=True):
        point = data.xpos[body] + jnp.sum(data.xmat[body] * anchor[:, None], -1)
        if sites.any():
            point = jnp.where(sites[:, None], data.site_xpos[np.where(sites, thing, 0)], point)
        arm = point - data.subtree_com[np.asarray(model.body_rootid)[body]]
        turn, shift = data.cvel[body, :3], data.cvel[body, 3:]
        moved = spatial.cross(turn, shift + spatial.cross(turn, arm))
        found.append(motion[body, 3:] + spatial.cross(motion[body, :3], arm) + moved)
    return found[0] - found[1]


def _turns(model: Model, data: mjx.Data, motion: Array, chosen: np.ndarray) -> Float[Array, "n 3"]:
    """The rate of the rotational rows: half the vector part of conj(q_2) (0, w_1 - w_2) q_1, by the product rule."""
    objects, (first, second), sites = _bodies(model, chosen)
    one, other = data.xquat[first], data.xquat[second]
    one = spatial.product(one, model.eq_data[chosen, 6:10])
    if sites.any():
        placed = [
            spatial.product(data.xquat[body], model.site_quat[np.where(sites, thing, 0)])
            for thing, body in zip(objects, (first, second), strict=True)
        ]
        one, other = (
            jnp.where(sites[:, None], at, q) for at, q in zip(placed, (one, other), strict=True)
        )
    turns, accelerations = (
        [each[body, :3] for body in (first, second)] for each in (data.cvel, motion)
    )

    def pure(vector: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(vector[:, :1]), vector], 1)

    def row(one: Array, other: Array, turn: Array) -> Array:
        conjugate = other * np.array([1.0, -1.0, -1.0, -1.0]).astype(other.dtype)
        return 0.5 * spatial.product(spatial.product(conjugate, pure(turn)), one)[:, 1:]

    rates = [
        0.5 * spatial.product(pure(turn), q) for turn, q in zip(turns, (one, other), strict=True)
    ]
    at = one, other, turns[0] - turns[1]
    found = jax.jvp(row, at, (*rates, accelerations[0] - accelerations[1]))[1]
    return found * model.eq_data[chosen, 10:11]
