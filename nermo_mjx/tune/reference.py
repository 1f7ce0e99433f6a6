"""A recorded walk that a tuning compares with, to find the parameters of the robot that walked it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout.differentiable import Rollout
from nermo_mjx.view.recording import Recording, RecordingError

#: Spread of a coordinate below which it counts as this large: a millimetre, and a hundredth of a radian.
_LEAST_SPREAD: Final = (1e-3, 1e-2)


@dataclasses.dataclass(frozen=True)
class Reference:
    """Positions at the end of each control tick, and how much each of them counts.

    Attributes:
        qpos: (ticks, nq).
        weight: inverse of each coordinate's variance over the recording, (nq,).
    """

    qpos: Float[np.ndarray, "ticks nq"]
    weight: Float[np.ndarray, " nq"]

    def error(self, qpos: Float[Array, "ticks nq"]) -> Float[Array, ""]:
        """Mean over time and coordinates of the squared difference from the recording, over the recording's variance.

        Args:
            qpos: of a walk, at the end of each control tick; what is longer than the reference does not count.
        """
        apart = (qpos[: len(self.qpos)] - jnp.asarray(self.qpos, qpos.dtype)) ** 2
        return jnp.mean(apart @ jnp.asarray(self.weight, qpos.dtype)) / self.qpos.shape[1]


def load_reference(path: Path, rollout: Rollout, seconds: float) -> Reference:
    """Read a recording as the reference of a walk of `seconds`.

    Raises:
        ParameterError: it is no recording, of another robot, or shorter than the walk; one sentence.
    """
    try:
        recording = Recording.load(path)
        recording.check_model(rollout.robot.model)
    except RecordingError as error:
        raise ParameterError(f"recording is {path}: {error}") from None
    dt = rollout.controller.dt
    time = dt * (1.0 + np.arange(round(seconds / dt)))
    if recording.time[-1] < time[-1] - 0.5 * dt or recording.time[0] > 2.5 * dt:
        first, last = recording.time[0], recording.time[-1]
        raise ParameterError(
            f"recording is {path}, from {first:.3g} to {last:.3g} s: expected all of the run, from its start to "
            f"{time[-1]:.3g} s."
        )
    qpos = np.stack([np.interp(time, recording.time, column) for column in recording.qpos.T], axis=-1)
    place = np.arange(qpos.shape[1]) - rollout.robot.joints.root
    least = np.where((place >= 0) & (place < 3), *_LEAST_SPREAD)
    return Reference(qpos, 1.0 / np.maximum(qpos.std(axis=0), least) ** 2)
