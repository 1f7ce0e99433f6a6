"""Sharp edges: MuJoCo gives every vertex one normal, so an edge is sharp only if its vertices are split."""

from __future__ import annotations

from typing import Final

import numpy as np

from nermo_mjx.robot.meshes.shapes import Shape

#: Edges that turn by more than this stay sharp [rad]. A chamfer turns by less: its vertices take the normal of the
#: large adjacent face, and the edge looks rounded.
CREASE: Final = np.radians(50.0)


def creased(shape: Shape, angle: float = CREASE) -> Shape:
    """The same surface, its vertices split wherever faces meet at more than `angle` [rad]; unused ones are dropped."""
    corner = shape.vertices[shape.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    kept = np.flatnonzero(area > 1e-9)
    normal = normal / np.maximum(area, 1e-12)[:, None]
    around: dict[int, list[int]] = {}
    for face in kept.tolist():
        for vertex in shape.faces[face].tolist():
            around.setdefault(vertex, []).append(face)
    vertices: list[np.ndarray] = []
    owner: dict[tuple[int, int], int] = {}
    for vertex, faces in around.items():
        for group in _smooth_groups(vertex, faces, shape.faces, normal, np.cos(angle)):
            owner.update(((face, vertex), len(vertices)) for face in group)
            vertices.append(shape.vertices[vertex])
    split = [[owner[face, vertex] for vertex in shape.faces[face].tolist()] for face in kept.tolist()]
    return Shape(np.array(vertices), np.array(split))


def _smooth_groups(
    vertex: int, faces: list[int], corners: np.ndarray, normal: np.ndarray, limit: float
) -> list[list[int]]:
    """Faces around a vertex, in groups that are connected across edges that are not sharp."""
    group = {face: {face} for face in faces}
    for i, one in enumerate(faces):
        for other in faces[i + 1 :]:
            shared = set(corners[one].tolist()) & set(corners[other].tolist()) - {vertex}
            if shared and normal[one] @ normal[other] > limit and group[one] is not group[other]:
                union = group[one] | group[other]
                group.update((member, union) for member in union)
    return [list(members) for members in {id(members): sorted(members) for members in group.values()}.values()]
