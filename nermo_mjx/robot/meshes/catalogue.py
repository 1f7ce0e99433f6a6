"""All mesh files of the robot."""

from __future__ import annotations

from nermo_mjx.robot.meshes.creases import creased
from nermo_mjx.robot.meshes.head import head_shapes
from nermo_mjx.robot.meshes.hip import hip_shapes
from nermo_mjx.robot.meshes.leg import leg_shapes
from nermo_mjx.robot.meshes.obj import to_obj
from nermo_mjx.robot.meshes.servo import servo
from nermo_mjx.robot.meshes.spine import spine_shapes
from nermo_mjx.robot.meshes.tail import tail_shapes
from nermo_mjx.robot.meshes.torso import torso_shapes


def mesh_texts() -> dict[str, str]:
    """The text of every file in `mjcf/meshes`, by the file's name."""
    shapes = torso_shapes() | head_shapes() | spine_shapes() | hip_shapes() | leg_shapes() | tail_shapes()
    shapes["servo"] = servo()
    return {f"{name}.obj": to_obj(creased(shape)) for name, shape in sorted(shapes.items())}
