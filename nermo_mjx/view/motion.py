"""The state of a recorded run at each sample: positions of bodies and tendons, and forces.

A recording holds positions, velocities and commands. Forces follow from them: MuJoCo's forward dynamics of a sample
gives the contact forces and, as the force of a tendon's length limit, its tension. The robot's tendons are massless
and inextensible and have neither springs nor actuators of their own, so that the limit's force is the whole tension.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import LIMBS

#: Number of points drawn between the two ends of a tendon's wrap.
ARC: Final = 5


@dataclasses.dataclass(frozen=True)
class Tendon:
    """A tendon over time.

    Attributes:
        name: in the model.
        radius: as it is drawn [m].
        path: points of its polygon in the world [m]; the last is repeated where a tendon has fewer.
        tension: [N], 0 where it is slack.
    """

    name: str
    radius: float
    path: Float[np.ndarray, "T K 3"]
    tension: Float[np.ndarray, " T"]


@dataclasses.dataclass(frozen=True)
class Contact:
    """A contact point between two geoms over time.

    Attributes:
        limb: which of `LIMBS` it belongs to, or -1.
        point: in the world [m]; without a contact, that of the nearest time with one.
        force: on the robot, in the world [N]; 0 where there is no contact.
    """

    limb: int
    point: Float[np.ndarray, "T 3"]
    force: Float[np.ndarray, "T 3"]


@dataclasses.dataclass(frozen=True)
class Motion:
    """The drawn motion of a run.

    Attributes:
        time: of each sample [s].
        position, quaternion: of every body of the model, the world first, in the world [m], (w, x, y, z).
        tendons, contacts: see there.
    """

    time: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T nbody 3"]
    quaternion: Float[np.ndarray, "T nbody 4"]
    tendons: tuple[Tendon, ...]
    contacts: tuple[Contact, ...]


def motion_of(recording: Recording, model: mujoco.MjModel, most: int | None = None) -> Motion:
    """Evaluate a model at a recording's samples, up to the first that is not finite.

    Args:
        recording: the run.
        model: that was simulated, with the run's parameters (`recorded_model`).
        most: maximum number of samples; of a longer recording every second, third, ... one is kept.

    Raises:
        RecordingError: it does not fit the model, or has no finite state.
    """
    recording.check_model(model)
    samples = finite_samples(recording, most)
    data = mujoco.MjData(model)
    position = np.empty((len(samples), model.nbody, 3))
    quaternion = np.empty((len(samples), model.nbody, 4))
    tension = np.zeros((len(samples), model.ntendon))
    wraps: list[_Wraps] = []
    found: dict[tuple[int, int, int], dict[int, tuple[np.ndarray, np.ndarray]]] = {}
    for i, sample in enumerate(samples):
        data.qpos[:], data.qvel[:] = recording.qpos[sample], recording.qvel[sample]
        data.ctrl[:] = np.nan_to_num(recording.ctrl[sample])
        mujoco.mj_forward(model, data)
        position[i], quaternion[i] = data.xpos, data.xquat
        limits = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
        np.add.at(tension[i], data.efc_id[limits], data.efc_force[limits])
        wraps.append(_Wraps.of(data))
        for key, point, force in _contacts(model, data):
            found.setdefault(key, {})[i] = (point, force)
    tendons = tuple(
        Tendon(model.tendon(k).name, float(model.tendon_width[k]), _paths(model, wraps, k), tension[:, k])
        for k in range(model.ntendon)
    )
    contacts = tuple(_contact(model, key, found[key], len(samples)) for key in sorted(found))
    return Motion(recording.time[samples].astype(float), position, quaternion, tendons, contacts)


def finite_samples(recording: Recording, most: int | None = None) -> np.ndarray:
    """Indices of the shown samples: those before the first that is not finite, at most `most` of them."""
    finite = np.isfinite(recording.qpos).all(axis=1) & np.isfinite(recording.qvel).all(axis=1)
    count = len(finite) if finite.all() else int(np.argmin(finite))
    if count == 0:
        raise RecordingError("The recording has no finite state to show.")
    return np.arange(0, count, 1 if most is None else -(-count // most))


@dataclasses.dataclass(frozen=True)
class _Wraps:
    """Paths of the tendons at one sample, from MuJoCo's data; geoms are those that any tendon may wrap."""

    first: np.ndarray
    count: np.ndarray
    geom: np.ndarray
    point: np.ndarray
    centre: np.ndarray
    axis: np.ndarray

    @classmethod
    def of(cls, data: mujoco.MjData) -> _Wraps:
        axis = data.geom_xmat.reshape(-1, 3, 3)[:, :, 2]
        return cls(
            data.ten_wrapadr.copy(), data.ten_wrapnum.copy(), data.wrap_obj.reshape(-1).copy(),
            data.wrap_xpos.reshape(-1, 3).copy(), data.geom_xpos.copy(), axis.copy(),
        )  # fmt: skip


def _paths(model: mujoco.MjModel, wraps: list[_Wraps], tendon: int) -> Float[np.ndarray, "T K 3"]:
    """The polygon of one tendon at each sample, with an arc around each pulley."""
    paths = [_path(each, tendon) for each in wraps]
    longest = max(map(len, paths))
    return np.stack([np.pad(path, ((0, longest - len(path)), (0, 0)), mode="edge") for path in paths])


def _path(wraps: _Wraps, tendon: int) -> Float[np.ndarray, "K 3"]:
    first, count = int(wraps.first[tendon]), int(wraps.count[tendon])
    points, geoms = wraps.point[first : first + count], wraps.geom[first : first + count]
    parts: list[np.ndarray] = []
    for i in range(count):
        parts.append(points[i : i + 1])
        if i + 1 < count and geoms[i] >= 0 and geoms[i] == geoms[i + 1]:
            geom = int(geoms[i])
            parts.append(_arc(points[i], points[i + 1], wraps.centre[geom], wraps.axis[geom]))
    return np.concatenate(parts)


def _arc(begin: np.ndarray, end: np.ndarray, centre: np.ndarray, axis: np.ndarray) -> Float[np.ndarray, "ARC 3"]:
    """Points between two on a cylinder, along the shorter arc, since wraps are shorter than half a turn."""
    u, v = begin - centre, end - centre
    height_u, height_v = u @ axis, v @ axis
    u, v = u - height_u * axis, v - height_v * axis
    angle = np.arctan2(np.dot(axis, _cross(u, v)), u @ v)
    share = np.linspace(0.0, 1.0, ARC + 2)[1:-1, None]
    turned = np.cos(share * angle) * u + np.sin(share * angle) * _cross(axis, u)
    return centre + turned + (height_u + share * (height_v - height_u)) * axis


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`np.cross` of two vectors, without its large overhead."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _contacts(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[tuple[int, int, int], np.ndarray, np.ndarray]]:
    """((geom, geom, number), point, force on the robot) of each contact."""
    result: list[Any] = []
    seen: dict[tuple[int, int], int] = {}
    wrench = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        if contact.efc_address < 0:
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        one, two = int(contact.geom1), int(contact.geom2)
        number = seen[one, two] = seen.get((one, two), -1) + 1
        # MuJoCo's normal points from the first geom to the second, and the force acts on the second.
        sign = -1.0 if model.body_weldid[model.geom_bodyid[two]] == 0 else 1.0
        result.append(((one, two, number), contact.pos.copy(), sign * (contact.frame.reshape(3, 3).T @ wrench[:3])))
    return result


def _contact(
    model: mujoco.MjModel, key: tuple[int, int, int], found: dict[int, tuple[np.ndarray, np.ndarray]], count: int
) -> Contact:
    there = np.array(sorted(found))
    force = np.zeros((count, 3))
    force[there] = [found[i][1] for i in there]
    # The point of the previous contact, and before the first contact the first one's.
    nearest = there[np.maximum(np.searchsorted(there, np.arange(count), side="right") - 1, 0)]
    point = np.array([found[i][0] for i in nearest])
    bodies = [model.body(model.geom_bodyid[geom]).name for geom in key[:2]]
    limb = next((i for i, limb in enumerate(LIMBS) if any(body.startswith(limb) for body in bodies)), -1)
    return Contact(limb, point, force)
