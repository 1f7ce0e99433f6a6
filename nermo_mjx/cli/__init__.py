"""The command line `nermo-mjx`. Commands import heavy modules only when they run, so that `--help` is fast."""

from __future__ import annotations

import click

from nermo_mjx.cli import directories, jobs, logs, tools, view, walk  # noqa: F401 (each makes its commands)
from nermo_mjx.cli.output import ALL_COMMANDS, CommandGroup
from nermo_mjx.version import __version__

EPILOG = """\b
First steps:
  nermo-mjx walk --video walk.mp4
  nermo-mjx sweep sweeps/quickstart.yaml --out runs/quickstart
  nermo-mjx search sweeps/search_speed.yaml --out runs/fast
  nermo-mjx tune sweeps/tune_speed.yaml --out runs/tuned
  nermo-mjx train sweeps/train_residual.yaml --out runs/walker
  nermo-mjx experiment all --quick --out runs/look
"""


@click.group(
    cls=CommandGroup, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, package_name="nermo-mjx", message="nermo-mjx %(version)s")
def main() -> None:
    """Digital twin of Nermo, the tendon-driven robotic mouse.

    Exit codes: 0 success, 1 the job failed, 2 usage error. All numbers are in
    SI units and radians; summaries show millimetres and degrees.
    """


for command in ALL_COMMANDS:
    main.add_command(command)
