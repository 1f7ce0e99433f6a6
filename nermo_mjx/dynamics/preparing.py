"""A model of MJX as the stages take it: with what MJX leaves out, and nothing decided by values it had when it was put.

MJX decides when a model is put which friction losses, gravity compensation and drag count; a field that was zero then
has no effect later, and no derivative. Here a field counts unless it is known to be zero while the program is traced.
"""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.dynamics.mjx_import import Model, mjx
from nermo_mjx.shapes import Array

_ON_JOINTS = (mjx.TrnType.JOINT, mjx.TrnType.JOINTINPARENT)
_SPRINGS = ("jnt_stiffness", "jnt_stiffnesspoly", "tendon_stiffness", "tendon_stiffnesspoly")
_DAMPERS = ("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly")


def is_zero(array: Array | np.ndarray) -> bool:
    """Whether an array is known to be zero: it is concrete and all zeros."""
    return not isinstance(array, jax.core.Tracer) and not np.any(np.asarray(array))


def prepared(model: Model) -> Model:
    """The model with the springs, dampers and inertias of its actuators, and with static flags that hold for its
    values.

    Raises:
        ValueError: something of the model is not simulated.
    """
    if model.not_simulated:
        others = len(model.not_simulated) - 1
        raise ValueError(model.not_simulated[0] + (f" There are {others} more, see not_simulated." if others else ""))
    if model.approximated:
        others = len(model.approximated) - 1
        warnings.warn(
            model.approximated[0] + (f" There are {others} more, see approximated." if others else ""), stacklevel=4
        )
    changes = _of_actuators(model) | _flags(model)
    if not model.nmat and np.any(model.sensor_type == mjx.SensorType.RANGEFINDER):
        changes["mat_rgba"] = jnp.ones((1, 4))  # MJX's ray reads one even where no geom has a material
    model = model.tree_replace(changes) if changes else model
    disabled = model.opt.disableflags & (mjx.DisableBit.SPRING | mjx.DisableBit.DAMPER)
    if disabled in (mjx.DisableBit.SPRING, mjx.DisableBit.DAMPER):  # MJX drops all passive forces with either
        names = _SPRINGS if disabled == mjx.DisableBit.SPRING else _DAMPERS
        without: dict[str, Any] = {name: jnp.zeros_like(getattr(model, name)) for name in names}
        model = model.tree_replace(without | {"opt.disableflags": model.opt.disableflags & ~disabled})
    return model


def _of_actuators(model: Model) -> dict[str, Any]:
    """Armature and damping of joints and tendons with those of their actuators, times the squares of the gears."""
    kinds, joint_of = np.asarray(model.actuator_trntype), np.asarray(model.dof_jntid)
    target = np.asarray(model.actuator_trnid)[:, 0]
    joints = (target == np.arange(model.njnt)[:, None]) & np.isin(kinds, _ON_JOINTS)
    tendons = (target == np.arange(model.ntendon)[:, None]) & (kinds == mjx.TrnType.TENDON)
    changes = {}
    for name, more in (
        ("armature", model.actuator_armature),
        ("damping", model.actuator_damping),
        ("dampingpoly", model.actuator_dampingpoly),
    ):
        if not is_zero(more):
            scaled = (model.actuator_gear[:, 0] ** 2 * more.T).T
            for of, owners in ((f"dof_{name}", joints[joint_of]), (f"tendon_{name}", tendons)):
                if owners.any():
                    changes[of] = getattr(model, of) + owners.astype(scaled.dtype) @ scaled
    return changes


def _flags(model: Model) -> dict[str, Any]:
    """MJX's static flags that are off where a field may have an effect, switched on."""
    changes: dict[str, Any] = {}
    for kind in ("dof", "tendon"):
        loss, name = getattr(model, f"{kind}_frictionloss"), f"{kind}_hasfrictionloss"
        if isinstance(loss, jax.core.Tracer):
            changes[f"_impl.{name}"] = np.ones(loss.shape, bool)
        elif np.any((np.asarray(loss) != 0) & ~getattr(model._impl, name)):
            changes[f"_impl.{name}"] = np.asarray(loss) != 0
    if isinstance(model.tendon_frictionloss, jax.core.Tracer):
        # MuJoCo C has no row where it is negative, as it has for a joint: at 0 the derivative is the mean of both
        # sides.
        changes["tendon_frictionloss"] = jnp.maximum(model.tendon_frictionloss, 0.0)
    if not (model.flg_gravcomp or is_zero(model.body_gravcomp)):
        changes["flg_gravcomp"] = True
    if not (is_zero(model.opt.density) and is_zero(model.opt.viscosity)):
        if np.any(model.geom_fluid[:, 0] > 0.0):
            raise ValueError(
                "density or viscosity is not known to be 0, and a geom has fluidshape='ellipsoid': "
                "allowed is 'none', the box model of drag."
            )
        if not model.opt._impl.has_fluid_params:
            changes["opt._impl.has_fluid_params"] = True
    return changes
