"""The sun in MuJoCo's images: overhead, following the robot."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

_DIRECTIONAL = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


def put_overhead(model: mujoco.MjModel) -> None:
    """Point the shadow-casting light straight down, in place.

    A slanting sun speckles the floor at the edge of the shadow map; one overhead also shows where the feet stand.
    """
    overhead = (model.light_type == _DIRECTIONAL) & (model.light_castshadow != 0)
    model.light_dir[overhead] = (0.0, 0.0, -1.0)
    model.light_pos[overhead, :2] = 0.0


def move_above(model: mujoco.MjModel, data: mujoco.MjData, point: Float[np.ndarray, " 3"]) -> None:
    """Move the sun to a point in the world [m], after `mj_camlight`; otherwise the robot walks out of its shadow
    map."""
    data.light_xpos[model.light_type == _DIRECTIONAL, :2] += point[:2]
