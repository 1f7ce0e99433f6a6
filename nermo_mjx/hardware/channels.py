"""Mapping of servos to the channels of a servo board, and conversion of their angles.

A file names the servos that are connected:

    rate: 50
    front_left_hip: {channel: 0, direction: 1, zero: 90, low: 20, high: 160}
    front_left_knee: {channel: 1, direction: -1, zero: 92.5}

    servo degrees = zero + direction * angle of the controller in degrees

Channels go up from 0; direction is 1 or -1; `zero` is the servo angle for 0 from the controller; `low` and `high` are
its limits; `missing` is sent if the simulated robot has no such servo. `rate` is the rate at which angles are sent, and
`whole_degrees` how they are rounded.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Float
from pydantic import Field, create_model

from nermo_mjx.robot import SERVOS
from nermo_mjx.robot.quantity import of_type
from nermo_mjx.specs.fields import Fields, optional, read
from nermo_mjx.specs.reading import read_file, read_mapping
from nermo_mjx.specs.values import Finite, Whole

#: The order of the author's software, by its name.
PUBLISHED_ORDER: Final = "published"
#: How angles are rounded to whole degrees.
ROUNDING_FUNCTIONS: Final = {"rounded": np.rint, "truncated": np.trunc}


class ChannelFields(Fields):
    """A servo's entry in a file."""

    what: ClassVar = "a field of a channel"
    expected: ClassVar = "a mapping such as {channel: 0, direction: 1, zero: 90}"
    example: ClassVar = expected
    channel: Annotated[int, Whole(0, 65_535)] = Field(description="on the servo board, from 0")
    direction: float = optional(
        "-1 where the servo turns against the controller's angle", enum=[1, -1]
    )
    zero: Finite = optional("servo angle where the controller says 0 [deg]")
    low: Finite = optional("least that the servo may be given [deg]")
    high: Finite = optional("most that the servo may be given [deg]")
    missing: Finite = optional(
        "servo angle where the simulated robot has no such servo [deg]; else it is refused"
    )


class Servos(Fields):
    """A file for `nermo-mjx servos --channels`: the connected servos."""

    what: ClassVar = "a servo"
    rate: float = optional("how often the servos are given angles [Hz]", exclusiveMinimum=0)
    whole_degrees: str = optional(
        "angles are given in whole degrees: to the nearest, or cut", enum=[*ROUNDING_FUNCTIONS]
    )


_SERVO_FIELDS: dict[str, Any] = {name: (ChannelFields, optional()) for name in SERVOS}
ChannelsFile = create_model(
    "ChannelsFile", __base__=Servos, __doc__=Servos.__doc__, **_SERVO_FIELDS
)


@dataclasses.dataclass(frozen=True)
class ServoChannel:
    """One servo on its channel.

    Attributes:
        servo: of `SERVOS`.
        number: of the channel, from 0.
        direction: 1 or -1.
        zero: servo angle for 0 from the controller [deg].
        low, high: limits of the servo angle [deg].
        missing: servo angle if the simulated robot has no such servo [deg]; None if that is an error.
    """

    servo: str
    number: int
    direction: float = 1.0
    zero: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    missing: float | None = None


@dataclasses.dataclass(frozen=True)
class Channels:
    """The connected servos, and the rate and rounding of their angles.

    Attributes:
        servos: in the order of their channels.
        rate: at which angles are sent [Hz]; None if not specified.
        whole_degrees: `rounded` or `truncated`; None for angles that are not rounded.
    """

    servos: tuple[ServoChannel, ...]
    rate: float | None = None
    whole_degrees: str | None = None

    def __iter__(self) -> Iterator[ServoChannel]:
        return iter(self.servos)

    def given(self, degrees: Float[np.ndarray, ...]) -> Float[np.ndarray, ...]:
        """Angles as sent to the servos [deg]."""
        return (
            degrees
            if self.whole_degrees is None
            else ROUNDING_FUNCTIONS[self.whole_degrees](degrees) + 0.0
        )


def read_channels(source: str | os.PathLike[str] | Mapping[str, Any]) -> Channels:
    """The channels of a file, of a dict with its fields, see this module, or "published", the author's order.

    >>> [channel.servo for channel in read_channels("published")][:3]
    ['front_left_hip', 'front_left_knee', 'front_right_hip']

    Raises:
        SpecError: a sentence with file, line, field, value and what is allowed.
    """
    of_type(
        "channels",
        source,
        (Mapping, str, os.PathLike),
        "the path of a file, or a mapping of its fields",
    )
    if isinstance(source, Mapping):
        doc = read_mapping(source, "channels")
    else:
        shipped = os.fspath(source) == PUBLISHED_ORDER
        doc = read_file(
            Path(__file__).with_name(f"{PUBLISHED_ORDER}.yaml") if shipped else source,
            "table of channels",
        )
    file = read(doc, ChannelsFile)
    channels_by_number: dict[int, ServoChannel] = {}
    for servo in (key for key in doc.data if key not in Servos.model_fields):
        fields = getattr(file, servo).model_dump(exclude_unset=True)
        channel = ServoChannel(servo, fields.pop("channel"), **fields)
        if channel.direction not in (1, -1):
            doc.fail((servo, "direction"), f"is {channel.direction:g}: allowed is 1 or -1.")
        if channel.number in channels_by_number:
            doc.fail(
                (servo, "channel"),
                f"is {channel.number}, which {channels_by_number[channel.number].servo} has already.",
            )
        if channel.low >= channel.high:
            doc.fail(
                (servo, "low" if "low" in fields else "high"),
                f"low is {channel.low:g} and high {channel.high:g}: low must be less.",
            )
        channels_by_number[channel.number] = channel
    if not channels_by_number:
        doc.fail((), "no servo is named; at least one is needed.")
    if file.whole_degrees not in (None, *ROUNDING_FUNCTIONS):
        doc.fail(
            ("whole_degrees",),
            f"is {file.whole_degrees!r}: allowed is {' or '.join(ROUNDING_FUNCTIONS)}.",
        )
    return Channels(
        tuple(channels_by_number[number] for number in sorted(channels_by_number)),
        file.rate,
        file.whole_degrees,
    )
