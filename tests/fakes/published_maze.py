"""The published maze as the tests know it: its table, typed apart from the scene, and a distance to its boxes."""

from __future__ import annotations

import numpy as np

#: x [m], y [m] and yaw [degrees] of the boxes 1 to 40, of 0.10 m, in the robot's frame.
_TABLE = """
-0.124 -1.240    0.0    0.006 -1.163  -40.0   -0.248 -1.162 -149.0   -0.249 -1.310  -29.0
 0.003 -1.307  -36.0   -0.124 -1.349    0.0   -0.123 -1.126    0.0    1.267 -0.919    0.0
 1.267 -1.047    0.0    1.267 -1.185    0.0    1.267 -1.323    0.0    1.125 -1.335    0.0
 0.977 -1.350    0.0    0.786 -1.372    0.0    0.598 -1.479    0.0    0.494 -1.635  -34.7
 0.337 -1.793   22.6    0.140 -1.830    0.0   -0.086 -1.830    0.0   -0.317 -1.830    0.0
-0.520 -1.830    0.0   -0.707 -1.794    0.0   -0.833 -1.659    0.0   -0.929 -1.491    0.0
-0.937 -1.310   -1.6   -0.928 -1.140   -2.6   -0.890 -0.984  -25.7   -0.793 -0.874  -51.3
-0.649 -0.795  -64.4   -0.501 -0.734  -69.3   -0.376 -0.670  -51.3   -0.307 -0.536    0.0
-0.307 -0.419    0.0    0.771 -0.919    0.0    0.627 -0.919    0.0    0.502 -0.885    0.0
 0.391 -0.781    0.0    0.302 -0.667    0.0    0.285 -0.547    0.0    0.269 -0.429    0.0
"""
BOXES = np.array(_TABLE.split(), float).reshape(-1, 3)


def clearance(points: np.ndarray) -> np.ndarray:
    """Distance from points (n, 2) to the surfaces of all boxes [m], shape (n, 40); 0 inside."""
    x, y, yaw = BOXES.T
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    dx, dy = points[:, :1] - x, points[:, 1:] - y
    along, across = np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx)
    return np.hypot(np.maximum(along - 0.05, 0.0), np.maximum(across - 0.05, 0.0))
