"""A recording: the time history of one simulated run, in one NPZ file that any NumPy can read."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from nermo_mjx.files import (
    MAX_FILE_BYTES,
    FileError,
    arrays_of,
    check_arrays,
    json_of,
    read_bytes,
    replace_file,
)

#: Version of the file's layout; a reader refuses any other.
LAYOUT_VERSION: Final = 1
_MARK: Final = "nermo_mjx recording"
#: Beginning of the names of sensors that hold a channel of a robot's log, measured and simulated (T, 2).
LOG_PREFIX: Final = "log."
_REMEDY: Final = (
    "nermo-mjx walk --record FILE.npz writes one, and nermo-mjx log reads a robot's log"
)

#: The arrays of a file, T samples each; with them a text `header`, and `sensor.NAME`.
ARRAYS: Final[dict[str, tuple[str, tuple[Any, ...]]]] = {
    "time": ("fiu", ("T",)),
    "qpos": ("fiu", ("T", "nq")),
    "qvel": ("fiu", ("T", "nv")),
    "ctrl": ("fiu", ("T", "nu")),
}


class Metadata(BaseModel, extra="allow"):
    setup: dict[str, str | float | bool | list[Any] | None] | None = None
    parameters: dict[str, float | None] | None = None
    metrics: dict[str, float | bool | str | None] | None = None
    labels: dict[str, float | bool | str | None] | None = None
    run: dict[str, float | None] | None = None
    units: dict[str, str] | None = None
    versions: dict[str, str | None] | None = None
    engine: str | None = None


class _Header(BaseModel):
    format: str
    layout: int
    model_hash: str
    metadata: Metadata


class RecordingError(FileError, ValueError):
    """A file that is not a recording, or one that does not fit the model; the message is one sentence."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One run over time.

    Attributes:
        time: of each sample, increasing [s].
        qpos: generalised positions [m, rad].
        qvel: generalised velocities [m/s, rad/s].
        ctrl: commanded servo angles [rad].
        sensors: named sensor readings, each with the time axis first; units as in `robot.Sensors`.
        model_hash: `model_hash` of the model that ran; "" if unknown.
        metadata: plain JSON values: `setup`, `parameters`, `metrics`, `engine`, `versions`, and `units` of
            custom metrics.
    """

    time: Float[np.ndarray, " T"]
    qpos: Float[np.ndarray, "T nq"]
    qvel: Float[np.ndarray, "T nv"]
    ctrl: Float[np.ndarray, "T nu"]
    sensors: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    model_hash: str = ""
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays |= {f"sensor {name}": values for name, values in self.sensors.items()}
        if np.ndim(self.time) != 1 or len(self.time) == 0:
            raise RecordingError(
                f"A recording needs at least one sample, but its time has shape {np.shape(self.time)}."
            )
        for name, values in arrays.items():
            if np.ndim(values) == 0 or len(values) != len(self.time):
                raise RecordingError(
                    f"{name} has shape {np.shape(values)}, but there are {len(self.time)} samples."
                )

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    def between(self, begin: float, end: float) -> Recording:
        """The samples from one time to another [s], both included; at least the first one after `begin`."""
        first = min(int(np.searchsorted(self.time, begin - 1e-9)), len(self.time) - 1)
        last = max(first + 1, int(np.searchsorted(self.time, end + 1e-9)))
        arrays = {name: getattr(self, name)[first:last] for name in ARRAYS}
        sensors = {name: values[first:last] for name, values in self.sensors.items()}
        return dataclasses.replace(self, **arrays, sensors=sensors)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the NPZ file atomically: a killed process leaves no half of it.

        Raises:
            RecordingError: the file cannot be written.
        """
        return write_whole(Path(path), "the recording", self.content())

    def content(self) -> bytes:
        """What `save` writes."""
        header = {
            "format": _MARK,
            "layout": LAYOUT_VERSION,
            "model_hash": self.model_hash,
            "metadata": dict(self.metadata),
        }
        arrays = {"header": np.array(json.dumps(header))}
        arrays |= {name: getattr(self, name) for name in ARRAYS}
        arrays |= {f"sensor.{name}": values for name, values in self.sensors.items()}
        file = io.BytesIO()
        np.savez_compressed(
            file, allow_pickle=False, **{key: np.asarray(v) for key, v in arrays.items()}
        )
        return file.getvalue()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Read a file that `save` wrote.

        Raises:
            RecordingError: there is no such file, it is something else, or of another version.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise TypeError(f"path is {path!r}: expected the path of a recording.")
        try:
            arrays = arrays_of(read_bytes(Path(path), MAX_FILE_BYTES), path)
            if arrays.get("header", np.zeros(1)).dtype.kind != "U":
                raise RecordingError(f"{path}: not a recording of nermo_mjx; {_REMEDY}.")
            header = json_of(str(arrays.pop("header")), _Header, path)
            if header["format"] != _MARK:
                raise RecordingError(f"{path}: not a recording of nermo_mjx; {_REMEDY}.")
            if header["layout"] != LAYOUT_VERSION:
                raise RecordingError(
                    f"{path}: a recording of layout {header['layout']}, but this version reads layout "
                    f"{LAYOUT_VERSION}; record the run again."
                )
            sensors = {key for key in arrays if key.startswith("sensor.")}
            check_arrays(arrays, ARRAYS | dict.fromkeys(sensors, ("fiub", ("T", ...))), path)
            sensor_arrays = {key.removeprefix("sensor."): arrays[key] for key in sensors}
            motion = {name: arrays[name] for name in ARRAYS}
            recording = cls(
                **motion,
                sensors=sensor_arrays,
                model_hash=header["model_hash"],
                metadata=header["metadata"],
            )
            if not (np.isfinite(recording.time).all() and (np.diff(recording.time) > 0).all()):
                raise RecordingError(f"{path}: its time does not increase from sample to sample.")
            return recording
        except FileNotFoundError:
            raise RecordingError(f"{path}: there is no such file.") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror or error}).") from None
        except RecordingError as error:
            text = str(error)
            raise RecordingError(
                text if text.startswith(f"{path}:") else f"{path}: {text}"
            ) from None
        except FileError as error:
            reason = str(error).rstrip(".")
            raise RecordingError(
                f"{reason}, so it is not a recording of nermo_mjx; {_REMEDY}."
            ) from None

    def check_model(self, model: mujoco.MjModel) -> None:
        """Raise `RecordingError` unless the recording was made with a model of the same structure."""
        if self.qpos.shape[1] != model.nq:
            raise RecordingError(
                f"The recording has {self.qpos.shape[1]} positions, but the model has {model.nq}."
            )
        if self.model_hash and self.model_hash != model_hash(model):
            raise RecordingError(
                "The recording was made with another version of the robot's model; record the run again."
            )


def write_whole(path: Path, kind: str, content: bytes) -> Path:
    """Write a file that appears under its name when complete; its folder is created if missing.

    Args:
        path: of the file.
        kind: it holds, for the message.
        content: of the file.

    Raises:
        RecordingError: it cannot be written; what was there is still there.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)
    except OSError as error:
        raise RecordingError(
            f"{path}: {kind} cannot be written ({error.strerror or error})."
        ) from None
    return path


def model_hash(model: mujoco.MjModel) -> str:
    """Names a model by its structure: bodies, joints, actuators and sensors, where they sit and in which order.

    Masses, friction, gains and stiffnesses do not count, because a sweep varies them within one structure; meshes,
    cameras, colours and light do not count, because they are looks.
    """
    digest = hashlib.sha256()
    # Velocities of joints are in `qvel`: these sensors are for metrics alone, and robots did not always have them.
    sensors = np.flatnonzero(model.sensor_type != mujoco.mjtSensor.mjSENS_JOINTVEL)
    sizes = (model.nq, model.nv, model.nu, model.nbody, model.njnt, model.ntendon, len(sensors))
    kinds = (
        mujoco.mjtObj.mjOBJ_BODY,
        mujoco.mjtObj.mjOBJ_JOINT,
        mujoco.mjtObj.mjOBJ_TENDON,
        mujoco.mjtObj.mjOBJ_ACTUATOR,
        mujoco.mjtObj.mjOBJ_SENSOR,
    )
    ids = (
        range(model.nbody),
        range(model.njnt),
        range(model.ntendon),
        range(model.nu),
        sensors.tolist(),
    )
    names = [
        [mujoco.mj_id2name(model, kind, i) for i in indices]
        for kind, indices in zip(kinds, ids, strict=True)
    ]
    digest.update(repr((sizes, names)).encode())
    for array in (
        model.body_parentid,
        model.jnt_type,
        model.jnt_bodyid,
        model.sensor_type[sensors],
        model.wrap_type,
    ):
        digest.update(np.ascontiguousarray(array, dtype=np.int64).tobytes())
    for array in (model.body_pos, model.body_quat, model.jnt_pos, model.jnt_axis):
        # Rounded, so that another compiler's last digit makes no other robot; `+ 0.0` turns -0 into 0.
        digest.update((np.round(array, 9) + 0.0).tobytes())
    return digest.hexdigest()[:16]


def recording_of(
    trace: Any, model: mujoco.MjModel, *, world: int = 0, metadata: Mapping[str, Any]
) -> Recording:
    """The recording of one world of a simulator's trace (time [T]; qpos, qvel, ctrl and each sensor [n, T, ...])."""

    def pick(values: Any) -> np.ndarray:
        return np.asarray(values)[world]

    sensors = {name: pick(values) for name, values in trace.sensors.items()}
    arrays = (np.asarray(trace.time), pick(trace.qpos), pick(trace.qvel), pick(trace.ctrl))
    return Recording(*arrays, sensors=sensors, model_hash=model_hash(model), metadata=metadata)
