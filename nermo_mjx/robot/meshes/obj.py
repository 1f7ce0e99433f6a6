"""Mesh files: Wavefront OBJ in millimetres, to a hundredth, without normals; small, and readable in a diff."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.robot.meshes.shapes import Shape


def to_obj(shape: Shape) -> str:
    """The text of a mesh file."""
    lines = ["v " + " ".join(_number(value) for value in row) for row in _hundredths(shape).tolist()]
    lines += ["f {} {} {}".format(*face) for face in (shape.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


@functools.lru_cache(maxsize=128)
def read_obj(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices [mm] and faces of a file that `to_obj` wrote."""
    rows: dict[str, list[list[str]]] = {"v": [], "f": []}
    for line in path.read_text(encoding="ascii").splitlines():
        kind, *values = line.split()
        rows[kind].append(values)
    return np.array(rows["v"], float), np.array(rows["f"], int) - 1


def rounded(shape: Shape) -> Shape:
    """The shape as its mesh file has it."""
    return Shape(_hundredths(shape) / 100, shape.faces)


def _hundredths(shape: Shape) -> Int[np.ndarray, "V 3"]:
    # An offset larger than rounding errors, so that all platforms round to the same hundredth.
    return np.rint(100.0 * shape.vertices + 1e-5).astype(int)


def _number(hundredths: int) -> str:
    return f"{hundredths / 100:.2f}".rstrip("0").rstrip(".") if hundredths else "0"
