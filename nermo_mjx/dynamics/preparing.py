"""A model of MJX as the stages take it: with what MJX leaves out, and nothing decided by values it had when it was put;
and a model of MuJoCo made fit to be put.

MJX decides when a model is put which friction losses, gravity compensation and drag count; a field that was zero then
has no effect later, and no derivative. Here a field counts unless it is known to be zero while the program is traced.
"""

from __future__ import annotations

import copy
import warnings
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics.coverage import frictionless, named
from nermo_mjx.dynamics.mjx_copy import make_data, put_model
from nermo_mjx.dynamics.mjx_import import Model, collision_driver, mjx
from nermo_mjx.shapes import Array

_MJX_JOINT_TRANSMISSIONS = (mjx.TrnType.JOINT, mjx.TrnType.JOINTINPARENT)
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
        raise ValueError(
            model.not_simulated[0]
            + (f" There are {others} more, see not_simulated." if others else "")
        )
    if model.approximated:
        others = len(model.approximated) - 1
        warnings.warn(
            model.approximated[0]
            + (f" There are {others} more, see approximated." if others else ""),
            stacklevel=4,
        )
    changes = _of_actuators(model) | _flags(model)
    if not model.nmat and np.any(model.sensor_type == mjx.SensorType.RANGEFINDER):
        changes["mat_rgba"] = jnp.ones(
            (1, 4)
        )  # MJX's ray reads one even where no geom has a material
    model = model.tree_replace(changes) if changes else model
    disabled = model.opt.disableflags & (mjx.DisableBit.SPRING | mjx.DisableBit.DAMPER)
    if disabled in (
        mjx.DisableBit.SPRING,
        mjx.DisableBit.DAMPER,
    ):  # MJX drops all passive forces with either
        names = _SPRINGS if disabled == mjx.DisableBit.SPRING else _DAMPERS
        without: dict[str, Any] = {name: jnp.zeros_like(getattr(model, name)) for name in names}
        model = model.tree_replace(
            without | {"opt.disableflags": model.opt.disableflags & ~disabled}
        )
    return model


def _of_actuators(model: Model) -> dict[str, Any]:
    """Armature and damping of joints and tendons with those of their actuators, times the squares of the gears."""
    kinds, joint_of = np.asarray(model.actuator_trntype), np.asarray(model.dof_jntid)
    target = np.asarray(model.actuator_trnid)[:, 0]
    joints = (target == np.arange(model.njnt)[:, None]) & np.isin(kinds, _MJX_JOINT_TRANSMISSIONS)
    tendons = (target == np.arange(model.ntendon)[:, None]) & (kinds == mjx.TrnType.TENDON)
    changes = {}
    for name, extra_inertia in (
        ("armature", model.actuator_armature),
        ("damping", model.actuator_damping),
        ("dampingpoly", model.actuator_dampingpoly),
    ):
        if not is_zero(extra_inertia):
            scaled = (model.actuator_gear[:, 0] ** 2 * extra_inertia.T).T
            for owner_field, owners in (
                (f"dof_{name}", joints[joint_of]),
                (f"tendon_{name}", tendons),
            ):
                if owners.any():
                    changes[owner_field] = (
                        getattr(model, owner_field) + owners.astype(scaled.dtype) @ scaled
                    )
    return changes


def _flags(model: Model) -> dict[str, Any]:
    """MJX's static flags that are off where a field may have an effect, switched on."""
    changes: dict[str, Any] = {}
    for kind in ("dof", "tendon"):
        loss, name = getattr(model, f"{kind}_frictionloss"), f"{kind}_hasfrictionloss"
        if isinstance(loss, jax.core.Tracer):
            changes[f"_impl.{name}"] = np.ones(loss.shape, bool)
        elif np.any((np.asarray(loss) != 0) & ~getattr(model._impl, name)):
            changes[f"_impl.{name}"] = (np.asarray(loss) != 0) | getattr(model._impl, name)
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


# ---
# A model that MJX can put, by changes that cost little, each of which is named.


_CAPSULE, _ELLIPSOID, _CYLINDER, _MESH, _HFIELD = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}")
    for name in ("CAPSULE", "ELLIPSOID", "CYLINDER", "MESH", "HFIELD")
)
#: Flags that MJX refuses and that do not change a model's motion.
_DIAGNOSTIC_FLAGS: Final = {
    "energy": mujoco.mjtEnableBit.mjENBL_ENERGY,
    "fwdinv": mujoco.mjtEnableBit.mjENBL_FWDINV,
}


def fitted(model: mujoco.MjModel) -> tuple[mujoco.MjModel, list[str]]:
    """A copy of a model that MJX can put, and a sentence for each change; the list is empty if nothing had to change.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="box" size="1 1 .1"/>
    ... <body name="can" pos="0 0 .3"><freejoint/><geom name="wall" type="cylinder" size=".1 .2"/></body></worldbody>
    ... </mujoco>''')
    >>> fitted(model)[1]
    ["geom 'wall' is a capsule, no cylinder: MJX cannot collide it with geom 0."]

    Masses, inertias and sizes of bodies do not change. A capsule is as long as the cylinder, or as the longest axis of
    the ellipsoid, whose other two it has as their geometric mean; its ends are round.

    Args:
        model: compiled by MuJoCo; it is not changed.

    Raises:
        ValueError: MJX refuses the model still; the sentence says what it refuses.
    """
    ours, changes = copy.copy(model), []
    if ours.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        ours.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        changes.append("solver is Newton, no PGS.")
    for name, flag in _DIAGNOSTIC_FLAGS.items():
        if ours.opt.enableflags & int(flag):
            ours.opt.enableflags &= ~int(flag)
            changes.append(f"flag {name} is disabled.")
    if ours.opt.noslip_iterations:
        changes.append(
            f"noslip_iterations is 0, no {ours.opt.noslip_iterations}: contacts may creep."
        )
        ours.opt.noslip_iterations = 0
    changes += _shapes(ours) + _margins(ours)
    for kind, index in frictionless(ours):
        (ours.pair_dim if kind == "pair" else ours.geom_condim)[index] = 3
        getattr(ours, f"{kind}_friction")[index] = mujoco.mjMINMU
        changes.append(
            f"{named(ours, kind, index)} has condim 3 and next to no friction, no condim 1."
        )
    try:
        make_data(put_model(ours))
    except NotImplementedError as error:
        raise ValueError(
            f"MJX refuses the model also after {len(changes)} changes: {error}"
        ) from None
    return ours, changes


def _pairs(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Geoms that may collide, and the number of their explicit pair or -1."""
    pairs: Any = collision_driver.geom_pairs(model)
    return [(int(first), int(second), int(pair)) for first, second, pair in pairs]


def _shapes(model: mujoco.MjModel) -> list[str]:
    """Cylinders and ellipsoids become capsules where they meet what MJX cannot collide them with."""
    changes = []
    for pair in _pairs(model):
        for geom, other_geom in (pair[:2], pair[1::-1]):
            kinds = [mujoco.mjtGeom(kind) for kind in sorted(model.geom_type[[geom, other_geom]])]
            kind = mujoco.mjtGeom(model.geom_type[geom])
            if kind in (_CYLINDER, _ELLIPSOID) and not collision_driver.has_collision_fn(*kinds):
                was = kind.name.removeprefix("mjGEOM_").lower()
                changes.append(
                    f"{named(model, 'geom', geom)} is a capsule, no {was}: MJX cannot collide it with "
                    f"{named(model, 'geom', other_geom)}."
                )
                _become_capsule(model, geom)
    return changes


def _become_capsule(model: mujoco.MjModel, geom: int) -> None:
    size: Float[np.ndarray, " 3"] = model.geom_size[geom].copy()
    if model.geom_type[geom] == _CYLINDER:
        radius, half = size[:2]
    else:
        along = int(np.argmax(size))
        half, radius = size[along], np.sqrt(np.prod(np.delete(size, along)))
        if along < 2:  # a capsule lies along z
            axis = np.zeros(3)
            axis[1 - along] = np.pi / 2 if along == 0 else -np.pi / 2
            quat = model.geom_quat[geom].copy()
            mujoco.mju_quatIntegrate(quat, axis, 1.0)
            model.geom_quat[geom], model.geom_sameframe[geom] = quat, 0
    half = max(half - radius, 1e-6 * radius)
    model.geom_type[geom], model.geom_size[geom] = _CAPSULE, (radius, half, 0.0)
    model.geom_rbound[geom] = radius + half
    model.geom_aabb[geom] = (0.0, 0.0, 0.0, radius, radius, radius + half)


def _margins(model: mujoco.MjModel) -> list[str]:
    """Margins become 0 where a mesh or a height field meets something."""
    changes, zeroed = [], set()
    for first, second, pair in _pairs(model):
        if not np.isin(model.geom_type[[first, second]], (_MESH, _HFIELD)).any():
            continue
        if pair >= 0 and model.pair_margin[pair]:
            changes.append(
                f"margin of {named(model, 'pair', pair)} is 0, no {model.pair_margin[pair]:g}."
            )
            model.pair_margin[pair] = 0.0
        for geom in () if pair >= 0 else (first, second):
            if model.geom_margin[geom] and geom not in zeroed:
                zeroed.add(geom)
                changes.append(
                    f"margin of {named(model, 'geom', geom)} is 0, no {model.geom_margin[geom]:g}."
                )
                model.geom_margin[geom] = 0.0
    return changes
