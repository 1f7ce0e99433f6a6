"""Provenance of a result: its code (`CodeStamp`), and the versions, machine and command of each session.

A directory records both, and mixes results of different codes only on request.
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

#: Subpackages that determine the simulation of a world and its metrics.
ROOMS: Final = ("robot", "kinematics", "control", "dynamics", "physics", "rollout")
#: Suffixes of source files of a subpackage, and of the robot's model.
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
    """Identifies the code that made a row: with equal stamps, results are equal on one kind of machine.

    Attributes:
        package: Version of nermo-mjx.
        sources: Digest of the sources that affect results.
        model: Digest of the model of the robot, or of another simulated model.
        engine: Name of the engine.
        mujoco, mujoco_mjx, jax: Versions of these packages.
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
        model: Digest of the model, as in `nermo_mjx.robot.Robot.fingerprint`.
        engine: Name of the engine, never "auto".
        subpackages: Subpackages that affect the results in addition to `ROOMS`.
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
    """Digest of the sources in `ROOMS` and in additional subpackages, and of the files of the robot's model."""
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
    """Record of one session: its start, command, versions and machine."""
    started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    return {
        "started": started,
        "command": shlex.join(sys.argv),
        "versions": versions(),
        "machine": machine(),
        **entries,
    }


def local_time(started: Any) -> str:
    """The start of a session in the time zone of this machine, with the name of the zone."""
    try:
        return f"{datetime.datetime.fromisoformat(str(started)).astimezone():%Y-%m-%d %H:%M %Z}"
    except (ValueError, OverflowError):
        return str(started)


def processor() -> str:
    """The processor's name."""
    return processor_line("model name").rpartition(":")[2].strip() or platform.machine()
