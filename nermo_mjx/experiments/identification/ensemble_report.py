"""An ensemble in identification.json, in ensemble.csv, and as a section to read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from nermo_mjx.experiments.identification.ensemble import Bodies
from nermo_mjx.experiments.identification.space import ALL
from nermo_mjx.experiments.table import number
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.runs.text import MISSING, table

QUANTILES: Final = (0.05, 0.5, 0.95)
#: Smallest correlation that is listed.
_WORTH: Final = 0.3


def ensemble_content(bodies: Bodies) -> dict[str, Any]:
    """An ensemble for identification.json; parameters that share a value are represented by the first."""
    size = len(bodies.objective)
    shown = {free.names[0]: bodies.values[free.names[0]] for free in ALL.values()}
    content: dict[str, Any] = {
        "size": size,
        "tolerance": bodies.tolerance,
        "found": bodies.found,
        "effective_size": bodies.effective,
        "share_of_prior": bodies.share,
        "sweeps": [
            {"candidates": each.proposed, "level": each.level, "acceptance": each.acceptance} for each in bodies.sweeps
        ],
        "better_than_default": int(np.sum(bodies.objective < bodies.objective[0])) if size else 0,
        "parameters": {
            free.names[0]: {"low": free.low, "high": free.high, "why": free.why, "names": list(free.names)}
            for free in ALL.values()
        },
    }
    if size:
        for name, column in shown.items():
            content["parameters"][name]["quantiles"] = quantiles(column, bodies.weights)
        content["correlations"] = correlations(shown, bodies.weights)
        content["bodies"] = {name: column.tolist() for name, column in bodies.values.items()} | {
            "objective": bodies.objective.tolist(),
            "weight": bodies.weights.tolist(),
        }
    return content


def quantiles(values: np.ndarray, weights: np.ndarray) -> list[float]:
    """The 5, 50 and 95 % quantiles of values (n,) with weights (n,)."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order]) - 0.5 * weights[order]
    return np.interp(QUANTILES, below / weights.sum(), values[order]).tolist()


def correlations(columns: Mapping[str, np.ndarray], weights: np.ndarray) -> dict[str, dict[str, float]]:
    """Weighted correlations of the logarithms between all columns."""
    logs = np.array([np.log(column) for column in columns.values()])
    away = logs - (logs @ weights / weights.sum())[:, None]
    covariance = (away * weights) @ away.T
    scale = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        matrix = covariance / np.outer(scale, scale)
    return {name: dict(zip(columns, row.tolist(), strict=True)) for name, row in zip(columns, matrix, strict=True)}


def csv_text(content: Mapping[str, Any]) -> str:
    """ensemble.csv: its origin, then one body per row; the default body comes first if it is one of them."""
    ensemble = content["ensemble"]
    tried = sum(sweep["candidates"] for sweep in ensemble["sweeps"])
    units = {name: about.unit for name, about in quantities(ModelParameters)}
    options = " ".join(f"--{name} {value}" for name, value in content["settings"].items())
    columns = ensemble["bodies"]
    about = (
        f"Bodies whose objective on the straight line is at most {ensemble['tolerance']:g}; the first is the default.",
        f"{ensemble['found']} of {tried} candidates were; these stand for them. Made by: nermo-mjx identify {options}",
        f"Engine {content['engine']}, MuJoCo {content['versions']['mujoco']}.",
        "Units: " + ", ".join(f"{name} {units[name]}" for name in columns if units.get(name, "1") != "1"),
    )
    rows = zip(*columns.values(), strict=True)
    texts = {"objective": "{:.4f}", "weight": "{:.6f}"}
    forms = [texts.get(name, "{:.4g}") for name in columns]
    lines = [",".join(form.format(value) for form, value in zip(forms, row, strict=True)) for row in rows]
    return "\n".join([*(f"# {line}" for line in about), ",".join(columns), *lines]) + "\n"


def ensemble_section(content: Mapping[str, Any]) -> str:
    """The ensemble's part of identification.md."""
    ensemble = content["ensemble"]
    if ensemble is None:
        return ""
    tried = sum(sweep["candidates"] for sweep in ensemble["sweeps"])
    size, found, tolerance = ensemble["size"], ensemble["found"], ensemble["tolerance"]
    text = f"""\
## Ensemble

Bodies whose objective is at most {tolerance:g}. Free are the parameters above and, within their plausible ranges, the
friction of sole and tail; the prior is even in their logarithms. {found} of {tried} candidates are within it, which is
{ensemble["share_of_prior"]:.2%} of the prior.
"""
    if not size:
        return f"{text}\nThere is no body to draw.\n\n"
    better = ensemble["better_than_default"]
    nearer = f"{better or 'none'} of the others {'come' if better > 1 else 'comes'}"
    return f"""\
{text}
The ensemble has {size} bodies. The first is the default, the best at the default frictions; with frictions of its own,
{nearer} nearer to the published speeds. The others were taken from those found about as often as they weigh, and keep
the weight that is left. Those found know as much as {ensemble["effective_size"]:.0f} bodies drawn independently.

{table(["parameter", "5 %", "median", "95 %", "default", "bounds", "why these"], _rows(ensemble), "lrrrrll")}
Correlations of the logarithms beyond {_WORTH:g}: {_related(ensemble["correlations"])}.

{table(["sweep", "candidates", "begun from bodies within", "within the tolerance"], _sweeps(ensemble), "lrrr")}
`ensemble.csv` has all bodies.

"""


def _rows(ensemble: Mapping[str, Any]) -> list[list[str]]:
    units = {name: about.unit for name, about in quantities(ModelParameters)}
    rows = []
    for name, about in ensemble["parameters"].items():
        unit = "" if units.get(name, "1") == "1" else f" [{units[name]}]"
        bounds = f"{about['low']:g} to {about['high']:g}"
        default = number(ensemble["bodies"][name][0])
        rows.append([", ".join(about["names"]) + unit, *map(number, about["quantiles"]), default, bounds, about["why"]])
    return rows


def _sweeps(ensemble: Mapping[str, Any]) -> list[list[str]]:
    return [
        [str(i) if i else "even", str(sweep["candidates"]), f"{sweep['level']:.2f}" if i else MISSING,
         f"{sweep['acceptance']:.0%}"]
        for i, sweep in enumerate(ensemble["sweeps"])
    ]  # fmt: skip


def _related(correlations: Mapping[str, Mapping[str, float]]) -> str:
    names = list(correlations)
    pairs = [(correlations[a][b], a, b) for i, a in enumerate(names) for b in names[:i]]
    told = [f"{a} with {b} {value:+.2f}" for value, a, b in sorted(pairs, key=lambda pair: -abs(pair[0]))
            if abs(value) > _WORTH]  # fmt: skip
    return "; ".join(told) or "none"
