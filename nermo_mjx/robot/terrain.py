"""How high the ground is beneath a place: planes, boxes and height fields that stand still."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.shapes import Array, Scalars

#: Cosine of the steepest plane that counts as ground.
_STEEPEST: Final = 0.1
_PARALLEL: Final = 1e-9


class Terrain:
    """Height of what the robot stands on, above z = 0 of the world; pure JAX, differentiable."""

    def __init__(self, model: mujoco.MjModel, geoms: Sequence[int]) -> None:
        """
        Args:
            model: compiled.
            geoms: ids of the ground's geoms, fixed to the world: planes, boxes and height fields.

        Raises:
            ParameterError: a plane that is too steep, or a height field that is not level.
        """
        self._surfaces = [_surface(model, geom) for geom in geoms]
        #: Height beside all of it: there a robot falls, and has fallen where it is lower.
        self._bottom = min(surface.bottom for surface in self._surfaces)

    def height(self, x: ArrayLike, y: ArrayLike) -> Scalars:
        """Height [m] of the highest ground at (x, y) [m], which broadcast; beside all of it, of its lowest point."""
        x, y = jnp.asarray(x), jnp.asarray(y)
        heights = [surface.height(x, y) for surface in self._surfaces]
        highest = heights[0]
        for each in heights[1:]:
            highest = jnp.maximum(highest, each)
        return jnp.where(jnp.isneginf(highest), self._bottom, highest)


class _Plane:
    def __init__(self, place: np.ndarray, rotation: np.ndarray) -> None:
        self.place, self.normal = place, rotation[:, 2]
        self.bottom = float(place[2])
        self.level = not self.normal[:2].any()

    def height(self, x: Array, y: Array) -> Array:
        if self.level:
            return jnp.full(jnp.broadcast_shapes(x.shape, y.shape), self.place[2], jnp.result_type(float))
        along = self.normal[0] * (x - self.place[0]) + self.normal[1] * (y - self.place[1])
        return self.place[2] - along / self.normal[2]


class _Box:
    def __init__(self, place: np.ndarray, rotation: np.ndarray, size: np.ndarray) -> None:
        self.place, self.rotation, self.size = place, rotation, size
        self.bottom = float(place[2] - np.abs(rotation[2]) @ size)

    def height(self, x: Array, y: Array) -> Array:
        """Where a vertical line from above enters the box, between its three pairs of faces; -inf where it does not."""
        top, base = jnp.full((), jnp.inf), jnp.full((), -jnp.inf)
        for axis, half in zip(self.rotation.T, self.size, strict=True):
            # Points of the line are (x, y, place_z + h); their coordinate along the axis is offset + slope h.
            offset, slope = axis[0] * (x - self.place[0]) + axis[1] * (y - self.place[1]), axis[2]
            if abs(slope) < _PARALLEL:
                top = jnp.where(jnp.abs(offset) <= half, top, -jnp.inf)
            else:
                top = jnp.minimum(top, (half * np.sign(slope) - offset) / slope)
                base = jnp.maximum(base, (-half * np.sign(slope) - offset) / slope)
        return jnp.where(top >= base, self.place[2] + top, -jnp.inf)


class _Field:
    def __init__(self, place: np.ndarray, rotation: np.ndarray, size: np.ndarray, data: np.ndarray) -> None:
        self.place, self.rotation, self.size = place, rotation, size
        self.heights = size[2] * data
        self.bottom = float(place[2])

    def height(self, x: Array, y: Array) -> Array:
        """On the triangles into which MuJoCo cuts each cell; -inf beside the field."""
        rows, columns = self.heights.shape
        dx, dy = x - self.place[0], y - self.place[1]
        u = (self.rotation[0, 0] * dx + self.rotation[1, 0] * dy) / self.size[0]
        v = (self.rotation[0, 1] * dx + self.rotation[1, 1] * dy) / self.size[1]
        column, row = 0.5 * (u + 1.0) * (columns - 1), 0.5 * (v + 1.0) * (rows - 1)
        i = jnp.clip(jnp.floor(row), 0, rows - 2).astype(int)
        j = jnp.clip(jnp.floor(column), 0, columns - 2).astype(int)
        s, t = column - j, row - i
        table = jnp.asarray(self.heights, jnp.result_type(float))
        origin, right, up, opposite = table[i, j], table[i, j + 1], table[i + 1, j], table[i + 1, j + 1]
        lower = origin + s * (right - origin) + t * (opposite - right)
        upper = origin + t * (up - origin) + s * (opposite - up)
        inside = (jnp.abs(u) <= 1.0) & (jnp.abs(v) <= 1.0)
        return jnp.where(inside, self.place[2] + jnp.where(s >= t, lower, upper), -jnp.inf)


def _surface(model: mujoco.MjModel, geom: int) -> _Plane | _Box | _Field:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    place, turn, size = model.geom_pos[geom].copy(), rotation.reshape(3, 3), model.geom_size[geom].copy()
    name, kind = model.geom(geom).name, model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _Box(place, turn, size)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        if turn[2, 2] < _STEEPEST:
            raise ParameterError(f"scene has the ground {name!r}, a plane that is too steep to stand on.")
        return _Plane(place, turn)
    field = model.geom_dataid[geom]
    if turn[2, 2] < 1.0 - 1e-6:
        raise ParameterError(f"scene has the ground {name!r}, an hfield that is not level.")
    rows, columns, start = model.hfield_nrow[field], model.hfield_ncol[field], model.hfield_adr[field]
    data = model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    return _Field(place, turn, model.hfield_size[field].copy(), np.array(data, float))
