"""A page for the browser in one self-contained file, which contains a document and packed arrays."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import html
import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.recording import write_whole

_WEB: Final = resources.files("nermo_mjx.view") / "web"
_LIBRARIES: Final = {
    "three": "vendor/three/three.min.js",
    "meshoptimizer": "vendor/meshoptimizer/simplifier.min.js",
}


#: The step that stands for NaN, and the largest one.
NAN_STEP, _LARGEST_STEP = -32768, 32767


class Packer:
    """Collects arrays; each gets an entry in the header, and together they become one text.

    Args:
        part: name of the text, for pages that have several.
    """

    def __init__(self, part: str = "data") -> None:
        self.part = part
        self._parts: list[bytes] = []
        self._size = 0

    def plain(self, values: np.ndarray, kind: str = "float32") -> dict[str, Any]:
        """Entry of an unchanged array, as `float32`, `uint32` or `uint16`."""
        array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
        return self._add(array.tobytes(), kind, array.shape)

    def steps(self, values: np.ndarray, resolution: float = 0.0) -> dict[str, Any]:
        """Entry of an array (T, ...) that changes little from row to row.

        Each value is off by at most 1/131068 of the array's range, or half the resolution if that is more: coarser
        values take less space. NaN is kept, infinities become NaN.
        """
        array = np.where(np.isfinite(values), values, np.nan).astype(float)
        low, high = (np.nanmin(array), np.nanmax(array)) if np.isfinite(array).any() else (0.0, 0.0)
        zero, scale = (low + high) / 2, max((high - low) / (2 * _LARGEST_STEP), resolution) or 1.0
        steps = np.where(np.isnan(array), NAN_STEP, np.rint((array - zero) / scale)).astype(
            np.int16
        )
        columns = np.ascontiguousarray(steps.reshape(len(steps), -1).T)
        with np.errstate(over="ignore"):
            columns[:, 1:] = np.diff(columns, axis=1)  # wraps around, which the reader reverses
        words = columns.astype("<i2").reshape(-1).view(np.uint8).reshape(-1, 2)
        content = words[:, 1].tobytes() + words[:, 0].tobytes()
        return self._add(content, "steps", array.shape) | {"scale": scale, "zero": zero}

    def floats(self, values: np.ndarray, exact: bool = False) -> dict[str, Any]:
        """Entry of an array (n,) of any range, with a relative error below 1e-5; `exact` keeps all of 32-bit floats."""
        with np.errstate(over="ignore"):
            bits = np.asarray(values, np.float32).view(np.uint32)
        if not exact:  # the lowest byte is rounded away, which gzip then hardly stores
            bits = (bits + np.uint32(0x80)) & np.uint32(0xFFFFFF00)
        return self.plain(bits.view(np.float32))

    def json(self, value: Any) -> dict[str, Any]:
        """Entry of a JSON value."""
        content = json.dumps(
            value, ensure_ascii=False, separators=(",", ":"), allow_nan=False
        ).encode()
        return self._add(content, "json", (len(content),))

    @property
    def content(self) -> bytes:
        """All arrays."""
        return b"".join(self._parts)

    def text(self) -> str:
        """All arrays, gzipped, in base 64."""
        return base64.b64encode(gzip.compress(self.content, 9, mtime=0)).decode("ascii")

    def _add(self, content: bytes, kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
        padding = bytes(-self._size % 4)
        entry = {
            "part": self.part,
            "kind": kind,
            "at": self._size + len(padding),
            "shape": list(shape),
        }
        self._parts += [padding, content]
        self._size += len(padding) + len(content)
        return entry


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
        contents = (
            f"{self.rows} rows, {self.recordings} recordings"
            if self.rows
            else f"{self.samples} samples"
        )
        return f"Page({len(self.html) / 1e6:.1f} MB, {contents})"


def template(kind: str) -> str:
    """The document of a `viewer` or an `explore` page, with places for what it shows."""
    main = "main.js" if kind == "viewer" else f"{kind}/main.js"
    return _filled(
        web_file("frame.html"),
        {"kind": kind, "main": main, "body": web_file(f"{kind}.html").rstrip()},
    )


def _filled(document: str, content: Mapping[str, str]) -> str:
    return re.sub(r"<!--(\w+)-->", lambda match: content.get(match[1], match[0]), document)


def document(
    kind: str,
    title: str,
    header: Mapping[str, Any],
    parts: Sequence[Packer],
    folders: Sequence[str] = ("",),
) -> str:
    """A whole page.

    Args:
        kind: `viewer` or `explore`.
        title: of the window.
        header: JSON header of the page.
        parts: packed arrays that the header points into.
        folders: of `web/` whose modules and style the page has.
    """
    styles = [
        name
        for web_folder in folders
        if (_WEB / (name := f"{web_folder}/style.css".lstrip("/"))).is_file()
    ]
    data = [
        f'<script type="text/plain" data-part="{part.part}">{part.text()}</script>'
        for part in parts
    ]
    # An import map: the libraries, and each of our modules as `viewer/[FOLDER/]NAME.js`, as data URLs.
    sources = {name: web_file(path) for name, path in _LIBRARIES.items()}
    for folder in folders:
        for web_folder in sorted(
            web_folder.name
            for web_folder in (_WEB / folder).iterdir()
            if web_folder.name.endswith(".js")
        ):
            name = f"viewer/{folder}/{web_folder}".replace("//", "/")
            sources[name] = f"{web_file(name.removeprefix('viewer/'))}\n//# sourceURL={name}\n"
    encoded = {
        name: base64.b64encode(source.encode()).decode("ascii") for name, source in sources.items()
    }
    modules = {name: f"data:text/javascript;base64,{content}" for name, content in encoded.items()}
    content = {
        "title": html.escape(title),
        "style": "\n".join(map(web_file, styles)),
        "imports": as_json({"imports": modules}),
        "header": as_json(header),
        "data": "\n".join(data),
    }
    return _filled(template(kind), content)


def web_file(name: str) -> str:
    """A file of `web/`."""
    return (_WEB / name).read_text(encoding="utf-8")


def as_json(value: Any) -> str:
    """JSON that may stand in a script element."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )
