"""A page for the browser that shows one recording, or two in comparison; everything it needs is in the one file."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import os
from importlib import resources
from pathlib import Path
from typing import Any, Final

from nermo_mjx.recording import Recording, whole_file
from nermo_mjx.view.packing import Packer

_WEB: Final = resources.files("nermo_mjx.view") / "web"
_LIBRARIES: Final = {"three": "vendor/three/three.min.js", "meshoptimizer": "vendor/meshoptimizer/simplifier.min.js"}


@dataclasses.dataclass(frozen=True)
class Page:
    """A finished page.

    Attributes:
        html: the whole document.
        height: in a notebook [pixels].
        samples: how many samples of the (longer) recording it holds.
    """

    html: str
    height: int = 480
    samples: int = 0

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, at once or not at all.

        Raises:
            RecordingError: it cannot be written.
        """
        path = Path(path)
        with whole_file(path, "the page") as file:
            file.write(self.html.encode())
        return path

    def _repr_html_(self) -> str:
        """What a notebook shows: the page in a frame of its own, kept with the notebook."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" title="Recording of nermo_mjx" allow="fullscreen" '
            f'style="width:100%;height:{self.height}px;border:0;border-radius:8px"></iframe>'
        )

    def __repr__(self) -> str:
        return f"Page({len(self.html) / 1e6:.1f} MB, {self.samples} samples)"


def show(
    recording: Recording | str | os.PathLike[str],
    other: Recording | str | os.PathLike[str] | None = None,
    *,
    height: int = 480,
) -> Page:
    """The page of a recording: the robot to turn around and to scrub through, with tendons, forces and plots.

    In a notebook, a cell that ends in `show(recording)` shows it; `show(recording).save("walk.html")` writes one file
    that needs nothing else.

    Args:
        recording: the run, or the NPZ file that holds it.
        other: a second one to compare with, in step with the time.
        height: in a notebook [pixels].

    Raises:
        RecordingError: there is no such recording, or it was made with another version of the model.
        ParameterError: its setup names something that this version does not have.
    """
    given = [recording] if other is None else [recording, other]
    loaded = [each if isinstance(each, Recording) else Recording.load(each) for each in given]
    names = [_name(each, letter) for each, letter in zip(given, "AB", strict=False)]
    from nermo_mjx.view.clip import clips_of  # needs the robot, and thus JAX

    packer = Packer()
    header = clips_of(loaded, names, packer)
    samples = max(clip["time"]["shape"][0] for clip in header["clips"])
    return Page(_document(header, packer.text()), height, samples)


def _name(given: Any, letter: str) -> str:
    return letter if isinstance(given, Recording) else Path(given).stem


def _document(header: dict[str, Any], data: str) -> str:
    """The template with style, library, modules and data in their places."""
    title = " and ".join(dict.fromkeys(clip["title"] for clip in header["clips"]))
    parts = {
        "title": html.escape(f"Nermo: {title}"),
        "style": _text("style.css"),
        "imports": _json({"imports": _modules()}),
        "header": _json(header),
        "data": data,
    }
    document = _text("page.html")
    for name, content in parts.items():
        document = document.replace(f"<!--{name}-->", content, 1)
    return document


def _modules() -> dict[str, str]:
    """An import map: the libraries, and each of our modules as `viewer/NAME.js`, as data URLs."""
    ours = sorted(each.name for each in _WEB.iterdir() if each.name.endswith(".js"))
    sources = {name: _text(path) for name, path in _LIBRARIES.items()}
    sources |= {f"viewer/{name}": f"{_text(name)}\n//# sourceURL=viewer/{name}\n" for name in ours}
    return {name: _data_url(source) for name, source in sources.items()}


def _data_url(source: str) -> str:
    return "data:text/javascript;base64," + base64.b64encode(source.encode()).decode("ascii")


def _text(name: str) -> str:
    return (_WEB / name).read_text(encoding="utf-8")


def _json(value: Any) -> str:
    """JSON that may stand in a script element."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
