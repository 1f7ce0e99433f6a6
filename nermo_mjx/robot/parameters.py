"""Numbers of the robot, from A. Rohregger, "Digital Nermo" (Master's thesis, TU Munich, 2021), with its errata.

Frames: x to the robot's left, y backward (the head points to -y), z up. SI units and radians.
Limb order everywhere: front left, front right, rear left, rear right.

Sign convention, stated once: positive spine servo angle, positive spine joint angle theta_v, positive turn rate and
positive yaw all mean a turn to the **left** (counter-clockwise seen from above). The lateral joint angles of the DH
chain (Table 5.3) are therefore -theta_v. Erratum: (5.26) and the published code disagree about this sign.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

LIMBS: Final = ("front_left", "front_right", "rear_left", "rear_right")
GAITS: Final = ("trt", "trt1", "lat")
ROUTINGS: Final = ("type1", "type2", "type3")


@dataclasses.dataclass(frozen=True)
class LegGeometry:
    """One leg in its sagittal plane; (y, z) are relative to the hip or shoulder axis O [A.4, A.2.2].

    Attributes:
        l1, l2, l3, l4: upper leg, knee to tendon attachment B, knee to ankle, ankle to foot [m].
        theta3: constant ankle angle [rad].
        pulley_radius: r_p of the knee servo's pulley [m].
        pulley_height: d1, the pulley centre E above O [m].
        tendon_length: l_t0, pulling length of the tendon at servo angle 0 [m].
        knee_direction: s of the leg model, -1 front and +1 rear.
        servo_direction: k of the tendon law, +1 front and -1 rear (the published servo convention).
        guide: C, the fixed guide point of tendon routing type 2 (y, z) [m].
    """

    l1: float
    l2: float
    l3: float
    l4: float
    theta3: float
    pulley_radius: float
    pulley_height: float
    tendon_length: float
    knee_direction: float
    servo_direction: float
    guide: tuple[float, float]


FRONT_LEG: Final = LegGeometry(
    l1=0.0295, l2=0.0145, l3=0.0225, l4=0.0145, theta3=math.radians(23), pulley_radius=0.008, pulley_height=0.0128,
    tendon_length=0.033, knee_direction=-1.0, servo_direction=1.0, guide=(-0.004, -0.002),
)  # fmt: skip
REAR_LEG: Final = LegGeometry(
    l1=0.0317, l2=0.0200, l3=0.0305, l4=0.0205, theta3=math.radians(73), pulley_radius=0.008, pulley_height=0.0128,
    tendon_length=0.032, knee_direction=1.0, servo_direction=-1.0, guide=(0.004, -0.002),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class SpineGeometry:
    """The spine: a modified DH chain and the antagonist tendons that bend it.

    Attributes:
        dh: 11 rows (alpha_prev [rad], a_prev [m], theta [rad], d [m]) of Table 5.3.
        lateral_joints: 0-based rows that bend sideways, each by -theta_v (see the module's sign convention).
        vertical_joints: 0-based rows that bend up and down: fused on Nermo-Lite, actuated on Nermo 4.1.
        segment_length: l_v, length of a tendon segment across a straight joint [m] (5.26).
        segment_offset: d_1, its distance from the spine axis [m].
        pulley_radius: r_sp of the spine servo's pulley [m].
        max_joint_angle: limit of theta_v in the experiments [rad] (A.4.2).
        max_servo_angle: servo angle that bends each joint by about that limit [rad].
    """

    dh: tuple[tuple[float, float, float, float], ...]
    lateral_joints: tuple[int, ...] = (2, 4, 6, 8)
    vertical_joints: tuple[int, ...] = (1, 3, 5, 7)
    segment_length: float = 0.003
    segment_offset: float = 0.00625
    pulley_radius: float = 0.0065
    max_joint_angle: float = 0.1
    max_servo_angle: float = 0.4


def _row(alpha_deg: float, a: float, theta_deg: float) -> tuple[float, float, float, float]:
    return math.radians(alpha_deg), a, math.radians(theta_deg), 0.0


SPINE: Final = SpineGeometry(
    dh=(
        _row(0, 0.0, 90.0),
        _row(90, 0.0016, -10.7),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, -7.0),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, -6.9),
        _row(-90, 0.0070, 0.0),
        _row(90, 0.0070, 9.7),
        _row(-90, 0.0092, 0.0),
        _row(90, 0.0014, 15.0),
        _row(-90, 0.0, -90.0),
    )
)


@dataclasses.dataclass(frozen=True)
class BodyGeometry:
    """Where the limbs sit; left side, the right side mirrors x [A.5, with errata].

    Attributes:
        shoulder: shoulder axis from the spine base, in the torso's frame [m].
        hip: hip axis from the spine end, in the hip's frame [m]. Table A.5 gives hip and spine end from the spine base.
    """

    shoulder: tuple[float, float, float] = (0.0368, -0.0615, -0.0324)
    hip: tuple[float, float, float] = (0.0428, 0.0604 - 0.0517, -0.0253 + 0.0154)


BODY: Final = BodyGeometry()


@dataclasses.dataclass(frozen=True)
class GaitPattern:
    """A published gait [A.2, A.6]: stance share of the cycle, stance offsets of the limbs, gait factor of (5.21)."""

    duty: float
    offsets: tuple[float, float, float, float]
    gait_factor: float


GAIT_PATTERNS: Final[dict[str, GaitPattern]] = {
    "trt": GaitPattern(0.50, (0.50, 0.00, 0.00, 0.50), 2.00),  # ideal trot
    "trt1": GaitPattern(0.60, (0.50, 0.00, 0.00, 0.50), 1.67),  # walking trot
    "lat": GaitPattern(0.68, (0.63, 0.14, 0.00, 0.54), 1.47),  # lateral sequence walk
}
