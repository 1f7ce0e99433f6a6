"""A robot's own log: a table of what was commanded and measured over time, and a file that says what its columns are.

    time: {column: t, unit: ms}
    channels:
      cmd_fl_hip: {quantity: command, of: front_left_hip, unit: deg, sign: -1, zero: 90}
      pos_fl_hip: {quantity: angle, of: front_left_hip, unit: deg}
      gyro: {quantity: gyro, columns: [gx, gy, gz], unit: deg/s}
      track: {quantity: position, columns: [x, y], unit: mm, time: {column: t_video, offset: 1.25}}

    value = sign * (number in the column - zero) * unit

The table is CSV or Parquet. Channels may have rates of their own: where a cell is empty, a channel has no sample. Late
samples are brought in order, and of those with one stamp the last counts; `Log.findings` tells it. A clock that is off
is set by `offset` [s], and by `scale` from its first stamp on. What a channel's own `time` does not say is as in the
file's.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
from jaxtyping import Float
from pydantic import Field

from nermo_mjx.files import MAX_ARRAY_BYTES, read_bytes
from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.specs.fields import Fields, optional, read
from nermo_mjx.specs.reading import Document, SpecError, describe, read_file, read_mapping
from nermo_mjx.specs.values import Choice, Finite, Positive

_DEGREE_RAD: Final = float(np.pi / 180.0)
_ANGLE_UNITS: Final = {"rad": 1.0, "deg": _DEGREE_RAD}
_LENGTH_UNITS: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_FORCE_UNITS: Final = {"N": 1.0, "mN": 1e-3}
_TORQUE_UNITS: Final = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2}
#: The quantities of channels, and the units of each in SI; the first is that of the values. Those of sliding joints and
#: of motors are among the servos'.
QUANTITIES: Final[dict[str, dict[str, float]]] = {
    "command": _ANGLE_UNITS | _LENGTH_UNITS | _TORQUE_UNITS,
    "angle": _ANGLE_UNITS | _LENGTH_UNITS,
    "velocity": {
        "rad/s": 1.0,
        "deg/s": _DEGREE_RAD,
        "rpm": 6.0 * _DEGREE_RAD,
        "m/s": 1.0,
        "mm/s": 1e-3,
    },
    "gyro": {"rad/s": 1.0, "deg/s": _DEGREE_RAD},
    "accelerometer": {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3},
    "position": _LENGTH_UNITS,
    "yaw": _ANGLE_UNITS,
    "force": _FORCE_UNITS,
    "contact": {"switch": 1.0},
    "current": {"A": 1.0, "mA": 1e-3},
    "torque": _TORQUE_UNITS,
}
#: What a channel is of where a file does not say it: the only such sensor of this robot. These are the quantities that
#: the base moves.
CHANNEL_PARTS: Final = {"gyro": "imu", "accelerometer": "imu", "position": "torso", "yaw": "torso"}
#: How many columns a channel may have: one for each axis of these quantities.
AXIS_COUNTS: Final = {"gyro": (3,), "accelerometer": (3,), "position": (2, 3)}
_TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: An angle may stand still when it is measured, unless its command moves by more than this [rad, m].
MOTION_THRESHOLD: Final = 0.05
#: Rows in a row that may be stamped before an earlier one: more are of a clock that was set back.
_MAX_LATE_ROWS: Final = 10
#: Longest interval between samples that is no gap, in usual ones: a single lost sample makes one of 2.
_MAX_INTERVAL_RATIO: Final = 1.8


class ClockFields(Fields):
    """The clock of a log's rows, or of one channel."""

    what: ClassVar = "a field of a clock"
    expected: ClassVar = "a mapping such as {column: t, unit: ms}"
    column: str = optional("with the time of each row; by default that of the other channels")
    unit: Any = optional(
        f"{', '.join(_TIME_UNITS)}, or a number of seconds, such as those of a frame"
    )
    scale: Positive = optional("true seconds per second of this clock")
    offset: Finite = optional("what this clock shows too little [s]")


class SignalFields(Fields):
    """A channel's entry in a file."""

    what: ClassVar = "a field of a channel"
    expected: ClassVar = "a mapping such as {quantity: angle, of: front_left_hip, unit: deg}"
    example: ClassVar = expected
    quantity: Annotated[str, Choice(tuple(QUANTITIES), {"acceleration": "accelerometer"})] = Field(
        description="what it is"
    )
    unit: Any = Field(description="of the column's numbers: a name, or the SI units of a count")
    of: str = optional("name of the servo, joint, sensor, foot or body that it is of")
    column: str = optional("name of its column; by default the channel's name")
    columns: list[str] = optional("names of the columns of its axes: x, y and z")
    sign: float = optional("-1 where the column counts against the robot's model", enum=[1, -1])
    zero: Finite = optional("number in the column where the model has 0")
    time: ClockFields = optional("its own clock")

    @classmethod
    def written_out(cls, value: Any) -> Any:
        """With a force, which former versions called a contact, as one."""
        if (
            isinstance(value, dict)
            and value.get("quantity") == "contact"
            and value.get("unit") in [*_FORCE_UNITS]
        ):
            return value | {"quantity": "force"}
        return value


class LogFields(Fields):
    """A file for `nermo-mjx log --channels`: the columns of a robot's log."""

    what: ClassVar = "a field of the channels of a log"
    example: ClassVar = (
        "time: {column: t, unit: s} and channels: {NAME: {quantity: angle, of: JOINT, unit: deg}}"
    )
    time: ClockFields = Field(description="the clock of the rows")
    channels: dict[str, SignalFields] = Field(
        description="by name, which is that of a column or of several"
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """One signal of a log.

    Attributes:
        name: of its column, or of its columns together.
        quantity: one of `QUANTITIES`.
        of: the servo, joint, sensor, foot or body that it is of.
        times: of its samples from the log's start, ascending [s].
        values: (n,), or (n, axes) of several columns, without NaN; a yaw without jumps of a whole turn.
        unit: of the values, in SI: rad, rad/s, m/s^2, m, A, N, N m; "switch" for 0 and 1.
    """

    name: str
    quantity: str
    of: str
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n ..."]
    unit: str = ""

    @property
    def interval(self) -> float:
        """Usual time between samples [s]."""
        return float(np.median(np.diff(self.times)))

    @property
    def gaps(self) -> Float[np.ndarray, "k 2"]:
        """Begin and end of the times without samples [s]."""
        long = np.flatnonzero(np.diff(self.times) > _MAX_INTERVAL_RATIO * self.interval)
        return np.stack([self.times[long], self.times[long + 1]], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """The channels of a robot's log.

    Attributes:
        channels: in the order of their file.
        file: that was read.
        findings: what was brought in order, or is missing, in sentences.
    """

    channels: tuple[Channel, ...]
    file: str
    findings: tuple[str, ...] = ()

    @property
    def duration(self) -> float:
        """From the first to the last sample of any channel [s]."""
        return max(float(channel.times[-1]) for channel in self.channels)

    def of_quantity(self, quantity: str) -> dict[str, Channel]:
        """The channels of a quantity, by what they are of."""
        return {channel.of: channel for channel in self.channels if channel.quantity == quantity}

    def commands(self) -> dict[str, Channel]:
        """The commands by which a model can be driven, by servo.

        Raises:
            ParameterError: no channel is a command.
        """
        if not (commands := self.of_quantity("command")):
            raise ParameterError(
                f"{self.file}: no channel is a command, by which the model could be driven."
            )
        return commands

    def channel(self, quantity: str, of: str | None = None) -> Channel | None:
        """The channel of a quantity and of a name, or the first one of any name; None if there is none."""
        candidates = self.of_quantity(quantity)
        return next(iter(candidates.values()), None) if of is None else candidates.get(of)


def table_of_log(file: str | os.PathLike[str]) -> Any:
    """The `pandas.DataFrame` of a CSV or Parquet file as it stands; its index has the line, or the row, of each.

    Raises:
        SpecError: it is absent, damaged, too large or empty, or a row has too many cells or too few.
    """
    path = Path(file)
    try:
        read = {".csv": _csv, ".parquet": _parquet}[path.suffix.lower()]
        table = read(path)
    except KeyError:
        raise SpecError(f"{path}: allowed is a log as FILE.csv or FILE.parquet.") from None
    except FileNotFoundError:
        raise SpecError(f"{path}: there is no such file.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read ({error.strerror or error}).") from None
    if table.empty:
        raise SpecError(f"{path}: it is empty: expected the names of columns, and rows of numbers.")
    for name in table.columns[table.columns.duplicated()]:
        raise SpecError(f"{path}: column {name!r} is there twice.")
    return table


def _csv(path: Path) -> Any:
    import pandas as pd  # imported where it is used: it takes half a second

    try:
        text = read_bytes(path, MAX_ARRAY_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SpecError(
            f"{path}: not a text file in UTF-8 ({error.reason} at byte {error.start})."
        ) from None
    # A line is one row: no cell of numbers goes over several.
    lines = [
        (i, line)
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    if len(lines) < 2:
        return pd.DataFrame()
    mark = max(",;\t", key=lines[0][1].count)
    names = [name.strip() for name in next(csv.reader([lines[0][1]], delimiter=mark))]
    for number, line in lines[1:]:
        if '"' not in line and (cells := line.count(mark) + 1) != len(names):
            raise SpecError(
                f"{path}:{number}: it has {cells} cells, but there are {len(names)} columns."
            )
    rows = io.StringIO("\n".join(line for _, line in lines[1:]))
    how = {
        "sep": mark,
        "decimal": "," if mark == ";" else ".",
        "skipinitialspace": True,
        "low_memory": False,
    }
    try:
        frame = pd.read_csv(rows, header=None, index_col=False, names=range(len(names)), **how)
        if len(frame) != len(lines) - 1:
            raise ValueError("a quoted cell goes over several lines")
        return frame.set_axis(names, axis=1).set_axis([number for number, _ in lines[1:]], axis=0)
    except ValueError as error:  # pandas' ParserError is one
        raise SpecError(f"{path}: not valid CSV: {str(error).strip().rstrip('.')}.") from None


def _parquet(path: Path) -> Any:
    import pyarrow as pa

    from nermo_mjx.runs.files import parquet_file

    try:
        with parquet_file(path, ours=False) as file:
            return file.read().to_pandas(ignore_metadata=True)
    except (pa.ArrowException, ValueError) as error:
        raise SpecError(
            f"{path}: not a Parquet file, or a damaged one ({str(error).splitlines()[0]})."
        ) from None


def read_log(
    file: str | os.PathLike[str], channels: str | os.PathLike[str] | Mapping[str, Any]
) -> Log:
    """Read a robot's log.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "log.csv")
    >>> _ = path.write_text("t,spine\\n0,90\\n10,0\\n20,180\\n")
    >>> told = {"quantity": "angle", "of": "spine", "unit": "deg", "sign": -1, "zero": 90}
    >>> log = read_log(path, {"time": {"column": "t", "unit": "ms"}, "channels": {"spine": told}})
    >>> log.channels[0].times, log.channels[0].values.round(2)
    (array([0.  , 0.01, 0.02]), array([-0.  ,  1.57, -1.57]))

    Args:
        file: CSV (comma, semicolon or tab; lines that begin with # are comments) or Parquet.
        channels: file of the channels, or a dict of its fields; see this module.

    Raises:
        SpecError: a file is absent or wrong, a column is missing or holds no numbers, the time runs backward, or a
            sensor's column never changes; one sentence with file, line or row, field, value and what is allowed.
    """
    kind = "file of a log's channels"
    doc = (
        read_mapping(channels, kind) if isinstance(channels, Mapping) else read_file(channels, kind)
    )
    fields, table = read(doc, LogFields), table_of_log(file)
    if not fields.channels:
        doc.fail(("channels",), "names no channel: at least one is needed.")
    reader, channel_map = _Reader(doc, fields, str(file), table), dict[tuple[str, str], Channel]()
    for name, entry in fields.channels.items():
        quantity = entry.quantity
        key = (quantity, entry.of or CHANNEL_PARTS.get(quantity, ""))
        if not key[1]:
            doc.fail(
                ("channels", name), "has no 'of': expected the name of its servo, joint or foot."
            )
        if key in channel_map:
            doc.fail(
                ("channels", name, "of"),
                f"is {key[1]!r}: its {quantity} is channel {channel_map[key].name!r} already.",
            )
        times, values, unit = reader.samples(name, entry)
        channel_map[key] = Channel(name, *key, times, values, unit)
    for (quantity, source), channel in channel_map.items():
        command = channel_map.get(("command", source)) if quantity == "angle" else None
        moves = quantity in ("velocity", *CHANNEL_PARTS) or (
            command is not None and np.ptp(command.values) > MOTION_THRESHOLD
        )
        still = np.flatnonzero(np.ptp(channel.values, axis=0).reshape(-1) == 0.0) if moves else ()
        for i in still:
            entry = fields.channels[channel.name]
            column = reader.columns(channel.name, entry)[i]
            doc.fail(
                ("channels", channel.name),
                f"is of column {column!r}, which never changes in {file}: a measured {quantity} does; leave the "
                "channel out.",
            )
    start = min(channel.times[0] for channel in channel_map.values())
    shifted = tuple(
        dataclasses.replace(channel, times=channel.times - start)
        for channel in channel_map.values()
    )
    for channel in shifted:
        reader.note(channel.name, _gaps_of(channel))
    return Log(shifted, str(file), reader.findings)


def _gaps_of(channel: Channel) -> str:
    gaps = channel.gaps
    if not len(gaps):
        return ""
    lengths = gaps[:, 1] - gaps[:, 0]
    longest, lost = int(np.argmax(lengths)), int(np.sum(np.round(lengths / channel.interval) - 1))
    share = 100.0 * lost / (lost + len(channel.times))
    count = f"{len(gaps)} gaps, the longest" if len(gaps) > 1 else "a gap"
    return f"{count} of {lengths[longest]:.3g} s at {gaps[longest, 0]:.3f} s: {share:.2g} % of the samples are missing"


class _Reader:
    """The columns of a table as the fields of a file say.

    Attributes:
        notes: what was found, and the channels that it was found of.
    """

    def __init__(self, doc: Document, fields: LogFields, file: str, table: Any) -> None:
        self.doc, self.fields, self.file, self.table = doc, fields, file, table
        self.notes: dict[str, list[str]] = {}

    def where(self, row: int) -> str:
        """The place of a row, for messages."""
        mark = ":" if self.file.lower().endswith(".csv") else ": row "
        return f"{self.file}{mark}{self.table.index[row]}"

    def note(self, name: str, what: str) -> None:
        """Remember what was found of a channel; "" for nothing."""
        if what:
            self.notes.setdefault(what, []).append(name)

    @property
    def findings(self) -> tuple[str, ...]:
        """One sentence for all channels with the same finding."""
        return tuple(f"{several(names)}: {what}." for what, names in self.notes.items())

    def column(self, name: str, *path: str | int) -> Float[np.ndarray, " n"]:
        """A column that the field at `path` names; NaN where a cell is empty."""
        import pandas as pd

        names = [str(label) for label in self.table.columns]
        if name not in names:
            allowed = f"{self.file} has {', '.join(names)}{did_you_mean(name, names)}"
            self.doc.fail(path, f"asks for the column {name!r}, but {allowed}")
        cells = self.table.iloc[:, names.index(name)]
        dated = cells.dtype.kind in "mM"
        matches = (
            np.full(len(cells), np.inf)
            if dated
            else pd.to_numeric(cells, errors="coerce").to_numpy(float)
        )
        wrong = np.isinf(matches) | (np.isnan(matches) & ~cells.isna().to_numpy())
        if wrong.any():
            row = int(np.argmax(wrong))
            text = describe(str(cells.iloc[row]))
            raise SpecError(
                f"{self.where(row)}: column {name!r} is {text}: expected a finite number, or nothing."
            )
        return matches

    def factor(self, unit: Any, units: Mapping[str, float], *path: str) -> float:
        """SI units per number of a column."""
        if (
            isinstance(unit, int | float)
            and not isinstance(unit, bool)
            and unit > 0
            and np.isfinite(unit)
        ):
            return float(unit)
        if not isinstance(unit, str) or unit not in units:
            allowed = f"{', '.join(units)}, or how many {next(iter(units))} a count is"
            suggestion = did_you_mean(unit, units) if isinstance(unit, str) else "."
            self.doc.fail((*path, "unit"), f"is {describe(unit)}: allowed is {allowed}{suggestion}")
        return units[unit]

    def clock(self, name: str, entry: SignalFields) -> Float[np.ndarray, " n"]:
        """Times of the rows for a channel [s]; NaN where there is none."""
        path: tuple[str, ...] = ("time",)
        time_fields = self.fields.time.model_dump(exclude_unset=True)
        if entry.time is not None:
            time_fields, path = (
                time_fields | entry.time.model_dump(exclude_unset=True),
                ("channels", name, "time"),
            )
        for field in ("column", "unit"):
            if field not in time_fields:
                self.doc.fail(path, f"has no '{field}': expected {ClockFields.expected}.")
        stamps = self.column(time_fields["column"], *path, "column") * self.factor(
            time_fields["unit"], _TIME_UNITS, *path
        )
        first = stamps[np.argmax(np.isfinite(stamps))]
        return (
            first
            + time_fields.get("offset", 0.0)
            + time_fields.get("scale", 1.0) * (stamps - first)
        )

    def columns(self, name: str, entry: SignalFields) -> list[str]:
        """The names of a channel's columns."""
        axes = AXIS_COUNTS.get(entry.quantity, (1,))
        names = [entry.column or name] if entry.columns is None else entry.columns
        if len(names) not in axes or (entry.column is not None and entry.columns is not None):
            allowed = " or ".join(map(str, axes))
            self.doc.fail(
                ("channels", name),
                f"has {len(names)} columns: allowed for its quantity is {allowed}.",
            )
        if len({*names}) < len(names):
            self.doc.fail(
                ("channels", name, "columns"), "names a column twice: expected one for each axis."
            )
        return names

    def samples(self, name: str, entry: SignalFields) -> tuple[np.ndarray, np.ndarray, str]:
        """Times and values of a channel, in order, and their unit."""
        path, units = ("channels", name), QUANTITIES[entry.quantity]
        factor = self.factor(entry.unit, units, *path)
        # Those that are 1 begin a kind of units; a count is of the first kind.
        upto = (
            list(units)[: list(units).index(entry.unit) + 1]
            if isinstance(entry.unit, str)
            else [*units][:1]
        )
        unit = [axis_name for axis_name in upto if units[axis_name] == 1.0][-1]
        if (sign := 1.0 if entry.sign is None else entry.sign) not in (1, -1):
            self.doc.fail((*path, "sign"), f"is {entry.sign:g}: allowed is 1 or -1.")
        names, time = self.columns(name, entry), self.clock(name, entry)
        raw_columns = np.stack([self.column(axis_name, *path) for axis_name in names], axis=-1)
        rows = np.flatnonzero(np.isfinite(raw_columns).all(axis=-1) & np.isfinite(time))
        if len(rows) < 2:
            self.doc.fail(path, f"has {len(rows)} samples in {self.file}: expected two at least.")
        times, values = time[rows], sign * factor * (raw_columns[rows] - (entry.zero or 0.0))
        self._refuse_backward(rows, times)
        is_late = times < np.maximum.accumulate(times)
        if is_late.any():
            longest_step_back = float(np.max(np.maximum.accumulate(times) - times))
            self.note(
                name,
                f"{is_late.sum()} samples came late, by up to {longest_step_back:.3g} s, and were brought in order",
            )
        order = np.argsort(times, kind="stable")
        times, values = times[order], values[order]
        last = np.append(np.diff(times) > 0.0, True)
        if not last.all():
            self.note(name, f"{(~last).sum()} stamps are doubled; the last sample of each counts")
        times, values = times[last], values[last]
        if len(times) < 2:
            raise SpecError(
                f"{self.file}: the time of channel {name!r} is {times[0]:g} s in all rows."
            )
        values = values if entry.columns else values[:, 0]
        return times, np.unwrap(values) if entry.quantity == "yaw" else values, unit

    def _refuse_backward(self, rows: np.ndarray, times: np.ndarray) -> None:
        """Late samples are few in a row; a clock that was set back stays behind."""
        behind = times < np.maximum.accumulate(times)
        begins = np.flatnonzero(behind & ~np.append(False, behind[:-1]))
        ends = np.append(np.flatnonzero(~behind), len(times))
        for begin in begins:
            length = int(ends[np.searchsorted(ends, begin)] - begin)
            if length > _MAX_LATE_ROWS:
                raise SpecError(
                    f"{self.where(int(rows[begin]))}: the time runs backward, from {times[begin - 1]:.6g} to "
                    f"{times[begin]:.6g} s, for {length} rows: split the file there, or mend its clock."
                )


def several(names: Sequence[str]) -> str:
    """Names in a sentence, at most three of them."""
    remaining = len(names) - 3
    return ", ".join(names[:3]) + (
        f" and {remaining} other{'s' if remaining > 1 else ''}" if remaining > 0 else ""
    )
