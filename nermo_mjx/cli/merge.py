"""`nermo-mjx merge`: the rows of several sweeps in one directory."""

from __future__ import annotations

from pathlib import Path

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.output import print_json, sayer, stdout_reserved
from nermo_mjx.cli.sweep import print_result, result_fields

EPILOG = """\b
Examples:
  nermo-mjx merge runs/slow runs/fast --out runs/both
"""


@click.command("merge", epilog=EPILOG)
@click.argument("sources", metavar="DIR DIR...", nargs=-1, required=True, type=click.Path(path_type=Path))
@options.out
@options.accept_new_code
@options.report
def command(sources: tuple[Path, ...], out: Path, accept_new_code: bool, as_json: bool, quiet: bool) -> None:
    """Merge the rows of several sweeps into one directory.

    The sweeps may differ in what they vary, and in their repeats; what is
    fixed, the seed and the code have to be the same. Nothing is simulated,
    and the given directories are only read. A row that is in several is taken
    from the first of them.
    """
    with stdout_reserved():
        from nermo_mjx.sweep.merging import merge_sweeps

        result = merge_sweeps(sources, out, accept_new_code=accept_new_code, warn=sayer("merge", quiet))
    if as_json:
        print_json(result_fields(out, result))
    elif not quiet:
        print_result(result)
        if not result.complete:
            taken = " ".join(f"--use {source}" for source in sources)
            click.echo(f"To run the rest: nermo-mjx sweep {out / 'sweep.yaml'} --out {out} {taken}")
