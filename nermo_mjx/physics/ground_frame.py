"""Derivatives of the physics in a frame that travels with the robot.

On level ground the physics does not know where on it the robot is. In reverse mode that shows as a sum over all bodies
which must cancel, and in float32 cancels to a percent only. What is left acts like a force on the horizontal position,
which nothing takes back, and after some hundred steps it is as large as the gradient. Where the scene is level, the
derivative by the horizontal position is therefore written down instead of computed: the new position moves with the
old one, and nothing else does. Values do not change.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float


class GroundFrame:
    """The rule for one model; it does nothing where the scene is not level."""

    def __init__(self, model: mujoco.MjModel, root: int) -> None:
        """
        Args:
            model: of robot and scene.
            root: address of the robot's position in `qpos`.
        """
        self.level = is_level(model)
        self._place = slice(root, root + 2)
        places = (model.sensor_type == mujoco.mjtSensor.mjSENS_FRAMEPOS) & (model.sensor_refid < 0)
        self._readings = (model.sensor_adr[places][:, None] + np.arange(2)).ravel()

    def leave(self, qpos: Float[Array, " nq"]) -> tuple[Float[Array, " nq"], Float[Array, " 2"] | None]:
        """`qpos` without derivatives by the horizontal position, and a zero shift that has them."""
        if not self.level:
            return qpos, None
        place = qpos[self._place]
        fixed = jax.lax.stop_gradient(place)
        return qpos.at[self._place].set(fixed), place - fixed

    def enter(self, qpos: Float[Array, " nq"], shift: Float[Array, " 2"] | None) -> Float[Array, " nq"]:
        """`qpos` that moves with the shift."""
        return qpos if shift is None else qpos.at[self._place].add(shift)

    def enter_readings(self, sensordata: Float[Array, " n"], shift: Float[Array, " 2"] | None) -> Float[Array, " n"]:
        """Sensor readings of which the positions in the world move with the shift."""
        if shift is None or not len(self._readings):
            return sensordata
        return sensordata.at[self._readings].add(jnp.tile(shift, len(self._readings) // 2))


def is_level(model: mujoco.MjModel) -> bool:
    """Whether all that the robot can touch is level ground: planes across z, and no wall, field, tie or moving thing."""
    if model.neq or model.nmocap or np.any(model.geom_contype | model.geom_conaffinity):
        return False
    touched = np.union1d(model.pair_geom1, model.pair_geom2)
    fixed = touched[model.body_weldid[model.geom_bodyid[touched]] == 0]
    planes = (model.geom_type[fixed] == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid[fixed] == 0)
    upright = np.abs(model.geom_quat[fixed, 1:3]).max(axis=1, initial=0.0) < 1e-9
    sites = model.wrap_objid[model.wrap_type == mujoco.mjtWrap.mjWRAP_SITE]
    tied = model.body_weldid[model.site_bodyid[sites]] == 0
    return bool((planes & upright).all() and not tied.any())
