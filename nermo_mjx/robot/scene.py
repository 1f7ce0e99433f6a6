"""A scene: a bundled one, by its name, or a custom one, as self-contained MJCF text.

A file or an `MjSpec` is converted to such a text once, when a setup is created. The text can be compared, hashed, sent
to another process, and stored in a spec file or a recording, so that these document the ground the robot walked on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NoReturn, TypeAlias

import mujoco

from nermo_mjx.robot.files import load_file, scene_files
from nermo_mjx.robot.gravity import gravity_values
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import ParameterError, check_quantities, replace_quantities
from nermo_mjx.robot.terrains import TERRAINS, add_terrain

Scene: TypeAlias = str | os.PathLike[str] | mujoco.MjSpec
#: Default classes of the geoms that carry the robot, and of those that stop it; nested classes count, too.
GROUND: Final = "ground"
OBSTACLE: Final = "obstacle"
#: A geom of this name is ground, whatever its class.
FLOOR: Final = "floor"
#: Allowed types of ground: every engine can collide a sphere with them, and `terrain.Terrain` knows their height.
GROUND_TYPES: Final = (
    mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_HFIELD,
)  # fmt: skip
#: The file of `mjcf/scenes/common` into which a terrain is put.
_GROUNDS: Final = "scenes/common/terrain"
#: Elements that move, act or measure: only the robot may have positions, controls and sensors.
_FOREIGN: Final = {
    "joints": "a joint", "actuators": "an actuator", "sensors": "a sensor", "tendons": "a tendon",
    "equalities": "an equality", "pairs": "a contact pair", "keys": "a keyframe", "flexes": "a flex",
    "skins": "a skin", "plugins": "a plugin",
}  # fmt: skip
#: MuJoCo's first write of a text that it has read differs slightly: a frame's quaternion is written out.
_MOST_READ: Final = 4


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
            gravity is kept.

    Raises:
        ParameterError: the scene or file does not exist; MuJoCo rejects it; it has elements that only the robot may
            have, or no ground.
    """
    if isinstance(scene, mujoco.MjSpec):
        return _text(scene.copy(), f"the MjSpec {scene.modelname!r}")
    if scene in scenes():
        return str(scene)
    if isinstance(scene, str) and is_mjcf(scene):
        return _from_text(scene)
    path = Path(scene)
    if not os.path.isfile(path):
        if path.suffix != ".xml":
            names = " or ".join(map(repr, scenes()))
            raise ParameterError(f"scene is {str(scene)!r}: allowed is {names} or the path of an MJCF file (.xml).")
        raise ParameterError(f"scene is {str(scene)!r}: there is no such file.")
    with _refusals(repr(str(scene))):
        spec = mujoco.MjSpec.from_file(str(path))
    return _text(spec, repr(str(scene)))


def scene_name(scene: str) -> str:
    """Name of a scene from `resolve_scene`: its own, or that of its model."""
    return ElementTree.fromstring(scene).get("model", "own") if is_mjcf(scene) else scene


def load_scene(scene: str) -> mujoco.MjSpec:
    """The editable specification of a scene from `resolve_scene`."""
    if scene in TERRAINS:
        spec = load_file(_GROUNDS)
        add_terrain(spec, scene)
        spec.modelname = scene
        return spec
    return mujoco.MjSpec.from_string(scene) if is_mjcf(scene) else load_file(f"scenes/{scene}")


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
    classes = {each.get("class") for each in tree.findall(f".//default[@class='{role}']//default")} | {role}
    return [geom for geom in spec.geoms if geom.classname.name in classes or (role == GROUND and geom.name == FLOOR)]


@contextlib.contextmanager
def _refusals(called: str) -> Iterator[None]:
    """Turn MuJoCo's message of several lines into one sentence about the scene."""
    try:
        yield
    except ValueError as error:
        said = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise ParameterError(f"scene is {called}: MuJoCo refuses it: {said.rstrip('.')}.") from None


@functools.lru_cache(maxsize=64)
def _from_text(text: str) -> str:
    with _refusals("MJCF"):
        spec = mujoco.MjSpec.from_string(text)
    return _text(spec, "MJCF")


def _text(spec: mujoco.MjSpec, called: str) -> str:
    """MJCF of a checked and prepared scene, which does not change when it is read and prepared again."""
    text = _prepared(spec, called)
    for _ in range(_MOST_READ):
        before, text = text, _prepared(mujoco.MjSpec.from_string(text), called)
        if text == before:
            break
    return text


def _prepared(spec: mujoco.MjSpec, called: str) -> str:
    """MJCF of a scene, checked, with all geoms named and fixed to the world, and absolute paths of files."""

    def refuse(why: str) -> NoReturn:
        raise ParameterError(f"scene is {called}: it {why}.")

    for kind, what in _FOREIGN.items():
        for element in getattr(spec, kind):
            refuse(f"has {what}{f' {element.name!r}' if element.name else ''}, and only the robot may")
    for body in spec.bodies[1:]:
        if body.mocap:
            refuse(f"has a body {body.name!r} that moves (mocap), and only the robot may")
    with _refusals(called):
        ground = _geoms(spec, GROUND)
    if not ground:
        refuse(f"has no ground: give what the robot stands on the default class {GROUND!r}, or the name {FLOOR!r}")
    spec.compiler.discardvisual = False
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for role in (GROUND, OBSTACLE):
        taken = {geom.name for geom in spec.geoms}
        free = (name for i in range(len(spec.geoms)) if (name := f"{role}_{i}") not in taken)
        for geom in _geoms(spec, role):
            geom.name = geom.name or next(free)
    for geom in ground:
        if geom.type not in GROUND_TYPES:
            kind = geom.type.name.removeprefix("mjGEOM_").lower()
            refuse(f"has the ground {geom.name!r}, a {kind}; allowed is a plane, a box, a capsule or an hfield")
    _find_files(spec)
    # Static bodies are merged into the world, so that the only bodies are the robot's.
    spec.compiler.fusestatic = True
    with _refusals(called):
        model = spec.compile()
    if model.nbody > 1:
        refuse(f"has a body {model.body(1).name!r} that a camera or light aims at; aim it at none")
    try:
        check_quantities(replace_quantities(ModelParameters(), gravity_values(model.opt.gravity)))
    except ParameterError as error:
        refuse(f"has a gravity with which {str(error).removesuffix('.')}")
    return _own_settings_only(spec.to_xml())


def _own_settings_only(text: str) -> str:
    """The scene without settings that would affect the robot, which has its own options and compiler settings."""
    tree = ElementTree.fromstring(text)
    for name, kept in (("option", "gravity"), ("compiler", "angle"), ("size", "")):
        for element in tree.findall(name):
            element.attrib = {key: value for key, value in element.attrib.items() if key == kept}
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
