"""A part on its test stand, in MuJoCo C without gravity: servos that hold or move, and loads that grow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.experiments import body
from nermo_mjx.experiments.cases import LABELS
from nermo_mjx.experiments.outcome import BODY, Column, Outcome
from nermo_mjx.experiments.settings import Settings, body_count
from nermo_mjx.robot import ModelParameters, ParameterError
from nermo_mjx.robot.flexure import chain_of
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import check_quantities, replace_quantities

#: Parameters of the body, without those of its servos' motors and gears, which these stands do not have.
SETTABLE: Final = body.SETTABLE - {f"servo.{name}" for name in ("supply_voltage", "back_emf", "dead_band", "backlash")}
#: Time in which a stand comes to rest, and in which a motion or a load is slow: inertia and damping hardly matter [s].
REST: Final = 2.0
SLOW: Final = 8.0
#: A servo saturates at this share of its torque limit, which it only approaches.
_SATURATED: Final = 0.999
#: Numbers of hinges whose bend is compared.
HINGES: Final = (1, 2, 4)


class Stand:
    """A stand that is stepped.

    Args:
        spec: of `assemble_leg` or `assemble_spine`.
    """

    def __init__(self, spec: Any) -> None:
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def settle(self, servo: Any) -> Stand:
        """Command the servos, and wait until all is at rest.

        Raises:
            ParameterError: it does not come to rest.
        """
        self.data.ctrl[:] = servo
        for _ in range(self._steps(REST)):
            mujoco.mj_step(self.model, self.data)
        if not np.abs(self.data.qvel).max() < 1e-2:
            raise ParameterError(f"the stand of {self.model.names[:40].split(b'.')[0]!r} does not come to rest.")
        return self.evaluated()

    def evaluated(self) -> Stand:
        """Places of all parts at the present angles."""
        mujoco.mj_forward(self.model, self.data)
        return self

    def site(self, name: str) -> np.ndarray:
        """Where a site is [m]."""
        return np.array(self.data.site(name).xpos)

    def angle(self, joint: str) -> float:
        """Of a joint, the sum over its hinges [rad]."""
        model = self.model
        return float(sum(self.data.qpos[model.jnt_qposadr[i]] for i in range(model.njnt)
                         if chain_of(model.joint(i).name) == joint))  # fmt: skip

    def held(self, site: str, direction: Sequence[float], most: float) -> float:
        """The force along a direction at a site [N], growing slowly, at which a servo reaches its torque limit.

        NaN if none does up to `most` [N].
        """
        model, data, at = self.model, self.data, self.model.site(site).id
        body, steps = int(model.site_bodyid[at]), self._steps(SLOW)
        limit = _SATURATED * model.actuator_forcerange[:, 1]
        for step in range(steps):
            force = most * step / steps * np.asarray(direction)
            arm = data.site_xpos[at] - data.xipos[body]
            data.xfrc_applied[body] = np.concatenate([force, np.cross(arm, force)])
            mujoco.mj_step(model, data)
            if (np.abs(data.actuator_force) > limit).any():
                return float(np.linalg.norm(force))
        return float("nan")

    def work(self, path: Callable[[float], Any]) -> tuple[float, float]:
        """Slow motion along a path of servo angles, from 0 to 1: work that all servos do, and the part of it that is
        not returned to them, the sum where they drive [J]."""
        model, data, done, driving = self.model, self.data, 0.0, 0.0
        steps = self._steps(SLOW)
        for step in range(steps):
            data.ctrl[:] = path((step + 1) / steps)
            mujoco.mj_step(model, data)
            power = data.actuator_force * data.actuator_velocity * model.opt.timestep
            done, driving = done + float(power.sum()), driving + float(np.maximum(power, 0.0).sum())
        self.evaluated()
        return done, driving

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.model.opt.timestep)


def bend(spec: Any, joints: Sequence[str], torque: float) -> float:
    """By how much joints bend together under a moment on each of them [rad], without tendons and servos."""
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    free, loaded = Stand(spec), Stand(spec)
    for i in range(loaded.model.njnt):
        if chain_of(loaded.model.joint(i).name) in joints:
            loaded.data.qfrc_applied[loaded.model.jnt_dofadr[i]] = torque
    zero = np.zeros(loaded.model.nu)
    for stand in (free, loaded):
        stand.settle(zero)
    return sum(loaded.angle(joint) - free.angle(joint) for joint in joints)


def measured(
    name: str,
    settings: Settings,
    about: Mapping[str, Column],
    cases: Sequence[Mapping[str, Any]],
    measure: Callable[..., dict[str, float]],
) -> Outcome:
    """All cases of a stand, once for each profile, with the same values; there are no repeats.

    Args:
        name: of the experiment.
        about: its columns, those of the cases and the measured ones.
        cases: their values.
        measure: of the body's parameters and a case.

    Raises:
        ParameterError: a parameter that the stand does not have, or values with which it does not come to rest.
    """
    bodies, count = settings.bodies or {}, body_count(settings.bodies)
    for parameter in {**settings.values, **bodies}:
        choice("values", parameter, sorted(SETTABLE))
    rows: list[dict[str, Any]] = []
    total = max(count, 1) * len(cases)
    for i in range(max(count, 1)):
        values = {**settings.values} | {parameter: float(of[i]) for parameter, of in bodies.items()}
        parameters = replace_quantities(ModelParameters(), {of: np.asarray(value) for of, value in values.items()})
        check_quantities(parameters)
        numbered = {BODY: i + 1} if count else {}
        for case in cases:
            found = measure(parameters, **case)
            rows += [{"profile": profile, **case, **numbered, "repeat": 0, **found} for profile in settings.profiles]
            if settings.progress:
                settings.progress(len(rows) / len(settings.profiles) / total)
    columns = {column: np.array([row[column] for row in rows]) for column in rows[0]}
    return Outcome(name, columns, {**{each: LABELS[each] for each in ("profile", "repeat", BODY)}, **about}, {})
