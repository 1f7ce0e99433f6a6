"""The commands that run a row again, as the page puts them together from a row's values."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from nermo_mjx.robot.presets import PRESETS
from nermo_mjx.rollout import Setup
from nermo_mjx.specs.reading import SpecError, read_file
from nermo_mjx.view.explore.runs import Runs

#: Choices that are options of `nermo-mjx walk`, with the values that it takes.
_OPTIONS: Final = ("robot", "scene", "tail", "physics", "gait", "spine", "steering", "profile")
#: Choices that are none: only their defaults can be walked.
_NO_OPTIONS: Final = {"routing": Setup.routing, "cone": Setup.cone, "trajectory": Setup.trajectory}
#: Pilots that `walk` takes, and the parameters that their options are.
_PILOTS: Final = {"straight": (), "arc": ("radius", "direction"), "open_loop": ("turn_rate",)}
_SIDES: Final = {"left": 1.0, "right": -1.0}


def commands_of(path: Path, runs: Runs) -> dict[str, Any]:
    """Commands of a directory's rows.

    Returns:
        `replay`: words to which the row's number is added, of a sweep; `walk`: `words`, `options`, pairs of an option
        and the column of its value, and `set`, columns that `--set NAME=X` takes, where `walk` can do what the rows
        did. Either is None where there is no such command.
    """
    replay = f"nermo-mjx replay {shlex.quote(str(path))} --row" if runs.kind == "sweep" else None
    spec = path / ("sweep.yaml" if runs.kind == "sweep" else "search.yaml")
    try:
        walk = _walk(read_file(spec, runs.kind).data, runs) if spec.exists() else None
    except SpecError:  # of another version; what can be read is shown
        walk = None
    return {"replay": replay, "walk": walk}


def _walk(spec: Mapping[str, Any], runs: Runs) -> dict[str, Any] | None:
    """How `nermo-mjx walk` does the same as a row of a resolved file."""
    texts = {each.name: each for each in runs.columns.values() if each.is_text and each.role == "varied"}
    numbers = [
        each.name for each in runs.columns.values() if not each.is_text and each.role in ("varied", "randomized")
    ]
    words, options = ["nermo-mjx", "walk"], []
    if spec.get("controller") is not None or any(
        name in texts or spec.get(name, default) != default for name, default in _NO_OPTIONS.items()
    ):
        return None
    if not _has_presets_step(spec, "physics" in texts):
        return None
    for name in (*_OPTIONS, "pilot"):
        if name in texts:
            if name == "pilot" and not set(texts[name].values) <= set(_PILOTS):
                return None
            options.append([f"--{name}", name])
    fixed = dict(spec.get("set") or {})
    for name in _OPTIONS:
        value = str(spec.get(name, getattr(Setup, name)))
        if "<" in value:  # a scene of one's own, written out
            return None
        if name not in texts and value != str(getattr(Setup, name)):
            words += [f"--{name}", value]
    if "pilot" not in texts:
        given = spec.get("pilot", Setup.pilot)
        pilot, chosen = next(iter(given.items())) if isinstance(given, dict) else (given, None)
        if pilot not in _PILOTS or not set(chosen or {}) <= set(_PILOTS[pilot]):
            return None
        words += ["--pilot", pilot] if pilot != Setup.pilot else []
        fixed |= {f"pilot.{key}": _SIDES.get(value, value) for key, value in (chosen or {}).items()}
    run = spec.get("run") or {}
    length, warmup = ("duration", "warmup") if "duration" in run else ("cycles", "warmup_cycles")
    for option, name in ((f"--{length}", length), ("--warmup", warmup)):
        words += [option, f"{run[name]:.17g}"] if name in run else []
    for name, value in fixed.items():
        words += ["--set", f"{name}={value!r}"]
    return {"words": shlex.join(words), "options": options, "set": numbers}


def _has_presets_step(spec: Mapping[str, Any], any_preset: bool) -> bool:
    """Whether the time step is the one that goes with the preset, as `walk` takes it."""
    step, preset = spec.get("timestep"), PRESETS.get(str(spec.get("physics", Setup.physics)))
    return step is None or any_preset or (preset is not None and float(step) == preset.timestep)
