"""A small machine for tests of the engines: a driven pendulum that brushes the ground and has an end stop."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from nermo_mjx import Robot, load_robot

XML = """
<mujoco>
  <option timestep="0.002" cone="elliptic" iterations="20"/>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
    <body pos="0 0 0.25">
      <joint name="swing" axis="0 1 0" damping="0.01" range="-0.5 0.5" limited="true"/>
      <geom name="bob" type="sphere" pos="0 0 -0.24" size="0.02" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact><pair geom1="ground" geom2="bob" condim="3"/></contact>
  <actuator><position joint="swing" kp="0.5"/></actuator>
  <sensor><jointpos joint="swing"/><jointvel joint="swing"/></sensor>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class SwayLoop:
    """Drives the pendulum to and fro and adds up what it reads; see `physics.engine.Loop`."""

    steps_per_tick: int = 3

    def init(self, params: Any, sensordata: Any) -> Any:
        """(ticks so far, sum of readings)."""
        return jnp.zeros(()), sensordata

    def step(self, params: Any, state: Any, sensordata: Any) -> Any:
        """See `Loop.step`."""
        tick, total = state
        return (tick + 1.0, total + sensordata.mean(axis=0)), jnp.sin(params * tick)[None]


def robot() -> Robot:
    """A robot whose models are the machine's: all that the engines need of one."""
    robot_with_model, model = load_robot(), mujoco.MjModel.from_xml_string(XML)
    vars(robot_with_model).update(model=model, physical=model)
    return robot_with_model


def batch(worlds: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Arguments of `Engine.open`: every world with its own drive, start and damping."""
    share = np.linspace(0.0, 1.0, worlds)
    params = np.asarray(0.1 + 0.2 * share, np.float32)
    return params, 0.45 - 0.3 * share[:, None], {"dof_damping": 0.005 + 0.02 * share[:, None]}
