"""Experiments without a walk: dimensions of the robot, and test stands of its parts in MuJoCo C without gravity.

The load case is 0.125 N m on a joint, as in the finite element analysis of the publication (A.1). The springs have the
published stiffnesses, so that this experiment checks the model of the joints, with one hinge and with chains of hinges.
The stand of the leg compares the routings of the knee's tendon; section 5.1.2 of the publication describes how their
lever arms and couplings differ.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import jax
import mujoco
import numpy as np

from nermo_mjx.experiments.cases import BODY, CaseRuns, Settings
from nermo_mjx.kinematics import leg
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.robot import (
    LIMBS,
    ModelParameters,
    ParameterError,
    assemble_leg,
    assemble_spine,
    load_robot,
)
from nermo_mjx.robot.equipment import VISUAL_GROUP, chain_of
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.parameters import LEGS, ROUTINGS, SERVO_RANGE, SPINE_GEOMETRY
from nermo_mjx.robot.quantity import (
    check_quantities,
    choice,
    quantities,
    replace_quantities,
    values_of,
)

#: Torque of the published load case [N m].
TORQUE: Final = 0.125
#: Parameters that can be set for the body, and for the stands, which have no motors and gears.
BODY_SETTABLE: Final = frozenset(
    name for name, _ in quantities(ModelParameters) if not name.startswith("geometry.")
)
STAND_SETTABLE: Final = BODY_SETTABLE - {
    f"servo.{name}" for name in ("supply_voltage", "back_emf", "dead_band", "backlash")
}
#: Time in which a stand usually comes to rest [s]; maximum number of these times, for low damping; and duration of a slow
#: motion or a slowly growing load, with little effect of inertia and damping [s].
REST, PATIENCE, SLOW = 2.0, 15, 8.0
#: Speed of joints below which a stand is at rest [rad/s].
RESTING_SPEED: Final = 2e-3
#: A servo counts as saturated at this share of its torque limit.
_SATURATED: Final = 0.999
#: Numbers of hinges whose bend is compared.
HINGES: Final = (1, 2, 4)


class Stand:
    """A simulation of a part on its test stand.

    Args:
        spec: Result of `assemble_leg` or `assemble_spine`.
    """

    def __init__(self, spec: Any) -> None:
        self.name = spec.modelname
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def settle(self, servo: Any, times: int = 1) -> Stand:
        """Command the servos, and simulate until the part is at rest.

        Args:
            servo: Servo angles [rad].
            times: Minimum duration, as a multiple of `REST`.

        Raises:
            ParameterError: The part does not come to rest.
        """
        self.data.ctrl[:] = servo
        for waited in range(1, PATIENCE + 1):
            # A swing is also without speed at its ends: the fastest moment of the last quarter counts.
            speed = 0.0
            for step in range(steps := self._steps(REST)):
                mujoco.mj_step(self.model, self.data)
                if step >= 0.75 * steps:
                    speed = max(speed, np.abs(self.data.qvel).max())
            mujoco.mj_forward(self.model, self.data)
            if waited >= times and speed < RESTING_SPEED:
                return self
        raise ParameterError(
            f"the stand of {self.name} does not come to rest with these parameters."
        )

    def site(self, name: str) -> np.ndarray:
        """Position of a site [m]."""
        return np.array(self.data.site(name).xpos)

    def angle(self, joint: str) -> float:
        """Angle of a joint, the sum over its hinges [rad]."""
        model = self.model
        joint_ids = [i for i in range(model.njnt) if chain_of(model.joint(i).name) == joint]
        return float(sum(self.data.qpos[model.jnt_qposadr[i]] for i in joint_ids))

    def held(self, site: str, direction: Sequence[float], largest_force: float) -> float:
        """Force at a site, along a direction, at which a servo reaches its torque limit [N].

        The force grows slowly up to `largest_force` [N]; NaN if no servo reaches its limit.
        """
        model, data, site_id = self.model, self.data, self.model.site(site).id
        body, steps = int(model.site_bodyid[site_id]), self._steps(SLOW)
        limit = _SATURATED * model.actuator_forcerange[:, 1]
        for step in range(steps):
            force = largest_force * step / steps * np.asarray(direction)
            arm = data.site_xpos[site_id] - data.xipos[body]
            data.xfrc_applied[body] = np.concatenate([force, np.cross(arm, force)])
            mujoco.mj_step(model, data)
            if (np.abs(data.actuator_force) > limit).any():
                return float(np.linalg.norm(force))
        return float("nan")

    def work(self, path: Callable[[float], Any]) -> tuple[float, float]:
        """Simulate a slow motion along a path of servo angles, from 0 to 1.

        Returns:
            Work of all servos [J], and the sum of their positive work alone [J].
        """
        model, data, done, driving = self.model, self.data, 0.0, 0.0
        steps = self._steps(SLOW)
        for step in range(steps):
            data.ctrl[:] = path((step + 1) / steps)
            mujoco.mj_step(model, data)
            power = data.actuator_force * data.actuator_velocity * model.opt.timestep
            done, driving = done + float(power.sum()), driving + float(np.maximum(power, 0.0).sum())
        return done, driving

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.model.opt.timestep)


def bend(spec: Any, joints: Sequence[str], torque: float = TORQUE) -> float:
    """Total change of the angles of joints under a moment on each of them [rad], without tendons and servos."""
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    free, loaded = Stand(spec), Stand(spec)
    for i in range(loaded.model.njnt):
        if chain_of(loaded.model.joint(i).name) in joints:
            loaded.data.qfrc_applied[loaded.model.jnt_dofadr[i]] = torque
    for stand in (free, loaded):
        stand.settle(np.zeros(loaded.model.nu), times=2)  # springs alone come to rest slowly
    return sum(loaded.angle(joint) - free.angle(joint) for joint in joints)


def _measured(
    name: str,
    settings: Settings,
    cases: Sequence[Mapping[str, Any]],
    measure: Any,
    settable: frozenset[str],
) -> CaseRuns:
    """Measure all cases with MuJoCo C, without repeats; all profiles have the same values.

    Args:
        name: Name of the experiment.
        settings: Settings of the experiment.
        cases: Labels of the cases.
        measure: Function of the parameters of the body and the labels of a case, which returns the measured columns.
        settable: Parameters that can be set.

    Raises:
        ParameterError: A parameter does not apply, or a stand does not come to rest.
    """
    for parameter in {**settings.values, **(settings.bodies or {})}:
        choice("values", parameter, sorted(settable))
    rows: list[dict[str, Any]] = []
    count = max(settings.body_count, 1)
    for i in range(count):
        values = {**settings.values} | {
            parameter: float(body_values[i])
            for parameter, body_values in (settings.bodies or {}).items()
        }
        parameters = replace_quantities(
            ModelParameters(),
            {body_values: np.asarray(value) for body_values, value in values.items()},
        )
        check_quantities(parameters)
        numbered = {BODY: i + 1} if settings.bodies else {}
        for case in cases:
            measurements = measure(parameters, **case)
            rows += [
                {"profile": profile, **numbered, **case, "repeat": 0, **measurements}
                for profile in settings.profiles
            ]
            if settings.progress:
                settings.progress(len(rows) / len(settings.profiles) / (count * len(cases)))
    return CaseRuns.of(
        name, {column: np.array([row[column] for row in rows]) for column in rows[0]}
    )


def world_counter(cases: Sequence[Mapping[str, Any]]) -> Callable[[Settings], int]:
    """A function that returns the number of worlds of these cases."""
    return lambda settings: max(settings.body_count, 1) * len(cases) * len(settings.profiles)


# --- the body alone

_LATERAL: Final = tuple(f"spine_joint_{i}" for i in range(1, 5))


def run_body(settings: Settings) -> CaseRuns:
    """Measure the body; see `_measured`."""

    def measure(parameters: ModelParameters) -> dict[str, float]:
        bends = {
            f"bend_{pair}_knee": bend(
                assemble_leg(f"{pair}_left", parameters=parameters), [f"{pair}_left_knee"]
            )
            for pair in ("front", "rear")
        }
        bends["bend_spine"] = bend(assemble_spine(parameters=parameters), _LATERAL)
        sizes, limit = (
            _dimensions(),
            float(joint_angle(np.asarray(SERVO_RANGE["spine"][1]), Geometry())),
        )
        mass = float(parameters.mass.front + parameters.mass.rear)
        return {"mass": mass, **sizes, **bends, "spine_joint_limit": limit}

    return _measured("body", settings, [{}], measure, BODY_SETTABLE)


@functools.cache
def _dimensions() -> dict[str, float]:
    robot = load_robot()
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    visible = (model.geom_bodyid > 0) & (model.geom_group == VISUAL_GROUP)
    ends = []  # smallest and largest coordinates of the visible parts [m]
    for geom in np.flatnonzero(visible).tolist():
        turned, position = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
            points = position + model.mesh_vert[first : first + count] @ turned.T
            ends.append([points.min(axis=0), points.max(axis=0)])
        else:
            centre, half = (
                position + turned @ model.geom_aabb[geom][:3],
                np.abs(turned) @ model.geom_aabb[geom][3:],
            )
            ends.append([centre - half, centre + half])
    corners = np.array(ends)
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
    }


# --- one leg: the effect of the tendon's routing on force, speed and work of the knee's servo

#: The foot is pulled down, and the spine's end pushed, by up to this force [N].
_MOST_LEG, _MOST_SPINE = 20.0, 40.0
#: Changes of servo angles from which the speed, and the coupling of the hip, are computed [rad].
_STEP, _SWING = 0.05, 0.2
#: Length and height of a swing of the foot, as in the experiments [m].
_STRIDE, _LIFT = 0.060, 0.010
LEG_CASES: Final = tuple(
    {"pair": pair, "routing": routing, "hinges": hinges}
    for pair in LEGS
    for routing, hinges in (
        *((routing, 1) for routing in ROUTINGS),
        *(("type3", n) for n in HINGES[1:]),
    )
)
_inverse: Final = jax.jit(leg.inverse_kinematics, static_argnames="routing")


def run_leg(settings: Settings) -> CaseRuns:
    """Measure all routings of a leg, and chains of hinges; see `_measured`."""

    def measure(
        parameters: ModelParameters, pair: str, routing: Any, hinges: int
    ) -> dict[str, float]:
        limb, joints = f"{pair}_left", (f"{pair}_left_hip", f"{pair}_left_knee")

        def settled(servo: Any) -> Stand:
            return Stand(assemble_leg(limb, routing, parameters, hinges)).settle(servo)

        rest = servo_angles(pair, np.array(LEGS[pair].neutral_foot), routing)
        higher, lower = (
            settled(rest + np.array([0.0, step])).site(f"{limb}_foot")[2]
            for step in (_STEP, -_STEP)
        )
        swung = [settled(rest + np.array([angle, 0.0])) for angle in (_SWING, -_SWING)]
        hip, knee = (swung[0].angle(joint) - swung[1].angle(joint) for joint in joints)
        swing = swing_of(pair, routing)
        return {
            "force": settled(rest).held(f"{limb}_foot", (0.0, 0.0, -1.0), _MOST_LEG),
            "speed": float(abs(higher - lower) / (2 * _STEP) * parameters.servo.speed),
            "work": settled(swing(0.0)).work(swing)[1],
            "coupling": LEGS[pair].knee_direction * knee / hip,
            "bend": bend(assemble_leg(limb, routing, parameters, hinges), joints[1:]),
        }

    return _measured("leg-stand", settings, LEG_CASES, measure, STAND_SETTABLE)


def servo_angles(pair: str, foot: np.ndarray, routing: str) -> np.ndarray:
    """Servo angles (..., 2) [rad] that put the foot at (..., 2) = (y, z) [m], in double precision."""
    with jax.enable_x64(True):
        return np.asarray(_inverse(leg.leg_of(LEGS[pair]), foot, routing).servo)


def swing_of(pair: str, routing: str) -> Any:
    """A function from 0 to 1 with the servo angles of a swing: the foot moves along a parabola by the longest stride."""
    share = np.linspace(0.0, 1.0, 101)
    foot = np.stack([_STRIDE * (0.5 - share), 4.0 * _LIFT * share * (1.0 - share)], axis=-1)
    servo = servo_angles(pair, foot + LEGS[pair].neutral_foot, routing)
    return lambda time_share: [np.interp(time_share, share, angle) for angle in servo.T]


# --- the spine: lateral, vertical and combined bends of both robots

_VERTICAL: Final = tuple(f"spine_vertical_{i}" for i in range(1, 5))
#: Plane -> shares of the lateral and the vertical servo, joints that bend, and direction of the force.
PLANES: Final = {
    "lateral": ((1.0, 0.0), _LATERAL, (-1.0, 0.0, 0.0)),
    "vertical": ((0.0, 1.0), _VERTICAL, (0.0, 0.0, -1.0)),
    "combined": ((1.0, 1.0), _LATERAL + _VERTICAL, (-(0.5**0.5), 0.0, -(0.5**0.5))),
}
SPINE_CASES: Final[tuple[dict[str, Any], ...]] = (
    *({"robot": "nermo_lite", "plane": "lateral", "hinges": hinges} for hinges in HINGES),
    *({"robot": "nermo_41", "plane": plane, "hinges": 1} for plane in PLANES),
)


def run_spine(settings: Settings) -> CaseRuns:
    """Measure all planes of the spine, and chains of hinges; see `_measured`."""

    def measure(
        parameters: ModelParameters, robot: Any, plane: str, hinges: int
    ) -> dict[str, float]:
        # The masses of the robot, unless they are set.
        default, now = dict(values_of(ModelParameters())), dict(values_of(parameters))
        parameters_of_case = {
            name: np.asarray(value)
            for name, value in mass_values(robot).items()
            if now[name] == default[name]
        }
        parameters = replace_quantities(parameters, parameters_of_case)
        shares, joints, direction = PLANES[plane]
        share = np.array(shares[: 2 if robot == "nermo_41" else 1])

        def settled(servo: Any) -> Stand:
            return Stand(assemble_spine(parameters, robot, hinges)).settle(servo)

        ends = [settled(sign * SPINE_GEOMETRY.max_servo_angle * share) for sign in (1.0, -1.0)]
        near = [settled(sign * _STEP * share).site("spine_end") for sign in (1.0, -1.0)]
        return {
            "joint_angle": float(np.mean([ends[0].angle(joint) for joint in joints])),
            "range": float(np.linalg.norm(ends[0].site("spine_end") - ends[1].site("spine_end"))),
            "force": settled(0.0 * share).held("spine_end", direction, _MOST_SPINE),
            "speed": float(
                np.linalg.norm(near[0] - near[1]) / (2 * _STEP) * parameters.servo.speed
            ),
            "work": settled(0.0 * share).work(
                lambda time_share: time_share * SPINE_GEOMETRY.max_servo_angle * share
            )[0],
            "bend": bend(assemble_spine(parameters, robot, hinges), joints),
        }

    return _measured("spine-stand", settings, SPINE_CASES, measure, STAND_SETTABLE)
