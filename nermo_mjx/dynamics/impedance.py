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
        jnp.clip(bound, mjMINIMP, mjMAXIMP) for bound in (solimp[0], solimp[1], solimp[3])
    )
    power = jnp.maximum(1, solimp[4])
    is_direct, damped = solref[0] <= 0, solref[1] <= 0
    time, ratio = jnp.where(is_direct, 1.0, time), jnp.where(damped, 1.0, ratio)
    k = jnp.where(
        is_direct, -solref[0] / (high * high), 1 / (high * high * time * time * ratio * ratio)
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
        np.flatnonzero(kinds == kind) for kind in (mjx.EqType.CONNECT, mjx.EqType.WELD)
    )
    off = mjx.DisableBit.CONSTRAINT | mjx.DisableBit.EQUALITY
    if not (connects.size or welds.size) or model.opt.disableflags & off:
        return data
    motion = tree_of(model).moves.astype(data.qvel.dtype) @ (data.cdof_dot * data.qvel[:, None])
    rates = []
    for rows_of_kind in (connects, welds):
        if rows_of_kind.size:
            parts = [_points(model, data, motion, rows_of_kind)]
            if rows_of_kind is welds:
                parts.append(_turns(model, data, motion, rows_of_kind))
            active = data.eq_active[rows_of_kind].astype(motion.dtype)[:, None]
            rates.append((jnp.concatenate(parts, 1) * active).ravel())
    rate = jnp.concatenate(rates)
    data = data.tree_replace(
        {"_impl.efc_aref": rows.inner(data).efc_aref.at[: rate.size].add(-rate)}
    )
    return data


def _bodies(
    model: Model, equalities: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """The objects and the bodies of equalities, and which of them are about sites."""
    objects = [
        np.asarray(objects_of_end)[equalities]
        for objects_of_end in (model.eq_obj1id, model.eq_obj2id)
    ]
    sites = np.asarray(model.eq_objtype)[equalities] == mjx.ObjType.SITE
    of_site = np.asarray(model.site_bodyid)
    return (
        objects,
        [np.where(sites, of_site[np.where(sites, o, 0)], o) if sites.any() else o for o in objects],
        sites,
    )


def _points(
    model: Model, data: mjx.Data, motion: Array, equalities: np.ndarray
) -> Float[Array, "n 3"]:
    """Acceleration of the first anchors relative to the second."""
    objects, bodies, sites = _bodies(model, equalities)
    anchors = model.eq_data[equalities, 0:3], model.eq_data[equalities, 3:6]
    if model.eq_type[equalities[0]] == mjx.EqType.WELD:  # in the other order
        anchors = anchors[::-1]
    points = []
    for object_ids, body, anchor in zip(objects, bodies, anchors, strict=True):
        point = data.xpos[body] + jnp.sum(data.xmat[body] * anchor[:, None], -1)
        if sites.any():
            point = jnp.where(sites[:, None], data.site_xpos[np.where(sites, object_ids, 0)], point)
        arm = point - data.subtree_com[np.asarray(model.body_rootid)[body]]
        turn, shift = data.cvel[body, :3], data.cvel[body, 3:]
        acceleration = spatial.cross(turn, shift + spatial.cross(turn, arm))
        points.append(motion[body, 3:] + spatial.cross(motion[body, :3], arm) + acceleration)
    return points[0] - points[1]


def _turns(
    model: Model, data: mjx.Data, motion: Array, equalities: np.ndarray
) -> Float[Array, "n 3"]:
    """The rate of the rotational rows: half the vector part of conj(q_2) (0, w_1 - w_2) q_1, by the product rule."""
    objects, (first, second), sites = _bodies(model, equalities)
    first_quat, second_quat = data.xquat[first], data.xquat[second]
    first_quat = spatial.product(first_quat, model.eq_data[equalities, 6:10])
    if sites.any():
        placed = [
            spatial.product(data.xquat[body], model.site_quat[np.where(sites, object_ids, 0)])
            for object_ids, body in zip(objects, (first, second), strict=True)
        ]
        first_quat, second_quat = (
            jnp.where(sites[:, None], placed_quat, q)
            for placed_quat, q in zip(placed, (first_quat, second_quat), strict=True)
        )
    turns, accelerations = (
        [field[body, :3] for body in (first, second)] for field in (data.cvel, motion)
    )

    def pure(vector: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(vector[:, :1]), vector], 1)

    def row(first_quat: Array, second_quat: Array, turn: Array) -> Array:
        conjugate = second_quat * np.array([1.0, -1.0, -1.0, -1.0]).astype(second_quat.dtype)
        return 0.5 * spatial.product(spatial.product(conjugate, pure(turn)), first_quat)[:, 1:]

    rates = [
        0.5 * spatial.product(pure(turn), q)
        for turn, q in zip(turns, (first_quat, second_quat), strict=True)
    ]
    at = first_quat, second_quat, turns[0] - turns[1]
    rates_of_rows = jax.jvp(row, at, (*rates, accelerations[0] - accelerations[1]))[1]
    return rates_of_rows * model.eq_data[equalities, 10:11]
