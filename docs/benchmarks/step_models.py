"""Models for step_matrix.py: MuJoCo's for MJX, Playground's or any file, each in a state with contacts."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

#: Maximum time that a model moves freely until it touches something [s].
SETTLING: Final = 2.0
#: Skipped steps at the beginning.
FIRST: Final = 10
#: Maximum number of these steps.
MOST_STEPS: Final = 4000
#: Warnings after which a state is invalid.
LOST: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def installed_models() -> Iterator[tuple[str, Path]]:
    """(name, file) of the models that come with `mujoco-mjx`, and with `playground`, if installed."""
    for package, below, prefix in (
        ("mujoco", "mjx/test_data", "mjx"),
        ("mujoco_playground", "_src", "playground"),
    ):
        spec = importlib.util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            continue
        yield from models_below(Path(next(iter(spec.submodule_search_locations))) / below, prefix)


def models_below(root: Path, prefix: str = "") -> Iterator[tuple[str, Path]]:
    """(name, file) of each model in a directory that is not part of another one, or of a single file."""
    files = [root] if root.is_file() else sorted(root.rglob("*.xml"))
    for path in files:
        text = path.read_text(errors="replace")
        beside = [other.read_text(errors="replace") for other in path.parent.glob("*.xml")]
        is_part = any(f'file="{path.name}"' in other for other in beside)
        if not is_part and ("<worldbody" in text or "<include" in text):
            parts = [
                part for part in path.relative_to(root).parts[:-1] if part not in ("xmls", "assets")
            ]
            yield "/".join(filter(None, [prefix, *parts, path.stem])), path


def load(path: Path) -> mujoco.MjModel:
    """The model of a file, without missing meshes that are purely visual.

    The visual meshes of Playground's robots are in a separate repository; the dynamics does not depend on them.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    for material in spec.materials:  # kept, because rangefinders ignore transparent geoms
        material.textures = [""] * len(material.textures)
    for part in (*spec.textures, *spec.skins):
        spec.delete(part)
    for field in spec.hfields:  # next to the scene, if the robot's file has its meshes elsewhere
        beside = path.parent / "assets" / Path(field.file).name
        field.file = str(beside) if beside.is_file() else field.file
    gone = _meshes_gone(spec, path.parent)
    for geom in [each for each in spec.geoms if each.meshname in gone]:
        if (
            geom.contype
            or geom.conaffinity
            or not (geom.parent.explicitinertial or _is_fixed(geom.parent))
        ):
            raise ValueError(f"mesh {geom.meshname!r} is not there, and it collides or has a mass.")
        spec.delete(geom)
    for mesh in [each for each in spec.meshes if each.name in gone]:
        spec.delete(mesh)
    return spec.compile()


def _meshes_gone(spec: mujoco.MjSpec, folder: Path) -> set[str]:
    """Names of the meshes with missing files; files in subdirectories are used from there."""
    gone = set()
    for mesh in spec.meshes:
        mesh.name = mesh.name or Path(mesh.file).stem
        if not mesh.file or (folder / spec.meshdir / mesh.file).is_file():
            continue
        beside = next(folder.rglob(Path(mesh.file).name), None)
        if beside is None:
            gone.add(mesh.name)
        else:
            mesh.file = str(beside.resolve())
    return gone


def _is_fixed(body: mujoco.MjsBody) -> bool:
    """Whether a body has no joint between it and the world."""
    while body is not None and body.name != "world":
        if body.joints or body.mocap:
            return False
        body = body.parent
    return True


def touching(model: mujoco.MjModel, steps: int) -> mujoco.MjData:
    """A state with as many constraints as occur in the motion, which do not change for `steps` steps.

    MuJoCo C simulates it from its first keyframe, or its reference, with slightly perturbed velocities. If there is no
    contact with the controls of the keyframe, or near the middle of their ranges, they are drawn from the full ranges.
    """
    data = mujoco.MjData(model)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    best, start = (-1, -1, -1), np.zeros(0)
    for share in (0.1, 1.0):
        states, rows = _moved(model, data, kind, share)
        held = 0
        # Not at the beginning, when many bodies just touch their support.
        for index in range(min(FIRST, len(rows) - 1), max(len(rows) - steps, 1)):
            held = held + 1 if index and rows[index] == rows[index - 1] else 0
            found = (*rows[index], min(held, 20))
            if len(set(rows[index : index + steps])) == 1 and found > best:
                best, start = found, states[index]
        if best[1] > 0:
            break
    mujoco.mj_setState(model, data, start, kind)
    # A muscle whose activation equals its control, and a control at its limit, are kinks.
    low, high = _control_ranges(model)
    data.ctrl[:] = np.clip(
        data.ctrl + 0.02 * (high - low) * np.random.default_rng(1).uniform(-1.0, 1.0, model.nu),
        low + 0.01 * (high - low),
        high - 0.01 * (high - low),
    )
    mujoco.mj_forward(model, data)
    return data


def _control_ranges(model: mujoco.MjModel) -> np.ndarray:
    """Ends of the controls' ranges, (2, nu); -1 and 1 if unlimited."""
    return np.where(
        model.actuator_ctrllimited[:, None].astype(bool), model.actuator_ctrlrange, [-1.0, 1.0]
    ).T


def _moved(
    model: mujoco.MjModel, data: mujoco.MjData, kind: int, share: float
) -> tuple[list[np.ndarray], list[tuple[int, int]]]:
    """States, and (contacts, rows) after each, of a model with controls from this fraction of their ranges."""
    random = np.random.default_rng(0)
    mujoco.mj_resetData(model, data)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    if model.nu and (share == 1.0 or not model.nkey):
        low, high = _control_ranges(model)
        data.ctrl[:] = 0.5 * (low + high) + 0.5 * share * (high - low) * random.uniform(
            -1.0, 1.0, model.nu
        )
    data.qvel[:] += 0.1 * random.normal(size=model.nv)
    states, rows = [], []
    for _ in range(min(MOST_STEPS, round(SETTLING / model.opt.timestep))):
        before = np.zeros(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, before, kind)
        mujoco.mj_step(model, data)
        if any(data.warning[each].number for each in LOST):
            break
        states.append(before)
        rows.append((data.ncon, data.nefc))
    return (states, rows) if states else ([before], [(0, 0)])
