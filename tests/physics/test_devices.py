# Tests of physics/engine.py, physics/mjx_engine.py
"""A batch is divided among all local devices, gives the same results as on one, and no device waits for another."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jaxlib import xla_client

from nermo_mjx.physics import engine
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.engine import FIRST_AXIS, NO_AXIS, SECOND_AXIS, choose_devices
from nermo_mjx.robot import ParameterError


def test_one_device_divides_nothing():
    """Where there is one device, a function stays as it is and arrays keep their length."""
    devices = choose_devices(1)
    assert (devices.mesh, devices.count, devices.padded(5)) == (None, 1, 5)
    assert devices.divide(len, (FIRST_AXIS, SECOND_AXIS), NO_AXIS) is len
    assert devices.put([np.ones((5, 2))])[0].shape == (5, 2)


@pytest.mark.parametrize("value", ["0", "many", "1.0", "100"])
def test_so_is_one_in_the_environment(monkeypatch, value):
    monkeypatch.setenv("NERMO_MJX_DEVICES", value)
    with pytest.raises(ParameterError, match=f"NERMO_MJX_DEVICES is {value}: allowed is 1 to"):
        choose_devices()
    assert choose_devices(1).count == 1, "an argument comes first"


def test_batches_are_limited_on_a_cpu_only(monkeypatch):
    """The hang from which the limit keeps is one of JAX's CPU runtime."""
    monkeypatch.setattr(engine, "cpu_batch_limit", lambda: 32)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert engine.batch_limit() == 32
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert engine.batch_limit() is None


FOUR = """
import dataclasses, json, re, sys
import nermo_mjx, jax, numpy as np
sys.path.insert(0, {tests!r})
from fakes.swinging import SwayLoop, batch, robot
from nermo_mjx.physics.engine import Devices
from nermo_mjx.physics.mjx_engine import MjxEngine

def walk(engine):
    session = engine.open(*batch(5))
    session.advance(20)
    state = jax.device_get(session.loop_state)
    return session, (state, dataclasses.astuple(session.record(10)))

def collectives(engine, session):
    program = engine.advance.lower(session.params, session.fields, session.carry, jax.numpy.int32(1)).compile()
    return sorted(set(re.findall("all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter",
                                 program.as_text())))

about = {{}}
one, four = (MjxEngine(robot(), SwayLoop(), devices=count) for count in (1, None))
_, alone = walk(one)
session, together = walk(four)
about["devices"] = [one.devices.count, four.devices.count]
about["spread"] = len(session.carry.physics.qpos.sharding.device_set)
about["shapes"] = [list(leaf.shape) for leaf in jax.tree.leaves(together)]
about["expected"] = [list(leaf.shape) for leaf in jax.tree.leaves(alone)]
about["moved"] = float(np.ptp(alone[1][0], axis=1).min())
# Of large numbers, an acceleration of 200 m/s^2, rounding alone is 1e-5.
about["difference"] = max(float((np.abs(a - b) / (1.0 + np.abs(a))).max(initial=0.0)) for a, b in
                          zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True))
about["collectives"] = collectives(four, session)

# What the division is for: left to JAX, all devices agree on the end of every loop.
Devices.divide = lambda self, function, arguments, results: function
automatic = MjxEngine(robot(), SwayLoop(), devices=4)
about["left to jax"] = collectives(automatic, session)
print(json.dumps(about))
"""


@pytest.fixture(scope="module")
def four_devices(tmp_path_factory) -> dict[str, Any]:
    """Output of a process with four devices for five worlds."""
    settings = ("JAX_", "PJRT_", "NERMO_", "XLA_")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(settings)}
    environment["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    )
    environment["NERMO_MJX_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    script = FOUR.format(tests=str(Path(__file__).parents[1]))
    process = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=540
    )
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout)


@pytest.mark.long
@pytest.mark.release
def test_four_devices_give_what_one_gives(four_devices):
    """Five worlds on four devices: the loop's state and the recording have five, with the numbers of one device."""
    assert four_devices["devices"] == [1, 4]
    assert four_devices["spread"] == 4
    assert four_devices["shapes"] == four_devices["expected"]
    assert {shape[0] for shape in four_devices["shapes"]} == {5}
    assert four_devices["moved"] > 0.01
    assert four_devices["difference"] < 1e-5


@pytest.mark.release
def test_no_device_waits_for_another(four_devices):
    """The program holds no communication; left to JAX's automatic partition it would."""
    assert four_devices["collectives"] == []
    assert "all-reduce" in four_devices["left to jax"]


@pytest.mark.release
def test_the_controller_of_c_runs_on_a_processor_beside_an_accelerator(simulator, monkeypatch):
    """Another CPU client stands for the processor of a machine on which JAX computes on an accelerator."""
    sim = simulator()
    batch = sim.prepare({"frequency": np.linspace(0.6, 1.0, 3)})
    other_session = CEngine(sim.robot, sim.loop).open(batch.params, batch.qpos, batch.fields)
    processor = xla_client.make_cpu_client(asynchronous=False).local_devices()[0]
    with monkeypatch.context() as machine:
        machine.setattr(jax, "default_backend", lambda: "gpu")
        machine.setattr(
            jax,
            "local_devices",
            lambda backend=None: [processor] if backend == "cpu" else jax.devices(),
        )
        session = CEngine(sim.robot, sim.loop).open(batch.params, batch.qpos, batch.fields)
        for engine_session in (other_session, session):
            engine_session.advance(3)
    assert session.arguments[2].devices() == {processor}
    np.testing.assert_array_equal(session.qpos, other_session.qpos)
    assert jax.numpy.zeros(1).devices() != {processor}
