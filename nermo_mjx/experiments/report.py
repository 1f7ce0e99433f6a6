"""The results of experiments as files: the table of the worlds, report.json, and report.md."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.control.parameters import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.cases import BODY, PROFILES, CaseRuns, Column, texts
from nermo_mjx.experiments.published import (
    AGREES,
    LINE_KINDS,
    Experiment,
    Line,
    line_counts,
    set_ups,
)
from nermo_mjx.files import json_of
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import Recording
from nermo_mjx.runs.code import local_time
from nermo_mjx.runs.files import EMPTY_CELL, listed, table
from nermo_mjx.sweep.spec import START_SPREAD
from nermo_mjx.sweep.table import Columns, meta

# --- a table: one row per world, with the roles of the table of a sweep (see `nermo_mjx.sweep.table`). The columns of the
# cases have the role `varied`, measurements in words the role `text`. Booleans are 1 or 0, with `logical` in the metadata

REPEAT, PROFILE, CODE, TEXT = "repeat", "profile", "code", "text"


def table_of(
    outcome: CaseRuns,
    first_row: int,
    first_variant: int,
    seed: int,
    code: str,
    metadata: Mapping[str, Any],
) -> pa.Table:
    """The table of an outcome.

    Args:
        outcome: Outcome of an experiment.
        first_row, first_variant: Indices of the first row and the first case.
        seed: Seed of the initial states.
        code: Short name of the code that made the outcome.
        metadata: Additional metadata of the schema.
    """
    columns, cases, count = Columns(), case_columns(outcome), len(outcome)
    variants: dict[tuple[Any, ...], int] = {}
    labels = [outcome.columns[name].tolist() for name in cases if name != BODY]
    variant = [variants.setdefault(case, len(variants)) for case in zip(*labels, strict=True)]
    start = outcome.columns.get(REPEAT, np.zeros(count, int)) + outcome.columns.get(BODY, 1) - 1
    draws = [hashlib.blake2b(f"{seed} {number}".encode(), digest_size=6) for number in start]
    added = {
        "row": (first_row + np.arange(count), "position of the world in the experiment"),
        "variant": (first_variant + np.array(variant), "index of the case"),
        "seed": ([int.from_bytes(draw.digest()) for draw in draws], "of the start of the run"),
    }
    for name, (numbers, text) in added.items():
        columns.add(name, np.array(numbers), "index", "1", text)
    for name, measured in outcome.columns.items():
        values = np.asarray(measured)
        is_text, logical = values.dtype.kind in "OU", values.dtype == bool
        role = "varied" if name in cases else TEXT if is_text else "metric"
        role = {REPEAT: "index", BODY: "index", "status": "status"}.get(name, role)
        column = outcome.about.get(name, Column("1", name.replace("_", " ")))
        scale = ("structure" if is_text else "linear") if role == "varied" else None
        numbers = values.astype(float) if logical else values
        columns.add(
            name,
            numbers,
            role,
            column.unit or "1",
            column.doc,
            scale=scale,
            logical="true" if logical else None,
        )
    if "status" not in outcome.columns:
        columns.add("status", np.full(count, "ok"), "status", "1", "no run can end early")
    columns.add(CODE, np.full(count, code), CODE, "1", "the code that made the row, see run.json")
    profiles = " ".join(dict.fromkeys(outcome.columns[PROFILE].tolist()))
    names = json.dumps(list(outcome.columns))
    table_metadata = {"experiment": outcome.experiment, "columns": names, "profile": profiles}
    return columns.table({**table_metadata, **metadata})


def outcome_of(content: pa.Table, recordings: Mapping[str, Recording]) -> CaseRuns:
    """The outcome that `table_of` converted to a table; its recordings are stored separately."""
    metadata = content.schema.metadata
    fields = {
        name: content.schema.field(name)
        for name in json_of(metadata[b"columns"], list[str], "a table of an experiment")
    }
    # Texts become string arrays again instead of object arrays.
    columns = {name: np.array(content.column(name).to_pylist()) for name in fields}
    for name, field in fields.items():
        columns[name] = columns[name].astype(bool) if "logical" in meta(field) else columns[name]
    columns_info = {
        name: Column(meta(field)["unit"], meta(field)["description"])
        for name, field in fields.items()
    }
    return CaseRuns(metadata[b"experiment"].decode(), columns, columns_info, recordings)


def case_columns(outcome: CaseRuns) -> list[str]:
    """Names of the columns that tell the cases apart, `profile` first: those before `repeat`."""
    names = list(outcome.columns)
    return names[: names.index(REPEAT)] if REPEAT in names else [PROFILE]


def case_table(
    outcome: CaseRuns, profile: str, metrics: Sequence[str], needs: Mapping[str, str]
) -> tuple[str, int]:
    """A Markdown table of the cases of a profile, mean and standard deviation of `metrics` over their repeats, and
    the number of cases.

    Args:
        needs: Metric -> column that must be a number for the metric to be meaningful.
    """
    labels = [name for name in case_columns(outcome) if name != PROFILE]
    metrics = [name for name in metrics if name in outcome.columns]

    def heading(name: str) -> str:
        unit = outcome.about[name].unit if name in outcome.about else ""
        unit = shown("", unit, np.zeros(1)).unit if name in metrics else unit
        return name.replace("_", " ") if unit in ("", "1") else f"{name.replace('_', ' ')} [{unit}]"

    def label(value: Any) -> str:
        return f"{value:g}" if isinstance(value, float) else setting_text(value)

    cases: dict[tuple[Any, ...], list[int]] = {}
    for row in np.flatnonzero(outcome.where(profile=profile)):
        cases.setdefault(tuple(outcome.columns[name][row].item() for name in labels), []).append(
            int(row)
        )
    rows = [
        [
            *map(label, case),
            *(_over_repeats(outcome, name, members, needs.get(name, "")) for name in metrics),
        ]
        for case, members in cases.items()
    ]
    return table(
        [*map(heading, (*labels, *metrics))], rows, "l" * len(labels) + "r" * len(metrics)
    ), len(rows)


def _over_repeats(outcome: CaseRuns, name: str, rows: list[int], need: str) -> str:
    """Mean and spread of numbers, counts of Booleans, all distinct texts."""
    if need in outcome.columns and not np.isfinite(outcome.columns[need][rows]).any():
        return EMPTY_CELL
    values = np.asarray(outcome.columns[name])[rows]
    if values.dtype == bool:
        return f"{int(values.sum())} of {len(values)}"
    if values.dtype.kind in "OU":
        return "; ".join(dict.fromkeys(filter(None, map(str, values.tolist())))) or EMPTY_CELL
    quantity = shown(name, outcome.about[name].unit, values)
    good = quantity.values[np.isfinite(quantity.values)]
    if not len(good):
        return EMPTY_CELL
    mean = float(good.mean())
    text = rounded(mean)
    # Values that do not depend on the start, such as theory, have no spread except rounding.
    if np.ptp(good) > 1e-6 * abs(mean):
        text += f" ± {good.std(ddof=1):.{len(text.partition('.')[2])}f}"
    return text if len(good) == len(values) else f"{text} ({len(good)} of {len(values)})"


def rounded(value: float, digits: int = 3) -> str:
    """A number with the given significant digits and no exponent; "–" where it is not finite, "0" below 5e-5."""
    if not math.isfinite(value):
        return EMPTY_CELL
    if abs(value) < 5e-5:
        return "0"
    decimals = min(max(digits - 1 - math.floor(math.log10(abs(value))), 0), 7)
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


# --- report.json

#: Headings of a table of lines, and their alignment.
LINE_HEADINGS = (
    *((name, "left") for name in ("figure", "kind")),
    *(
        (name, "right")
        for name in ("published", "author's model", "as published", "exact", "as built", "90 %")
    ),
    *((name, "left") for name in ("in it", "holds")),
)


#: Fields of a record that concern the directory only.
_OF_RECORD: Final = ("recordings", "rows", "bodies", "drawn")


def entry_of(
    title: str, outcome: CaseRuns, metadata: Mapping[str, Any], lines: Sequence[Line]
) -> dict[str, Any]:
    """The stored entry of an experiment: its lines, its settings, and its size.

    Args:
        metadata: Settings, engine, code, session and duration of the experiment.
    """
    cases = [name for name in case_columns(outcome) if name != PROFILE]
    status, number_of = np.unique(
        outcome.columns.get("status", np.array([], str)), return_counts=True
    )
    return {
        "experiment": outcome.experiment,
        "title": title,
        "worlds": len(outcome),
        "cases": len(set(zip(*(outcome.columns[name].tolist() for name in cases), strict=True)))
        if cases
        else 1,
        "status": dict(zip(status.tolist(), number_of.tolist(), strict=True)),
        **{name: value for name, value in metadata.items() if name not in _OF_RECORD},
        "lines": [dataclasses.asdict(line) for line in lines],
    }


def collect(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Content of report.json, from the entries of all experiments in a directory.

    Returns:
        `lines` of all experiments; `summary`: how many of them hold, in total, by kind and by experiment;
        `experiments`: what was run of each, with which settings, versions, machine and command, and its files;
        `set_ups` of the author's model; `differences`: sentences, if they were not all run in the same way; `started`,
        `command`, `versions`, `machine` of the latest, `wall_seconds` of all.
    """

    def summary(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        by_kind = {kind: [line for line in lines if line["kind"] == kind] for kind in LINE_KINDS}
        return line_counts(lines) | {
            "by_kind": {
                kind: line_counts(kind_lines) for kind, kind_lines in by_kind.items() if kind_lines
            }
        }

    def conditions(entry: Mapping[str, Any]) -> dict[str, Any]:
        conditions_made = {
            f"version of {name}": entry["versions"].get(name, "unknown")
            for name in ("nermo-mjx", "mujoco", "jax")
        }
        return {
            **entry["settings"],
            "engine": entry["engine"],
            "code": entry.get("code", "unknown"),
            **conditions_made,
        }

    lines = [line for entry in entries.values() for line in entry["lines"]]
    latest = max(entries.values(), key=lambda entry: entry["started"], default={})
    hidden, unlike = ("experiment", "lines", "finished"), []
    for name in list(entries)[1:]:
        first = next(iter(entries))
        if changed := differences(conditions(entries[name]), conditions(entries[first])):
            unlike.append(f"{name} was run otherwise than {first}: {'; '.join(changed)}.")
    return {
        "lines": lines,
        "summary": summary(lines)
        | {"by_experiment": {name: summary(entry["lines"]) for name, entry in entries.items()}},
        "experiments": {
            name: {key: value for key, value in entry.items() if key not in hidden}
            for name, entry in entries.items()
        },
        "set_ups": set_ups(),
        "differences": unlike,
        "wall_seconds": sum(entry["wall_seconds"] for entry in entries.values()),
        **{key: latest.get(key) for key in ("started", "command", "versions", "machine")},
    }


def cells(line: Mapping[str, Any]) -> list[str]:
    """A line of report.json as a row of texts under `LINE_HEADINGS`."""
    name = f"{line['figure']} [{line['unit']}]" if line["unit"] not in ("", "1") else line["figure"]
    published = published_text(line["published"], at_most=line["rule"] == "at_most")
    values = [_value(line[profile]) for profile in ("as_published", "exact", "as_built")]
    spread = (
        EMPTY_CELL if line["low"] is None else f"{rounded(line['low'])} to {rounded(line['high'])}"
    )
    if line["low"] is None and line["ensemble"] is not None:
        spread = f"{line['ensemble']:.0%} of the bodies"
    judged = (_value(line["covered"]), _value(line["holds"]))
    return [name, line["kind"], published, published_text(line["author"]), *values, spread, *judged]


def published_text(value: Any, *, at_most: bool = False) -> str:
    """A published figure with its published digits; an interval, or several values, in words."""
    if isinstance(value, list):
        digits = max(len(f"{bound:g}".partition(".")[2]) for bound in value)
        ends = [value[0], value[-1]] if len(value) == 2 else [min(value), max(value)]
        return " to ".join(f"{bound:.{digits}f}" for bound in ends)
    text = (
        f"{value:g}"
        if isinstance(value, int | float) and not isinstance(value, bool)
        else _value(value)
    )
    return f"at most {text}" if at_most else text


def _value(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: EMPTY_CELL, True: "yes", False: "no"}[value]
    return rounded(value) if isinstance(value, int | float) else str(value)


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Differences between settings, in words: "seed: 0 instead of 1"."""
    words = {"values": "parameters", "quick": "quick run"}
    return [
        f"{words.get(name, name)}: {setting_text(first.get(name))} instead of {setting_text(second.get(name))}"
        for name in dict.fromkeys((*first, *second))
        if first.get(name) != second.get(name)
    ]


def setting_text(value: Any) -> str:
    """A setting in words."""
    if value is None:
        return "the published one"
    if isinstance(value, bool):
        return _value(value)
    if isinstance(value, list | tuple):
        return " and ".join(map(str, value))
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={number:g}" for name, number in value.items()) or "as they are"
    return str(value)


# --- report.md

_SOURCE: Final = (
    'A. Rohregger, "Digital Nermo", Master\'s thesis, TU Munich, December 2021, chapters 6 and 7'
)
_LINE_COUNTS: Final = ("lines", "hold", "do_not_hold", "not_measured")
_MEANING: Final = {
    "predicted": "not used in any decision about the twin",
    "rewritten": "its rule was changed after the author's own model had failed it",
    "chosen": "something was decided with it in view",
    "fitted": "a term of the identification, or decided by those",
    "theory": "formula against formula; nothing is simulated",
}


def report_page(
    content: Mapping[str, Any],
    experiments: Mapping[str, Experiment],
    outcomes: Mapping[str, CaseRuns],
) -> str:
    """The text of report.md.

    Args:
        content: Content of report.json.
        experiments: Experiments, in the order of the report.
        outcomes: Name of an experiment -> outcome, with its cases.
    """
    reported = [experiments[name] for name in experiments if name in content["experiments"]]
    parts = ["# The published experiments, simulated again\n", *_summary(content, reported)]
    for experiment in reported:
        parts += _experiment(content, experiment, outcomes.get(experiment.name))
    parts += [*_what_was_run(content, reported), "## Conventions\n"]
    parts += [f"- Author's model, `{name}`: {text}." for name, text in content["set_ups"].items()]
    parts.append(texts("report")["conventions"].format(faster=1 / PUBLISHED_CLOCK_RATIO))
    return "\n".join(parts).rstrip() + "\n"


def headline(summary: Mapping[str, Any]) -> str:
    """How many predicted figures hold, and how many published values lie in their interval."""
    predicted = summary["by_kind"].get("predicted", line_counts([]))
    text = f"{predicted['hold']} of {_judged(predicted)} predicted figures hold"
    spread = predicted["covered"] + predicted["not_covered"]
    return (
        f"{text}; {predicted['covered']} of {spread} published values lie in the 90 % interval"
        if spread
        else text
    )


def _judged(counted: Mapping[str, Any]) -> int:
    return int(counted["hold"] + counted["do_not_hold"])


def _summary(content: Mapping[str, Any], reported: list[Experiment]) -> Iterator[str]:
    summary, by_kind = content["summary"], content["summary"]["by_kind"]
    yield (
        f"**{headline(summary)}.** In all, {summary['hold']} of {_judged(summary)} figures hold. Only predicted lines "
        f"count as evidence. Published figures: {_SOURCE}.\n"
    )

    def counted(line_count: Mapping[str, Any]) -> list[str]:
        return [str(line_count[name]) for name in _LINE_COUNTS]

    headings = ["figures", "hold", "do not hold", "not judged or measured"]
    rows = [
        [kind, _MEANING[kind], *counted(by_kind[kind])] for kind in LINE_KINDS if kind in by_kind
    ]
    yield table(
        ["kind", "what it is", *headings], [*rows, ["all", "", *counted(summary)]], "llrrrr"
    )
    rows = []
    for experiment in reported:
        counts = summary["by_experiment"][experiment.name]
        kind_counts = [counts["by_kind"].get(kind) for kind in LINE_KINDS]
        anchor = "".join(
            c for c in experiment.title.lower().replace(" ", "-") if c.isalnum() or c == "-"
        )  # as GitHub's
        held_texts = [
            f"{kind_count['hold']} of {_judged(kind_count)}" if kind_count else EMPTY_CELL
            for kind_count in kind_counts
        ]
        rows.append([f"[{experiment.title}](#{anchor})", *held_texts, *counted(counts)])
    yield table(["experiment", *LINE_KINDS, *headings], rows, f"l{'r' * len(LINE_KINDS)}rrrr")
    yield texts("report")["legend"].format(agrees=AGREES)
    settings = {
        experiment.title: content["experiments"][experiment.name]["settings"]
        for experiment in reported
    }
    if quick := [title for title, counts in settings.items() if counts["quick"]]:
        yield f"> **A quick run** of {', '.join(quick)}: fewer cases, and other figures than a full run's.\n"
    for title, counts in settings.items():
        if counts["values"]:
            yield f"> {title} was run with other parameters than the default: {setting_text(counts['values'])}.\n"
        if walker := counts.get("controller"):
            yield f"> In {title}, {walker} walked in place of the published controller, upon which it acts.\n"
    for sentence in content["differences"]:
        yield f"> **Run in different ways.** {sentence}\n"


def _experiment(
    content: Mapping[str, Any], experiment: Experiment, outcome: CaseRuns | None
) -> Iterator[str]:
    entry = content["experiments"][experiment.name]
    lines = [line for line in content["lines"] if line["experiment"] == experiment.name]
    yield f"## {experiment.title}\n"
    yield experiment.description + "\n"
    rows = []
    for line in lines:
        *first, holds = cells(line)
        source = f"{line['section']}: {line['sentence']}" if line["sentence"] else line["section"]
        rows.append([*first, "**no**" if holds == "no" else holds, source])
    yield table([*(name for name, _ in LINE_HEADINGS), "source"], rows, "llrrrrrrlll")
    if entry.get("bodies"):
        yield f"Intervals: the starts of the default body, and {entry['bodies']} identified bodies, a start each.\n"
    if reasons := [line for line in lines if line["reason"] or line["holds"] is False]:
        yield "What does not hold, and where a rule has a reason:\n"
        for line in reasons:
            bold = "**no**, " if line["holds"] is False else ""
            yield f"- {bold}{line['figure']}: {line['reason'] or 'no reason is known.'}"
        yield ""
    if outcome is not None:
        yield "### Simulation and theory\n"
        yield "Mean ± standard deviation over the repeats, in simulated time.\n"
        for profile in dict.fromkeys(outcome.columns[PROFILE].tolist()):
            text, count = case_table(outcome, profile, experiment.metrics, experiment.needs)
            yield f"<details><summary>{profile.replace('_', ' ')}, {count} cases</summary>\n"
            yield text
            yield "</details>\n"
    for path in map(PurePosixPath, entry["plots"]):
        if path.suffix == ".png":
            caption = path.stem.removeprefix(f"{experiment.name}-").replace("-", " ")
            yield f"![{experiment.title}: {caption}]({path})\n"
    for video in entry["videos"]:
        pace = (
            "in real time"
            if video["speed"] == 1
            else f"{video['speed']:g} times as fast as real time"
        )
        yield f"Video: [{video['file']}]({video['file']}), {video['shows']}, {pace}.\n"
    yield from (f"{note}\n" for note in entry["notes"])
    recordings = ", ".join(f"[{path}]({path})" for path in entry["recordings"])
    files = f" Recordings: {recordings}." if recordings else ""
    yield f"Every world: [{entry['table']}]({entry['table']}).{files}\n"


def _what_was_run(content: Mapping[str, Any], reported: list[Experiment]) -> Iterator[str]:
    yield "## What was run\n"
    rows = []
    for experiment in reported:
        entry = content["experiments"][experiment.name]
        settings = entry["settings"]
        row = {
            "experiment": experiment.name,
            "cases": entry["cases"],
            "profiles": setting_text([n for n in PROFILES if n in settings["profiles"]]).replace(
                "_", " "
            ),
            "repeats": settings["repeats"],
            "seed": settings["seed"],
            "worlds": entry["worlds"],
            "went": ", ".join(f"{count} {status}" for status, count in entry["status"].items())
            or EMPTY_CELL,
            "engine": entry["engine"],
            "code": entry.get("code", EMPTY_CELL),
            "parameters": setting_text(settings["values"]),
            "took": f"{entry['wall_seconds']:.0f} s",
            "on": local_time(entry["started"]),
        }
        rows.append(row)
    yield table(
        list(rows[0]) if rows else [], [[*map(str, row.values())] for row in rows], "lrlrrrllllrl"
    )
    for experiment in reported:
        if content["experiments"][experiment.name]["settings"]["quick"]:
            yield f"- {experiment.name} was a quick run: {experiment.quick}."
    shift = (
        f"{1e3 * START_SPREAD['start.x']:g} mm, {math.degrees(START_SPREAD['start.yaw']):g} degree"
    )
    yield (
        f"- Repeats differ by a seeded shift of the start: at most {shift} and {START_SPREAD['start.phase']:g} of a "
        "gait cycle; in the balance test, of pose and servo angles. All profiles have the same starts."
    )
    for command in dict.fromkeys(
        content["experiments"][experiment.name]["command"] for experiment in reported
    ):
        yield f"- Command: `{command}`"
    yield f"- Versions of the latest run: {listed(content['versions'])}"
    yield f"- Machine of the latest run: {listed(content['machine'])}\n"
