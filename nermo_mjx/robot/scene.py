"""A scene: a bundled one, by its name, or a custom one, as self-contained MJCF text.

A file or an `MjSpec` is converted to such a text once, when a setup is created. The text can be compared, hashed, sent
to another process, and stored in a spec file or a recording, so that these document the ground the robot walked on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn, TypeAlias

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from nermo_mjx.files import opened, read_bytes
from nermo_mjx.robot.model_parameters import ModelParameters, gravity_values
from nermo_mjx.robot.parts import load_file, scene_files
from nermo_mjx.robot.quantity import ParameterError, check_quantities, nearest, replace_quantities
from nermo_mjx.robot.terrains import TERRAINS, TerrainShape, add_terrain, field_share, geom_names
from nermo_mjx.shapes import Array, Scalars

Scene: TypeAlias = str | os.PathLike[str] | mujoco.MjSpec
#: Default classes of the geoms that carry the robot, and of those that stop it; nested classes count, too.
GROUND: Final = "ground"
OBSTACLE: Final = "obstacle"
#: A geom of this name is ground, whatever its class.
FLOOR_GEOM: Final = "floor"
#: Allowed types of ground: every engine can collide a sphere with them, and `terrain.Terrain` knows their height.
GROUND_TYPES: Final = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_HFIELD,
)
#: The file of `mjcf/scenes/common` into which a terrain is put.
_TERRAIN_FILE: Final = "scenes/common/terrain"
#: Elements that move, act or measure: only the robot may have positions, controls and sensors.
_ROBOT_ELEMENTS: Final = {
    "joints": "a joint",
    "actuators": "an actuator",
    "sensors": "a sensor",
    "tendons": "a tendon",
    "equalities": "an equality",
    "pairs": "a contact pair",
    "keys": "a keyframe",
    "flexes": "a flex",
    "skins": "a skin",
    "plugins": "a plugin",
}
#: Options that would change how the robot walks, and that it does not have.
_FIXED_OPTIONS: Final = ("density", "viscosity", "wind", "disableflags", "enableflags")
#: MuJoCo's first write of a text that it has read differs slightly: a frame's quaternion is written out.
_MAX_READINGS: Final = 4


@dataclasses.dataclass(frozen=True)
class SceneGeoms:
    """Names of the geoms that touch the robot, in the scene's order: those that carry it, and those that stop it."""

    ground: tuple[str, ...]
    obstacles: tuple[str, ...]


def scenes() -> tuple[str, ...]:
    """Names of the scenes that come with the package: files of `mjcf/scenes`, and terrains."""
    return (*scene_files(), *TERRAINS)


def resolve_scene(scene: Scene) -> str:
    """A scene in stored form: the name of a bundled one, or MJCF.

    Args:
        scene: a name; the path of an MJCF file, relative to the working directory; MJCF itself; or an `MjSpec`, which
            is not changed. In a custom scene nothing moves; geoms of the default class `ground`, and the one
            named `floor`, carry the robot, those of the class `obstacle` stop it, and no other touches it. Files that
            it refers to, such as meshes, are not embedded; the text has their absolute paths. Of its options only
            gravity is kept; a warning names those of the solver, which are the robot's.

    Raises:
        ParameterError: the scene or file does not exist; MuJoCo rejects it; it has elements that only the robot may
            have, no ground, a fluid, flags, or numbers that are not finite.
    """
    if isinstance(scene, mujoco.MjSpec):
        return _text(scene.copy(), f"the MjSpec {scene.modelname!r}")
    if scene in scenes():
        return str(scene)
    if isinstance(scene, str) and is_mjcf(scene):
        return _from_text(scene)
    if not isinstance(scene, str | os.PathLike):
        raise ParameterError(
            f"scene is {scene!r}: expected a name, or the path of an MJCF file (.xml)."
        )
    path = Path(scene)
    if not os.path.isfile(path):
        if path.suffix != ".xml":
            names, near = " or ".join(map(repr, scenes())), nearest(str(scene), scenes())
            hint = f"did you mean {near!r}? " if near else ""
            raise ParameterError(
                f"scene is {str(scene)!r}: {hint}allowed is {names} or the path of an MJCF file (.xml)."
            )
        raise ParameterError(f"scene is {str(scene)!r}: there is no such file.")
    return _text(read_mjcf(path), repr(str(scene)))


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """A person's MJCF file.

    Raises:
        ParameterError: it cannot be read, or would make more than fits; MuJoCo refuses it.
    """
    with _refusals(repr(str(path))):
        _check_sizes(
            ElementTree.fromstring(read_bytes(path, _MAX_MJCF_BYTES)), path.parent, repr(str(path))
        )
        return mujoco.MjSpec.from_file(str(path))


def scene_name(scene: str) -> str:
    """Name of a scene from `resolve_scene`: its own, or that of its model."""
    return ElementTree.fromstring(scene).get("model", "own") if is_mjcf(scene) else scene


def load_scene(scene: str) -> mujoco.MjSpec:
    """The editable specification of a scene from `resolve_scene`."""
    if scene in TERRAINS:
        spec = load_file(_TERRAIN_FILE)
        add_terrain(spec, scene)
        spec.modelname = scene
        return spec
    return (
        _dressed(mujoco.MjSpec.from_string(scene))
        if is_mjcf(scene)
        else load_file(f"scenes/{scene}")
    )


def _dressed(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A custom scene with the sky, the lights and the mat of the bundled ones, where it has none of its own."""
    usual = load_file("scenes/common/mat")
    look = ("type", "builtin", "rgb1", "rgb2", "width", "height", "mark", "markrgb")
    sky, mat = usual.textures
    if not any(texture.type == sky.type for texture in spec.textures):
        spec.add_texture(name="nermo_sky", **{name: getattr(sky, name) for name in look})
        spec.visual.rgba.haze = usual.visual.rgba.haze
    if not spec.lights:
        for light in usual.lights:
            light_fields = ("type", "pos", "dir", "diffuse", "specular", "castshadow")
            spec.worldbody.add_light(**{name: getattr(light, name) for name in light_fields})
        for name in ("ambient", "diffuse", "specular"):
            setattr(spec.visual.headlight, name, getattr(usual.visual.headlight, name))
    bare = [
        geom
        for geom in spec.geoms
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE
        and not geom.material
        and np.array_equal(geom.rgba, mujoco.MjSpec().default.geom.rgba)
    ]
    if bare:
        spec.add_texture(name="nermo_mat", **{name: getattr(mat, name) for name in look})
        material, source = spec.add_material(name="nermo_mat"), usual.materials[0]
        material.textures = ["" if not name else "nermo_mat" for name in source.textures]
        for name in ("texrepeat", "texuniform", "specular", "reflectance"):
            setattr(material, name, getattr(source, name))
        for geom in bare:
            geom.material = "nermo_mat"
    return spec


@functools.lru_cache(maxsize=64)
def scene_geoms(scene: str) -> SceneGeoms:
    """The geoms that touch the robot, of a scene from `resolve_scene`."""
    spec = load_scene(scene)
    ground, obstacles = ([geom.name for geom in _geoms(spec, role)] for role in (GROUND, OBSTACLE))
    return SceneGeoms(tuple(ground), tuple(obstacles))


def is_mjcf(text: str) -> bool:
    return text.lstrip().startswith("<")


def _geoms(spec: mujoco.MjSpec, role: str) -> list[Any]:
    """Geoms of a default class, or of a class nested in it."""
    tree = ElementTree.fromstring(spec.to_xml())
    classes = {
        default.get("class") for default in tree.findall(f".//default[@class='{role}']//default")
    } | {role}
    return [
        geom
        for geom in spec.geoms
        if geom.classname.name in classes or (role == GROUND and geom.name == FLOOR_GEOM)
    ]


@contextlib.contextmanager
def _refusals(called: str) -> Iterator[None]:
    """Turn MuJoCo's message of several lines into one sentence about the scene."""
    try:
        yield
    except OSError as error:
        raise ParameterError(
            f"scene is {called}: {error.filename} cannot be read ({error.strerror})."
        ) from None
    except (ValueError, ElementTree.ParseError) as error:
        if isinstance(error, ParameterError):
            raise
        message = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise ParameterError(
            f"scene is {called}: MuJoCo refuses it: {message.rstrip('.')}."
        ) from None


#: What MuJoCo may make of a scene: elements, and bytes of its textures, height fields and numbers.
_MAX_ELEMENTS: Final = 100_000
_MAX_MODEL_BYTES: Final = 1 << 27
#: Bytes of an MJCF file.
_MAX_MJCF_BYTES: Final = 1 << 24
#: Elements of which MuJoCo makes many that only the robot may have.
_GENERATOR_ELEMENTS: Final = ("composite", "flexcomp")


def _check_sizes(root: ElementTree.Element, home: Path, called: str) -> None:
    """Refuse MJCF of which MuJoCo would make more than fits: it allocates whatever a few numbers ask for.

    Raises:
        ParameterError: names the element, what it asks for, and what is allowed; for the others see `_refusals`.
    """
    elements = size = 0.0
    waiting, included = [(root, home, 1.0)], set[Path]()
    while waiting:
        element, home, copies = waiting.pop()
        attributes = element.attrib
        if element.tag in _GENERATOR_ELEMENTS:
            raise ParameterError(
                f"scene is {called}: it has a {element.tag}: only the robot may move."
            )
        if element.tag == "replicate":
            copies *= max(_number(attributes, "count"), 1.0)
        elif element.tag in ("include", "model") and "file" in attributes:
            path = home / attributes["file"]
            if (
                element.tag == "model" or path.resolve() not in included
            ):  # MuJoCo includes no file twice
                content = read_bytes(path, _MAX_MJCF_BYTES)
                size += len(content)
                # As MuJoCo does: a model's files are named from its own folder, those of an included file from here.
                inside = path.parent if element.tag == "model" else home
                waiting.append((ElementTree.fromstring(content), inside, copies))
            included.add(path.resolve())
        elif element.tag == "size":
            size += (
                8
                * _MAX_ELEMENTS
                * sum(_number(attributes, name) for name in attributes if name.startswith("nuser_"))
            )
            size += 8 * (_number(attributes, "nkey") + _number(attributes, "nuserdata"))
        elif element.tag == "texture":
            faces = 1 if attributes.get("type") == "2d" else 6
            size += (
                3
                * faces
                * _number(attributes, "width")
                * (_number(attributes, "height") or _number(attributes, "width"))
            )
        elif element.tag == "hfield":
            size += 4 * _number(attributes, "nrow") * _number(attributes, "ncol")
        elif element.tag == "numeric":
            size += 8 * _number(attributes, "size")
        elements += copies
        for count, limit, kind in (
            (elements, _MAX_ELEMENTS, "elements"),
            (size, _MAX_MODEL_BYTES, "bytes"),
        ):
            if not count <= limit:
                raise ParameterError(
                    f"scene is {called}: with its {element.tag} it asks for {count:,.0f} {kind}: allowed are {limit:,}."
                )
        waiting += [(child, home, copies) for child in element]


def _number(attributes: Mapping[str, str], name: str) -> float:
    """An attribute's number; 0 if there is none, or it is none, which MuJoCo refuses."""
    try:
        return max(float(attributes.get(name, "0").split()[0]), 0.0)
    except (ValueError, IndexError):
        return 0.0


@functools.lru_cache(maxsize=64)
def _from_text(text: str) -> str:
    with _refusals("MJCF"):
        _check_sizes(ElementTree.fromstring(text), Path(), "MJCF")
        spec = mujoco.MjSpec.from_string(text)
    return _text(spec, "MJCF")


def _text(spec: mujoco.MjSpec, called: str) -> str:
    """MJCF of a checked and prepared scene, which does not change when it is read and prepared again."""
    text = _prepared(spec, called)
    for _ in range(_MAX_READINGS):
        original, text = text, _prepared(mujoco.MjSpec.from_string(text), called)
        if text == original:
            break
    return text


def _prepared(spec: mujoco.MjSpec, called: str) -> str:
    """MJCF of a scene, checked, with all geoms named and fixed to the world, and absolute paths of files."""

    def refuse(why: str) -> NoReturn:
        raise ParameterError(f"scene is {called}: it {why}.")

    for kind, description in _ROBOT_ELEMENTS.items():
        for element in getattr(spec, kind):
            refuse(
                f"has {description}{f' {element.name!r}' if element.name else ''}, and only the robot may"
            )
    for body in spec.bodies[1:]:
        if body.mocap:
            refuse(f"has a body {body.name!r} that moves (mocap), and only the robot may")
    _find_files(spec)
    with _refusals(called):
        _check_files(spec, called)
        ground = _geoms(spec, GROUND)
    if not ground:
        refuse(
            f"has no ground: give what the robot stands on the default class {GROUND!r}, or the name {FLOOR_GEOM!r}"
        )
    _check_options(spec, called)
    spec.compiler.discardvisual = False
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for role in (GROUND, OBSTACLE):
        geom_names = {geom.name for geom in spec.geoms}
        free = (name for i in range(len(spec.geoms)) if (name := f"{role}_{i}") not in geom_names)
        for geom in _geoms(spec, role):
            geom.name = geom.name or next(free)
    for geom in ground:
        if geom.type not in GROUND_TYPES:
            kind = geom.type.name.removeprefix("mjGEOM_").lower()
            refuse(
                f"has the ground {geom.name!r}, a {kind}; allowed is a plane, a box, a capsule or an hfield"
            )
    # Static bodies are merged into the world, so that the only bodies are the robot's.
    spec.compiler.fusestatic = True
    with _refusals(called):
        model = spec.compile()
    if model.nbody > 1:
        refuse(f"has a body {model.body(1).name!r} that a camera or light aims at; aim it at none")
    for element in (*spec.bodies[1:], *spec.sites, *spec.frames):  # the robot has names like theirs
        element.name = ""
    for name in ("geom_pos", "geom_quat", "geom_size", "hfield_size", "hfield_data"):
        if not np.isfinite(getattr(model, name)).all():
            refuse(f"has numbers that are not finite, in {name}")
    try:
        check_quantities(replace_quantities(ModelParameters(), gravity_values(model.opt.gravity)))
    except ParameterError as error:
        refuse(f"has a gravity with which {str(error).removesuffix('.')}")
    return _own_settings_only(spec.to_xml())


def _check_options(spec: mujoco.MjSpec, called: str) -> None:
    """Refuse options that would change how the robot walks, and warn of the solver's, which are not taken."""
    default = mujoco.MjSpec().option
    options = {
        name: getattr(spec.option, name)
        for name in dir(default)
        if not name.startswith("_") and name != "gravity"
    }
    options = {
        name: value
        for name, value in options.items()
        if not np.array_equal(value, getattr(default, name))
    }
    if wrong := [name for name in options if name in _FIXED_OPTIONS]:
        subject = "flags" if wrong[0].endswith("flags") else f"{wrong[0]} {options[wrong[0]]}"
        raise ParameterError(
            f"scene is {called}: its option has {subject}, without which the robot would walk: of a scene's options only "
            "gravity is taken; leave it out."
        )
    if options:
        listing = ", ".join(f"{name} {value}" for name, value in options.items())
        warnings.warn(
            f"scene is {called}: its option has {listing}, which is not taken: the solver is the robot's, whose physics, "
            "timestep and cone the setup names.",
            stacklevel=4,
        )


def _own_settings_only(text: str) -> str:
    """The scene without settings that would affect the robot, which has its own options and compiler settings."""
    tree = ElementTree.fromstring(text)
    for name, allowed in (("option", "gravity"), ("compiler", "angle"), ("size", "")):
        for element in tree.findall(name):
            element.attrib = {key: value for key, value in element.attrib.items() if key == allowed}
            element[:] = []
    return ElementTree.tostring(tree, encoding="unicode")


def _find_files(spec: mujoco.MjSpec) -> None:
    """Make the paths of the files that a scene refers to absolute."""
    home = Path(spec.modelfiledir or ".")

    def found(folder: str, file: str) -> str:
        return str((home / folder / file).resolve()) if file else ""

    for element in (*spec.meshes, *spec.hfields):
        element.file = found(spec.meshdir, element.file)
    for texture in spec.textures:
        texture.file = found(spec.texturedir, texture.file)
        texture.cubefiles = [found(spec.texturedir, file) for file in texture.cubefiles]
    spec.meshdir = spec.texturedir = ""


def _check_files(spec: mujoco.MjSpec, called: str) -> None:
    """Refuse files of which MuJoCo would make more than fits: large ones, and PNG files with many pixels."""
    file_names = (
        *(asset.file for asset in (*spec.meshes, *spec.hfields, *spec.textures)),
        *(file for asset in spec.textures for file in asset.cubefiles),
    )
    for path in map(Path, filter(None, file_names)):
        with opened(path) as file:
            size, head = os.fstat(file.fileno()).st_size, file.read(24)
        if head.startswith(b"\x89PNG"):
            size = 4 * int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big")
        if size > _MAX_MODEL_BYTES:
            raise ParameterError(
                f"scene is {called}: {path} takes {size:,} bytes: allowed are {_MAX_MODEL_BYTES:,}."
            )


# ---
# Height of the ground at a point: planes, boxes, capsules and height fields, fixed or of a terrain's shape.


#: Cosine of the steepest plane that counts as ground.
_STEEPEST_COSINE: Final = 0.1
_PARALLEL_TOLERANCE: Final = 1e-9


class Terrain:
    """Height of the ground above z = 0 of the world; pure JAX, differentiable."""

    def __init__(self, model: mujoco.MjModel, geoms: Sequence[int], scene: str = "") -> None:
        """
        Args:
            model: compiled.
            geoms: ids of the ground's geoms, fixed to the world: planes, boxes, capsules and height fields.
            scene: name of the scene; one of `TERRAINS` has a shape.

        Raises:
            ParameterError: a plane that is too steep, or a height field that is not level.
        """
        kind = TERRAINS.get(scene)
        self._kind = None if kind is None or kind.obstacle else kind
        shaped = set(geom_names(scene))
        self._still = [
            _surface(model, geom) for geom in geoms if model.geom(geom).name not in shaped
        ]
        self._shaped = [_surface(model, geom) for geom in geoms if model.geom(geom).name in shaped]
        #: Height where there is no ground: there a robot falls, and has fallen once it is lower.
        self._bottom = min(surface.bottom for surface in (*self._still, *self._shaped))

    @property
    def has_shape(self) -> bool:
        """Whether its shape depends on parameters."""
        return self._kind is not None

    def height(self, x: ArrayLike, y: ArrayLike, shape: TerrainShape | None = None) -> Scalars:
        """Height [m] of the highest ground at (x, y) [m], which broadcast; where there is none, that of its lowest
        point.

        Args:
            shape: of a terrain, instead of the compiled one; ignored in scenes without parameters.
        """
        x, y = jnp.asarray(x), jnp.asarray(y)
        heights = [surface.height(x, y) for surface in self._still]
        if self._kind is None or shape is None:
            heights += [surface.height(x, y) for surface in self._shaped]
        else:
            heights.append(self._shaped_height(x, y, shape))
        highest = heights[0]
        for height in heights[1:]:
            highest = jnp.maximum(highest, height)
        return jnp.where(jnp.isneginf(highest), self._bottom, highest)

    def _shaped_height(self, x: Array, y: Array, shape: TerrainShape) -> Array:
        assert self._kind is not None
        pos, quat, size = (jnp.asarray(value, float) for value in self._kind.layout(shape, jnp))
        if self._kind.geom == mujoco.mjtGeom.mjGEOM_HFIELD:
            return self._shaped[0].height(x, y, shape.height, pos[0])
        surface = _box_height if self._kind.geom == mujoco.mjtGeom.mjGEOM_BOX else _capsule_height
        # All elements at once, along the last axis.
        rotation = _rotation(quat)
        return jnp.max(
            surface(x[..., None] - pos[:, 0], y[..., None] - pos[:, 1], rotation, size) + pos[:, 2],
            axis=-1,
        )


def _rotation(quat: Array) -> Array:
    """Rotation matrices (k, 3, 3) of quaternions (k, 4)."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _box_height(dx: Array, dy: Array, rotation: Array, size: Array) -> Array:
    """Height above a box's centre at which a vertical line enters it, by its three pairs of faces; or -inf.

    Args:
        dx, dy: offset of the line from the centre, (...) [m].
        rotation, size: (..., 3, 3) and half lengths (..., 3) [m].
    """
    top, base = jnp.full((), jnp.inf), jnp.full((), -jnp.inf)
    for i in range(3):
        # Points of the line are (dx, dy, h); their coordinate along the axis is offset + slope h.
        offset = rotation[..., 0, i] * dx + rotation[..., 1, i] * dy
        slope = rotation[..., 2, i]
        half = size[..., i]
        flat = jnp.abs(slope) < _PARALLEL_TOLERANCE
        safe, side = jnp.where(flat, 1.0, slope), jnp.where(slope < 0.0, -half, half)
        clearance = jnp.where(jnp.abs(offset) <= half, jnp.inf, -jnp.inf)
        top = jnp.minimum(top, jnp.where(flat, clearance, (side - offset) / safe))
        base = jnp.maximum(base, jnp.where(flat, -jnp.inf, (-side - offset) / safe))
    return jnp.where(top >= base, top, -jnp.inf)


def _capsule_height(dx: Array, dy: Array, rotation: Array, size: Array) -> Array:
    """The same for a capsule: the cylinder between its ends, and the spheres there."""
    ax, ay, az = (rotation[..., i, 2] for i in range(3))
    radius, half = size[..., 0], size[..., 1]
    along = dx * ax + dy * ay
    # Distance from the axis: |d|^2 - (d a)^2 <= r^2, with d = (dx, dy, h).
    a, c = 1.0 - az * az, dx * dx + dy * dy - along * along - radius * radius
    steep = a < _PARALLEL_TOLERANCE
    under = (along * az) ** 2 - a * c
    h = (along * az + jnp.sqrt(jnp.where(under > 0.0, under, 1.0))) / jnp.where(steep, 1.0, a)
    on_side = ~steep & (under > 0.0) & (jnp.abs(along + h * az) <= half)
    highest = jnp.where(on_side, h, -jnp.inf)
    for end in (-half, half):
        room = radius * radius - (dx - end * ax) ** 2 - (dy - end * ay) ** 2
        ball = end * az + jnp.sqrt(jnp.where(room > 0.0, room, 1.0))
        highest = jnp.maximum(highest, jnp.where(room > 0.0, ball, -jnp.inf))
    return highest


class _Surface(NamedTuple):
    """Ground of one geom.

    Attributes:
        height: at (x, y), -inf where it is not.
        bottom: its lowest height [m].
    """

    height: Callable[..., Array]
    bottom: float


def _surface(model: mujoco.MjModel, geom: int) -> _Surface:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    position = model.geom_pos[geom].copy()
    turn = rotation.reshape(3, 3)
    size = model.geom_size[geom].copy()
    name, kind = model.geom(geom).name, mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE):
        capsule = kind == mujoco.mjtGeom.mjGEOM_CAPSULE

        def solid(x: Array, y: Array) -> Array:
            enters = _capsule_height if capsule else _box_height
            return position[2] + enters(
                x - position[0], y - position[1], jnp.asarray(turn, float), jnp.asarray(size, float)
            )

        up = abs(turn[2, 2]) * size[1] + size[0] if capsule else np.abs(turn[2]) @ size
        return _Surface(solid, float(position[2] - up))
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        normal = turn[:, 2]
        if normal[2] < _STEEPEST_COSINE:
            raise ParameterError(
                f"scene has the ground {name!r}, a plane that is too steep to stand on."
            )

        def plane(x: Array, y: Array) -> Array:
            if not normal[:2].any():
                return jnp.full(jnp.broadcast_shapes(x.shape, y.shape), position[2], float)
            return (
                position[2]
                - (normal[0] * (x - position[0]) + normal[1] * (y - position[1])) / normal[2]
            )

        return _Surface(plane, float(position[2]))
    if turn[2, 2] < 1.0 - 1e-6:
        raise ParameterError(f"scene has the ground {name!r}, an hfield that is not level.")
    return _hills(model, geom, position, turn)


def _hills(model: mujoco.MjModel, geom: int, position: np.ndarray, turn: np.ndarray) -> _Surface:
    """The surface of a height field, at its position and rotation."""
    name, field = model.geom(geom).name, model.geom_dataid[geom]
    rows = model.hfield_nrow[field]
    columns = model.hfield_ncol[field]
    start = model.hfield_adr[field]
    data = np.array(model.hfield_data[start : start + rows * columns].reshape(rows, columns), float)
    extent, of_waves = model.hfield_size[field].copy(), name in geom_names("rough")

    def share(row: Array, column: Array) -> Array:
        """Heights of points of the field. Rough ground is computed: XLA takes minutes to compile so large a table."""
        if of_waves:
            return field_share(column.astype(float), row.astype(float), jnp)
        return jnp.asarray(data, float)[row, column]

    def hills(x: Array, y: Array, highest: ArrayLike = extent[2], moved: Any = None) -> Array:
        """On the triangles into which MuJoCo divides each cell, for a field of this height and place."""
        if moved is not None:
            x, y = x - moved[0] + position[0], y - moved[1] + position[1]
        dx, dy = x - position[0], y - position[1]
        u = (turn[0, 0] * dx + turn[1, 0] * dy) / extent[0]
        v = (turn[0, 1] * dx + turn[1, 1] * dy) / extent[1]
        column, row = 0.5 * (u + 1.0) * (columns - 1), 0.5 * (v + 1.0) * (rows - 1)
        i = jnp.clip(jnp.floor(row), 0, rows - 2).astype(int)
        j = jnp.clip(jnp.floor(column), 0, columns - 2).astype(int)
        s, t = column - j, row - i
        origin = share(i, j)
        right = share(i, j + 1)
        up = share(i + 1, j)
        opposite = share(i + 1, j + 1)
        lower = origin + s * (right - origin) + t * (opposite - right)
        upper = origin + t * (up - origin) + s * (opposite - up)
        inside = (jnp.abs(u) <= 1.0) & (jnp.abs(v) <= 1.0)
        return jnp.where(inside, position[2] + highest * jnp.where(s >= t, lower, upper), -jnp.inf)

    return _Surface(hills, float(position[2]))
