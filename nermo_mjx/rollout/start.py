"""The start pose of a world: in the posture of its gait, level, at rest, and on the ground."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.protocol import ControllerLike
from nermo_mjx.kinematics import spine
from nermo_mjx.kinematics.body import feet_positions, hips, shoulders
from nermo_mjx.kinematics.leg import forward, four_legs
from nermo_mjx.robot import Robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.terrains import TerrainShape
from nermo_mjx.rollout.lanes import Lanes
from nermo_mjx.rollout.parameters import Start
from nermo_mjx.shapes import Array

#: Tendons start longer than their limit by this much, as when loaded [m]. At the limit itself rounding would determine
#: whether a tendon holds or its knee springs loose in the first step.
TAUT: Final = 2e-5
#: Initial penetration of the lowest sole [m]. On the surface rounding would determine whether it touches in the first
#: steps, which moves the robot by 0.1 micrometres.
DEPTH: Final = 1e-5

#: Half-widths of the start's perturbation that makes repeats differ: a millimetre, a degree, a fiftieth of a cycle.
START_SPREAD: Final = {"start.x": 1e-3, "start.y": 1e-3, "start.yaw": math.radians(1.0), "start.phase": 0.02}


@dataclasses.dataclass(frozen=True, eq=False)
class StartPose:
    """Maps parameters to `qpos`."""

    robot: Robot
    controller: ControllerLike

    def qpos(
        self, control: Any, start: Start, terrain: TerrainShape | None = None, geometry: Geometry | None = None
    ) -> Float[Array, " nq"]:
        """Positions of one world (leaves of shape ()); torso level, the body's mean heading `start.yaw` from -y.

        Args:
            control: the controller's parameters.
            start: position, heading and phase.
            terrain: shape of the ground, see `Terrain.height`.
            geometry: of the body, by default the published one.
        """
        geometry = geometry or Geometry()
        servo = self.controller.initial_servo(control, start.phase)
        legs = four_legs(geometry)
        eased = servo.knee + legs.servo_direction * TAUT / legs.pulley_radius
        pose = forward(legs, jnp.stack([servo.hip, eased], axis=-1), self.robot.config.routing)
        bend = spine.joint_angle(servo.spine, geometry)
        lifted = spine.joint_angle(servo.spine_vertical, geometry) if self.robot.joints.spine_vertical else None
        axis_height = jnp.concatenate([shoulders(geometry)[:, 2], hips(bend, geometry)[:, 2]])
        # A bent spine turns torso and hip to opposite sides of the robot's heading; the total bend is 4 theta_v.
        yaw = start.yaw + 0.5 * 4 * bend
        # The ground's height differs between feet; the foot that requires the greatest height determines the body's.
        x, y, z = jnp.moveaxis(feet_positions(bend, pose.foot, geometry, lifted), -1, 0)
        cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
        place = start.x + cosine * x - sine * y, start.y + sine * x + cosine * y
        beneath = self.robot.terrain.height(*place, terrain)
        # The vertical spine turns the legs by up to half a radian, the lateral one by a few hundredths.
        below = axis_height + pose.foot[:, 1] if lifted is None else z
        height = jnp.max(geometry.foot.radius - DEPTH - below + beneath)

        joints, half = self.robot.joints, yaw / 2
        zero = jnp.zeros_like(half)
        root = jnp.stack([zero + start.x, zero + start.y, height, jnp.cos(half), zero, zero, jnp.sin(half)])
        qpos = jnp.asarray(self.robot.model.qpos0, float).at[joints.root : joints.root + 7].set(root)
        qpos = qpos.at[np.array(joints.hip)].set(servo.hip).at[np.array(joints.pulley)].set(servo.knee)
        hinges = self.robot.config.hinges  # bend equally
        qpos = qpos.at[np.array(joints.knee)].set(pose.knee_angle[:, None] / hinges)
        qpos = qpos.at[np.array(joints.spine)].set(bend / hinges).at[joints.spine_pulley].set(servo.spine)
        if lifted is None:
            return qpos
        pulley = np.array(joints.spine_vertical_pulley)
        return qpos.at[np.array(joints.spine_vertical)].set(lifted / hinges).at[pulley].set(servo.spine_vertical)

    def batch(
        self, control: Any, start: Start, terrain: TerrainShape | None = None, geometry: Geometry | None = None
    ) -> np.ndarray:
        """Positions of all worlds, (n, nq), from leaves with a leading world axis."""
        return np.asarray(self._batched(control, start, terrain, geometry), float)

    @functools.cached_property
    def _batched(self) -> Lanes:
        return Lanes(self.qpos)
