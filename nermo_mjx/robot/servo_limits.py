"""How stiff and how damped a servo may be at a time step, before its discrete dynamics alternate instead of settling.

A servo of inertia I turns by tau = kp (u - q) - kv w. Euler's method is explicit in both, w' = w + h tau / I and
q' = q + h w', so that the eigenvalues z of a step are the roots of

    z^2 - (2 - a - b) z + 1 - a = 0,    a = h kv / I,    b = h^2 kp / I.

They lie in the unit circle if and only if b + 2 a < 4 (Jury's criterion), that is

    h^2 kp + 2 h kv < 4 I.

With kp or kv alone these are 4 I / h^2 and 2 I / h; beyond, the torque jumps from limit to limit in each step. I is at
least the armature, since the inertia matrix is that of the bodies, which is positive, plus it; the joints' damping, in
which Euler's method is implicit, only widens the bound. The standing robot starts to alternate at 1.01 times the bound.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from nermo_mjx.robot.equipment import ARMATURE
from nermo_mjx.robot.quantity import ParameterError

#: Share of the bound that is allowed: closer to it a servo settles, but rings for longer than a control period.
ALLOWED: Final = 0.9
#: Share of it that is allowed for kp: without damping, the rest of the body is enough to make a stiff servo ring.
ALLOWED_STIFFNESS: Final = 0.75


def highest_kp(timestep: float, kv: float) -> float:
    """The highest proportional gain [N m/rad] at a time step [s], with a damping kv [N m s/rad]."""
    inertia = 4.0 * ARMATURE["servo"]
    return min(ALLOWED_STIFFNESS * inertia, ALLOWED * inertia - 2.0 * timestep * kv) / timestep**2


def highest_kv(timestep: float, kp: Any) -> Any:
    """The highest damping [N m s/rad] at a time step [s], with gains kp [N m/rad] of any shape."""
    return (4.0 * ALLOWED * ARMATURE["servo"] - timestep**2 * kp) / (2.0 * timestep)


def check_servo(kp: Any, kv: Any, timestep: float) -> None:
    """Reject servos whose stiffness and damping together are too high for the time step.

    Args:
        kp, kv: gains [N m/rad] and damping [N m s/rad], of any shapes that broadcast.
        timestep: of the physics [s].

    Raises:
        ParameterError: for the largest excess.
    """
    kp, kv = np.broadcast_arrays(np.asarray(kp, float), np.asarray(kv, float))
    excess = kv - highest_kv(timestep, kp) * (1.0 + 1e-6)
    if (excess > 0.0).any():
        worst = np.unravel_index(np.argmax(excess), excess.shape)
        raise ParameterError(
            f"servo.kv is {kv[worst]:g}: allowed is [0, {highest_kv(timestep, float(kp[worst])):g}] N m s/rad beside "
            f"servo.kp {kp[worst]:g} N m/rad at a time step of {timestep:g} s."
        )
