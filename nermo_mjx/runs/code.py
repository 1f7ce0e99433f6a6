"""Which code computes a result, where and with what: enough to run it again.

A directory records it, and mixes results of different codes only on request.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any, Final

from nermo_mjx.runtime import processor_line
from nermo_mjx.version import __version__

#: Rooms of the package that determine what a world does and what is measured.
ROOMS: Final = ("robot", "kinematics", "control", "dynamics", "physics", "rollout")
#: Sources among the files of a room, and of the robot's model.
_SUFFIXES: Final = (".py", ".csv", ".xml", ".obj")
#: Name of each field of a stamp in messages.
_CALLED: Final = {
    "package": "nermo-mjx {}",
    "sources": "sources {}",
    "model": "model {}",
    "engine": "engine {}",
    "mujoco": "MuJoCo {}",
    "mujoco_mjx": "MuJoCo MJX {}",
    "jax": "JAX {}",
}


@dataclasses.dataclass(frozen=True)
class CodeStamp:
    """What made a row: equal stamps mean that equal results can be expected, on one kind of machine.

    Attributes:
        package: version of nermo-mjx.
        sources: digest of the sources that compute.
        model: digest of the robot's model, or of what else is simulated.
        engine: name of the engine that ran.
        mujoco, mujoco_mjx, jax: versions.
    """

    package: str
    sources: str
    model: str
    engine: str
    mujoco: str
    mujoco_mjx: str
    jax: str

    @property
    def id(self) -> str:
        """A short name, identical on all machines that ran the same code: the column `code` of a table."""
        return hashlib.blake2b(json.dumps(self.fields()).encode(), digest_size=4).hexdigest()

    def fields(self) -> dict[str, str]:
        """For a JSON file."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        return ", ".join(form.format(self.fields()[name]) for name, form in _CALLED.items())

    def unlike(self, former: CodeStamp) -> str:
        """How this stamp differs from another, as "engine c, not warp"; empty if it does not."""
        own_fields, other_fields = self.fields(), former.fields()
        differences = [
            (form.format(own_fields[name]), other_fields[name])
            for name, form in _CALLED.items()
            if own_fields[name] != other_fields[name]
        ]
        return ", ".join(f"{ours}, not {former}" for ours, former in differences)


def stamp(model: str, engine: str, subpackages: tuple[str, ...] = ()) -> CodeStamp:
    """The stamp of the code that runs here.

    Args:
        model: digest of the model, as `nermo_mjx.robot.Robot.fingerprint`.
        engine: name of the engine that runs, never "auto".
        subpackages: further rooms of the package that affect the results, in addition to `ROOMS`.
    """
    return CodeStamp(
        package=__version__,
        sources=sources(subpackages),
        model=model,
        engine=engine,
        mujoco=version("mujoco"),
        mujoco_mjx=version("mujoco-mjx"),
        jax=version("jax"),
    )


def stored_stamp(fields: Any) -> CodeStamp | None:
    """The stamp in a JSON file; None if it has no readable one."""
    try:
        return CodeStamp(
            **{field.name: str(fields[field.name]) for field in dataclasses.fields(CodeStamp)}
        )
    except (KeyError, TypeError):
        return None


@functools.cache
def sources(subpackages: tuple[str, ...] = ()) -> str:
    """Digest of the sources in `ROOMS`, and in more of them, and of the robot's model files."""
    package = Path(__file__).parents[1]
    inside = package / "mjcf"
    roots = [
        *(package / room for room in (*ROOMS, *subpackages)),
        inside if inside.is_dir() else package.parent / "mjcf",
    ]
    total = hashlib.blake2b(digest_size=8)
    for root in roots:
        for path in sorted(root.rglob("*")):
            if path.suffix in _SUFFIXES:
                total.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
                total.update(path.read_bytes())
    return total.hexdigest()


# ---
# Versions, machine and command of a session of work.


PACKAGES = (
    "mujoco",
    "mujoco-mjx",
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "pyarrow",
    "optax",
    "orbax-checkpoint",
)


def versions() -> dict[str, str]:
    """Versions of this package, of Python, and of the packages that affect results."""
    return {"nermo-mjx": __version__, "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }


@functools.cache
def version(package: str) -> str:
    """Version of an installed package; "absent" if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def machine() -> dict[str, Any]:
    """The machine's name, processor, number of cores and platform."""
    return {
        "host": platform.node(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
    }


def session(**entries: Any) -> dict[str, Any]:
    """One session of work: when, by which command, with which versions, where."""
    started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    return {
        "started": started,
        "command": shlex.join(sys.argv),
        "versions": versions(),
        "machine": machine(),
        **entries,
    }


def local_time(started: Any) -> str:
    """When a session started, for people: in this machine's time zone, and with its name."""
    try:
        return f"{datetime.datetime.fromisoformat(str(started)).astimezone():%Y-%m-%d %H:%M %Z}"
    except (ValueError, OverflowError):
        return str(started)


def processor() -> str:
    """The processor's name."""
    return processor_line("model name").rpartition(":")[2].strip() or platform.machine()
