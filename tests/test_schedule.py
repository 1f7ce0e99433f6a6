"""Switches while the robot walks: continuous feet and servos, derivatives, walks without a fall, files and refusals."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.control.schedule import MOST, Switch, scheduled
from nermo_mjx.robot import ParameterError
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.robot.parameters import Sensors
from nermo_mjx.runtime import compiler_options

FREQUENCY, AT = 0.8, 2.0
GAITS = ("trt", "trt1", "lat")
PAIRS = list(itertools.permutations(GAITS, 2))
SPINES = ("none", "stride_extension", "balance")
#: Parts of a gait cycle by which a switch is later.
PHASES = np.arange(20) / 20


def feet(setup: Setup, phases: np.ndarray, rate: float, seconds: float) -> tuple[np.ndarray, ...]:
    """Commanded feet (phases, ticks, 4, 2), planned contact, and servo angles, at a control rate [Hz], of a robot at
    rest."""
    import dataclasses

    made, robot = setup.make_controller(), setup.load()
    controller = dataclasses.replace(made, control_rate=rate, pilot_rate=rate)
    world = setup.world({"frequency": FREQUENCY})
    with jax.enable_x64(True):
        control, schedule = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (world.control, world.schedule))
        sensors = jax.tree.map(jnp.asarray, robot.sensors(robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0))))

        def walk(phase):
            moved = dataclasses.replace(schedule, at=schedule.at.at[0].add(phase / FREQUENCY))

            def tick(state, _):
                own = scheduled(control, moved, state.time, FREQUENCY)
                state, servos = controller.update(own, state, sensors)
                return state, (state.foot, state.stance, servos.vector(robot.servos))

            first = controller.init(scheduled(control, moved, 0.0, FREQUENCY), sensors)
            return jax.lax.scan(tick, first, None, length=round(rate * seconds))[1]

        return tuple(map(np.asarray, jax.jit(jax.vmap(walk), compiler_options=compiler_options())(phases)))
