"""A model driven by a log's commands, in batches of bodies: what its sensors would have shown.

Any MJCF, or Nermo. A control of a step is the mean of the command that is held during it, `delay` earlier, so that a
delay is no staircase. A base that no channel sees is held in place. A model on servos starts where the log's angles
do, one with a free base stands before; one that motors push is set to the measured angles again every half second,
since its errors grow.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from nermo_mjx.experiments.cases import texts
from nermo_mjx.experiments.determinacy import LoggedSamples, Parameter, without
from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.twin import SETTLING_SECONDS
from nermo_mjx.physics.servo_play import Play, played, servo_addresses
from nermo_mjx.physics.variation import Variation, moves_constants
from nermo_mjx.robot import ModelParameters, ParameterError, load_robot
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.quantity import did_you_mean, replace_quantities
from nermo_mjx.robot.scene import read_mjcf
from nermo_mjx.runtime import thread_count

#: Interval at which a model without servos begins anew [s].
AGAIN: Final = 0.5
#: Time after which servos have forgotten where a log begins [s].
FORGOTTEN: Final = 2.0
#: Of a servo without load [rad/s].
MOTOR_SPEED: Final = 15.0
#: Worlds simulated together, which bounds memory.
LANES: Final = 32
#: Perturbations of unknown starts: position and velocity.
START_WIDTH: Final = (1e-4, 1e-3)
#: Parameters that are no fields of MuJoCo's model: of the commands.
COMMANDS: Final = ("delay", "bias", "dead_band", "backlash")
#: Kinds of parameters and their ranges; see `experiments.yaml`.
KINDS: Final[dict[str, dict[str, Any]]] = texts("log")["kinds"]
#: Quantities that a model predicts.
PREDICTED: Final = ("angle", "velocity", "gyro", "accelerometer", "position", "yaw", "torque")
_SENSORS: Final = {"gyro": "GYRO", "accelerometer": "ACCELEROMETER"}


#: What a model lacks.
_SERVO: Final = (
    'write <position name="{}" joint="{}" kp="..." kv="..."/> into a copy of it,'
    " with the robot's own gains"
)


class Body:
    """A model and those of its parameters that may be estimated.

    Attributes:
        model: compiled.
        parameters: by name.
        notes: what was assumed, in sentences.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.model.opt.tolerance = min(model.opt.tolerance, 1e-10)
        self.parameters: dict[str, Parameter] = {}
        self.notes: list[str] = []
        #: Values of parameters that are not estimated, and what Nermo's own parameters are where they are not named.
        self.fixed: dict[str, float] = {}
        self.standing: dict[str, float] = {}
        self._places: dict[str, tuple[str, int]] = {}
        #: Parameters that act on one kinematic tree alone, and a degree of freedom of it.
        self.dofs: dict[str, int] = {}

    def joint(self, name: str) -> int:
        """Id of the joint of this name, or that an actuator of this name turns.

        Raises:
            ParameterError: there is none.
        """
        model = self.model
        if (found := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)) >= 0:
            return int(found)
        return int(model.actuator_trnid[self.actuator(name), 0])

    def actuator(self, name: str) -> int:
        """Id of the actuator of this name, or that turns the joint of this name.

        Raises:
            ParameterError: there is none.
        """
        model = self.model
        for each in (name, f"{name}_servo"):
            if (found := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, each)) >= 0:
                return int(found)
        joints = [model.joint(int(i)).name for i in model.actuator_trnid[:, 0]]
        if name in joints:
            return joints.index(name)
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
            raise ParameterError(
                f"no actuator of the model turns the joint {name!r}: {_SERVO.format(name, name)}."
            )
        known = [model.actuator(i).name for i in range(model.nu)]
        raise ParameterError(f"the model has no servo or joint {name!r}{did_you_mean(name, known)}")

    @property
    def servos(self) -> np.ndarray:
        """Whether each actuator is a position servo (nu,)."""
        return (self.model.actuator_biasprm[:, 1] < 0) & (self.model.actuator_gainprm[:, 0] > 0)

    def fields(self, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
        """Model fields of bodies with values (k, p) of named parameters: (k, ...) each."""
        model, fields = self.model, dict[str, np.ndarray]()

        def field(name: str) -> np.ndarray:
            if name not in fields:
                fields[name] = np.repeat(getattr(model, name)[None], len(values), axis=0)
            return fields[name]

        for name, column in zip(names, values.T, strict=True):
            if name in COMMANDS or name.startswith("bias."):
                continue
            kind, i = self._places[name]
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
        """Dead band and backlash of the position servos, with leading axis k; None without."""
        column = dict(zip(names, values.T, strict=True))
        if not {"dead_band", "backlash"} & column.keys():
            return None
        model, none = self.model, np.zeros(len(values))
        gains = [
            column.get(f"kp.{model.actuator(i).name}", model.actuator_gainprm[i, 0] + none)
            for i in range(model.nu)
        ]
        force = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], 1e6)
        # Where no torque limit tells it, the motor crosses its play at its full speed with an error of 0.1 rad.
        speed = MOTOR_SPEED * np.where(
            model.actuator_forcelimited, 1.0, 1e6 / (0.1 * model.actuator_gainprm[:, 0])
        )
        dead_band, backlash = (
            column.get(each, none)[:, None] for each in ("dead_band", "backlash")
        )
        return Play(
            dead_band,
            backlash,
            np.stack(gains, axis=1),
            -model.actuator_biasprm[:, 2],
            force,
            speed,
        )

    def at(self, values: Mapping[str, float]) -> Body:
        """The body with other values of named parameters."""
        other = copy.copy(self)
        other.fixed = self.fixed | dict(values)
        return other

    def start(self) -> np.ndarray:
        """Positions of the model at rest (nq,)."""
        return np.array(self.model.key_qpos[0] if self.model.nkey else self.model.qpos0)


class MjcfBody(Body):
    """Any MJCF."""

    def __init__(self, path: Path, log: Sequence[Log], free: Iterable[str]) -> None:
        """
        Args:
            path: of the MJCF.
            log: of the robot; its channels tell what moves and what is seen.
            free: kinds of parameters that are estimated, of `KINDS`.

        Raises:
            ParameterError: a file that MuJoCo cannot compile, or channels of parts that it does not have.
        """
        try:
            spec = read_mjcf(path)
            whole = spec.copy()
        except ParameterError as error:
            raise ParameterError(f"model{str(error).removeprefix('scene')}") from None
        try:
            seen = {each.quantity for one in log for each in one.channels}
            held = not seen & {"gyro", "accelerometer", "position", "yaw"} and _hold(spec)
            super().__init__(spec.compile())
            self._spec = whole if held else spec
        except ParameterError:
            raise
        except (ValueError, OSError) as error:
            raise ParameterError(
                f"{path}: MuJoCo cannot compile it ({str(error).splitlines()[0]})."
            ) from None
        if held:
            self.notes.append(
                "No channel sees the base: it is held where the model puts it, and nothing touches the ground."
            )
        self._add(
            tuple(free),
            {each.of for one in log for each in one.channels if each.quantity == "command"},
        )

    def _add(self, free: tuple[str, ...], commanded: set[str]) -> None:
        model = self.model
        data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = self.start()
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        inertia = np.maximum(np.diag(mass), 1e-9)
        driven = sorted(self.actuator(name) for name in commanded)
        joints = [int(model.actuator_trnid[a, 0]) for a in driven]
        dofs = [int(model.jnt_dofadr[j]) for j in joints]

        def add(
            kind: str, of: str, i: int, unit: str, default: float = 0.0, scale: float = 1.0
        ) -> None:
            """A parameter, whose range is about its default, or about a scale where the model leaves it out."""
            about, name = KINDS[kind], f"{kind}.{of}" if of else kind
            low, value, high = np.array(about["range" if default > 0 else "unset"]) * (
                default or scale
            )
            neutral = default if default > 0 or low <= 0 else math.nan
            self.parameters[name] = Parameter(
                name, kind, unit, value, low, high, about["why"], neutral
            )
            self._places[name] = (kind, i)

        for a, j, v in zip(driven, joints, dofs, strict=True):
            others = tuple(self.parameters)
            joint, servo = model.joint(j).name, model.actuator(a).name or model.joint(j).name
            unit = "m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
            torque = "N" if unit == "m" else "N m"
            gain = float(model.actuator_gainprm[a, 0])
            strength = gain * 0.2 if self.servos[a] else inertia[v] * 20
            critical = (
                2 * math.sqrt(max(gain, 1e-9) * inertia[v]) if self.servos[a] else inertia[v] * 10
            )
            if "armature" in free:
                add(
                    "armature",
                    joint,
                    v,
                    "kg" if unit == "m" else "kg m^2",
                    float(model.dof_armature[v]),
                    inertia[v],
                )
            if "damping" in free:
                add(
                    "damping", joint, v, f"{torque} s/{unit}", float(model.dof_damping[v]), critical
                )
            if "frictionloss" in free:
                add("frictionloss", joint, v, torque, float(model.dof_frictionloss[v]), strength)
            if "stiffness" in free and model.jnt_stiffness[j] > 0:
                add("stiffness", joint, j, f"{torque}/{unit}", float(model.jnt_stiffness[j]))
            if "kp" in free:
                add("kp", servo, a, f"{torque}/{unit}" if self.servos[a] else "1", gain)
            if "bias" in free and self.servos[a]:
                add("bias", servo, a, unit)
            self.dofs |= {name: v for name in self.parameters if name not in others}
        if "mass" in free:
            for b in range(1, model.nbody):
                if model.body_mass[b] > 0 and (model.body_weldid[b] != 0):
                    add(
                        "mass",
                        model.body(b).name or f"body_{b}",
                        b,
                        "kg",
                        float(model.body_mass[b]),
                    )
                    self.dofs[f"mass.{model.body(b).name or f'body_{b}'}"] = int(
                        model.body_dofadr[b]
                    )
        for t in range(model.ntendon):
            if "tendon" in free and model.tendon_limited[t]:
                add("tendon", model.tendon(t).name or f"tendon_{t}", t, "m")
        touches = bool(model.npair) or bool((model.geom_contype[model.geom_bodyid == 0] > 0).any())
        if (
            "friction" in free
            and touches
            and any(kind == mujoco.mjtJoint.mjJNT_FREE for kind in model.jnt_type)
        ):
            add("friction", "", 0, "1", 1.0)
        for kind in ("delay", "dead_band", "backlash"):
            if kind in free and (kind == "delay" or self.servos[driven].all()):
                add(kind, "", 0, "s" if kind == "delay" else "rad")

    def written(self, names: Sequence[str], values: np.ndarray) -> str:
        """The MJCF with values (p,) of named parameters."""
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
    """Hold the bases of a model where it puts them; whether it has one."""
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return False
    model = spec.compile()
    welded, above = model.body_weldid, model.body_weldid[model.body_parentid[model.body_weldid]]
    bases = [int(model.jnt_bodyid[joint.id]) for joint in free]
    for body in spec.bodies:
        body.name = body.name or f"body_{body.id}"
    # A parent that moves never touches its children, but one that stands still does; one that hangs is above ground.
    for one in spec.bodies:
        for other in spec.bodies:
            child = (
                welded[one.id] in bases and welded[other.id] != welded[one.id] == above[other.id]
            )
            if child or welded[one.id] == 0 < welded[other.id]:
                spec.add_exclude(bodyname1=one.name, bodyname2=other.name)
    for each in [*spec.keys, *free]:
        spec.delete(each)
    return True


class NermoBody(Body):
    """Nermo-Lite or Nermo 4.1 as it comes with the package, with the parameters of `ModelParameters`."""

    def __init__(self, robot: Any, free: Iterable[str]) -> None:
        """
        Args:
            robot: its name.
            free: kinds of parameters that are estimated.
        """
        nermo, self.robot = load_robot(robot), robot
        super().__init__(nermo.physical)
        self._variation, self.standing = Variation(nermo), dict(mass_values(robot))
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        known = replace_quantities(ModelParameters(), self.standing)
        for name, about in texts("log")["nermo"].items():
            if about["kind"] not in free:
                continue
            value = about.get(
                "value", functools.reduce(getattr, name.split("."), known) if "." in name else 0.0
            )
            low, high = about["low"], about["high"]
            neutral = about.get("neutral", math.nan)
            self.parameters[name] = Parameter(
                name,
                about["kind"],
                about["unit"],
                min(max(float(value), low), high),
                low,
                high,
                about["why"],
                neutral,
            )
        if "bias" in free:
            low, value, high = KINDS["bias"]["unset"]
            for servo in nermo.servos[:9]:
                name = f"bias.{servo}"
                self.parameters[name] = Parameter(
                    name, "bias", "rad", value, low, high, KINDS["bias"]["why"], 0.0
                )

    def _named(self, names: Sequence[str], values: np.ndarray) -> dict[str, Any]:
        return self.standing | {
            n: c
            for n, c in zip(names, values.T, strict=True)
            if n in self.parameters and "." in n and not n.startswith("bias.")
        }

    def fields(self, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
        """See `Body.fields`."""
        worlds, lanes = len(values), max(len(values), LANES)
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
        """See `Body.joint`: knees and the spine are named after their servos, whose pulleys a log sees."""
        return int(self.model.actuator_trnid[self.actuator(name), 0])


def body_of(model: str | os.PathLike[str], logs: Sequence[Log], free: Sequence[str]) -> Body:
    """The body of an MJCF file, or of a robot of the package by its name; see `MjcfBody` and `NermoBody`."""
    return (
        MjcfBody(Path(model), logs, free)
        if str(model).endswith(".xml")
        else NermoBody(str(model), free)
    )


class LoggedTwin:
    """The predictions of a body for logs: the problem that an `Estimation` solves."""

    def __init__(
        self,
        body: Body,
        logs: Sequence[Log],
        names: Sequence[str],
        only: Callable[[np.ndarray, float], np.ndarray] | None = None,
    ) -> None:
        """
        Args:
            body: that is driven.
            logs: one or several.
            names: of the parameters that the values of `predict` are of.
            only: which samples count, of times (n,) and the duration of their log: (n,) bool.

        Raises:
            ParameterError: a channel of a part that the model does not have, no command, or nothing to compare.
        """
        for log in logs:
            if body.model.nu and not log.of_quantity("command"):
                raise ParameterError(
                    f"{log.file}: no channel is a command, by which the model could be driven."
                )
        self.body, self.names, self.logs = body, tuple(names), tuple(logs)
        pushed = not body.servos.all() and body.model.nu > 0
        self._legs = [_Driven(body, log, AGAIN if pushed else None) for log in logs]
        if not all(leg.channels for leg in self._legs):
            raise ParameterError(
                "no channel of the log is one that a model predicts: give angles, an IMU, or a track."
            )
        self.stands = any(leg.stands for leg in self._legs)
        labels = list(dict.fromkeys(each.name for leg in self._legs for each in leg.channels))
        parts, keep, offset = [], [], 0.0
        for leg in self._legs:
            for each in leg.channels:
                size = each.values.reshape(len(each.times), -1).shape[1]
                chosen = leg.inside(each) & (
                    True if only is None else only(each.times, leg.log.duration)
                )
                keep.append(np.repeat(chosen, size))
                of = np.repeat(offset + each.times, size)
                values = np.unwrap(each.values) if each.quantity == "yaw" else each.values
                parts.append((values.ravel(), np.full(len(of), labels.index(each.name)), of))
            offset += leg.log.duration + 1.0
        self.keep = np.concatenate(keep)
        values, channel, times = (
            np.concatenate(column)[self.keep] for column in zip(*parts, strict=True)
        )
        self.labels = tuple(labels)
        sizes = {each.name: each.values[:1].size for leg in self._legs for each in leg.channels}
        self.components = tuple(sizes[label] for label in labels)
        quantum = np.array([_quantum(values[channel == i]) for i in range(len(labels))])
        self.measured = LoggedSamples(values, channel, times, quantum)
        self._around: list[tuple[np.ndarray, np.ndarray]] = []

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Predictions (k, n) of the samples that count for values (k, p)."""
        rows = []
        for block in np.array_split(values, -(-len(values) // LANES)):
            parts = [leg.predict(self.names, block) for leg in self._legs]
            rows.append(np.concatenate(parts, axis=1)[:, self.keep])
        return np.concatenate(rows)

    @functools.cached_property
    def parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Kinematic tree that each parameter (p,) and each channel is of; -1 of several, or of one that others pull."""
        body, model = self.body, self.body.model
        seen = {
            each.name: model.jnt_dofadr[body.joint(each.of)]
            if each.quantity in ("angle", "velocity")
            else -1
            for leg in self._legs
            for each in leg.channels
        }
        dofs = np.array(
            [
                *(body.dofs.get(name, -1) for name in self.names),
                *(seen[label] for label in self.labels),
            ]
        )
        trees = np.where((dofs < 0) | (model.neq + model.ntendon > 0), -1, model.dof_treeid[dofs])
        return trees[: len(self.names)], trees[len(self.names) :]

    def renew(self, values: np.ndarray) -> None:
        """Linearize what depends on unknown starts, at values (p,)."""
        self._around, first = [], 0
        for leg in self._legs:
            columns, window = leg.nuisance(self.names, values)
            kept = self.keep[first : first + len(window)]
            place = np.cumsum(self.keep)[first : first + len(window)] - 1
            first += len(window)
            for w in np.unique(window[kept]):
                rows = np.flatnonzero(kept & (window == w))
                if len(rows) > columns.shape[1] > 0:
                    self._around.append((place[rows], columns[rows]))
        self._remove: dict[bytes, list[tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]] = {}

    def project(self, residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Whitened residuals (n, k) without what the unknown starts explain."""
        if not self._around:
            return residual
        if (key := sigma.tobytes()) not in self._remove:
            of = self.measured.channel
            self._remove[key] = [
                (rows, without(c / sigma[of[rows]][:, None])) for rows, c in self._around
            ]
        residual = residual.copy()
        for rows, remove in self._remove[key]:
            residual[rows] = remove(residual[rows])
        return residual


def replay_on_model(log: Log, model: str | os.PathLike[str]) -> tuple[Log, tuple[str, ...]]:
    """Drive any MJCF by a log's commands, from the log's first angles, or from standing if its base is free.

    Returns:
        The log's channels as the model has them, at the log's time stamps, and what was assumed, in sentences.

    Raises:
        ParameterError: the log and the model do not fit together, or the simulation diverges.
    """
    body = body_of(model, [log], ())
    twin = LoggedTwin(body, [log], ())
    predicted, made = twin.predict(np.zeros((1, 0)))[0], list[Channel]()
    if not np.isfinite(predicted).all():
        raise ParameterError(f"{model} diverges under the commands of {log.file}.")
    for each in log.channels:
        if each.name in twin.labels:
            rows = twin.measured.channel == twin.labels.index(each.name)
            values = predicted[rows].reshape(-1, *each.values.shape[1:])
            times = twin.measured.time[rows].reshape(len(values), -1)[:, 0]
            made.append(dataclasses.replace(each, times=times, values=values))
    return Log(tuple(made), str(model)), tuple(body.notes)


def _quantum(values: np.ndarray) -> float:
    """Smallest step of values that are multiples of it; 0 if they are fine."""
    steps = np.unique(np.round(np.abs(np.diff(np.unique(values))), 12))
    steps = steps[steps > 0]
    return float(steps[0]) if len(steps) and len(np.unique(values)) < len(values) / 4 else 0.0


def until(log: Log, end: float) -> Log:
    """The samples of a log before a time [s]; every channel keeps at least one."""
    parts = []
    for each in log.channels:
        kept = each.times < max(end, float(each.times[0]) + 1e-9)
        parts.append(dataclasses.replace(each, times=each.times[kept], values=each.values[kept]))
    return dataclasses.replace(log, channels=tuple(parts))


class _Driven:
    """A body under the commands of one log."""

    def __init__(self, body: Body, log: Log, window: float | None) -> None:
        self.body, self.log, model = body, log, body.model
        self.channels = tuple(each for each in log.channels if each.quantity in PREDICTED)
        self.step = float(model.opt.timestep)
        self.stands = any(kind == mujoco.mjtJoint.mjJNT_FREE for kind in model.jnt_type)
        total = max(1, math.ceil(log.duration / self.step))
        self.steps = total if window is None or self.stands else max(1, round(window / self.step))
        self.windows = math.ceil(total / self.steps)
        self.settle = round(SETTLING_SECONDS / self.step) if self.stands else 0
        self.readings = [self._reading(each) for each in self.channels]
        grid = np.arange(self.windows * self.steps + 1) * self.step
        self.grid = np.concatenate([(np.arange(self.settle) - self.settle) * self.step, grid])
        self.commands: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for each in log.channels:
            if each.quantity == "command":
                held = np.concatenate([[each.values[0]], each.values])
                knots = np.concatenate(
                    [
                        [min(each.times[0], 0.0) - 10.0],
                        each.times,
                        [max(grid[-1], each.times[-1]) + 10.0],
                    ]
                )
                area = np.concatenate([[0.0], np.cumsum(held * np.diff(knots))])
                a = body.actuator(each.of)
                if each.unit in ("rad", "m") and not body.servos[a]:
                    servo = _SERVO.format(
                        model.actuator(a).name, model.joint(int(model.actuator_trnid[a, 0])).name
                    )
                    raise ParameterError(
                        f"channel {each.name!r} commands positions, but its actuator in the model takes a force: "
                        f"{servo}, or give the channel unit: N m."
                    )
                self.commands[a] = (knots, area)
        self.start = self._start()

    def inside(self, channel: Channel) -> np.ndarray:
        """Samples that the simulation reaches (n,)."""
        return (channel.times >= 0) & (channel.times < self.windows * self.steps * self.step)

    def _reading(self, channel: Channel) -> tuple[str, Any]:
        model, body = self.body.model, self.body
        if channel.quantity in ("angle", "velocity"):
            joint = body.joint(channel.of)
            address = model.jnt_qposadr if channel.quantity == "angle" else model.jnt_dofadr
            return ("qpos" if channel.quantity == "angle" else "qvel"), [int(address[joint])]
        if channel.quantity == "torque":
            return "actuator_force", [body.actuator(channel.of)]
        if channel.quantity in _SENSORS:
            kind = getattr(mujoco.mjtSensor, f"mjSENS_{_SENSORS[channel.quantity]}")
            of = [i for i in range(model.nsensor) if model.sensor_type[i] == kind]
            named = [
                i
                for i in of
                if channel.of in (model.sensor(i).name, model.site(int(model.sensor_objid[i])).name)
            ]
            chosen = named or (of if len(of) == 1 else [])
            if not chosen:
                raise ParameterError(
                    f"channel {channel.name!r}: the model has no {channel.quantity} sensor {channel.of!r}."
                )
            first = int(model.sensor_adr[chosen[0]])
            return "sensordata", list(
                range(first, first + channel.values.reshape(len(channel.times), -1).shape[1])
            )
        found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, channel.of)
        if found < 0:
            raise ParameterError(f"channel {channel.name!r}: the model has no body {channel.of!r}.")
        return ("xpos" if channel.quantity == "position" else "xmat"), int(found)

    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities at the start of each window, (windows, nq) and (windows, nv)."""
        model = self.body.model
        rest = self.body.start()
        qpos = np.repeat(rest[None], self.windows, axis=0)
        qvel = np.zeros((self.windows, model.nv))
        begin = np.arange(self.windows) * self.steps * self.step
        for channel in self.channels:
            if channel.quantity == "angle" and not self.stands:
                joint = self.body.joint(channel.of)
                i, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
                for w, t in enumerate(begin):
                    # A parabola through the samples around: noise counts less, and it has a slope.
                    near = np.argsort(np.abs(channel.times - t))[:9]
                    order = min(2, len(near) - 1)
                    curve = np.polyfit(channel.times[near] - t, channel.values[near], order)
                    qpos[w, i], qvel[w, v] = (
                        curve[-1],
                        (curve[-2] if order else 0.0) if self.windows > 1 else 0.0,
                    )
        return qpos, qvel

    def controls(self, names: Sequence[str], values: np.ndarray) -> np.ndarray:
        """Controls (k, settle + windows * steps, nu) of values (k, p)."""
        model, column = self.body.model, dict(zip(names, values.T, strict=True))
        delay = column.get("delay", np.zeros(len(values)))
        rest = self.body.start()
        found = np.zeros((len(values), len(self.grid) - 1, model.nu))
        held = [
            rest[model.jnt_qposadr[j]] if servo else 0.0
            for j, servo in zip(model.actuator_trnid[:, 0], self.body.servos, strict=True)
        ]
        found[:] = held
        for a, (knots, area) in self.commands.items():
            for each in np.unique(delay):
                mean = np.diff(np.interp(self.grid - each, knots, area)) / self.step
                found[delay == each, :, a] = mean
            for name in {
                f"bias.{model.actuator(a).name}",
                f"bias.{model.actuator(a).name.removesuffix('_servo')}",
            }:
                if name in column:
                    found[:, :, a] += column[name][:, None]
        return found

    def predict(self, names: Sequence[str], values: np.ndarray, starts: Any = None) -> np.ndarray:
        """Predictions of all samples (k, n) for values (k, p); NaN where a simulation fails.

        Args:
            starts: positions and velocities (k, windows, ...), by default those of the log.
        """
        model, body, k, w = self.body.model, self.body, len(values), self.windows
        names = (*names, *body.fixed)
        values = np.concatenate([values, np.tile(list(body.fixed.values()), (k, 1))], axis=1)
        batch = Batch(model, k * w, nthread=thread_count(None))
        fields = body.fields(names, values)
        for name, field in fields.items():
            batch.expand(name)[...] = np.repeat(field, w, axis=0)
        if moves_constants(fields) or "dof_armature" in fields:
            batch.set_const()
        qpos, qvel = self.start if starts is None else starts
        batch.bind("qpos")[...] = np.broadcast_to(qpos, (k, *self.start[0].shape)).reshape(
            k * w, -1
        )
        batch.bind("qvel")[...] = np.broadcast_to(qvel, (k, *self.start[1].shape)).reshape(
            k * w, -1
        )
        ctrl = self.controls(names, values)
        wanted = sorted({name for name, _ in self.readings})
        play = body.play(names, values)
        motor = np.zeros((k * w, model.nu))

        def run(steps: np.ndarray) -> dict[str, np.ndarray]:
            """Steps of controls (k w, n, nu)."""
            nonlocal motor
            try:
                if play is None:
                    return batch.rollout(steps.shape[1], steps, record=wanted)
                rows: list[dict[str, np.ndarray]] = []
                of = Play(
                    *(
                        np.repeat(np.broadcast_to(leaf, (k, np.shape(leaf)[-1])), w, axis=0)
                        for leaf in play
                    )
                )
                addresses = servo_addresses(model)
                position, velocity = batch.bind("qpos"), batch.bind("qvel")
                for i in range(steps.shape[1]):
                    q, v = position[:, addresses[0]], velocity[:, addresses[1]]
                    control, motor = played(of, motor, steps[:, i], q, v, self.step, np)
                    rows.append(batch.rollout(1, control[:, None], record=wanted))
                return {
                    name: np.concatenate([row[name] for row in rows], axis=1) for name in wanted
                }
            except SimulationError:
                return {
                    name: np.full(
                        (k * w, steps.shape[1], *np.shape(getattr(mujoco.MjData(model), name))),
                        np.nan,
                    )
                    for name in wanted
                }

        if self.settle:
            run(ctrl[:, : self.settle])
        driven = ctrl[:, self.settle :].reshape(k * w, self.steps, model.nu)
        first = {"qpos": np.array(batch.bind("qpos")), "qvel": np.array(batch.bind("qvel"))}
        found = run(driven)
        lost = batch.warning.reshape(k, -1).any(axis=1)
        rows = [
            self._sampled(c, r, found, first, k)
            for c, r in zip(self.channels, self.readings, strict=True)
        ]
        result = np.concatenate(rows, axis=1)
        result[lost] = np.nan
        return result

    def _sampled(
        self,
        channel: Channel,
        reading: tuple[str, Any],
        found: Mapping[str, np.ndarray],
        first: Mapping[str, np.ndarray],
        k: int,
    ) -> np.ndarray:
        """A channel's samples (k, n) by straight lines between steps."""
        name, of = reading
        series = found[name].reshape(k, self.windows, self.steps, *found[name].shape[2:])
        if name == "xpos":
            series = series[..., of, : channel.values.shape[1]]
        elif name == "xmat":
            turned = series[..., of, :]
            series = np.unwrap(np.arctan2(turned[..., 3], turned[..., 0]), axis=2)[..., None]
        else:
            series = series[..., of]
        times = np.clip(channel.times, 0.0, self.windows * self.steps * self.step - 1e-9)
        window = np.minimum((times / (self.steps * self.step)).astype(int), self.windows - 1)
        local = times / self.step - window * self.steps
        if (
            name in first
        ):  # states come after their step, everything else belongs to the state before
            start = first[name].reshape(k, self.windows, 1, -1)[..., of]
            series = np.concatenate([start, series], axis=2)
        low = (
            np.minimum(local.astype(int), series.shape[2] - 2)
            if series.shape[2] > 1
            else np.zeros(len(local), int)
        )
        share = np.clip(local - low, 0.0, 1.0)[:, None]
        high = np.minimum(low + 1, series.shape[2] - 1)
        return ((1 - share) * series[:, window, low] + share * series[:, window, high]).reshape(
            k, -1
        )

    def nuisance(self, names: Sequence[str], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the samples to unknown starts (n, m), and the window of each sample (n,)."""
        which = np.concatenate([self._window(each) for each in self.channels])
        columns = self._frame()
        if not self.stands:
            # The whole of a log that servos drive is one window, whose start they soon forget.
            early = (
                self if self.windows > 1 else _Driven(self.body, until(self.log, FORGOTTEN), None)
            )
            near = np.concatenate(
                [np.repeat(e.times < FORGOTTEN, e.values[:1].size) for e in self.channels]
            )
            columns += early.to_starts(names, values, near | (self.windows > 1))
        return (np.stack(columns, axis=1) if columns else np.zeros((len(which), 0))), which

    def _window(self, channel: Channel) -> np.ndarray:
        """Of each number of a channel."""
        own = np.clip((channel.times / (self.steps * self.step)).astype(int), 0, self.windows - 1)
        return np.repeat(own, channel.values[:1].size)

    def to_starts(
        self, names: Sequence[str], values: np.ndarray, rows: np.ndarray
    ) -> list[np.ndarray]:
        """Derivatives of the samples `rows` (n,) to positions and velocities of the starts, (n,) each, normalized."""
        model, starts, columns = self.body.model, list[Any](), list[np.ndarray]()
        for way in np.eye(2 * model.nv):
            for sign in (1.0, -1.0):
                qpos, qvel = (
                    self.start[0].copy(),
                    self.start[1] + sign * START_WIDTH[1] * way[model.nv :],
                )
                for row in qpos:
                    mujoco.mj_integratePos(model, row, way[: model.nv], sign * START_WIDTH[0])
                starts.append((qpos, qvel))
        for i in range(0, len(starts), LANES):
            both = tuple(np.stack(part) for part in zip(*starts[i : i + LANES], strict=True))
            found = self.predict(names, np.repeat(values[None], len(both[0]), axis=0), both)
            for change in np.nan_to_num(found[0::2] - found[1::2]):
                columns.append(np.zeros(len(rows)))
                columns[-1][rows] = change / max(float(np.abs(change).max()), 1e-30)
        return columns

    def _frame(self) -> list[np.ndarray]:
        """What an unknown frame of a track does to its samples: shifts, and a turn."""
        columns = []
        sizes = [each.values.size for each in self.channels]
        ends = np.cumsum([0, *sizes])
        tracks = [i for i, each in enumerate(self.channels) if each.quantity in ("position", "yaw")]
        turn = np.zeros(ends[-1])
        for i in tracks:
            each = self.channels[i]
            if each.quantity == "yaw":
                turn[ends[i] : ends[i + 1]] = 1.0
                continue
            values = each.values
            for axis in range(values.shape[1]):
                shift = np.zeros_like(values)
                shift[:, axis] = 1.0
                columns.append(np.pad(shift.ravel(), (ends[i], ends[-1] - ends[i + 1])))
            around = values[:, :2] - values[:, :2].mean(axis=0)
            turned = np.zeros_like(values)
            turned[:, 0], turned[:, 1] = -around[:, 1], around[:, 0]
            turn[ends[i] : ends[i + 1]] = turned.ravel()
        return [*columns, turn] if tracks else []
