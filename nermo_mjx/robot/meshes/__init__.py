"""Visual meshes of the robot, made from its numbers; they have no mass and do not collide."""
