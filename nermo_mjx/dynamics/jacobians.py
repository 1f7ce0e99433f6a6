"""Jacobians of points on bodies, with the tree known at trace time.

`mjx.jac` determines on the device, level by level, which velocities move a body, for each end of a tendon and each
contact: for this robot 130 of a step's launches on a GPU, though none of it depends on the state. Other functions deep
in MJX's stages with bad derivatives are replaced together with it.
"""

from __future__ import annotations

import functools
import threading
import types
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from mujoco import mjMINVAL
from mujoco.mjx._src import collision_sdf, constraint, math, smooth, support

from nermo_mjx.dynamics import spatial, wrapping
from nermo_mjx.dynamics.impedance import stiffness_damping_impedance
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.dynamics.tree import tree_of
from nermo_mjx.shapes import Array, Count, Scalar

P = ParamSpec("P")
T = TypeVar("T")
#: Held while MJX's functions are replaced, so that two tracing threads do not restore each other's.
_TRACING: Final = threading.RLock()


def point_jacobian(
    model: mjx.Model, data: mjx.Data, point: Float[Array, " 3"], body: Count | int
) -> tuple[Float[Array, "nv 3"], Float[Array, "nv 3"]]:
    """As `mjx.jac`: how a point on a body moves, and how the body turns, with each velocity."""
    moves = jnp.asarray(tree_of(model).moves, point.dtype)[body][:, None]
    arm = point - data.subtree_com[jnp.asarray(np.asarray(model.body_rootid))[body]]
    turns = data.cdof[:, :3] * moves
    return data.cdof[:, 3:] * moves + spatial.cross(turns, jnp.broadcast_to(arm, turns.shape)), turns


def muscle_time_constant(excess: Scalar, rising: Scalar, falling: Scalar, width: Scalar) -> Scalar:
    """As MJX's `muscle_dynamics_timescale`: from one time constant to the other over a width of excess excitation.

    MJX takes the fifth power of excess over width first, which is 0 by default: it overflows in float32.
    """
    share = jnp.clip(excess / jnp.maximum(width, mjMINVAL) + 0.5, 0.0, 1.0)
    smooth = falling + (rising - falling) * share**3 * (3.0 * share * (2.0 * share - 5.0) + 10.0)
    return jnp.where(width < mjMINVAL, jnp.where(excess > 0.0, rising, falling), smooth)


def axis_and_angle(q: Float[Array, " 4"]) -> tuple[Float[Array, " 3"], Scalar]:
    """As MJX's `quat_to_axis_angle`, of which only the product is used: here the rotation vector, and 1."""
    return spatial.rotation_vector(q), jnp.ones((), q.dtype)


def _segment_length(vector: Float[Array, " 3"]) -> Scalar:
    """Length of a tendon's segment, at least 1e-15 m: times its direction, that has the derivative of the vector."""
    none = ~jnp.any(vector)
    return jnp.where(none, mjMINVAL, jnp.linalg.norm(jnp.where(none, jnp.ones_like(vector), vector)))


def _segment_direction(vector: Array, length: Scalar) -> Array:
    """Its direction: that of MuJoCo, x, where it has no length."""
    first = jnp.zeros_like(vector).at[0].set(1.0)
    return vector / length + jnp.where(length <= mjMINVAL, first, 0.0)


#: What MJX's `smooth` takes from `math`, where `norm` and `safe_div` are those of tendons' segments.
_TENDONS_MATH: Final = types.SimpleNamespace(**{
    **vars(math), "norm": _segment_length, "safe_div": _segment_direction, "quat_to_axis_angle": axis_and_angle,
})  # fmt: skip


def with_point_jacobians(stage: Callable[P, T]) -> Callable[P, T]:
    """A function that calls stages of MJX, with the replacements of this module in place while it is traced."""
    ours = {
        (support, "jac"): point_jacobian, (support, "wrap_circle"): wrapping.circle,
        (support, "wrap_inside"): wrapping.inside, (support, "_length_circle"): wrapping.arc,
        (collision_sdf, "_cylinder"): spatial.cylinder_distance,
        (support, "muscle_dynamics_timescale"): muscle_time_constant, (math, "quat_to_axis_angle"): axis_and_angle,
        (constraint, "_kbi"): stiffness_damping_impedance, (smooth, "math"): _TENDONS_MATH,
    }  # fmt: skip

    @functools.wraps(stage)
    def traced(*args: P.args, **kwargs: P.kwargs) -> T:
        with _TRACING:
            before = {(home, name): getattr(home, name) for home, name in ours}
            for (home, name), function in ours.items():
                setattr(home, name, function)
            try:
                return stage(*args, **kwargs)
            finally:
                for (home, name), function in before.items():
                    setattr(home, name, function)

    return traced
