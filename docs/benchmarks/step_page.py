"""The tables of the results of `step_matrix`, in a page: `python docs/benchmarks/step_page.py LINES PAGE`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, Final

import click
from step_matrix import lines_of

BEGIN: Final = "<!-- made by step_page.py -->"
END: Final = "<!-- end -->"
#: Largest error at which a gradient counts as equal to the differences.
LARGEST: Final = 1e-4
#: What is off.
_OFF: Final = "| model | nv | contacts, rows | against differences | differences among themselves | end against C |"


def page(lines: Path) -> str:
    """The text between `BEGIN` and `END`: how many models are right, what is off, where others are, and the cost."""
    models = dict(sorted(lines_of(lines).items()))
    measured = {name: each for name, each in models.items() if "error" in each}
    exact = [name for name, each in measured.items() if each["finite"] and each["error"] <= LARGEST]
    finite = sum(each["finite"] for each in measured.values())
    right = [name for name in exact if measured[name]["end_off_c"] <= LARGEST]
    plain = [each["plain"] for each in measured.values() if "plain" in each]
    refusals = sum(isinstance(each, str) and each != "NaN" for each in plain)
    wrong = sum(each == "NaN" or (not isinstance(each, str) and each > LARGEST) for each in plain)
    off = [_row(name, each) for name, each in measured.items() if name not in right]
    timed = [each for each in measured.values() if "compile_s" in each]
    refused = [
        f"| {name.replace('/', '/<wbr>')} | {' '.join(each['failed'].split()).replace('|', '/')} |"
        for name, each in models.items()
        if "error" not in each
    ]
    said = [
        f"{len(measured)} models; the gradients of {finite} are finite, and {len(exact)} are within {LARGEST:g} of the "
        f"differences, {sum(measured[name]['rows'] > 0 for name in exact)} of these with constraints and "
        f"{sum(measured[name]['contacts'] > 0 for name in exact)} with contacts. `mjx.step` was differentiated on "
        f"{len(plain)} of them: it refuses {refusals}, and {wrong} more gradients are wrong or NaN.",
        *_table("Where something is off:", _OFF, off),
        f"Gradient within {LARGEST:g} of the differences, and end of C's, on {len(right)}: {_folders(right)}.",
        *([_cost(timed)] if timed else []),
        *_table("Not measured:", "| model | because |", refused),
    ]
    return "\n\n".join(said)


def _table(title: str, head: str, rows: list[str]) -> list[str]:
    """Nothing if there are no rows."""
    return [title, "\n".join([head, "|---" * (head.count("|") - 1) + "|", *rows])] if rows else []


def _folders(models: list[str]) -> str:
    """How many there are in each folder."""
    counted = Counter(name.rpartition("/")[0] or name for name in models)
    return ", ".join(f"{folder} {number}" for folder, number in counted.items())


def _row(name: str, each: dict[str, Any]) -> str:
    """With a path that a browser may break."""
    rows = f"{each['contacts']}, {each['rows']}"
    errors = (_error(each[key]) for key in ("error", "spread", "end_off_c"))
    return f"| {' | '.join([name.replace('/', '/<wbr>'), str(each['nv']), rows, *errors])} |"


def _cost(timed: list[dict[str, Any]]) -> str:
    """The range over the models of which it was measured."""

    def over(key: str, digits: int) -> str:
        values = [each[key] for each in timed]
        return f"{min(values):.{digits}f} to {max(values):.{digits}f}"

    cosine = min(each["cosine"] for each in timed if each.get("cosine") is not None)
    return (
        f"Cost, measured on {len(timed)}: {over('trace_s', 1)} s to trace, {over('compile_s', 1)} s to compile, "
        f"{over('forward_ms', 3)} ms a step. The gradient takes {over('ratio', 1)} times as long as the steps. "
        f"In float32 its cosine with that in float64 is at least {cosine:.5f}."
    )


def _error(value: float) -> str:
    shown = f"{value:.0e}"
    return f"**{shown}**" if value > LARGEST else shown


@click.command()
@click.argument("lines", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument(
    "target", metavar="PAGE", type=click.Path(exists=True, dir_okay=False, path_type=Path)
)
def main(lines: Path, target: Path) -> None:
    """Put the table of LINES into PAGE, between its two comments."""
    text = target.read_text()
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    target.write_text(f"{before}{BEGIN}\n\n{page(lines)}\n\n{END}{after}")


if __name__ == "__main__":
    main()
