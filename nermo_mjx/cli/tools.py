"""The commands about the installation itself: model, schema, bench, completion."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import get_completion_class

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import BENCH_CASES, ENGINES
from nermo_mjx.cli.options import number
from nermo_mjx.cli.output import Failure, Output, command, print_table
from nermo_mjx.progress import ProgressBar

if TYPE_CHECKING:
    from nermo_mjx.robot import Robot


@command("model")
@options.body
@options.file("--xml", ".xml", "Write one self-contained MJCF file.")
def model_command(xml: Path | None, **config: Any) -> Output:
    """Summarize the assembled robot, or write it as one MJCF file.

    Examples:
      nermo-mjx model
      nermo-mjx model --tail articulated --xml nermo.xml
    """
    from nermo_mjx.robot import load_robot

    loaded = load_robot(**{name: value for name, value in config.items() if value is not None})
    summary = robot_summary(loaded)
    if xml is not None:
        try:
            xml.write_text(loaded.to_xml(), encoding="utf-8")
        except OSError as error:
            raise Failure(f"{xml}: the MJCF cannot be written ({error.strerror}).") from None
        summary["xml"] = str(xml)

    def show() -> None:
        what = f"{summary['robot']} with {summary['tail']} tail in scene {summary['scene']}"
        click.echo(f"{what}, time step {summary['timestep']:g} s")
        counts = [("degrees of freedom", summary["degrees_of_freedom"])]
        counts += [
            (part, len(summary[part]))
            for part in ("bodies", "joints", "actuators", "tendons", "sensors")
        ]
        print_table("Parts", ", number>", [*counts, ("contact pairs", summary["contact_pairs"])])
        print_table(
            "Names", ", ", [[part, ", ".join(summary[part])] for part in ("actuators", "tendons")]
        )
        rows = [
            [row["body"], row["group"], f"{1e3 * row['mass']:.2f}"] for row in summary["masses"]
        ]
        rows += [["", "", ""]] + [
            ["all", group, f"{1e3 * mass:.2f}"] for group, mass in summary["mass"].items()
        ]
        print_table("Masses", "body, counts to, mass [g]>", rows)

    return Output(summary, show, [] if xml is None else [xml])


def robot_summary(robot: Robot) -> dict[str, Any]:
    """Names of the parts, and the masses before and behind the spine."""
    from nermo_mjx.robot.scene import scene_name

    model, config, masses = robot.model, robot.config, robot.mass_table()
    groups = {
        group: sum(float(row["mass"]) for row in masses if row["group"] == group)
        for group in ("front", "rear")
    }
    return {
        "robot": config.robot,
        "scene": scene_name(str(config.scene)),
        "tail": config.tail,
        "physics": config.physics,
        "timestep": model.opt.timestep,
        "degrees_of_freedom": model.nv,
        "bodies": [model.body(i).name for i in range(1, model.nbody)],
        "joints": [model.joint(i).name for i in range(model.njnt)],
        "actuators": [model.actuator(i).name for i in range(model.nu)],
        "tendons": [model.tendon(i).name for i in range(model.ntendon)],
        "sensors": [model.sensor(i).name for i in range(model.nsensor)],
        "contact_pairs": model.npair,
        "masses": masses,
        "mass": {**groups, "total": sum(groups.values())},
    }


#: Where the fields of each command's file are declared.
FILES: Final = {
    "sweep": "sweep.spec:SweepFile",
    "search": "optimize.search_spec:SearchFile",
    "tune": "optimize.tuning_spec:TuningFile",
    "train": "learn.spec:TrainingFile",
    "servos": "hardware.channels:ChannelsFile",
    "log": "hardware.log:LogFields",
}


@command("schema")
@click.argument("kind", type=click.Choice(list(FILES)))
@options.file("--out", ".json", "File for the schema, instead of standard output.")
def schema_command(kind: str, out: Path | None) -> Output:
    """Print the JSON Schema of the file that a command reads.

    An editor that supports it completes fields, names and parameters, with
    units, defaults and ranges, and marks errors. KIND is the command; servos
    and log read a file of channels.

    Examples:
      nermo-mjx schema sweep
      nermo-mjx schema tune --out tune.schema.json

    With "# yaml-language-server: $schema=tune.schema.json" as its first line, a
    file next to it is completed and checked as you type.
    """
    from nermo_mjx.runs.files import replace_file
    from nermo_mjx.specs.fields import schema_of

    module, _, name = FILES[kind].partition(":")
    schema = schema_of(getattr(importlib.import_module(f"nermo_mjx.{module}"), name))
    text = json.dumps(schema, indent=2)
    if out is None:
        return Output(schema, lambda: click.echo(text), always=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_file(out, f"{text}\n".encode())
    return Output(schema, files=[out])


@command("bench")
@click.argument("cases", nargs=-1, type=click.Choice(BENCH_CASES), metavar="[CASE]...")
@options.choice_option(
    "--engine", ENGINES[1:], "Repeatable; c and mjx by default.", default=None, multiple=True
)
@number(
    "--worlds", "Size of the batch; repeatable; by default 64.", click.IntRange(1), multiple=True
)
def bench_command(
    cases: tuple[str, ...], engine: tuple[str, ...], worlds: tuple[int, ...]
) -> Output:
    """Measure throughput, start-up and memory on this machine.

    The default CASE is throughput.

    Cases:
      throughput  physics steps per second of a walk with controller and metrics
      startup     a new process to its first control tick, cold and warm cache

    Examples:
      nermo-mjx bench
      nermo-mjx bench --engine mjx --worlds 64 --worlds 1024 --json
      nermo-mjx bench throughput startup --engine c
    """
    from nermo_mjx.bench import measurement_table, run_bench

    with ProgressBar("bench", "measurements", compiles=True) as progress:
        result = run_bench(
            cases or BENCH_CASES[:1], engine or ("c", "mjx"), worlds or (64,), progress.count
        )

    def show() -> None:
        click.echo(
            "hardware: " + ", ".join(f"{key} {value}" for key, value in result["hardware"].items())
        )
        for line in result["cases"]:
            if "error" in line:
                click.echo(
                    f"{line['case']} (engine {line['engine']}, worlds {line['worlds']}) failed: {line['error']}"
                )
        for case in dict.fromkeys(line["case"] for line in result["cases"]):
            headings, rows = measurement_table(
                [line for line in result["cases"] if line["case"] == case]
            )
            if rows:
                print_table(case.capitalize(), headings, rows)

    return Output(result, show)


SHELLS = ("bash", "zsh", "fish")
_PROGRAM, _VARIABLE = "nermo-mjx", "_NERMO_MJX_COMPLETE"


@command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
@click.pass_context
def completion_command(context: click.Context, shell: str) -> Output:
    """Print a script with which a shell completes commands, options, names and files.

    Examples:
      nermo-mjx completion bash
      nermo-mjx completion fish

    Append what it prints to ~/.bashrc or ~/.zshrc, or write it to
    ~/.config/fish/completions/nermo-mjx.fish.
    """
    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(context.find_root().command, {}, _PROGRAM, _VARIABLE).source()
    return Output({"shell": shell, "script": script}, lambda: click.echo(script), always=True)
