"""Arrays for a web page: rounded to 16 bits, ordered so that they compress well, gzipped, as text.

`view/web/data.js` is the reader. A packed array has an entry in the header:
`{"part", "kind", "at", "shape"}`, and for `steps` `{"scale", "zero"}`. Kinds:

- `float32`, `uint32`, `uint16`: plain values, little-endian, row by row.
- `planes3`, `planes4`: as many high bytes of 32-bit floats, first all highest bytes, then all next ones.
- `json`: a value as JSON, `shape` its bytes.
- `steps`: x = zero + scale * q with q a 16-bit integer, stored column by column as differences between neighbouring
  rows, first all high bytes, then all low ones. -32768 stands for a missing value.
"""

from __future__ import annotations

import base64
import gzip
import json
from typing import Any, Final

import numpy as np

MISSING: Final = -32768
_LARGEST: Final = 32767


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
        zero, scale = (low + high) / 2, max((high - low) / (2 * _LARGEST), resolution) or 1.0
        steps = np.where(np.isnan(array), MISSING, np.rint((array - zero) / scale)).astype(np.int16)
        columns = np.ascontiguousarray(steps.reshape(len(steps), -1).T)
        with np.errstate(over="ignore"):
            columns[:, 1:] = np.diff(columns, axis=1)  # wraps around, which the reader reverses
        words = columns.astype("<i2").reshape(-1).view(np.uint8).reshape(-1, 2)
        content = words[:, 1].tobytes() + words[:, 0].tobytes()
        return self._add(content, "steps", array.shape) | {"scale": scale, "zero": zero}

    def floats(self, values: np.ndarray, exact: bool = False) -> dict[str, Any]:
        """Entry of an array (n,) of any range, with a relative error below 1e-5; `exact` keeps all of 32-bit floats."""
        planes = 4 if exact else 3
        with np.errstate(over="ignore"):
            bits = np.asarray(values, np.float32).view(np.uint32)
        if not exact:
            bits = bits + np.uint32(0x80)  # drop the lowest byte, with rounding
        content = b"".join((bits >> np.uint32(24 - 8 * k)).astype(np.uint8).tobytes() for k in range(planes))
        return self._add(content, f"planes{planes}", np.shape(values))

    def json(self, value: Any) -> dict[str, Any]:
        """Entry of a JSON value."""
        content = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
        return self._add(content, "json", (len(content),))

    def text(self) -> str:
        """All arrays, gzipped, in base 64."""
        return base64.b64encode(gzip.compress(b"".join(self._parts), 9, mtime=0)).decode("ascii")

    def _add(self, content: bytes, kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
        padding = bytes(-self._size % 4)
        entry = {"part": self.part, "kind": kind, "at": self._size + len(padding), "shape": list(shape)}
        self._parts += [padding, content]
        self._size += len(padding) + len(content)
        return entry
