"""An identification's directory: identification.json, a report to read, and plots of the search and its residuals."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from nermo_mjx.experiments.identification.candidates import WALKS, Walking
from nermo_mjx.experiments.identification.ensemble_report import csv_text, ensemble_content, ensemble_section
from nermo_mjx.experiments.identification.memory import FILE, RESULT, CandidateFile
from nermo_mjx.experiments.identification.plots import figures_of
from nermo_mjx.experiments.identification.search import Identified, Search, identify
from nermo_mjx.experiments.identification.space import FREE, START
from nermo_mjx.experiments.identification.targets import TARGETS, Target
from nermo_mjx.experiments.report import published
from nermo_mjx.experiments.table import number
from nermo_mjx.physics.making import resolve_engine
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.robot import ModelParameters, ParameterError
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.runs import RunDirectory, Written, codes_of, engine_of, session
from nermo_mjx.runs.files import clear_errors, content_of
from nermo_mjx.runs.text import MISSING, listed, table, to_json
from nermo_mjx.runs.workers import Workers, WorkersLost

FORMULA: Final = (
    "root of the mean over all targets of r^2, where r = ln(value / published) / tolerance, of an interval its nearer "
    "end; r = 0 inside it, and where an order (published: at least 1) is met; 10 for a candidate that falls, diverges "
    "or goes backwards"
)
TARGET_HEADINGS: Final = (
    ("ratio of speeds", "left"), ("published", "right"), ("tolerance", "right"), ("before", "right"),
    ("identified", "right"), ("residual [tolerances]", "right"),
)  # fmt: skip
PARAMETER_HEADINGS: Final = (
    ("parameter", "left"), ("start", "right"), ("identified", "right"), ("bounds", "left"), ("why these", "left"),
)  # fmt: skip
#: A parameter is at a bound if it is closer to it than this share of the range of its logarithm.
_AT_BOUND: Final = 0.01


def run_identification(
    out: str | os.PathLike[str],
    *,
    engine: str = "auto",
    accept_new_code: bool = False,
    progress: Callable[[float], None] | None = None,
    notify: Callable[[str], None] | None = None,
    workers: Workers | None = None,
    **wanted: Any,
) -> dict[str, Any]:
    """Identify, and write the result into a directory; an interrupted search there is resumed.

    Args:
        out: the directory.
        engine: of the simulations; `auto` is the one that the directory was started with, if any.
        accept_new_code: reuse candidates of other code; the file's `code` tells them apart.
        progress: called with the share done.
        notify: called with a message about conflicting files.
        workers: what simulates; by default this process. The result is the same.
        wanted: of `search.Search`.

    Returns:
        Content of identification.json.

    Raises:
        ParameterError: wrong arguments, or a directory that holds a finished identification, or another search.
        OtherCode: other code made the candidates that the directory holds.
        DirectoryError: the directory holds something else, is in use, or cannot be written.
        WorkersLost: no worker is left; the same command resumes.
    """
    resolve_engine(engine)
    folder = Path(out)
    search = Search(**wanted)
    settings = dataclasses.asdict(search)
    with RunDirectory(folder, "identification") as held, Written(held) as written:
        if found := content_of(folder / RESULT):
            content = json.loads(found)
            if "plots" in content or content["settings"] != settings:
                raise ParameterError(f"{folder} holds an identification; choose another directory.")
            return _publish(written, content, notify)
        if engine == "auto":
            engine = engine_of(folder) or engine
        code, defaults = Walking(resolve_engine(engine)).stamp(), WALKS.defaults()
        held.take_code(code, holds_rows=(folder / FILE).exists(), accept=accept_new_code)
        about = session(settings=settings, engine=code.engine)
        held.note_session(about)
        started = time.monotonic()
        # Settings that determine the candidates; the ensemble's settings only determine its extent.
        begun = {name: settings[name] for name in ("samples", "generations", "population", "seed")}
        with clear_errors(folder):
            memory = CandidateFile(folder / FILE, begun | {"defaults": defaults}, code.id)
        try:
            identified = identify(search, code.engine, memory, progress, workers)
        except WorkersLost as lost:
            raise WorkersLost(lost.kept_in(folder)) from lost
        made = {"model": code.model, "defaults": defaults, "codes": list(codes_of(folder))}
        content = {**_content(identified), **made, **about, "wall_seconds": time.monotonic() - started}
        # The result first: whatever happens to the plots, the search is not lost.
        held.write(RESULT, to_json(content))
        return _publish(written, content, notify)


def _publish(written: Written, content: dict[str, Any], notify: Callable[[str], None] | None) -> dict[str, Any]:
    """Create the rest of the directory from its result, which has `plots` when everything exists."""
    folder = written.held.out
    if content["ensemble"] and content["ensemble"]["size"]:
        written.write(folder / "ensemble.csv", csv_text(content).encode())
    plots = write_figures(figures_of(content), folder / "plots", written.write)
    content = content | {"plots": [written.name(path) for path in plots]}
    written.write(folder / "identification.md", _page(content).encode())
    written.held.write(RESULT, to_json(content))
    if notify and written.aside:
        notify(written.sentence())
    return content


def target_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `TARGET_HEADINGS`."""
    return [
        [
            name, published(target["published"]), f"{target['tolerance']:.0%}", _number(target["start"]),
            _number(target["value"]), _signed(target["residual"]),
        ]
        for name, target in content["targets"].items()
    ]  # fmt: skip


def parameter_rows(content: Mapping[str, Any]) -> list[list[str]]:
    """Rows of texts under `PARAMETER_HEADINGS`."""
    rows = []
    for free in content["free"].values():
        names = ", ".join(free["parameters"]) + (f" [{free['unit']}]" if free["unit"] != "1" else "")
        value = number(free["value"]) + (f" (at its {free['at_bound']} bound)" if free["at_bound"] else "")
        default = ", ".join(dict.fromkeys(f"{value:g}" for value in free["default"]))
        rows.append([names, default, value, f"{free['low']:g} to {free['high']:g}", free["why"]])
    return rows


def _content(found: Identified) -> dict[str, Any]:
    """The search and its result."""
    known = dict(quantities(ModelParameters))
    targets = {
        name: {
            **_target(target),
            "value": found.figures[name][0],
            "residual": found.figures[name][1],
            "start": found.start_figures[name][0],
            "start_residual": found.start_figures[name][1],
        }
        for name, target in TARGETS.items()
    }
    free = {}
    for name, about in FREE.items():
        value = found.parameters[about.names[0]]
        free[name] = {
            "parameters": list(about.names), "unit": known[about.names[0]].unit, "low": about.low, "high": about.high,
            "why": about.why, "default": [START[each] for each in about.names], "value": value,
            "at_bound": _at_bound(value, about.low, about.high),
        }  # fmt: skip
    rounded = {name: f"{value:.4g}" for name, value in found.parameters.items()}
    return {
        "parameters": found.parameters,
        "options": " ".join(f"--set {name}={value}" for name, value in rounded.items()),
        "yaml": "set:\n" + "".join(f"  {name}: {value}\n" for name, value in rounded.items()),
        "objective": {"formula": FORMULA, "start": found.start, "end": found.objective},
        "targets": targets,
        "free": free,
        "candidates": len(found.costs),
        "costs": list(found.costs),
        "ensemble": None if found.bodies is None else ensemble_content(found.bodies),
    }


def _target(target: Target) -> dict[str, Any]:
    about = dataclasses.asdict(target)
    low, high = about.pop("low"), about.pop("high")
    return {"published": low if low == high else [low, high if math.isfinite(high) else None], **about}


def _at_bound(value: float, low: float, high: float) -> str | None:
    place = math.log(value / low) / math.log(high / low)
    return "lower" if place < _AT_BOUND else "upper" if place > 1 - _AT_BOUND else None


def _page(content: Mapping[str, Any]) -> str:
    objective, search = content["objective"], content["settings"]
    targets = table([name for name, _ in TARGET_HEADINGS], target_rows(content), "lrrrrr")
    parameters = table([name for name, _ in PARAMETER_HEADINGS], parameter_rows(content), "lrrll")
    pictures = "\n".join(
        f"![{Path(path).stem.replace('-', ' ')}]({path})\n" for path in content["plots"] if path.endswith(".png")
    )
    return f"""\
# Identification of what the publication does not give

Servo gain and damping, and damping of the joints, were searched within physical bounds for the published speeds on the
straight line, in the profile exact. Nothing else was looked at: orientation, turning, balance and maze are predictions.
The contact of the soles is that of the author's model.

**Objective {objective["start"]:.3f} at the start, {objective["end"]:.3f} after {content["candidates"]} candidates.**

## Published speeds

{targets}
A residual is a deviation in units of the tolerance: 1 is the deviation declared acceptable beforehand.

## Parameters

{parameters}
To use them in `nermo-mjx experiment` and `nermo-mjx walk`:

```sh
{content["options"]}
```

In a sweep file:

```yaml
{content["yaml"]}```

{ensemble_section(content)}{pictures}
## How

- Objective: {objective["formula"]}.
- Search: {search["samples"]} points of a Sobol sequence, then {search["generations"]} times
  {search["population"]} by CMA-ES from the best of them; both in the logarithms of the parameters.
- Seed {search["seed"]}, engine {content["engine"]}, {content["wall_seconds"]:.0f} s, begun on {content["started"]}.
- Command: `{content["command"]}`
- Model {content["model"]}, code {", ".join(content["codes"])}; versions: {listed(content["versions"])}
- Machine: {listed(content["machine"])}
"""


def _number(value: float | None) -> str:
    return MISSING if value is None else number(value)


def _signed(value: float | None) -> str:
    return MISSING if value is None or not math.isfinite(value) else f"{value + 0.0:+.2f}"
