"""Options shared by commands, short ways to declare them, and their completion in a shell. It imports nothing heavy."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from nermo_mjx.cli.choices import (
    ENGINES,
    GAITS,
    HEADS,
    METRICS,
    PARAMETERS,
    PHYSICS,
    PROFILES,
    ROBOTS,
    SCENES,
    SPINE_MODES,
    STEERINGS,
    TAIL_MOTIONS,
    TAILS,
    TRAJECTORIES,
    VIEWS,
)
from nermo_mjx.cli.output import WrongUse
from nermo_mjx.runtime import THREADS

if TYPE_CHECKING:
    from nermo_mjx.robot import Quantity
    from nermo_mjx.runs.workers import Workers


Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def names(*known: str, end: str = "") -> Completer:
    """Completes one of these names, and what follows each of them."""

    def complete(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        found = [name + end for name in known if name.startswith(incomplete)]
        # A shell adds a space after a single offer; a second one prevents that before the value.
        return [CompletionItem(each) for each in (found if len(found) != 1 or not end else [*found, f"{found[0]}X"])]

    return complete


class FileKind(click.Path):
    """A path completed with files of certain suffixes, and the folders leading to them."""

    def __init__(self, *endings: str, **settings: Any) -> None:
        super().__init__(path_type=Path, **settings)
        self.endings = endings

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        found = offered(incomplete, self.endings)
        # If nothing matches, the shell offers its own completions.
        return [CompletionItem(each) for each in found] or [CompletionItem(incomplete, type="file")]


def offered(incomplete: str, endings: tuple[str, ...]) -> list[str]:
    """Files with one of the suffixes, and folders with a slash, that begin with the typed text.

    A single folder is entered, because a shell adds a space after a single offer.
    """
    folder, _, begin = incomplete.rpartition("/")
    where = Path(folder or ("/" if incomplete.startswith("/") else ".")).expanduser()
    prefix = incomplete[: len(incomplete) - len(begin)]
    try:
        entries = sorted(where.iterdir())
    except OSError:
        return []
    fitting = [e for e in entries if e.name.startswith(begin) and (begin.startswith(".") or e.name[0] != ".")]
    folders = [f"{prefix}{e.name}/" for e in fitting if e.is_dir()]
    files = [f"{prefix}{e.name}" for e in fitting if not e.is_dir() and e.name.endswith(endings)]
    if len(folders) == 1 and not files:
        return offered(folders[0], endings) or folders
    return sorted(folders + files)


def assigned(texts: Iterable[str], known: Mapping[str, Quantity]) -> dict[str, float]:
    """Names and values of every NAME=X, where NAME may be a pattern; ranges are not checked. The last one wins.

    Args:
        texts: as given.
        known: the parameters that may be named.

    Raises:
        WrongUse: a text is something else.
    """
    from nermo_mjx.robot.quantity import nearest
    from nermo_mjx.specs.walk import is_pattern, matches

    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = (part.strip() for part in text.partition("="))
        if not equals:
            example, about = next(iter(known.items()))
            raise WrongUse(f"--set {text}: expected NAME=VALUE, such as {example}={about.default:g}.")
        found = matches(name, known) if is_pattern(name) else [name] if name in known else []
        if not found:
            near = None if is_pattern(name) else nearest(name, known)
            what = "matches no parameter" if is_pattern(name) else "is not a parameter"
            hint = f"did you mean {near}?" if near else "`nermo-mjx sweep --list-parameters` prints all."
            raise WrongUse(f"--set {text}: {name} {what}; {hint}")
        try:
            values |= dict.fromkeys(found, float(number))
        except ValueError:
            allowed = known[found[0]].allowed()
            raise WrongUse(f"--set {text}: {number!r} is not a number; allowed is {allowed}.") from None
    return values


F = TypeVar("F", bound=Callable[..., Any])
POSITIVE = click.FloatRange(0, min_open=True)
#: Files that are read: of a sweep or a tuning, and recordings.
SPEC = FileKind(".yaml", ".yml")
RECORDING = FileKind(".npz", exists=True, dir_okay=False)
#: Completes the columns of a sweep's table.
columns = names(*PARAMETERS, *METRICS)


def choice(name: str, names: tuple[str, ...], about: str | None = None, **more: Any) -> Callable[[F], F]:
    """An option that allows some names; the first is the default unless `default` is given."""
    settings: dict[str, Any] = {"default": names[0], "show_default": True} | more
    return click.option(name, type=click.Choice(names), help=about, **settings)


def _modes(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes the last of several names joined by "+"."""
    before, plus, last = incomplete.rpartition("+")
    return [CompletionItem(before + plus + mode) for mode in SPINE_MODES if mode.startswith(last)]


def number(name: str, about: str, kind: Any = float, **more: Any) -> Callable[[F], F]:
    """An option that takes a number."""
    whole = isinstance(kind, click.IntRange)
    settings: dict[str, Any] = {"metavar": "N" if whole else "X", "show_default": "default" in more} | more
    return click.option(name, type=kind, help=about, **settings)


def file(name: str, suffix: str, about: str, **more: Any) -> Callable[[F], F]:
    """An option that names a file to write."""
    return click.option(name, metavar=f"FILE{suffix}", type=FileKind(suffix, dir_okay=False), help=about, **more)


def given() -> dict[str, str]:
    """Flags of the options of this call that are not at their defaults, by name."""
    context = click.get_current_context()
    return {
        each.name or "": each.opts[0]
        for each in context.command.params
        if context.get_parameter_source(each.name or "") is not ParameterSource.DEFAULT
    }


def _keep_threads(ctx: click.Context, parameter: click.Parameter, value: int | None) -> None:
    """For this process, and for those that it starts."""
    if value is not None:
        os.environ[THREADS] = str(value)


#: The directory of results, and that, or a file, of what is found in finished tables: see `nermo_mjx.sweep.table`.
out = click.option(
    "--out", metavar="DIR", required=True, type=click.Path(file_okay=False, path_type=Path), help="Where results go."
)
report_out = click.option(
    "--out",
    metavar="DIR|FILE",
    type=click.Path(path_type=Path),
    help="A directory for table, JSON and figures, or FILE.csv or FILE.parquet for the table only.",
)
threads = number(
    "--threads",
    "Number of CPU cores for the engine c; by default all.",
    click.IntRange(1),
    expose_value=False,
    callback=_keep_threads,
)
accept_new_code = click.option(
    "--accept-new-code",
    is_flag=True,
    help="Resume a directory made by other code or another engine; the column code distinguishes its rows.",
)
robot, tail = choice("--robot", ROBOTS), choice("--tail", TAILS)
physics = choice("--physics", PHYSICS, "fast: 1.6 to 2 times the speed, speeds within 1.5 %.")
scene = click.option(
    "--scene",
    default="flat",
    metavar="NAME",
    show_default=True,
    shell_complete=names(*SCENES),
    help="A scene of mjcf/scenes, or the path of an MJCF file.",
)
camera = click.option(
    "--camera",
    default=VIEWS[0],
    metavar="NAME",
    show_default=True,
    help=f"{', '.join(VIEWS)}; what the robot sees: eyes, left_eye, right_eye, stereo.",
    shell_complete=names(*VIEWS, "eyes", "left_eye", "right_eye", "stereo"),
)


def engine(function: F) -> F:
    """`--engine`, and how much of the machine it uses."""
    about = "c: MuJoCo C on all cores. mjx: JAX. warp: NVIDIA. auto: warp or mjx on a GPU, else c."
    return choice("--engine", ENGINES, about)(threads(function))


def workers(function: F) -> F:
    """`--workers` and `--ray-address`; see `crew`."""
    about = "ADDRESS:PORT of a Ray cluster, or auto; by default one is started here."
    address = click.option("--ray-address", metavar="ADDR", help=about)
    where = choice("--workers", ("local", "ray"), "Where to simulate: on this machine, or on a Ray cluster.")
    return where(address(function))


def crew(kind: str, address: str | None, say: Callable[[str], None] | None) -> AbstractContextManager[Workers]:
    """The workers that the options request; `say` receives messages about them."""
    if kind == "local":
        if address is not None:
            raise click.UsageError("--ray-address is given without --workers ray.")
        from nermo_mjx.runs.workers import LocalWorkers

        return contextlib.nullcontext(LocalWorkers())
    if importlib.util.find_spec("ray") is None:
        raise click.UsageError("--workers ray needs Ray: install nermo-mjx with its extra ray, or ray itself, by pip.")
    from nermo_mjx.runs.ray_workers import RayWorkers

    return RayWorkers(address, say)


def set_option(about: str) -> Callable[[F], F]:
    """`--set`; see `assigned`."""
    return click.option(
        "--set", "assignments", multiple=True, metavar="NAME=X", help=about, shell_complete=names(*PARAMETERS, end="=")
    )


set_any = set_option("Any parameter that `sweep --list-parameters` prints; repeatable.")
controller = click.option("--controller", metavar="FILE", help="Custom controller: FILE.py:NAME, or a policy FILE.npz.")


def produced(function: F) -> F:
    """What a walk is saved as."""
    record = file("--record", ".npz", "Save the whole run.")
    return record(file("--video", ".mp4", "Render it; MP4, GIF or WebP.")(camera(function)))


def gait(function: F) -> F:
    """What decides how the robot steps: gait, stride, spine, turn rate and profile."""
    listed = [
        choice("--gait", GAITS, "Trot, walking trot, lateral walk, bound, rotary gallop."),
        number("--frequency", "Gait cycles per second [Hz]."),
        number("--stride", "Stride length, as a fraction of the maximum."),
        click.option(
            "--spine",
            default="none",
            show_default=True,
            metavar="NAME[+NAME]",
            shell_complete=_modes,
            help=f"{', '.join(SPINE_MODES[1:])}; several joined by +. The last two bend the vertical joints "
            "of nermo_41.",
        ),
        number("--spine-amplitude", "Servo amplitude of the stride extension [rad]."),
        number("--spine-phase", "Phase of the stride extension [rad]."),
        number("--turn-rate", "Turn rate held without feedback, -1 right to 1 left."),
        choice("--steering", STEERINGS, "What turns the robot. Default: leg; in as_published spine.", default=None),
        number(
            "--offset-compensation",
            "Rear legs compensate the hip's rise: a fraction, or all without a number.",
            is_flag=False,
            flag_value=1.0,
            metavar="[X]",
        ),
        choice("--trajectory", TRAJECTORIES, "Shape of the foot path; free: with movable points."),
        choice("--head", HEADS, "gaze: the neck keeps the image still while the torso sways."),
        choice("--tail-motion", TAIL_MOTIONS, "Motion of the articulated tail."),
        choice("--profile", PROFILES, "For design; the published simulation; the robot as built."),
    ]
    for option in reversed(listed):
        function = option(function)
    return function
