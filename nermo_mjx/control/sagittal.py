"""The vertical servo of Nermo 4.1's spine: flexes and extends the spine with the stride, and levels the torso.

Positive lifts the hip, which extends the spine; negative arches it and brings the rear feet forward. Neither mode is
published: the thesis describes the joints, and its experiments are those of Nermo-Lite. The stride extension is that of
(5.33) transferred to the sagittal plane, as mammals use it in bound and gallop: flexed when the hind feet touch down,
extended when they lift off.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import jax.numpy as jnp

from nermo_mjx.control import turning
from nermo_mjx.control.fusion import SAGITTAL_MODES, mode_names, shared_with_steering
from nermo_mjx.control.parameters import ControlParameters, Spine
from nermo_mjx.shapes import Scalar, Scalars


@runtime_checkable
class SagittalLike(Protocol):
    """Controls the vertical servo of the spine. Values are unbatched."""

    def __call__(
        self, params: ControlParameters, phase: Scalar, turn_rate: Scalar, pitch: Scalar, pitch_rate: Scalar
    ) -> Scalar:
        """Commanded servo angle, positive lifts the hip [rad].

        Args:
            params: of the controller.
            phase: of the gait cycle.
            turn_rate: in [-1, 1], positive left.
            pitch: of the torso from its IMU, positive nose down [rad].
            pitch_rate: measured angular velocity about the same axis [rad/s].
        """


@dataclasses.dataclass(frozen=True)
class SagittalModes(SagittalLike):
    """The sum of the chosen modes, reduced by steering as much as the lateral ones (5.46).

    Attributes:
        modes: "sagittal_extension", "pitch_balance", both joined by "+", or a tuple of names; converted to a tuple.

    Raises:
        ParameterError: an unknown mode.
    """

    modes: str | tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "modes", mode_names(self.modes, SAGITTAL_MODES))

    def __call__(
        self, params: ControlParameters, phase: Scalar, turn_rate: Scalar, pitch: Scalar, pitch_rate: Scalar
    ) -> Scalar:
        wanted = jnp.zeros_like(phase)
        if "sagittal_extension" in self.modes:
            wanted += sagittal_extension(params.spine, phase)
        if "pitch_balance" in self.modes:
            wanted += pitch_balance(params.spine, pitch, pitch_rate)
        steering = turning.spine_share(params.turning, turn_rate)
        return params.spine.max_servo_angle * shared_with_steering(params.spine, steering, wanted)


def sagittal_extension(spine: Spine, phase: Scalars) -> Scalars:
    """Servo angle -A cos(2 pi phase + psi) [rad]: with psi = 0 the spine is most flexed as a cycle begins, then
    extends.

    In `bound` and `gallop` the hind feet touch down at phase 0.
    """
    return -spine.sagittal_amplitude * jnp.cos(2.0 * jnp.pi * phase + spine.sagittal_phase)


def pitch_balance(spine: Spine, pitch: Scalars, pitch_rate: Scalars) -> Scalars:
    """Servo angle [rad] that levels the torso: flexion raises the rump and counteracts a rising nose."""
    return spine.pitch_gain * pitch + spine.pitch_damping * pitch_rate
