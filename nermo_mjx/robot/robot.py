"""The assembled robot: its compiled model, and its names resolved to ids once."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.robot.assembly import (
    ConeName,
    FeetName,
    RobotConfig,
    RobotName,
    TailName,
    assemble,
    default_parameters,
)
from nermo_mjx.robot.equipment import COMPLIANT_KINDS, TAIL_DAMPING, chain_of, compliant_kind
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import MassModel, is_front, physical_model, reduced_model
from nermo_mjx.robot.meshes.body import redraw
from nermo_mjx.robot.model_parameters import Build, Damping, gravity_values
from nermo_mjx.robot.parameters import LIMBS, PresetName, RoutingName, Sensors, reading_names
from nermo_mjx.robot.quantity import ParameterError, quantities, replace_quantities, values_of
from nermo_mjx.robot.scene import Scene, Terrain, scene_geoms, scene_name
from nermo_mjx.shapes import Array


@dataclasses.dataclass(frozen=True)
class JointIndex:
    """Addresses in `qpos` of the robot's named groups of joints.

    Attributes:
        root: address of the root's position (3) and quaternion (4).
        hip, pulley: one for each limb.
        knee, ankle: the hinges of each limb's joint, (4, hinges); their sum is the joint's angle.
        spine: those of the four lateral joints, front to rear.
        spine_pulley, neck: single joints.
        tail: its joints, empty for the rigid tail; tail_pulley likewise.
        spine_vertical: those of the four vertical joints of Nermo 4.1, front to rear, else empty; spine_vertical_pulley
            and head_tilt likewise.
    """

    root: int
    hip: tuple[int, ...]
    knee: tuple[tuple[int, ...], ...]
    ankle: tuple[tuple[int, ...], ...]
    pulley: tuple[int, ...]
    spine: tuple[tuple[int, ...], ...]
    spine_pulley: int
    neck: int
    tail: tuple[int, ...]
    tail_pulley: tuple[int, ...]
    spine_vertical: tuple[tuple[int, ...], ...] = ()
    spine_vertical_pulley: tuple[int, ...] = ()
    head_tilt: tuple[int, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class _Compiled:
    """What all robots of one configuration share; never handed to callers."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: JointIndex
    terrain: Terrain

    @functools.cached_property
    def physical(self) -> mujoco.MjModel:
        return physical_model(self.spec, self.model)

    @functools.cached_property
    def sensor_slices(self) -> dict[str, slice]:
        """Entries of `sensordata` by field of `Sensors`, in the order of `add_sensors`."""
        servos = tuple(self.model.actuator(i).name for i in range(self.model.nu))
        slices = {
            "knee_angle": np.size(self.joints.knee),
            "joint_velocity": len(self.compliant),
            "tail_force": 0,
        }
        names = [field.name for field in dataclasses.fields(Sensors)]
        sizes = {
            name: slices[name] if name in slices else len(reading_names(name, servos))
            for name in names
        }
        sizes["tail_force"] = self.model.nsensordata - sum(
            sizes.values()
        )  # one of each geom that touches the ground
        ends = itertools.accumulate(sizes.values())
        return {
            name: slice(end - size, end)
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @functools.cached_property
    def compliant(self) -> tuple[str, ...]:
        """The kind of each joint of `Sensors.joint_velocity`."""
        kinds = [compliant_kind(self.model.joint(i).name) for i in range(self.model.njnt)]
        return tuple(kind for kind in COMPLIANT_KINDS for joint_kind in kinds if joint_kind == kind)

    @functools.cached_property
    def mass_model(self) -> MassModel:
        return _mass_model(self.model)

    @functools.cached_property
    def fingerprint(self) -> str:
        return fingerprint(self.model)


def fingerprint(model: mujoco.MjModel) -> str:
    """Hash of a compiled model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A robot in a scene; its models are not shared, so that changing them does not affect other robots.

    Attributes:
        config: the configuration that it was built from.
    """

    config: RobotConfig
    _compiled: _Compiled = dataclasses.field(repr=False)

    @functools.cached_property
    def spec(self) -> mujoco.MjSpec:
        """An editable specification, from which `model` could be compiled again."""
        return self._compiled.spec.copy()

    @functools.cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model. Engines step `physical`; `physics.variation` varies it within a batch."""
        return copy.copy(self._compiled.model)

    @functools.cached_property
    def physical(self) -> mujoco.MjModel:
        """`model` without visuals and unused markers, for engines; the ids of geoms and sites differ."""
        return copy.copy(self._compiled.physical)

    def with_geometry(self, geometry: Geometry, build: Build | None = None) -> mujoco.MjModel:
        """The whole model of this robot with other lengths and positions, otherwise the same.

        Args:
            geometry, build: leaves of shape (); by default it is built as drawn.
        """
        return self.spec_with_geometry(geometry, build).compile()

    def spec_with_geometry(self, geometry: Geometry, build: Build | None = None) -> mujoco.MjSpec:
        """An editable specification, from which `with_geometry` is compiled."""
        spec = self._with(geometry, build)
        redraw(spec, geometry)
        return spec

    def physical_with_geometry(self, geometry: Geometry) -> mujoco.MjModel:
        """The same for `physical`."""
        physical = self._compiled.physical
        return reduced_model(
            self._with(geometry), [physical.site(i).name for i in range(physical.nsite)]
        )

    def _with(self, geometry: Geometry, build: Build | None = None) -> mujoco.MjSpec:
        defaults = default_parameters(self.config.robot)
        parameters = dataclasses.replace(defaults, geometry=geometry, build=build or defaults.build)
        return assemble(self.config, replace_quantities(parameters, gravity_values(self.gravity)))

    @property
    def joints(self) -> JointIndex:
        """Addresses in `qpos`."""
        return self._compiled.joints

    @functools.cached_property
    def servos(self) -> tuple[str, ...]:
        """Names of the servos in the order of `ctrl`, a choice of `SERVOS`."""
        model = self._compiled.model
        return tuple(model.actuator(i).name.removesuffix("_servo") for i in range(model.nu))

    def joint_damping(self, damping: Damping) -> Float[Array, "*batch n"] | np.ndarray:
        """Of each joint of `Sensors.joint_velocity` [N m s/rad].

        Args:
            damping: leaves of one shape, that of the batch.
        """
        # Each of n hinges in series has n times the damping of the joint.
        values = {
            kind: self.config.hinges * getattr(damping, kind) for kind in ("knee", "ankle", "spine")
        }
        values["tail"] = TAIL_DAMPING + 0.0 * values["knee"]
        damping_values = [values[kind] for kind in self._compiled.compliant]
        # An operation of its own would be compiled by itself.
        return (jnp if any(isinstance(value, jax.Array) for value in damping_values) else np).stack(
            damping_values, axis=-1
        )

    @property
    def n_servos(self) -> int:
        """Number of servos, the length of `ctrl`."""
        return self._compiled.model.nu

    def sensors(self, sensordata: Float[Array, "*batch n"] | np.ndarray) -> Sensors:
        """Read MuJoCo's `sensordata` by meaning; leading axes are kept, NumPy arrays stay NumPy arrays."""
        data = sensordata if isinstance(sensordata, jax.Array) else np.asarray(sensordata)
        parts: dict[str, Any] = {
            name: data[..., span] for name, span in self._compiled.sensor_slices.items()
        }
        for name in ("foot_position", "foot_velocity"):
            parts[name] = parts[name].reshape(*data.shape[:-1], 4, 3)
        parts["knee_angle"] = parts["knee_angle"].reshape(*data.shape[:-1], 4, -1).sum(axis=-1)
        parts["tail_force"] = parts["tail_force"].sum(axis=-1)
        parts["contact_distance"] = parts["contact_distance"][..., 0]
        return Sensors(**parts)

    def sensordata_at_rest(self, qpos: Float[Array, " nq"]) -> Float[Array, " n"]:
        """`sensordata` of the robot placed at `qpos`, in JAX: IMU pose and joint angles; all other readings are
        zero."""
        position, (w, x, y, z) = qpos[self.joints.root :][:3], qpos[self.joints.root :][3:7]
        arm = jnp.asarray(self.model.site("imu").pos, qpos.dtype)
        axis = jnp.stack([x, y, z])
        turned = arm + 2.0 * jnp.cross(axis, jnp.cross(axis, arm) + w * arm)
        data = jnp.zeros((self.model.nsensordata,), qpos.dtype)
        servos = self.model.jnt_qposadr[self.model.actuator_trnid[:, 0]]
        readings = {
            "position": position + turned,
            "orientation": jnp.stack([w, x, y, z]),
            "servo_angle": qpos[servos],
            "knee_angle": qpos[np.array(self.joints.knee).ravel()],
        }
        for name, reading in readings.items():
            data = data.at[self._compiled.sensor_slices[name]].set(reading)
        return data

    @property
    def mass_model(self) -> MassModel:
        """Masses and centres of mass before and behind the spine, of the standing robot."""
        return self._compiled.mass_model

    @functools.cached_property
    def obstacles(self) -> tuple[int, ...]:
        """Ids of the geoms that the robot may run into, in the scene's order; empty in an open scene."""
        return _ids(self.model, scene_geoms(str(self.config.scene)).obstacles)

    @property
    def gravity(self) -> Float[np.ndarray, " 3"]:
        """Acceleration of free fall in the scene [m/s^2]."""
        return np.array(self._compiled.model.opt.gravity)

    @property
    def terrain(self) -> Terrain:
        """Height of the ground."""
        return self._compiled.terrain

    def mass_table(self) -> list[dict[str, float | str]]:
        """Mass of every body [kg], and whether it counts to the front or the rear."""
        return [
            {
                "body": body.name,
                "group": "front" if is_front(body.name) else "rear",
                "mass": float(body.mass[0]),
            }
            for body in (self.model.body(i) for i in range(1, self.model.nbody))
        ]

    def to_xml(self) -> str:
        """One self-contained MJCF of the assembled robot and its scene."""
        return self._compiled.spec.to_xml()

    @property
    def fingerprint(self) -> str:
        """Hash of the compiled model, to recognise the model a recording was made with."""
        return self._compiled.fingerprint


@functools.lru_cache(maxsize=32)
def _compile(config: RobotConfig) -> _Compiled:
    try:
        spec = assemble(config)
        model = spec.compile()
    except ParameterError:
        raise
    except ValueError as error:  # a custom scene that uses the name of one of the robot's parts
        why = str(error).splitlines()[0].removeprefix("Error: ")
        raise ParameterError(
            f"scene is {scene_name(str(config.scene))!r}: beside the robot it has a {why}."
        ) from None
    terrain = Terrain(model, _ids(model, scene_geoms(str(config.scene)).ground), str(config.scene))
    return _Compiled(spec, model, _joint_index(model), terrain)


def _mass_model(model: mujoco.MjModel) -> MassModel:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    front = np.array([is_front(model.body(i).name) for i in range(1, model.nbody)])
    mass, com = model.body_mass[1:], data.xipos[1:]
    base, end = data.body("torso"), data.site("spine_end")

    def share(
        selection: np.ndarray, origin: np.ndarray, rotation: np.ndarray
    ) -> tuple[float, np.ndarray]:
        total = float(mass[selection].sum())
        centre = rotation.reshape(3, 3).T @ (mass[selection] @ com[selection] / total - origin)
        centre.flags.writeable = False
        return total, centre

    front_mass, front_com = share(front, base.xpos, base.xmat)
    rear_mass, rear_com = share(~front, end.xpos, end.xmat)
    return MassModel(
        front_mass=front_mass, rear_mass=rear_mass, front_com=front_com, rear_com=rear_com
    )


def mass_model_of(config: RobotConfig, geometry: Geometry) -> MassModel:
    """`Robot.mass_model` of a robot with other lengths and positions, in JAX.

    Centres of mass of the standing robot are linear in them.

    Args:
        config: of the robot.
        geometry: leaves of shape ().
    """
    published = load_robot(config).mass_model
    # Scene, contacts and time step change no mass.
    slopes = _mass_slopes(
        RobotConfig(
            robot=config.robot,
            tail=config.tail,
            routing=config.routing,
            feet=config.feet,
            hinges=config.hinges,
            simplifications=config.simplifications,
        )
    )
    front, rear = (jnp.asarray(com, float) for com in (published.front_com, published.rear_com))
    start = {name: declaration.default for name, declaration in quantities(Geometry)}
    for name, value in values_of(geometry):
        change = jnp.asarray(value, float) - jnp.asarray(start[name], float)
        front, rear = (
            com + change * jnp.asarray(slope, float)
            for com, slope in zip((front, rear), slopes[name], strict=True)
        )
    return dataclasses.replace(published, front_com=front, rear_com=rear)


@functools.lru_cache(maxsize=64)  # each takes seconds, and little memory
def _mass_slopes(config: RobotConfig) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """How the centres of the mass model move with each parameter of the geometry."""
    robot, slopes = load_robot(config), {}
    for name, declaration in quantities(Geometry):
        low, high = (
            _mass_model(
                robot.physical_with_geometry(
                    replace_quantities(Geometry(), {name: np.asarray(end)})
                )
            )
            for end in (declaration.low, declaration.high)
        )
        span = declaration.high - declaration.low
        slopes[name] = (
            (high.front_com - low.front_com) / span,
            (high.rear_com - low.rear_com) / span,
        )
    return slopes


def _ids(model: mujoco.MjModel, geoms: tuple[str, ...]) -> tuple[int, ...]:
    return tuple(sorted(model.geom(name).id for name in geoms))


# Many parameters because they are the fields of `RobotConfig`.
def load_robot(
    robot: RobotName | RobotConfig = "nermo_lite",
    scene: Scene = "flat",
    tail: TailName = "rigid",
    routing: RoutingName = "type3",
    cone: ConeName = "elliptic",
    physics: PresetName = "reference",
    timestep: float | None = None,
    hinges: int = 1,
    feet: FeetName = "spheres",
    simplifications: str = RobotConfig.simplifications,
) -> Robot:
    """Assemble a robot in a scene. The same arguments compile once; each call returns a robot with models of its own.

    Its parameters have the values of Nermo-Lite or Nermo 4.1. For those of the robot model `author`, give
    `control.parameters.author_body` to `compile_model`; `Setup(robot="author")` does this.

    >>> load_robot(tail="articulated").n_servos
    11
    >>> load_robot(RobotConfig(tail="articulated")).n_servos
    11

    Args: see `RobotConfig`, which `robot` may also be, alone.

    Raises:
        ParameterError: unknown name, unusable scene, time step out of range, or other arguments beside a `RobotConfig`.
    """
    others = (scene, tail, routing, cone, physics, timestep, hinges, feet, simplifications)
    if isinstance(robot, RobotConfig):
        defaults = ("flat", "rigid", "type3", "elliptic", "reference", None, 1, "spheres")
        if others != (*defaults, RobotConfig.simplifications):
            raise ParameterError(
                "robot is a RobotConfig beside other arguments: change its fields with dataclasses.replace."
            )
        return Robot(robot, _compile(robot))
    options = {} if timestep is None else {"timestep": timestep}
    config = RobotConfig(
        robot,
        scene,
        tail,
        routing,
        cone,
        physics,
        hinges=hinges,
        feet=feet,
        simplifications=simplifications,
        **options,
    )
    return Robot(config, _compile(config))


def _joint_index(model: mujoco.MjModel) -> JointIndex:
    address = {model.joint(i).name: int(model.jnt_qposadr[i]) for i in range(model.njnt)}

    def limbs(joint: str) -> tuple[int, ...]:
        return tuple(address[f"{limb}_{joint}"] for limb in LIMBS)

    def chain(joint: str) -> tuple[int, ...]:
        return tuple(index for name, index in address.items() if chain_of(name) == joint)

    return JointIndex(
        root=address["root"],
        hip=limbs("hip"),
        knee=tuple(chain(f"{limb}_knee") for limb in LIMBS),
        ankle=tuple(chain(f"{limb}_ankle") for limb in LIMBS),
        pulley=limbs("pulley"),
        spine=tuple(chain(f"spine_joint_{i}") for i in range(1, 5)),
        spine_pulley=address["spine_pulley"],
        neck=address["neck"],
        tail=tuple(index for name, index in address.items() if name.startswith("tail_joint")),
        tail_pulley=tuple(index for name, index in address.items() if name == "tail_pulley"),
        spine_vertical=tuple(filter(None, (chain(f"spine_vertical_{i}") for i in range(1, 5)))),
        spine_vertical_pulley=tuple(
            index for name, index in address.items() if name == "spine_vertical_pulley"
        ),
        head_tilt=tuple(index for name, index in address.items() if name == "head_tilt"),
    )
