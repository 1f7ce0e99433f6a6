"""The commands that walk the robot, or only its controller: walk, drive, replay of a row, a table of servo angles."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import tempfile
import webbrowser
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ENGINES, PILOTS
from nermo_mjx.cli.logs import LOGS, log_channels, log_of, print_differences
from nermo_mjx.cli.options import assigned, number, text
from nermo_mjx.cli.output import Failure, Output, WrongUse, command, in_unit, print_table, say
from nermo_mjx.cli.view import load_recording, refuse_video, save_run
from nermo_mjx.progress import ProgressBar, is_given
from nermo_mjx.trust import only_reading

if TYPE_CHECKING:
    from nermo_mjx.control.schedule import Switch
    from nermo_mjx.rollout import Run, Setup


#: Options that set one parameter.
PARAMETER_OPTIONS = {
    "frequency": "frequency",
    "stride": "stride",
    "spine_amplitude": "spine.amplitude",
    "spine_phase": "spine.phase",
    "turn_rate": "pilot.turn_rate",
    "offset_compensation": "spine.offset_compensation",
}
DEFAULT_CYCLES, DEFAULT_WARMUP = 8.0, 2.0


class Plan(NamedTuple):
    """One run: its static choices, its length, and the values of parameters that the user gave."""

    setup: Setup
    run: Run
    values: Mapping[str, float]


def planned_walk(
    *,
    pilot: Any,
    assignments: tuple[str, ...],
    switches: tuple[str, ...] = (),
    seed: int | None = None,
    cycles: float | None = None,
    duration: float | None = None,
    warmup: float | None = None,
    **options: Any,
) -> Plan:
    """Join and check the options; raises `WrongUse` or `ParameterError`."""
    from nermo_mjx.control.spine_modes import mode_names
    from nermo_mjx.rollout import Setup, all_parameters
    from nermo_mjx.specs.walk import unread

    pilot = pilot or ("straight" if options["turn_rate"] is None else "open_loop")
    fields = {field.name for field in dataclasses.fields(Setup)}
    choices = {
        name: value for name, value in options.items() if name in fields and value is not None
    }
    choices["spine"] = "+".join(mode_names(choices["spine"])) or "none"
    setup = Setup(pilot=pilot, schedule=tuple(map(_switch, switches)), **choices)
    parameters = all_parameters(setup)
    values: dict[str, float] = {} if seed is None else _shifted_start(seed)
    for option, name in PARAMETER_OPTIONS.items():
        if options[option] is None:
            continue
        flag = f"--{option.replace('_', '-')}"
        if name not in parameters:
            raise WrongUse(f"{flag} sets {name}, which is not a parameter of {setup.controller}.")
        if requirement := unread(setup, name):
            choice, needed_choice = requirement
            raise WrongUse(
                f"{flag} has no effect with --{choice} {getattr(setup, choice)}: add --{choice} {needed_choice}."
            )
        values[name] = parameters[name].numbers(flag, options[option])
    values |= assigned(assignments, parameters)
    for name, value in values.items():
        parameters[name].check(name, value)
    return Plan(setup, _length(cycles, duration, warmup), values)


def _switch(text: str) -> Switch:
    """The switch of AT,NAME=X[,NAME=X]..."""
    from nermo_mjx.control.schedule import Switch
    from nermo_mjx.robot.quantity import ParameterError

    begin, *parts = text.split(",")
    pairs = dict(part.partition("=")[::2] for part in parts)
    words = {
        name: pairs.pop(name)
        for name in ("gait", "steering", "spine", "head", "tail_motion")
        if name in pairs
    }
    try:
        blend = float(pairs.pop("blend", 1.0))
        return Switch(float(begin), blend, **words, values=pairs)  # type: ignore[arg-type]
    except ValueError as error:
        reason = f" {error}" if isinstance(error, ParameterError) else ""
        raise WrongUse(
            f"--switch {text}: expected AT,NAME=X such as 2.5,gait=lateral_walk,frequency=0.8.{reason}"
        ) from None


def _length(cycles: float | None, duration: float | None, warmup: float | None) -> Run:
    from nermo_mjx.rollout import Run

    if cycles is not None and duration is not None:
        raise WrongUse("Give --cycles or --duration, not both.")
    total = duration if duration is not None else cycles if cycles is not None else DEFAULT_CYCLES
    before = min(DEFAULT_WARMUP, total / 4) if warmup is None else warmup
    if before >= total:
        raise WrongUse(f"--warmup is {before:g}: it must be shorter than the run, {total:g}.")
    return (
        Run(cycles=total, warmup_cycles=before)
        if duration is None
        else Run(duration=total, warmup=before)
    )


def _shifted_start(seed: int) -> dict[str, float]:
    import numpy as np

    from nermo_mjx.rollout.run import START_SPREAD

    random = np.random.default_rng(seed)
    return {name: float(random.uniform(-width, width)) for name, width in START_SPREAD.items()}


#: Other lines of the table: metric, and how it is called.
LINES = {
    "distance": "distance",
    "duration": "measured time",
    "lateral_drift": "lateral drift",
    "slip": "slip of loaded feet",
    "stride_length": "length of a stride",
    "stride_length_cv": "its variability",
    "servo_work": "servo work",
    "cost_of_transport": "cost of transport, mechanical",
    "electrical_cost_of_transport": "cost of transport, electrical",
}


def print_walk(report: dict[str, Any]) -> None:
    """Print a report of a walk: what was done, metrics beside the theory, orientation, and how it ended."""
    import numpy as np

    from nermo_mjx.experiments import theory
    from nermo_mjx.rollout.stride_metrics import SPREAD_STRIDES

    metrics, setup, parameters = report["metrics"], report["setup"], report["parameters"]
    speed_unit = _shown_unit("speed")
    lines = [("speed", metrics.get("speed"), *speed_unit)]
    if setup["controller"]:
        how = setup["controller"]
    else:
        gait = setup["gait"].replace("_", " ")
        how = f"{gait} at {parameters['frequency']:g} Hz, spine {setup['spine']}, profile {setup['profile']}"
        # Feet that neither slip nor lag (5.21), strides lengthened by the spine (5.33), whose bend counts only at the
        # moment when the diagonal pairs switch.
        values = {name: np.asarray(value) for name, value in parameters.items()}
        extends = "stride_extension" in setup["spine"].split("+")
        values["spine.amplitude"] = (
            values["spine.amplitude"] * extends * np.cos(values["spine.phase"])
        )
        lines.append(("speed in theory", float(theory.speed(values)), *speed_unit))
    lines += [
        (title, metrics[name], *_shown_unit(name))
        for name, title in LINES.items()
        if name in metrics
    ]
    rows = [[title, _number(value, factor), unit] for title, value, unit, factor in lines]
    rows += [[name, f"{metrics[name]:.4g}", unit] for name, unit in report.get("units", {}).items()]
    headings = ", >, "
    if (ratio := parameters.get("tracking.clock_ratio", 1.0)) != 1.0:
        # Seconds of the controller's clock, in which frequencies are given, before simulated ones.
        scaled = {"mm/s": ratio, "s": 1.0 / ratio}
        of_clock = [
            _number(value, factor * scaled.get(unit, 1.0)) for _, value, unit, factor in lines
        ]
        rows = [
            [row[0], first, *row[1:]]
            for row, first in itertools.zip_longest(rows, of_clock, fillvalue="")
        ]
        headings = ", controller's clock>, simulated>, "
    print_table(
        f"Nermo walked: {how}, {setup['tail']} tail, engine {report['engine']}", headings, rows
    )
    parts, degrees = ("mean", "std", "min", "max"), math.degrees(1.0)
    angles = [
        [angle, *(_number(metrics.get(f"{angle}_{part}"), degrees) for part in parts)]
        for angle in ("roll", "pitch", "yaw")
    ]
    print_table("Orientation [degrees]", ", mean>, std>, min>, max>", angles)
    if (strides := metrics.get("strides", math.nan)) < SPREAD_STRIDES:
        click.echo(
            f"A foot made {strides:g} whole strides: feet with fewer than {SPREAD_STRIDES} are left out of the "
            "variability. Walk more --cycles; a foot that does not leave the ground makes none."
        )
    print_ending(metrics)


def print_ending(metrics: Mapping[str, Any]) -> None:
    """Print how a run ended, unless it is as it should be."""
    from nermo_mjx.rollout.metrics import Ending

    ending = Ending[metrics["status"]]
    if ending is not Ending.ok:
        click.echo(ending.value)


def _shown_unit(metric: str) -> tuple[str, float]:
    """Display unit of a metric, which is percent for a variability, and the factor from the SI unit."""
    from nermo_mjx.rollout import METRICS

    (factor,), unit = in_unit("", METRICS[metric].unit, 1.0)
    return ("%", 1e2) if metric.endswith("_cv") else (unit, factor)


def _number(value: float | None, factor: float) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    value *= factor
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _switch_option(help_text: str) -> Any:
    return click.option(
        "--switch", "switches", multiple=True, metavar="AT,NAME=X...", help=help_text
    )


@command("walk")
@options.gait
@options.controller
@text("--metrics", "FILE.py[:NAME]", "Custom metrics; repeatable.", multiple=True)
@options.choice_option(
    "--pilot", PILOTS, "Default: straight, or open_loop with --turn-rate.", default=None
)
@number("--cycles", "Duration in gait cycles, by default 8.", options.POSITIVE)
@number("--duration", "Duration in seconds, instead of --cycles.", options.POSITIVE)
@number("--warmup", "Unmeasured start, in the same unit; by default 2.", click.FloatRange(0))
@options.body
@options.set_any
@_switch_option(
    "From AT seconds on another gait, spine, steering, head, tail_motion or parameter; blend=X cycles; repeatable."
)
@number("--seed", "Shift the start slightly, like the repeats of a sweep.", click.IntRange(0))
@options.engine
@options.produced
def walk_command(
    engine: str, record: Path | None, video: Path | None, camera: str, **choices: Any
) -> Output:
    """Simulate one walk, and summarize it.

    Examples:
      nermo-mjx walk
      nermo-mjx walk --frequency 0.8 --spine stride_extension --video w.mp4
      nermo-mjx walk --turn-rate 0.5 --steering mix --record turn.npz
      nermo-mjx walk --set contact.friction=0.6 --json
      nermo-mjx walk --switch 2,gait=lateral_walk --switch 6,frequency=0.5
      nermo-mjx walk --controller bound.py:Bound --set reach=0.04
      nermo-mjx walk --controller policy.npz --duration 5 --record walk.npz
      nermo-mjx walk --metrics my_metrics.py
    """
    from nermo_mjx.rollout import Simulator

    setup, run, values = planned_walk(**choices)
    refuse_video(setup, video, camera)
    with ProgressBar("walk", compiles=True) as progress:
        simulator = Simulator(setup, engine=engine)
        result = simulator.run(values, run, record=bool(record or video), progress=progress.share)
    if result.trace is not None:
        save_run(result.recording(), record, video, camera)
    report = result.about()
    return Output(report, lambda: print_walk(report), [file for file in (record, video) if file])


#: Options of `drive` that need another one: which, and what is missing without it.
DRIVE_NEEDS = {
    "headless": "--connect URL",
    "rate": "--connect URL",
    "watchdog": "--connect URL",
    "delay": "--serve URL",
    "loss": "--serve URL",
    "channels": "--connect URL or --serve URL",
    "port": "a page",
    "browser": "a page",
}


@command("drive")
@options.gait
@options.controller
@options.choice_option(
    "--pilot", PILOTS, "Default: open_loop, which turns as you steer.", default=None
)
@options.body
@options.set_any
@text(
    "--record",
    "FILE.npz|FILE.csv",
    "A new file: NPZ of the twin, and after a reset FILE-2.npz, ...; CSV for a robot's log, what it was sent and what "
    "it measured, with FILE.yaml of its channels.",
    type=options.FileKind(".npz", ".csv", dir_okay=False),
)
@number("--port", "Of the page; by default any that is free.", click.IntRange(1, 65535))
@number("--seconds", "Duration; by default until Ctrl-C.", options.POSITIVE)
@click.option(
    "--browser/--no-browser", default=True, help="Open the page, or only print its address."
)
@text(
    "--connect",
    "URL",
    "The robot: mqtt://HOST[:PORT] of a broker, ros://HOST[:PORT] of a rosbridge, or print: for none, whose commands "
    "are printed.",
)
@text("--serve", "URL", "Be a simulated robot that is driven from there.")
@text(
    "--channels",
    "FILE.yaml",
    "Channel, direction, zero and limits of each servo, as for `servos`.",
    default="published",
    show_default=True,
    type=options.SPEC,
)
@number(
    "--rate",
    "Commands per second; by default that of the channels, or of the controller.",
    options.POSITIVE,
)
@number(
    "--watchdog",
    "Seconds without messages after which the robot holds still.",
    click.FloatRange(0, 5, min_open=True),
    default=0.25,
)
@options.flag("--headless", "Drive a robot without a page, from now on.")
@_switch_option("As for `walk`; repeatable.")
@number(
    "--delay",
    "With --serve: each message takes about this long, each way [ms].",
    click.FloatRange(0, 10_000),
    default=0.0,
)
@number(
    "--loss",
    "With --serve: share of messages that get lost, each way.",
    click.FloatRange(0, 1),
    default=0.0,
)
# Long because it checks each option of the command before anything starts.
def drive_command(
    connect: str | None,
    serve: str | None,
    headless: bool,
    record: Path | None,
    seconds: float | None,
    **choices: Any,
) -> Output:
    """Drive the robot in the browser while it walks: keyboard, gamepad, sliders.

    The page is served to this machine alone, and its address holds a secret.
    The robot is simulated in real time by the engine c. Without a page it
    waits.

    A recording opens in `view`, `render` and `servos`, and `replay` drives it
    again. While you drive, FILE.jsonl keeps every command: if the drive is
    killed, `replay` makes the recording from it.

    --connect URL drives a real robot over its topics: q_values (servo angles,
    out) and sensors_mouse (what it measures, in). Its servos go to the start
    of the gait slowly. Without messages, or with the page away, it holds
    still; after 5 s the drive ends. The exit code is 1 if the robot never
    answered, the link was lost, or a tenth of the commands was late. --serve
    is the other side: a simulated robot behind the same topics.

    Examples:
      nermo-mjx drive
      nermo-mjx drive --scene stairs --frequency 0.8 --record drive.npz
      nermo-mjx drive --controller policy.npz
      nermo-mjx drive --no-browser --port 8000
      nermo-mjx drive --connect mqtt://192.168.0.10 --record robot.csv
      nermo-mjx drive --connect print: --headless --seconds 2
      nermo-mjx drive --serve mqtt://localhost --delay 20 --loss 0.01
    """
    logs = record is not None and record.suffix == ".csv"
    given_options = {
        "--connect URL": bool(connect),
        "--serve URL": bool(serve),
        "a page": not (headless or serve),
    }
    given_options["--connect URL or --serve URL"] = bool(connect or serve)
    if connect and serve:
        raise WrongUse("Give --connect URL or --serve URL, not both.")
    options.refuse_without(
        DRIVE_NEEDS | {"record": "--connect URL" if logs else "a page"}, given_options
    )
    from nermo_mjx.hardware.live import TOPIC, SendError, address
    from nermo_mjx.live.driving import Driving
    from nermo_mjx.live.server import LiveDrive, free
    from nermo_mjx.live.wire import RobotDriving, SimulatedRobot
    from nermo_mjx.recording import RecordingError
    from nermo_mjx.runs.files import make_writable

    if given_options["a page"]:
        from nermo_mjx.robot.quantity import require

        require("drive", "websockets", "drive")
    port, browser, channels, rate, watchdog, delay, loss = (
        choices.pop(name)
        for name in ("port", "browser", "channels", "rate", "watchdog", "delay", "loss")
    )
    choices["pilot"] = choices["pilot"] or ("open_loop" if choices["controller"] is None else None)
    setup, _, values = planned_walk(**choices)
    drive_report, files, robots = dict[str, Any](), list[Path](), None
    sentences, failures = list[str](), list[str]()
    if not given_options["a page"]:
        say("Ctrl-C ends it")
    page_record, log = (None, record) if logs else (record, None)
    if record is not None:
        make_writable(record.parent)
        for record_file in (record, *([record.with_suffix(".yaml")] if logs else [])):
            free(record_file)
    try:
        if serve is not None:
            address(serve, "serve")
            simulated = SimulatedRobot(setup, values, channels, delay / 1e3, loss)
            drive_report, sentences = simulated.run(serve, seconds), simulated.sentences()
            failures = (
                [] if drive_report["commands"].get("taken") else [f"No command came on {TOPIC}."]
            )
        else:
            with ProgressBar("drive", quiet=headless or is_given("quiet"), compiles=True):
                recorded = page_record is not None
                if connect is not None:
                    robots = RobotDriving(
                        setup, values, connect, channels, rate, watchdog, record=recorded, log=log
                    )
                driving = robots or Driving(setup, values, record=recorded)
            with robots.reach() if robots else contextlib.nullcontext():
                if robots and headless:
                    robots.run(seconds)
                else:
                    drive = LiveDrive(driving, page_record, port or 0)
                    if robots:
                        robots.operator = lambda: drive.away
                    click.echo(f"drive: {drive.address}", err=True)
                    with _browser(drive.address) if browser else contextlib.nullcontext():
                        try:
                            drive.run(seconds)
                        except (KeyboardInterrupt, SendError):
                            pass
                        except RecordingError as error:
                            failures = [str(error)]
                    drive_report, files = drive.report(), drive.files
                    failures = [drive.failure] if drive.failure else failures
        if robots:
            drive_report |= dataclasses.asdict(robots.driven)
            sentences, failures = (
                robots.driven.sentences(),
                failures + robots.failures(drive_report.get("factor", 1.0)),
            )
            files += [log, log.with_suffix(".yaml")] if log else []
    except SendError as error:
        raise Failure(f"{str(error).rstrip('.')}.") from None
    content = drive_report | ({"verdict": failures} if connect or serve else {})
    return Output(
        content,
        lambda: click.echo("\n".join(sentences), nl=bool(sentences)),
        files,
        " ".join(failures),
    )


@contextlib.contextmanager
def _browser(address: str) -> Iterator[None]:
    """Open an address with a secret in the browser by a file that only its user reads: command lines are public."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder, "drive.html")
        page.touch(0o600)
        page.write_text(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}">')
        webbrowser.open(page.as_uri())
        yield


#: What options of `replay` need.
REPLAY_NEEDS = {
    "row": "a directory",
    "engine": "a directory or --commands LOG",
    **dict.fromkeys(("sweep", "controller"), "a recorded drive"),
    **dict.fromkeys(
        ("channels", "model", "robot", "scene", "tail", "physics", "profile", "assignments"),
        "--commands LOG",
    ),
}


@command("replay")
@click.argument("out", metavar="[DIR|FILE]", required=False, type=options.PATH)
@text(
    "--commands",
    "LOG",
    "Drive the twin by the commands of a robot's log.",
    type=options.FileKind(*LOGS),
)
@log_channels
@text(
    "--model",
    "FILE.xml",
    "With --commands: drive the MJCF of another robot.",
    type=options.FileKind(".xml"),
)
@options.body
@options.profile
@options.set_any
@number("--row", "Row of the table, from 0; not with a FILE.", int, metavar="N")
@options.choice_option("--engine", ENGINES, "By default the directory's own.", default=None)
@options.produced
@options.file("--sweep", ".yaml", "Write a sweep file that walks as was driven, of a FILE.")
@text(
    "--controller",
    "FILE",
    "Your copy of the controller of a drive, FILE.py:NAME or a policy FILE.npz; of a FILE.",
)
# Long because it checks each option of the command before anything starts.
# Many parameters because each is an option of the command.
def replay_command(
    out: Path | None,
    commands: Path | None,
    row: int | None,
    engine: str | None,
    sweep: Path | None,
    controller: str | None,
    channels: Path | None,
    model: Path | None,
    record: Path | None,
    video: Path | None,
    camera: str,
    **body: Any,
) -> Output:
    """Rerun one row of a sweep's or a search's directory on its own, a recorded
    drive, or the commands of a robot's log.

    It has the parameters, start and duration that the sweep gives it, whether
    or not the sweep has reached it; for a search, those of a row of its table.
    Its metrics are compared with those in the table: with the engine c on the
    same machine, they are bit-identical. DIR is only read.

    A FILE.npz of `drive --record` is driven again, by the same commands, and
    compared sample by sample. It runs no Python that it names: give a
    controller of your own again. The FILE.jsonl of a drive that was killed is
    driven again, too, up to its end.

    --commands LOG drives the twin, from standing, by what a robot was
    commanded, at its times. What the robot measured is laid beside what the
    twin measures; the recording keeps both, for `view` and `plot`. With
    --model, any MJCF is driven, and compared.

    Examples:
      nermo-mjx replay runs/quickstart --row 57 --video row57.mp4
      nermo-mjx replay runs/quickstart --row 57 --engine mjx --json
      nermo-mjx replay runs/atlas --row 8123 --video gait.mp4
      nermo-mjx replay drive.npz --sweep drive.yaml
      nermo-mjx replay drive.jsonl --record drive.npz
      nermo-mjx replay --commands robot.csv --record twin.npz
      nermo-mjx replay --commands arm.csv --model arm.xml
    """
    if (out is None) == (commands is None):
        raise WrongUse("Give a directory, a recorded drive, or --commands LOG.")
    saved: dict[str, Any] = {"record": record, "video": video, "camera": camera}
    of_drive = out is not None and out.suffix in (".npz", ".jsonl")
    given_options = {
        "a directory": out and not of_drive,
        "a recorded drive": of_drive,
        "--commands LOG": commands,
    }
    options.refuse_without(
        REPLAY_NEEDS, given_options | {"a directory or --commands LOG": not of_drive}
    )
    if commands is not None:
        return _replay_log(commands, channels, model, engine, body, saved)
    assert out is not None
    if of_drive:
        return _replay_drive(out, sweep, controller, saved)
    if row is None:
        raise WrongUse("Give --row N, a row of the table.")
    from nermo_mjx.optimize.search_directory import find_evaluation
    from nermo_mjx.runs.files import make_writable, plain_json
    from nermo_mjx.sweep.replay import find_row, replay_row, report_of

    row_finder = (find_evaluation if (out / "search.yaml").exists() else find_row)(out, row)
    files = [file for file in (saved["record"], saved["video"]) if file]
    for path in files:
        make_writable(path.parent)
    refuse_video(row_finder.walk.setup, saved["video"], saved["camera"])
    with ProgressBar("replay", compiles=True) as progress:
        replay = replay_row(row_finder, engine, progress.share)
    report = report_of(row_finder, replay)
    if files:
        if not len(replay.history.time):
            raise Failure(
                f"row {row} diverged in its first tick: there is nothing to record or to show."
            )
        save_run(dataclasses.replace(replay.recording(), metadata=plain_json(report)), **saved)

    def show() -> None:
        values = "".join(f", {name} {label}" for name, label in row_finder.walk.labels.items())
        values += "".join(f", {name} {value:.4g}" for name, value in row_finder.values.items())
        click.echo(
            f"Row {row_finder.row} of {row_finder.out}: variant {report['variant']}, repeat {report['repeat']}{values}\n"
        )
        print_walk(report)
        for flag, what in (("fell", "fell"), ("diverged", "lost its numbers")):
            if report["metrics"][flag]:
                click.echo(
                    f"It {what} at {replay.metrics['failure_time']:.2f} s, of {row_finder.span[1]:.2f} s."
                )
        click.echo(report["compared"])

    return Output(report, show, files)


def _replay_log(
    file: Path,
    channels: Path | None,
    model: Path | None,
    engine: str | None,
    body: dict[str, Any],
    saved: dict[str, Any],
) -> Output:
    """Simulate Nermo or any MJCF under the commands of a log, and compare the measurements with the simulation."""
    from nermo_mjx.hardware.signals import channel_differences, findings_of
    from nermo_mjx.hardware.twin import replay_log, with_log
    from nermo_mjx.identify.twin import replay_on_model
    from nermo_mjx.rollout import Setup, all_parameters

    for name, flag in options.given().items() if model else ():
        if name not in ("commands", "channels", "model", "as_json", "quiet"):
            raise WrongUse(f"{flag} is for Nermo: it has no effect with --model.")
    log, assignments = log_of(file, channels), body.pop("assignments")
    content: dict[str, Any] = {"log": file, "model": model}
    if model:
        twin, notes = replay_on_model(log, model)
        differences = channel_differences(log, twin)
        simulated_names = [channel.name for channel in twin.channels]
    else:
        setup = Setup(**{name: value for name, value in body.items() if value is not None})
        refuse_video(setup, saved["video"], saved["camera"])
        with ProgressBar("replay", compiles=True) as progress:
            values = assigned(assignments, all_parameters(setup))
            replay = replay_log(log, setup, values, engine or "c", progress.share)
        recording, differences = with_log(replay, log, setup.load())
        save_run(recording, **saved)
        simulated_names, notes = recording.metadata["log"]["shown"], ()
        content = {**replay.metadata, "log": file}
    for sentence in (*findings_of(log), *notes):
        say(sentence)
    missing_names = [
        channel.name
        for channel in log.channels
        if channel.name not in simulated_names and channel.quantity != "command"
    ]
    content["channels"] = [*map(dataclasses.asdict, differences)]
    content["not_simulated"] = missing_names

    def show() -> None:
        duration = f"{log.duration:.4g} s"
        if model:
            print_differences(f"{file} minus {model}, {duration}", differences, missing_names)
            return
        metrics, engine = content["metrics"], f"engine {content['engine']}"
        if differences or missing_names:
            title = f"{file}, {duration}: measured minus simulated, {engine}"
            print_differences(title, differences, missing_names)
        else:
            angles = [math.degrees(metrics[f"{axis}_std"]) for axis in ("roll", "pitch", "yaw")]
            print_table(
                f"{file}, {duration}, {engine}: mean speed and standard deviations",
                "speed [mm/s]>, roll [deg]>, pitch [deg]>, yaw [deg]>",
                [[f"{1e3 * metrics['speed']:.1f}", *(f"{angle:.2f}" for angle in angles)]],
            )
        print_ending(metrics)

    return Output(content, show, [path for path in (saved["record"], saved["video"]) if path])


def _replay_drive(
    path: Path, sweep: Path | None, controller: str | None, saved: Mapping[str, Any]
) -> Output:
    """Drive a recording or a journal again, and compare; no Python runs that the person has not named."""
    from nermo_mjx.live.driving import as_sweep, difference, replay_drive
    from nermo_mjx.recording import RecordingError, write_whole
    from nermo_mjx.robot import ParameterError
    from nermo_mjx.sweep import Sweep

    recording = load_recording(path) if path.suffix == ".npz" else None
    try:
        with (
            contextlib.nullcontext() if controller else only_reading(),
            ProgressBar("replay", compiles=True),
        ):
            driven = recording or replay_drive(path, controller)
            if sweep is not None:
                text = Sweep.from_dict(as_sweep(driven, controller)).to_yaml(sweep.parent)
                write_whole(sweep, "the sweep file", text.encode())
            again = driven if recording is None else replay_drive(recording, controller)
    except (RecordingError, ParameterError) as error:
        raise WrongUse(f"{path}: {error}") from None
    save_run(again, **saved)
    differs = None if recording is None else difference(recording, again)
    samples = f"{len(again.time):,} samples"
    sentence = f"All {samples} equal the recording's, to the last bit."
    if recording is None:
        sentence = (
            f"{samples} were made again, up to {again.time[-1]:.2f} s, the end of the journal."
        )
    elif differs is not None:
        sentence = f"Of {samples} those from {differs:.2f} s on differ from the recording's."
    equal = None if recording is None else differs is None
    content = {
        "recording": path,
        "samples": len(again.time),
        "equal": equal,
        "differs_from": differs,
    }
    return Output(content, lambda: click.echo(sentence))


@command("servos")
@options.gait
@number("--rate", "Rows per second; by default that of the channels, or 50.", options.POSITIVE)
@number("--cycles", "Whole gait cycles, by default 1.", click.IntRange(1))
@text(
    "--channels",
    "FILE.yaml",
    "Channel, direction, zero and limits of each servo; published: the author's order, whole degrees at 30 Hz.",
    type=options.SPEC,
)
@options.robot
@options.tail
@options.set_any
@text(
    "--recording",
    "FILE.npz",
    "Instead of a gait: what was commanded in a recorded walk, such as that of a policy.",
    type=options.RECORDING_FILE,
)
@options.file("--out", ".csv", "File for the table.")
@text(
    "--send",
    "URL",
    "Send the angles to the robot in real time: mqtt://HOST[:PORT], ws://HOST[:PORT] of a rosbridge, or print:.",
)
@text("--topic", "NAME", "MQTT or ROS topic.", default="q_values", show_default=True)
@number("--seconds", "Duration of sending; by default until Ctrl-C.", options.POSITIVE)
# Long because it checks each option of the command before anything starts.
def servos_command(
    recording: Path | None,
    out: Path | None,
    send: str | None,
    seconds: float | None,
    **choices: Any,
) -> Output:
    """Write the servo angles of a gait as CSV, ready to be played in a loop, or
    send them to the robot.

    A time column, and a column for each servo in the order of its channel, in
    degrees. They come from the controller alone, long after its start, so
    that the last row leads back to the first. Whole gait cycles are divided
    into whole rows, so the actual rate is the nearest one that fits.

    A channel file has a line for each connected servo,
    NAME: {channel: 0, direction: -1, zero: 90, low: 20, high: 160}.

    --recording makes the table of a recorded walk, by whatever controller. A
    policy answers to its sensors, so its targets are those of one walk, to be
    played once, as an open loop.

    --send plays the table repeatedly in real time. Over MQTT a message
    is a JSON list of degrees, one per channel; to ROS 2, through a
    rosbridge server, a Float32MultiArray of radians.

    Examples:
      nermo-mjx servos --frequency 0.8 --out trot.csv
      nermo-mjx servos --gait trot --turn-rate 0.5 --rate 100 --out turn.csv
      nermo-mjx servos --spine stride_extension --cycles 3 --out walk.csv
      nermo-mjx servos --channels published --send mqtt://127.0.0.1 --seconds 10
      nermo-mjx servos --recording walk.npz --out policy.csv
    """
    if out is None and send is None:
        raise WrongUse("Give --out FILE.csv, --send URL, or both.")
    if send is None and seconds is not None:
        raise WrongUse("--seconds limits the duration of --send: give --send URL, too.")
    from nermo_mjx.hardware import recorded_table, servo_table
    from nermo_mjx.hardware.live import SendError, address, connected, lateness, send_table
    from nermo_mjx.runs.files import replace_file

    if send is not None:
        address(send, "send")
    topic, send_options = (
        choices.pop("topic"),
        {name: choices.pop(name) for name in ("rate", "channels")},
    )
    if recording is None:
        cycles = choices.pop("cycles") or 1
        setup, _, values = planned_walk(
            pilot="open_loop", scene="flat", physics="reference", **choices
        )
        table = servo_table(setup, values, cycles=cycles, **send_options)
        words = [f"{name} {getattr(setup, name)}" for name in ("gait", "spine", "steering")]
        words += [
            f"{name} {value:g}" for name, value in {"frequency": table.frequency, **values}.items()
        ]
    else:
        from nermo_mjx.view import robot_of

        used_options = (
            "recording",
            "rate",
            "channels",
            "out",
            "send",
            "topic",
            "seconds",
            "as_json",
            "quiet",
        )
        for name, flag in options.given().items():
            if name not in used_options:
                raise WrongUse(
                    f"{flag} has no effect with --recording, whose walk is over: leave one of them out."
                )
        loaded, words = load_recording(recording), [f"walk {recording.name}"]
        table = recorded_table(loaded, robot_of(loaded), **send_options)
    if out is not None:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, table.to_csv(", ".join(words)).encode())
        except OSError as error:
            raise Failure(f"{out}: the table cannot be written ({error.strerror}).") from None
    report = None
    if send is not None:
        try:
            with connected(send, topic) as robot:
                report = send_table(table, robot, seconds)
        except SendError as error:  # nobody there is a failure, and not wrong use
            raise Failure(str(error)) from None
    numbers = [channel.number for channel in table.channels]
    columns = zip(
        table.names,
        numbers,
        table.angles.min(axis=0),
        table.angles.max(axis=0),
        table.speed,
        strict=True,
    )
    keys = ("servo", "channel", "low_deg", "high_deg", "speed_deg_per_s")
    servos = [dict(zip(keys, column, strict=True)) for column in columns]
    content: dict[str, Any] = {"out": out, "rows": len(table.time)}
    content |= {name: getattr(table, name) for name in ("rate", "cycles", "frequency")}
    content |= {"servo_speed_deg_per_s": table.servo_speed, "servos": servos}
    content |= {} if report is None else {"sent": dataclasses.asdict(report)}

    def show() -> None:
        if table.too_fast:
            say(table.too_fast)
        shapes = "{channel}|{servo}|{low_deg:.1f}|{high_deg:.1f}|{speed_deg_per_s:.0f}"
        rows = [shapes.format(**servo).split("|") for servo in servos]
        title = f"{table.how_many}, {len(table.time)} rows, {table.rate:.6g} rows/s"
        print_table(title, "channel>, servo, from [deg]>, to [deg]>, fastest [deg/s]>", rows)
        if out is not None:
            click.echo(f"wrote {out}")
        if report is not None:
            latest = f"the latest was {1e3 * report.latest:.1f} ms late"
            click.echo(
                f"sent {report.messages} messages in {report.seconds:.1f} s, {report.skipped} skipped; {latest}"
            )

    late_note = "" if report is None else lateness(report.skipped, report.messages + report.skipped)
    return Output(content, show, failure=late_note)
