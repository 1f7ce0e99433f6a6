"""The files of an identification, and its page.

The directory contains:

    identification.json           estimates and sentences
    report.html, plots/           page and figures
    identified.xml                identified model of an MJCF
    ensemble.csv                  parameter sets of Nermo, for `--body` and `randomize: {from: DIR}`
    next.npz or next.csv          commands of the proposed experiment
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel

from nermo_mjx.identify import determinacy
from nermo_mjx.identify.body import MjcfBody, NermoBody
from nermo_mjx.identify.determinacy import percent
from nermo_mjx.identify.estimation import INTERVAL_QUANTILES
from nermo_mjx.identify.identification import Identification
from nermo_mjx.identify.proposal import COMMAND_TIMES, MAX_REMAINING_SHARE, propose_experiment
from nermo_mjx.plotting.charts import blank_page
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.style import BAND_COLOUR, BEST_COLOUR, INK, LINE_COLOUR, MUTED_INK
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.runs.files import (
    DirectoryError,
    content_of,
    make_writable,
    replace_file,
    stored_json,
    to_json,
)

if TYPE_CHECKING:
    from nermo_mjx.view.page import Page

RESULT: Final = "identification.json"
#: Number of parameter sets in ensemble.csv, and of posterior samples in the band of a figure.
ENSEMBLE_SIZE: Final = 64
BAND_BODIES: Final = 24


def reject_figures(out: Path) -> NoReturn:
    """Raise `DirectoryError`, because a directory does not contain the curves of its figures."""
    raise DirectoryError(
        f"{out / 'plots'} has the figures: only the command that made {out} draws them."
    )


def estimates(identification: Identification) -> dict[str, dict[str, Any]]:
    """The estimates in identification.json: name of a parameter -> its fields."""
    fit = identification.fit
    return {
        parameter.name: {
            "unit": parameter.unit, "kind": parameter.kind, "start": parameter.value, "value": identification.values[i],
            "interval": list(identification.intervals[i]), "determined": bool(fit.determined[i]),
            "at_bound": fit.at_bound[i], "low": parameter.low, "high": parameter.high, "why": parameter.why,
        }
        for i, parameter in enumerate(fit.space.parameters)
    }  # fmt: skip


ESTIMATE_HEADINGS: Final = ("parameter", "", "start", "value", "90 %", "range and its reason")


def estimate_rows(estimates: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Rows of the parameters in identification.json, under `ESTIMATE_HEADINGS`."""
    rows = []
    for name, estimate in estimates.items():
        determinacy = "determined" if estimate["determined"] else "not determined"
        determinacy += f", at its {estimate['at_bound']} bound" if estimate["at_bound"] else ""
        label = f"{name} [{estimate['unit']}]" if estimate["unit"] != "1" else name
        interval = " to ".join(f"{end:.4g}" for end in estimate["interval"])
        numbers = [f"{estimate['start']:.4g}", f"{estimate['value']:.4g}", interval]
        rows.append(
            [
                label,
                determinacy,
                *numbers,
                f"{estimate['low']:.3g} to {estimate['high']:.3g}: {estimate['why']}",
            ]
        )
    return rows


def write_identification(identification: Identification, out: Path, command: str) -> dict[str, Any]:
    """Write the directory, and return the content of identification.json.

    Args:
        identification: Result of `identify_log`.
        out: Directory.
        command: Command that reproduces the result.
    """
    make_writable(out)
    name, remaining, commands = propose_experiment(identification)
    proposed = _write_commands(identification, commands, out) if commands else ""
    sentences = identification.sentences()
    if remaining < MAX_REMAINING_SHARE:
        sentences.append(
            f"To measure next: {name} ({proposed}) leaves {percent(remaining)} of the least known direction."
        )
    else:
        sentences.append(
            "No motion of the servos that was tried tells more of the least known direction."
        )
    files = _write_body(identification, out)
    judged = identification.after.evaluation
    content = {
        "command": command,
        "logs": list(dict.fromkeys(Path(log.file).name for log in identification.after.twin.logs)),
        "sentences": sentences,
        "right": identification.right,
        "parameters": estimates(identification),
        "combinations": {formula: deviation for formula, deviation, _ in determinacy.find_combinations(identification.fit)},
        "singular_values": np.sqrt(np.maximum(1.0 / np.maximum(identification.fit.share, 1e-12) ** 2 - 1.0, 0.0)).tolist(),
        "left_out": list(identification.left_out),
        "missing": dict(identification.missing),
        "errors": dict(identification.errors),
        "repeatability": dict(identification.repeatability),
        "channels": {
            label: {"rms": judged.rms[i], "noise": judged.noise[i], "before": identification.before.evaluation.rms[i]}
            for i, label in enumerate(identification.after.twin.labels)
        },
        "next": {"name": name, "left": remaining, "file": proposed},
        "files": files,
        "wall_seconds": identification.seconds,
    }  # fmt: skip
    replace_file(out / RESULT, to_json(content))
    write_figures(figures_of(identification), out / "plots")
    replace_file(out / "report.html", identification_page(out).html.encode())
    return content


class Estimate(BaseModel):
    """A parameter in identification.json."""

    unit: str
    start: float
    value: float
    interval: tuple[float, float]
    determined: bool
    at_bound: str
    low: float
    high: float
    why: str


class Report(BaseModel):
    """The part of identification.json that the page shows."""

    command: str
    logs: list[str]
    sentences: list[str]
    parameters: dict[str, Estimate]


def identification_page(out: Path) -> Page:
    """The page of a complete identification: sentences, estimates, command, and figures.

    Raises:
        DirectoryError: The identification is not complete, or its file is damaged.
    """
    from nermo_mjx.view.page import Page
    from nermo_mjx.view.trained import image, offline_page  # `view` imports this subpackage

    report = stored_json(out / RESULT, Report)
    if report is None:
        raise DirectoryError(
            f"{out} contains no complete identification: run the same command again."
        )
    verdict = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in report["sentences"])
    parts = [
        f"<h2>Verdict</h2>{verdict}",
        f"<h2>Parameters</h2>{_html_table(ESTIMATE_HEADINGS, estimate_rows(report['parameters']))}",
        f"<h2>To make it again</h2><pre>{html.escape(report['command'])}</pre>",
        *(image(name, content_of(out / "plots" / f"{name}.svg") or b"") for name in FIGURES),
    ]
    title = f"What {', '.join(report['logs'])} says of the robot"
    return Page(offline_page(html.escape(title), "an identification", parts, ()), 680)


def _html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table; the text in its last column wraps."""
    wrapped = ' style="text-align: left; white-space: normal"'
    cells = ""
    for row in rows:
        *shown_cells, reason = map(html.escape, row)
        cells += f"<tr>{''.join(f'<td>{cell}</td>' for cell in shown_cells)}<td{wrapped}>{reason}</td></tr>"
    head = (
        "".join(f"<th>{cell}</th>" for cell in headings[:-1]) + f"<th{wrapped}>{headings[-1]}</th>"
    )
    return f'<div class="wide"><table><tr>{head}</tr>{cells}</table></div>'


def _write_commands(
    identification: Identification, commands: Mapping[str, np.ndarray], out: Path
) -> str:
    """Write the commands of an experiment, and return the name of the file.

    The file of Nermo is a recording for `servos`, the file of another robot is a table.
    """
    if isinstance(identification.body, NermoBody):
        model = identification.body.model
        ctrl = np.zeros((len(COMMAND_TIMES), model.nu))
        for name, values in commands.items():
            ctrl[:, identification.body.actuator(name)] = values
        still = np.repeat(identification.body.rest_positions()[None], len(COMMAND_TIMES), axis=0)
        Recording(COMMAND_TIMES, still, np.zeros((len(COMMAND_TIMES), model.nv)), ctrl).save(
            out / "next.npz"
        )
        return "next.npz"
    rows = [
        ["time", *commands],
        *np.column_stack([COMMAND_TIMES, *commands.values()]).round(6).astype(str).tolist(),
    ]
    replace_file(out / "next.csv", "".join(",".join(row) + "\n" for row in rows).encode())
    return "next.csv"


def _write_body(identification: Identification, out: Path) -> list[str]:
    """Write the identified model, and return the names of the files.

    The file of Nermo is an ensemble for `nermo_mjx.robot.identified`, the best parameter set first.
    """
    names = [parameter.name for parameter in identification.fit.space.parameters]
    if isinstance(identification.body, MjcfBody):
        replace_file(
            out / "identified.xml",
            identification.body.mjcf_text(names, identification.values).encode(),
        )
        return ["identified.xml"]
    nermo_names = [name for name in dict(quantities(ModelParameters)) if name in names]
    columns = [names.index(name) for name in nermo_names]
    fixed = {
        name: value
        for name, value in identification.body.robot_values.items()
        if name not in nermo_names
    }
    bodies = np.vstack(
        [
            identification.values,
            identification.bodies[:: max(len(identification.bodies) // (ENSEMBLE_SIZE - 1), 1)][
                : ENSEMBLE_SIZE - 1
            ],
        ]
    )
    values = dict(zip(nermo_names, bodies[:, columns].T, strict=True))
    values |= {name: np.full(len(bodies), value) for name, value in fixed.items()}
    comment = (
        "Bodies drawn from the posterior of an identification from a log; the first is the best."
    )
    replace_file(out / "ensemble.csv", ensemble_text(comment, values, np.ones(len(bodies))))
    return ["ensemble.csv"]


def ensemble_text(comment: str, values: Mapping[str, np.ndarray], objective: np.ndarray) -> bytes:
    """Content of a file for `nermo_mjx.robot.identified`: parameter sets of equal weight, the best first.

    Args:
        comment: Comment at the head of the file.
        values: Name of a model parameter -> its values (n,).
        objective: Objective of each parameter set (n,).
    """
    columns = {
        **values,
        "objective": objective,
        "weight": np.full(len(objective), 1 / len(objective)),
    }
    rows = [
        ",".join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True)
    ]
    return "\n".join(
        [*(f"# {line}" for line in comment.splitlines()), ",".join(columns), *rows, ""]
    ).encode()


def figures_of(identification: Identification) -> Iterator[tuple[str, Figure]]:
    """The figures of a result, by name."""
    yield from ((name, draw(identification)) for name, draw in FIGURES.items())


def _draw_predictions(identification: Identification, limit: int = 6) -> Figure:
    """Draw measured and predicted curves of the validation samples, with a band of the posterior."""
    twin = identification.after.twin
    predictions = twin.predict(
        identification.bodies[:: max(len(identification.bodies) // BAND_BODIES, 1)][:BAND_BODIES]
    )
    low, high = np.quantile(predictions, INTERVAL_QUANTILES, axis=0)
    best = twin.measured.values + identification.after.residual
    initial_prediction = twin.measured.values + identification.before.residual
    units = {channel.name: channel.unit for log in twin.logs for channel in log.channels}
    worst = np.argsort(
        -identification.after.evaluation.rms / identification.after.evaluation.noise
    )[:limit]
    figure = blank_page(
        "Predicted and measured, where nothing was fitted", 7.5, 1.0 + 1.35 * len(worst),
        f"Band: 90 % of {BAND_BODIES} bodies of the posterior, without the sensors' noise; the channels that fit worst.",
    )  # fmt: skip
    for ax, i in zip(
        figure.subplots(len(worst), 1, sharex=True, squeeze=False)[:, 0], worst, strict=True
    ):
        rows = np.flatnonzero(twin.measured.channel == i)
        rows = rows[twin.measured.time[rows] < twin.measured.time[rows[0]] + 3.0]
        rows = rows[:: twin.components[i]]
        time = twin.measured.time[rows]
        ax.plot(time, twin.measured.values[rows], ".", ms=2.5, color=INK, label="measured")
        ax.fill_between(time, low[rows], high[rows], color=BAND_COLOUR, lw=0, alpha=0.7)
        ax.plot(
            time, initial_prediction[rows], color=MUTED_INK, lw=0.9, ls="--", label="default body"
        )
        ax.plot(time, best[rows], color=LINE_COLOUR, lw=1.2, label="identified")
        ax.set_title(
            f"{twin.labels[i]}{' x' * (twin.components[i] > 1)} [{units[twin.labels[i]]}]",
            loc="left",
        )
    ax.set_xlabel("time [s]")
    figure.axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def _draw_residuals(identification: Identification) -> Figure:
    """Draw the residuals of the validation samples, relative to the noise of each channel."""
    labels, judged = identification.after.twin.labels, identification.after.evaluation
    figure = blank_page(
        "Residuals where nothing was fitted, in the noise of each channel",
        7.0,
        1.7 + 0.25 * len(labels),
    )
    ax, y = figure.subplots(), np.arange(len(labels))
    for shift, residual, colour, label in (
        (-0.18, identification.before.evaluation.rms, BAND_COLOUR, "default body"),
        (0.18, judged.rms, LINE_COLOUR, "identified"),
    ):
        ax.barh(y + shift, residual / judged.noise, 0.36, color=colour, label=label)
    ax.axvline(1.0, color=BEST_COLOUR, lw=0.9, label="noise")
    ax.set_yticks(y, labels)
    ax.set(xscale="log", xlabel="root mean square [noise]", ylim=(len(labels) - 0.4, -0.6))
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def _draw_intervals(identification: Identification) -> Figure:
    """Draw the 90 % intervals within the ranges of the parameters."""
    space, fit = identification.fit.space, identification.fit
    span = space.high - space.low
    low, high = (
        [getattr(parameter, end) for parameter in space.parameters] for end in ("low", "high")
    )
    ends = (space.coordinates(np.clip(identification.intervals.T, low, high)) - space.low) / span
    figure = blank_page(
        "90 % intervals in the ranges that were searched", 7.0, 1.2 + 0.2 * len(space)
    )
    ax, y = figure.subplots(), np.arange(len(space))
    colours = [LINE_COLOUR if is_determined else BAND_COLOUR for is_determined in fit.determined]
    ax.hlines(y, *ends, color=colours, lw=4)
    ax.plot((fit.x - space.low) / span, y, "|", color=INK)
    ax.set_yticks(y, [parameter.name for parameter in space.parameters])
    ax.set(
        xlim=(-0.02, 1.02),
        ylim=(len(space) - 0.4, -0.6),
        xlabel="share of the range (dark: determined)",
    )
    return figure


#: The figures by name.
FIGURES: Final = {
    "predicted": _draw_predictions,
    "residuals": _draw_residuals,
    "intervals": _draw_intervals,
}
