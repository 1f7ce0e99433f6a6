"""`nermo-mjx walk`: one run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import PILOTS, ROBOTS, TAILS
from nermo_mjx.cli.output import print_json, stdout_reserved
from nermo_mjx.cli.progress import Progress
from nermo_mjx.cli.render import check_video, save_run
from nermo_mjx.cli.walk_plan import Plan, plan
from nermo_mjx.cli.walk_report import print_walk

if TYPE_CHECKING:
    from nermo_mjx.rollout import RunResult

EPILOG = """\b
Examples:
  nermo-mjx walk
  nermo-mjx walk --frequency 0.8 --spine stride_extension --video w.mp4
  nermo-mjx walk --turn-rate 0.5 --steering mix --record turn.npz
  nermo-mjx walk --set contact.friction=0.6 --json
  nermo-mjx walk --controller bound.py:Bound --set reach=0.04
  nermo-mjx walk --controller policy.npz --duration 5 --record walk.npz
  nermo-mjx walk --metrics my_metrics.py
"""


@click.command("walk", epilog=EPILOG)
@options.gait
@click.option("--controller", metavar="FILE", help="Custom controller: FILE.py:NAME, or a policy FILE.npz.")
@click.option("--metrics", multiple=True, metavar="FILE.py[:NAME]", help="Custom metrics; repeatable.")
@options.choice("--pilot", PILOTS, "Default: straight, or open_loop with --turn-rate.", default=None)
@options.number("--cycles", "Duration in gait cycles, by default 8.", options.POSITIVE)
@options.number("--duration", "Duration in seconds, instead of --cycles.", options.POSITIVE)
@options.number("--warmup", "Unmeasured start, in the same unit; by default 2.", click.FloatRange(0))
@options.choice("--robot", ROBOTS)
@options.scene
@options.choice("--tail", TAILS)
@options.physics
@options.assigned("Any parameter that `sweep --list-parameters` prints; repeatable.")
@options.number("--seed", "Shift the start slightly, like the repeats of a sweep.", click.IntRange(0))
@options.engine
@options.file("--record", ".npz", "Save the whole run.")
@options.file("--video", ".mp4", "Render it; MP4, GIF or WebP.")
@options.camera
@options.report
def command(
    engine: str, record: Path | None, video: Path | None, camera: str, as_json: bool, quiet: bool, **chosen: Any
) -> None:
    """Simulate one walk, and summarize it."""
    with stdout_reserved():
        wanted = plan(**chosen)
        check_video(wanted.setup, video, camera)
        result = _run(wanted, engine, bool(record or video), quiet)
        if result.trace is not None:
            save_run(result.recording(), record, video, camera, quiet)
    report = result.about()
    if as_json:
        print_json(report)
    elif not quiet:
        print_walk(report, wanted, [path for path in (record, video) if path is not None])


def _run(wanted: Plan, engine: str, record: bool, quiet: bool) -> RunResult:
    from nermo_mjx.rollout import Simulator

    with Progress("walk", quiet=quiet, compiles=True) as progress:
        simulator = Simulator(wanted.setup, engine=engine)
        return simulator.run(wanted.values, wanted.run, record=record, progress=progress.share)
