"""Jacobians of points on bodies, with the tree known when a program is traced.

`mjx.jac` finds out on the device, level by level, which velocities move a body, for each end of a tendon and each
contact: for this robot 130 of a step's launches on a GPU, and nothing that depends on the state.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from mujoco.mjx._src import support

from nermo_mjx.dynamics import spatial, wrapping
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.dynamics.tree import tree_of
from nermo_mjx.shapes import Array, Count

P = ParamSpec("P")
T = TypeVar("T")
#: Held while MJX's own function is replaced: of two threads that trace, neither must restore the other's.
_TRACING: Final = threading.RLock()


def point_jacobian(
    model: mjx.Model, data: mjx.Data, point: Float[Array, " 3"], body: Count | int
) -> tuple[Float[Array, "nv 3"], Float[Array, "nv 3"]]:
    """As `mjx.jac`: how a point on a body moves, and how the body turns, with each velocity."""
    moves = jnp.asarray(tree_of(model).moves, point.dtype)[body][:, None]
    arm = point - data.subtree_com[jnp.asarray(np.asarray(model.body_rootid))[body]]
    turns = data.cdof[:, :3] * moves
    return data.cdof[:, 3:] * moves + spatial.cross(turns, jnp.broadcast_to(arm, turns.shape)), turns


def with_point_jacobians(stage: Callable[P, T]) -> Callable[P, T]:
    """A function that calls stages of MJX, which take Jacobians and wraps of tendons from here while it is traced."""
    ours = {
        "jac": point_jacobian, "wrap_circle": wrapping.circle, "wrap_inside": wrapping.inside,
        "_length_circle": wrapping.arc,
    }  # fmt: skip

    @functools.wraps(stage)
    def traced(*args: P.args, **kwargs: P.kwargs) -> T:
        with _TRACING:
            before = {name: getattr(support, name) for name in ours}
            vars(support).update(ours)
            try:
                return stage(*args, **kwargs)
            finally:
                vars(support).update(before)

    return traced
