"""A page for the browser: a recording, two in comparison, or a directory of runs, in one self-contained file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from nermo_mjx.recording import Recording
from nermo_mjx.view.document import Page, document
from nermo_mjx.view.packing import Packer


def show(
    recording: Recording | str | os.PathLike[str],
    other: Recording | str | os.PathLike[str] | None = None,
    *,
    height: int | None = None,
) -> Page:
    """The page of a recording: an interactive view of the robot with a time slider, tendons, forces and plots.

    For the directory of a sweep or a search, it is the page of all its runs, see `explore`.

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
    if not isinstance(recording, Recording) and Path(recording).is_dir():
        from nermo_mjx.runs import DirectoryError
        from nermo_mjx.view.explore import explore

        if other is not None:
            raise DirectoryError(f"{recording} is a directory: it is shown alone, and compared row by row in its page.")
        return explore(recording, height=height or 680)
    given = [recording] if other is None else [recording, other]
    loaded = [each if isinstance(each, Recording) else Recording.load(each) for each in given]
    names = [_name(each, letter) for each, letter in zip(given, "AB", strict=False)]
    from nermo_mjx.view.clip import clips_of  # needs the robot, and thus JAX

    packer = Packer()
    header = clips_of(loaded, names, packer)
    samples = max(clip["time"]["shape"][0] for clip in header["clips"])
    title = " and ".join(dict.fromkeys(clip["title"] for clip in header["clips"]))
    return Page(document("page.html", f"Nermo: {title}", header, [packer]), height or 480, samples)


def _name(given: Any, letter: str) -> str:
    return letter if isinstance(given, Recording) else Path(given).stem
