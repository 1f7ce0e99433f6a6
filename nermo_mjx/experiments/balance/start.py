"""Start poses of the balance test: on four feet, slightly perturbed, differently for each repeat."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation

from nermo_mjx.experiments.balance.protocol import ROUTING, STANCE
from nermo_mjx.kinematics.body import hips, shoulders
from nermo_mjx.kinematics.leg import forward, four_legs
from nermo_mjx.robot import LIMBS, Robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.rollout.start import TAUT

#: Repeats differ by up to this much, up and down: position of the body [m], its attitude and the leg servos [rad].
PLACE, TURN = 0.001, math.radians(1.0)


@dataclasses.dataclass(frozen=True)
class Nudge:
    """The perturbation of a repeat's start: position (3,) [m] (the third is a drop, not negative), attitude (3,) about
    x, y and z [rad], and q1, q2 of the legs (4, 2) [rad]."""

    place: np.ndarray
    turn: np.ndarray
    servo: np.ndarray


def nudge(seed: int, case: int, repeat: int) -> Nudge:
    """Uniform draws, which for a repeat do not depend on the rest of the batch."""
    draw = np.random.default_rng([seed, case, repeat])
    place = draw.uniform(-PLACE, PLACE, 3)
    place[2] = abs(place[2])
    return Nudge(place, draw.uniform(-TURN, TURN, 3), draw.uniform(-TURN, TURN, (4, 2)))


def start_pose(robot: Robot, start: Nudge) -> np.ndarray:
    """Positions (nq,): heading -y, the four soles of the neutral stance level with the ground, then perturbed."""
    legs = four_legs(Geometry())
    axes = np.concatenate([shoulders(Geometry()), hips(0.0, Geometry())]).astype(float)
    neutral = _soles(axes, np.asarray(forward(legs, STANCE, ROUTING).foot, float))
    # Front and rear legs differ in length, so the torso pitches by a fraction of a degree when all four feet stand.
    pitch = math.atan2(neutral[0, 2] - neutral[2, 2], neutral[2, 1] - neutral[0, 1])

    servo = STANCE + start.servo
    eased = servo + np.stack([np.zeros(4), legs.servo_direction * TAUT / legs.pulley_radius], axis=-1)
    pose = forward(legs, eased, ROUTING)
    attitude = Rotation.from_euler("ZXY", start.turn[[2, 0, 1]] + np.array([0.0, pitch, 0.0]))
    lowest = attitude.apply(_soles(axes, np.asarray(pose.foot, float)))[:, 2].min()
    radius = robot.model.geom(f"{LIMBS[0]}_sole").size[0]

    qpos, joints = robot.model.qpos0.copy(), robot.joints
    qpos[joints.root : joints.root + 3] = start.place + np.array([0.0, 0.0, radius - lowest])
    qpos[joints.root + 3 : joints.root + 7] = attitude.as_quat(scalar_first=True)
    qpos[list(joints.hip)], qpos[list(joints.pulley)] = servo.T
    qpos[np.array(joints.knee)] = pose.knee_angle[:, None] / robot.config.hinges
    return qpos


def _soles(axes: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Feet (4, 3) in the torso's frame, from the axes of the legs (4, 3) and the feet (4, 2) = (y, z) from them."""
    return axes + np.column_stack([np.zeros(4), feet])
