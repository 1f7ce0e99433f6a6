"""The body alone: its dimensions and mass, and the deflection of its joints under the published load on test stands.

There is no walking here. The load case is that of the publication's finite-element analysis, 0.125 N m on a joint; the
springs have the published stiffnesses, so this checks their modelling.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.experiments.cases import LABELS
from nermo_mjx.experiments.outcome import BODY, Column, Outcome
from nermo_mjx.experiments.settings import Settings, body_count
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.robot import LIMBS, ModelParameters, ParameterError, assemble_leg, assemble_spine, load_robot
from nermo_mjx.robot.equipment import VISUAL_GROUP
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.interface import SERVO_RANGE
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import check_quantities, quantities, replace_quantities

NAME: Final = "body"
#: Torque of the published load case [N m].
TORQUE: Final = 0.125
#: Time allowed for a loaded joint to come to rest [s].
_REST: Final = 4.0
SETTABLE: Final = frozenset(name for name, _ in quantities(ModelParameters) if not name.startswith("geometry."))
ABOUT: Final = {
    "mass": Column("kg", "of the whole robot"),
    "servos": Column("1", "servos, with that of the articulated tail"),
    "length": Column("m", "from the nose to the tip of the tail, standing, by the visible parts"),
    "height": Column("m", "from the ground, standing, by the visible parts"),
    "width": Column("m", "over all visible parts, standing"),
    "scapula_pelvis": Column("m", "from the shoulder axes to the hip axes, along the robot"),
    "bend_front_knee": Column("rad", f"of a front knee under {TORQUE:g} N m"),
    "bend_rear_knee": Column("rad", f"of a rear knee under {TORQUE:g} N m"),
    "bend_spine": Column("rad", f"of the four spine joints together, each under {TORQUE:g} N m"),
    "spine_joint_limit": Column("rad", "angle of each spine joint at the end of the servo's range (5.26)"),
}


def run(settings: Settings) -> Outcome:
    """Measure the body; one row per profile, with the same values.

    There are no repeats, and the engine is always MuJoCo C.

    Raises:
        ParameterError: a parameter that does not belong to the body.
    """
    bodies, count = settings.bodies or {}, body_count(settings.bodies)
    for name in {**settings.values, **bodies}:
        choice("values", name, sorted(SETTABLE))
    rows: list[dict[str, Any]] = []
    for body in range(max(count, 1)):
        own = {name: float(of[body]) for name, of in bodies.items()}
        measured = _measured(tuple(sorted({**settings.values, **own}.items())))
        numbered = {BODY: body + 1} if count else {}
        rows += [{"profile": profile, **numbered, "repeat": 0, **measured} for profile in settings.profiles]
        if settings.progress:
            settings.progress((body + 1) / max(count, 1))
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return Outcome(NAME, columns, {name: LABELS[name] for name in ("profile", "repeat", BODY)} | ABOUT, {})


def _measured(values: tuple[tuple[str, float], ...]) -> dict[str, float]:
    """`ABOUT` of one body."""
    parameters = replace_quantities(ModelParameters(), {name: np.asarray(value) for name, value in values})
    check_quantities(parameters)
    numbers = _dimensions() | {"mass": float(parameters.mass.front + parameters.mass.rear)}
    # Only these determine where a loaded joint rests; bodies that share them are simulated once.
    stiffness = tuple((name, value) for name, value in values if name.startswith("stiffness."))
    numbers |= {f"bend_{pair}_knee": _knee_bend(pair, stiffness) for pair in ("front", "rear")}
    return {name: (numbers | {"bend_spine": _spine_bend(stiffness)})[name] for name in ABOUT}


@functools.cache
def _dimensions() -> dict[str, float]:
    robot = load_robot()
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    corners = np.array([_outline(model, data, geom) for geom in range(model.ngeom) if _is_seen(model, geom)])
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    soles = [model.geom(f"{limb}_sole") for limb in LIMBS]
    ground = min(data.geom_xpos[sole.id, 2] - sole.size[0] for sole in soles)
    axes = [data.site(f"{pair}_left_axis").xpos[1] for pair in ("front", "rear")]
    return {
        "servos": float(load_robot(tail="articulated").n_servos),
        "length": float(high[1] - low[1]),
        "height": float(high[2] - ground),
        "width": float(high[0] - low[0]),
        "scapula_pelvis": float(axes[1] - axes[0]),
        "spine_joint_limit": float(joint_angle(np.asarray(SERVO_RANGE["spine"][1]), Geometry())),
    }


def _is_seen(model: Any, geom: int) -> bool:
    return model.geom_bodyid[geom] > 0 and model.geom_group[geom] == VISUAL_GROUP


def _outline(model: Any, data: Any, geom: int) -> np.ndarray:
    """Smallest and largest coordinates of a geom in the world, (2, 3) [m]."""
    turned, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        first, number = int(mesh.vertadr[0]), int(mesh.vertnum[0])
        points = place + model.mesh_vert[first : first + number] @ turned.T
        return np.stack([points.min(axis=0), points.max(axis=0)])
    centre, half = place + turned @ model.geom_aabb[geom][:3], np.abs(turned) @ model.geom_aabb[geom][3:]
    return np.stack([centre - half, centre + half])


@functools.cache
def _knee_bend(pair: str, stiffness: tuple[tuple[str, float], ...]) -> float:
    """Deflection of a knee under the load, without its tendon, so that only its spring resists [rad]."""
    limb = f"{pair}_left"
    spec = assemble_leg(limb, parameters=replace_quantities(ModelParameters(), dict(stiffness)))
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    free, loaded = (_at_rest(spec, {f"{limb}_knee": torque}) for torque in (0.0, TORQUE))
    return float(loaded.joint(f"{limb}_knee").qpos[0] - free.joint(f"{limb}_knee").qpos[0])


@functools.cache
def _spine_bend(stiffness: tuple[tuple[str, float], ...]) -> float:
    """Deflection of the four joints in series under the load, with the servo off [rad]."""
    spec = assemble_spine(parameters=replace_quantities(ModelParameters(), dict(stiffness)))
    joints = [f"spine_joint_{i}" for i in range(1, 5)]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    loaded = _at_rest(spec, dict.fromkeys(joints, TORQUE))
    return float(sum(loaded.joint(joint).qpos[0] for joint in joints))


def _at_rest(spec: Any, torque: Mapping[str, float]) -> Any:
    """The stand at rest with its servos at 0 and constant torques on its joints [N m].

    Raises:
        ParameterError: it does not come to rest.
    """
    model = spec.compile()
    data = mujoco.MjData(model)
    for joint, value in torque.items():
        data.joint(joint).qfrc_applied = value
    for _ in range(round(_REST / model.opt.timestep)):
        mujoco.mj_step(model, data)
    if not np.abs(data.qvel).max() < 1e-2:
        raise ParameterError(f"the stand of {spec.modelname} does not come to rest with these parameters.")
    return data
