"""All mesh files of the robot."""

from __future__ import annotations

import mujoco

from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.meshes.creases import creased
from nermo_mjx.robot.meshes.head import head_shapes
from nermo_mjx.robot.meshes.hip import hip_shapes
from nermo_mjx.robot.meshes.leg import leg_shapes
from nermo_mjx.robot.meshes.obj import rounded, to_obj
from nermo_mjx.robot.meshes.servo import servo
from nermo_mjx.robot.meshes.spine import spine_shapes
from nermo_mjx.robot.meshes.tail import tail_shapes
from nermo_mjx.robot.meshes.torso import torso_shapes


def mesh_texts() -> dict[str, str]:
    """The text of every file in `mjcf/meshes`, by the file's name."""
    robot = Geometry()
    shapes = torso_shapes(robot) | head_shapes() | spine_shapes(robot) | hip_shapes(robot) | leg_shapes(robot)
    shapes |= tail_shapes() | {"servo": servo()}
    return {f"{name}.obj": to_obj(creased(shape)) for name, shape in sorted(shapes.items())}


def redraw(spec: mujoco.MjSpec, geometry: Geometry) -> None:
    """Replace an assembled robot's meshes from the files by those of its geometry.

    Args:
        spec: of the robot.
        geometry: that it was assembled with.
    """
    shapes = torso_shapes(geometry) | hip_shapes(geometry) | leg_shapes(geometry)
    shapes |= {f"spine_{name.removeprefix('spine_')}": shape for name, shape in spine_shapes(geometry).items()}
    for mesh in spec.meshes:
        # Both sides share one file; the right side is mirrored by its scale.
        shape = shapes.get(mesh.name.replace("_left_", "_").replace("_right_", "_"))
        if shape is not None:
            drawn = rounded(creased(shape))
            mesh.uservert, mesh.userface = drawn.vertices.ravel(), drawn.faces.ravel()
