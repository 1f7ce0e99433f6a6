"""Gait, spine modes, steering, head and tail that change while the robot walks.

A controller is a pure function of its parameters, and parameters may change at any tick. A schedule is a list of
switches; before each tick the controller gets the parameters of that moment. With p_0 the world's own value of a
parameter, p_k that after switch k, and r_k in [0, 1] how far the switch has come,

    p(t) = p_0 + sum_k r_k(t) (p_k - p_{k-1}),        r_k(t) = clip((t - at_k) / (blend_k T), 0, 1),

with T the period of the gait cycle. Offsets of limbs go the shorter way around the cycle. So feet and servos are
continuous: a limb's phase is, as long as it never goes backward, which `check_schedule` guarantees. A mode is switched
by its gain, whose value while it acts is the world's own: amplitude of the stride extension, gain of the gaze.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeVar

import jax.numpy as jnp
import numpy as np

from nermo_mjx.control.head_and_tail import (
    COUNTER_ROLL,
    COUNTER_YAW,
    GAZE,
    SWING,
    HeadName,
    TailMotionName,
)
from nermo_mjx.control.parameters import (
    GRIP,
    SPINE_HARMONICS,
    STEERING,
    ControlParameters,
    SteeringName,
    with_gait_factor,
)
from nermo_mjx.control.spine_modes import mode_names
from nermo_mjx.robot.parameters import GAIT_CODES, GAIT_PATTERNS, LIMBS, GaitName
from nermo_mjx.robot.quantity import (
    ParameterError,
    Quantity,
    allowed_names,
    choice,
    parameter_tree,
    quantities,
    quantity,
    replace_quantities,
    values_of,
)
from nermo_mjx.shapes import Scalars

Tree = TypeVar("Tree")
#: Most switches of a run.
MAX_SWITCHES: Final = 8
#: The parameters by which each mode is switched off and on.
MODE_GAINS: Final[Mapping[str, tuple[str, ...]]] = {
    "stride_extension": ("spine.amplitude",),
    "balance": ("spine.balance_share",),
    "harmonics": tuple(
        f"spine.harmonics.{part}{k}"
        for k in range(1, SPINE_HARMONICS + 1)
        for part in ("cos", "sin")
    ),
    "sagittal_extension": ("spine.sagittal_amplitude",),
    "pitch_balance": ("spine.pitch_gain", "spine.pitch_damping"),
    GAZE: ("head.gain",),
    SWING: ("tail.swing_amplitude",),
    COUNTER_YAW: ("tail.yaw_gain",),
    COUNTER_ROLL: ("tail.roll_gain",),
}
#: Choices of a switch that turn modes off and on.
MODE_CHOICES: Final = ("spine", "head", "tail_motion")


@dataclasses.dataclass(frozen=True)
class Switch:
    """What changes at a time; what is None stays as it was.

    >>> Switch(at=2.0, gait="lateral_walk", values={"frequency": 0.8}).values
    (('frequency', 0.8),)

    Attributes:
        at: when it begins [s].
        blend: how long it takes, in gait cycles of the world's own frequency.
        gait, steering, spine, head, tail_motion: by name, as in `Setup`.
        values: of parameters of the controller, by name; stored as pairs.

    Raises:
        ParameterError: an unknown name, or a switch that changes nothing.
    """

    at: float
    blend: float = 1.0
    gait: GaitName | None = None
    steering: SteeringName | None = None
    spine: str | None = None
    head: HeadName | None = None
    tail_motion: TailMotionName | None = None
    values: Any = ()

    def __post_init__(self) -> None:
        items = self.values.items() if isinstance(self.values, Mapping) else self.values
        allowed = dict(quantities(ControlParameters))
        items = (
            (str(name), allowed[name].numbers(name, value) if name in allowed else value)
            for name, value in items
        )
        object.__setattr__(self, "values", tuple((name, float(value)) for name, value in items))
        object.__setattr__(self, "gait", GAIT_CODES.get(self.gait or "", self.gait))
        for field, names in allowed_names(Switch).items():
            if (name := getattr(self, field)) is not None:
                choice(field, name, names)
        modes = self.modes
        if not (self.values or modes or self.gait or self.steering):
            raise ParameterError(
                "switch changes nothing: give a gait, steering, spine, head, tail_motion or set."
            )

    @property
    def modes(self) -> dict[str, tuple[str, ...]]:
        """The modes that act afterwards, by the choice that it makes."""
        choices = {"head": self.head, "tail_motion": self.tail_motion}
        modes = {
            field: tuple({name} - {"none"}) for field, name in choices.items() if name is not None
        }
        return modes | ({} if self.spine is None else {"spine": mode_names(self.spine)})

    def absolute(self) -> dict[str, float]:
        """The values that it gives parameters, those of the gait and of the steering among them."""
        values: dict[str, float] = {}
        if self.gait is not None:
            pattern = GAIT_PATTERNS[self.gait]
            values |= {"duty": pattern.duty, "gait_factor": pattern.gait_factor}
            values |= {
                f"offset.{limb}": offset
                for limb, offset in zip(LIMBS, pattern.offsets, strict=True)
            }
        if self.steering is not None:
            leg, spine = STEERING[self.steering]
            values |= {
                "turning.leg": leg,
                "turning.spine": spine,
                "pilot.grip": GRIP[self.steering],
            }
        return values | with_gait_factor(dict(self.values))

    def written(self) -> dict[str, Any]:
        """As in a file."""
        fields = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name != "values"
        }
        fields["set"] = dict(self.values) or None
        return {name: value for name, value in fields.items() if value is not None}


def _of_switches(default: float, unit: str, low: float, high: float, doc: str) -> Any:
    return quantity(
        (default,) * MAX_SWITCHES,
        unit,
        low,
        high,
        doc,
        labels=tuple(map(str, range(1, MAX_SWITCHES + 1))),
    )


@parameter_tree
class Schedule:
    """The switches of a run as parameters: a sweep can vary their times, and a gradient goes through them.

    Attributes:
        at, blend: of each switch; those that are not used change nothing.
        share, value: by the name of a parameter, p_k = share_k p + value_k with p the world's own; k = 0 is before the
            first switch, and the last is `MAX_SWITCHES`.
    """

    at: Any = _of_switches(0.0, "s", 0.0, 1e6, "when the switch begins")
    blend: Any = _of_switches(1.0, "1", 0.05, 100.0, "how long it takes, in gait cycles")
    share: dict[str, Any] = dataclasses.field(default_factory=dict)
    value: dict[str, Any] = dataclasses.field(default_factory=dict)


def schedule_of(
    start: Switch, switches: Sequence[Switch], declarations: Mapping[str, Quantity]
) -> Schedule:
    """The schedule of switches.

    Args:
        start: the modes that act at the start, of each of `MODE_CHOICES`.
        switches: in the order of time.
        declarations: parameters of the controller, with their ranges.

    Raises:
        ParameterError: too many switches, or a parameter that is unknown or out of range.
    """
    if len(switches) > MAX_SWITCHES:
        raise ParameterError(f"schedule has {len(switches)} switches: allowed are {MAX_SWITCHES}.")
    acting: dict[str, set[str]] = {}
    ever = {
        field: {name for entry in (start, *switches) for name in entry.modes.get(field, ())}
        for field in MODE_CHOICES
    }
    changes: dict[str, float] = {}
    course: list[dict[str, tuple[float, float]]] = []
    for number, switch in enumerate((start, *switches)):
        values, modes = switch.absolute(), switch.modes
        try:
            for name in [
                *values,
                *(gain for names in modes.values() for mode in names for gain in MODE_GAINS[mode]),
            ]:
                declaration = declarations[choice("parameter", name, declarations)]
                if name in values:
                    declaration.check(name, values[name])
        except ParameterError as error:
            raise ParameterError(f"schedule.{number} is refused: {error}") from None
        changes |= values
        acting |= {field: set(names) for field, names in modes.items()}
        off = {
            gain
            for field, names in ever.items()
            for name in names - acting[field]
            for gain in MODE_GAINS[name]
        }
        course.append(
            {name: (0.0, value) for name, value in changes.items()} | dict.fromkeys(off, (0.0, 0.0))
        )
    course += course[-1:] * (MAX_SWITCHES - len(switches))
    names = sorted({name for values in course for name in values})
    steps = {name: np.array([values.get(name, (1.0, 0.0)) for values in course]) for name in names}
    unused = MAX_SWITCHES - len(switches)
    return Schedule(
        at=np.array([*(switch.at for switch in switches), *[0.0] * unused]),
        blend=np.array([*(switch.blend for switch in switches), *[1.0] * unused]),
        share={name: pairs[:, 0] for name, pairs in steps.items()},
        value={name: pairs[:, 1] for name, pairs in steps.items()},
    )


def scheduled(
    control: Tree, schedule: Schedule | None, time: Scalars | float, cycle_rate: Any
) -> Tree:
    """The controller's parameters at a time.

    Args:
        control: the world's own; leaves may have leading batch axes, as those of the schedule.
        schedule: None for parameters that do not change.
        time: since the start [s].
        cycle_rate: gait cycles per second of simulated time [1/s], by the world's own parameters.
    """
    if schedule is None or not schedule.share:
        return control
    rate = jnp.asarray(cycle_rate)[..., None]
    come = jnp.clip((time - schedule.at) * rate / schedule.blend, 0.0, 1.0)
    courses = _courses(control, schedule)
    now = {
        name: course[..., 0] + jnp.sum(come * (course[..., 1:] - course[..., :-1]), -1)
        for name, course in courses.items()
    }
    return replace_quantities(control, now)


def _courses(control: Any, schedule: Schedule) -> dict[str, Any]:
    """By name, the values (..., MAX_SWITCHES + 1) of a parameter before the first switch and after each."""
    constants, courses = dict(values_of(control)), {}
    for name, share in schedule.share.items():
        course = jnp.asarray(constants[name])[..., None] * share + schedule.value[name]
        if name.startswith("offset."):  # the shorter way around the cycle
            moves = course[..., 1:] - course[..., :-1]
            moves = jnp.cumsum(moves - jnp.round(moves), -1)
            course = jnp.concatenate([course[..., :1], course[..., :1] + moves], -1)
        courses[name] = course
    return courses


def turned(moves: Mapping[str, Any]) -> Any:
    """By how much of the cycle a limb goes backward at most, by changes of parameters by name."""
    offsets = [np.abs(move) for name, move in moves.items() if name.startswith("offset.")]
    return (np.maximum.reduce(offsets) if offsets else 0.0) + np.abs(moves.get("duty", 0.0))


def check_schedule(control: Any, schedule: Schedule, switches: int, cycle_rate: Any) -> None:
    """Reject switches that overlap, or by which a limb would go backward in its cycle.

    Args:
        control, schedule, cycle_rate: as for `scheduled`; concrete.
        switches: how many of the schedule's are used.

    Raises:
        ParameterError: with the parameter of the schedule, its value and what is allowed.
    """
    begin, blend = np.asarray(schedule.at, float), np.asarray(schedule.blend, float)
    period = 1.0 / np.asarray(cycle_rate, float)[..., None]
    ends = begin + blend * period
    for k in range(1, switches):
        overlaps = (begin[..., k] < ends[..., k - 1]).ravel()
        if overlaps.any():
            value, end = begin[..., k].ravel()[overlaps][0], ends[..., k - 1].ravel()[overlaps][0]
            raise ParameterError(
                f"schedule.at.{k + 1} is {value:g}: allowed is at least {end:g} s, when switch {k} ends."
            )
    courses = {
        name: np.asarray(course, float) for name, course in _courses(control, schedule).items()
    }
    moves = {name: np.abs(np.diff(course)) for name, course in courses.items()}
    backward = np.zeros_like(blend) + turned(moves)
    if "frequency" in courses:
        course = courses["frequency"]
        backward = backward * course[..., :1] / np.minimum(course[..., 1:], course[..., :-1])
    backward, blend = np.broadcast_arrays(backward, blend)
    for k in range(switches):
        short = (backward[..., k] >= blend[..., k]).ravel()
        if short.any():
            value, minimum = blend[..., k].ravel()[short][0], backward[..., k].ravel()[short][0]
            raise ParameterError(
                f"schedule.blend.{k + 1} is {value:g}: allowed is more than {minimum:g} cycles; a limb would go backward."
            )
