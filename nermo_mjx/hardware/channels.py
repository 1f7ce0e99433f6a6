"""Which servo hangs on which channel of a servo board, and how its angle is turned into that of the gait.

A file names the servos that are connected:

    front_left_hip: {channel: 0, direction: 1, zero: 90, low: 20, high: 160}
    front_left_knee: {channel: 1, direction: -1, zero: 92.5}

    servo degrees = zero + direction * angle of the controller in degrees

Channels go up from 0; direction is 1 or -1; `zero` is what the servo is given where the controller says 0; `low` and
`high` are what it may be given.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, create_model

from nermo_mjx.robot import SERVOS
from nermo_mjx.robot.interface import servo_range
from nermo_mjx.specs.fields import Fields, optional, read
from nermo_mjx.specs.reading import read_file, read_mapping
from nermo_mjx.specs.values import Finite, Whole


class ChannelFields(Fields):
    """A servo, as it stands in a file."""

    what: ClassVar = "a field of a channel"
    expected: ClassVar = "a mapping such as {channel: 0, direction: 1, zero: 90}"
    example: ClassVar = expected
    channel: Annotated[int, Whole(0, 65_535)] = Field(description="on the servo board, from 0")
    direction: float = optional("-1 where the servo turns against the controller's angle", enum=[1, -1])
    zero: Finite = optional("servo angle where the controller says 0 [deg]")
    low: Finite = optional("least that the servo may be given [deg]")
    high: Finite = optional("most that the servo may be given [deg]")


class Servos(Fields):
    """A file for `nermo-mjx servos --channels`: the connected servos."""

    what: ClassVar = "a servo"


_NAMED: dict[str, Any] = {name: (ChannelFields, optional()) for name in SERVOS}
ChannelsFile = create_model("ChannelsFile", __base__=Servos, __doc__=Servos.__doc__, **_NAMED)


@dataclasses.dataclass(frozen=True)
class Channel:
    """One servo on its channel.

    Attributes:
        servo: of `SERVOS`.
        number: of the channel, from 0.
        direction: 1 or -1.
        zero: servo angle where the controller says 0 [deg].
        low, high: what the servo may be given [deg].
    """

    servo: str
    number: int
    direction: float = 1.0
    zero: float = 0.0
    low: float = -math.inf
    high: float = math.inf


#: The connected servos in the order of their channels.
Channels = tuple[Channel, ...]


def default_channels(n_servos: int, routing: str = "type3") -> Channels:
    """The first servos of `SERVOS` in their order, in the controller's own angles, with the model's limits."""
    limits = [tuple(math.degrees(end) for end in servo_range(servo, routing)) for servo in SERVOS[:n_servos]]
    return tuple(Channel(servo, i, low=low, high=high)
                 for i, (servo, (low, high)) in enumerate(zip(SERVOS, limits, strict=False)))  # fmt: skip


def read_channels(source: str | os.PathLike[str] | Mapping[str, Any]) -> Channels:
    """The channels of a file, or of a dict with its fields; see this module.

    Raises:
        SpecError: a sentence with file, line, field, value and what is allowed.
    """
    doc = read_mapping(source, "channels") if isinstance(source, Mapping) else read_file(source, "table of channels")
    file = read(doc, ChannelsFile)
    found: dict[int, Channel] = {}
    for servo in doc.data:
        given = getattr(file, servo).model_dump(exclude_unset=True)
        channel = Channel(servo, given.pop("channel"), **given)
        if channel.direction not in (1, -1):
            doc.fail((servo, "direction"), f"is {channel.direction:g}: allowed is 1 or -1.")
        if channel.number in found:
            doc.fail((servo, "channel"), f"is {channel.number}, which {found[channel.number].servo} has already.")
        if channel.low >= channel.high:
            doc.fail((servo, "low" if "low" in given else "high"), f"low is {channel.low:g} and high {channel.high:g}: "
                     "low must be less.")  # fmt: skip
        found[channel.number] = channel
    if not found:
        doc.fail((), "no servo is named; at least one is needed.")
    return tuple(found[number] for number in sorted(found))
