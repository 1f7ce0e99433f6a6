"""Results for programs and readers: the table of an experiment's worlds, report.json, and report.md."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.control.parameters import PROFILES, PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.cases import Column, Outcome
from nermo_mjx.experiments.lines import AGREES, KINDS, Line, counts, set_ups
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import Recording
from nermo_mjx.runs.text import MISSING, listed, table
from nermo_mjx.sweep.spec import START_SPREAD
from nermo_mjx.sweep.table import Columns, meta

if TYPE_CHECKING:
    from nermo_mjx.experiments.catalogue import Experiment

# --- a table: one row per world, with the roles `case` (what tells the cases apart), `index` (repeat), `metric`,
# `status`, and `code` (that made it)

REPEAT, PROFILE, CODE = "repeat", "profile", "code"


def table_of(outcome: Outcome, about: Mapping[str, Any], code: str) -> pa.Table:
    """The table of an outcome.

    Args:
        about: what to note in the schema's metadata.
        code: short name of the code that made it.
    """
    columns, cases = Columns(), case_columns(outcome)
    for name, values in outcome.columns.items():
        role = "case" if name in cases else {REPEAT: "index", "status": "status"}.get(name, "metric")
        column = outcome.about.get(name, Column("1", name.replace("_", " ")))
        columns.add(name, np.asarray(values), role, column.unit or "1", column.doc)
    columns.add(CODE, np.full(len(outcome), code), CODE, "1", "the code that made the row, see run.json")
    return columns.table({"experiment": outcome.experiment, **about})


def outcome_of(content: pa.Table, recordings: Mapping[str, Recording]) -> Outcome:
    """The outcome that `table_of` converted to a table; its recordings are stored separately."""
    fields = [field for field in content.schema if meta(field)["role"] != CODE]
    # Texts become string arrays again instead of object arrays.
    columns = {field.name: np.array(content.column(field.name).to_pylist()) for field in fields}
    about = {field.name: Column(meta(field)["unit"], meta(field)["description"]) for field in fields}
    return Outcome(content.schema.metadata[b"experiment"].decode(), columns, about, recordings)


def case_columns(outcome: Outcome) -> list[str]:
    """Names of the columns that tell the cases apart, `profile` first: those before `repeat`."""
    names = list(outcome.columns)
    return names[: names.index(REPEAT)] if REPEAT in names else [PROFILE]


@dataclasses.dataclass(frozen=True)
class CaseTable:
    """Cases of one profile for display: headings with units, their alignment, and one row of texts per case."""

    profile: str
    headings: list[str]
    sides: str
    rows: list[list[str]]


def case_tables(
    outcome: Outcome, metrics: Sequence[str], needs: Mapping[str, str] | None = None
) -> Iterator[CaseTable]:
    """A table of the cases of each profile, with the mean and standard deviation of `metrics` over their repeats.

    Args:
        needs: metric -> column that must be a number for the metric to be meaningful.
    """
    needs = needs or {}
    labels = [name for name in case_columns(outcome) if name != PROFILE]
    metrics = [name for name in metrics if name in outcome.columns]
    headings = [_heading(outcome, name) for name in labels] + [
        _heading(outcome, name, shown_unit=True) for name in metrics
    ]
    for profile in dict.fromkeys(outcome.columns[PROFILE].tolist()):
        cases: dict[tuple[Any, ...], list[int]] = {}
        for row in np.flatnonzero(outcome.where(profile=profile)):
            cases.setdefault(tuple(outcome.columns[name][row].item() for name in labels), []).append(int(row))
        texts = [
            [_label(value) for value in case]
            + [_over_repeats(outcome, name, members, needs.get(name, "")) for name in metrics]
            for case, members in cases.items()
        ]
        yield CaseTable(profile, headings, "l" * len(labels) + "r" * len(metrics), texts)


def number(value: float, digits: int = 3) -> str:
    """A number with the given significant digits and no exponent; "–" where it is not finite, "0" below 5e-5."""
    if not math.isfinite(value):
        return MISSING
    if abs(value) < 5e-5:
        return "0"
    decimals = min(max(digits - 1 - math.floor(math.log10(abs(value))), 0), 7)
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


def _heading(outcome: Outcome, name: str, *, shown_unit: bool = False) -> str:
    unit = outcome.about[name].unit if name in outcome.about else ""
    unit = shown("", unit, np.zeros(1)).unit if shown_unit else unit
    return name.replace("_", " ") if unit in ("", "1") else f"{name.replace('_', ' ')} [{unit}]"


def _label(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _over_repeats(outcome: Outcome, name: str, rows: list[int], need: str) -> str:
    """Mean and spread of numbers, counts of Booleans, all distinct texts."""
    if need in outcome.columns and not np.isfinite(outcome.columns[need][rows]).any():
        return MISSING
    values = np.asarray(outcome.columns[name])[rows]
    if values.dtype == bool:
        return f"{int(values.sum())} of {len(values)}"
    if values.dtype.kind in "OU":
        return "; ".join(dict.fromkeys(filter(None, map(str, values.tolist())))) or MISSING
    quantity = shown(name, outcome.about[name].unit, values)
    good = quantity.values[np.isfinite(quantity.values)]
    if not len(good):
        return MISSING
    mean = float(good.mean())
    text = number(mean)
    # Values that do not depend on the start, such as theory, have no spread except rounding.
    if np.ptp(good) > 1e-6 * abs(mean):
        text += f" ± {good.std(ddof=1):.{len(text.partition('.')[2])}f}"
    return text if len(good) == len(values) else f"{text} ({len(good)} of {len(values)})"


# --- report.json

#: Headings of a table of lines, and their alignment.
HEADINGS = (
    ("figure", "left"), ("kind", "left"), ("published", "right"), ("author's model", "right"),
    ("as published", "right"), ("exact", "right"), ("as built", "right"), ("90 %", "right"), ("in it", "left"),
    ("holds", "left"),
)  # fmt: skip
_WORDS: Final = {"values": "parameters", "quick": "quick run"}


def entry_of(title: str, outcome: Outcome, about: Mapping[str, Any], lines: Sequence[Line]) -> dict[str, Any]:
    """The stored entry of an experiment: its lines, its settings, and its size.

    Args:
        about: its settings, engine, code, session and duration.
    """
    cases = [name for name in case_columns(outcome) if name != PROFILE]
    status, number_of = np.unique(outcome.columns.get("status", np.array([], str)), return_counts=True)
    return {
        "experiment": outcome.experiment,
        "title": title,
        "worlds": len(outcome),
        "cases": len(set(zip(*(outcome.columns[name].tolist() for name in cases), strict=True))) if cases else 1,
        "status": dict(zip(status.tolist(), number_of.tolist(), strict=True)),
        **{name: value for name, value in about.items() if name != "recordings"},
        "lines": [dataclasses.asdict(line) for line in lines],
    }


def collect(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Content of report.json, from the entries of all experiments that a directory holds.

    Returns:
        `lines` of all experiments; `summary`: how many of them hold, in total, by kind and by experiment;
        `experiments`: what was run of each, with which settings, versions, machine and command, and its files;
        `set_ups` of the author's model; `differences`: sentences, if they were not all run in the same way; `started`,
        `command`, `versions`, `machine` of the latest, `wall_seconds` of all.
    """
    lines = [line for entry in entries.values() for line in entry["lines"]]
    latest = max(entries.values(), key=lambda entry: entry["started"], default={})
    hidden = ("experiment", "lines", "files", "finished")
    return {
        "lines": lines,
        "summary": {
            **counts(lines),
            "by_kind": _by_kind(lines),
            "by_experiment": {
                name: counts(entry["lines"]) | {"by_kind": _by_kind(entry["lines"])} for name, entry in entries.items()
            },
        },
        "experiments": {
            name: {key: value for key, value in entry.items() if key not in hidden} for name, entry in entries.items()
        },
        "set_ups": set_ups(),
        "differences": _differences(entries),
        "wall_seconds": sum(entry["wall_seconds"] for entry in entries.values()),
        **{key: latest.get(key) for key in ("started", "command", "versions", "machine")},
    }


def _by_kind(lines: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """`counts` of the lines of each kind; kinds without lines are omitted."""
    by_kind = {kind: [line for line in lines if line["kind"] == kind] for kind in KINDS}
    return {kind: counts(found) for kind, found in by_kind.items() if found}


def cells(line: Mapping[str, Any]) -> list[str]:
    """A line of report.json as a row of texts under `HEADINGS`."""
    name = f"{line['figure']} [{line['unit']}]" if line["unit"] not in ("", "1") else line["figure"]
    published = published_text(line["published"], at_most=line["rule"] == "at_most")
    values = [_value(line[profile]) for profile in ("as_published", "exact", "as_built")]
    words = {True: "yes", False: "no", None: MISSING}
    spread = MISSING if line["low"] is None else f"{number(line['low'])} to {number(line['high'])}"
    if line["low"] is None and line["ensemble"] is not None:
        spread = f"{line['ensemble']:.0%} of the bodies"
    author = published_text(line["author"])
    return [name, line["kind"], published, author, *values, spread, words[line["covered"]], words[line["holds"]]]


def published_text(value: Any, *, at_most: bool = False) -> str:
    """A published figure with its published digits; an interval, or several values, in words."""
    if isinstance(value, list):
        digits = max(len(f"{each:g}".partition(".")[2]) for each in value)
        ends = [value[0], value[-1]] if len(value) == 2 else [min(value), max(value)]
        return " to ".join(f"{each:.{digits}f}" for each in ends)
    text = f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else _value(value)
    return f"at most {text}" if at_most else text


def _value(value: Any) -> str:
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value) if isinstance(value, int | float) else str(value)


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Differences between settings, in words: "seed: 0 instead of 1"."""
    return [
        f"{_WORDS.get(name, name)}: {said(one.get(name))} instead of {said(other.get(name))}"
        for name in dict.fromkeys((*one, *other))
        if one.get(name) != other.get(name)
    ]


def said(value: Any) -> str:
    """A setting in words."""
    if value is None:
        return "the published one"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " and ".join(map(str, value))
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={number:g}" for name, number in value.items()) or "as they are"
    return str(value)


def _differences(entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A sentence on each experiment that was run differently from the first."""
    sentences, conditions = [], {name: _conditions(entry) for name, entry in entries.items()}
    for name in list(entries)[1:]:
        first = next(iter(entries))
        if found := differences(conditions[name], conditions[first]):
            sentences.append(f"{name} was run otherwise than {first}: {'; '.join(found)}.")
    return sentences


def _conditions(entry: Mapping[str, Any]) -> dict[str, Any]:
    made = {f"version of {name}": entry["versions"].get(name, "unknown") for name in ("nermo-mjx", "mujoco", "jax")}
    return {**entry["settings"], "engine": entry["engine"], "code": entry.get("code", "unknown"), **made}


# --- report.md

_SOURCE: Final = 'A. Rohregger, "Digital Nermo", Master\'s thesis, TU Munich, December 2021, chapters 6 and 7'
_COUNTS: Final = ("lines", "hold", "do_not_hold", "not_measured")
_MEANING: Final = {
    "predicted": "not used in any decision about the twin",
    "chosen": "something was decided with it in view",
    "fitted": "a term of the identification, or decided by those",
    "theory": "formula against formula; nothing is simulated",
}


def page(content: Mapping[str, Any], experiments: Mapping[str, Experiment], outcomes: Mapping[str, Outcome]) -> str:
    """The text of report.md.

    Args:
        content: of report.json.
        experiments: in the order of the report.
        outcomes: by experiment; they give the cases.
    """
    chosen = [experiments[name] for name in experiments if name in content["experiments"]]
    parts = ["# The published experiments, simulated again\n", *_summary(content, chosen)]
    for each in chosen:
        parts += _experiment(content, each, outcomes.get(each.name))
    parts += [*_what_was_run(content, chosen), *_conventions(content)]
    return "\n".join(parts).rstrip() + "\n"


def headline(summary: Mapping[str, Any]) -> str:
    """How many predicted figures hold, and how many published values lie in their interval."""
    predicted = summary["by_kind"].get("predicted", counts([]))
    text = f"{predicted['hold']} of {_judged(predicted)} predicted figures hold"
    spread = predicted["covered"] + predicted["not_covered"]
    return f"{text}; {predicted['covered']} of {spread} published values lie in the 90 % interval" if spread else text


def _summary(content: Mapping[str, Any], chosen: list[Experiment]) -> Iterator[str]:
    summary = content["summary"]
    yield (
        f"**{headline(summary)}.** In all, {summary['hold']} of {_judged(summary)} figures hold. Only predicted lines "
        f"count as evidence. Published figures: {_SOURCE}.\n"
    )
    by_kind = summary["by_kind"]
    rows = [
        [kind, _MEANING[kind], *(str(by_kind[kind][name]) for name in _COUNTS)] for kind in KINDS if kind in by_kind
    ]
    rows.append(["all", "", *(str(summary[name]) for name in _COUNTS)])
    counted = ["figures", "hold", "do not hold", "not judged or measured"]
    yield table(["kind", "what it is", *counted], rows, "llrrrr")
    rows = [
        [
            f"[{each.title}](#{_anchor(each.title)})",
            *(_held(summary["by_experiment"][each.name]["by_kind"].get(kind)) for kind in KINDS),
            *(str(summary["by_experiment"][each.name][name]) for name in _COUNTS),
        ]
        for each in chosen
    ]
    yield table(["experiment", *KINDS, *counted], rows, f"l{'r' * len(KINDS)}rrrr")
    yield (
        "- **author's model**: what his model and code give, run headless (settings below). A criterion that they fail "
        "is no criterion.\n"
        "- **as published**: the simulation of the publication's tests; its simulation figures are judged here.\n"
        "- **exact**: closed-form kinematics, one clock, the stance of Table A.7; shown, not judged.\n"
        "- **as built**: the robot with faults of its hardware; the hardware's figures are judged here.\n"
        "- **90 %**: interval of the judged profile over identified bodies and starts, if bodies were run; **in it**: "
        "whether the published value lies in it.\n"
        f"- **holds**: a number is within {AGREES:.0%} of the published one. An effect, a ratio that says how much "
        f"something changes, is judged on its size, the ratio less 1: within {AGREES:.0%} of the published size. Half "
        "a unit of the last published digit counts as rounding. A bound or a range is not widened; a trend or an "
        "outcome is the published one. Where a rule is another, its reason is given.\n"
    )
    settings = {each.title: content["experiments"][each.name]["settings"] for each in chosen}
    if quick := [title for title, own in settings.items() if own["quick"]]:
        yield f"> **A quick run** of {', '.join(quick)}: fewer cases, and other figures than a full run's.\n"
    for title, own in settings.items():
        if own["values"]:
            yield f"> {title} was run with other parameters than the default: {said(own['values'])}.\n"
        if walker := own.get("controller"):
            yield f"> In {title}, {walker} walked in place of the published controller, upon which it acts.\n"
    for sentence in content["differences"]:
        yield f"> **Run in different ways.** {sentence}\n"


def _judged(counted: Mapping[str, Any]) -> int:
    return int(counted["hold"] + counted["do_not_hold"])


def _held(counted: Mapping[str, Any] | None) -> str:
    """Number of lines that hold, out of all."""
    return f"{counted['hold']} of {_judged(counted)}" if counted else MISSING


def _experiment(content: Mapping[str, Any], each: Experiment, outcome: Outcome | None) -> Iterator[str]:
    about = content["experiments"][each.name]
    lines = [line for line in content["lines"] if line["experiment"] == each.name]
    yield f"## {each.title}\n"
    yield each.description + "\n"
    rows = []
    for line in lines:
        *texts, holds = cells(line)
        source = f"{line['section']}: {line['sentence']}" if line["sentence"] else line["section"]
        rows.append([*texts, "**no**" if holds == "no" else holds, source])
    yield table([*(name for name, _ in HEADINGS), "source"], rows, "llrrrrrrlll")
    if about.get("bodies"):
        yield f"Intervals: the starts of the default body, and {about['bodies']} identified bodies, a start each.\n"
    reasons = [line for line in lines if line["reason"] or line["holds"] is False]
    if reasons:
        yield "What does not hold, and where a rule has a reason:\n"
        for line in reasons:
            bold = "**no**, " if line["holds"] is False else ""
            yield f"- {bold}{line['figure']}: {line['reason'] or 'no reason is known.'}"
        yield ""
    if outcome is not None:
        yield "### Simulation and theory\n"
        yield "Mean ± standard deviation over the repeats, in simulated time.\n"
        for cases in case_tables(outcome, each.metrics, each.needs):
            title = f"{cases.profile.replace('_', ' ')}, {len(cases.rows)} cases"
            yield f"<details><summary>{title}</summary>\n"
            yield table(cases.headings, cases.rows, cases.sides)
            yield "</details>\n"
    for path in map(PurePosixPath, about["plots"]):
        if path.suffix == ".png":
            caption = path.stem.removeprefix(f"{each.name}-").replace("-", " ")
            yield f"![{each.title}: {caption}]({path})\n"
    for video in about["videos"]:
        pace = "in real time" if video["speed"] == 1 else f"{video['speed']:g} times as fast as real time"
        yield f"Video: [{video['file']}]({video['file']}), {video['shows']}, {pace}.\n"
    yield from (f"{note}\n" for note in about["notes"])
    recordings = "".join(f", [{path}]({path})" for path in about["recordings"]).removeprefix(", ")
    files = f" Recordings: {recordings}." if recordings else ""
    yield f"Every world: [{about['table']}]({about['table']}).{files}\n"


def _what_was_run(content: Mapping[str, Any], chosen: list[Experiment]) -> Iterator[str]:
    yield "## What was run\n"
    rows = []
    for each in chosen:
        about = content["experiments"][each.name]
        settings = about["settings"]
        went = ", ".join(f"{count} {status}" for status, count in about["status"].items()) or MISSING
        profiles = said([name for name in PROFILES if name in settings["profiles"]]).replace("_", " ")
        rows.append(
            [
                each.name, str(about["cases"]), profiles, str(settings["repeats"]), str(settings["seed"]),
                str(about["worlds"]), went, about["engine"], about.get("code", MISSING), said(settings["values"]),
                f"{about['wall_seconds']:.0f} s", about["started"][:16].replace("T", " "),
            ]
        )  # fmt: skip
    headings = ["experiment", "cases", "profiles", "repeats", "seed", "worlds", "went", "engine", "code",
                "parameters", "took", "on"]  # fmt: skip
    yield table(headings, rows, "lrlrrrllllrl")
    for each in chosen:
        if content["experiments"][each.name]["settings"]["quick"]:
            yield f"- {each.name} was a quick run: {each.quick}."
    shift = f"{1e3 * START_SPREAD['start.x']:g} mm, {math.degrees(START_SPREAD['start.yaw']):g} degree"
    yield (
        f"- Repeats differ by a seeded shift of the start: at most {shift} and {START_SPREAD['start.phase']:g} of a "
        "gait cycle; in the balance test, of pose and servo angles. All profiles have the same starts."
    )
    for command in dict.fromkeys(content["experiments"][each.name]["command"] for each in chosen):
        yield f"- Command: `{command}`"
    yield f"- Versions of the latest run: {listed(content['versions'])}"
    yield f"- Machine of the latest run: {listed(content['machine'])}\n"


def _conventions(content: Mapping[str, Any]) -> Iterator[str]:
    yield "## Conventions\n"
    for name, text in content["set_ups"].items():
        yield f"- Author's model, `{name}`: {text}."
    yield (
        "- Angles in degrees, lengths in millimetres or metres, as each heading says; the tables in `results/` and the "
        "recordings have SI units and radians.\n"
        "- Positive pitch is nose down, positive roll leans left, positive yaw turns left.\n"
        "- Published times and speeds are those of the controller's clock. In the profile as published that clock runs "
        f"{1 / PUBLISHED_CLOCK_RATIO:g} times too fast: the tables of figures convert to it; the tables of cases and "
        "the files have simulated time; plots say which they show.\n"
        "- std is the standard deviation over time, amplitude half the range from the least to the largest angle.\n"
        "- No constant is chosen for a case. What the publication does not give (contact, servo gains, damping) is "
        "the same in all experiments."
    )


def _anchor(title: str) -> str:
    """The link target that GitHub gives a heading."""
    return "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c == "-")
