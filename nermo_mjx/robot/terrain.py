"""Height of the ground at a point: planes, boxes, capsules and height fields, fixed or of a terrain's shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.robot.terrains import TERRAINS, TerrainShape, field_share, geom_names
from nermo_mjx.shapes import Array, Scalars

#: Cosine of the steepest plane that counts as ground.
_STEEPEST: Final = 0.1
_PARALLEL: Final = 1e-9


class Terrain:
    """Height of the ground above z = 0 of the world; pure JAX, differentiable."""

    def __init__(self, model: mujoco.MjModel, geoms: Sequence[int], scene: str = "") -> None:
        """
        Args:
            model: compiled.
            geoms: ids of the ground's geoms, fixed to the world: planes, boxes, capsules and height fields.
            scene: name of the scene; one of `TERRAINS` has a shape.

        Raises:
            ParameterError: a plane that is too steep, or a height field that is not level.
        """
        kind = TERRAINS.get(scene)
        self._kind = None if kind is None or kind.obstacle else kind
        shaped = set(geom_names(scene))
        self._still = [_surface(model, geom) for geom in geoms if model.geom(geom).name not in shaped]
        self._shaped = [_surface(model, geom) for geom in geoms if model.geom(geom).name in shaped]
        #: Height where there is no ground: there a robot falls, and has fallen once it is lower.
        self._bottom = min(surface.bottom for surface in (*self._still, *self._shaped))

    @property
    def has_shape(self) -> bool:
        """Whether its shape depends on parameters."""
        return self._kind is not None

    def height(self, x: ArrayLike, y: ArrayLike, shape: TerrainShape | None = None) -> Scalars:
        """Height [m] of the highest ground at (x, y) [m], which broadcast; where there is none, that of its lowest
        point.

        Args:
            shape: of a terrain, instead of the compiled one; ignored in scenes without parameters.
        """
        x, y = jnp.asarray(x), jnp.asarray(y)
        heights = [surface.height(x, y) for surface in self._still]
        if self._kind is None or shape is None:
            heights += [surface.height(x, y) for surface in self._shaped]
        else:
            heights.append(self._shaped_height(x, y, shape))
        highest = heights[0]
        for each in heights[1:]:
            highest = jnp.maximum(highest, each)
        return jnp.where(jnp.isneginf(highest), self._bottom, highest)

    def _shaped_height(self, x: Array, y: Array, shape: TerrainShape) -> Array:
        assert self._kind is not None
        pos, quat, size = (jnp.asarray(each, float) for each in self._kind.layout(shape, jnp))
        if self._kind.geom == mujoco.mjtGeom.mjGEOM_HFIELD:
            (field,) = self._shaped
            assert isinstance(field, _Field)
            return field.height(x - pos[0, 0] + field.place[0], y - pos[0, 1] + field.place[1], shape.height)
        surface = _box_height if self._kind.geom == mujoco.mjtGeom.mjGEOM_BOX else _capsule_height
        # All elements at once, along the last axis.
        rotation = _rotation(quat)
        return jnp.max(surface(x[..., None] - pos[:, 0], y[..., None] - pos[:, 1], rotation, size) + pos[:, 2], axis=-1)


def _rotation(quat: Array) -> Array:
    """Rotation matrices (k, 3, 3) of quaternions (k, 4)."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _box_height(dx: Array, dy: Array, rotation: Array, size: Array) -> Array:
    """Height above a box's centre at which a vertical line enters it, by its three pairs of faces; or -inf.

    Args:
        dx, dy: offset of the line from the centre, (...) [m].
        rotation, size: (..., 3, 3) and half lengths (..., 3) [m].
    """
    top, base = jnp.full((), jnp.inf), jnp.full((), -jnp.inf)
    for i in range(3):
        # Points of the line are (dx, dy, h); their coordinate along the axis is offset + slope h.
        offset, slope, half = rotation[..., 0, i] * dx + rotation[..., 1, i] * dy, rotation[..., 2, i], size[..., i]
        flat = jnp.abs(slope) < _PARALLEL
        safe, side = jnp.where(flat, 1.0, slope), jnp.where(slope < 0.0, -half, half)
        beside = jnp.where(jnp.abs(offset) <= half, jnp.inf, -jnp.inf)
        top = jnp.minimum(top, jnp.where(flat, beside, (side - offset) / safe))
        base = jnp.maximum(base, jnp.where(flat, -jnp.inf, (-side - offset) / safe))
    return jnp.where(top >= base, top, -jnp.inf)


def _capsule_height(dx: Array, dy: Array, rotation: Array, size: Array) -> Array:
    """The same for a capsule: the cylinder between its ends, and the spheres there."""
    ax, ay, az = (rotation[..., i, 2] for i in range(3))
    radius, half = size[..., 0], size[..., 1]
    along = dx * ax + dy * ay
    # Distance from the axis: |d|^2 - (d a)^2 <= r^2, with d = (dx, dy, h).
    a, c = 1.0 - az * az, dx * dx + dy * dy - along * along - radius * radius
    steep = a < _PARALLEL
    under = (along * az) ** 2 - a * c
    h = (along * az + jnp.sqrt(jnp.where(under > 0.0, under, 1.0))) / jnp.where(steep, 1.0, a)
    beside = ~steep & (under > 0.0) & (jnp.abs(along + h * az) <= half)
    highest = jnp.where(beside, h, -jnp.inf)
    for end in (-half, half):
        room = radius * radius - (dx - end * ax) ** 2 - (dy - end * ay) ** 2
        ball = end * az + jnp.sqrt(jnp.where(room > 0.0, room, 1.0))
        highest = jnp.maximum(highest, jnp.where(room > 0.0, ball, -jnp.inf))
    return highest


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


class _Solid:
    """A box or a capsule."""

    def __init__(self, place: np.ndarray, rotation: np.ndarray, size: np.ndarray, round_: bool) -> None:
        self.place, self.rotation, self.size, self.round = place, rotation, size, round_
        up = abs(rotation[2, 2]) * size[1] + size[0] if round_ else np.abs(rotation[2]) @ size
        self.bottom = float(place[2] - up)

    def height(self, x: Array, y: Array) -> Array:
        surface = _capsule_height if self.round else _box_height
        rotation, size = (jnp.asarray(each, jnp.result_type(float)) for each in (self.rotation, self.size))
        return self.place[2] + surface(x - self.place[0], y - self.place[1], rotation, size)


class _Field:
    def __init__(
        self, place: np.ndarray, rotation: np.ndarray, size: np.ndarray, data: np.ndarray, of_waves: bool
    ) -> None:
        self.place, self.rotation, self.size, self.form = place, rotation, size, data.shape
        self.highest = float(size[2])
        #: None for rough ground, whose points are computed: XLA takes minutes to compile a program with so large a
        #: table.
        self.table = None if of_waves else data
        self.bottom = float(place[2])

    def height(self, x: Array, y: Array, highest: ArrayLike | None = None) -> Array:
        """Height on the triangles into which MuJoCo divides each cell, for a field of this height; -inf off the
        field."""
        rows, columns = self.form
        dx, dy = x - self.place[0], y - self.place[1]
        u = (self.rotation[0, 0] * dx + self.rotation[1, 0] * dy) / self.size[0]
        v = (self.rotation[0, 1] * dx + self.rotation[1, 1] * dy) / self.size[1]
        column, row = 0.5 * (u + 1.0) * (columns - 1), 0.5 * (v + 1.0) * (rows - 1)
        i = jnp.clip(jnp.floor(row), 0, rows - 2).astype(int)
        j = jnp.clip(jnp.floor(column), 0, columns - 2).astype(int)
        s, t = column - j, row - i
        origin, right, up, opposite = (
            self._shares(i, j),
            self._shares(i, j + 1),
            self._shares(i + 1, j),
            self._shares(i + 1, j + 1),
        )
        lower = origin + s * (right - origin) + t * (opposite - right)
        upper = origin + t * (up - origin) + s * (opposite - up)
        inside = (jnp.abs(u) <= 1.0) & (jnp.abs(v) <= 1.0)
        share = jnp.where(s >= t, lower, upper)
        return jnp.where(inside, self.place[2] + (self.highest if highest is None else highest) * share, -jnp.inf)

    def _shares(self, row: Array, column: Array) -> Array:
        """Heights of points of the field."""
        if self.table is None:
            return field_share(column.astype(float), row.astype(float), jnp)
        return jnp.asarray(self.table, jnp.result_type(float))[row, column]


def _surface(model: mujoco.MjModel, geom: int) -> _Plane | _Solid | _Field:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    place, turn, size = model.geom_pos[geom].copy(), rotation.reshape(3, 3), model.geom_size[geom].copy()
    name, kind = model.geom(geom).name, mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return _Solid(place, turn, size, round_=kind == mujoco.mjtGeom.mjGEOM_CAPSULE)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        if turn[2, 2] < _STEEPEST:
            raise ParameterError(f"scene has the ground {name!r}, a plane that is too steep to stand on.")
        return _Plane(place, turn)
    field = model.geom_dataid[geom]
    if turn[2, 2] < 1.0 - 1e-6:
        raise ParameterError(f"scene has the ground {name!r}, an hfield that is not level.")
    rows, columns, start = model.hfield_nrow[field], model.hfield_ncol[field], model.hfield_adr[field]
    data = np.array(model.hfield_data[start : start + rows * columns].reshape(rows, columns), float)
    return _Field(place, turn, model.hfield_size[field].copy(), data, of_waves=name in geom_names("rough"))
