"""The model that engines step: the robot's, without purely visual elements and unused markers.

Both engines move every geom and every site in every step. Of this robot's 117 geoms 13 collide or guide a tendon, and
of its 98 sites 46 are on a tendon or read by a sensor; the others matter only for rendering and inspection.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Final

import mujoco

#: Sites that are read by name, though neither a tendon nor a sensor refers to them.
READ: Final = ("spine_end",)

_GEOM_WRAPS = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
_SITE_WRAP = int(mujoco.mjtWrap.mjWRAP_SITE)


def physical_model(spec: mujoco.MjSpec, model: mujoco.MjModel) -> mujoco.MjModel:
    """The compiled model without the meshes, geoms, sites, cameras and lights that affect neither forces nor readings.

    Bodies, joints, actuators, tendons, contact pairs and sensors keep their ids, and trajectories are bit-identical.

    Args:
        spec: of the whole robot; it is not changed.
        model: compiled from it.
    """
    geoms = {model.geom(i).name for i in _geoms(model)}
    sites = {model.site(i).name for i in _sites(model)} | set(READ)
    return reduced_model(spec, geoms, sites)


def reduced_model(spec: mujoco.MjSpec, geoms: Collection[str], sites: Collection[str]) -> mujoco.MjModel:
    """The compiled model of a specification with only these geoms and sites and no visuals; `spec` is not changed."""
    lean = spec.copy()
    for geom in list(lean.geoms):
        if geom.name not in geoms:
            lean.delete(geom)
    for site in list(lean.sites):
        if site.name not in sites:
            lean.delete(site)
    for element in (*lean.cameras, *lean.lights, *lean.meshes):
        lean.delete(element)
    return lean.compile()


def _geoms(model: mujoco.MjModel) -> Iterator[int]:
    """Ids of the geoms that collide, guide a tendon, or are read by a sensor."""
    yield from (*model.pair_geom1.tolist(), *model.pair_geom2.tolist())
    yield from (i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i])
    yield from (int(i) for kind, i in _wraps(model) if kind in _GEOM_WRAPS)
    yield from _sensed(model, mujoco.mjtObj.mjOBJ_GEOM)


def _sites(model: mujoco.MjModel) -> Iterator[int]:
    """Ids of the sites that tendons go through or choose a side by, that actuators pull, or that sensors read."""
    yield from (int(i) for kind, i in _wraps(model) if kind == _SITE_WRAP)
    yield from (
        int(side)
        for (kind, _), side in zip(_wraps(model), model.wrap_prm, strict=True)
        if kind in _GEOM_WRAPS and side >= 0
    )
    yield from (
        int(i)
        for transmission, pair in zip(model.actuator_trntype, model.actuator_trnid, strict=True)
        if int(transmission) == int(mujoco.mjtTrn.mjTRN_SITE)
        for i in pair
        if i >= 0
    )
    yield from _sensed(model, mujoco.mjtObj.mjOBJ_SITE)


def _wraps(model: mujoco.MjModel) -> list[tuple[int, int]]:
    return list(zip(model.wrap_type.tolist(), model.wrap_objid.tolist(), strict=True))


def _sensed(model: mujoco.MjModel, kind: Any) -> Iterator[int]:
    """Ids of the elements of one kind that a sensor reads or uses as its reference."""
    for types, ids in ((model.sensor_objtype, model.sensor_objid), (model.sensor_reftype, model.sensor_refid)):
        yield from (int(i) for each, i in zip(types, ids, strict=True) if int(each) == int(kind) and i >= 0)
