"""The rate of the Jacobian of connected and welded bodies, which MuJoCo C subtracts from the reference acceleration.

A row of an equality asks for J a + J' v = -b J v - k imp r. MJX leaves out J' v, the acceleration of the difference
while the joints' accelerations are zero: closed linkages in motion are wrong by as much.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics import rows, spatial
from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.dynamics.tree import tree_of
from nermo_mjx.shapes import Array


def with_rates(model: Model, data: mjx.Data) -> mjx.Data:
    """Data with J' v subtracted from the reference accelerations; after the position stage and `com_vel`."""
    kinds = np.asarray(model.eq_type)
    connects, welds = (np.flatnonzero(kinds == each) for each in (mjx.EqType.CONNECT, mjx.EqType.WELD))
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
    stiffness, aref, _ = rows.row_arrays(data)
    rate = jnp.concatenate(rates)
    return rows.with_row_arrays(data, stiffness, aref.at[: rate.size].add(-rate))


def _bodies(model: Model, chosen: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """The objects and the bodies of equalities, and which of them are about sites."""
    objects = [np.asarray(each)[chosen] for each in (model.eq_obj1id, model.eq_obj2id)]
    sites = np.asarray(model.eq_objtype)[chosen] == mjx.ObjType.SITE
    of_site = np.asarray(model.site_bodyid)
    return objects, [np.where(sites, of_site[np.where(sites, o, 0)], o) if sites.any() else o for o in objects], sites


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
        one, other = (jnp.where(sites[:, None], at, q) for at, q in zip(placed, (one, other), strict=True))
    turns, accelerations = ([each[body, :3] for body in (first, second)] for each in (data.cvel, motion))

    def pure(vector: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(vector[:, :1]), vector], 1)

    def row(one: Array, other: Array, turn: Array) -> Array:
        conjugate = other * np.array([1.0, -1.0, -1.0, -1.0]).astype(other.dtype)
        return 0.5 * spatial.product(spatial.product(conjugate, pure(turn)), one)[:, 1:]

    rates = [0.5 * spatial.product(pure(turn), q) for turn, q in zip(turns, (one, other), strict=True)]
    at = one, other, turns[0] - turns[1]
    found = jax.jvp(row, at, (*rates, accelerations[0] - accelerations[1]))[1]
    return found * model.eq_data[chosen, 10:11]
