"""The spine's controller: auxiliary modes, their fusion with steering, and offset compensation.

Positive spine servo and joint angles turn left (`robot/parameters.py`). (5.33)'s stride extension is therefore
+A cos(2 pi phase + psi) here, with the published stance offsets, with no further change of sign.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control import turning
from nermo_mjx.control.parameters import SPINE_HARMONICS, ControlParameters, Spine
from nermo_mjx.control.trajectory import signed_power
from nermo_mjx.kinematics.body import balance_angle, hip_height_offset
from nermo_mjx.kinematics.spine import joint_angle, servo_angle
from nermo_mjx.robot.assembly import RobotConfig
from nermo_mjx.robot.geometry import Geometry, geometry_of
from nermo_mjx.robot.masses import MassModel
from nermo_mjx.robot.parameters import SPINE_GEOMETRY
from nermo_mjx.robot.quantity import ParameterError, choice, of_type
from nermo_mjx.robot.robot import mass_model_of
from nermo_mjx.shapes import Array, Planar, Scalar, Scalars

#: Auxiliary modes of the lateral servo; several may be active, and their sum is clipped.
LATERAL_MODES: Final = ("stride_extension", "balance", "harmonics")
#: Those of Nermo 4.1's vertical servo (`sagittal`).
SAGITTAL_MODES: Final = ("sagittal_extension", "pitch_balance")
AUXILIARY_MODES: Final = LATERAL_MODES + SAGITTAL_MODES
NO_MODE: Final = "none"
#: Every choice of modes, by its name.
SPINES: Final = (
    NO_MODE,
    *(
        "+".join(combination)
        for n in range(1, 6)
        for combination in itertools.combinations(AUXILIARY_MODES, n)
    ),
)

#: Share left by steering below which the power law is linear (see `signed_power`).
_LINEAR_FADE_SHARE = 1e-3


#: Spine control: from the controller's parameters, the gait's phase, the turn rate in [-1, 1], the wanted feet (y, z)
#: in their legs' frames [m] and the planned contact to the servo's angle, positive left [rad]. Values are unbatched.
SpineLike = Callable[[Any, Scalar, Scalar, Float[Array, "4 2"], Bool[Array, " 4"]], Scalar]


@dataclasses.dataclass(frozen=True)
class SpineModes:
    """The published spine: steering fused with the sum of the auxiliary modes.

    Attributes:
        modes: "none", "stride_extension", "balance", "harmonics", or several joined by "+" (or a tuple of names);
            converted to a tuple of `LATERAL_MODES`.
        masses: two-mass model of the assembled robot, for the mode "balance". Stored as plain numbers.
        robot: that the model belongs to, to compute it for other geometries; by default it is the same for all.

    Raises:
        ParameterError: an unknown mode, or the mode "balance" without masses.
    """

    modes: str | tuple[str, ...] = ()
    masses: MassModel | None = None
    robot: RobotConfig | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "modes", mode_names(self.modes, LATERAL_MODES))
        if "balance" in self.modes and self.masses is None:
            raise ParameterError(
                f"masses is None: the spine mode {'+'.join(self.modes)!r} needs the robot's mass model."
            )
        if self.masses is not None:  # as plain numbers: hashable and comparable
            plain = {
                name: np.asarray(value, float).tolist() for name, value in vars(self.masses).items()
            }
            plain = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in plain.items()
            }
            object.__setattr__(self, "masses", MassModel(**plain))

    def __call__(
        self, params: ControlParameters, phase: Array, turn_rate: Array, feet: Array, stance: Array
    ) -> Scalar:
        auxiliary = jnp.zeros_like(phase)
        if "stride_extension" in self.modes:
            auxiliary += stride_extension(params.spine, phase)
        if "balance" in self.modes:
            assert self.masses is not None
            masses, geometry = self.masses, geometry_of(params)
            if self.robot is not None and getattr(params, "geometry", None) is not None:
                masses = mass_model_of(self.robot, geometry)
            masses = jax.tree.map(jnp.asarray, masses, is_leaf=lambda leaf: isinstance(leaf, tuple))
            auxiliary += params.spine.balance_share * balance(
                params.spine, masses, feet, stance, geometry
            )
        if "harmonics" in self.modes:
            auxiliary += harmonics(params.spine, phase)
        return fuse(params.spine, turning.spine_share(params.turning, turn_rate), auxiliary)

    def check(self, params: ControlParameters) -> None:
        """Reject an amplitude that the default limit of the servo's angle would clip.

        A limit below the default one is a choice, such as that of the profile `as_built`: it clips.
        """
        amplitude = np.asarray(params.spine.amplitude, float)
        limit = np.maximum(params.spine.max_servo_angle, SPINE_GEOMETRY.max_servo_angle)
        is_clipped = amplitude > limit * (1.0 + 1e-9)
        if "stride_extension" in self.modes and is_clipped.any():
            value = np.broadcast_to(amplitude, is_clipped.shape)[is_clipped].flat[0]
            allowed = np.broadcast_to(limit, is_clipped.shape)[is_clipped].flat[0]
            raise ParameterError(
                f"spine.amplitude is {value:g}, which spine.max_servo_angle would clip: allowed is at most {allowed:g} "
                "rad, or a larger spine.max_servo_angle."
            )


def mode_names(
    spine: str | tuple[str, ...], modes: tuple[str, ...] = AUXILIARY_MODES
) -> tuple[str, ...]:
    """Names joined by "+", or in a tuple, as a tuple in the order of `modes`.

    Raises:
        ParameterError: an unknown name.
    """
    names = (
        spine.split("+")
        if isinstance(spine, str)
        else of_type("spine", spine, (tuple, list), "names of modes")
    )
    selected_names = {
        choice("spine", of_type("spine", name, str, "names of modes").strip(), (NO_MODE, *modes))
        for name in names
    } - {NO_MODE}
    return tuple(name for name in modes if name in selected_names)


def stride_extension(spine: Spine, phase: Scalars) -> Scalars:
    """Servo angle A cos(2 pi phase + psi) [rad], which compresses the diagonal in swing and extends the other
    (5.33)."""
    return spine.amplitude * jnp.cos(2.0 * jnp.pi * phase + spine.phase)


def harmonics(spine: Spine, phase: Scalars) -> Scalars:
    """Servo angle [rad] of a Fourier series, sum a_k cos(k 2 pi phase) + b_k sin(k 2 pi phase).

    Unlike an amplitude and a phase, the coefficients have a derivative where they are zero.
    """
    turns = 2.0 * jnp.pi * jnp.arange(1.0, SPINE_HARMONICS + 1.0) * jnp.asarray(phase)[..., None]
    waves = jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=-1)
    return jnp.sum(spine.harmonics * waves.reshape(*waves.shape[:-2], -1), axis=-1)


def balance(
    spine: Spine,
    masses: MassModel,
    feet: Float[Array, "4 2"],
    stance: Bool[Array, " 4"],
    geometry: Geometry,
) -> Scalar:
    """Servo angle [rad] that brings the centre of mass over the stability diagonal, or inside the triangle (5.35).

    Zero while all four feet are on the ground, where there is nothing to balance. `masses` is the two-mass model of the
    assembled robot, `feet` are the commanded ones (y, z) in their leg's frame [m], `stance` is their planned contact.
    """
    return servo_angle(balance_angle(masses, feet, stance, geometry, spine.balance_lift), geometry)


def fuse(spine: Spine, steering: Scalars, auxiliary: Scalars) -> Scalars:
    """q_sp = q_max (alpha_tr + (1 - |alpha_tr|)^s f_sp), in [-q_max, q_max] (5.45, 5.46) [rad].

    Erratum: (5.46) is printed without the absolute value, which is needed: otherwise a left turn would amplify the
    other mode. `steering` is alpha_tr in [-1, 1], positive left; f_sp is the servo angle wanted by the auxiliary modes
    [rad] over q_max, clipped to [-1, 1].
    """
    return spine.max_servo_angle * jnp.clip(
        steering + shared_with_steering(spine, steering, auxiliary), -1.0, 1.0
    )


def shared_with_steering(spine: Spine, steering: Scalars, auxiliary: Scalars) -> Scalars:
    """(1 - |alpha_tr|)^s f_sp, the auxiliary modes as reduced by steering, in [-1, 1]; see `fuse`."""
    target = jnp.clip(auxiliary / spine.max_servo_angle, -1.0, 1.0)
    left_over = signed_power(
        1.0 - jnp.abs(steering), jnp.asarray(spine.fusion_exponent), _LINEAR_FADE_SHARE
    )
    return left_over * target


def compensation(
    spine: Spine,
    servo: Scalar,
    geometry: Geometry,
    lifted: Planar | None = None,
    feet: Float[Array, "4 2"] | None = None,
) -> Float[Array, "4 2"]:
    """Shift (y, z) of the four commanded feet that undoes the hips' rise by the bent spine (5.31) [m].

    Zero for the front legs; the rear feet go down by `offset_compensation` of their hip's rise, and with
    `offset_at_feet` of their own, which is what the author's code takes.

    Args:
        servo: lateral servo angle [rad].
        lifted: rise of both rear feet due to the vertical joints of Nermo 4.1 [m].
        feet: (y, z) in their legs' frames [m]; None for what the hips rise.
    """
    theta_v = joint_angle(servo, geometry)
    rise = hip_height_offset(theta_v, geometry)
    if feet is not None:
        rise = rise + spine.offset_at_feet * (hip_height_offset(theta_v, geometry, feet) - rise)
    rise = spine.offset_compensation * (rise if lifted is None else rise + lifted)
    lowered = jnp.concatenate([jnp.zeros_like(rise), -rise], axis=-1)
    return jnp.stack([jnp.zeros_like(lowered), lowered], axis=-1)


# ---
# The vertical servo of Nermo 4.1's spine: flexes and extends the spine with the stride, and levels the torso.
#
# Positive lifts the hip, which extends the spine; negative arches it and brings the rear feet forward. Neither mode is
# published: the thesis describes the joints, and its experiments are those of Nermo-Lite. The stride extension is that
# of (5.33) transferred to the sagittal plane, as mammals use it in bound and gallop: flexed when the hind feet touch
# down, extended when they lift off.


#: Control of the vertical servo: from the controller's parameters, the gait's phase, the turn rate, the torso's pitch
#: by its IMU, positive nose down [rad], and its rate [rad/s] to the servo's angle, positive lifts the hip [rad].
SagittalLike = Callable[[Any, Scalar, Scalar, Scalar, Scalar], Scalar]


@dataclasses.dataclass(frozen=True)
class SagittalModes:
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
        self,
        params: ControlParameters,
        phase: Scalar,
        turn_rate: Scalar,
        pitch: Scalar,
        pitch_rate: Scalar,
    ) -> Scalar:
        extension = jnp.zeros_like(phase)
        if "sagittal_extension" in self.modes:
            extension += sagittal_extension(params.spine, phase)
        if "pitch_balance" in self.modes:
            extension += pitch_balance(params.spine, pitch, pitch_rate)
        steering = turning.spine_share(params.turning, turn_rate)
        return params.spine.max_servo_angle * shared_with_steering(
            params.spine, steering, extension
        )


def sagittal_extension(spine: Spine, phase: Scalars) -> Scalars:
    """Servo angle -A cos(2 pi phase + psi) [rad]: with psi = 0 the spine is most flexed as a cycle begins, then
    extends.

    In `bound` and `gallop` the hind feet touch down at phase 0.
    """
    return -spine.sagittal_amplitude * jnp.cos(2.0 * jnp.pi * phase + spine.sagittal_phase)


def pitch_balance(spine: Spine, pitch: Scalars, pitch_rate: Scalars) -> Scalars:
    """Servo angle [rad] that levels the torso: flexion raises the rump and counteracts a rising nose."""
    return spine.pitch_gain * pitch + spine.pitch_damping * pitch_rate
