"""Options shared by commands, short ways to declare them, and their completion in a shell. It imports nothing heavy."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from nermo_mjx.cli import choices
from nermo_mjx.cli.output import WrongUse
from nermo_mjx.runtime import THREADS_VARIABLE

if TYPE_CHECKING:
    from nermo_mjx.robot import Quantity

F = TypeVar("F", bound=Callable[..., Any])
Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def names(*choices: str, end: str = "", separator: str = "") -> Completer:
    """Completes one of these names, and what follows each of them; or the last of several that are joined."""

    def complete(
        context: click.Context, parameter: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        prefix, mark, last = incomplete.rpartition(separator) if separator else ("", "", incomplete)
        completions = [prefix + mark + name + end for name in choices if name.startswith(last)]
        # A shell adds a space after a single offer; a second one prevents that before the value.
        return [
            CompletionItem(completion)
            for completion in (
                completions
                if len(completions) != 1 or not end
                else [*completions, f"{completions[0]}X"]
            )
        ]

    return complete


class FileKind(click.Path):
    """A path completed with files of certain suffixes, and the folders leading to them."""

    def __init__(self, *endings: str, **settings: Any) -> None:
        super().__init__(path_type=Path, **settings)
        self.endings = endings

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        files = offered(incomplete, self.endings)
        # If nothing matches, the shell offers its own completions.
        return [CompletionItem(file_name) for file_name in files] or [
            CompletionItem(incomplete, type="file")
        ]


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
    fitting = [
        e
        for e in entries
        if e.name.startswith(begin) and (begin.startswith(".") or e.name[0] != ".")
    ]
    folders = [f"{prefix}{e.name}/" for e in fitting if e.is_dir()]
    files = [f"{prefix}{e.name}" for e in fitting if not e.is_dir() and e.name.endswith(endings)]
    if len(folders) == 1 and not files:
        return offered(folders[0], endings) or folders
    return sorted(folders + files)


def assigned(texts: Iterable[str], parameters: Mapping[str, Quantity]) -> dict[str, float]:
    """Names and values of every NAME=X, where NAME may be a pattern; ranges are not checked. The last one wins.

    Raises:
        WrongUse: a text is something else, or names none of the parameters.
    """
    from nermo_mjx.robot.quantity import ParameterError, nearest
    from nermo_mjx.specs.walk import is_pattern, matches

    values: dict[str, float] = {}
    for text in texts:
        name, equals, number = (part.strip() for part in text.partition("="))
        if not equals:
            example, declaration = next(iter(parameters.items()))
            raise WrongUse(
                f"--set {text}: expected NAME=VALUE, such as {example}={declaration.default:g}."
            )
        pattern = is_pattern(name)
        matching = matches(name, parameters) if pattern else [name] if name in parameters else []
        if not matching:
            near = None if pattern else nearest(name, parameters)
            problem = "matches no parameter" if pattern else "is not a parameter"
            hint = (
                f"did you mean {near}?"
                if near
                else "`nermo-mjx sweep --list-parameters` prints all."
            )
            raise WrongUse(f"--set {text}: {name} {problem}; {hint}")
        try:
            values |= {
                match_name: parameters[match_name].numbers(match_name, number)
                for match_name in matching
            }
        except ParameterError as error:
            raise WrongUse(f"--set {text}: {error}") from None
    return values


def given() -> dict[str, str]:
    """Flags of the options of this call that are not at their defaults, by name."""
    context = click.get_current_context()
    return {
        parameter.name or "": parameter.opts[0]
        for parameter in context.command.params
        if context.get_parameter_source(parameter.name or "") is not ParameterSource.DEFAULT
    }


def refuse_without(needs: Mapping[str, str], options: Mapping[str, Any]) -> None:
    """Refuse options that are given and have no effect.

    Args:
        needs: by an option's name what it needs; others are passed over.
        options: which of these are there.

    Raises:
        WrongUse: one is not.
    """
    for name, flag in given().items():
        if not options.get(need := needs.get(name, ""), True):
            raise WrongUse(f"{flag} has no effect without {need}.")


# ---
# How options are declared.

PATH, FOLDER = click.Path(path_type=Path), click.Path(file_okay=False, path_type=Path)
POSITIVE = click.FloatRange(0, min_open=True)
#: Files that are read: of a sweep or a tuning, and recordings.
SPEC = FileKind(".yaml", ".yml")
RECORDING_FILE = FileKind(".npz", exists=True, dir_okay=False)


def text(name: str, metavar: str, help_text: str, **attributes: Any) -> Callable[[F], F]:
    """An option with a value."""
    return click.option(name, metavar=metavar, help=help_text, **attributes)


def flag(name: str, help_text: str, **attributes: Any) -> Callable[[F], F]:
    """An option without a value."""
    return click.option(name, is_flag=True, help=help_text, **attributes)


def choice_option(
    name: str, names: tuple[str, ...], help_text: str | None = None, **attributes: Any
) -> Callable[[F], F]:
    """An option that allows some names; the first is the default unless `default` is given."""
    settings: dict[str, Any] = {"default": names[0], "show_default": True} | attributes
    return click.option(name, type=click.Choice(names), help=help_text, **settings)


class _Gait(click.Choice):
    """The name of a gait; the author's codes pass as well."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        codes = dict(zip(choices.GAIT_CODES, self.choices, strict=False))
        return super().convert(codes.get(value, value), param, ctx)


def number(name: str, help_text: str, kind: Any = float, **attributes: Any) -> Callable[[F], F]:
    """An option that takes a number."""
    is_integer = isinstance(kind, click.IntRange)
    settings: dict[str, Any] = {
        "metavar": "N" if is_integer else "X",
        "show_default": "default" in attributes,
    } | attributes
    return click.option(name, type=kind, help=help_text, **settings)


def file(name: str, suffix: str, help_text: str, **attributes: Any) -> Callable[[F], F]:
    """An option that names a file to write."""
    return click.option(
        name,
        metavar=f"FILE{suffix}",
        type=FileKind(suffix, dir_okay=False),
        help=help_text,
        **attributes,
    )


def column(
    name: str, help_text: str, *, suggestions: tuple[str, ...] = (), **attributes: Any
) -> Callable[[F], F]:
    """An option that names a column of a table, completed with parameters and metrics, or with the given names."""
    complete = names(*(suggestions or (*choices.PARAMETERS, *choices.METRICS)))
    return click.option(name, metavar="NAME", shell_complete=complete, help=help_text, **attributes)


#: Where the parameters of `--body` are kept in a command's context.
_BODY_KEY = "nermo_mjx.body"


def set_option(help_text: str) -> Callable[[F], F]:
    """`--set`; see `assigned`."""
    return click.option(
        "--set",
        "assignments",
        multiple=True,
        metavar="NAME=X",
        help=help_text,
        shell_complete=names(*choices.PARAMETERS, end="="),
        callback=lambda ctx, parameter, assignments: _with_body(ctx, assignments),
    )


def _best_body(ctx: click.Context, parameter: click.Parameter, source: str | None) -> None:
    """Read the parameters of the best body, as assignments."""
    if source is not None:
        from nermo_mjx.robot import identified

        ctx.meta[_BODY_KEY] = tuple(
            f"{name}={value:.12g}" for name, value in identified.best(source).items()
        )


def _with_body(ctx: click.Context, assignments: tuple[str, ...]) -> tuple[str, ...]:
    """Assignments of `--body` that are not given by `--set`, and those that are."""
    assigned_names = {assignment.split("=")[0] for assignment in assignments}
    return (
        *(
            assignment
            for assignment in ctx.meta.get(_BODY_KEY, ())
            if assignment.split("=")[0] not in assigned_names
        ),
        *assignments,
    )


def grouped(*listed: Callable[[Any], Any]) -> Callable[[F], F]:
    """Several options, in this order."""

    def declare(function: F) -> F:
        for option in reversed(listed):
            function = option(function)
        return function

    return declare


def _keep_threads(ctx: click.Context, parameter: click.Parameter, value: int | None) -> None:
    """For this process, and for those that it starts."""
    if value is not None:
        os.environ[THREADS_VARIABLE] = str(value)


# ---
# Options of several commands.

out = text("--out", "DIR", "Where results go.", required=True, type=FOLDER)
threads = number(
    "--threads",
    "Number of CPU cores for the engine c; by default all.",
    click.IntRange(1),
    expose_value=False,
    callback=_keep_threads,
)
engine = grouped(
    choice_option(
        "--engine",
        choices.ENGINES,
        "c: MuJoCo C on all cores. mjx: JAX, also on GPUs. warp: NVIDIA, on trial. auto: mjx on a GPU, else c.",
    ),
    threads,
)
#: See `jobs.working`.
workers = grouped(
    choice_option(
        "--workers", ("local", "ray"), "Where to simulate: on this machine, or on a Ray cluster."
    ),
    text(
        "--ray-address",
        "ADDR",
        "ADDRESS:PORT of a Ray cluster, or auto; by default one is started here.",
    ),
)
accept_new_code = flag(
    "--accept-new-code",
    "Resume a directory made by other code or another engine; the column code distinguishes its rows.",
)
robot = choice_option("--robot", choices.ROBOT)
tail = choice_option(
    "--tail", choices.TAIL, "Default: rigid; in as_published articulated.", default=None
)
scene = text(
    "--scene",
    "NAME",
    "A scene of mjcf/scenes, or the path of an MJCF file.",
    default="flat",
    show_default=True,
    shell_complete=names(*choices.SCENES),
)
physics = choice_option(
    "--physics", choices.PHYSICS, "fast: 1.6 to 2 times the speed, speeds within 1.5 %."
)
profile = choice_option(
    "--profile", choices.PROFILE, "For design; the published simulation; the robot as built."
)
#: What decides the model.
body = grouped(robot, scene, tail, physics)
camera = text(
    "--camera",
    "NAME",
    f"{', '.join(choices.VIEWS)}; what the robot sees: eyes, left_eye, right_eye, stereo.",
    default=choices.VIEWS[0],
    show_default=True,
    shell_complete=names(*choices.VIEWS, "eyes", "left_eye", "right_eye", "stereo"),
)
#: What a run is saved as.
produced = grouped(
    file("--record", ".npz", "Save the whole run."),
    file("--video", ".mp4", "Render it; MP4, GIF or WebP."),
    camera,
)
_BEST_BODY_HELP = "The best body of an identification's directory; {} goes before it."
controller = text("--controller", "FILE", "Custom controller: FILE.py:NAME, or a policy FILE.npz.")
set_any = grouped(
    set_option("Any parameter that `sweep --list-parameters` prints; repeatable."),
    text(
        "--body",
        "DIR",
        _BEST_BODY_HELP.format("--set"),
        is_eager=True,
        expose_value=False,
        callback=_best_body,
    ),
)
#: The same of a job's file, see `Described.from_file`.
best_body = text("--body", "DIR", _BEST_BODY_HELP.format("what the file names"))
#: What decides how the robot steps.
gait = grouped(
    click.option(
        "--gait",
        type=_Gait(choices.GAIT),
        default=choices.GAIT[0],
        show_default=True,
        help="Order of the feet.",
    ),
    number("--frequency", "Gait cycles per second [Hz].", str),
    number("--stride", "Stride length, as a fraction of the maximum.", str),
    text(
        "--spine",
        "NAME[+NAME]",
        f"{', '.join(choices.SPINE_MODES[1:])}; several joined by +. The last two bend the vertical joints "
        "of nermo_41.",
        default="none",
        show_default=True,
        shell_complete=names(*choices.SPINE_MODES, separator="+"),
    ),
    number("--spine-amplitude", "Servo amplitude of the stride extension [rad].", str),
    number("--spine-phase", 'Phase of the stride extension [rad], or such as "-45 deg".', str),
    number("--turn-rate", "Turn rate held without feedback, -1 right to 1 left.", str),
    choice_option(
        "--steering",
        choices.STEERING,
        "What turns the robot. Default: leg; in as_published spine.",
        default=None,
    ),
    number(
        "--offset-compensation",
        "Rear legs compensate the hip's rise: a fraction, or all without a number.",
        str,
        is_flag=False,
        flag_value="1",
        metavar="[X]",
    ),
    choice_option(
        "--trajectory", choices.TRAJECTORY, "Shape of the foot path; free: with movable points."
    ),
    choice_option(
        "--head", choices.HEAD, "gaze: the neck keeps the image still while the torso sways."
    ),
    choice_option("--tail-motion", choices.TAIL_MOTION, "Motion of the articulated tail."),
    profile,
    number(
        "--control-rate",
        "Ticks of the controller a second. Default: 100; in as_published 250.",
        metavar="HZ",
    ),
    text(
        "--simplifications",
        "NAMES",
        "Of the robot author: none, or servos, contact and noslip, joined by +.",
    ),
)
