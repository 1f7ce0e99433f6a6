"""`nermo-mjx model`: the components of the assembled robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import ROBOTS, TAILS
from nermo_mjx.cli.group import Failure
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved

if TYPE_CHECKING:
    from nermo_mjx.robot import Robot

EPILOG = """\b
Examples:
  nermo-mjx model
  nermo-mjx model --tail articulated --xml nermo.xml
"""


@click.command("model", epilog=EPILOG)
@options.choice("--robot", ROBOTS)
@options.scene
@options.choice("--tail", TAILS)
@options.physics
@options.file("--xml", ".xml", "Write one self-contained MJCF file.")
@options.report
def command(robot: str, scene: str, tail: str, physics: str, xml: Path | None, as_json: bool, quiet: bool) -> None:
    """Summarize the assembled robot, or write it as one MJCF file."""
    with stdout_reserved():
        from nermo_mjx.robot import load_robot

        loaded = load_robot(robot=robot, scene=scene, tail=tail, physics=physics)
        summary = summarize(loaded)
    if xml is not None:
        try:
            xml.write_text(loaded.to_xml(), encoding="utf-8")
        except OSError as error:
            raise Failure(f"{xml}: the MJCF cannot be written ({error.strerror}).") from None
        summary["xml"] = str(xml)
    if as_json:
        print_json(summary)
    elif not quiet:
        _print(summary)


def summarize(robot: Robot) -> dict[str, Any]:
    """Names of the parts, and the masses before and behind the spine."""
    from nermo_mjx.robot.scene import scene_name

    model = robot.model
    masses = robot.mass_table()
    groups = {group: sum(float(row["mass"]) for row in masses if row["group"] == group) for group in ("front", "rear")}
    return {
        "robot": robot.config.robot,
        "scene": scene_name(str(robot.config.scene)),
        "tail": robot.config.tail,
        "physics": robot.config.physics,
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


def _print(summary: dict[str, Any]) -> None:
    what = f"{summary['robot']} with {summary['tail']} tail in scene {summary['scene']}"
    click.echo(f"{what}, time step {summary['timestep']:g} s")
    counts = [("degrees of freedom", str(summary["degrees_of_freedom"]))]
    counts += [(part, str(len(summary[part]))) for part in ("bodies", "joints", "actuators", "tendons", "sensors")]
    counts.append(("contact pairs", str(summary["contact_pairs"])))
    print_table("Parts", [("", "left"), ("number", "right")], [list(row) for row in counts])
    names = [[part, ", ".join(summary[part])] for part in ("actuators", "tendons")]
    print_table("Names", [("", "left"), ("", "left")], names)
    rows = [[row["body"], row["group"], f"{1e3 * row['mass']:.2f}"] for row in summary["masses"]]
    rows += [["", "", ""]] + [["all", group, f"{1e3 * mass:.2f}"] for group, mass in summary["mass"].items()]
    print_table("Masses", [("body", "left"), ("counts to", "left"), ("mass [g]", "right")], rows)
    if "xml" in summary:
        click.echo(f"wrote {summary['xml']}")
