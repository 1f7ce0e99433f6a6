"""What MJX leaves out of a MuJoCo model, or does otherwise, without saying so, and the step does not bring back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np

#: Fields that say which elements have a feature, by what is said of it; an element has it where its entry is not zero.
FEATURES: Final[dict[str, tuple[tuple[str, str], ...]]] = {
    "has a delay, and MJX keeps no history: set delay to "
    "0": (("actuator", "actuator_delay"), ("sensor", "sensor_delay")),
    "is read at an interval, and MJX keeps no history: remove interval": (("sensor", "sensor_interval"),),
    "has a surface velocity: remove surfacevel": (("geom", "geom_surfacevel"),),
    "is adhesive: set adhesion to 0": (("geom", "geom_adhesion"), ("pair", "pair_adhesion")),
    "has a spring that yields: remove its yield": (("joint", "jnt_springyield"), ("tendon", "tendon_springyield")),
}  # fmt: skip
#: Fields with the plugin of each element; -1 is none.
PLUGINS: Final = (
    ("body", "body_plugin"), ("geom", "geom_plugin"), ("actuator", "actuator_plugin"), ("sensor", "sensor_plugin"),
)  # fmt: skip
#: What a rangefinder of MJX cannot see.
UNSEEN: Final = (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
_OTHERS: Final = "their contacts are MJX's, and may be others than MuJoCo C's"
#: What is said of pairs of kinds of geoms that do not collide altogether as in C.
APPROXIMATE: Final[dict[tuple[str, ...], str]] = {
    ("PLANE", "CYLINDER"): "where the axis is along the normal, C turns the contacts with the slightest tilt and has "
    "no derivative; the step's is that of contacts that do not turn",
    **{("HFIELD", kind): _OTHERS for kind in ("SPHERE", "CAPSULE", "BOX", "MESH")},
    **{(kind, "MESH"): _OTHERS for kind in ("PLANE", "SPHERE", "CAPSULE", "BOX", "MESH")},
    **{(kind, "CYLINDER"): _OTHERS for kind in ("CAPSULE", "ELLIPSOID", "CYLINDER")},
    **{(kind, "BOX"): _OTHERS for kind in ("CAPSULE", "BOX")},
}
#: Flags of `mjtEnableBit` that MJX takes and does not act on.
FLAGS: Final = {"mjENBL_SLEEP": "sleep", "mjENBL_IPC": "ipc"}


def not_simulated(model: mujoco.MjModel) -> list[str]:
    """What `step` and `forward` would leave out of a model: a sentence for each element, none if they simulate it all.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body>
    ... </worldbody><actuator><motor name="a" joint="j" delay=".01" nsample="4"/></actuator></mujoco>''')
    >>> not_simulated(model)
    ["actuator 'a' has a delay, and MJX keeps no history: set delay to 0."]

    `step` and `forward` refuse such a model with the first sentence. What `mjx.put_model` refuses by itself is not
    listed; `fitted` changes some of that.

    Args:
        model: compiled by MuJoCo.
    """
    return [f"{what}." for what in _missing(model)]


def _missing(model: mujoco.MjModel) -> Iterator[str]:
    for said, fields in FEATURES.items():
        for kind, field in fields:
            values = getattr(model, field, ())  # MuJoCo 3 has no springs that yield
            for index in np.flatnonzero([np.any(value) for value in values]):
                yield f"{named(model, kind, index)} {said}"
    for kind, field in PLUGINS:
        for index in np.flatnonzero(getattr(model, field) >= 0):
            yield f"{named(model, kind, index)} is run by a plugin: MJX has none"
    for index in np.flatnonzero((model.actuator_ctrlnum != 1) | (model.actuator_outnum != 1)):
        yield f"{named(model, 'actuator', index)} has several controls or outputs: allowed is one of each"
    disabled = model.opt.disableactuator
    for index in np.flatnonzero([disabled >> group & 1 if 0 <= group < 31 else 0 for group in model.actuator_group]):
        yield f"{named(model, 'actuator', index)} is in a disabled group: remove it, or actuatorgroupdisable"
    if model.opt.density > 0.0 or model.opt.viscosity > 0.0:
        for index in np.flatnonzero(model.geom_fluid[:, 0] > 0.0):
            yield f"{named(model, 'geom', index)} has fluidshape='ellipsoid': allowed is 'none', the box model of drag"
    for bit, name in FLAGS.items():
        if model.opt.enableflags & int(getattr(mujoco.mjtEnableBit, bit, 0)):
            yield f"flag {name} is enabled: disable it"
    for tendon, geom, site in _side_sites(model):
        if model.site_bodyid[site] != model.geom_bodyid[geom]:
            names = (named(model, *each) for each in (("tendon", tendon), ("site", site), ("geom", geom)))
            yield "{} has the side {} on another body than {}: put it on the same".format(*names)
    if model.opt.noslip_iterations > 0:
        yield f"noslip_iterations is {model.opt.noslip_iterations}: set it to 0"
    if np.any(model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER):
        for index in np.flatnonzero(np.isin(model.geom_type, UNSEEN)):
            seen = "allowed are shapes other than cylinder, hfield, sdf"
            yield f"{named(model, 'geom', index)} is not seen by rangefinders: {seen}"


def approximated(model: mujoco.MjModel) -> list[str]:
    """What `step` and `forward` do otherwise than MuJoCo C, and warn of: a sentence for each, none if there is nothing.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="box" size="1 1 .1"/>
    ... <body pos="0 0 .3"><freejoint/><geom name="b" type="box" size=".1 .1 .1"/></body></worldbody></mujoco>''')
    >>> approximated(model)
    ["geom 0 and geom 'b' are box and box: their contacts are MJX's, and may be others than MuJoCo C's."]

    Args:
        model: compiled by MuJoCo.
    """
    from mujoco.mjx._src import collision_driver

    met: dict[tuple[str, ...], list[Any]] = {}
    for first, second, _ in collision_driver.geom_pairs(model):
        kinds = tuple(mujoco.mjtGeom(model.geom_type[each]).name.removeprefix("mjGEOM_") for each in (first, second))
        if kinds in APPROXIMATE:
            met.setdefault(kinds, []).append((first, second))
    said = []
    for kinds, pairs in met.items():
        geoms = " and ".join(named(model, "geom", each) for each in pairs[0])
        more = f", as are {len(pairs) - 1} more pairs" if len(pairs) > 1 else ""
        said.append(f"{geoms} are {' and '.join(kinds).lower()}{more}: {APPROXIMATE[kinds]}.")
    if mujoco.__version__ >= "4":
        for tendon, geom, site in _side_sites(model):
            if np.linalg.norm(model.site_pos[site] - model.geom_pos[geom]) >= model.geom_size[geom, 0]:
                said.append(
                    f"{named(model, 'tendon', tendon)} has a side site: MuJoCo 4 leads it past its geom by another "
                    "rule than MuJoCo 3, which MJX and the step follow; compare ten_length."
                )
    return said


def _side_sites(model: mujoco.MjModel) -> Iterator[tuple[int, int, int]]:
    """Tendon, geom and side site of each wrap that has one."""
    wraps = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    for wrap in np.flatnonzero(wraps & (model.wrap_prm >= 0.0)):
        tendon = int(np.searchsorted(model.tendon_adr, wrap, side="right")) - 1
        yield tendon, int(model.wrap_objid[wrap]), round(model.wrap_prm[wrap])


def named(model: mujoco.MjModel, kind: str, index: Any) -> str:
    """An element as a sentence names it: its kind, and its name or else its number."""
    name = getattr(model, kind)(int(index)).name
    return f"{kind} {name!r}" if name else f"{kind} {int(index)}"
