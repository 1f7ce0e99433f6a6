"""The sections of a sweep file, one reader each: setup and pilot, run, sampler, fixed, varied and drawn parameters."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Any

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.sweep.axes import Axis, Draw, check_value, read_axis, read_draw, read_number
from nermo_mjx.sweep.reading import Document, FieldPath, describe, nearest

SETUP_FIELDS = (
    "robot", "scene", "tail", "routing", "cone", "physics", "timestep", "gait", "spine", "steering", "profile",
    "trajectory",
)  # fmt: skip
SAMPLERS = ("grid", "sobol", "latin_hypercube")
#: Where `randomize.from` draws whole bodies.
BODIES = ("identified",)
#: Options of the pilots, and the parameter each one sets (None: the distance ends the run, way points are the path).
PILOT_OPTIONS: dict[str, dict[str, str | None]] = {
    "straight": {"distance": None},
    "arc": {"radius": "pilot.radius", "direction": "pilot.direction"},
    "waypoints": {"points": None},
    "open_loop": {"turn_rate": "pilot.turn_rate"},
}


def read_setup(doc: Document) -> tuple[Setup, dict[str, Any]]:
    """The static choices, each one tried on its own so that a message names its line; and the pilot's options."""
    choices: dict[str, Any] = {}
    for field in (*SETUP_FIELDS, "pilot"):
        if field not in doc.data:
            continue
        value = doc.data[field]
        path: FieldPath = (field,)
        if field == "pilot" and isinstance(value, dict) and len(value) == 1:
            value, path = next(iter(value)), (field, next(iter(value)))
        if field == "timestep":
            value = read_number(doc, path, value)
        elif not isinstance(value, str):
            expected = "a name or {name: {option: value}}" if field == "pilot" else "a name"
            doc.fail(path, f"is {describe(value)}: expected {expected}.", field)
        if (field, value) == ("pilot", "external"):
            doc.fail(path, "is 'external', which takes its command from Python: use rollout.Simulator.", field)
        choices[field] = value
        tried = {field: value}
        if (field, value) == ("pilot", "waypoints"):
            path = (field, value, "points")
            choices["waypoints"] = tried["waypoints"] = _read_points(doc, path)
        _try_setup(doc, path, field, **tried)
    setup = _try_setup(doc, (), "", **choices)
    return setup, _read_pilot_options(doc, setup.pilot)


def _try_setup(doc: Document, path: FieldPath, field: str, **choices: Any) -> Setup:
    try:
        return Setup(**choices)
    except ParameterError as error:
        message = str(error).removeprefix(f"{field} ").rstrip(".")
        allowed = re.findall(r"'([^']+)'", message.partition("allowed")[2])
        hint = "." if "did you mean" in message else nearest(str(choices.get(field)), allowed)
        doc.fail(path, message + hint, field)


def _read_points(doc: Document, path: FieldPath) -> tuple[tuple[float, float], ...]:
    """The way points of a pilot: rows of (x, y)."""
    options = doc.data["pilot"]["waypoints"] if isinstance(doc.data["pilot"], dict) else None
    rows = options.get("points") if isinstance(options, dict) else None
    expected = "expected points: [[x, y], ...] in metres."
    if not isinstance(rows, list):
        doc.fail(path[:1], f"is 'waypoints' without points: {expected}")
    for row in rows:
        if not isinstance(row, list) or len(row) != 2:
            doc.fail(path, f"has {describe(row)}: {expected}")
    return tuple((read_number(doc, path, x), read_number(doc, path, y)) for x, y in rows)


def _read_pilot_options(doc: Document, pilot: str) -> dict[str, Any]:
    given = doc.data.get("pilot")
    options = given[pilot] if isinstance(given, dict) else None
    if options is None:
        return {}
    path, allowed = ("pilot", pilot), PILOT_OPTIONS.get(pilot, {})
    if not isinstance(options, dict):
        doc.fail(path, f"is {describe(options)}: expected a mapping of {', '.join(allowed) or 'nothing'}.")
    for key in options:
        if key not in allowed:
            known = f"allowed are {', '.join(allowed)}" if allowed else "it has none"
            doc.fail((*path, key), f"is not an option of the pilot '{pilot}'; {known}{nearest(key, allowed)}")
    sides = {"left": 1.0, "right": -1.0}
    values: dict[str, Any] = {}
    for key, value in options.items():
        if key == "points":
            values[key] = [[float(x), float(y)] for x, y in value]
        else:
            side = key == "direction" and value in sides
            values[key] = sides[value] if side else read_number(doc, (*path, key), value)
    return values


def read_run(doc: Document, pilot: Mapping[str, Any]) -> Run:
    """Length and warm-up of each run; the pilot's distance is one of its ends."""
    names = ("cycles", "warmup_cycles", "duration", "warmup")
    given = _mapping(doc, "run")
    for key in given:
        if key not in names:
            doc.fail(("run", key), f"is not a field of a run; allowed are {', '.join(names)}{nearest(key, names)}")
    values = {key: read_number(doc, ("run", key), value) for key, value in given.items()}
    if "distance" in pilot:
        values["distance"] = pilot["distance"]
    try:
        run = Run(**values)
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        key = subject.removeprefix("run.")
        path = ("run", key) if key in given else ("run",) if key != "distance" else ("pilot", "straight", key)
        doc.fail(path, message, ".".join(("run", key)) if key != "distance" else None)
    # Defaults are written out: what a run of frequency 1 Hz counts in seconds is its cycles.
    warmup, length = (float(each) for each in run.seconds(1.0))
    fields = ("duration", "warmup") if run.duration is not None else ("cycles", "warmup_cycles")
    return dataclasses.replace(run, **dict(zip(fields, (length, warmup), strict=True)))


def read_sampler(doc: Document) -> tuple[str, int]:
    """The sampler, and its number of variants (0 for a grid)."""
    value = doc.data.get("sample", "grid")
    if value == "grid":
        return "grid", 0
    expected = "expected grid, {sobol: N} or {latin_hypercube: N}"
    if not isinstance(value, dict) or len(value) != 1:
        doc.fail(("sample",), f"is {describe(value)}: {expected}.")
    name = next(iter(value))
    if name not in SAMPLERS[1:]:
        doc.fail(("sample", name), f"is not a sampler: {expected}{nearest(name, SAMPLERS[1:])}")
    return name, read_whole(doc, ("sample", name), 1, 10_000_000)


def read_fixed(doc: Document, parameters: Mapping[str, Quantity]) -> dict[str, float]:
    """The parameters under `set`."""
    values = {}
    for name, value in named(doc, "set", parameters):
        values[name] = read_number(doc, ("set", name), value, name)
        check_value(doc, ("set", name), name, parameters[name], values[name])
    return values


def read_axes(doc: Document, parameters: Mapping[str, Quantity], *, grid: bool) -> tuple[Axis, ...]:
    """The parameters under `vary`, in the order of the file."""
    return tuple(
        read_axis(doc, name, value, parameters[name], grid=grid) for name, value in named(doc, "vary", parameters)
    )


def read_draws(doc: Document, parameters: Mapping[str, Quantity]) -> tuple[int, str | None, tuple[Draw, ...]]:
    """The number of repeats, where bodies are drawn from, and the parameters under `randomize`."""
    given = _mapping(doc, "randomize")
    repeats = read_whole(doc, ("randomize", "repeats"), 1, 100_000) if "repeats" in given else 1
    bodies = given.get("from")
    if "from" in given and bodies not in BODIES:
        doc.fail(("randomize", "from"), f"is {describe(bodies)}: allowed is {', '.join(BODIES)}"
                                        f"{nearest(str(bodies), BODIES)}")  # fmt: skip
    given_draws = named(doc, "randomize", parameters, besides=("repeats", "from"))
    return repeats, bodies, tuple(read_draw(doc, name, value, parameters[name]) for name, value in given_draws)


def read_whole(doc: Document, path: FieldPath, low: int, high: int) -> int:
    """A whole number within bounds."""
    value: Any = doc.data
    for key in path:
        value = value[key]
    number = read_number(doc, path, value)
    if not low <= number <= high or number != int(number):
        doc.fail(path, f"is {number:g}: expected a whole number from {low} to {high:,}.")
    return int(number)


def named(
    doc: Document, section: str, parameters: Mapping[str, Quantity], besides: tuple[str, ...] = ()
) -> Iterator[tuple[str, Any]]:
    """The entries of a section whose keys are parameter names."""
    for name, value in _mapping(doc, section).items():
        if name in besides:
            continue
        if name not in parameters:
            allowed = _allowed(name, parameters) + nearest(name, parameters)
            doc.fail((section, name), f"is not a parameter; {allowed}", name)
        yield name, value


def _allowed(name: str, parameters: Mapping[str, Quantity]) -> str:
    """The allowed names near an unknown one: those of its group, or of the top level and the groups."""
    group = name.rpartition(".")[0]
    mates = [other for other in parameters if group and other.startswith(f"{group}.")]
    if not mates:
        mates = [other for other in parameters if "." not in other]
        mates += dict.fromkeys(f"{other.partition('.')[0]}.*" for other in parameters if "." in other)
    return f"allowed are {', '.join(mates)} (nermo-mjx sweep --list-parameters prints all)"


def _mapping(doc: Document, section: str) -> dict[str, Any]:
    value = doc.data.get(section, {})
    if not isinstance(value, dict):
        doc.fail((section,), f"is {describe(value)}: expected a mapping.")
    return value
