"""The table of the results of `step_matrix`, in a page: `python docs/benchmarks/step_page.py LINES PAGE`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import click
from step_matrix import lines_of

BEGIN: Final = "<!-- made by step_page.py -->"
END: Final = "<!-- end -->"
#: Largest error at which a gradient counts as equal to the differences.
LARGEST: Final = 1e-4
_HEAD: Final = (
    "| model | nv | contacts, rows | against differences | differences among themselves | end against C "
    "| float32, cosine | `mjx.step` | trace, compile [s] | a step [ms] | gradient over steps |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def page(lines: Path) -> str:
    """The text between `BEGIN` and `END`: number of correct models, their table, and the others."""
    models = lines_of(lines)
    measured = {name: each for name, each in models.items() if "error" in each}
    exact = [name for name, each in measured.items() if each["finite"] and each["error"] <= LARGEST]
    finite = sum(each["finite"] for each in measured.values())
    refused = {name: each["failed"] for name, each in models.items() if "error" not in each}
    said = [
        f"{len(measured)} models; the gradients of {finite} are finite, and {len(exact)} are within {LARGEST:g} of the "
        f"differences, {sum(measured[name]['rows'] > 0 for name in exact)} of these with constraints and "
        f"{sum(measured[name]['contacts'] > 0 for name in exact)} with contacts.",
        "\n".join([_HEAD, *(_row(name, each) for name, each in sorted(measured.items()))]),
    ]
    if refused:
        said.append(
            "Not measured:\n\n| model | because |\n|---|---|\n"
            + "\n".join(
                f"| {name} | {' '.join(reason.split()).replace('|', '/')} |" for name, reason in sorted(refused.items())
            )
        )
    return "\n\n".join(said)


def _row(name: str, each: dict[str, Any]) -> str:
    plain = each.get("plain", each.get("failed", ""))
    cost = "compile_s" in each
    cells = [
        name,
        each["nv"],
        f"{each['contacts']}, {each['rows']}",
        _error(each["error"]),
        _error(each["spread"]),
        _error(each["end_off_c"]),
        "" if each.get("cosine") is None else f"{each['cosine']:.7f}",
        plain if isinstance(plain, str) else _error(plain),
        f"{each['trace_s']:.1f}, {each['compile_s']:.1f}" if cost else "",
        f"{each['forward_ms']:.3f}" if cost else "",
        f"{each['ratio']:.1f}" if cost else "",
    ]
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


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
