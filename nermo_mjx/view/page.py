"""A page for the browser: a recording, two in comparison, or a directory of runs, in one self-contained file."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

from nermo_mjx.recording import Recording, write_whole
from nermo_mjx.view.clip import Packer

_WEB: Final = resources.files("nermo_mjx.view") / "web"
_LIBRARIES: Final = {"three": "vendor/three/three.min.js", "meshoptimizer": "vendor/meshoptimizer/simplifier.min.js"}
_PLACE: Final = re.compile(r"<!--(\w+)-->")


@dataclasses.dataclass(frozen=True)
class Page:
    """A finished page.

    Attributes:
        html: the whole document.
        height: in a notebook [pixels].
        samples: number of samples of the (longer) recording, if it shows only recordings.
        rows, recordings: their numbers, if it shows a directory.
    """

    html: str
    height: int = 480
    samples: int = 0
    rows: int = 0
    recordings: int = 0

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, atomically.

        Raises:
            RecordingError: it cannot be written.
        """
        return write_whole(Path(path), "the page", self.html.encode())

    def _repr_html_(self) -> str:
        """Notebook output: the page in an iframe, stored with the notebook."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" title="Page of nermo_mjx" allow="fullscreen; clipboard-write" '
            f'style="width:100%;height:{self.height}px;border:0;border-radius:8px"></iframe>'
        )

    def __repr__(self) -> str:
        held = f"{self.rows} rows, {self.recordings} recordings" if self.rows else f"{self.samples} samples"
        return f"Page({len(self.html) / 1e6:.1f} MB, {held})"


def template(kind: str) -> str:
    """The document of a `viewer` or an `explore` page, with places for what it shows."""
    main = "main.js" if kind == "viewer" else f"{kind}/main.js"
    return _filled(text("frame.html"), {"kind": kind, "main": main, "body": text(f"{kind}.html").rstrip()})


def _filled(document: str, content: Mapping[str, str]) -> str:
    return _PLACE.sub(lambda place: content.get(place[1], place[0]), document)


def document(
    kind: str, title: str, header: Mapping[str, Any], parts: Sequence[Packer], folders: Sequence[str] = ("",)
) -> str:
    """A whole page.

    Args:
        kind: `viewer` or `explore`.
        title: of the window.
        header: JSON header of the page.
        parts: packed arrays that the header points into.
        folders: of `web/` whose modules and style the page has.
    """
    styles = [name for each in folders if (_WEB / (name := f"{each}/style.css".lstrip("/"))).is_file()]
    data = [f'<script type="text/plain" data-part="{part.part}">{part.text()}</script>' for part in parts]
    content = {
        "title": html.escape(title),
        "style": "\n".join(map(text, styles)),
        "own_style": text("explore.css") if kind == "explore" else "",
        "imports": as_json({"imports": _modules(folders)}),
        "header": as_json(header),
        "data": "\n".join(data),
    }
    return _filled(template(kind), content)


def text(name: str) -> str:
    """A file of `web/`."""
    return (_WEB / name).read_text(encoding="utf-8")


def as_json(value: Any) -> str:
    """JSON that may stand in a script element."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _modules(folders: Sequence[str]) -> dict[str, str]:
    """An import map: the libraries, and each of our modules as `viewer/[FOLDER/]NAME.js`, as data URLs."""
    sources = {name: text(path) for name, path in _LIBRARIES.items()}
    for folder in folders:
        for each in sorted(each.name for each in (_WEB / folder).iterdir() if each.name.endswith(".js")):
            name = f"{folder}/{each}".lstrip("/")
            sources[f"viewer/{name}"] = f"{text(name)}\n//# sourceURL=viewer/{name}\n"
    encoded = {name: base64.b64encode(source.encode()).decode("ascii") for name, source in sources.items()}
    return {name: f"data:text/javascript;base64,{content}" for name, content in encoded.items()}


def show(
    recording: Recording | str | os.PathLike[str],
    other: Recording | str | os.PathLike[str] | None = None,
    *,
    height: int | None = None,
) -> Page:
    """The page of a recording: an interactive view of the robot with a time slider, tendons, forces and plots.

    For the directory of a sweep or a search, it is the page of all its runs, see `explore`; for that of a training its
    curves, its evaluation, and a walk of its policy.

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
        from nermo_mjx.runs import DirectoryError, kind_of
        from nermo_mjx.view.explore import explore

        if other is not None:
            raise DirectoryError(f"{recording} is a directory: it is shown alone, and compared row by row in its page.")
        if kind_of(Path(recording)) == "training":
            from nermo_mjx.view.trained import trained

            return trained(Path(recording))
        return explore(recording, height=height or 680)
    given = [recording] if other is None else [recording, other]
    loaded = [each if isinstance(each, Recording) else Recording.load(each) for each in given]
    names = ["AB"[i] if isinstance(each, Recording) else Path(each).stem for i, each in enumerate(given)]
    if len(set(names)) < len(names):  # files of one name tell runs apart by their folders
        names = ["/".join(Path(str(each)).resolve().with_suffix("").parts[-2:]) for each in given]
    from nermo_mjx.view.clip import clips_of  # needs the robot, and thus JAX

    packer = Packer()
    header = clips_of(loaded, names, packer)
    samples = max(clip["time"]["shape"][0] for clip in header["clips"])
    title = " and ".join(dict.fromkeys(clip["title"] for clip in header["clips"]))
    return Page(document("viewer", f"Nermo: {title}", header, [packer]), height or 480, samples)
