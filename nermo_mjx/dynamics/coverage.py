"""What MJX leaves out of a MuJoCo model without saying so, and the step does not bring back."""

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
    if model.opt.noslip_iterations > 0:
        yield f"noslip_iterations is {model.opt.noslip_iterations}: set it to 0"
    if np.any(model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER):
        for index in np.flatnonzero(np.isin(model.geom_type, UNSEEN)):
            yield f"{named(model, 'geom', index)} is not seen by rangefinders: allowed are shapes other than "
            "cylinder, hfield, sdf"


def named(model: mujoco.MjModel, kind: str, index: Any) -> str:
    """An element as a sentence names it: its kind, and its name or else its number."""
    name = getattr(model, kind)(int(index)).name
    return f"{kind} {name!r}" if name else f"{kind} {int(index)}"
