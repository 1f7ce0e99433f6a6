"""Test stands of one leg and of the spine: force, speed and work of their servos, and the bend of their joints."""
