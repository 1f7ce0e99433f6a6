"""What runs between ticks of physics in one world: controller and metrics, joined. Pure; the same in every engine."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nermo_mjx.control.controller import Controller, ControllerState
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.pilot import FOLLOWERS
from nermo_mjx.robot import Robot
from nermo_mjx.rollout import metrics
from nermo_mjx.rollout.parameters import Start, Window


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopParameters:
    """Parameters of one world's loop; `servo_speed` is how fast a servo's target may change [rad/s]."""

    control: ControlParameters
    start: Start
    window: Window
    servo_speed: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopState:
    """What the loop carries from tick to tick in one world; `ctrl` is what the servos aim at [rad]."""

    control: ControllerState
    metrics: metrics.MetricState
    ctrl: Float[Array, " n_servos"]


@dataclasses.dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Implements `physics.engine.Loop` for a robot and a controller."""

    robot: Robot
    controller: Controller

    @property
    def steps_per_tick(self) -> int:
        """Physics steps in a control tick."""
        return round(self.controller.dt / self.robot.config.timestep)

    def init(self, params: LoopParameters, sensordata: Float[Array, " n"]) -> LoopState:
        """See `Loop.init`."""
        sensors = self.robot.sensors(sensordata)
        control = self.controller.init(params.control, sensors, params.start.phase)
        servo = self.controller.servo_angles(control)
        return LoopState(control, metrics.init(sensors), servo.vector(self.robot.n_servos))

    def step(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> tuple[LoopState, Float[Array, " n_servos"]]:
        """See `Loop.step`. Metrics see the tick that has just ended, the controller its last reading."""
        sensors = self.robot.sensors(sensordata)
        cycle_rate = params.control.gait.frequency / params.control.tracking.clock_ratio
        path = None
        position = jnp.where(jnp.isfinite(sensors.position[-1]), sensors.position[-1], 0.0)
        if self.controller.pilot in FOLLOWERS:
            path = self.controller.locate(params.control, position, state.control.path_point.progress)
        measured = metrics.update(
            params.window, state.metrics, sensors, state.control.time, self.controller.dt, cycle_rate, path,
            state.control.stance, self.robot.terrain.height(position[0], position[1]),
        )  # fmt: skip
        # A world that lost its numbers walks on in place on readings of zero: nothing non-finite enters the controller.
        last = jax.tree.map(lambda leaf: jnp.where(measured.lost, 0.0, leaf[-1]), sensors)
        control, servo = self.controller.update(params.control, state.control, last)
        reach = params.servo_speed * self.controller.dt
        ctrl = state.ctrl + jnp.clip(servo.vector(self.robot.n_servos) - state.ctrl, -reach, reach)
        return LoopState(control, measured, ctrl), ctrl
