"""The commands that repeat a row's run, which the page assembles from the row's values."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, Final

from nermo_mjx.robot.presets import PRESETS
from nermo_mjx.rollout import Setup
from nermo_mjx.specs.reading import SpecError, read_file
from nermo_mjx.view.explore.runs import Runs

#: Choices that are options of `nermo-mjx walk`, with the values that it takes.
_OPTIONS: Final = (
    "robot", "scene", "tail", "physics", "gait", "spine", "steering", "profile", "trajectory", "head", "tail_motion",
)  # fmt: skip
#: Choices without an option: `walk` supports only their defaults.
_NO_OPTIONS: Final = {"routing": Setup.routing, "cone": Setup.cone, "hinges": Setup.hinges}
#: Pilots that `walk` supports, and the parameters that their options set.
_PILOTS: Final = {"straight": (), "arc": ("radius", "direction"), "open_loop": ("turn_rate",)}
_SIDES: Final = {"left": 1.0, "right": -1.0}


def commands_of(path: Path, runs: Runs) -> dict[str, Any]:
    """Commands of a directory's rows.

    Returns:
        `replay`: words to which the row's number is added; `walk`: `words`, `options`, pairs of an option and the
        column of its value, and `set`, columns that `--set NAME=X` takes; None if `walk` cannot repeat the rows' runs.
    """
    spec = path / ("sweep.yaml" if runs.kind == "sweep" else "search.yaml")
    try:
        walk = _walk(read_file(spec, runs.kind).data, runs) if spec.exists() else None
    except SpecError:  # of another version; the readable part is shown
        walk = None
    return {"replay": f"nermo-mjx replay {shlex.quote(str(path))} --row", "walk": walk}


def _walk(spec: Mapping[str, Any], runs: Runs) -> dict[str, Any] | None:
    """The `nermo-mjx walk` command for a row of a resolved file; None if there is none."""
    varied = [each for each in runs.columns.values() if each.role in ("varied", "randomized")]
    names = {each.name: set(each.values) for each in varied if each.is_text}
    if not _walkable(spec, names):
        return None
    pilot, chosen = _pilot(spec)
    fixed = dict(spec.get("set") or {})
    words = ["nermo-mjx", "walk"]
    for name in _OPTIONS:
        value = str(spec.get(name, getattr(Setup, name)))
        words += [_option(name), value] if name not in names and value != str(getattr(Setup, name)) else []
    if "pilot" not in names:
        words += ["--pilot", pilot] if pilot != Setup.pilot else []
        fixed |= {f"pilot.{key}": _SIDES.get(value, value) for key, value in chosen.items()}
    run = spec.get("run") or {}
    length, warmup = ("duration", "warmup") if "duration" in run else ("cycles", "warmup_cycles")
    for option, name in ((f"--{length}", length), ("--warmup", warmup)):
        words += [option, f"{run[name]:.17g}"] if name in run else []
    for name, value in fixed.items():
        words += ["--set", f"{name}={value!r}"]
    return {
        "words": shlex.join(words),
        "options": [[_option(name), name] for name in (*_OPTIONS, "pilot") if name in names],
        "set": [each.name for each in varied if not each.is_text],
    }


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _walkable(spec: Mapping[str, Any], names: Mapping[str, Set[str]]) -> bool:
    """Whether `walk` has an option for every choice of a file, and for those that its rows vary (`names`)."""
    if spec.get("controller") is not None or not set(names) <= {*_OPTIONS, "pilot"}:
        return False
    if any(spec.get(name, default) != default for name, default in _NO_OPTIONS.items()):
        return False
    chosen = {name: names.get(name, {str(spec.get(name, getattr(Setup, name)))}) for name in ("scene",)}
    # A custom scene is stored as MJCF, which cannot be an option's value.
    if any("<" in value for value in chosen["scene"]):
        return False
    step, preset = spec.get("timestep"), PRESETS.get(str(spec.get("physics", Setup.physics)))
    if "physics" not in names and step is not None and (preset is None or float(step) != preset.timestep):
        return False
    pilot, options = _pilot(spec)
    return (
        names["pilot"] <= set(_PILOTS) if "pilot" in names else pilot in _PILOTS and set(options) <= set(_PILOTS[pilot])
    )


def _pilot(spec: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """The pilot of a file, and its options."""
    given = spec.get("pilot", Setup.pilot)
    if not isinstance(given, dict):
        return str(given), {}
    name, options = next(iter(given.items()))
    return str(name), options or {}
