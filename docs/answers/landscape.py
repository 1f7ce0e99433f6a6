"""How well the exact gradients of a tuning agree with secants: the table of docs/gradients.md.

python docs/answers/landscape.py sweeps/tune_speed.yaml   # the table of any tuning file
python docs/answers/landscape.py docs                     # JSON: tune_speed.yaml, also with stiff soles and tendons

The script evaluates the objective and its exact slope along each tuned parameter, through the given starting point, at
41 points, and nine secants of each width about points of this line. Slopes that equal narrow secants are correct;
slopes that equal wide secants are useful to an optimizer.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from gradients import HARD

from nermo_mjx.optimize import Tuning
from nermo_mjx.optimize.objective import FURTHEST
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.optimize.tuning_spec import Gradient
from nermo_mjx.plotting.shown import shown

SPEC = Path(__file__).parents[2] / "sweeps" / "tune_speed.yaml"
#: Points of a line, the points about which secants are taken, and widths of the secants as fractions of the bounds.
POINTS, CENTRES, WIDTHS = 41, [3, 7, 11, 16, 20, 24, 29, 33, 37], (0.001, 0.005, 0.02, 0.05, 0.1)
#: Walks that are evaluated together.
BATCH = 64


def errors_of(tuning: Tuning) -> dict[str, np.ndarray]:
    """For each tuned parameter |slope - secant| / |secant| (secants, widths), NaN where the robot falls."""
    tuning, found = dataclasses.replace(tuning, method=Gradient()).without_path(), {}
    problem, given = WalkProblem(tuning), np.array([each.start for each in tuning.tuned], float)
    for i, each in enumerate(tuning.tuned):
        bounds = each.high - each.low
        line = (
            np.linspace(each.low + FURTHEST * bounds, each.high - FURTHEST * bounds, POINTS).round(
                14
            )
            + 0.0
        )
        ends = [
            line[centre] + side * 0.5 * width * bounds
            for centre, width, side in itertools.product(CENTRES, WIDTHS, (-1, 1))
        ]
        points = np.tile(given, (POINTS + len(ends), 1))
        points[:, i] = [*line, *ends]
        points = np.asarray(
            jnp.asarray(points, float), float
        )  # as they are evaluated: a secant divides by their distance
        batches = [points[first : first + BATCH] for first in range(0, len(points), BATCH)]
        results = [problem.evaluate(jnp.asarray(batch, float), True) for batch in batches]
        value, slope = (
            np.concatenate([np.asarray(getattr(r, k)) for r in results])
            for k in ("value", "gradient")
        )
        value = np.where(np.concatenate([np.asarray(r.ok) for r in results]), value, np.nan)
        x, rise = (
            column[POINTS:].reshape(len(CENTRES), len(WIDTHS), 2)
            for column in (points[:, i], value)
        )
        secant = np.diff(rise)[..., 0] / np.diff(x)[..., 0]
        error = np.abs(slope[CENTRES, i, None] - secant) / np.abs(secant)
        error[~np.isfinite(value[CENTRES])] = np.nan
        found[each.name] = error
    return found


def median(error: np.ndarray) -> str:
    """The median error of secants [%], of those whose walks completed."""
    return f"{100 * np.nanmedian(error):.2g}"


def table(tuning: Tuning, found: dict[str, np.ndarray]) -> str:
    """Markdown: a row for each parameter and width."""
    lines = ["| parameter | width | of the bounds | median error |", "| --- | --: | --: | --: |"]
    for each, errors in zip(tuning.tuned, found.values(), strict=True):
        for width, error in zip(WIDTHS, errors.T, strict=True):
            of = shown(
                "", tuning.parameters[each.name].unit, np.asarray(width * (each.high - each.low))
            )
            name = each.name if width == WIDTHS[0] else ""
            lines.append(
                f"| {name} | {of.shown(float(of.values))} | {100 * width:g} % | {median(error)} % |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    if sys.argv[1] != "docs":
        tuning = Tuning.from_file(sys.argv[1])
        print(table(tuning, errors_of(tuning)))
    else:
        soft = Tuning.from_file(SPEC)
        stiff = Tuning.from_dict(soft.resolved() | {"set": soft.resolved()["set"] | HARD})
        both = {"soft": errors_of(soft), "stiff": errors_of(stiff)}
        texts = {"landscape.table": table(soft, both["soft"])}
        for name, found in both.items():
            for parameter, errors in found.items():
                texts[f"landscape.{name}_{parameter.split('.')[1]}"] = median(
                    errors[:, WIDTHS.index(0.02)]
                )
        print(json.dumps(texts, indent=1, ensure_ascii=False))
