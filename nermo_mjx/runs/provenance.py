"""Where and with what a result was made: enough to run it again."""

from __future__ import annotations

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
    """Versions of this package, of Python, and of what decides the numbers."""
    found = {"nermo-mjx": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "absent"
    return found


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
