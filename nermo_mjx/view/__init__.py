"""Visualisation of runs: recordings, videos, and a page for the browser."""

import os
from pathlib import Path

from nermo_mjx.recording import Recording, RecordingError, model_hash, recording_of
from nermo_mjx.robot.quantity import of_type
from nermo_mjx.view.page import Page
from nermo_mjx.view.playing import play, write_keyframes
from nermo_mjx.view.recorded import robot_of, shown_model
from nermo_mjx.view.video import CAMERAS, OVERLAYS, Pane, VideoError, check_video, render

__all__ = [
    "CAMERAS",
    "OVERLAYS",
    "Page",
    "Pane",
    "Recording",
    "RecordingError",
    "VideoError",
    "check_video",
    "model_hash",
    "offscreen",
    "play",
    "recording_of",
    "render",
    "robot_of",
    "show",
    "shown_model",
    "write_keyframes",
]


def show(
    recording: Recording | str | os.PathLike[str],
    other: Recording | str | os.PathLike[str] | None = None,
    *,
    height: int | None = None,
) -> Page:
    """The page of a recording: an interactive view of the robot with a time slider, tendons, forces and plots.

    For the directory of a sweep, a search or experiments, it is the page of all its runs, see `explore`; for that of a
    training its curves, its evaluation, and a walk of its policy; for others their figures.

    In a notebook, a cell that ends in `show(recording)` shows it; `show(recording).save("walk.html")` writes one
    self-contained file.

    Args:
        recording: the run, the NPZ file that holds it, or a directory.
        other: a second recording to compare with, synchronised in time.
        height: in a notebook [pixels]; by default 480, and 680 for a directory.

    Raises:
        RecordingError: the recording does not exist, or was made with another version of the model.
        ParameterError: its setup names something that this version does not have.
        DirectoryError: a directory holds no runs that can be shown, or is given with another recording.
    """
    for source in (recording, other):
        of_type(
            "recording",
            source,
            (Recording, str, os.PathLike, type(None)),
            "a recording, or the path of one",
        )
    if not isinstance(recording, Recording) and Path(recording).is_dir():
        from nermo_mjx.cli.kinds import directory_page  # which page shows which kind of directory
        from nermo_mjx.runs import DirectoryError

        if other is not None:
            raise DirectoryError(
                f"{recording} is a directory: it is shown alone, and compared row by row in its page."
            )
        return directory_page(Path(recording), height=height or 680)
    from nermo_mjx.view.clip import page_of

    sources = [recording] if other is None else [recording, other]
    names = [
        "AB"[i] if isinstance(source, Recording) else Path(source).stem
        for i, source in enumerate(sources)
    ]
    if len(set(names)) < len(names):  # files of one name tell runs apart by their folders
        names = [
            "/".join(Path(str(source)).resolve().with_suffix("").parts[-2:]) for source in sources
        ]
    loaded = [
        source if isinstance(source, Recording) else Recording.load(source) for source in sources
    ]
    return page_of(loaded, names, height or 480)
