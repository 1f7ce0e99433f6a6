"""Where and with what a result was made: enough to run it again."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from nermo_mjx.version import __version__

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy", "scipy", "pyarrow", "optax", "orbax-checkpoint")


def versions() -> dict[str, str]:
    """Versions of this package, of Python, and of the packages that affect results."""
    return {"nermo-mjx": __version__, "python": platform.python_version()} | {name: version(name) for name in PACKAGES}


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


def session(**more: Any) -> dict[str, Any]:
    """One session of work: when, by which command, with which versions, where."""
    started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    return {"started": started, "command": shlex.join(sys.argv), "versions": versions(), "machine": machine(), **more}


def processor() -> str:
    """The processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
