"""Parameters of the robot's body that a sweep may vary within one batch: servos, contact, springs, masses, lengths.

Defaults are those of the published robot. The thesis is silent on contact, servo gain and damping, and the damping of
knees, ankles and spine: contact and damping of joints are those of the author's model, servo gain and damping were
identified once from the published straight-line speeds, which hardly depend on them (docs/published_set_up.md). An
ensemble of other bodies matches these speeds as closely (`identified`). `physics.variation` writes them into model
fields.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import ROBOT_MASSES
from nermo_mjx.robot.quantity import group, parameter_tree, quantity
from nermo_mjx.robot.terrains import TerrainShape

#: Supply voltage at which the servos have their stall torque and their speed [V].
NOMINAL_VOLTAGE: Final = 6.0


@parameter_tree
class Servo:
    """All position servos (Power HD-DSM44 at 6 V).

    A direct-current motor that is driven with the share u of its supply voltage V turns with the torque

        tau = u T V / V0 - T k / V0 w,    -1 <= u <= 1,

    at the speed w, with the stall torque T at the nominal voltage V0 and the back-EMF constant k, seen at the output:
    its torque limit falls linearly from T V / V0 at rest to zero at the no-load speed V / k. The data sheet's 0.07 s
    for 60 degrees at 6 V are 0.40 V s/rad. The default is 0: `damping.hip` and `damping.pulley`, those of the author's
    model, already brake by as much as 0.39 V s/rad would.
    """

    kp: Any = quantity(
        19.11, unit="N m/rad", low=0.1, high=350.0, doc="proportional gain; see servo_limits"
    )
    kv: Any = quantity(
        0.01561, unit="N m s/rad", low=0.0, high=0.55, doc="velocity damping of the servo loop"
    )
    torque_limit: Any = quantity(0.157, unit="N m", low=0.01, high=2.0, doc="stall torque")
    spine_torque: Any = quantity(
        1.0,
        unit="1",
        low=0.01,
        high=1.0,
        doc="torque limit of the lateral spine's servo, over that of the others",
    )
    speed: Any = quantity(
        15.0, unit="rad/s", low=0.1, high=1000.0, doc="fastest change of the angle it aims at"
    )
    knee_range: Any = quantity(
        0.0, unit="rad", low=0.0, high=0.6, doc="by how much those of knees turn further"
    )
    supply_voltage: Any = quantity(
        NOMINAL_VOLTAGE,
        unit="V",
        low=3.0,
        high=9.0,
        doc="stall torque and speed are in proportion to it",
    )
    back_emf: Any = quantity(
        0.0,
        unit="V s/rad",
        low=0.0,
        high=2.0,
        doc="back-EMF constant at the output: supply voltage per no-load speed",
    )
    dead_band: Any = quantity(
        0.0, unit="rad", low=0.0, high=0.2, doc="error of its angle that it does not respond to"
    )
    backlash: Any = quantity(
        0.0, unit="rad", low=0.0, high=0.2, doc="free travel of its gears, from flank to flank"
    )
    idle_current: Any = quantity(
        0.008, unit="A", low=0.0, high=1.0, doc="of one servo without torque"
    )
    stall_current: Any = quantity(
        0.8, unit="A", low=0.0, high=10.0, doc="of one servo at its stall torque, at 6 V"
    )

    @property
    def stall_torque(self) -> Any:
        """Largest torque at this supply voltage [N m]."""
        return self.torque_limit * (self.supply_voltage / NOMINAL_VOLTAGE)

    @property
    def top_speed(self) -> Any:
        """Fastest change of the angle it aims at, at this supply voltage [rad/s]."""
        return self.speed * (self.supply_voltage / NOMINAL_VOLTAGE)

    @property
    def brake(self) -> Any:
        """Torque lost to the back-EMF per speed [N m s/rad]; it does not depend on the supply voltage."""
        return self.torque_limit * self.back_emf / NOMINAL_VOLTAGE


@parameter_tree
class Battery:
    """The battery, which feeds servos and electronics directly; only metrics depend on it."""

    capacity: Any = quantity(
        1.0, unit="A h", low=0.01, high=100.0, doc="charge of the full battery"
    )
    electronics_current: Any = quantity(
        0.3, unit="A", low=0.0, high=10.0, doc="drawn by everything but the servos"
    )


@parameter_tree
class Contact:
    """Rubber sole, and the tail's tip, on a mat; the impedance grows from zero with depth (continuous onset).

    With a damping ratio or an impedance of 0.3 the soles of a standing robot bounce in the steps of `fast`.

    Friction of the sole is that of the author's model (basic_scene.xml). His soles are nearly rigid: an impedance of
    0.9 at the first touch, of which the speed becomes a staircase in every parameter. Here a foot crosses the onset in
    tens of steps instead of two, so that slopes of the speed are those that a tuner sees. The soft ball yields by 2.3
    mm under the standing robot, which then stands as high as on balls of 2 mm that yield by 0.5 mm (docs/model.md,
    Contact). The tail is printed plastic: 0.4, as for the robot against a box; the author's has MuJoCo's 1.0. Friction
    with a box is that of plastic and printed parts on wood.
    """

    friction: Any = quantity(1.4, unit="1", low=0.05, high=5.0, doc="sliding friction of the sole")
    tail_friction: Any = quantity(
        0.4, unit="1", low=0.0, high=5.0, doc="sliding friction of the tail on the ground"
    )
    trunk_friction: Any = quantity(
        1.0, unit="1", low=0.0, high=5.0, doc="the same of chest, pelvis, head"
    )
    obstacle_friction: Any = quantity(
        0.4, unit="1", low=0.0, high=5.0, doc="friction of all parts on obstacles"
    )
    time_constant: Any = quantity(
        0.004, unit="s", low=0.004, high=0.1, doc="solref time constant; >= 2 time steps"
    )
    damping_ratio: Any = quantity(1.5, unit="1", low=0.5, high=10.0, doc="solref damping ratio")
    impedance: Any = quantity(0.95, unit="1", low=0.5, high=0.9999, doc="solimp at full depth")
    width: Any = quantity(
        0.005, unit="m", low=1e-5, high=0.02, doc="depth at which the full impedance is reached"
    )


@parameter_tree
class Stiffness:
    """Torsion springs of the compliant joints (Table A.1)."""

    front_knee: Any = quantity(0.135, unit="N m/rad", low=0.01, high=2.0, doc="front knee spring")
    rear_knee: Any = quantity(0.19, unit="N m/rad", low=0.01, high=2.0, doc="rear knee spring")
    ankle: Any = quantity(0.1, unit="N m/rad", low=0.01, high=2.0, doc="ankle spring")
    spine: Any = quantity(1.2, unit="N m/rad", low=0.1, high=20.0, doc="each spine joint")


@parameter_tree
class Damping:
    """Viscous damping of the joints: that of the author's model.

    Knees end at 0.5 N m s/rad: beyond, the tendon pulls at a leg that holds still, and its servo swings against it.
    """

    hip: Any = quantity(0.01, unit="N m s/rad", low=0.0, high=1.0, doc="hip and shoulder joints")
    knee: Any = quantity(0.005, unit="N m s/rad", low=0.0, high=0.5, doc="knee joints")
    ankle: Any = quantity(0.005, unit="N m s/rad", low=0.0, high=1.0, doc="ankle joints")
    spine: Any = quantity(0.01, unit="N m s/rad", low=0.0, high=1.0, doc="spine joints")
    pulley: Any = quantity(
        0.01, unit="N m s/rad", low=0.0, high=1.0, doc="pulleys of knees and spine, neck, head"
    )


@parameter_tree
class Mass:
    """Mass of everything in front of and behind the spine; parts keep their shares, and inertias scale with them.

    Defaults are those of Nermo-Lite; Nermo 4.1 has its own (`masses.ROBOT_MASSES`).
    """

    front: Any = quantity(
        ROBOT_MASSES["nermo_lite"][0],
        unit="kg",
        low=0.05,
        high=0.5,
        doc="torso, head, front legs and half the spine",
    )
    rear: Any = quantity(
        ROBOT_MASSES["nermo_lite"][1],
        unit="kg",
        low=0.03,
        high=0.5,
        doc="hip, rear legs, tail and half the spine",
    )


@parameter_tree
class Build:
    """How the built robot differs from its drawings: printed parts and tendons that were tied by hand.

    The controller does not know of it. A softness of n makes a taut tendon yield n times as far under the same force,
    and more slowly by the root of n; at 1 those of the legs yield by 0.02 to 0.05 mm under 10 N.
    """

    leg_slack: Any = quantity(
        0.0,
        unit="m",
        low=-0.002,
        high=0.004,
        doc="by how much all legs' tendons are too long; negative: too short",
    )
    front_slack: Any = quantity(
        0.0, unit="m", low=-0.002, high=0.004, doc="the same of the front legs, in addition"
    )
    rear_slack: Any = quantity(
        0.0, unit="m", low=-0.002, high=0.004, doc="the same of the rear legs, in addition"
    )
    spine_slack: Any = quantity(
        0.0, unit="m", low=0.0, high=0.004, doc="by how much the spine's tendons are too long"
    )
    front_softness: Any = quantity(
        1.0, unit="1", low=1.0, high=1000.0, doc="how soft the front legs' tendons are"
    )
    rear_softness: Any = quantity(
        1.0, unit="1", low=1.0, high=1000.0, doc="how soft the rear legs' tendons are"
    )
    spine_softness: Any = quantity(
        1.0, unit="1", low=1.0, high=1000.0, doc="how soft the spine's tendons are"
    )
    tendon_impedance: Any = quantity(
        0.0,
        unit="1",
        low=0.0,
        high=0.98,
        doc="impedance with which the legs' tendons go taut; 0: without a jump",
    )
    asymmetry: Any = quantity(
        0.0,
        unit="1",
        low=-0.5,
        high=0.5,
        doc="share by which the left knees' springs are stiffer, the right softer",
    )
    front_tilt: Any = quantity(
        0.0,
        unit="rad",
        low=-0.3,
        high=0.3,
        doc="turn of both front legs with their servos; positive: feet backward",
    )
    rear_tilt: Any = quantity(
        0.0,
        unit="rad",
        low=-0.3,
        high=0.3,
        doc="turn of both rear legs with their servos; positive: feet backward",
    )

    def slack(self, pair: str) -> Any:
        """By how much the tendons of the `front` or `rear` legs, or of the `spine`, are too long [m]."""
        return (
            self.spine_slack if pair == "spine" else self.leg_slack + getattr(self, f"{pair}_slack")
        )


@parameter_tree
class Ground:
    """Gravity in the frame of the ground: a slope turns gravity, not the scene, so heights and angles refer to the
    ground.

    In a scene that sets its own gravity, that is the default.
    """

    gravity: Any = quantity(9.81, unit="m/s^2", low=0.1, high=30.0, doc="acceleration of free fall")
    slope: Any = quantity(
        0.0, unit="rad", low=-0.8, high=0.8, doc="how steep the ground rises in its direction"
    )
    direction: Any = quantity(
        0.0,
        unit="rad",
        low=-np.pi,
        high=np.pi,
        doc="where it rises to: 0 is ahead at yaw 0, positive to the left",
    )


@parameter_tree
class ModelParameters:
    """All body parameters; every leaf may carry leading batch axes."""

    servo: Servo = group(Servo)
    battery: Battery = group(Battery)
    contact: Contact = group(Contact)
    stiffness: Stiffness = group(Stiffness)
    damping: Damping = group(Damping)
    mass: Mass = group(Mass)
    build: Build = group(Build)
    ground: Ground = group(Ground)
    terrain: TerrainShape = group(TerrainShape)
    geometry: Geometry = group(Geometry)


def is_shaped(names: Iterable[str]) -> bool:
    """Whether any of these parameters, of geometry and build, decides where a robot has its feet.

    >>> is_shaped(["build.rear_tilt"]), is_shaped(["build.asymmetry", "servo.kp"])
    (True, False)
    """
    return any(
        name.startswith(("geometry.", "build.")) and name != "build.asymmetry" for name in names
    )


# ---
# Gravity in the frame of the ground: its magnitude, and the steepness and direction of the slope.


def gravity_vector(gravity: Any, slope: Any, direction: Any, xp: Any = np) -> Any:
    """Acceleration of free fall in the frame of the ground, (3,) [m/s^2]: g (-u sin s, -cos s).

    Args:
        gravity: its magnitude g [m/s^2].
        slope: angle s at which the ground rises [rad].
        direction: of the rise, u = (sin d, -cos d): 0 is -y, the heading of a robot with yaw 0, and pi/2 is x, its
        left.
        xp: `numpy`, or `jax.numpy`.
    """
    along = -gravity * xp.sin(slope)
    return xp.stack(
        [along * xp.sin(direction), -along * xp.cos(direction), -gravity * xp.cos(slope)]
    )


def gravity_values(vector: np.ndarray) -> dict[str, float]:
    """The parameters `ground.*` of a gravity (3,) that points down."""
    x, y, z = map(float, vector)
    direction = math.atan2(-x, y) if x or y else 0.0
    return {
        "ground.gravity": math.hypot(x, y, z),
        "ground.slope": math.atan2(math.hypot(x, y), -z),
        "ground.direction": direction,
    }
