"""Helpers of tests that read untrusted files: code that leaves a trace if it runs, special files, and limits."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.sweep_fake import FakeSimulator

CANARY = """
import pathlib
pathlib.Path({log!r}).write_text("run")
import jax.numpy as jnp
from nermo_mjx import Controller, metric

@metric(unit="rad/s", better="low", reduce="rms")
def yaw_shake(sensors):
    "Turning about its own axis."
    return sensors.gyro[2]

stiff = Controller(spine=lambda params, phase, turn_rate, feet, stance: 0.0 * phase)
"""


class Measuring(FakeSimulator):
    """With what the stranger's metric gives."""

    def run(self, values: Any, run: Any, **options: Any) -> Any:
        result = super().run(values, run, **options)
        result.metrics |= {"yaw_shake": result.metrics["speed"] * 2}
        return result


@contextlib.contextmanager
def bounded(seconds: int = 60, additional: int = 1 << 30) -> Iterator[None]:
    """Inside of it, waiting ends in an alarm, and memory beyond what is taken now in a MemoryError."""

    def late(*_: Any) -> None:
        raise AssertionError("it waits")

    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    former_handler, memory = (
        signal.signal(signal.SIGALRM, late),
        resource.getrlimit(resource.RLIMIT_AS),
    )
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + additional, memory[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, memory)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former_handler)


def special(path: Path, kind: str) -> Path:
    """A pipe that nobody writes into, or a link to a device that never ends, in the place of a file."""
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    return path


SPECIAL = pytest.mark.parametrize("kind", ["pipe", "device"])


def write_text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def write_json(path: Path, data: Any) -> Path:
    return write_text(path, json.dumps(data))
