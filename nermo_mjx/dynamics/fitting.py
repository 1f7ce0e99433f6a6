"""A model made fit for MJX, by changes that cost little, each of which is named."""

from __future__ import annotations

import copy
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.dynamics.coverage import named
from nermo_mjx.dynamics.mjx_import import mjx

_CAPSULE, _ELLIPSOID, _CYLINDER, _MESH, _HFIELD = (
    getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("CAPSULE", "ELLIPSOID", "CYLINDER", "MESH", "HFIELD")
)
#: Flags that MJX refuses and that do not change a model's motion.
_SILENT: Final = {"energy": mujoco.mjtEnableBit.mjENBL_ENERGY, "fwdinv": mujoco.mjtEnableBit.mjENBL_FWDINV}


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
    for name, flag in _SILENT.items():
        if ours.opt.enableflags & int(flag):
            ours.opt.enableflags &= ~int(flag)
            changes.append(f"flag {name} is disabled.")
    if ours.opt.noslip_iterations:
        changes.append(f"noslip_iterations is 0, no {ours.opt.noslip_iterations}: contacts may creep.")
        ours.opt.noslip_iterations = 0
    changes += _shapes(ours) + _margins(ours)
    try:
        mjx.make_data(mjx.put_model(ours))
    except NotImplementedError as error:
        raise ValueError(f"MJX refuses the model also after {len(changes)} changes: {error}") from None
    return ours, changes


def _pairs(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Geoms that may collide, and the number of their explicit pair or -1."""
    from mujoco.mjx._src import collision_driver

    found: Any = collision_driver.geom_pairs(model)
    return [(int(first), int(second), int(pair)) for first, second, pair in found]


def _shapes(model: mujoco.MjModel) -> list[str]:
    """Cylinders and ellipsoids become capsules where they meet what MJX cannot collide them with."""
    from mujoco.mjx._src import collision_driver

    changes = []
    for pair in _pairs(model):
        for geom, other in (pair[:2], pair[1::-1]):
            kinds = [mujoco.mjtGeom(kind) for kind in sorted(model.geom_type[[geom, other]])]
            kind = mujoco.mjtGeom(model.geom_type[geom])
            if kind in (_CYLINDER, _ELLIPSOID) and not collision_driver.has_collision_fn(*kinds):
                was = kind.name.removeprefix("mjGEOM_").lower()
                changes.append(
                    f"{named(model, 'geom', geom)} is a capsule, no {was}: MJX cannot collide it with "
                    f"{named(model, 'geom', other)}."
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
            changes.append(f"margin of {named(model, 'pair', pair)} is 0, no {model.pair_margin[pair]:g}.")
            model.pair_margin[pair] = 0.0
        for geom in () if pair >= 0 else (first, second):
            if model.geom_margin[geom] and geom not in zeroed:
                zeroed.add(geom)
                changes.append(f"margin of {named(model, 'geom', geom)} is 0, no {model.geom_margin[geom]:g}.")
                model.geom_margin[geom] = 0.0
    return changes
