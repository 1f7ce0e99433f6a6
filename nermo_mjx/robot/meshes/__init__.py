"""Meshes of what the robot looks like, made from its numbers; they weigh nothing and touch nothing.

`python -m nermo_mjx.robot.meshes` writes them to `mjcf/meshes`, whence the MJCF files take them.
"""

from nermo_mjx.robot.meshes.catalogue import mesh_texts
from nermo_mjx.robot.meshes.obj import read_obj

__all__ = ["mesh_texts", "read_obj"]
