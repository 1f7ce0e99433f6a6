"""`nermo-mjx experiment`: the published experiments, figures side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.assignments import assigned
from nermo_mjx.cli.choices import EXPERIMENTS, PROFILES
from nermo_mjx.cli.output import print_json, print_table, stdout_reserved
from nermo_mjx.cli.progress import Stages, duration

if TYPE_CHECKING:
    from nermo_mjx.experiments.run import ExperimentsResult

EPILOG = """\b
Examples:
  nermo-mjx experiment all --out runs/published
  nermo-mjx experiment all --quick --out runs/look
  nermo-mjx experiment turning --profile exact --repeats 5 --out runs/turns
  nermo-mjx experiment maze --set contact.friction=0.8 --out runs/slippery
  nermo-mjx experiment all --bodies 64 --out runs/published
  nermo-mjx experiment maze --controller policy.npz --out runs/learned
"""
ALL = "all"
#: Longest text of a cell on the terminal; the names of figures are shorter.
_WIDEST = 72


@click.command("experiment", epilog=EPILOG)
@click.argument("name", type=click.Choice((*EXPERIMENTS, ALL)))
@options.out
@options.choice("--profile", ("all", *PROFILES), "Set-up: as published, as described, as built.")
@options.number("--repeats", "Starts of each case; by default 3, or 1 with --quick.", click.IntRange(1))
@options.number("--seed", "Seed of the shifts between repeats.", click.IntRange(0), default=0)
@options.number("--bodies", "Also run this many identified bodies: for what share of them does a line hold?",
                click.IntRange(1))  # fmt: skip
@click.option("--quick", is_flag=True, help="Quick run: fewer cases, no videos; a minute.")
@click.option("--no-video", is_flag=True, help="Render no videos.")
@click.option("--again", is_flag=True, help="Rerun, and replace the results in DIR.")
@click.option(
    "--controller",
    metavar="FILE.npz",
    help="A policy, in place of the published controller; for straight-line, turning and maze.",
)
@options.workers
@options.accept_new_code
@options.assigned("A parameter of the body, such as contact.friction; repeatable.")
@options.engine
@options.report
def command(
    name: str, out: Path, profile: str, repeats: int | None, seed: int, bodies: int | None, quick: bool,
    no_video: bool, again: bool, controller: str | None, workers: str, ray_address: str | None, accept_new_code: bool,
    assignments: tuple[str, ...], engine: str, as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Run a published experiment, or all of them, and compare.

    Writes a table of every run, a report with the published figures beside
    the simulated ones, plots, recordings and a video. Finished experiments
    are kept in DIR; the same command resumes.

    --workers ray distributes experiments, and batches of bodies, over the
    machines of a cluster, which need no access to DIR.
    """
    with stdout_reserved():
        from nermo_mjx.experiments.run import run_experiments

        values = _values(assignments)
        with (
            Stages(quiet, compiles=lambda what: "," not in what) as stages,
            options.crew(workers, ray_address, stages.say) as crew,
        ):
            result = run_experiments(
                EXPERIMENTS if name == ALL else [name], out, engine=engine,
                profiles=PROFILES if profile == "all" else (profile,), repeats=repeats, seed=seed, quick=quick,
                values=values, controller=controller, bodies=bodies, video=not no_video, again=again,
                accept_new_code=accept_new_code, progress=stages.share, notify=stages.say, workers=crew,
            )  # fmt: skip
    if as_json:
        run = {each.name: {"kept": each.kept} for each in result.results}
        print_json({"out": result.out, "run": run, **result.report})
    elif not quiet:
        _print(result)


def _values(assignments: tuple[str, ...]) -> dict[str, float]:
    """Parameters by name; their ranges are checked with the other settings."""
    from nermo_mjx.robot.quantity import quantities
    from nermo_mjx.rollout.parameters import WorldParameters

    known = dict(quantities(WorldParameters))
    unknown = "is not a parameter; `nermo-mjx sweep --list-parameters` prints all."
    return assigned(assignments, known, unknown)


def _print(result: ExperimentsResult) -> None:
    from nermo_mjx.experiments.catalogue import EXPERIMENTS as CATALOGUE
    from nermo_mjx.experiments.report import HEADINGS, cells

    content = result.report
    for each in result.results:
        rows = [list(map(_short, cells(line))) for line in content["lines"] if line["experiment"] == each.name]
        print_table(CATALOGUE[each.name].title, list(HEADINGS), rows)
    for each in result.results:
        about, summary = content["experiments"][each.name], content["summary"]["by_experiment"][each.name]
        took = f"{about['worlds']} runs in {duration(about['wall_seconds'])}, engine {about['engine']}"
        click.echo(f"{each.name}: {_counted(summary)} ({took}{', kept' if each.kept else ''})")
    kinds = content["summary"]["by_kind"]
    click.echo(f"all of {result.out}: {'; '.join(f'{kind}: {_counted(kinds[kind])}' for kind in kinds)}")
    click.echo("Only predicted lines count as evidence.")
    for sentence in content["differences"]:
        click.echo(sentence)
    for name, place in _places(result).items():
        click.echo(f"{name:<10} {place}")


def _short(text: str) -> str:
    """A cell shortened to leave room for the others; the report has the full text."""
    return text if len(text) <= _WIDEST else f"{text[: _WIDEST - 1]}…"


def _counted(summary: dict[str, Any]) -> str:
    compared = summary["hold"] + summary["do_not_hold"]
    missing = f", {summary['not_measured']} not judged or measured" if summary["not_measured"] else ""
    return f"{summary['hold']} of {compared} figures hold{missing}"


def _places(result: ExperimentsResult) -> dict[str, Path]:
    """Where the files are, by what they are."""
    made = {"plots": "plots", "recordings": "recordings", "videos": "videos"}
    folders = {name: result.out / folder for name, folder in made.items()
               if any(getattr(each, name) for each in result.results)}  # fmt: skip
    return {"report": result.out / "report.md", "tables": result.out / "results", **folders}
