"""The interface of controllers for simulators, metrics, sweeps and tunings: pure functions of pytrees."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Bool, Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.kinematics.leg import four_legs, inverse
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import Sensors, ServoAngles
from nermo_mjx.shapes import Array, Scalar

#: What every controller has.
REQUIRED = ("dt", "parameters", "init", "initial_servo", "update", "cycle_rate")


@runtime_checkable
class ControllerLike(Protocol):
    """A controller. `params` and its state are any pytrees; values are unbatched, and engines `vmap`.

    Where `parameters` is a parameter tree (`nermo_mjx.parameter_tree`), each of its quantities can be named like those
    of the published controller: in `values`, and in sweep and tuning files.
    """

    @property
    def dt(self) -> float:
        """Simulated duration of a control tick [s], a whole number of physics steps."""

    @property
    def parameters(self) -> Any:
        """Default parameters of one world; they define the structure and shapes of all others."""

    def init(self, params: Any, sensors: Sensors, phase: Scalar) -> Any:
        """State at the start, from the readings at rest; `phase` is `start.phase`."""

    def initial_servo(self, params: Any, phase: Scalar) -> ServoAngles:
        """Servo angles of the start pose."""

    def update(self, params: Any, state: Any, sensors: Sensors) -> tuple[Any, ServoAngles]:
        """One control tick: the state and the servo angles `dt` later."""

    def cycle_rate(self, params: Any) -> Any:
        """Gait cycles per simulated second [1/s], in which runs are counted and over which metrics are averaged.

        Elementwise: in a batch the leaves of `params` have a leading axis.
        """


@runtime_checkable
class FollowsPath(Protocol):
    """A controller with a path, relative to which the robot is measured (`cross_track_rms`, progress along it)."""

    def path(self, params: Any, state: Any, position: Float[Array, " 3"]) -> PathPoint | None:
        """The point of the path closest to a position [m]; None if it does not follow one."""


@runtime_checkable
class ActsUpon(Protocol):
    """A controller that acts upon the published one, such as a policy."""

    def upon(self, **choices: Any) -> ControllerLike:
        """The same controller upon a published one with other choices, named as in `Setup`: `pilot`, `spine`.

        Raises:
            ParameterError: it cannot act upon that one.
        """


@runtime_checkable
class PlansContact(Protocol):
    """A controller that plans contacts (for `swing_loaded_rear`)."""

    def stance(self, state: Any) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""


@runtime_checkable
class ChecksParameters(Protocol):
    """A controller with checks of its parameters beyond the ranges of its quantities."""

    def check(self, params: Any) -> None:
        """Raise `ParameterError` with one sentence. `params` are not traced, and may have leading batch axes."""


@runtime_checkable
class CompletesValues(Protocol):
    """A controller with parameters that are derived from others, unless both are named."""

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        """Named values plus derived ones."""


def leg_servos(
    feet: Float[Array, "4 2"], spine: Any = 0.0, routing: str = "type3", geometry: Geometry | None = None
) -> ServoAngles:
    """Servo angles for feet (y, z) in their legs' frames [m] and the spine's servo [rad]; neck and tail are straight.

    >>> leg_servos(jnp.asarray([[0.0, -0.045], [0.0, -0.045], [0.0, -0.05], [0.0, -0.05]])).hip.shape
    (4,)

    Args:
        feet: y is backward, z up from the hip's axis; unreachable positions are moved to the edge of the workspace.
        spine: positive turns left.
        routing: knee tendon routing of the robot.
        geometry: of the robot, by default the published one. If a controller's parameters have a group `geometry:
            Geometry`, it receives that of its world.
    """
    servo = inverse(four_legs(geometry or Geometry()), feet, routing).servo
    spine = jnp.asarray(spine, servo.dtype)
    rest = jnp.zeros_like(spine)
    return ServoAngles(hip=servo[..., 0], knee=servo[..., 1], spine=spine, neck=rest, tail=rest)
