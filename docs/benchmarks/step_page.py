"""The tables of the results of `step_matrix`, in a page: `python docs/benchmarks/step_page.py LINES PAGE`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import click
from step_matrix import lines_of

BEGIN: Final = "<!-- made by step_page.py -->"
END: Final = "<!-- end -->"
#: Largest error at which a gradient counts as equal to the differences.
LARGEST: Final = 1e-4
#: What is off, and what a step costs.
_OFF: Final = "| model | nv | contacts, rows | against differences | differences among themselves | end against C |"
_COST: Final = "| model | trace, compile [s] | a step [ms] | gradient over steps | float32, cosine |"


def page(lines: Path) -> str:
    """The text between `BEGIN` and `END`: how many models are right, what is off, the others' names, and the cost."""
    models = dict(sorted(lines_of(lines).items()))
    measured = {name: each for name, each in models.items() if "error" in each}
    exact = [name for name, each in measured.items() if each["finite"] and each["error"] <= LARGEST]
    finite = sum(each["finite"] for each in measured.values())
    right = [name for name in exact if measured[name]["end_off_c"] <= LARGEST]
    plain = [each["plain"] for each in measured.values() if "plain" in each]
    refusals = sum(isinstance(each, str) and each != "NaN" for each in plain)
    wrong = sum(each == "NaN" or (not isinstance(each, str) and each > LARGEST) for each in plain)
    off = [_row(name, each) for name, each in measured.items() if name not in right]
    cost = [_cost(name, each) for name, each in measured.items() if "compile_s" in each]
    refused = [
        f"| {name} | {' '.join(each['failed'].split()).replace('|', '/')} |"
        for name, each in models.items()
        if "error" not in each
    ]
    said = [
        f"{len(measured)} models; the gradients of {finite} are finite, and {len(exact)} are within {LARGEST:g} of the "
        f"differences, {sum(measured[name]['rows'] > 0 for name in exact)} of these with constraints and "
        f"{sum(measured[name]['contacts'] > 0 for name in exact)} with contacts. `mjx.step` was differentiated on "
        f"{len(plain)} of them: it refuses {refusals}, and {wrong} more gradients are wrong or NaN.",
        *_table("Where something is off:", _OFF, off),
        f"Gradient within {LARGEST:g} of the differences, and end of C's, on {len(right)}:",
        "\n".join(_names(right)),
        *_table("What it costs:", _COST, cost),
        *_table("Not measured:", "| model | because |", refused),
    ]
    return "\n\n".join(said)


def _table(title: str, head: str, rows: list[str]) -> list[str]:
    """Nothing if there are no rows."""
    return [title, "\n".join([head, "|---" * (head.count("|") - 1) + "|", *rows])] if rows else []


def _names(models: list[str]) -> list[str]:
    """A line for each folder of models."""
    folders: dict[str, list[str]] = {}
    for name in models:
        folder, _, own = name.rpartition("/")
        folders.setdefault(folder, []).append(own)
    return [
        f"- {folder}: {', '.join(names)}" if folder else f"- {', '.join(names)}" for folder, names in folders.items()
    ]


def _row(name: str, each: dict[str, Any]) -> str:
    """With a path that a browser may break."""
    rows = f"{each['contacts']}, {each['rows']}"
    errors = (_error(each[key]) for key in ("error", "spread", "end_off_c"))
    return f"| {' | '.join([name.replace('/', '/<wbr>'), str(each['nv']), rows, *errors])} |"


def _cost(name: str, each: dict[str, Any]) -> str:
    cosine = "" if each.get("cosine") is None else f"{each['cosine']:.7f}"
    times = f"{each['trace_s']:.1f}, {each['compile_s']:.1f} | {each['forward_ms']:.3f} | {each['ratio']:.1f}"
    return f"| {name} | {times} | {cosine} |"


def _error(value: float) -> str:
    shown = f"{value:.0e}"
    return f"**{shown}**" if value > LARGEST else shown


@click.command()
@click.argument("lines", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("target", metavar="PAGE", type=click.Path(exists=True, dir_okay=False, path_type=Path))
def main(lines: Path, target: Path) -> None:
    """Put the table of LINES into PAGE, between its two comments."""
    text = target.read_text()
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    target.write_text(f"{before}{BEGIN}\n\n{page(lines)}\n\n{END}{after}")


if __name__ == "__main__":
    main()
