"""Measurements of the balance test in each world, and the criterion for passing. Plain NumPy, after the run."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.experiments.balance.protocol import COMPRESSION, PHASES, ROUTING, STANCE
from nermo_mjx.experiments.outcome import Column
from nermo_mjx.kinematics.attitude import attitude
from nermo_mjx.kinematics.balance import diagonal_distance
from nermo_mjx.kinematics.body import hips, shoulders
from nermo_mjx.kinematics.leg import forward, four_legs
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.geometry import Geometry

#: For each lifted limb, the front and the rear foot of the diagonal over which it may tip. The third standing foot is
#: the one opposite, 3 - limb: it carries the load if the centre of mass is inside the diagonal.
DIAGONAL: Final = ((1, 2), (0, 3), (0, 3), (1, 2))
#: Force above which a foot is in contact [N]. The sensor sums contact forces and reads exactly 0 without contact, so
#: any small number will do; this one is a thousandth of a foot's load.
TOUCH: Final = 0.001

ABOUT: Final = {
    "passed": Column("1", "upright, and the lifted foot clear of the ground"),
    "upright": Column("1", "no tilt, from the lift on, that would bring the lifted foot down again"),
    "clear": Column("1", "the lifted foot never touches the ground while it swings"),
    "contact_share": Column("1", "share of the swing with the lifted foot on the ground"),
    "clearance": Column("m", "least height of the lifted sole above the ground during the swing"),
    "tilt_max": Column("rad", "largest angle of the torso from upright, from the lift on"),
    "pitch_stand": Column("rad", "mean pitch on four feet, positive nose down"),
    "pitch_rest": Column("rad", "resting pitch: mean pitch with the leg lifted, at rest before it swings"),
    "roll_rest": Column("rad", "mean roll at the same time, positive leans left"),
    "pitch_swing_min": Column("rad", "least pitch during the swing"),
    "pitch_swing_max": Column("rad", "largest pitch during the swing"),
    "com_height": Column("m", "height of the centre of mass on four feet"),
    **{
        f"com_margin_{phase}": Column("m", f"{how} signed distance (5.35), {phase}: positive inside the diagonal")
        for phase, how in (("stand", "mean"), ("shift", "mean"), ("lift", "mean"), ("swing", "least"))
    },
    "third_share": Column("1", "share of the swing with the foot opposite the lifted one on the ground"),
    **{
        f"force_{phase}_{limb}": Column("N", f"mean force of the {limb.replace('_', ' ')} foot, {phase}")
        for phase in PHASES
        for limb in LIMBS
    },
}


@functools.cache
def tip_angle() -> float:
    """Rotation about the diagonal at which the lifted foot comes down again [rad].

    Height by which full compression lifts a foot, over that foot's distance from the diagonal, both from the kinematics
    of the level stance: 0.20 rad in front, 0.15 rad behind. The smaller one is used for all cases.
    """
    feet, raised = (
        np.asarray(forward(four_legs(Geometry()), STANCE + [[0.0, q2] for q2 in change], ROUTING).foot, float)
        for change in (np.zeros(4), COMPRESSION)
    )
    axes = np.concatenate([shoulders(Geometry()), hips(0.0, Geometry())])
    ground = axes[:, :2] + np.column_stack([np.zeros(4), feet[:, 0]])
    lever = [
        abs(float(diagonal_distance(ground[limb], ground[front], ground[rear])))
        for limb, (front, rear) in enumerate(DIAGONAL)
    ]
    return float(np.arctan((raised - feet)[:, 1] / lever).min())


def verdict(force: Float[np.ndarray, "*batch T"], tilt: Float[np.ndarray, "*batch S"]) -> tuple[np.ndarray, np.ndarray]:
    """Whether the robot stayed upright, and whether the lifted foot stayed clear; it passed if both are true.

    Args:
        force: of the lifted foot during the swing [N].
        tilt: of the torso from the lift on [rad]. Non-finite values do not pass.
    """
    return np.all(tilt < tip_angle(), axis=-1), np.all(force <= TOUCH, axis=-1)


def inside(limb: int, com: Float[np.ndarray, "T 3"], feet: Float[np.ndarray, "T 4 3"]) -> Float[np.ndarray, " T"]:
    """Distance of the centre of mass from the diagonal beside the lifted limb [m], positive towards the third foot."""
    com, feet = com[:, :2], feet[:, :, :2]
    front, rear = (feet[:, foot] for foot in DIAGONAL[limb])
    side = diagonal_distance(feet[:, 3 - limb], front, rear)
    return np.asarray(diagonal_distance(com, front, rear) * np.sign(side), float)


def centre_of_mass(model: mujoco.MjModel, qpos: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, "T 3"]:
    """Centre of mass of the whole robot [m], from the simulated model."""
    data, com = mujoco.MjData(model), np.full((len(qpos), 3), np.nan)
    root = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    for i in np.flatnonzero(np.isfinite(qpos).all(axis=1)):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        com[i] = data.subtree_com[root]
    return com


def readings(
    limb: int, model: mujoco.MjModel, qpos: np.ndarray, sensors: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Time histories of one world: `roll`, `pitch`, `tilt` (T,) [rad], `centre_of_mass` (T, 3) and `com_margin` [m].

    Args:
        limb: the lifted one.
        model: the simulated model.
        qpos: (T, nq).
        sensors: as named in `robot.Sensors`, (T, ...).
    """
    orientation = np.asarray(sensors["orientation"], float)
    roll, pitch, _ = np.asarray(attitude(jnp.asarray(orientation)), float).T
    up = 1.0 - 2.0 * (orientation[:, 1] ** 2 + orientation[:, 2] ** 2)
    com = centre_of_mass(model, qpos)
    return {
        "roll": roll,
        "pitch": pitch,
        "tilt": np.arccos(np.clip(up, -1.0, 1.0)),
        "centre_of_mass": com,
        "com_margin": inside(limb, com, sensors["foot_position"]),
    }


def measure(
    limb: int,
    time: Float[np.ndarray, " T"],
    sensors: Mapping[str, np.ndarray],
    shown: Mapping[str, np.ndarray],
    sole: float,
) -> dict[str, float | bool]:
    """All of `ABOUT` for one world.

    Args:
        limb: the lifted one.
        time: end of each tick on the protocol's clock [s].
        sensors, shown: as in `readings`, and its result.
        sole: radius of the sole [m].
    """

    def within(begin: float, end: float) -> np.ndarray:
        return (time > begin + 1e-6) & (time < end + 1e-6)

    force, pitch, margin = sensors["foot_force"], shown["pitch"], shown["com_margin"]
    still = {name: within(*phase.still) for name, phase in PHASES.items()}
    swing = still["swing"] = within(PHASES["swing"].begin, PHASES["swing"].end)
    upright, clear = verdict(force[swing, limb], shown["tilt"][within(PHASES["lift"].begin, math.inf)])
    height = sensors["foot_position"][swing, limb, 2] - sole
    values = {
        "passed": bool(upright and clear),
        "upright": bool(upright),
        "clear": bool(clear),
        "contact_share": np.mean(force[swing, limb] > TOUCH),
        "clearance": height.min(),
        "tilt_max": shown["tilt"][within(PHASES["lift"].begin, math.inf)].max(),
        "pitch_stand": pitch[still["stand"]].mean(),
        "pitch_rest": pitch[still["lift"]].mean(),
        "roll_rest": shown["roll"][still["lift"]].mean(),
        "pitch_swing_min": pitch[swing].min(),
        "pitch_swing_max": pitch[swing].max(),
        "com_height": shown["centre_of_mass"][still["stand"], 2].mean(),
        **{f"com_margin_{phase}": margin[still[phase]].mean() for phase in ("stand", "shift", "lift")},
        "com_margin_swing": margin[swing].min(),
        "third_share": np.mean(force[swing, 3 - limb] > TOUCH),
    }
    for phase, when in still.items():
        values |= {f"force_{phase}_{name}": force[when, i].mean() for i, name in enumerate(LIMBS)}
    return {name: values[name] for name in ABOUT}
