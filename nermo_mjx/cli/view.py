"""The commands that show a recording: view in the browser, render as a video, play in MuJoCo's viewer."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli import options
from nermo_mjx.cli.choices import OVERLAYS
from nermo_mjx.cli.kinds import directory_page, kind_of_directory
from nermo_mjx.cli.options import FileKind, flag, number
from nermo_mjx.cli.output import Output, WrongUse, command, say
from nermo_mjx.progress import ProgressBar
from nermo_mjx.trust import only_reading

if TYPE_CHECKING:
    from nermo_mjx.plotting.files import Figures
    from nermo_mjx.rollout import Setup
    from nermo_mjx.view import Page, Recording


def load_recording(path: Path) -> Recording:
    """The recording of a file.

    Raises:
        WrongUse: The file is no recording of a robot of this version, or it has nothing to show; the message names it.
    """
    from nermo_mjx.robot import ParameterError
    from nermo_mjx.view import Recording, RecordingError, robot_of
    from nermo_mjx.view.recorded import finite_samples

    try:
        recording = Recording.load(path)
        robot_of(recording)
        finite_samples(recording)
    except (RecordingError, ParameterError) as error:
        text = str(error)
        raise WrongUse(text if text.startswith(f"{path}:") else f"{path}: {text}") from None
    return recording


def figures_of_file(path: Path, *, notify: Callable[[str], None]) -> Figures:
    """The figures of a recording's file; errors as for `load_recording` and `view.figures.figures_of_recording`."""
    from nermo_mjx.view.figures import figures_of_recording

    return figures_of_recording(load_recording(path), notify)


@command("render", reads=True)
@click.argument(
    "recordings", metavar="FILE.npz...", nargs=-1, required=True, type=options.RECORDING_FILE
)
@options.file("--out", ".mp4", "MP4 (H.264), GIF or WebP.", required=True)
@options.camera
@click.option(
    "--overlay",
    "overlays",
    multiple=True,
    type=click.Choice(OVERLAYS),
    metavar="NAME",
    help="gait: footfall; servos: their angles; support: support polygon and centre of mass. Repeatable.",
)
@number("--fps", "Frames per second.", click.IntRange(1, 240), default=30)
@number("--width", "Pixels of one robot's picture.", click.IntRange(16, 7680), default=640)
@number("--height", "Pixels of one robot's picture.", click.IntRange(16, 4320), default=480)
@number("--speed", "1 is real time, 0.25 a quarter of it.", options.POSITIVE, default=1.0)
def render_command(recordings: tuple[Path, ...], out: Path, **video_options: Any) -> Output:
    """Render a recording of `walk --record` as a video; several are shown side by side, synchronized.

    Examples:
      nermo-mjx render walk.npz --out walk.mp4
      nermo-mjx render walk.npz --out slow.gif --camera side --speed 0.25 --fps 25
      nermo-mjx render walk.npz other.npz --out both.mp4 --overlay gait
    """
    loaded = [load_recording(path) for path in recordings]
    render_with_progress(loaded, out, [path.stem for path in recordings], **video_options)
    seconds = min(recording.duration for recording in loaded) / video_options["speed"]
    content = {
        "video": out,
        "seconds": seconds,
        **{name: video_options[name] for name in ("width", "height", "fps")},
    }
    return Output(content, files=[out])


def refuse_video(setup: Setup, video: Path | None, camera: str) -> None:
    """Refuse a video that cannot be made, before anything is simulated."""
    if video is not None:
        from nermo_mjx.view import check_video

        check_video(setup.load().model, video, camera=camera)


def save_run(recording: Recording, record: Path | None, video: Path | None, camera: str) -> None:
    """Save a recording as it is, as a video, or both."""
    if record is not None:
        recording.save(record)
    if video is not None:
        render_with_progress([recording], video, camera=camera)


def render_with_progress(
    recordings: Sequence[Recording], path: Path, names: Sequence[str] = ("",), **video_options: Any
) -> None:
    """Render a video with a progress bar; several recordings are side by side, with their names, titles and metrics.

    Robots are built from the setups of the recordings.
    """
    from nermo_mjx.view import render, robot_of, shown_model
    from nermo_mjx.view.recorded import headline_of, title_of
    from nermo_mjx.view.video import Pane

    robots = [robot_of(recording) for recording in recordings]
    models = [shown_model(*recording) for recording in zip(recordings, robots, strict=True)]
    with ProgressBar("video", "frames") as progress:
        if len(recordings) == 1:
            render(recordings[0], models[0], path, progress=progress.count, **video_options)
            return
        panes = []
        for recording, name, model in zip(recordings, names, models, strict=True):
            figures = ", ".join(" ".join(row) for row in headline_of(recording))
            panes.append(
                Pane(recording, name, list(filter(None, (title_of(recording), figures))), model)
            )
        render(panes, robots[0].model, path, progress=progress.count, **video_options)


#: Options of `play` that require a certain kind of file.
_TASK, _RECORDED = "a training", "a recording"
PLAY_NEEDS = dict.fromkeys(
    ("policy", "scene", "assignments", "seconds", "video", "camera"), _TASK
) | dict.fromkeys(("speed", "xml", "rate"), _RECORDED)


@command("play")
@click.argument(
    "path", metavar="FILE.npz|TRAINING.yaml|DIR", type=FileKind(".npz", ".yaml", ".yml")
)
@number("--speed", "1 is real time, 0.25 a quarter of it.", options.POSITIVE, default=1.0)
@options.file("--xml", ".xml", "Write MJCF with the recording as keyframes instead.")
@number("--rate", "Keyframes per second.", options.POSITIVE, default=25.0)
@options.text(
    "--policy",
    "zero|random|FILE.npz",
    "Of a training: what acts; by default the policy in DIR, or zero.",
)
@options.text(
    "--scene", "NAME", "Of a training: where; by default the first scene of its evaluation."
)
@options.set_option("Of a training: a parameter or a command of its task; repeatable.")
@number("--seconds", "Of a training: how long; by default as in its evaluation.", options.POSITIVE)
@options.file("--video", ".mp4", "Of a training: an MP4, GIF or WebP instead of a page.")
@options.camera
def play_command(
    path: Path, speed: float, xml: Path | None, rate: float, policy: str | None, **task: Any
) -> Output:
    """Play a recording in MuJoCo's viewer, or a policy in a training's task.

    A recording needs a display. With --xml, no window is opened: the file
    contains the robot, its scene and the recording, and plain MuJoCo can show
    it anywhere with `python -m mujoco.viewer --mjcf=FILE.xml` and its slider
    over keyframes.

    A training is its file, or its directory, which may be at work. Its robot
    walks under a policy's actions, or under none or random ones, and the walk
    opens in the browser. `drive --controller policy.npz` is the same live.

    Examples:
      nermo-mjx play walk.npz --speed 0.25
      nermo-mjx play walk.npz --xml walk.xml
      nermo-mjx play runs/walker --scene stairs --video stairs.mp4
      nermo-mjx play sweeps/train_residual.yaml --policy random
    """
    from nermo_mjx.view import play, show, write_keyframes

    if not path.exists():
        raise WrongUse(
            f"{path} does not exist: allowed is a recording FILE.npz, or the file or directory of a training."
        )
    is_task = path.is_dir() or path.suffix in (".yaml", ".yml")
    options.refuse_without(PLAY_NEEDS, {_TASK: is_task, _RECORDED: not is_task})
    if is_task:
        walk, video = _play_task(path, policy, **task), task["video"]
        if video is None:
            return _shown(show(walk), None, path.resolve().stem, False, {"seconds": walk.duration})
        render_with_progress([walk], video, camera=task["camera"])
        return Output({"video": video, "seconds": walk.duration}, files=[video])
    with only_reading():
        loaded = load_recording(path)
    keys = None
    if xml is None:
        play(loaded, speed=speed)
    else:
        keys = write_keyframes(loaded, xml, rate=rate)
    content = {"recording": path, "seconds": loaded.duration, "xml": xml, "keyframes": keys}
    return Output(
        content, lambda: None if xml is None else click.echo(f"wrote {xml}, with {keys} keyframes")
    )


def _play_task(
    path: Path,
    policy: str | None,
    assignments: tuple[str, ...],
    video: Path | None,
    camera: str,
    **how: Any,
) -> Recording:
    """A walk in the task of a training's file or directory."""
    from nermo_mjx.learn.directory import POLICY_FILE, SPEC_FILE
    from nermo_mjx.learn.evaluation import ZERO_POLICY, played_task
    from nermo_mjx.learn.spec import Training
    from nermo_mjx.learn.task import task_parameters

    training = Training.from_file(path / SPEC_FILE if path.is_dir() else path)
    refuse_video(training.setup, video, camera)
    values = options.assigned(assignments, task_parameters(training.setup))
    policy = policy or (str(path / POLICY_FILE) if path.is_dir() else ZERO_POLICY)
    with ProgressBar("play", compiles=True):
        return played_task(training, policy, values=values, **how)


@command("view", reads=True)
@click.argument("path", metavar="PATH", type=FileKind(".npz"))
@click.argument("other", metavar="[OTHER.npz]", required=False, type=options.RECORDING_FILE)
@options.file("--out", ".html", "Write the page to this file.")
@number(
    "--recordings",
    "For a directory: maximum number of recordings in the page; by default 50.",
    click.IntRange(0),
)
@flag("--no-open", "Do not open a browser.")
@flag(
    "--follow",
    "For a training at work: a page that shows each checkpoint, until it ends or Ctrl-C.",
)
def view_command(
    path: Path,
    other: Path | None,
    out: Path | None,
    recordings: int | None,
    no_open: bool,
    follow: bool,
) -> Output:
    """View a recording, or any directory of results, in the browser.

    The page is self-contained and needs no network. For a recording FILE.npz:
    an interactive 3D view with a time line, tendons coloured by tension,
    contact forces, plots; a second recording is compared with it, synchronized
    in time. For the directory of a sweep, a search or experiments: every run
    as a point or a cell, to filter and brush; clicking a run shows its numbers
    and the command that repeats it, and plays its recording if there is one.
    For the directory of a training: curves, evaluation, and a walk of its
    policy on each scene, which is simulated for the page. For an identification:
    its report. For others: figures.

    Examples:
      nermo-mjx view walk.npz
      nermo-mjx view walk.npz other.npz
      nermo-mjx view walk.npz --out walk.html --no-open
      nermo-mjx view runs/quickstart
      nermo-mjx view runs/walker --follow
    """
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise WrongUse(f"{out}: a page ends in .html, not in {out.suffix or 'nothing'!r}.")
    if not path.exists():
        raise WrongUse(
            f"{path} does not exist: allowed is a recording FILE.npz, or a directory of results."
        )
    if follow:
        return _follow(path, out, no_open)
    notes: list[str] = []
    page, amounts = _page(path, other, recordings, notes)
    for note in notes:
        say(note)
    return _shown(page, out, path.resolve().stem, no_open, amounts)


def _shown(
    page: Page, out: Path | None, name: str, no_open: bool, amounts: dict[str, Any]
) -> Output:
    """Save a page, in a new folder unless a file is given, and open it."""
    file = page.save(out or Path(tempfile.mkdtemp(prefix="nermo-mjx-")) / f"{name}.html")
    opened = not no_open and _has_browser() and webbrowser.open(file.resolve().as_uri())
    sentence = f"wrote {file}" + (
        "" if opened or no_open else "; no browser was found, open it in one"
    )
    content = {"page": str(file), "bytes": file.stat().st_size, **amounts, "opened": opened}
    # The file is in a temporary folder, so that its path is printed unless the browser shows it.
    return Output(content, lambda: click.echo(sentence), always=out is None and not opened)


#: Interval at which a browser reloads the page of a running training [s].
_RELOAD = 20.0


def _follow(path: Path, out: Path | None, no_open: bool) -> Output:
    """Write the page of a training again after each checkpoint, until the training has ended."""
    from nermo_mjx.learn.directory import HISTORY_FILE, training_status
    from nermo_mjx.view.trained import trained

    if not path.is_dir() or not kind_of_directory(path).follows:
        raise WrongUse(f"--follow is for the directory of a training, but {path} is none.")
    shown_status, seen_time, status = None, 0, training_status(path)
    with contextlib.suppress(KeyboardInterrupt):
        while seen_time == 0 or not status.complete:
            status = training_status(path)
            written_time = (
                (path / HISTORY_FILE).stat().st_mtime_ns if (path / HISTORY_FILE).exists() else 0
            )
            if written_time != seen_time or (seen_time and status.complete):
                page = trained(path, reload=None if status.complete else _RELOAD)
                file = None if shown_status is None else Path(shown_status.content["page"])
                amounts = {"iterations": status.rows_done, "complete": status.complete}
                shown_status, seen_time = (
                    _shown(
                        page, out or file, path.resolve().stem, no_open or seen_time != 0, amounts
                    ),
                    written_time,
                )
                say(
                    f"{shown_status.content['page']} shows {status.rows_done:,} of {status.rows:,} iterations"
                )
            elif not status.complete:
                time.sleep(1.0)
    if shown_status is None:
        raise WrongUse(f"{path} has no checkpoint yet: nothing was shown.")
    return shown_status


def _page(
    path: Path, other: Path | None, recordings: int | None, notes: list[str]
) -> tuple[Page, dict[str, Any]]:
    """The page of a recording or a directory, and the numbers of its samples, rows and recordings."""
    from nermo_mjx.view import show
    from nermo_mjx.view.explore import MAX_RECORDINGS

    if not path.is_dir():
        if recordings is not None:
            raise WrongUse(
                f"--recordings is for the page of a directory, but {path} is a recording."
            )
        for file in (path, *([] if other is None else [other])):
            load_recording(file)  # refuses a file that cannot be shown, with its name
        page = show(path, other)
        return page, {"samples": page.samples}
    if other is not None:
        raise WrongUse(
            f"{path} is a directory: it has its own page; show {other} with a separate command."
        )
    kind_of_directory(path)  # refuses a directory of no known kind
    limit = MAX_RECORDINGS if recordings is None else recordings
    page = directory_page(path, recordings=limit, notify=notes.append)
    if page.samples:
        return page, {"samples": page.samples}
    return page, {"rows": page.rows, "recordings": page.recordings} if page.rows else {}


def _has_browser() -> bool:
    """Whether a window can open; without a display Python would start a text browser, or wait for one."""
    if sys.platform.startswith("linux") and not os.environ.get("BROWSER"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
