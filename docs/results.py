"""Makes the figures, tables, moving pictures and numbers that the docs show, from the list docs/results.yaml.

    python docs/results.py --list           # what is fresh, what is stale, and what it costs
    python docs/results.py --only free_gait
    python docs/results.py                  # what is stale, up to half an hour of processor time; again for the rest

A result is stale when the body, the controller, the metrics, its files or its commands are no longer those with which
it was made: docs/answers/stamps.json has a digest of each. Work goes on in runs/results where it was interrupted.
Results of more than half an hour are made with `--only` alone.

Numbers and tables come from docs/answers/*.json. A page has them as `<!-- NAME -->text<!-- /NAME -->`, or `<!-- / -->`;
the text is written here, never typed. The site lists the results of a page at its end (docs/conf.py).
"""

from __future__ import annotations

import ast
import dataclasses
import datetime
import functools
import hashlib
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from ruamel.yaml import YAML

from nermo_mjx import Setup, __version__
from nermo_mjx.recording import model_hash
from nermo_mjx.runs.files import replace_file

ROOT = Path(__file__).parents[1]
ANSWERS = ROOT / "docs" / "answers"
STAMPS = ANSWERS / "stamps.json"
#: A part of the work [minutes of processor time].
PART = 30.0
PROFILES = ("exact", "as_published", "as_built")
#: Parameters of the body, by the first part of their names.
OF_BODY = (
    "servo",
    "battery",
    "contact",
    "stiffness",
    "damping",
    "mass",
    "build",
    "ground",
    "geometry",
)
#: What each digest is of, beside the body. Tests hold the loop and the engines, which call it, to the same walks.
SOURCES = {
    "controller": ("control/[!_]*.py", "kinematics/*.py"),
    "metrics": tuple(
        f"rollout/{name}.py"
        for name in ("*_metrics", "metrics", "electrical", "reduction", "transitions")
    ),
}
#: Doors for code of others.
NOT_COUNTED = ("protocol.py", "custom_metrics.py")
MARKED = re.compile(r"(<!-- ([\w.]+) -->)(.*?)(<!-- /(?:\2)? -->)", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Result:
    """An entry of docs/results.yaml.

    Attributes:
        pages: that show it, relative to docs.
        minutes: of processor time.
        run: commands; `DIR` is its directory. What the last one prints goes to `prints`, if given. None: made by hand.
        writes: files of the docs that the commands write, or patterns of them.
        copies: file in its directory -> file of the docs; a figure becomes WebP.
        robot: whose body it depends on; "any" for models of others and for machines.
        also: further rooms of the package on which it depends.
        made: when it was last made, for one that this program has not made yet.
        why: it is made with `--only` alone, or by hand.
    """

    pages: list[str]
    minutes: float
    run: list[str]
    prints: str | None = None
    writes: list[str] = dataclasses.field(default_factory=list)
    copies: dict[str, str] = dataclasses.field(default_factory=dict)
    robot: str = "nermo_lite"
    also: list[str] = dataclasses.field(default_factory=list)
    made: datetime.date | None = None
    why: str = ""

    @property
    def outputs(self) -> list[str]:
        """Files of the docs, relative to the repository."""
        return [*([self.prints] if self.prints else []), *self.writes, *self.copies.values()]


def results() -> dict[str, Result]:
    listed = YAML(typ="safe").load((ROOT / "docs" / "results.yaml").read_text())
    return {name: Result(**entry) for name, entry in listed.items()}


def stamps() -> dict[str, Any]:
    return json.loads(STAMPS.read_text()) if STAMPS.exists() else {}


def digest(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:12]


def code(path: Path) -> str:
    """A source without its comments, docstrings and imports, which change no result; other files as they are."""
    text = path.read_text(encoding="utf-8", errors="replace")
    if path.suffix == ".ipynb":
        return json.dumps(
            [cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        )
    if path.suffix != ".py":
        return text
    lines = text.splitlines()
    for node in ast.walk(ast.parse(text)):
        value = node.value if isinstance(node, ast.Expr) else None
        prose = isinstance(value, ast.Constant) and isinstance(value.value, str)
        if prose or isinstance(node, (ast.Import, ast.ImportFrom)):
            lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    return "\n".join(line for line in lines if line.strip() and not line.lstrip().startswith("#"))


@functools.cache
def digest_of_sources(*patterns: str) -> str:
    files = sorted(
        {
            path
            for each in patterns
            for path in (ROOT / "nermo_mjx").glob(each)
            if path.name not in NOT_COUNTED
        }
    )
    return digest(*((str(path.relative_to(ROOT)), code(path)) for path in files))


@functools.cache
def body(robot: str) -> str:
    """Digest of a robot's structure and of its parameters' defaults, servos and contact among them, in all profiles.

    Six digits of each: with MuJoCo's versions the last ones may change.
    """
    setups = [Setup(robot=robot, profile=profile) for profile in PROFILES]
    bodies = [
        {n: f"{v:.6g}" for n, v in each.defaults().items() if n.split(".")[0] in OF_BODY}
        for each in setups
    ]
    return digest(model_hash(setups[0].load().model), *bodies)


def digests(result: Result) -> dict[str, str]:
    """What a result stands on."""
    words = [
        word
        for command in result.run
        for word in shlex.split(command)
        if word not in result.outputs
    ]
    files = [ROOT / word for word in words if (ROOT / word).is_file()]
    found = {"commands and files": digest(result.run, *map(code, files))}
    if result.robot != "any":
        found |= {"body": body(result.robot)} | {
            name: digest_of_sources(*each) for name, each in SOURCES.items()
        }
    return found | (
        {", ".join(result.also): digest_of_sources(*(f"{room}/**/*.py" for room in result.also))}
        if result.also
        else {}
    )


def stale(name: str, result: Result) -> list[str] | None:
    """What has changed since a result was made, or which of its files is missing; None if it has no stamp."""
    if (stamp := stamps().get(name)) is None:
        return None
    changed = [what for what, now in digests(result).items() if stamp["digests"].get(what) != now]
    return changed + [output for output in result.outputs if not any(ROOT.glob(output))]


def told(name: str, result: Result) -> str:
    """When, with which version and of which body a result was made, and whether it is stale; a line."""
    if (changed := stale(name, result)) is None:
        return f"{result.made}, without a stamp, so perhaps of another body" + (
            f"; {result.why}" if result.why else ""
        )
    stamp = stamps()[name]
    of = f", body {stamp['digests']['body'][:8]}" if "body" in stamp["digests"] else ""
    made = f"{stamp['date']}, version {stamp['version']}{of}"
    return made + (f"; stale, since these changed: {', '.join(changed)}" if changed else "")


def make(name: str, result: Result) -> None:
    """Run a result's commands, keep what they give, and stamp it."""
    now = digests(result)
    out = ROOT / "runs" / "results" / f"{name}-{digest(now)}"
    out.mkdir(parents=True, exist_ok=True)
    for number, command in enumerate(result.run, 1):
        words = shlex.split(command.replace("DIR", str(out)))
        start = {"nermo-mjx": [sys.executable, "-m", "nermo_mjx"], "python": [sys.executable]}.get(
            words[0], words[:1]
        )
        kept = result.prints is not None and number == len(result.run)
        pipe = subprocess.PIPE if kept else None
        done = subprocess.run([*start, *words[1:]], cwd=ROOT, text=True, stdout=pipe)
        if done.returncode:
            raise click.ClickException(f"{name}: exit code {done.returncode} of {command}")
        if kept:
            replace_file(ROOT / result.prints, done.stdout.encode())
    for source, target in result.copies.items():
        if target.endswith(".webp"):
            subprocess.run(
                [sys.executable, ROOT / "docs" / "pictures.py", out / source, ROOT / target],
                check=True,
            )
        else:
            shutil.copy(out / source, ROOT / target)
    stamp = {"date": f"{datetime.date.today()}", "version": __version__, "digests": now}
    replace_file(
        STAMPS,
        (json.dumps(dict(sorted((stamps() | {name: stamp}).items())), indent=1) + "\n").encode(),
    )


def numbers() -> dict[str, str]:
    """Texts by name, from docs/answers."""
    found: dict[str, str] = {}
    for path in sorted(ANSWERS.glob("*.json")):
        if path != STAMPS:
            found |= json.loads(path.read_text(encoding="utf-8"))
    return found


def pages() -> Iterable[Path]:
    return (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))


def filled(text: str, known: dict[str, str]) -> str:
    """A page with the numbers that it names, and tables on lines of their own; other comments stay."""
    told = {name: f"\n{each}\n" if "\n" in each else each for name, each in known.items()}
    return MARKED.sub(lambda found: found[1] + told.get(found[2], found[3]) + found[4], text)


def footer(page: str) -> str:
    """What a page of the site says about the results that it shows, in Markdown; nothing if there are none."""
    shown = {name: result for name, result in results().items() if page in result.pages}
    if not shown:
        return ""
    old = sum(
        bool(each) or each is None
        for each in (stale(name, result) for name, result in shown.items())
    )
    title = "How the results of this page were made" + (
        f": {old} of {len(shown)} are stale or have no stamp" if old else ""
    )
    lines = []
    for name, result in shown.items():
        commands = "".join(f"; `{command}`" for command in result.run)
        lines.append(f"- **{name.replace('_', ' ')}**: {told(name, result)}{commands}")
    return "\n".join(["", "", f":::{{dropdown}} {title}", *lines, ":::", ""])


@click.command(help=__doc__)
@click.option(
    "--only", multiple=True, metavar="NAME", help="This result, whatever it costs; may be repeated."
)
@click.option(
    "--list", "listed", is_flag=True, help="Say what is stale and what it costs, and make nothing."
)
@click.option(
    "--minutes", default=PART, help="Of processor time, at most, by the costs in the list."
)
def main(only: tuple[str, ...], listed: bool, minutes: float) -> None:
    known = results()
    if unknown := set(only) - set(known):
        raise click.UsageError(f"docs/results.yaml has no {', '.join(sorted(unknown))}.")
    left = minutes
    for name, result in known.items():
        if only and name not in only:
            continue
        fresh = stale(name, result) == []
        if listed or fresh:
            click.echo(
                f"{'fresh' if fresh else 'stale'}  {name}, {result.minutes:g} min: {told(name, result)}"
            )
        elif not result.run or (not only and (result.minutes > PART or result.why)):
            click.echo(
                f"apart  {name}, {result.minutes:g} min: {result.why or f'with --only {name}'}"
            )
        elif not only and result.minutes > left:
            click.echo(f"left   {name}, {result.minutes:g} min: for the next part")
        else:
            left -= result.minutes
            click.echo(f"makes  {name}, about {result.minutes:g} min")
            make(name, result)
    if not listed:
        for page in pages():
            if (now := filled(text := page.read_text(encoding="utf-8"), numbers())) != text:
                page.write_text(now, encoding="utf-8")
                click.echo(f"filled {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
