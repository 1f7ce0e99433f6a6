"""Models with parameters that can be estimated: any MJCF, or Nermo."""

from __future__ import annotations

import copy
import functools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.hardware.log import CHANNEL_PARTS, Channel, Log
from nermo_mjx.identify.estimation import Parameter
from nermo_mjx.physics.servo_play import Play
from nermo_mjx.physics.variation import Variation
from nermo_mjx.robot import ModelParameters, ParameterError, load_robot
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.quantity import did_you_mean, replace_quantities
from nermo_mjx.robot.scene import read_mjcf
from nermo_mjx.specs.reading import read_file

#: Speed of a servo without load [rad/s].
NO_LOAD_SPEED: Final = 15.0
#: Number of worlds that are simulated together; it limits memory.
BATCH_WORLDS: Final = 32
#: Parameters that affect commands and servos, and are not fields of MuJoCo's model.
COMMAND_PARAMETERS: Final = ("delay", "bias", "dead_band", "backlash")
_TEXTS: Final[dict[str, Any]] = read_file(Path(__file__).with_name("parameters.yaml")).data
#: Kinds of parameters and their ranges; see `parameters.yaml`.
PARAMETER_KINDS: Final[dict[str, dict[str, Any]]] = _TEXTS["kinds"]
#: Advice for a model without a servo.
_SERVO_ADVICE: Final = (
    'write <position name="{}" joint="{}" kp="..." kv="..."/> into a copy of it,'
    " with the robot's own gains"
)


class Body:
    """A model, and its parameters that can be estimated.

    Attributes:
        model: Compiled model.
        parameters: Parameters by name.
        notes: Assumptions, in sentences.
        fixed: Values of parameters that are not estimated.
        robot_values: Values of Nermo's parameters that differ from the defaults of `ModelParameters`.
        dofs: Name of a parameter that acts on one kinematic tree -> a degree of freedom of this tree.
    """

    def __init__(self, model: mujoco.MjModel, free: Iterable[str]) -> None:
        """
        Args:
            model: Compiled model.
            free: Kinds of parameters that are estimated, from `PARAMETER_KINDS`.
        """
        self.model, self._free = copy.copy(model), frozenset(free)
        self.model.opt.tolerance = min(model.opt.tolerance, 1e-10)
        self.parameters: dict[str, Parameter] = {}
        self.notes: list[str] = []
        self.fixed: dict[str, float] = {}
        self.robot_values: dict[str, float] = {}
        self._elements: dict[str, tuple[str, int]] = {}
        self.dofs: dict[str, int] = {}

    def _add(
        self,
        kind: str,
        element: str,
        i: int,
        unit: str,
        default: float = 0.0,
        scale: float = 1.0,
        dof: int = -1,
    ) -> None:
        """Add a parameter if its kind is free; the range is relative to the default, or to the scale without a default."""
        if kind not in self._free:
            return
        description, name, default = (
            PARAMETER_KINDS[kind],
            f"{kind}.{element}" if element else kind,
            float(default),
        )
        low, value, high = np.array(description["range" if default > 0 else "unset"]) * (
            default or scale
        )
        neutral = default if default > 0 or low <= 0 else math.nan
        self.parameters[name] = Parameter(
            name, kind, unit, value, low, high, description["why"], neutral
        )
        self._elements[name], self.dofs[name] = (kind, i), dof

    def joint(self, name: str) -> int:
        """Id of the joint with this name, or of the joint of the actuator with this name.

        Raises:
            ParameterError: The model has no such element.
        """
        model = self.model
        if (joint_id := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)) >= 0:
            return int(joint_id)
        return int(model.actuator_trnid[self.actuator(name), 0])

    def actuator(self, name: str) -> int:
        """Id of the actuator with this name, or of the actuator of the joint with this name.

        Raises:
            ParameterError: The model has no such element.
        """
        model = self.model
        for candidate in (name, f"{name}_servo"):
            if (
                actuator_id := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, candidate)
            ) >= 0:
                return int(actuator_id)
        joints = [model.joint(int(i)).name for i in model.actuator_trnid[:, 0]]
        if name in joints:
            return joints.index(name)
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
            raise ParameterError(
                f"no actuator of the model turns the joint {name!r}: {_SERVO_ADVICE.format(name, name)}."
            )
        actuator_names = [model.actuator(i).name for i in range(model.nu)]
        raise ParameterError(
            f"the model has no servo or joint {name!r}{did_you_mean(name, actuator_names)}"
        )

    def commanded_actuator(self, channel: Channel) -> int:
        """Id of the actuator that follows the commands of a channel.

        Raises:
            ParameterError: The model has no such actuator, or the actuator accepts forces instead of positions.
        """
        a, model = self.actuator(channel.of), self.model
        if channel.unit in ("rad", "m") and not self.servos[a]:
            servo = _SERVO_ADVICE.format(
                model.actuator(a).name, model.joint(int(model.actuator_trnid[a, 0])).name
            )
            raise ParameterError(
                f"channel {channel.name!r} commands positions, but its actuator in the model takes a force: "
                f"{servo}, or give the channel unit: N m."
            )
        return a

    @property
    def servos(self) -> np.ndarray:
        """Whether each actuator is a position servo (nu,)."""
        return (self.model.actuator_biasprm[:, 1] < 0) & (self.model.actuator_gainprm[:, 0] > 0)

    def fields(self, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
        """Fields of MuJoCo's model (k, ...) for values (k, p) of named parameters."""
        model, fields = self.model, dict[str, np.ndarray]()

        def field(name: str) -> np.ndarray:
            if name not in fields:
                fields[name] = np.repeat(getattr(model, name)[None], len(values), axis=0)
            return fields[name]

        for name, column in zip(names, values.T, strict=True):
            if name in COMMAND_PARAMETERS or name.startswith("bias."):
                continue
            kind, i = self._elements[name]
            if kind in ("armature", "damping", "frictionloss"):
                field(f"dof_{kind}")[:, i] = column
            elif kind == "stiffness":
                field("jnt_stiffness")[:, i] = column
            elif kind == "kp":
                field("actuator_gainprm")[:, i, 0] = column
                if self.servos[i]:
                    field("actuator_biasprm")[:, i, 1] = -column
            elif kind == "mass":
                field("body_mass")[:, i] = column
                field("body_inertia")[:, i] = (
                    model.body_inertia[i] * (column / model.body_mass[i])[:, None]
                )
            elif kind == "friction":
                field("geom_friction")[:, :, 0] *= column[:, None]
                field("pair_friction")[:, :, :2] *= column[:, None, None]
            elif kind == "tendon":
                field("tendon_range")[:, i, 1] += column
        return fields

    def play(self, names: Sequence[str], values: np.ndarray) -> Play | None:
        """Dead band and backlash of the position servos, with leading axis k; None if neither is a named parameter."""
        column = dict(zip(names, values.T, strict=True))
        if not {"dead_band", "backlash"} & column.keys():
            return None
        model, zeros = self.model, np.zeros(len(values))
        gains = [
            column.get(f"kp.{model.actuator(i).name}", model.actuator_gainprm[i, 0] + zeros)
            for i in range(model.nu)
        ]
        force = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], 1e6)
        # Without a torque limit, the motor crosses its play at full speed if the error is 0.1 rad.
        speed = NO_LOAD_SPEED * np.where(
            model.actuator_forcelimited, 1.0, 1e6 / (0.1 * model.actuator_gainprm[:, 0])
        )
        dead_band, backlash = (
            column.get(kind, zeros)[:, None] for kind in ("dead_band", "backlash")
        )
        return Play(
            dead_band,
            backlash,
            np.stack(gains, axis=1),
            -model.actuator_biasprm[:, 2],
            force,
            speed,
        )

    def with_values(self, values: Mapping[str, float]) -> Body:
        """A copy of the body with fixed values of named parameters."""
        body = copy.copy(self)
        body.fixed = self.fixed | dict(values)
        return body

    def rest_positions(self) -> np.ndarray:
        """Positions of the model at rest (nq,)."""
        return np.array(self.model.key_qpos[0] if self.model.nkey else self.model.qpos0)


class MjcfBody(Body):
    """A model from any MJCF."""

    def __init__(self, path: Path, log: Sequence[Log], free: Iterable[str]) -> None:
        """
        Args:
            path: Path of the MJCF.
            log: Logs of the robot; their channels determine the driven actuators, and whether the base is measured.
            free: Kinds of parameters that are estimated, from `PARAMETER_KINDS`.

        Raises:
            ParameterError: MuJoCo cannot compile the file, or the model lacks a part that a channel names.
        """
        try:
            spec = read_mjcf(path)
            full_spec = spec.copy()
        except ParameterError as error:
            raise ParameterError(f"model{str(error).removeprefix('scene')}") from None
        try:
            quantities = {
                logged_channel.quantity for log_part in log for logged_channel in log_part.channels
            }
            is_held = quantities.isdisjoint(CHANNEL_PARTS) and _hold(spec)
            super().__init__(spec.compile(), free)
            self._spec = full_spec if is_held else spec
        except ParameterError:
            raise
        except (ValueError, OSError) as error:
            raise ParameterError(
                f"{path}: MuJoCo cannot compile it ({str(error).splitlines()[0]})."
            ) from None
        if is_held:
            self.notes.append(
                "No channel sees the base: it is held where the model puts it, and nothing touches the ground."
            )
        commanded = {
            channel.of
            for log_part in log
            for channel in log_part.channels
            if channel.quantity == "command"
        }
        self._add_all(sorted(self.actuator(name) for name in commanded))

    def _add_all(self, driven: Sequence[int]) -> None:
        """Add the parameters of driven actuators, bodies, tendons, the ground and the commands."""
        model = self.model
        data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = self.rest_positions()
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        for a in driven:
            self._add_servo(a, np.maximum(np.diag(mass), 1e-9))
        for b in range(1, model.nbody):
            if model.body_mass[b] > 0 and model.body_weldid[b] != 0:
                name, dof = model.body(b).name or f"body_{b}", int(model.body_dofadr[b])
                self._add("mass", name, b, "kg", model.body_mass[b], dof=dof)
        for t in range(model.ntendon):
            if model.tendon_limited[t]:
                self._add("tendon", model.tendon(t).name or f"tendon_{t}", t, "m")
        touches = model.npair or (model.geom_contype[model.geom_bodyid == 0] > 0).any()
        if touches and (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
            self._add("friction", "", 0, "1", 1.0)
        self._add("delay", "", 0, "s")
        if self.servos[driven].all():
            self._add("dead_band", "", 0, "rad")
            self._add("backlash", "", 0, "rad")

    def _add_servo(self, a: int, inertia: np.ndarray) -> None:
        """Add the parameters of an actuator and of its joint, with scales from the joint's inertia (nv,)."""
        model, servo = self.model, bool(self.servos[a])
        j = int(model.actuator_trnid[a, 0])
        v, joint, gain = int(model.jnt_dofadr[j]), model.joint(j).name, model.actuator_gainprm[a, 0]
        name = model.actuator(a).name or joint
        slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
        unit, torque, mass = ("m", "N", "kg") if slides else ("rad", "N m", "kg m^2")
        strength = gain * 0.2 if servo else inertia[v] * 20
        critical = 2 * math.sqrt(max(gain, 1e-9) * inertia[v]) if servo else inertia[v] * 10
        add = functools.partial(self._add, dof=v)
        add("armature", joint, v, mass, model.dof_armature[v], inertia[v])
        add("damping", joint, v, f"{torque} s/{unit}", model.dof_damping[v], critical)
        add("frictionloss", joint, v, torque, model.dof_frictionloss[v], strength)
        if model.jnt_stiffness[j] > 0:
            add("stiffness", joint, j, f"{torque}/{unit}", model.jnt_stiffness[j])
        add("kp", name, a, f"{torque}/{unit}" if servo else "1", gain)
        if servo:
            add("bias", name, a, unit)

    def mjcf_text(self, names: Sequence[str], values: np.ndarray) -> str:
        """Text of the MJCF with values (p,) of named parameters."""
        spec = self._spec.copy()
        model = spec.compile()
        freed = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        moves = (
            {"dof": ~freed[model.dof_jntid], "jnt": ~freed} if len(freed) > self.model.njnt else {}
        )
        for name, field in self.fields(
            (*names, *self.fixed), np.array([[*values, *self.fixed.values()]])
        ).items():
            getattr(model, name)[moves.get(name[:3], ...)] = field[0]
        spec.copy_back(model)
        return str(spec.to_xml())


def _hold(spec: mujoco.MjSpec) -> bool:
    """Fix the bases of a model at their initial poses, and return whether the model has a free base."""
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return False
    model = spec.compile()
    welded, above = model.body_weldid, model.body_weldid[model.body_parentid[model.body_weldid]]
    bases = [int(model.jnt_bodyid[joint.id]) for joint in free]
    for body in spec.bodies:
        body.name = body.name or f"body_{body.id}"
    # MuJoCo excludes contacts between a moving parent and its children, but not those of a fixed parent; and a fixed base
    # does not touch the ground.
    for first_body in spec.bodies:
        for second_body in spec.bodies:
            child = (
                welded[first_body.id] in bases
                and welded[second_body.id] != welded[first_body.id] == above[second_body.id]
            )
            if child or welded[first_body.id] == 0 < welded[second_body.id]:
                spec.add_exclude(bodyname1=first_body.name, bodyname2=second_body.name)
    for element in [*spec.keys, *free]:
        spec.delete(element)
    return True


class NermoBody(Body):
    """Nermo-Lite or Nermo 4.1 as it comes with the package, with the parameters of `ModelParameters`."""

    def __init__(self, robot: Any, free: Iterable[str]) -> None:
        """
        Args:
            robot: Name of the robot.
            free: Kinds of parameters that are estimated, from `PARAMETER_KINDS`.
        """
        nermo, self.robot = load_robot(robot), robot
        super().__init__(nermo.physical, free)
        self._variation, self.robot_values = Variation(nermo), dict(mass_values(robot))
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        parameters = replace_quantities(ModelParameters(), self.robot_values)
        for name, description in _TEXTS["nermo"].items():
            if description["kind"] not in self._free:
                continue
            value = description.get(
                "value",
                functools.reduce(getattr, name.split("."), parameters) if "." in name else 0.0,
            )
            value = min(max(float(value), description["low"]), description["high"])
            self.parameters[name] = Parameter(
                **{"name": name, "neutral": math.nan, **description, "value": value}
            )
        for i, servo in enumerate(nermo.servos[:9]):
            self._add("bias", servo, i, "rad")

    def _named(self, names: Sequence[str], values: np.ndarray) -> dict[str, Any]:
        """Values of the named parameters of `ModelParameters`, with the robot's own values of the others."""
        return self.robot_values | {
            n: c
            for n, c in zip(names, values.T, strict=True)
            if n in self.parameters and "." in n and not n.startswith("bias.")
        }

    def fields(self, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
        """See `Body.fields`."""
        worlds, lanes = len(values), max(len(values), BATCH_WORLDS)
        padded = np.concatenate([values, np.repeat(values[:1], lanes - worlds, axis=0)])
        named = self._named(names, padded)
        parameters = replace_quantities(ModelParameters(), named)
        fields = self._variation.batch(parameters, lanes, named)
        return {name: field[:worlds] for name, field in fields.items() if name != "servo_play"}

    def play(self, names: Sequence[str], values: np.ndarray) -> Play | None:
        """See `Body.play`."""
        named = self._named(names, values)
        if not {"servo.dead_band", "servo.backlash"} & named.keys():
            return None
        servo = replace_quantities(ModelParameters(), named).servo
        leaves = [
            np.broadcast_to(np.asarray(leaf, float), (len(values),))[:, None]
            for leaf in Play.of(servo)
        ]
        return Play(*leaves)

    def joint(self, name: str) -> int:
        """See `Body.joint`; a log measures the pulleys of knees and spine, under the names of their servos."""
        return int(self.model.actuator_trnid[self.actuator(name), 0])


def load_body(model: str | os.PathLike[str], logs: Sequence[Log], free: Sequence[str]) -> Body:
    """Load the body of an MJCF file, or of a robot of the package by its name; see `MjcfBody` and `NermoBody`."""
    return (
        MjcfBody(Path(model), logs, free)
        if str(model).endswith(".xml")
        else NermoBody(str(model), free)
    )
