"""Drives: a user commands the robot while it walks. The same controller runs the simulated robot and the real one."""
