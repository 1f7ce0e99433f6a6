"""The visible shapes of a model: its geoms with sizes, poses and colours, and its meshes."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.view.packing import Packer

_GEOM: Final = mujoco.mjtGeom
#: Shapes that the page draws, by MuJoCo's type.
KINDS: Final = {
    int(_GEOM.mjGEOM_PLANE): "plane", int(_GEOM.mjGEOM_SPHERE): "sphere", int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid", int(_GEOM.mjGEOM_CYLINDER): "cylinder", int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_MESH): "mesh",
}  # fmt: skip
#: MuJoCo draws the groups below this one; the others contain collision geoms.
HIDDEN_GROUP: Final = 3


def shapes_of(model: mujoco.MjModel, packer: Packer) -> dict[str, Any]:
    """Bodies, geoms and meshes of a model, in the page's format.

    Returns:
        `bodies`: names; `eyes`: the camera of that name with body, pose and field of view, or None; `geoms`: of each
        `kind`, `body`, `size`, `pos`, `quat` in its body [m], `rgba`, `collides`, and for a mesh
        its index; `meshes`: entries of vertices and faces.
    """
    meshes: dict[int, int] = {}
    geoms = []
    for i in range(model.ngeom):
        kind = KINDS.get(int(model.geom_type[i]))
        if kind is None:
            continue
        geom: dict[str, Any] = {
            "kind": kind, "body": int(model.geom_bodyid[i]), "size": _rounded(model.geom_size[i]),
            "pos": _rounded(model.geom_pos[i]), "quat": _rounded(model.geom_quat[i]),
            "rgba": _rounded(_colour(model, i)), "collides": bool(model.geom_group[i] >= HIDDEN_GROUP),
        }  # fmt: skip
        if kind == "mesh":
            geom["mesh"] = meshes.setdefault(int(model.geom_dataid[i]), len(meshes))
        geoms.append(geom)
    return {
        "bodies": [model.body(i).name for i in range(model.nbody)],
        "eyes": _eyes(model),
        "geoms": geoms,
        "meshes": [_mesh(model, mesh, packer) for mesh in meshes],
    }


def _eyes(model: mujoco.MjModel) -> dict[str, Any] | None:
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "eyes")
    if camera < 0:
        return None
    return {
        "body": int(model.cam_bodyid[camera]), "pos": _rounded(model.cam_pos[camera]),
        "quat": _rounded(model.cam_quat[camera]), "fovy": float(model.cam_fovy[camera]),
    }  # fmt: skip


def _mesh(model: mujoco.MjModel, mesh: int, packer: Packer) -> dict[str, Any]:
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    return {
        "vertices": packer.steps(model.mesh_vert[vertices]),
        "faces": packer.plain(model.mesh_face[faces], "uint32"),
    }


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The colour in which MuJoCo draws it: the material's unless the geom has its own; a texture's mean colour."""
    material = int(model.geom_matid[geom])
    own = np.array(model.geom_rgba[geom], float)
    if material < 0 or not np.allclose(own, 0.5 * np.array([1, 1, 1, 2])):
        return own
    colour = np.array(model.mat_rgba[material], float)
    textures = model.mat_texid[material]
    texture = next((int(t) for t in textures if t >= 0), -1)
    if texture >= 0:
        size = int(model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture])
        start = int(model.tex_adr[texture])
        pixels = model.tex_data[start : start + size].reshape(-1, int(model.tex_nchannel[texture]))
        colour[:3] *= pixels[:, :3].mean(axis=0) / 255.0
    return colour


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 7) for value in values]
