"""report.md: the report for readers, with the plots, theory next to simulation, and the settings of the runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

from nermo_mjx.control.published import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.judgement import AGREES
from nermo_mjx.experiments.line import KINDS
from nermo_mjx.experiments.report import HEADINGS, cells, collect, published
from nermo_mjx.experiments.settings import said
from nermo_mjx.experiments.table import case_tables
from nermo_mjx.runs import Written
from nermo_mjx.runs.text import MISSING, listed, table, to_json
from nermo_mjx.sweep.spec import START_SPREAD

if TYPE_CHECKING:
    from nermo_mjx.experiments.catalogue import Experiment
    from nermo_mjx.experiments.directory import Directory

_SOURCE: Final = 'A. Rohregger, "Digital Nermo", Master\'s thesis, TU Munich, December 2021, chapters 6 and 7'
_COUNTS: Final = ("lines", "hold", "do_not_hold", "not_measured")
_MEANING: Final = {
    "predicted": "not used in any decision about the twin",
    "chosen": "something was decided with it in view",
    "fitted": "a term of the identification, or decided by those",
    "theory": "formula against formula; nothing is simulated",
}


def write(directory: Directory, experiments: Mapping[str, Experiment], written: Written) -> None:
    """Write the report of all experiments that the directory holds."""
    content = collect(directory, experiments)
    written.write(directory.out / "report.json", to_json(content))
    written.write(directory.out / "report.md", page(directory, content, experiments).encode())


def page(directory: Directory, content: Mapping[str, Any], experiments: Mapping[str, Experiment]) -> str:
    """The text of report.md.

    Args:
        directory: whose tables give the cases.
        content: of report.json.
        experiments: in the order of the report.
    """
    chosen = [experiments[name] for name in content["experiments"]]
    parts = ["# The published experiments, simulated again\n", *_summary(content, chosen)]
    for experiment in chosen:
        parts += _experiment(directory, content, experiment)
    parts += [*_what_was_run(content, chosen), *_conventions()]
    return "\n".join(parts).rstrip() + "\n"


def _summary(content: Mapping[str, Any], chosen: list[Experiment]) -> Iterator[str]:
    summary = content["summary"]
    predicted = summary["by_kind"].get("predicted", {"hold": 0, "do_not_hold": 0})
    yield (
        f"**{predicted['hold']} of {_judged(predicted)} predicted figures hold**, and {summary['hold']} of "
        f"{_judged(summary)} figures in all. Only predicted lines count as evidence. Published figures: {_SOURCE}.\n"
    )
    rows = [
        [kind, _MEANING[kind], *(str(summary["by_kind"][kind][name]) for name in _COUNTS)]
        for kind in KINDS
        if kind in summary["by_kind"]
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
        "- **as published**: the simulation as the publication's software ran it (feet that lag, a clock 2.5 times too "
        "fast).\n- **exact**: as its text describes it (closed-form kinematics, one clock).\n- **ratio**: exact over "
        "published; of an effect, its size over the published one; for an interval, over its nearer end.\n- **holds**: "
        f"a number is within {AGREES:.0%} of the published one. An effect, a ratio that says how much something "
        f"changes, is judged on its size, the ratio less 1: within {AGREES:.0%} of the published size, or half a unit "
        "of the last digit. A bound or a range is not widened; a trend or an outcome is the published one.\n"
        "- **ensemble**: share of the identified bodies in which the line holds.\n"
    )
    quick = [each.title for each in chosen if content["experiments"][each.name]["settings"]["quick"]]
    if quick:
        yield f"> **A quick run** of {', '.join(quick)}: fewer cases, and other figures than a full run's.\n"
    changed = {each.title: content["experiments"][each.name]["settings"]["values"] for each in chosen}
    for title, values in changed.items():
        if values:
            yield f"> {title} was run with other parameters than the default: {said(values)}.\n"
    for each in chosen:
        if walker := content["experiments"][each.name]["settings"].get("controller"):
            yield f"> In {each.title}, {walker} walked in place of the published controller, upon which it acts.\n"
    for sentence in content["differences"]:
        yield f"> **Run in different ways.** {sentence}\n"


def _judged(counts: Mapping[str, Any]) -> int:
    return int(counts["hold"] + counts["do_not_hold"])


def _held(counts: Mapping[str, Any] | None) -> str:
    """Number of lines that hold, out of all."""
    return f"{counts['hold']} of {_judged(counts)}" if counts else MISSING


def _experiment(directory: Directory, content: Mapping[str, Any], experiment: Experiment) -> Iterator[str]:
    about = content["experiments"][experiment.name]
    lines = [line for line in content["lines"] if line["experiment"] == experiment.name]
    yield f"## {experiment.title}\n"
    yield experiment.description + "\n"
    rows = []
    for line in lines:
        *texts, holds, share = cells(line)
        rows.append([*texts, "**no**" if holds == "no" else holds, share, line["source"]])
    headings = [name for name, _ in HEADINGS]
    yield table([*headings, "source"], rows, "llrrrrlrl")
    if about.get("bodies"):
        yield f"Ensemble: {about['bodies']} identified bodies, once each in the profile exact.\n"
    yield from _reasons(lines, about["settings"]["quick"])
    stored = directory.load(experiment.name)
    if stored is not None:
        yield "### Simulation and theory\n"
        yield "Mean ± standard deviation over the repeats, in simulated time.\n"
        for cases in case_tables(stored.outcome, experiment.metrics, experiment.needs):
            title = f"{cases.profile.replace('_', ' ')}, {len(cases.rows)} cases"
            yield f"<details><summary>{title}</summary>\n"
            yield table(cases.headings, cases.rows, cases.sides)
            yield "</details>\n"
    yield from _files(about, experiment)


def _reasons(lines: list[Mapping[str, Any]], quick: bool) -> Iterator[str]:
    failing = [line for line in lines if line["holds"] is False]
    if not failing:
        return
    yield "What does not hold, and why:\n" if not quick else "What does not hold (reasons are those of a full run):\n"
    for line in failing:
        demanded = line["demanded"]
        asked = f" (demanded: {published(demanded)})" if demanded else ""
        yield f"- **{line['figure']}**{asked}: {line['reason'] or 'no reason is known.'}"
    yield ""


def _files(about: Mapping[str, Any], experiment: Experiment) -> Iterator[str]:
    plots = [PurePosixPath(path) for path in about["plots"]]
    for path in plots:
        if path.suffix == ".png":
            caption = path.stem.removeprefix(f"{experiment.name}-").replace("-", " ")
            yield f"![{experiment.title}: {caption}]({path})\n"
    for video in about["videos"]:
        pace = "in real time" if video["speed"] == 1 else f"{video['speed']:g} times as fast as real time"
        yield f"Video: [{video['file']}]({video['file']}), {video['shows']}, {pace}.\n"
    yield from (f"{note}\n" for note in about["notes"])
    links = [f"[{about['table']}]({about['table']})", *(f"[{path}]({path})" for path in about["recordings"])]
    yield f"Every world: {links[0]}." + (f" Recordings: {', '.join(links[1:])}." if links[1:] else "") + "\n"


def _what_was_run(content: Mapping[str, Any], chosen: list[Experiment]) -> Iterator[str]:
    yield "## What was run\n"
    rows = []
    for each in chosen:
        about = content["experiments"][each.name]
        settings = about["settings"]
        went = ", ".join(f"{count} {status}" for status, count in about["status"].items()) or "–"
        rows.append(
            [
                each.name, str(about["cases"]), said(settings["profiles"]).replace("_", " "), str(settings["repeats"]),
                str(settings["seed"]), str(about["worlds"]), went, about["engine"], about.get("code", MISSING),
                said(settings["values"]), f"{about['wall_seconds']:.0f} s", _moment(about["started"]),
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
        "gait cycle; in the balance test, of pose and servo angles. Both profiles have the same starts."
    )
    for command in dict.fromkeys(content["experiments"][each.name]["command"] for each in chosen):
        yield f"- Command: `{command}`"
    yield f"- Versions of the latest run: {listed(content['versions'])}"
    yield f"- Machine of the latest run: {listed(content['machine'])}\n"


def _conventions() -> Iterator[str]:
    yield "## Conventions\n"
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


def _moment(started: str) -> str:
    """2026-11-21T12:42:33+0000 for a reader."""
    return started[:16].replace("T", " ")


def _anchor(title: str) -> str:
    """The link target that GitHub gives a heading."""
    return "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c == "-")
