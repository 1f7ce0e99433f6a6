"""What a policy's action does: it changes the controller's servo targets or its parameters, or replaces the targets.

An action is one number in [-1, 1] for each of the names of its kind. At zero the controller is unchanged
(`Residual`, `Modulation`), or the robot stands (`Targets`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Final, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Float
from pydantic import Field

from nermo_mjx.control.path import PathPoint
from nermo_mjx.control.protocol import ControllerLike, FollowsPath, PlansContact
from nermo_mjx.robot import ParameterError, Sensors, ServoAngles
from nermo_mjx.robot.parameters import SERVOS
from nermo_mjx.robot.quantity import (
    check_quantities,
    did_you_mean,
    quantities,
    replace_quantities,
    values_of,
)
from nermo_mjx.shapes import Array, Scalar
from nermo_mjx.specs.model import Spec, one_of
from nermo_mjx.specs.values import Ends

#: Servos that actions reach: those of the legs and the spine. The neck and the tail look straight ahead and back.
ACTION_SERVOS: Final = SERVOS[:9]

Action = Float[Array, " a"]
_Range = Annotated[float, Field(ge=0, le=1.6)]


@runtime_checkable
class ActionKind(Protocol):
    """The effect of an action on a controller. Values are unbatched."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers of an action (a,)."""

    def check(self, controller: ControllerLike) -> None:
        """Raise `ParameterError` if such an action cannot change anything of the controller."""

    def parameters(self, params: Any, action: Action) -> Any:
        """The parameters of the controller under an action (a,)."""
        return params

    def servo(self, servo: ServoAngles, home: ServoAngles, action: Action) -> ServoAngles:
        """Servo angles [rad] under an action (a,), from the angles of the controller and of the standing robot (`home`)."""
        return servo


@dataclasses.dataclass(frozen=True)
class ServoAction(Spec, ActionKind):
    """Common base of `Residual` and `Targets`: an action moves each group of servos within a range."""

    what = "a group of servos"
    expected = "{hip: rad, knee: rad, spine: rad}"
    hip: _Range
    """range of the hips' servos to either side [rad]; 0: they do not belong to the action"""
    knee: _Range
    """range of the knees' servos to either side [rad]; 0: they do not belong to the action"""
    spine: _Range
    """range of the spine's servo to either side [rad]; 0: it does not belong to the action"""

    def __post_init__(self) -> None:
        called, ranges = type(self).__name__.lower(), dataclasses.asdict(self)
        for name, value in ranges.items():
            if not 0.0 <= value <= 1.6:
                raise ParameterError(f"{called}.{name} is {value!r}: allowed is [0, 1.6] rad.")
        if not any(ranges.values()):
            raise ParameterError(
                f"{called} has ranges of 0 only: give at least one of hip, knee and spine [rad]."
            )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name in ACTION_SERVOS if getattr(self, name.rsplit("_", 1)[-1]))

    def move_servos(self, servo: ServoAngles, action: Action) -> ServoAngles:
        """Servo angles [rad] after the action (a,) has moved each servo by its share of the range."""
        hip, knee, index = servo.hip, servo.knee, 0
        if self.hip:
            hip, index = hip + self.hip * action[:4], 4
        if self.knee:
            knee, index = knee + self.knee * action[index : index + 4], index + 4
        spine = servo.spine + self.spine * action[index] if self.spine else servo.spine
        return dataclasses.replace(servo, hip=hip, knee=knee, spine=spine)


@dataclasses.dataclass(frozen=True)
class Residual(ServoAction):
    """An action corrects the servo targets of the controller; the nine default corrections are as in the publications.

    >>> Residual(spine=0.0).names[-1]
    'rear_right_knee'
    """

    hip: _Range = 0.3
    """largest correction of a hip's servo [rad]; 0: the hips are left to the controller"""
    knee: _Range = 0.3
    """largest correction of a knee's servo [rad]; 0: the knees are left to the controller"""
    spine: _Range = 0.2
    """largest correction of the spine's servo [rad]; 0: the spine is left to the controller"""

    def servo(self, servo: ServoAngles, home: ServoAngles, action: Action) -> ServoAngles:
        return self.move_servos(servo, action)


@dataclasses.dataclass(frozen=True)
class Targets(ServoAction):
    """An action replaces the servo targets, around the pose of the standing robot; only the controller's clock is used."""

    hip: _Range = 0.8
    """range of a hip's servo to either side [rad]; 0: the hips keep their standing pose"""
    knee: _Range = 0.8
    """range of a knee's servo to either side [rad]; 0: the knees keep their standing pose"""
    spine: _Range = 0.4
    """range of the spine's servo to either side [rad]; 0: the spine keeps its standing pose"""

    def servo(self, servo: ServoAngles, home: ServoAngles, action: Action) -> ServoAngles:
        return self.move_servos(home, action)


#: Default parameters of `Modulation`, and their ranges.
MODULATION_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "frequency": (0.4, 1.4),
    "stride": (0.4, 1.0),
    "spine.amplitude": (0.0, 0.4),
    "spine.phase": (-3.1416, 3.1416),
    "pilot.turn_rate": (-1.0, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Modulation(Spec, ActionKind):
    """An action changes parameters of the controller while it runs.

    An action of -1 sets the low end of the range, 0 the value that the controller has without a policy, and 1 the high
    end; values in between are interpolated linearly. Only the pilot `open_loop` reads the turn rate, and only the mode
    `stride_extension` of the spine reads the spine's amplitude and phase.
    """

    what = "an option of 'modulation'"
    expected = "{ranges: {parameter: [low, high]}}"
    ranges: dict[str, Ends] = dataclasses.field(default_factory=lambda: dict(MODULATION_RANGES))
    """parameters of the controller, and their ranges (low, high), each in its unit"""

    def __hash__(self) -> int:
        return hash(tuple(self.ranges.items()))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.ranges)

    def check(self, controller: ControllerLike) -> None:
        allowed = dict(quantities(controller.parameters))
        if not self.ranges:
            raise ParameterError(
                "modulation has no ranges: name at least one parameter of the controller."
            )
        for name, (low, high) in self.ranges.items():
            if name not in allowed:
                hint = did_you_mean(name, allowed)
                raise ParameterError(
                    f"modulation has {name!r}, which is no parameter of the controller{hint}"
                )
            if not low < high:
                raise ParameterError(
                    f"modulation.{name} is [{low:g}, {high:g}]: expected a low end and a high end."
                )
            check_quantities(replace_quantities(controller.parameters, {name: low}))
            check_quantities(replace_quantities(controller.parameters, {name: high}))

    def parameters(self, params: Any, action: Action) -> Any:
        values, changed = dict(values_of(params)), {}
        for share, (name, (low, high)) in zip(action, self.ranges.items(), strict=True):
            value = jnp.asarray(values[name])
            span = jnp.where(share > 0.0, high - value, value - low)
            changed[name] = jnp.clip(value + share * span, low, high)
        return replace_quantities(params, changed)


#: Kinds of actions, by their names in files.
ACTIONS: Final[dict[str, Any]] = {
    "residual": Residual,
    "modulation": Modulation,
    "targets": Targets,
}
#: A field for the kind of an action.
ActionField = Annotated[ActionKind, one_of("Action", "is not what an action does", ACTIONS)]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ActionParameters:
    """Parameters of a controller, and the action on this controller, numbers in [-1, 1] (a,)."""

    control: Any
    action: Action


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ActionState:
    """State of the controller, and servo angles [rad] of the standing robot, which `Targets` reads."""

    control: Any
    home: ServoAngles


@dataclasses.dataclass(frozen=True)
class ActionController:
    """A controller under the actions of a policy. It is a `ControllerLike` whose parameters are `ActionParameters`.

    >>> from nermo_mjx.control import published_controller
    >>> ActionController(published_controller(), Residual()).parameters.action.shape
    (9,)

    Attributes:
        base: Controller that the actions change.
        kind: Kind of the actions.
    """

    base: ControllerLike
    kind: ActionKind

    def __post_init__(self) -> None:
        self.kind.check(self.base)

    @property
    def dt(self) -> float:
        return self.base.dt

    @property
    def parameters(self) -> ActionParameters:
        """See `ControllerLike`; the action is zero."""
        return ActionParameters(self.base.parameters, jnp.zeros(len(self.kind.names)))

    def init(self, params: ActionParameters, sensors: Sensors, phase: Scalar) -> ActionState:
        return ActionState(self.base.init(params.control, sensors, phase), self._home(params))

    def initial_servo(self, params: ActionParameters, phase: Scalar) -> ServoAngles:
        return (
            self._home(params)
            if isinstance(self.kind, Targets)
            else self.base.initial_servo(params.control, phase)
        )

    def update(
        self, params: ActionParameters, state: ActionState, sensors: Sensors
    ) -> tuple[ActionState, ServoAngles]:
        action = jnp.clip(params.action, -1.0, 1.0)
        control_parameters = self.kind.parameters(params.control, action)
        control, servo = self.base.update(control_parameters, state.control, sensors)
        return ActionState(control, state.home), self.kind.servo(servo, state.home, action)

    def cycle_rate(self, params: ActionParameters) -> Any:
        if not isinstance(self.kind, Modulation):
            return self.base.cycle_rate(params.control)
        action = jnp.moveaxis(
            jnp.clip(jnp.asarray(params.action), -1.0, 1.0), -1, 0
        )  # the actions of a batch apply one by one
        return self.base.cycle_rate(self.kind.parameters(params.control, action))

    def path(
        self, params: ActionParameters, state: ActionState, position: Float[Array, " 3"]
    ) -> PathPoint | None:
        """See `FollowsPath`; None if the controller does not follow a path."""
        if not isinstance(self.base, FollowsPath):
            return None
        return self.base.path(params.control, state.control, position)

    def stance(self, state: ActionState) -> Any:
        """See `PlansContact`; None if the controller does not plan contacts."""
        return self.base.stance(state.control) if isinstance(self.base, PlansContact) else None

    def _home(self, params: ActionParameters) -> ServoAngles:
        """Servo angles [rad] of the standing robot: the mean of the controller's initial angles over a gait cycle."""
        if not isinstance(self.kind, Targets):
            zero = jnp.zeros(())
            return ServoAngles(
                hip=jnp.zeros(4), knee=jnp.zeros(4), spine=zero, neck=zero, tail=zero
            )
        starts = [
            self.base.initial_servo(params.control, jnp.asarray(phase))
            for phase in (0.0, 0.25, 0.5, 0.75)
        ]
        return jax.tree.map(lambda *angles: sum(angles[1:], angles[0]) / len(angles), *starts)
