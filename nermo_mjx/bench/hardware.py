"""The machine and the versions that a measurement was made with."""

from __future__ import annotations

import importlib.metadata
import platform
import resource
import subprocess
import sys
from pathlib import Path

import jax

from nermo_mjx.runs.provenance import processor
from nermo_mjx.runtime import cpu_count


def describe() -> dict[str, str | int]:
    """Name of the processor and accelerator, memory, and versions of the numerical packages."""
    devices = jax.devices()
    versions = {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "jax", "jaxlib")}
    return {
        "cpu": processor(),
        "cores": cpu_count(),
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "python": platform.python_version(),
        **versions,
    }


def commit() -> str | None:
    """The commit of the measured source, with a + if files differ from it; None for an installed package."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--exclude=*", "--dirty=+", "--abbrev=12"]
    try:
        done = subprocess.run(git, check=False, capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() or None


def peak_bytes() -> int:
    """Peak memory so far: of the accelerator, or of this process on a CPU."""
    statistics = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if statistics and "peak_bytes_in_use" in statistics:
        return int(statistics["peak_bytes_in_use"])
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
