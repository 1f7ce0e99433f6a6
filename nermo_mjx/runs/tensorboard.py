"""Scalars of a long run in DIR/tensorboard, which `tensorboard --logdir DIR` shows; needs the extra `tensorboard`."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from nermo_mjx.runs.files import WrongDirectory


class TensorBoard:
    """Writes scalars; use it in a `with` statement. A resumed session adds a file.

    Args:
        out: the directory.
        part: of several processes that write the directory, which one this is.
    """

    def __init__(self, out: Path, part: str = "") -> None:
        from tensorboardX import SummaryWriter

        # Files are named by the second: of two sessions within one, the later would overwrite the earlier.
        self._writer = SummaryWriter(str(out / "tensorboard" / part), filename_suffix=f".{time.time_ns()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Write the finite numbers, by name; the others cannot be plotted."""
        for name, value in numbers.items():
            if math.isfinite(value):
                self._writer.add_scalar(name, float(value), step)
        self._writer.flush()


def require_tensorboard() -> None:
    """Raises `WrongDirectory`, with the sentence that says what to install, where the package is missing."""
    if importlib.util.find_spec("tensorboardX") is None:
        raise WrongDirectory("tensorboard needs the package tensorboardX: install it with pip.")
