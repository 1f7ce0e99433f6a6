"""Terrains whose shape is set by parameters, so that each world of a batch has its own.

Each is a named scene. It begins 0.15 m ahead of the robot's start, and the path leads along -y; on the spiral stair it
is the circle to the left. `TerrainShape` alone determines the layout, for the compiled scene, the model fields of a
batch (`physics.variation`), and the height of the ground (`terrain`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from nermo_mjx.robot.quantity import parameter_tree, quantity

#: Distance from the robot's start to the beginning of a terrain, and half the terrain's width [m].
TERRAIN_DISTANCE: Final = 0.15
HALF_WIDTH: Final = 0.4
#: Depth to which steps and ramps are buried [m], so that there is no gap beneath them.
BURIAL_DEPTH: Final = 0.1
#: Radius and half height of the poles of the slalom [m].
POLE: Final = (0.01, 0.08)
#: The field of rough ground: half lengths across and along the path [m], spacing of its points, and its centre.
FIELD_SIZE: Final = (0.6, 2.4)
FIELD_STEP: Final = 0.03
FIELD_CENTRE: Final = -2.0


@parameter_tree
class TerrainShape:
    """The shape of a terrain; each scene uses some of it (`TERRAINS`), and has its own defaults."""

    height: Any = quantity(0.01, "m", 0.0, 0.05, "of a plank, log, step, or of rough ground")
    spacing: Any = quantity(
        0.2, "m", 0.05, 1.0, "way from one plank, log, step or gate to the next"
    )
    width: Any = quantity(0.1, "m", 0.01, 0.3, "of a plank, along the way")
    radius: Any = quantity(0.1, "m", 0.05, 2.0, "of a log, or of the way up the spiral stair")
    slope: Any = quantity(math.radians(10.0), "rad", 0.0, 0.6, "of the ramp")
    gap: Any = quantity(0.2, "m", 0.05, 1.0, "between the two poles of a gate")
    offset: Any = quantity(0.06, "m", -0.3, 0.3, "of the slalom's gates from the middle")
    shift: Any = quantity(0.0, "m", -1.0, 1.0, "how much farther ahead the terrain begins")
    side: Any = quantity(0.0, "m", -0.4, 0.4, "how far to the left rough ground is moved")


class TerrainGeoms(NamedTuple):
    """Positions, orientations and sizes of a terrain's geoms: (k, 3), (k, 4) and (k, 3), as in MuJoCo."""

    pos: Any
    quat: Any
    size: Any


@dataclasses.dataclass(frozen=True)
class TerrainKind:
    """A named terrain.

    Attributes:
        doc: description in one line.
        geom: type of its geoms.
        count: number of its geoms.
        layout: from a shape and `numpy` or `jax.numpy` to a `TerrainGeoms`.
        defaults: of the shape, where they differ from those of `TerrainShape`; their names are the parameters that the
        terrain reads.
        obstacle: whether it stops the robot, instead of carrying it.
        material: of its geoms.
    """

    doc: str
    geom: mujoco.mjtGeom
    count: int
    layout: Callable[[TerrainShape, Any], TerrainGeoms]
    defaults: Mapping[str, float]
    obstacle: bool = False
    material: str = "wood"

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the parameters that it reads."""
        return tuple(f"terrain.{name}" for name in self.defaults)


def _stacked(xp: Any, *columns: Any) -> Any:
    """Columns of k numbers each, or one number for all, as an array (k, columns)."""
    return xp.stack(xp.broadcast_arrays(*(xp.asarray(column) for column in columns)), axis=-1)


def _level(xp: Any, count: int) -> Any:
    return xp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))


def _along(shape: TerrainShape, count: int) -> Any:
    """Distances from the start to the beginnings of this number of elements."""
    return TERRAIN_DISTANCE + shape.shift + shape.spacing * np.arange(count)


def _planks(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    y = -(_along(shape, 14) + 0.5 * shape.width)
    pos = _stacked(xp, 0.0, y, shape.height - 0.5 * BURIAL_DEPTH)
    return TerrainGeoms(
        pos,
        _level(xp, 14),
        _stacked(xp, np.full(14, HALF_WIDTH), 0.5 * shape.width, 0.5 * BURIAL_DEPTH),
    )


def _logs(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    pos = _stacked(xp, 0.0, -(_along(shape, 18) + 0.5 * shape.spacing), shape.height - shape.radius)
    half = math.sqrt(0.5)
    quat = xp.asarray(np.tile([half, 0.0, half, 0.0], (18, 1)))
    return TerrainGeoms(pos, quat, _stacked(xp, np.full(18, 1.0) * shape.radius, HALF_WIDTH, 0.0))


def _ramp(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    """A plane that rises from the floor, and the platform that it leads to."""
    half, top, thick = 1.0, 1.0, 0.5 * BURIAL_DEPTH
    cosine, sine, begin = xp.cos(shape.slope), xp.sin(shape.slope), TERRAIN_DISTANCE + shape.shift
    along, up = begin + half * cosine + thick * sine, half * sine - thick * cosine
    end = begin + 2.0 * half * cosine
    pos = xp.stack(
        [
            _stacked(xp, 0.0, -along, up),
            _stacked(xp, 0.0, -(end + top), 2.0 * half * sine - thick),
        ]
    )
    # Rotation about x, so that the ramp rises towards -y.
    turned = _stacked(xp, xp.cos(-0.5 * shape.slope), xp.sin(-0.5 * shape.slope), 0.0, 0.0)
    quat = xp.stack([turned, xp.asarray([1.0, 0.0, 0.0, 0.0])])
    size = xp.asarray([[HALF_WIDTH, half, thick], [HALF_WIDTH, top, thick]])
    return TerrainGeoms(pos, quat, size)


def _stairs(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    """Seven steps; the last is the platform."""
    number, platform = np.arange(7), 1.0
    half = xp.where(number < 6, 0.5 * shape.spacing, 0.5 * platform)
    y = -(_along(shape, 7) + half)
    pos = _stacked(xp, 0.0, y, shape.height * (number + 1) - BURIAL_DEPTH)
    return TerrainGeoms(pos, _level(xp, 7), _stacked(xp, HALF_WIDTH, half, BURIAL_DEPTH))


def _spiral(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    """Steps about the point (radius, 0), `spacing` apart along the path, which is the circle to the left."""
    number, width = np.arange(15), 0.3
    angle = (TERRAIN_DISTANCE + shape.shift + shape.spacing * (number + 0.5)) / shape.radius
    x, y = shape.radius * (1.0 - xp.cos(angle)), -shape.radius * xp.sin(angle)
    pos = _stacked(xp, x, y, shape.height * (number + 1) - BURIAL_DEPTH)
    quat = _stacked(xp, xp.cos(0.5 * angle), 0.0, 0.0, xp.sin(0.5 * angle))
    # As deep as the outer end requires; further in, steps overlap and the higher one counts.
    deep = 0.5 * shape.spacing * (1.0 + 0.5 * width / shape.radius)
    return TerrainGeoms(pos, quat, _stacked(xp, np.full(15, 0.5 * width), deep, BURIAL_DEPTH))


def _rough(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    pos = _stacked(xp, shape.side, FIELD_CENTRE - shape.shift, 0.0)[None]
    return TerrainGeoms(pos, _level(xp, 1), xp.asarray([[*FIELD_SIZE, 1.0]]))


def _slalom(shape: TerrainShape, xp: Any) -> TerrainGeoms:
    """Six gates of two poles, the left one first."""
    centres, radius = gates(shape, xp), POLE[0]
    distance = 0.5 * shape.gap + radius
    x = xp.stack([centres[:, 0] + distance, centres[:, 0] - distance], axis=-1).reshape(-1)
    pos = _stacked(xp, x, xp.repeat(centres[:, 1], 2), POLE[1])
    return TerrainGeoms(pos, _level(xp, 12), xp.asarray(np.tile([*POLE, 0.0], (12, 1))))


def gates(shape: TerrainShape, xp: Any = np) -> Any:
    """Centres of the slalom's six gates (6, 2) [m], for use as way points."""
    side = np.where(np.arange(6) % 2 == 0, 1.0, -1.0)
    return _stacked(xp, side * shape.offset, -(_along(shape, 6) + 0.5 * shape.spacing))


_BOX, _CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
#: Every terrain, by the name of its scene.
TERRAINS: Final[Mapping[str, TerrainKind]] = {
    "planks": TerrainKind(
        "planks across the way",
        _BOX,
        14,
        _planks,
        {"height": 0.01, "spacing": 0.2, "width": 0.1, "shift": 0.0},
    ),
    "ramp": TerrainKind(
        "a ramp, and the platform that it leads to",
        _BOX,
        2,
        _ramp,
        {"slope": math.radians(10.0), "shift": 0.0},
    ),
    "logs": TerrainKind(
        "round logs across the way, sunk into the floor",
        _CAPSULE,
        18,
        _logs,
        {"height": 0.01, "spacing": 0.15, "radius": 0.1, "shift": 0.0},
    ),
    "stairs": TerrainKind(
        "seven steps up to a platform",
        _BOX,
        7,
        _stairs,
        {"height": 0.01, "spacing": 0.15, "shift": 0.0},
    ),
    "spiral_stairs": TerrainKind(
        "fifteen steps up, about a point to the left",
        _BOX,
        15,
        _spiral,
        {"height": 0.01, "spacing": 0.15, "radius": 0.5, "shift": 0.0},
    ),
    "rough": TerrainKind(
        "random rough ground, a height field",
        mujoco.mjtGeom.mjGEOM_HFIELD,
        1,
        _rough,
        {"height": 0.01, "shift": 0.0, "side": 0.0},
        material="soil",
    ),
    "slalom": TerrainKind(
        "gates of two poles, to the left and to the right in turn",
        _CAPSULE,
        12,
        _slalom,
        {"spacing": 0.4, "gap": 0.2, "offset": 0.06, "shift": 0.0},
        obstacle=True,
    ),
}


def terrain_values(scene: str) -> dict[str, float]:
    """The parameters `terrain.*` that a scene reads."""
    kind = TERRAINS.get(scene)
    return (
        {} if kind is None else {f"terrain.{name}": value for name, value in kind.defaults.items()}
    )


@functools.cache
def scenes_reading(name: str) -> tuple[str, ...]:
    """The scenes that read a parameter `terrain.*`.

    >>> scenes_reading("terrain.slope")
    ('ramp',)
    """
    return tuple(scene for scene, kind in TERRAINS.items() if name in kind.reads)


def geom_names(scene: str) -> tuple[str, ...]:
    """Names of the geoms that a terrain's parameters move; none in another scene."""
    return tuple(f"{scene}_{i}" for i in range(TERRAINS[scene].count)) if scene in TERRAINS else ()


def _waves() -> tuple[np.ndarray, ...]:
    """The waves that make up rough ground: wave numbers across and along the way [rad/m], phases [rad], heights.

    They are from 0.1 to 0.5 m long, the short ones lower, in irregular directions and phases. These come from the
    golden ratio: a generator's stream may change with a release of NumPy, which would change the scene.
    """
    number, golden = np.arange(16), 0.5 * (np.sqrt(5.0) - 1.0)
    length = 0.1 * 5.0 ** (number / 15.0)
    direction = 2.0 * np.pi * ((golden * number) % 1.0)
    phase = 2.0 * np.pi * ((golden * number**2) % 1.0)
    number_of_waves = 2.0 * np.pi / length
    return number_of_waves * np.cos(direction), number_of_waves * np.sin(direction), phase, length


def field_share(column: Any, row: Any, xp: Any = np) -> Any:
    """Height of rough ground at points of its field over the parameter `height`, in [0, 1].

    Args:
        column, row: of the points, which broadcast.
        xp: `numpy` or `jax.numpy`.
    """
    low, high = _field_range()
    return (_sum_of_waves(column, row, xp) - low) / (high - low)


def _sum_of_waves(column: Any, row: Any, xp: Any) -> Any:
    across, along, phase, height = (
        values.astype(np.result_type(column * 1.0)) for values in _waves()
    )
    turn = FIELD_STEP * (column[..., None] * across + row[..., None] * along) + phase
    return xp.sum(height * xp.sin(turn), axis=-1)


@functools.cache
def _field_range() -> tuple[float, float]:
    columns, rows = _field_points()
    total = _sum_of_waves(columns, rows, np)
    return float(total.min()), float(total.max())


def _field_points() -> tuple[np.ndarray, np.ndarray]:
    columns, rows = (round(2.0 * half / FIELD_STEP) + 1 for half in FIELD_SIZE)
    column, row = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    return column, row


def field_shares() -> np.ndarray:
    """Relative heights of all points of the field, (rows, columns)."""
    return np.clip(field_share(*_field_points()), 0.0, 1.0)


def add_terrain(spec: mujoco.MjSpec, scene: str) -> None:
    """Put the geoms of a terrain of its default shape into a scene.

    Args:
        spec: the floor's; it has the default classes `ground` and `obstacle`.
        scene: name of the terrain.
    """
    kind = TERRAINS[scene]
    shape = TerrainShape(**kind.defaults)
    layout = kind.layout(shape, np)
    if kind.geom == mujoco.mjtGeom.mjGEOM_HFIELD:
        shares = field_shares()
        size = [*FIELD_SIZE, max(float(shape.height), 1e-6), BURIAL_DEPTH]
        spec.add_hfield(
            name=scene,
            nrow=shares.shape[0],
            ncol=shares.shape[1],
            size=size,
            userdata=shares.ravel(),
        )
    classname = spec.find_default("obstacle" if kind.obstacle else "ground")
    for name, pos, quat, size in zip(geom_names(scene), *layout, strict=True):
        geom = spec.worldbody.add_geom(
            classname, name=name, type=kind.geom, pos=pos, quat=quat, size=size
        )
        geom.material = kind.material
        if kind.geom == mujoco.mjtGeom.mjGEOM_HFIELD:
            geom.hfieldname, geom.size = scene, np.zeros(3)
