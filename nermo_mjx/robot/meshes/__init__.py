"""Meshes of what the robot looks like, made from its numbers; they weigh nothing and touch nothing.

`python -m nermo_mjx.robot.meshes` writes them to `mjcf/meshes`, whence the MJCF files take them.
"""
