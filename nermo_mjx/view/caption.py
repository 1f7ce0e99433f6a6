"""The text of a page about a run: its title, its figures, and a table of all settings."""

from __future__ import annotations

import math
from typing import Any, Final

from nermo_mjx.recording import Recording

_GAITS: Final = {"trt": "Trot", "trt1": "Walking trot", "lat": "Lateral sequence walk"}
_DEGREES: Final = math.degrees(1.0)
_SHOWN: Final = {"rad": ("°", _DEGREES), "rad/s": ("°/s", _DEGREES), "m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
#: Metrics in the page's head, and their labels.
_HEADLINE: Final = {
    "speed": "speed", "roll_std": "roll σ", "pitch_std": "pitch σ", "slip": "slip",
    "cost_of_transport": "cost of transport",
}  # fmt: skip


def title_of(recording: Recording) -> str:
    """The gait, its frequency and the spine mode, as far as known; or the name of an experiment's case."""
    if "case" in recording.metadata:
        return str(recording.metadata["case"])
    setup, parameters = _part(recording, "setup"), _part(recording, "parameters")
    gait, controller = setup.get("gait"), str(setup.get("controller") or "Recording").rpartition(":")[2]
    controller = controller.rpartition("/")[2]  # of a policy's file, its name
    parts = [_GAITS.get(str(gait), str(gait)) if gait else controller]
    if (frequency := _number(parameters.get("frequency"))) is not None:
        parts.append(f"{frequency:.3g} Hz")
    spine = str(setup.get("spine", "none")).replace("_", " ")
    if spine != "none":
        parts.append(f"spine {spine}")
    rate = _number(parameters.get("pilot.turn_rate"))
    if setup.get("pilot") == "open_loop" and rate:
        parts.append(f"turn rate {rate:g}")
    return ", ".join(parts)


def headline_of(recording: Recording) -> list[list[str]]:
    """A few metrics as (label, value with unit), and the status if something went wrong."""
    metrics = _part(recording, "metrics")
    units = _units(recording)
    known = [(name, label) for name, label in _HEADLINE.items() if name in metrics]
    rows = [[label, _shown(metrics[name], units[name], digits=3)] for name, label in known]
    status = metrics.get("status", "ok")
    return [row for row in rows if row[1] != "–"] + ([["status", str(status)]] if status != "ok" else [])


def details_of(recording: Recording) -> list[dict[str, Any]]:
    """Tables `{"title", "rows": [[name, value with unit], ...]}` of all metadata of the recording."""
    tables = []
    for key, title in (("labels", "Case"), ("metrics", "Metrics"), ("parameters", "Parameters"), ("setup", "Setup"),
                       ("run", "Run"), ("versions", "Versions")):  # fmt: skip
        units = _units(recording) if key in ("metrics", "parameters") else {}
        rows = [[name, _shown(value, units.get(name, ""))] for name, value in _part(recording, key).items()]
        rows = [row for row in rows if row[1] not in ("–", "")]
        if rows:
            tables.append({"title": title, "rows": rows})
    return tables


def _part(recording: Recording, key: str) -> dict[str, Any]:
    value = recording.metadata.get(key)
    return dict(value) if isinstance(value, dict) else {}


def _units(recording: Recording) -> dict[str, str]:
    """Units of metrics and parameters by name, including the recording's custom metrics."""
    from nermo_mjx.robot.quantity import quantities
    from nermo_mjx.rollout import METRICS  # starts JAX
    from nermo_mjx.rollout.parameters import WorldParameters

    units = {name: about.unit for name, about in quantities(WorldParameters)}
    return units | {name: metric.unit for name, metric in METRICS.items()} | _part(recording, "units")


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _shown(value: Any, unit: str, digits: int = 4) -> str:
    """A value as people read it: degrees and millimetres."""
    number = _number(value)
    if number is None:
        return "–" if value is None else ("no", "yes")[value] if isinstance(value, bool) else str(value)
    if not math.isfinite(number):
        return "–"
    name, factor = _SHOWN.get(unit, ("" if unit == "1" else unit, 1.0))
    shown = f"{number * factor:{'#' if digits == 3 else ''}.{digits}g}".rstrip(".")
    return f"{shown}{'' if name == '°' else ' '}{name}".rstrip()
