"""The directory of an identification from logs, its report, and what to measure next.

It holds identification.json, report.html, plots, the identified model, for Nermo as ensemble.csv for `--body` and
`randomize: {from: DIR}`, and the commands of the experiment that would tell most.
"""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel

from nermo_mjx.experiments import determinacy
from nermo_mjx.experiments.determinacy import Estimation, Kept, percent
from nermo_mjx.experiments.log_identification import Identification
from nermo_mjx.experiments.log_twin import LoggedTwin, MjcfBody, NermoBody
from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.table import servo_table
from nermo_mjx.plotting.charts import page as blank_page
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.style import BAND_COLOUR, BEST_COLOUR, INK, LINE_COLOUR, MUTED_INK
from nermo_mjx.recording import Recording
from nermo_mjx.robot import ModelParameters
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout import Setup
from nermo_mjx.runs.directory import engine_of
from nermo_mjx.runs.files import DirectoryError, make_writable, replace_file, stored_json, to_json
from nermo_mjx.runs.status import Status, last_command

RESULT: Final = "identification.json"
#: What is kept for a resume.
STEPS: Final = "steps.json"
#: Bodies in ensemble.csv, and draws in the posterior predictive check.
BODIES: Final = 64
SHOWN: Final = 24

# --- what to measure next

#: Duration of an experiment that is proposed, and its rate of commands [s, Hz].
LASTS: Final = 6.0
RATE: Final = 50.0
#: Times of its commands [s].
TIMES: Final = np.arange(round(LASTS * RATE)) / RATE
#: An experiment that leaves more of the least known direction is not worth its time.
USEFUL: Final = 0.9
#: Amplitude and range of frequencies of a chirp [rad, Hz].
SWING: Final = 0.2
SWEPT: Final = (0.2, 4.0)


def _excitations(found: Identification) -> dict[str, dict[str, np.ndarray]]:
    """Experiments by name: commands of each servo at `RATE`."""
    body, log = found.body, found.after.twin.logs[0]
    names = [each.of for each in log.channels if each.quantity == "command"]
    rest = {name: np.asarray(log.channel("command", name).values) for name in names}  # type: ignore[union-attr]
    begun = np.clip(TIMES / 0.5, 0.0, 1.0) * np.clip((LASTS - TIMES) / 0.5, 0.0, 1.0)
    middle = {name: float(np.median(values)) for name, values in rest.items()}

    def chirp(
        chosen: Sequence[str], factor: float = 1.0, wave: Any = np.sin
    ) -> dict[str, np.ndarray]:
        """Of these servos, one after the other in phase; the others stand."""
        turned = (
            2 * np.pi * factor * (SWEPT[0] * TIMES + (SWEPT[1] - SWEPT[0]) * TIMES**2 / (2 * LASTS))
        )
        made = {name: np.full(len(TIMES), middle[name]) for name in names}
        for i, name in enumerate(chosen):
            limits = body.model.actuator_ctrlrange[body.actuator(name)]
            swing = middle[name] + SWING * begun * wave(turned + 2.4 * i)
            made[name] = np.clip(swing, *limits) if limits[1] > limits[0] else swing
        return made

    worst = np.abs(found.fit.directions[:, int(np.argmax(found.fit.share))])
    parts = [found.fit.space.parameters[int(i)].name.split(".")[-1] for i in np.argsort(-worst)[:3]]
    near = [
        name for name in names if any(part in (name, f"{name}_servo") for part in parts)
    ] or names[:2]
    made = {f"chirp of {name}": chirp([name]) for name in near[:3]}
    again = {
        name: np.interp(TIMES, log.channel("command", name).times, values)  # type: ignore[union-attr]
        for name, values in rest.items()
    }
    if isinstance(body, NermoBody):  # a walk at 1 Hz, as `servos` plays it
        table = servo_table(
            Setup(robot=body.robot), {"frequency": 1.0}, rate=RATE, cycles=round(LASTS)
        )
        angles = dict(zip(table.names, np.radians(table.angles.T), strict=True))
        made["a walk"] = {
            name: middle[name] + begun * (angles[name] - middle[name]) for name in names
        }
    return made | {
        "slow chirp of all servos": chirp(names, 0.25),
        "steps of all servos, which push the robot": chirp(
            names, 0.25, lambda phase: np.sign(np.sin(phase))
        ),
        "chirp of all servos": chirp(names),
        "the same commands again": again,
    }


def next_experiment(found: Identification) -> tuple[str, float, dict[str, np.ndarray]]:
    """The experiment that shrinks the least known direction most.

    Returns:
        Its name, the share of the direction's deviation that is left after it, and its commands at `RATE`.
    """
    fit, best = found.fit, ("", 1.0, dict[str, np.ndarray]())
    log = found.after.twin.logs[0]
    for name, commands in _excitations(found).items():
        channels = [Channel(n, "command", n, TIMES, values) for n, values in commands.items()]
        for each in log.channels:
            if each.name in found.fitted.twin.labels:
                at = np.arange(0.0, LASTS, max(each.interval, 1e-3))
                channels.append(
                    dataclasses.replace(
                        each, times=at, values=np.zeros((len(at), *each.values.shape[1:]))
                    )
                )
        names = [each.name for each in fit.space.parameters]
        twin = LoggedTwin(found.body, [Log(tuple(channels), name)], names)
        tried = Estimation(fit.space, twin)
        order = [found.fitted.twin.labels.index(label) for label in twin.labels]
        left = determinacy.contribution(tried.jacobian(fit.x, fit.sigma[order]), fit)
        if left < best[1]:
            best = (name, left, commands)
    return best


# --- a directory


class KeptSteps(BaseModel):
    """The file of them: what decides the arrays, and these in their order."""

    decides: str
    arrays: list[list[float | None] | list[list[float | None]]]


def kept_in(out: Path, decides: str) -> Kept:
    """Keeps arrays in their order in a directory, so that what was killed goes on after the last; see `Estimation`.

    Args:
        out: the directory.
        decides: what decides the arrays: those of something else are not taken.
    """
    held = stored_json(out / STEPS, KeptSteps)
    try:
        known = [
            np.array(each, float)
            for each in (held["arrays"] if held and held["decides"] == decides else ())
        ]
    except ValueError:  # damaged: rows of unequal length
        known = []
    left = iter(known.copy())

    def kept(compute: Callable[[], np.ndarray]) -> np.ndarray:
        if (found := next(left, None)) is not None:
            return found
        known.append(compute())
        replace_file(
            out / STEPS, to_json({"decides": decides, "arrays": [each.tolist() for each in known]})
        )
        return known[-1]

    return kept


def identification_status(out: Path) -> Status:
    """How far the identification in a directory is."""
    held, complete = stored_json(out / STEPS, KeptSteps), (out / RESULT).exists()
    done = len(held["arrays"]) if held else 0
    return Status(
        "steps",
        done,
        done if complete else None,
        complete,
        last_command(out),
        engine_of(out) or "c",
    )


def kept_figures(out: Path) -> NoReturn:
    """Raise `DirectoryError`: they are of curves that a directory does not keep."""
    raise DirectoryError(
        f"{out / 'plots'} has the figures: only the command that made {out} draws them."
    )


def estimates(found: Identification) -> dict[str, dict[str, Any]]:
    """What identification.json says of the parameters."""
    fit = found.fit
    return {
        each.name: {
            "unit": each.unit, "kind": each.kind, "start": each.value, "value": found.values[i],
            "interval": list(found.intervals[i]), "determined": bool(fit.determined[i]),
            "at_bound": fit.at_bound[i], "low": each.low, "high": each.high, "why": each.why,
        }
        for i, each in enumerate(fit.space.parameters)
    }  # fmt: skip


def estimate_rows(found: Identification) -> list[list[str]]:
    """Rows under `HEADINGS`."""
    fit, rows, bounds = found.fit, [], found.fit.at_bound
    for i, each in enumerate(fit.space.parameters):
        low, high = found.intervals[i]
        known = "determined" if fit.determined[i] else "not determined"
        known += f", at its {bounds[i]} bound" if bounds[i] else ""
        name = f"{each.name} [{each.unit}]" if each.unit != "1" else each.name
        numbers = [f"{each.value:.4g}", f"{found.values[i]:.4g}", f"{low:.4g} to {high:.4g}"]
        rows.append([name, known, *numbers, f"{each.low:.3g} to {each.high:.3g}: {each.why}"])
    return rows


HEADINGS: Final = ("parameter", "", "start", "value", "90 %", "range and its reason")


def write_identification(found: Identification, out: Path, command: str) -> dict[str, Any]:
    """Write the directory, and return the content of identification.json.

    Args:
        found: the result.
        out: the directory.
        command: that makes it again.
    """
    make_writable(out)
    name, left, commands = next_experiment(found)
    proposed = _written_commands(found, commands, out) if commands else ""
    sentences = found.sentences()
    if left < USEFUL:
        sentences.append(
            f"To measure next: {name} ({proposed}) leaves {percent(left)} of the least known direction."
        )
    else:
        sentences.append(
            "No motion of the servos that was tried tells more of the least known direction."
        )
    files = _written_body(found, out)
    judged = found.after.judgement
    content = {
        "command": command,
        "sentences": sentences,
        "right": found.right,
        "parameters": estimates(found),
        "combinations": {formula: deviation for formula, deviation, _ in determinacy.combinations(found.fit)},
        "singular_values": np.sqrt(np.maximum(1.0 / np.maximum(found.fit.share, 1e-12) ** 2 - 1.0, 0.0)).tolist(),
        "left_out": list(found.left_out),
        "missing": dict(found.missing),
        "errors": dict(found.errors),
        "repeatability": dict(found.repeatability),
        "channels": {
            label: {"rms": judged.rms[i], "noise": judged.noise[i], "before": found.before.judgement.rms[i]}
            for i, label in enumerate(found.after.twin.labels)
        },
        "next": {"name": name, "left": left, "file": proposed},
        "files": files,
        "wall_seconds": found.seconds,
    }  # fmt: skip
    replace_file(out / RESULT, to_json(content))
    figures = list(figures_of(found))
    write_figures(figures, out / "plots")
    logs = ", ".join(dict.fromkeys(Path(each.file).name for each in found.after.twin.logs))
    title = f"What {logs} says of the robot"
    page = identification_page(title, sentences, found, command, figures)
    replace_file(out / "report.html", page)
    return content


def identification_page(
    title: str, sentences: Sequence[str], found: Identification, command: str, figures: Figures
) -> bytes:
    """The page of an identification: its verdict, estimates, the command, and figures."""
    from nermo_mjx.view.trained import offline_page  # views know of experiments, too

    said = "".join(f"<p>{html.escape(each)}</p>" for each in sentences)
    made = [
        f"<h2>Verdict</h2>{said}",
        f"<h2>Parameters</h2>{html_table(HEADINGS, estimate_rows(found))}",
        f"<h2>To make it again</h2><pre>{html.escape(command)}</pre>",
    ]
    return offline_page(html.escape(title), "an identification", made, figures).encode()


def html_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose last column is text that is wrapped."""
    wrapped = ' style="text-align: left; white-space: normal"'
    cells = ""
    for row in rows:
        *shown, reason = map(html.escape, row)
        cells += (
            f"<tr>{''.join(f'<td>{each}</td>' for each in shown)}<td{wrapped}>{reason}</td></tr>"
        )
    head = (
        "".join(f"<th>{each}</th>" for each in headings[:-1]) + f"<th{wrapped}>{headings[-1]}</th>"
    )
    return f'<div class="wide"><table><tr>{head}</tr>{cells}</table></div>'


def _written_commands(found: Identification, commands: Mapping[str, np.ndarray], out: Path) -> str:
    """The file of an experiment: a recording that `servos` plays, or for another robot a table."""
    if isinstance(found.body, NermoBody):
        model = found.body.model
        ctrl = np.zeros((len(TIMES), model.nu))
        for name, values in commands.items():
            ctrl[:, found.body.actuator(name)] = values
        still = np.repeat(found.body.start()[None], len(TIMES), axis=0)
        Recording(TIMES, still, np.zeros((len(TIMES), model.nv)), ctrl).save(out / "next.npz")
        return "next.npz"
    rows = [
        ["time", *commands],
        *np.column_stack([TIMES, *commands.values()]).round(6).astype(str).tolist(),
    ]
    replace_file(out / "next.csv", "".join(",".join(row) + "\n" for row in rows).encode())
    return "next.csv"


def _written_body(found: Identification, out: Path) -> list[str]:
    """The file of the identified model; for Nermo the ensemble, the best body first, as `identified` reads it."""
    names = [each.name for each in found.fit.space.parameters]
    if isinstance(found.body, MjcfBody):
        replace_file(out / "identified.xml", found.body.written(names, found.values).encode())
        return ["identified.xml"]
    known = [name for name in dict(quantities(ModelParameters)) if name in names]
    columns = [names.index(name) for name in known]
    fixed = {name: value for name, value in found.body.standing.items() if name not in known}
    bodies = np.vstack(
        [found.values, found.bodies[:: max(len(found.bodies) // (BODIES - 1), 1)][: BODIES - 1]]
    )
    values = dict(zip(known, bodies[:, columns].T, strict=True))
    values |= {name: np.full(len(bodies), value) for name, value in fixed.items()}
    about = (
        "Bodies drawn from the posterior of an identification from a log; the first is the best."
    )
    replace_file(out / "ensemble.csv", ensemble_text(about, values, np.ones(len(bodies))))
    return ["ensemble.csv"]


def ensemble_text(about: str, values: Mapping[str, np.ndarray], objective: np.ndarray) -> bytes:
    """A file that `nermo_mjx.robot.identified` reads, of bodies of equal weight, the best first.

    Args:
        about: lines of the comment that it begins with.
        values: model parameter -> (n,).
        objective: (n,).
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
        [*(f"# {line}" for line in about.splitlines()), ",".join(columns), *rows, ""]
    ).encode()


def figures_of(found: Identification) -> Iterator[tuple[str, Figure]]:
    """The figures of a result."""
    yield "predicted", _predicted(found)
    yield "residuals", _residuals(found)
    yield "intervals", intervals_figure(found)


def _predicted(found: Identification, most: int = 6) -> Figure:
    """Measured and predicted curves where nothing was fitted, with a band of the posterior."""
    twin = found.after.twin
    drawn = twin.predict(found.bodies[:: max(len(found.bodies) // SHOWN, 1)][:SHOWN])
    low, high = np.quantile(drawn, determinacy.ENDS, axis=0)
    best = twin.measured.values + found.after.residual
    before = twin.measured.values + found.before.residual
    units = {each.name: each.unit for log in twin.logs for each in log.channels}
    worst = np.argsort(-found.after.judgement.rms / found.after.judgement.noise)[:most]
    figure = blank_page(
        "Predicted and measured, where nothing was fitted", 7.5, 1.0 + 1.35 * len(worst),
        f"Band: 90 % of {SHOWN} bodies of the posterior, without the sensors' noise; the channels that fit worst.",
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
        ax.plot(time, before[rows], color=MUTED_INK, lw=0.9, ls="--", label="default body")
        ax.plot(time, best[rows], color=LINE_COLOUR, lw=1.2, label="identified")
        ax.set_title(
            f"{twin.labels[i]}{' x' * (twin.components[i] > 1)} [{units[twin.labels[i]]}]",
            loc="left",
        )
    ax.set_xlabel("time [s]")
    figure.axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def _residuals(found: Identification) -> Figure:
    labels, judged = found.after.twin.labels, found.after.judgement
    figure = blank_page(
        "Residuals where nothing was fitted, in the noise of each channel",
        7.0,
        1.7 + 0.25 * len(labels),
    )
    ax, y = figure.subplots(), np.arange(len(labels))
    for shift, of, colour, label in (
        (-0.18, found.before.judgement.rms, BAND_COLOUR, "default body"),
        (0.18, judged.rms, LINE_COLOUR, "identified"),
    ):
        ax.barh(y + shift, of / judged.noise, 0.36, color=colour, label=label)
    ax.axvline(1.0, color=BEST_COLOUR, lw=0.9, label="noise")
    ax.set_yticks(y, labels)
    ax.set(xscale="log", xlabel="root mean square [noise]", ylim=(len(labels) - 0.4, -0.6))
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return figure


def intervals_figure(found: Identification) -> Figure:
    """Intervals in the ranges of the parameters."""
    space, fit = found.fit.space, found.fit
    span = space.high - space.low
    low, high = ([getattr(each, end) for each in space.parameters] for end in ("low", "high"))
    ends = (space.coordinates(np.clip(found.intervals.T, low, high)) - space.low) / span
    figure = blank_page(
        "90 % intervals in the ranges that were searched", 7.0, 1.2 + 0.2 * len(space)
    )
    ax, y = figure.subplots(), np.arange(len(space))
    colours = [LINE_COLOUR if known else BAND_COLOUR for known in fit.determined]
    ax.hlines(y, *ends, color=colours, lw=4)
    ax.plot((fit.x - space.low) / span, y, "|", color=INK)
    ax.set_yticks(y, [each.name for each in space.parameters])
    ax.set(
        xlim=(-0.02, 1.02),
        ylim=(len(space) - 0.4, -0.6),
        xlabel="share of the range (dark: determined)",
    )
    return figure
