"""report.json and report.md: published and measured figures of all experiments in a directory."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nermo_mjx.experiments.line import KINDS, Line
from nermo_mjx.experiments.settings import differences
from nermo_mjx.experiments.table import case_count, number, status_counts
from nermo_mjx.runs.text import MISSING

if TYPE_CHECKING:
    from nermo_mjx.experiments.catalogue import Experiment
    from nermo_mjx.experiments.directory import Directory, Stored

#: Headings of a table of lines, and their alignment.
HEADINGS = (
    ("figure", "left"), ("kind", "left"), ("published", "right"), ("as published", "right"), ("exact", "right"),
    ("ratio", "right"), ("holds", "left"), ("ensemble", "right"),
)  # fmt: skip


def collect(directory: Directory, experiments: Mapping[str, Experiment]) -> dict[str, Any]:
    """Content of report.json.

    Returns:
        `lines` of all experiments; `summary`: how many of them hold, in total, by kind and by experiment;
        `experiments`: what was run of each, with which settings, versions, machine and command, and its files;
        `differences`: sentences, if they were not all run in the same way; `started`, `command`, `versions`, `machine`
        of the latest, `wall_seconds` of all.
    """
    found = {name: directory.entry(name) for name in experiments}
    entries = {name: entry for name, entry in found.items() if entry is not None}
    lines = [line for entry in entries.values() for line in entry["lines"]]
    by_experiment = {
        name: counts(entry["lines"]) | {"by_kind": counts_by_kind(entry["lines"])} for name, entry in entries.items()
    }
    latest = max(entries.values(), key=lambda entry: entry["started"], default={})
    return {
        "lines": lines,
        "summary": {**counts(lines), "by_kind": counts_by_kind(lines), "by_experiment": by_experiment},
        "experiments": {
            name: {
                key: value for key, value in entry.items() if key not in ("experiment", "lines", "files", "finished")
            }
            for name, entry in entries.items()
        },
        "differences": _differences(entries),
        "wall_seconds": sum(entry["wall_seconds"] for entry in entries.values()),
        **{key: latest.get(key) for key in ("started", "command", "versions", "machine")},
    }


def entry_of(title: str, stored: Stored, lines: Sequence[Line]) -> dict[str, Any]:
    """The stored entry of an experiment: its lines, its settings, and its first files."""
    outcome = stored.outcome
    return {
        "experiment": outcome.experiment,
        "title": title,
        "worlds": len(next(iter(outcome.columns.values()))),
        "cases": case_count(outcome),
        "status": status_counts(outcome),
        **{name: value for name, value in stored.about.items() if name != "recordings"},
        "table": f"results/{stored.table.name}",
        "recordings": [f"recordings/{path.name}" for path in stored.recordings],
        "lines": [line_entry(line) for line in lines],
    }


def counts(lines: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Number of lines, of those that hold, and of those that were not measured or are not judged."""
    holds = [line["holds"] for line in lines]
    return {
        "lines": len(holds),
        "hold": holds.count(True),
        "do_not_hold": holds.count(False),
        "not_measured": holds.count(None),
    }


def counts_by_kind(lines: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """`counts` of the lines of each kind; kinds without lines are omitted."""
    by_kind = {kind: [line for line in lines if line["kind"] == kind] for kind in KINDS}
    return {kind: counts(found) for kind, found in by_kind.items() if found}


def line_entry(line: Line) -> dict[str, Any]:
    """A line in the form of report.json; an interval is a list, and NaN is null."""
    entry = dataclasses.asdict(line)
    for name in ("published", "demanded"):
        if isinstance(entry[name], tuple):
            entry[name] = list(entry[name])
    return entry


def cells(line: Mapping[str, Any]) -> list[str]:
    """A line of report.json as a row of texts under `HEADINGS`."""
    name = f"{line['figure']} [{line['unit']}]" if line["unit"] not in ("", "1") else line["figure"]
    ratio = MISSING if line["ratio"] is None else f"{line['ratio']:.2f}"
    holds = {True: "yes", False: "no", None: MISSING}[line["holds"]]
    share = MISSING if line["ensemble"] is None else f"{line['ensemble']:.0%}"
    values = (published(line["published"]), _value(line["as_published"]), _value(line["exact"]))
    return [name, line["kind"], *values, ratio, holds, share]


def published(value: Any) -> str:
    """A published figure with its published digits; an interval in words."""
    if isinstance(value, (list, tuple)):
        low, high = value
        if high is None or not math.isfinite(high):
            return f"at least {low:g}"
        digits = max(_decimals(low), _decimals(high))
        return f"at most {high:g}" if low == 0 else f"{low:.{digits}f} to {high:.{digits}f}"
    return f"{value:g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else _value(value)


def _value(value: Any) -> str:
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value) if isinstance(value, (int, float)) else str(value)


def _decimals(value: float) -> int:
    return len(f"{value:g}".partition(".")[2])


def _differences(entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A sentence on each experiment that was run differently from the first."""
    if not entries:
        return []
    first, *others = entries
    sentences = []
    for name in others:
        found = differences(_conditions(entries[name]), _conditions(entries[first]))
        if found:
            sentences.append(f"{name} was run otherwise than {first}: {'; '.join(found)}.")
    return sentences


def _conditions(entry: Mapping[str, Any]) -> dict[str, Any]:
    versions: Mapping[str, str] = entry["versions"]
    named: Sequence[str] = ("nermo-mjx", "mujoco", "jax")
    made = {f"version of {package}": versions.get(package, "unknown") for package in named}
    return {**entry["settings"], "engine": entry["engine"], "code": entry.get("code", "unknown"), **made}
