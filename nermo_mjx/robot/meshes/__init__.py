"""Visual meshes of the robot, made from its numbers; they have no mass and do not collide.

`python -m nermo_mjx.robot.meshes` writes them to `mjcf/meshes`, where the MJCF files refer to them.
"""
