"""A scene: one that ships, by its name, or one of one's own, as a text of MJCF that stands for itself.

A file or an `MjSpec` becomes such a text once, where a setup is made: it can be compared, hashed, sent to another
process, and written into a spec file or a recording, all of which then know what the robot walked on.
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
#: Default classes of the geoms that the robot stands on, and of those that stop it; a class inside of one counts, too.
GROUND: Final = "ground"
OBSTACLE: Final = "obstacle"
#: A geom of this name is ground, whatever its class.
FLOOR: Final = "floor"
#: What ground can be: MuJoCo knows how a sphere touches it in every engine, and `terrain.Terrain` how high it is.
GROUND_TYPES: Final = (
    mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_HFIELD,
)  # fmt: skip
#: The file of `mjcf/scenes/common` into which a terrain is put.
_GROUNDS: Final = "scenes/common/terrain"
#: What moves, acts or reads: positions, controls and sensors are the robot's alone.
_FOREIGN: Final = {
    "joints": "a joint", "actuators": "an actuator", "sensors": "a sensor", "tendons": "a tendon",
    "equalities": "an equality", "pairs": "a contact pair", "keys": "a keyframe", "flexes": "a flex",
    "skins": "a skin", "plugins": "a plugin",
}  # fmt: skip
#: MuJoCo writes what it has just read a little differently once: a quaternion of a frame is written out.
_MOST_READ: Final = 4


@dataclasses.dataclass(frozen=True)
class SceneGeoms:
    """Names of the geoms that touch the robot, in the scene's order: what it stands on, and what stops it."""

    ground: tuple[str, ...]
    obstacles: tuple[str, ...]


def scenes() -> tuple[str, ...]:
    """Names of the scenes that come with the package: files of `mjcf/scenes`, and terrains."""
    return (*scene_files(), *TERRAINS)


def resolve_scene(scene: Scene) -> str:
    """A scene as it is kept: the name of one that ships, or MJCF.

    Args:
        scene: a name; the path of an MJCF file, relative to the working directory; MJCF itself; or an `MjSpec`, which
            is not changed. In a scene of one's own nothing moves; geoms of the default class `ground`, and the one
            named `floor`, carry the robot, those of the class `obstacle` stop it, and no other touches it. What
            it reads from files, such as meshes, stays there; the text has their absolute paths. Of its options
            gravity is kept.

    Raises:
        ParameterError: there is no such scene or file; MuJoCo refuses it; it has what belongs to the robot, or no
            ground.
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
    """What a scene as `resolve_scene` keeps it is called: its name, or that of its model."""
    return ElementTree.fromstring(scene).get("model", "own") if is_mjcf(scene) else scene


def load_scene(scene: str) -> mujoco.MjSpec:
    """The specification of a scene as `resolve_scene` keeps it, editable."""
    if scene in TERRAINS:
        spec = load_file(_GROUNDS)
        add_terrain(spec, scene)
        spec.modelname = scene
        return spec
    return mujoco.MjSpec.from_string(scene) if is_mjcf(scene) else load_file(f"scenes/{scene}")


@functools.lru_cache(maxsize=64)
def scene_geoms(scene: str) -> SceneGeoms:
    """Which geoms touch the robot, of a scene as `resolve_scene` keeps it."""
    spec = load_scene(scene)
    ground, obstacles = ([geom.name for geom in _geoms(spec, role)] for role in (GROUND, OBSTACLE))
    return SceneGeoms(tuple(ground), tuple(obstacles))


def is_mjcf(text: str) -> bool:
    return text.lstrip().startswith("<")


def _geoms(spec: mujoco.MjSpec, role: str) -> list[Any]:
    """Geoms of a default class, or of a class inside of it."""
    tree = ElementTree.fromstring(spec.to_xml())
    classes = {each.get("class") for each in tree.findall(f".//default[@class='{role}']//default")} | {role}
    return [geom for geom in spec.geoms if geom.classname.name in classes or (role == GROUND and geom.name == FLOOR)]


@contextlib.contextmanager
def _refusals(called: str) -> Iterator[None]:
    """Say in one sentence about the scene what MuJoCo says in several lines."""
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
    """MJCF of a scene that is checked and prepared, and stays as it is when it is read and prepared again."""
    text = _prepared(spec, called)
    for _ in range(_MOST_READ):
        before, text = text, _prepared(mujoco.MjSpec.from_string(text), called)
        if text == before:
            break
    return text


def _prepared(spec: mujoco.MjSpec, called: str) -> str:
    """MJCF of a scene in which all is checked, named and fixed to the world, and files have absolute paths."""

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
    # What stands still belongs to the world, so that the robot's bodies are all there are.
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
    """The scene without settings that would reach the robot: how it is computed, compiled and weighed is its own."""
    tree = ElementTree.fromstring(text)
    for name, kept in (("option", "gravity"), ("compiler", "angle"), ("size", "")):
        for element in tree.findall(name):
            element.attrib = {key: value for key, value in element.attrib.items() if key == kept}
            element[:] = []
    return ElementTree.tostring(tree, encoding="unicode")


def _find_files(spec: mujoco.MjSpec) -> None:
    """Give the files that a scene refers to their absolute paths."""
    home = Path(spec.modelfiledir or ".")

    def found(folder: str, file: str) -> str:
        return str((home / folder / file).resolve()) if file else ""

    for element in (*spec.meshes, *spec.hfields):
        element.file = found(spec.meshdir, element.file)
    for texture in spec.textures:
        texture.file = found(spec.texturedir, texture.file)
        texture.cubefiles = [found(spec.texturedir, file) for file in texture.cubefiles]
    spec.meshdir = spec.texturedir = ""
