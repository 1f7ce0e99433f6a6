"""Recordings that are named on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nermo_mjx.cli.group import WrongUse

if TYPE_CHECKING:
    from nermo_mjx.plotting.files import Figures
    from nermo_mjx.view import Recording


def load_recording(path: Path) -> Recording:
    """The recording of a file.

    Raises:
        WrongUse: it is none, is not one of this version's robot, or has nothing to show; the sentence names the file.
    """
    from nermo_mjx.view import Recording, RecordingError, robot_of
    from nermo_mjx.view.recorded import finite_samples

    try:
        recording = Recording.load(path)
        robot_of(recording)
        finite_samples(recording)
    except RecordingError as error:
        text = str(error)
        raise WrongUse(text if text.startswith(f"{path}:") else f"{path}: {text}") from None
    return recording


def figures(path: Path, *, notify: Callable[[str], None]) -> Figures:
    """The figures of a recording's file; arguments and errors as for `view.plots.figures.figures_of` and above."""
    from nermo_mjx.view.figures import figures_of

    return figures_of(load_recording(path), notify)
