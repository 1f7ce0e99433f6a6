"""Reports of a landscape: landscape.json for programs, report.md and the terminal's table for readers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.plotting.shown import shown
from nermo_mjx.runs.text import MISSING, listed, table
from nermo_mjx.tune.landscape.lines import Slice
from nermo_mjx.tune.spec import Tuning

#: If slopes and secants of `JUDGED` agree within this, exact gradients point in the right direction.
JUDGED: Final = (0.02, 0.05)
ERROR: Final = 0.25
SIGNS: Final = 0.9
HEADINGS: Final = (
    ("parameter", "left"), ("width", "right"), ("of the bounds", "right"), ("secants", "right"),
    ("median error", "right"), ("same sign", "right"), ("ripple", "right"),
)  # fmt: skip


def content_of(tuning: Tuning, points: pa.Table, lines: Sequence[Slice]) -> dict[str, Any]:
    """Content of landscape.json, in SI units and radians.

    `parameters`: by name `bounds`, `start`, the line `from` and `to`, the lowest and highest objective on it and where
    it is lowest, how many of its points `fell`, the line's `ripple` (residual of parabolas through seven neighbouring
    points), `widths`: for each width of secants its `share` of the bounds, the number of `secants`,
    `median_relative_error` of the slope, `sign_agreement`, `ripple`; and `follows`: whether slope and secants of 2 and
    5 % agree.
    """
    notes = {key.decode(): value.decode() for key, value in (points.schema.metadata or {}).items()}
    return {
        "objective": [term.written() for term in tuning.objective.terms],
        "parameters": {line.tuned.name: _about(tuning, line) for line in lines},
        "evaluations": points.num_rows,
        "batch": int(notes["batch"]),
        "precision": notes["precision"],
        "wall_seconds": float(notes["wall_seconds"]),
        "plots": [],
        **json.loads(notes["session"]),
    }


def rows_of(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `HEADINGS`."""
    rows = []
    for name, about in content["parameters"].items():
        for i, width in enumerate(about["widths"]):
            quantity = shown("", about["unit"], np.asarray(width["width"]))
            rows.append(
                [
                    name if i == 0 else "", quantity.shown(float(quantity.values)), f"{100 * width['share']:g} %",
                    str(width["secants"]), _percent(width["median_relative_error"]), _percent(width["sign_agreement"]),
                    _number(width["ripple"]),
                ]
            )  # fmt: skip
    return rows


def sentences(content: Mapping[str, Any]) -> list[str]:
    """The conclusion, one sentence per parameter."""
    return [_sentence(name, about) for name, about in content["parameters"].items()]


def page(content: Mapping[str, Any]) -> str:
    """The text of report.md."""
    return "\n".join(_page(content)).rstrip() + "\n"


def _page(content: Mapping[str, Any]) -> Iterator[str]:
    yield "# Can the gradients be trusted?\n"
    yield "\n".join(f"- {sentence}" for sentence in sentences(content)) + "\n"
    yield (
        "A slope is the exact derivative of the objective at a point, a secant the difference quotient over a width "
        "about it. Narrow secants show whether the derivative is correct; wide ones, as wide as a tuner's steps, "
        "whether it is useful. If they differ only for wide secants, the landscape is rough: tune with the "
        "estimator `smoothed`, `evolution` or `mixture`. If they differ only for narrow ones, the ripple from "
        "rounding and contacts is larger than the difference between the two ends.\n"
    )
    sides = "".join(side[0] for _, side in HEADINGS)
    yield table([heading for heading, _ in HEADINGS], rows_of(content), sides)
    yield (
        "Median error: |slope - secant| / |secant|. Same sign: share of the places where the signs agree. Ripple: "
        "standard deviation of the objective about a parabola through all points within the width.\n"
    )
    for name, about in content["parameters"].items():
        yield f"## {name}\n"
        ends = shown("", about["unit"], np.array([about["from"], about["to"], about["start"], about["lowest_at"]]))
        first, last, start, best = (ends.shown(value) for value in ends.values.tolist())
        yield (
            f"From {first} to {last}, start at {start}. The objective goes from {_number(about['lowest'])} (at {best}) "
            f"to {_number(about['highest'])}; the ripple of neighbouring points is {_number(about['ripple'])}"
            + (f"; at {about['fell']} of {about['points']} points the robot fell" if about["fell"] else "")
            + ".\n"
        )
        yield from (f"![Objective and slope along {name}]({plot})\n" for plot in content["plots"]
                    if plot.endswith(f"-{name}.png"))  # fmt: skip
    yield "## What was run\n"
    terms = ", ".join(" ".join(f"{key} {value}" for key, value in term.items()) for term in content["objective"])
    yield f"- Objective: {terms}"
    yield (
        f"- {content['evaluations']} walks with gradients in batches of {content['batch']}, {content['precision']}, in "
        f"{content['wall_seconds']:.0f} s, begun on {content['started']}"
    )
    yield f"- Command: `{content['command']}`"
    yield f"- Versions: {listed(content['versions'])}"
    yield f"- Machine: {listed(content['machine'])}"


def _about(tuning: Tuning, line: Slice) -> dict[str, Any]:
    tuned, good = line.tuned, line.value[line.ok]
    widths = [
        {
            "share": secants.share,
            "width": secants.width,
            "secants": len(secants.secant),
            "median_relative_error": secants.error,
            "sign_agreement": secants.sign_agreement,
            "ripple": secants.ripple,
        }
        for secants in line.secants
    ]
    judged = [secants for secants in line.secants if secants.share in JUDGED]
    known = all(len(secants.secant) for secants in judged)
    return {
        "unit": tuning.parameters[tuned.name].unit,
        "bounds": [tuned.low, tuned.high],
        "start": tuned.start,
        "from": float(line.x[0]),
        "to": float(line.x[-1]),
        "points": len(line.x),
        "fell": int((~line.ok).sum()),
        "lowest": float(good.min()) if len(good) else math.nan,
        "lowest_at": float(line.x[np.nanargmin(line.value)]) if len(good) else math.nan,
        "highest": float(good.max()) if len(good) else math.nan,
        "ripple": line.ripple,
        "widths": widths,
        "follows": all(s.error <= ERROR and s.sign_agreement >= SIGNS for s in judged) if known else None,
    }


def _sentence(name: str, about: Mapping[str, Any]) -> str:
    widths = [width for width in about["widths"] if width["share"] in JUDGED and width["secants"]]
    if about["follows"] is None:
        return f"{name}: too few places where the robot walks to the end; nothing can be said."
    found = " and ".join(
        f"{_percent(width['median_relative_error'])} from secants {100 * width['share']:g} % of the bounds wide "
        f"({_percent(width['sign_agreement'])} of one sign)"
        for width in widths
    )
    verdict = (
        "exact gradients can be followed" if about["follows"] else "exact gradients alone may mislead; average them"
    )
    return f"{name}: {verdict}. The slope differs by {found}."


def _percent(share: float) -> str:
    if not math.isfinite(share):
        return MISSING
    return f"{100 * share:.2g} %" if 0 < share < 0.0995 else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return f"{value + 0.0:.3g}" if math.isfinite(value) else MISSING
