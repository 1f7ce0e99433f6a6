"""Location of the MJCF files, and reading one of them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import mujoco

from nermo_mjx.robot.meshes.obj import read_obj


def mjcf_directory() -> Path:
    """The folder of the MJCF files: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "mjcf"
    return inside if inside.is_dir() else package.parent / "mjcf"


def scene_files() -> tuple[str, ...]:
    """Names of the scenes of `mjcf/scenes`."""
    return tuple(sorted(path.stem for path in (mjcf_directory() / "scenes").glob("*.xml")))


#: Changes the tree of an MJCF file.
Edit = Callable[[ET.Element], None]


def load_file(name: str, edit: Edit | None = None) -> mujoco.MjSpec:
    """The specification in `mjcf/NAME.xml`, editable, with its meshes inside.

    Args:
        name: of the file.
        edit: changes the tree of the file before it is compiled.
    """
    path = mjcf_directory() / f"{name}.xml"
    if edit is None:
        spec = mujoco.MjSpec.from_file(str(path))
    else:
        root = ET.parse(path).getroot()
        edit(root)
        included = {each.get("file", ""): (path.parent / each.get("file", "")).read_bytes()
                    for each in root.iter("include")}  # fmt: skip
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"), include=included)
    # Meshes become part of the specification: an assembled or exported model compiles anywhere, without files.
    for mesh in spec.meshes:
        vertices, faces = read_obj(mjcf_directory() / spec.meshdir / mesh.file)
        mesh.uservert, mesh.userface, mesh.file = vertices.ravel(), faces.ravel(), ""
    spec.meshdir = ""
    return spec
