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
from typing import Any, Final

from nermo_mjx.robot import SERVOS
from nermo_mjx.robot.interface import servo_range
from nermo_mjx.sweep.reading import Document, describe, nearest, read_file, read_mapping

_FIELDS: Final = ("channel", "direction", "zero", "low", "high")


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
    found: dict[int, Channel] = {}
    for servo, fields in doc.data.items():
        if servo not in SERVOS:
            doc.fail((servo,), f"is no servo{nearest(servo, SERVOS)} There are {', '.join(SERVOS)}.")
        channel = _channel(doc, servo, fields)
        if channel.number in found:
            doc.fail((servo, "channel"), f"is {channel.number}, which {found[channel.number].servo} has already.")
        found[channel.number] = channel
    if not found:
        doc.fail((), "no servo is named; at least one is needed.")
    return tuple(found[number] for number in sorted(found))


def _channel(doc: Document, servo: str, fields: Any) -> Channel:
    if not isinstance(fields, dict):
        doc.fail((servo,), f"is {describe(fields)}: expected a mapping such as {{channel: 0, direction: 1, zero: 90}}.")
    for name, value in fields.items():
        if name not in _FIELDS:
            doc.fail((servo, name), f"is unknown{nearest(name, _FIELDS)} There are {', '.join(_FIELDS)}.")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            doc.fail((servo, name), f"is {describe(value)}: expected a finite number.")
    number = fields.get("channel")
    if not isinstance(number, int) or number < 0:
        what = "missing" if number is None else f"{number:g}"
        doc.fail(
            (servo, "channel") if "channel" in fields else (servo,), f"the channel is {what}: expected 0, 1, 2, ..."
        )
    if fields.get("direction", 1) not in (1, -1):
        doc.fail((servo, "direction"), f"is {fields['direction']:g}: allowed is 1 or -1.")
    given = {name: float(fields[name]) for name in ("direction", "zero", "low", "high") if name in fields}
    channel = Channel(servo, number, **given)
    if channel.low >= channel.high:
        doc.fail((servo, "low" if "low" in fields else "high"), f"low is {channel.low:g} and high {channel.high:g}: "
                 "low must be less.")  # fmt: skip
    return channel
