"""Elements of a MuJoCo model that MJX and the step of this package omit, or simulate differently, without a warning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

#: Message about a feature -> element types and fields; an element has the feature if its entry is not zero.
FEATURES: Final[dict[str, tuple[tuple[str, str], ...]]] = {
    "has a delay, and MJX keeps no history: set delay to 0": (
        ("actuator", "actuator_delay"),
        ("sensor", "sensor_delay"),
    ),
    "is read at an interval, and MJX keeps no history: remove interval": (
        ("sensor", "sensor_interval"),
    ),
    "has a surface velocity: remove surfacevel": (("geom", "geom_surfacevel"),),
    "is adhesive: set adhesion to 0": (("geom", "geom_adhesion"), ("pair", "pair_adhesion")),
    "has a spring that yields: remove its yield": (
        ("joint", "jnt_springyield"),
        ("tendon", "tendon_springyield"),
    ),
}
#: Fields with the plugin of each element; -1 is none.
PLUGINS: Final = (
    ("body", "body_plugin"),
    ("geom", "geom_plugin"),
    ("actuator", "actuator_plugin"),
    ("sensor", "sensor_plugin"),
)
#: Types of geoms that a rangefinder of MJX does not detect.
INVISIBLE_GEOMS: Final = (
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_HFIELD,
    mujoco.mjtGeom.mjGEOM_SDF,
)
_CONTACT_DIFFERENCE: Final = "their contacts are MJX's, and may be others than MuJoCo C's"
_CONTACT_LOSS: Final = "their contacts are MJX's, up to 1 mm off at a depth of 1 mm, or missing, where MuJoCo C has some"
#: Pair of types of geoms whose contacts differ from MuJoCo C -> message.
APPROXIMATE_PAIRS: Final[dict[tuple[str, ...], str]] = {
    (
        "PLANE",
        "CYLINDER",
    ): "where the axis is along the normal, C turns the contacts with the slightest tilt and has "
    "no derivative; the step's is that of contacts that do not turn",
    **{("HFIELD", kind): _CONTACT_DIFFERENCE for kind in ("SPHERE", "CAPSULE", "BOX", "MESH")},
    **{
        (kind, "MESH"): _CONTACT_DIFFERENCE
        for kind in ("PLANE", "SPHERE", "CAPSULE", "BOX", "MESH")
    },
    **{(kind, "CYLINDER"): _CONTACT_LOSS for kind in ("CAPSULE", "ELLIPSOID", "CYLINDER")},
    **{(kind, "BOX"): _CONTACT_DIFFERENCE for kind in ("CAPSULE", "BOX")},
}
#: Number of random joint positions in which the distances of side sites are computed.
POSE_COUNT: Final = 200
#: Flags of `mjtEnableBit` that MJX accepts and ignores.
IGNORED_FLAGS: Final = {"mjENBL_SLEEP": "sleep", "mjENBL_IPC": "ipc"}
#: Fields with types that MJX supports partly: element type, field, and name of the enumeration.
_KIND_FIELDS: Final = (
    *(("actuator", f"{suffix.lower()}type", suffix) for suffix in ("Bias", "Dyn", "Gain", "Trn")),
    ("eq", "type", "Eq"),
    ("sensor", "type", "Sensor"),
)
_OPTION_FIELDS: Final = ("integrator", "cone", "jacobian", "solver")


def not_simulated(model: mujoco.MjModel) -> list[str]:
    """The elements of a model that `step` and `forward` would omit: a sentence for each element, or an empty list.

    >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body>
    ... </worldbody><actuator><motor name="a" joint="j" delay=".01" nsample="4"/></actuator></mujoco>''')
    >>> not_simulated(model)
    ["actuator 'a' has a delay, and MJX keeps no history: set delay to 0."]

    `step` and `forward` reject such a model with the first sentence; so does `put_model` if it is one of `refused`.

    Args:
        model: Model, compiled by MuJoCo.
    """
    return [f"{what}." for what in (*refused(model), *_missing(model))]


def refused(model: mujoco.MjModel) -> Iterator[str]:
    """The elements that MJX itself rejects, a sentence without full stop for each; `fitted` can change some of them."""
    from mujoco.mjx._src import collision_driver, types

    for index in range(model.nflex):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, index) or index
        yield f"flex {name!r} is soft: MJX has no flexes, remove it"
    of_elements = [(kind, f"{kind}_{field}", enum_name) for kind, field, enum_name in _KIND_FIELDS]
    for kind, field, enum_name in of_elements + [
        ("", name, name.title()) for name in _OPTION_FIELDS
    ]:
        supported, every = getattr(types, f"{enum_name}Type"), getattr(mujoco, f"mjt{enum_name}")
        for index, value in enumerate(
            getattr(model, field) if kind else [getattr(model.opt, field)]
        ):
            if value not in set(supported):
                allowed = ", ".join(member.name.lower() for member in supported)
                subject = (
                    f"{field.partition('_')[2]} of {named(model, kind, index)}" if kind else field
                )
                yield f"{subject} is {_word(every(value))}, which MJX lacks: allowed are {allowed}"
    for flag in mujoco.mjtEnableBit.__members__.values():
        if (
            model.opt.enableflags & int(flag)
            and int(flag) not in set(types.EnableBit)
            and flag.name != "mjNENABLE"
        ):
            yield f"flag {_word(flag)} is enabled, which MJX lacks: disable it"
    fluid = model.opt.density > 0 or model.opt.viscosity > 0 or model.opt.wind.any()
    if fluid and model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        yield "integrator is implicitfast, in a fluid: take Euler or RK4, or set density, viscosity and wind to 0"
    for sensor in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT):
        for object_type in (model.sensor_objtype[sensor], model.sensor_reftype[sensor]):
            if (by := _word(mujoco.mjtObj(object_type))) in ("site", "body", "xbody"):
                yield f"{named(model, 'sensor', sensor)} matches contacts by {by}, which MJX cannot: allowed are geoms"
        if model.sensor_intprm[sensor, 1] == 3:
            yield f"{named(model, 'sensor', sensor)} has the reduction netforce: allowed are none, mindist, maxforce"
    for first, second, pair in collision_driver.geom_pairs(model):
        kinds = [mujoco.mjtGeom(kind) for kind in model.geom_type[[first, second]]]
        margin = model.pair_margin[pair] if pair >= 0 else model.geom_margin[[first, second]].max()
        reason = ""
        if not collision_driver.has_collision_fn(*kinds):
            reason = (
                f"are {' and '.join(map(_word, kinds))}, which MJX cannot collide: exclude them"
            )
        elif margin and {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD} & set(kinds):
            reason = "have a margin, which MJX lacks for meshes and height fields: set it to 0"
        if reason:
            yield f"{named(model, 'geom', first)} and {named(model, 'geom', second)} {reason}, or see fitted"
    for element in frictionless(model):
        yield f"{named(model, *element)} has condim 1 with elliptic cones, which MJX lacks: take condim 3, or see fitted"


def _word(kind: Any) -> str:
    """A member of one of MuJoCo's enumerations, without its prefix."""
    return str(kind.name).partition("_")[2].lower()


def frictionless(model: mujoco.MjModel) -> list[tuple[str, int]]:
    """The geoms, or explicit pairs, that determine contacts of dimension 1 with elliptic cones."""
    from mujoco.mjx._src import collision_driver

    elements: list[tuple[str, int]] = []
    for first, second, pair in collision_driver.geom_pairs(model) if model.opt.cone else ():
        highest = model.geom_priority[[first, second]].max()
        deciding = [
            ("geom", int(geom)) for geom in (first, second) if model.geom_priority[geom] == highest
        ]
        deciding = [("pair", int(pair))] if pair >= 0 else deciding
        if all(
            (model.pair_dim if kind == "pair" else model.geom_condim)[feature] == 1
            for kind, feature in deciding
        ):
            elements += deciding
    return list(dict.fromkeys(elements))


def _missing(model: mujoco.MjModel) -> Iterator[str]:
    for reason, fields in FEATURES.items():
        for kind, field in fields:
            values = getattr(model, field, ())  # MuJoCo 3 has no springs that yield
            for index in np.flatnonzero([np.any(value) for value in values]):
                yield f"{named(model, kind, index)} {reason}"
    for kind, field in PLUGINS:
        for index in np.flatnonzero(getattr(model, field) >= 0):
            yield f"{named(model, kind, index)} is run by a plugin: MJX has none"
    for index in np.flatnonzero((model.actuator_ctrlnum != 1) | (model.actuator_outnum != 1)):
        yield f"{named(model, 'actuator', index)} has several controls or outputs: allowed is one of each"
    disabled = model.opt.disableactuator
    for index in np.flatnonzero(
        [disabled >> group & 1 if 0 <= group < 31 else 0 for group in model.actuator_group]
    ):
        yield f"{named(model, 'actuator', index)} is in a disabled group: remove it, or actuatorgroupdisable"
    if model.opt.density > 0.0 or model.opt.viscosity > 0.0:
        for index in np.flatnonzero(model.geom_fluid[:, 0] > 0.0):
            yield f"{named(model, 'geom', index)} has fluidshape='ellipsoid': allowed is 'none', the box model of drag"
    for bit, name in IGNORED_FLAGS.items():
        if model.opt.enableflags & int(getattr(mujoco.mjtEnableBit, bit, 0)):
            yield f"flag {name} is enabled: disable it"
    for wrap in side_sites(model):
        spread = wrap.most - wrap.least
        if (
            wrap.least <= wrap.radius + spread
            and wrap.most >= wrap.radius - spread
            and spread > 1e-6 * wrap.radius
        ):
            names = (
                named(model, *element)
                for element in (("tendon", wrap.tendon), ("site", wrap.site), ("geom", wrap.geom))
            )
            yield "{} has the side {}, now inside {}, now outside, as joints turn: put it on the same body".format(
                *names
            )
    if model.opt.noslip_iterations > 0:
        yield f"noslip_iterations is {model.opt.noslip_iterations}: set it to 0"
    if np.any(model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER):
        for index in np.flatnonzero(np.isin(model.geom_type, INVISIBLE_GEOMS)):
            note = "allowed are shapes other than cylinder, hfield, sdf"
            yield f"{named(model, 'geom', index)} is not seen by rangefinders: {note}"


def approximated(model: mujoco.MjModel) -> list[str]:
    """The differences of `step` and `forward` to MuJoCo C, about which they warn: a sentence for each, or an empty list.

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
        kinds = tuple(
            mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_")
            for geom in (first, second)
        )
        if kinds in APPROXIMATE_PAIRS:
            met.setdefault(kinds, []).append((first, second))
    messages = []
    for kinds, pairs in met.items():
        geoms = " and ".join(named(model, "geom", geom) for geom in pairs[0])
        remaining_note = f", as are {len(pairs) - 1} more pairs" if len(pairs) > 1 else ""
        messages.append(
            f"{geoms} are {' and '.join(kinds).lower()}{remaining_note}: {APPROXIMATE_PAIRS[kinds]}."
        )
    if mujoco.__version__ >= "4":
        messages += [
            f"{named(model, 'tendon', wrap.tendon)} has a side site: MuJoCo 4 leads it past its geom by another rule "
            "than MuJoCo 3, which MJX and the step follow; compare ten_length."
            for wrap in side_sites(model)
            if wrap.most >= wrap.radius
        ]
    return messages


class SideSite(NamedTuple):
    """A tendon's wrap with a side site.

    Attributes:
        wrap: Index among the wraps of the model.
        tendon, geom, site: Ids of tendon, geom and side site.
        radius: Radius of the geom [m].
        least, most: Smallest and largest distance of the site from the geom's centre, over random positions of the joints [m].
    """

    wrap: int
    tendon: int
    geom: int
    site: int
    radius: float
    least: float
    most: float


def side_sites(model: mujoco.MjModel) -> list[SideSite]:
    """All wraps with a side site. C looks in each step whether it is inside of the geom, MJX only when a model is put,
    at positions that are in the frames of their bodies."""
    kinds = np.isin(model.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    wraps = np.flatnonzero(kinds & (model.wrap_prm >= 0.0))
    geoms, sites = model.wrap_objid[wraps], np.round(model.wrap_prm[wraps]).astype(int)
    moves, data = np.any(model.geom_bodyid[geoms] != model.site_bodyid[sites]), mujoco.MjData(model)
    random, distances = np.random.default_rng(0), []
    for pose in range(POSE_COUNT if moves else 1):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(
            model, data.qpos, random.uniform(-np.pi, np.pi, model.nv) * (pose > 0), 1.0
        )
        mujoco.mj_kinematics(model, data)
        distances.append(np.linalg.norm(data.site_xpos[sites] - data.geom_xpos[geoms], axis=1))
    tendons = np.searchsorted(model.tendon_adr, wraps, side="right") - 1
    columns = (
        tendons,
        geoms,
        sites,
        model.geom_size[geoms, 0],
        np.min(distances, 0),
        np.max(distances, 0),
    )
    return [SideSite(*(cell.item() for cell in row)) for row in zip(wraps, *columns, strict=True)]


def named(model: mujoco.MjModel, kind: str, index: Any) -> str:
    """An element in a sentence: its type, and its name or else its number."""
    name = getattr(model, kind)(int(index)).name
    return f"{kind} {name!r}" if name else f"{kind} {int(index)}"
