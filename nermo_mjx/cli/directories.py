"""The commands that read directories of results and print, draw or compare their tables: status, plot, compare, sensitivity."""

from __future__ import annotations

import collections
import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import FORMATS, METRICS
from nermo_mjx.cli.kinds import RECORDING, Kind, kind_of_directory
from nermo_mjx.cli.logs import compare_files, log_channels
from nermo_mjx.cli.options import FileKind, column, flag
from nermo_mjx.cli.output import (
    Failure,
    Output,
    WrongUse,
    command,
    in_unit,
    print_pairs,
    print_table,
    room,
    say,
)
from nermo_mjx.progress import ProgressBar

if TYPE_CHECKING:
    from nermo_mjx.plotting.files import Figures
    from nermo_mjx.runs.status import Status
    from nermo_mjx.sweep.comparing import Comparison


@command("status", reads=True)
@click.argument("path", metavar="DIR", type=options.PATH)
def status_command(path: Path) -> Output:
    """Show what DIR contains, its progress, what made it, and how to resume.

    DIR is the directory of a sweep, a search, a tuning, a training,
    experiments or an identification, of this release or an earlier one,
    finished or in progress. It is only read.

    Examples:
      nermo-mjx status runs/quickstart
      nermo-mjx status runs/published --json
    """
    from nermo_mjx.runs import codes_of
    from nermo_mjx.runs.directory import read_record

    kind = kind_of_directory(path)
    status: Status = kind.load(kind.status)(path)
    codes, sessions = codes_of(path), read_record(path).get("sessions") or status.sessions

    def show() -> None:
        of_all = f" of {status.rows:,}" if status.rows is not None and not status.complete else ""
        amount = f"{status.rows_done:,}{of_all} {status.unit}, {'complete' if status.complete else 'not complete'}"
        click.echo(f"{path}: {kind.called}, {amount}")
        code_names = [f"{name}: {code}" for name, code in codes.items()] or [
            ", ".join(status.code) or "not known"
        ]
        pairs = [
            ("engine", status.engine or "not known"),
            *(("code", code_name) for code_name in code_names),
        ]
        action = "figures" if status.complete and " plot " in status.command else "resume"
        notes = [("note", note) for note in status.notes]
        command_text = status.command or "with the command that started it, not recorded here"
        print_pairs([*pairs, *_worked(sessions), *notes, (action, command_text)])

    content = {name: getattr(status, name) for name in ("rows", "rows_done", "engine", "complete")}
    return Output({"kind": kind.name, **content, "code": [*codes] or status.code}, show)


def _worked(sessions: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The newest sessions: their times, versions, machines and commands."""
    from nermo_mjx.runs.code import local_time

    latest = sessions[-3:]
    if len(sessions) > len(latest):
        yield "session", f"and {len(sessions) - len(latest)} earlier"
    for entry in latest:
        versions, machine = entry.get("versions", {}), entry.get("machine", {})
        version_text = ", ".join(
            f"{name} {versions[name]}"
            for name in ("nermo-mjx", "mujoco", "jax")
            if name in versions
        )
        machine_text = ", ".join(
            str(machine[name]) for name in ("host", "processor") if name in machine
        )
        cores = f", {machine['cores']} cores" if "cores" in machine else ""
        yield (
            "session",
            f"{local_time(entry.get('started', 'some time'))}, {version_text}, on {machine_text}{cores}",
        )
        if entry.get("command"):
            yield "", str(entry["command"])


@command("plot", reads=True)
@click.argument("path", metavar="PATH", type=FileKind(".npz"))
@options.text("--out", "DIR", "Where the figures go; by default PATH/plots.", type=options.FOLDER)
@click.option("--format", "form", type=click.Choice(FORMATS), help="By default both.")
@column("--x", "One figure of these columns: across,")
@column("--y", "up (by default the speed),")
@column("--color", "and as colours.")
def plot_command(path: Path, out: Path | None, form: str | None, **columns: str | None) -> Output:
    """Redraw the figures of PATH from its tables; nothing is simulated.

    PATH is the directory of a sweep, a search, a tuning, a training or
    experiments, or a recording FILE.npz: gait diagram, orientation, foot
    paths, servo angles, path over the ground.

    --x, --y and --color choose columns of a table: two parameters of a grid
    give a heat map, two metrics with a better direction a Pareto front, other
    columns a scatter plot. --color alone, with a metric, gives the usual
    figures for it.

    Examples:
      nermo-mjx plot runs/quickstart
      nermo-mjx plot runs/quickstart --x speed --y cost_of_transport
      nermo-mjx plot runs/quickstart --x frequency --y spine.phase --color slip
      nermo-mjx plot walk.npz --out plots --format png
    """
    kind = RECORDING if path.is_file() else kind_of_directory(path)
    if not set(columns) <= set(kind.options) and any(columns.values()):
        subject = "" if kind is RECORDING else "the directory of "
        raise WrongUse(
            f"--x, --y and --color choose columns of a sweep or a search, but {path} is {subject}{kind.called}."
        )
    if out is None and kind is RECORDING:
        raise WrongUse(f"{path} is a recording: give the directory for its figures with --out DIR.")
    notes: list[str] = []
    figure_options = {
        name: value
        for name, value in {**columns, "notify": notes.append}.items()
        if name in kind.options
    }
    from nermo_mjx.plotting.files import write_figures

    figures, folder = (
        kind.load(kind.figures)(path, **figure_options),
        path / "plots" if out is None else out,
    )
    with _drawing(kind, path, folder, notes) as write:
        files = write_figures(figures, folder, write, FORMATS if form is None else (form,))
    if not files:
        reason = " ".join(notes) or "its tables have no figures."
        raise Failure(f"there is nothing to draw of {path}: {reason}")
    for note in notes:
        say(note)
    return Output({"path": path, "kind": kind.name, "files": files, "notes": notes}, files=files)


@contextlib.contextmanager
def _drawing(
    kind: Kind, path: Path, folder: Path, notes: list[str]
) -> Iterator[Callable[[Path, bytes], None]]:
    """Lock a folder for figures, which is created if it is missing, and yield the function that writes files into it.

    In a directory that records its own files, other files are renamed as a backup.

    Raises:
        DirectoryError: Another command writes figures into the folder, or it cannot be written.
    """
    from nermo_mjx.runs import RunDirectory, Written
    from nermo_mjx.runs.directory import hold
    from nermo_mjx.runs.files import clear_errors, make_writable, replace_file

    make_writable(folder)
    with contextlib.ExitStack() as stack:
        with clear_errors(folder):
            stack.enter_context(hold(folder))
        if not kind.tracked or folder != path / "plots":
            yield replace_file
            return
        with RunDirectory(path, kind.name) as directory, Written(directory) as written:
            yield written.write
        notes += filter(None, [written.sentence()])


_report_out = options.text(
    "--out",
    "DIR|FILE",
    "A directory for table, JSON and figures, or FILE.csv or FILE.parquet for the table only.",
    type=options.PATH,
)


@command("compare", reads=True)
@click.argument("a", metavar="A", type=options.PATH)
@click.argument("b", metavar="[B]", required=False, type=options.PATH)
@column("--by", "Compare the values of a column in A.")
@options.text("--base", "VALUE", "The baseline value; by default none, or the first.")
@column(
    "--for",
    "An interval for each value of a column; repeatable: for each combination.",
    multiple=True,
)
@options.text("--where", "NAME=VALUE", "Only runs with this value of a column.", multiple=True)
@column(
    "--metric",
    "Metric to show; by default all, and for groups the speed.",
    suggestions=METRICS,
    multiple=True,
)
@flag("--all", "Every row and column, also those that are equal, empty or too wide.")
@_report_out
@log_channels
def compare_command(
    a: Path,
    b: Path | None,
    by: str | None,
    base: str | None,
    where: tuple[str, ...],
    out: Path | None,
    channels: Path | None,
    **choices: Any,
) -> Output:
    """Compare two sweeps, A and B, or with --by the values of a column of A; or
    a robot's log with another one, or with a recording of the twin.

    Runs are paired by variant and seed; the partner of a lost run is left
    out. Each metric's difference, B minus A or value minus base, has a 95 %
    interval, by Student's t over the variants, or the runs of one. Those
    beyond noise are marked with a star: at most 5 % of them are expected to
    be false. A terminal shows what differs, and the columns that fit.

    Of logs and recordings, the channels that both have are compared at the
    time stamps of the coarser one, B minus A: RMS, mean and lag of B behind A.
    Two logs of one command show how well the robot repeats itself.

    Examples:
      nermo-mjx compare runs/stiff runs/bending --for frequency --out runs/gain
      nermo-mjx compare runs/spine_gain --by spine --for gait --for frequency
      nermo-mjx compare runs/spine_gain --by spine --where gait=trot --json
      nermo-mjx compare robot.csv twin.npz
    """
    needs = dict.fromkeys(
        ("by", "base", "for", "where", "metric", "all", "out"), "directories of sweeps"
    )
    options.refuse_without(
        needs | {"channels": "a robot's log"},
        {needs["by"]: not a.is_file(), "a robot's log": a.is_file()},
    )
    if a.is_file():
        if b is None:
            raise WrongUse(f"{a} is a file: give another log or recording to compare it with.")
        return compare_files(a, b, channels)
    if (b is None) == (by is None):
        raise click.UsageError("Give two directories A and B, or one and --by NAME.")
    if base is not None and by is None:
        raise click.UsageError(
            "--base is a value of --by; for two directories, the first one is the base."
        )
    conditions = {}
    for text in where:
        name, equals, value = text.partition("=")
        if not equals:
            raise click.UsageError(f"--where {text}: expected NAME=VALUE, such as gait=trot.")
        conditions[name.strip()] = value.strip()
    from nermo_mjx.sweep.comparing import compare, figures_of_comparison

    with ProgressBar("compare") as bar:
        told_of = {"groups": choices["for"], "where": conditions, "drawn": choices["metric"]}
        comparison = compare(a, b, by=by, base=base, **told_of, progress=bar.share)
    return _report(
        "comparison",
        comparison,
        figures_of_comparison,
        out,
        lambda: _print_comparison(comparison, choices["metric"], show_all=choices["all"]),
    )


def _report(
    kind: str,
    report: Any,
    figures: Callable[[Any], Figures],
    out: Path | None,
    show: Callable[[], None],
) -> Output:
    """The output of a command whose result is a table; with `out`, the table and its figures are written."""
    files = list[Path]()
    if out is not None:
        from nermo_mjx.sweep.table import write_report

        files, backups = write_report(
            out, kind, report.table, report.about(), figures(report.table)
        )
        if backups:
            say(backups)
    return Output({**report.about(), "files": files}, show, files)


#: Maximum number of groups of a metric that a terminal shows: those with the smallest p values.
_MOST_GROUPS = 30


# Long because it prints the parts of one report in their order.
def _print_comparison(comparison: Comparison, metrics: Sequence[str], *, show_all: bool) -> None:
    """Print tables of the chosen metrics, or of all metrics, over all variants, and of the drawn metrics by groups.

    On a terminal, the tables have the rows that differ and the columns that fit.
    """
    from nermo_mjx.rollout.metric_table import headed
    from nermo_mjx.sweep.table import profile_text

    profile = profile_text(comparison.profiles)
    headings, hidden, columns = headed(), collections.Counter[str](), dict[str, None]()
    show_all = show_all or room() is None

    def unit(row: Mapping[str, Any]) -> str:
        return in_unit(row["metric"], row["metric_unit"])[1] or "1"

    def chosen(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Rows with a difference; of many groups, the rows with the smallest p values."""

        def shown(row: Mapping[str, Any]) -> bool:
            equal = (
                "equal on both sides"
                if row["difference"] == 0 and row["low"] == row["high"]
                else ""
            )
            why = equal if row["variants"] else "without a run"
            hidden.update([why] if why else [])
            return not why

        shown_rows = rows if show_all else [row for row in rows if shown(row)]
        if (
            show_all
            or not shown_rows
            or shown_rows[0]["group"] < 0
            or len(shown_rows) <= _MOST_GROUPS
        ):
            return shown_rows
        hidden["less sure"] += len(shown_rows) - _MOST_GROUPS
        order = sorted(
            range(len(shown_rows)),
            key=lambda i: shown_rows[i]["p"] if math.isfinite(shown_rows[i]["p"]) else 2.0,
        )
        return [shown_rows[i] for i in sorted(order[:_MOST_GROUPS])]

    def show(title: str, heads: list[Any], numbers: list[Any], cells: list[list[Any]]) -> None:
        first, unit_too = len(heads), [1] if heads[1:] == ["unit"] else []
        lost = [] if any(line[first + 6] for line in cells) else [first + 6]
        spare = [] if show_all else [*lost, first + 5, first, first + 1, first + 4, *unit_too]
        columns.update(
            dict.fromkeys(filter(None, print_table(title, [*heads, *numbers], cells, spare)))
        )

    for sentence in comparison.lost:
        click.echo(f"{sentence}\n")
    for other_name in comparison.others:
        numbers: list[Any] = [(comparison.base, "right"), (other_name, "right")]
        numbers += ["difference>", "95 % interval", "relative>", "variants>", "lost", ""]
        cells, heading = list[list[Any]](), ""
        for row in chosen(
            [row for row in comparison.rows(other_name) if not metrics or row["metric"] in metrics]
        ):
            if (now := headings.get(row["metric"], "Own metrics")) != heading:
                heading = now
                cells.append([f"{heading}:", *[""] * (1 + len(numbers))])
            cells.append([row["metric"], unit(row), *_cells(row)])
        show(f"{other_name} minus {comparison.base}, {profile}", ["metric", "unit"], numbers, cells)
        for metric in comparison.drawn if comparison.groups else ():
            lines = chosen(
                [
                    row
                    for row in comparison.rows(other_name, grouped=True)
                    if row["metric"] == metric
                ]
            )
            cells = []
            for row in lines:
                group = [
                    f"{group_value:.6g}" if isinstance(group_value, float) else group_value
                    for group_value in map(row.get, comparison.groups)
                ]
                cells.append([*group, *_cells(row)])
            heads: list[Any] = [(name, "right") for name in comparison.groups]
            if lines:
                show(
                    f"{metric} [{unit(lines[0])}]: {other_name} minus {comparison.base}, {profile}",
                    heads,
                    numbers,
                    cells,
                )
    for side, counts in comparison.status.items():
        click.echo(
            f"{side}: {', '.join(f'{count:,} {status}' for status, count in counts.items())}"
        )
    for note in comparison.notes[len(comparison.lost) :]:
        click.echo(note)
    hidden_notes = [
        f"rows {why} ({hidden_count:,})" for why, hidden_count in hidden.items() if hidden_count
    ]
    hidden_notes += [f"the columns {', '.join(columns)}"] if columns else []
    if hidden_notes:
        click.echo(f"Not shown, but with --all: {'; '.join(hidden_notes)}.")
    click.echo("* beyond noise; at most 5 % of all marked differences are expected to be false")


def _cells(row: Mapping[str, Any]) -> list[str]:
    shares = row["lost_base"], row["lost_other"]
    lost_text = (
        ", ".join(f"{float(f'{100 * share:.2g}'):g} %" for share in shares) if any(shares) else ""
    )
    if not row["variants"]:
        return ["", "", "no run has it", "", "", "0", lost_text, ""]
    values = (row[name] for name in ("base_mean", "other_mean", "difference", "low", "high"))
    (base, other_mean, difference, low, high), _ = in_unit(
        row["metric"], row["metric_unit"], *values
    )
    interval = f"[{low:.3g}, {high:.3g}]" if math.isfinite(low) else ""
    relative = (
        f"{row['relative']:+.1%}".replace("%", " %") if math.isfinite(row["relative"]) else ""
    )
    means = [f"{base:.4g}", f"{other_mean:.4g}", f"{difference:+.3g}"]
    return [
        *means,
        interval,
        relative,
        str(row["variants"]),
        lost_text,
        "*" if row["beyond_noise"] else "",
    ]


@command("sensitivity", reads=True)
@click.argument("path", metavar="DIR", type=options.PATH)
@column("--metric", "Whose variance.", suggestions=METRICS, default="speed", show_default=True)
@_report_out
def sensitivity_command(path: Path, metric: str, out: Path | None) -> Output:
    """Estimate each parameter's share of a metric's variance in a sweep.

    Sobol indices with 95 % intervals: first order, alone; total, including
    interactions; second order, of pairs. A sweep with sample: {saltelli: N}
    gives all of them, any other random sample the first-order ones.

    Examples:
      nermo-mjx sensitivity runs/robustness
      nermo-mjx sensitivity runs/robustness --metric roll_std --out runs/roll
    """
    from nermo_mjx.sweep.sensitivity import figures_of_indices, sensitivity

    analysis = sensitivity(path, metric)

    def show() -> None:
        from nermo_mjx.sweep.table import labelled

        structures = labelled(analysis.table)
        rows = [
            [
                *(line[name] for name in structures),
                f"{line['parameter']} {line['second']}".strip(),
                line["order"],
                f"{line['index']:.3f}",
                f"[{line['low']:.3f}, {line['high']:.3f}]",
            ]
            for line in sorted(
                analysis.table.to_pylist(), key=lambda line: (line["order"], -line["index"])
            )
        ]
        heads: list[Any] = [
            *((name, "left") for name in structures),
            "parameter",
            "order",
            "index>",
            "95 % interval",
        ]
        print_table(f"{analysis.metric}: share of the variance", heads, rows)
        for note in analysis.notes:
            click.echo(note)

    return _report("sensitivity", analysis, figures_of_indices, out, show)
