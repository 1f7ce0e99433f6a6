"""Motion in the frames in which it changes least: bodies relative to their parents, tendons' points to the bodies.

A hinge then changes only its quaternion, and a tendon's point moves only where it slides over a pulley, so both take a
fifth of the space. `view/web/frames.js` reassembles them.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from nermo_mjx.view.motion import Motion


class Frames:
    """The moving bodies of a motion.

    Attributes:
        bodies: their ids in the model, parents first, (n,).
        parents: index of each one's parent in `bodies`; -1 if the parent is static, with the world's frame centred at
            the root.
        position, quaternion: of each in its parent's frame, (T, n, 3) [m] and (T, n, 4), without sign flips.
    """

    def __init__(self, model: mujoco.MjModel, motion: Motion, origin: Float[np.ndarray, "T 3"]) -> None:
        self.bodies: Int[np.ndarray, " n"] = np.flatnonzero(model.body_weldid != 0)
        place = {int(body): i for i, body in enumerate(self.bodies)}
        self.parents = [place.get(int(model.body_parentid[body]), -1) for body in self.bodies]
        self._position = motion.position[:, self.bodies] - origin[:, None]
        self._quaternion = motion.quaternion[:, self.bodies]
        self.position, turns = self._position.copy(), self._quaternion.copy()
        for i, parent in enumerate(self.parents):
            if parent >= 0:
                self.position[:, i] = self._inside(parent, self._position[:, i])
                turns[:, i] = _product(_conjugate(self._quaternion[:, parent]), self._quaternion[:, i])
        self.quaternion = without_jumps(turns)

    def fixed(self, path: Float[np.ndarray, "T K 3"]) -> tuple[list[int], Float[np.ndarray, "T K 3"]]:
        """Points in the frames in which they move least: indices in `bodies` or -1, and the points."""
        frames, points = [], path.copy()
        for k in range(path.shape[1]):
            each = [path[:, k], *(self._inside(i, path[:, k]) for i in range(len(self.bodies)))]
            best = int(np.argmin([seen.var(axis=0).sum() for seen in each]))
            frames.append(best - 1)
            points[:, k] = each[best]
        return frames, points

    def _inside(self, frame: int, points: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Points in the frame of a body."""
        return _turned(_conjugate(self._quaternion[:, frame]), points - self._position[:, frame])


def without_jumps(quaternion: np.ndarray) -> np.ndarray:
    """The same rotations (T, n, 4), each with the sign closer to the previous one, so that they can be interpolated."""
    signs = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    steady = quaternion.copy()
    steady[1:] *= np.cumprod(signs, axis=0)[..., None]
    return steady


def _conjugate(quaternion: np.ndarray) -> np.ndarray:
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """First b, then a, as (w, x, y, z)."""
    w = a[:, 0] * b[:, 0] - (a[:, 1:] * b[:, 1:]).sum(axis=1)
    rest: Any = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w[:, None], rest], axis=1)


def _turned(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    twice = 2 * np.cross(quaternion[:, 1:], points)
    return points + quaternion[:, :1] * twice + np.cross(quaternion[:, 1:], twice)
