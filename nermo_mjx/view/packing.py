"""Arrays for a web page: rounded to 16 bits, ordered so that they compress well, gzipped, as text.

`view/web/data.js` is the reader. A packed array has an entry in the header:
`{"kind", "at", "shape"}`, and for `steps` `{"scale", "zero"}`. Kinds:

- `float32`, `uint32`: plain values, little-endian, row by row.
- `steps`: x = zero + scale * q with q a 16-bit integer, stored column by column as differences between neighbouring
  rows, first all high bytes, then all low ones. -32768 stands for a missing value.
"""

from __future__ import annotations

import base64
import gzip
from typing import Any, Final

import numpy as np

MISSING: Final = -32768
_LARGEST: Final = 32767


class Packer:
    """Collects arrays; each gets its entry in the header, and all together become one text."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def plain(self, values: np.ndarray, kind: str = "float32") -> dict[str, Any]:
        """Entry of an array as it is, in `float32` or `uint32`."""
        array = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
        return self._add(array.tobytes(), kind, array.shape)

    def steps(self, values: np.ndarray) -> dict[str, Any]:
        """Entry of an array (T, ...) that changes little from row to row.

        Each value is off by at most 1/131068 of the array's range; NaN is kept, infinities become NaN.
        """
        array = np.where(np.isfinite(values), values, np.nan).astype(float)
        low, high = (np.nanmin(array), np.nanmax(array)) if np.isfinite(array).any() else (0.0, 0.0)
        zero, scale = (low + high) / 2, (high - low) / (2 * _LARGEST) or 1.0
        steps = np.where(np.isnan(array), MISSING, np.rint((array - zero) / scale)).astype(np.int16)
        columns = np.ascontiguousarray(steps.reshape(len(steps), -1).T)
        with np.errstate(over="ignore"):
            columns[:, 1:] = np.diff(columns, axis=1)  # wraps around, and back in the reader
        words = columns.astype("<i2").reshape(-1).view(np.uint8).reshape(-1, 2)
        content = words[:, 1].tobytes() + words[:, 0].tobytes()
        return self._add(content, "steps", array.shape) | {"scale": scale, "zero": zero}

    def text(self) -> str:
        """All arrays, gzipped, in base 64."""
        return base64.b64encode(gzip.compress(b"".join(self._parts), 9, mtime=0)).decode("ascii")

    def _add(self, content: bytes, kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
        padding = bytes(-self._size % 4)
        entry = {"kind": kind, "at": self._size + len(padding), "shape": list(shape)}
        self._parts += [padding, content]
        self._size += len(padding) + len(content)
        return entry
