"""Closed triangle meshes from a few primitives: lofts, tubes, turned parts, plates and blocks.

Lengths are millimetres, as in the mesh files. A shape has one vertex per corner; `creases` makes edges sharp.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.robot.geometry import Geometry, dh_table


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh whose faces are counter-clockwise seen from outside.

    Attributes:
        vertices: [mm], shape (V, 3).
        faces: indices of vertices, shape (F, 3).
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        """The shape, shifted [mm]."""
        return Shape(self.vertices + np.array([x, y, z]), self.faces)

    def turned(self, axis: str, angle: float) -> Shape:
        """The shape, turned about one of the axes "x", "y", "z" by an angle [rad]."""
        return self.transformed(rotation(axis, angle))

    def transformed(self, matrix: Float[np.ndarray, "3 3"], offset: Any = (0.0, 0.0, 0.0)) -> Shape:
        """The shape after a rotation and a shift [mm]."""
        return Shape(self.vertices @ np.asarray(matrix).T + np.asarray(offset, float), self.faces)

    def mirrored(self) -> Shape:
        """The mirror image, x -> -x."""
        return Shape(self.vertices * [-1.0, 1.0, 1.0], self.faces[:, ::-1])

    def with_mirror_image(self) -> Shape:
        """The shape and its mirror image."""
        return join(self, self.mirrored())


def rotation(axis: str, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix about "x", "y" or "z"; angle in rad."""
    c, s = np.cos(angle), np.sin(angle)
    i = "xyz".index(axis)
    matrix = np.eye(3)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix[j, j], matrix[j, k], matrix[k, j], matrix[k, k] = c, -s, s, c
    return matrix


def join(*shapes: Shape) -> Shape:
    """Several shapes as one mesh; they may overlap."""
    offsets = np.cumsum([0, *(len(shape.vertices) for shape in shapes[:-1])])
    return Shape(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate(
            [shape.faces + offset for shape, offset in zip(shapes, offsets, strict=True)]
        ),
    )


def loft(rings: Sequence[Any] | np.ndarray, ring_closed: bool = False) -> Shape:
    """Skin over rings with the same number of points each, shape (R, N, 3); its ends are capped unless the rings
    close."""
    points = np.asarray(rings, float)
    count, size = points.shape[:2]
    index = np.arange(count * size).reshape(count, size)
    faces = []
    for r in range(count if ring_closed else count - 1):
        lower, upper = index[r], index[(r + 1) % count]
        a, b, c, d = lower, np.roll(lower, -1), np.roll(upper, -1), upper
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    vertices = points.reshape(-1, 3)
    if not ring_closed:
        tips = np.stack([points[0].mean(axis=0), points[-1].mean(axis=0)])
        for tip, ring in zip(
            (count * size, count * size + 1), (index[0][::-1], index[-1]), strict=True
        ):
            faces.append(np.stack([np.full(size, tip), ring, np.roll(ring, -1)], axis=1))
        vertices = np.concatenate([vertices, tips])
    return _outward(Shape(vertices, np.concatenate(faces)))


def rounded_rectangle(width: float, height: float, corner: float) -> Float[np.ndarray, "8 2"]:
    """Rectangle of half-width and half-height with cut corners, around the origin."""
    w, h, c = width, height, min(corner, 0.95 * width, 0.95 * height)
    return np.array(
        [
            [w, -h + c],
            [w, h - c],
            [w - c, h],
            [-w + c, h],
            [-w, h - c],
            [-w, -h + c],
            [-w + c, -h],
            [w - c, -h],
        ]
    )


def superellipse(width: float, height: float, power: float, sides: int) -> Float[np.ndarray, "N 2"]:
    """|x/width|^power + |z/height|^power = 1; power 2 is an ellipse, more is squarer."""
    t = 2 * np.pi * np.arange(sides) / sides
    c, s = np.cos(t), np.sin(t)
    return np.stack(
        [
            width * np.sign(c) * np.abs(c) ** (2 / power),
            height * np.sign(s) * np.abs(s) ** (2 / power),
        ],
        axis=1,
    )


def block(low: Sequence[float], high: Sequence[float], chamfer: float = 0.5) -> Shape:
    """A box from corner to corner [mm] with chamfered edges."""
    low_, high_ = np.asarray(low, float), np.asarray(high, float)
    half, centre = (high_ - low_) / 2, (low_ + high_) / 2
    c = min(chamfer, 0.45 * half.min())
    rings = []
    for z, inset in ((-half[2], c), (-half[2] + c, 0.0), (half[2] - c, 0.0), (half[2], c)):
        outline = rounded_rectangle(half[0] - inset, half[1] - inset, c)
        rings.append(np.column_stack([outline, np.full(8, z)]) + centre)
    return loft(rings)


def plate(outline: Any, low: float, high: float, chamfer: float = 0.3) -> Shape:
    """A plate in the y-z plane from x = low to x = high; its outline (N, 2) must be star-shaped about its mean [mm]."""
    flat = np.asarray(outline, float)
    inner = _inset(flat, chamfer)
    levels = ((low, inner), (low + chamfer, flat), (high - chamfer, flat), (high, inner))
    return loft([np.column_stack([np.full(len(flat), x), points]) for x, points in levels])


def frame_plate(outline: Any, window: Any, low: float, high: float, chamfer: float = 0.3) -> Shape:
    """A plate as `plate` makes it, with a window; the points of the two outlines (N, 2) correspond [mm]."""
    outer, inner = np.asarray(outline, float), np.asarray(window, float)
    edge = _inset(outer, chamfer)
    levels = (
        (low, inner),
        (low, edge),
        (low + chamfer, outer),
        (high - chamfer, outer),
        (high, edge),
        (high, inner),
    )
    rings = np.stack(
        [np.column_stack([np.full(len(outer), x), points]) for x, points in levels], axis=1
    )
    return loft(rings, ring_closed=True)


def strut(
    start: tuple[float, float], end: tuple[float, float], r0: float, r1: float, sides: int = 6
) -> np.ndarray:
    """Outline of a link: a circle of radius r0 at `start` and of r1 at `end`, and their tangents; (2 sides, 2) [mm]."""
    p, q = np.asarray(start, float), np.asarray(end, float)
    along = np.arctan2(*(q - p)[::-1])
    lean = np.arccos(np.clip((r0 - r1) / np.linalg.norm(q - p), -1.0, 1.0))
    near, far = np.linspace(lean, 2 * np.pi - lean, sides), np.linspace(-lean, lean, sides)
    arcs = [(p, r0, along + near), (q, r1, along + far)]
    return np.concatenate([c + r * np.stack([np.cos(a), np.sin(a)], axis=1) for c, r, a in arcs])


def beam(stations: Sequence[Sequence[float]], corner: float) -> Shape:
    """A bar along y through rectangles with cut corners, each (y, middle z, half-width, half-height) [mm]."""
    rings = []
    for y, z, width, height in stations:
        section = rounded_rectangle(width, height, corner)
        rings.append(np.column_stack([section[:, 0], np.full(8, y), z + section[:, 1]]))
    return loft(rings)


def turned_part(profile: Any, sides: int = 20) -> Shape:
    """A part turned on a lathe about the x axis; `profile` (N, 2) holds (x, radius) [mm], along x."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.zeros(sides), np.cos(angle), np.sin(angle)], axis=1)
    return loft([[x, 0.0, 0.0] + radius * circle for x, radius in np.asarray(profile, float)])


def tube(
    path: Any,
    radii: Any,
    sides: int = 6,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    closed: bool = False,
) -> Shape:
    """An elliptic tube along a path (N, 3) [mm].

    Args:
        radii: (along `up`, across it), one pair or one for each point.
        up: direction that one axis of the section keeps to; not parallel to the path.
    """
    points = np.asarray(path, float)
    sizes = np.broadcast_to(np.asarray(radii, float), (len(points), 2))
    around = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    tangent = around if closed else np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.asarray(up, float) - tangent * (tangent @ np.asarray(up, float))[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    rings = [
        p + np.outer(a * np.cos(angle), u) + np.outer(b * np.sin(angle), v)
        for p, (a, b), u, v in zip(points, sizes, first, second, strict=True)
    ]
    return loft(rings, ring_closed=closed)


def _inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """The outline moved inward, point by point along the mean of its two edges' normals."""
    ahead, behind = np.roll(outline, -1, axis=0) - outline, outline - np.roll(outline, 1, axis=0)
    along = ahead / np.linalg.norm(ahead, axis=1, keepdims=True) + behind / np.linalg.norm(
        behind, axis=1, keepdims=True
    )
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return outline + distance * np.stack([-along[:, 1], along[:, 0]], axis=1)


def _outward(shape: Shape) -> Shape:
    """The shape with its faces turned so that they enclose a positive volume."""
    a, b, c = (shape.vertices[shape.faces[:, i]] - shape.vertices.mean(axis=0) for i in range(3))
    return (
        shape
        if np.einsum("ij,ij->", a, np.cross(b, c)) > 0
        else Shape(shape.vertices, shape.faces[:, ::-1])
    )


# ---
# Sharp edges: MuJoCo gives every vertex one normal, so an edge is sharp only if its vertices are split.


#: Edges that turn by more than this stay sharp [rad]. A chamfer turns by less: its vertices take the normal of the
#: large adjacent face, and the edge looks rounded.
CREASE_RAD: Final = np.radians(50.0)


def creased(shape: Shape, angle: float = CREASE_RAD) -> Shape:
    """The same surface, its vertices split wherever faces meet at more than `angle` [rad]; unused ones are dropped."""
    corner = shape.vertices[shape.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    face_indices = np.flatnonzero(area > 1e-9)
    normal = normal / np.maximum(area, 1e-12)[:, None]
    around: dict[int, list[int]] = {}
    for face in face_indices.tolist():
        for vertex in shape.faces[face].tolist():
            around.setdefault(vertex, []).append(face)
    vertices: list[np.ndarray] = []
    owner: dict[tuple[int, int], int] = {}
    for vertex, faces in around.items():
        for group in _smooth_groups(vertex, faces, shape.faces, normal, np.cos(angle)):
            owner.update(((face, vertex), len(vertices)) for face in group)
            vertices.append(shape.vertices[vertex])
    split = [
        [owner[face, vertex] for vertex in shape.faces[face].tolist()]
        for face in face_indices.tolist()
    ]
    return Shape(np.array(vertices), np.array(split))


def _smooth_groups(
    vertex: int, faces: list[int], corners: np.ndarray, normal: np.ndarray, limit: float
) -> list[list[int]]:
    """Faces around a vertex, in groups that are connected across edges that are not sharp."""
    group = {face: {face} for face in faces}
    for i, first_face in enumerate(faces):
        for second_face in faces[i + 1 :]:
            shared = set(corners[first_face].tolist()) & set(corners[second_face].tolist()) - {
                vertex
            }
            if (
                shared
                and normal[first_face] @ normal[second_face] > limit
                and group[first_face] is not group[second_face]
            ):
                union = group[first_face] | group[second_face]
                group.update((member, union) for member in union)
    return [
        list(members)
        for members in {id(members): sorted(members) for members in group.values()}.values()
    ]


# ---
# Numbers that several parts share: units, thicknesses, and poses along the spine.


#: Millimetres in a metre: meshes are in millimetres, the robot's numbers in metres.
MM: Final = 1000.0
#: Radius at which the leg's and the spine's tendons are drawn [mm].
TENDON_RADIUS: Final = 0.5
#: The axes of the stacked hip and knee servos are apart by the pulley's height; a servo fills most of it [mm].
SERVO_WIDTH: Final = 11.0


def dh_pose(first: int, last: int, geometry: Geometry) -> Float[np.ndarray, "4 4"]:
    """Pose of DH row `last` seen from row `first` of the straight spine; lengths in mm."""
    pose = np.eye(4)
    for alpha, a, theta, d in dh_table(geometry)[first + 1 : last + 1]:
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, MM * a],
                [st * ca, ct * ca, -sa, -MM * d * sa],
                [st * sa, ct * sa, ca, MM * d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    return pose
