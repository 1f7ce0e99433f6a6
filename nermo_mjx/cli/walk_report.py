"""The terminal summary of one run: millimetres and degrees, where the metrics are in metres and radians."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli.output import print_table

if TYPE_CHECKING:
    from nermo_mjx.cli.walk_plan import Plan

ANGLES = ("roll", "pitch", "yaw")
#: Other lines of the table: metric, how it is called, its unit, and the factor from SI.
LINES = (
    ("distance", "distance", "mm", 1e3),
    ("duration", "measured time", "s", 1.0),
    ("lateral_drift", "lateral drift", "mm", 1e3),
    ("slip", "slip of loaded feet", "mm/s", 1e3),
    ("servo_work", "servo work", "J", 1.0),
    ("cost_of_transport", "cost of transport", "", 1.0),
)


def print_walk(report: dict[str, Any], plan: Plan, files: list[Path]) -> None:
    """Print a report of what `walk` had planned."""
    from nermo_mjx.rollout.metrics import Ending

    metrics, setup = report["metrics"], report["setup"]
    how = setup["controller"] or f"{setup['gait']} at {report['parameters']['frequency']:g} Hz, spine {setup['spine']}"
    what = f"{how}, {setup['tail']} tail, engine {report['engine']}"
    rows = [["speed", _shown(metrics.get("speed"), 1e3), "mm/s"]]
    if math.isfinite(theory := plan.theory):
        rows.append(["speed in theory", _shown(theory, 1e3), "mm/s"])
    for name, title, unit, factor in LINES:
        if name in metrics:
            rows.append([title, _shown(metrics[name], factor), unit])
    for own in plan.setup.own_metrics:
        rows.append([own.name, f"{metrics[own.name]:.4g}", own.unit])
    print_table(f"Nermo walked: {what}", [("", "left"), ("", "right"), ("", "left")], rows)
    degrees = math.degrees(1.0)
    parts = ("mean", "std", "min", "max")
    angles = [[angle, *(_shown(metrics.get(f"{angle}_{part}"), degrees) for part in parts)] for angle in ANGLES]
    print_table("Orientation [degrees]", [("", "left"), *((part, "right") for part in parts)], angles)
    ending = Ending[metrics["status"]]
    if ending is not Ending.ok:
        click.echo(ending.value)
    for file in files:
        click.echo(f"wrote {file}")


def _shown(value: float | None, factor: float) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    value *= factor
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
