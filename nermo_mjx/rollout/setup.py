"""What is chosen by name before anything compiles: robot, scene, gait, modes; and how long a run is measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from nermo_mjx.control.controller import Controller
from nermo_mjx.control.parameters import published_values
from nermo_mjx.control.pilot import Command
from nermo_mjx.robot import ParameterError, Quantity, Robot, RobotConfig, load_robot
from nermo_mjx.robot.gravity import gravity_values
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import check_quantities, quantities
from nermo_mjx.robot.scene import Scene
from nermo_mjx.robot.servo_limits import check_servo, highest_kp, highest_kv
from nermo_mjx.rollout.parameters import WorldParameters


@dataclasses.dataclass(frozen=True)
class Setup:
    """Static choices of a simulation; every name is checked at construction.

    Attributes:
        robot, scene, tail, routing, cone, physics, timestep: see `RobotConfig`. `dataclasses.replace` with another
            preset takes that preset's time step, unless one was given. A scene of one's own, a file or an `MjSpec`,
            is kept as MJCF, so that setups with the same one are equal.
        gait: `trt`, `trt1` or `lat`: defaults of duty, offsets and gait factor.
        spine: auxiliary modes of the spine: `none`, `stride_extension`, `balance`, or several joined by "+".
        steering: `leg`, `spine` or `mix`.
        profile: `exact` or `as_published`.
        pilot: `straight`, `arc`, `waypoints`, `open_loop`, or `external` with `command`.
        waypoints: for the pilot `waypoints`, (x, y) of each [m], see `control.course.course_through`.
        command: for the pilot `external`, see `control.pilot.tabulated`.
        trajectory: `cubic`, `linear` or `parabolic` foot paths.

    Raises:
        ParameterError: an unknown name; the message says what is allowed.
    """

    robot: str = "nermo_lite"
    scene: Scene = "flat"
    tail: str = "rigid"
    routing: str = "type3"
    cone: str = "elliptic"
    physics: str = "reference"
    timestep: float = None  # type: ignore[assignment]  # a number once it is made
    gait: str = "trt"
    spine: str = "none"
    steering: str = "leg"
    profile: str = "exact"
    pilot: str = "straight"
    waypoints: tuple[tuple[float, float], ...] | None = None
    command: Command | None = None
    trajectory: str = "cubic"

    def __post_init__(self) -> None:
        config = RobotConfig(
            self.robot, self.scene, self.tail, self.routing, self.cone, self.physics, self.timestep
        )  # fmt: skip
        object.__setattr__(self, "timestep", config.timestep)
        object.__setattr__(self, "scene", config.scene)
        published_values(self.gait, steering=self.steering, profile=self.profile)
        self.controller()
        ratio = 1.0 / (self.controller().control_rate * self.timestep)
        if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise ParameterError(
                f"timestep is {self.timestep}: allowed is the control period 0.01 s divided by a whole number."
            )

    def load(self) -> Robot:
        """The assembled robot in its scene."""
        return load_robot(self.robot, self.scene, self.tail, self.routing, self.cone, self.physics, self.timestep)

    def controller(self) -> Controller:
        """The controller with these choices."""
        robot = self.load()
        return Controller(
            spine=self.spine, pilot=self.pilot, waypoints=self.waypoints, command=self.command,
            trajectory=self.trajectory, routing=self.routing, masses=robot.mass_model,
            n_servos=robot.n_servos,
        )  # fmt: skip

    def defaults(self) -> dict[str, float]:
        """Value of every parameter before a user names any."""
        values = {name: float(about.default) for name, about in quantities(WorldParameters)}  # type: ignore[arg-type]
        values |= gravity_values(self.load().gravity)
        return values | published_values(self.gait, steering=self.steering, profile=self.profile)


def all_parameters(setup: Setup | None = None) -> dict[str, Quantity]:
    """Every parameter a sweep may name, with the defaults of `setup`."""
    setup = setup or Setup()
    defaults = setup.defaults()
    known = {name: dataclasses.replace(about, default=defaults[name]) for name, about in quantities(WorldParameters)}
    return known | _bounded_by_step(known, setup.timestep)


def _bounded_by_step(known: Mapping[str, Quantity], timestep: float) -> dict[str, Quantity]:
    """The parameters whose range depends on the time step, with the range that it leaves."""
    contact, kp, kv = (known[name] for name in ("contact.time_constant", "servo.kp", "servo.kv"))
    stiffest, most_damped = highest_kp(timestep, float(kv.default)), highest_kv(timestep, float(kp.default))  # type: ignore[arg-type]
    return {
        # MuJoCo lengthens what is shorter than two time steps, without a word.
        "contact.time_constant": dataclasses.replace(contact, low=max(contact.low, 2 * timestep)),
        "servo.kp": dataclasses.replace(kp, high=min(kp.high, stiffest)),
        "servo.kv": dataclasses.replace(kv, high=min(kv.high, most_damped)),
    }


def check_world(params: WorldParameters, timestep: float) -> None:
    """Refuse parameters that are not finite, out of their range, or outside what the time step allows.

    Args:
        params: concrete (not traced); leaves may carry leading batch axes.
        timestep: of the physics [s].

    Raises:
        ParameterError: with the field's name, its value and what is allowed.
    """
    check_quantities(params)
    for name, about in _bounded_by_step(dict(quantities(ModelParameters)), timestep).items():
        group, field = name.split(".")
        about.check(name, getattr(getattr(params.model, group), field))
    check_servo(params.model.servo.kp, params.model.servo.kv, timestep)


Length = float | np.ndarray


@dataclasses.dataclass(frozen=True)
class Run:
    """How long a run lasts and what part of it is measured: gait cycles, or seconds.

    Each number holds for all worlds, or is an array (n,) with one entry a world.

    Attributes:
        cycles, warmup_cycles: length of the run, and of its unmeasured start, in gait cycles.
        duration, warmup: the same in simulated seconds; `duration` excludes `cycles`.
        distance: measuring stops at the end of the gait cycle in which the robot has walked this far [m].

    Raises:
        ParameterError: neither or both lengths, a warm-up as long as the run, a value that is not finite.
    """

    cycles: Length | None = None
    warmup_cycles: Length | None = None
    duration: Length | None = None
    warmup: Length | None = None
    distance: Length | None = None

    def __post_init__(self) -> None:
        for name in ("cycles", "warmup_cycles", "duration", "warmup", "distance"):
            value, zero_ok = getattr(self, name), name.startswith("warmup")
            if value is None:
                continue
            bad = ~(np.isfinite(value) & ((np.asarray(value) > 0) | (zero_ok & (np.asarray(value) == 0))))
            if bad.any():
                shown = np.asarray(value)[bad].flat[0]
                raise ParameterError(f"run.{name} is {float(shown)!r}: allowed is {'[' if zero_ok else '('}0, inf).")
        if self.duration is not None and (self.cycles is not None or self.warmup_cycles is not None):
            raise ParameterError("run.duration is given beside run.cycles: give either seconds or gait cycles.")
        if self.duration is None and self.warmup is not None:
            raise ParameterError("run.warmup is given without run.duration: with cycles, give run.warmup_cycles.")
        length, warmup = np.broadcast_arrays(*self._lengths())
        late = warmup >= length
        if late.any():
            name = "warmup_cycles" if self.duration is None else "warmup"
            raise ParameterError(
                f"run.{name} is {warmup[late].flat[0]:g}: allowed is less than the run's length, "
                f"{length[late].flat[0]:g}."
            )

    def _lengths(self) -> tuple[Length, Length]:
        if self.duration is not None:
            return self.duration, 0.0 if self.warmup is None else self.warmup
        cycles = 8.0 if self.cycles is None else self.cycles
        default = np.where(np.asarray(cycles) > 2.0, 2.0, 0.0)
        return cycles, default if self.warmup_cycles is None else self.warmup_cycles

    def seconds(self, frequency: Any, clock_ratio: Any = 1.0) -> tuple[Any, Any]:
        """(end of the warm-up, end of the run) in simulated seconds, shaped as `frequency`, which may be traced."""
        length, warmup = self._lengths()
        period = clock_ratio / frequency if self.duration is None else frequency**0
        return warmup * period, length * period
