"""Controller and metrics, joined: the loop between ticks of physics in one world. Pure; the same in every engine."""

from __future__ import annotations

import dataclasses
from collections.abc import Container
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from nermo_mjx.control.controller import Controller, canonical, with_dtypes_of
from nermo_mjx.control.protocol import ControllerLike, FollowsPath, PlansContact
from nermo_mjx.robot import ParameterError, Robot, Sensors, ServoAngles
from nermo_mjx.robot.terrains import TerrainShape
from nermo_mjx.rollout import metrics
from nermo_mjx.rollout.own_metrics import OwnMetric
from nermo_mjx.rollout.setup import Start, Window, WorldParameters
from nermo_mjx.shapes import Array, Count, Scalar


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopParameters:
    """Parameters of one world's loop.

    Attributes:
        control: of the controller.
        start, window: of the run.
        servo_speed: maximum rate of change of a servo's target [rad/s].
        terrain: shape of the ground, in a scene that has one; None for the compiled ground.
        servo_brake: of the servos by their back-EMF [N m s/rad]; None unless it is named.
    """

    control: Any
    start: Start
    window: Window
    servo_speed: Any
    terrain: TerrainShape | None = None
    servo_brake: Any = None


def loop_parameters(robot: Robot, world: WorldParameters, window: Window, named: Container[str]) -> LoopParameters:
    """Parameters of the loop of worlds.

    Args:
        robot: that runs.
        world: all parameters.
        window: when to measure.
        named: those that are not the robot's defaults.
    """
    servo = world.model.servo
    brake = servo.brake if "servo.back_emf" in named else None
    return LoopParameters(world.control, world.start, window, servo.top_speed, terrain_of(robot, world), brake)


def terrain_of(robot: Robot, world: WorldParameters) -> TerrainShape | None:
    """Shape of the ground; None in a scene that has none."""
    return world.model.terrain if robot.terrain.has_shape else None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopState:
    """The loop's state in one world.

    Attributes:
        tick, time: control ticks, and simulated time [s], since the start.
        control: the controller's state.
        metrics: accumulators.
        ctrl: the servos' targets [rad].
    """

    tick: Count
    time: Scalar
    control: Any
    metrics: metrics.MetricState
    ctrl: Float[Array, " n_servos"]


@dataclasses.dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Implements `physics.engine.Loop` for a robot and a controller, with built-in and custom metrics."""

    robot: Robot
    controller: ControllerLike
    own: tuple[OwnMetric, ...] = ()

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""
        return round(self.controller.dt / self.robot.config.timestep)

    def init(self, params: LoopParameters, sensordata: Float[Array, " n"]) -> LoopState:
        """See `Loop.init`."""
        sensors = self.robot.sensors(sensordata)
        control = canonical(self.controller.init(params.control, sensors, params.start.phase))
        servo = self.controller.initial_servo(params.control, params.start.phase).vector(self.robot.servos)
        first, now = jnp.zeros((), jnp.int32), jnp.zeros(())
        return LoopState(first, now, control, metrics.init(sensors, self.own), servo.astype(now.dtype))

    def step(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> tuple[LoopState, Float[Array, " n_servos"]]:
        """See `Loop.step`. Metrics get the tick that has just ended, the controller its last reading."""
        measured = self.measure(params, state, sensordata)
        controller, own = self.controller, params.control
        control, servo = controller.update(own, state.control, self.last_reading(measured, sensordata))
        reach = params.servo_speed * controller.dt
        ctrl = state.ctrl + jnp.clip(servo.vector(self.robot.servos) - state.ctrl, -reach, reach)
        tick = state.tick + 1
        after = LoopState(tick, tick * controller.dt, with_dtypes_of(state.control, control), measured, ctrl)
        return with_dtypes_of(state, after), ctrl

    def measure(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> metrics.MetricState:
        """The metrics updated with the tick that has just ended."""
        sensors = self.robot.sensors(sensordata)
        controller, own = self.controller, params.control
        path, stance = None, None
        position = jnp.where(jnp.isfinite(sensors.position[-1]), sensors.position[-1], 0.0)
        if isinstance(controller, FollowsPath):
            path = controller.path(own, state.control, position)
        if isinstance(controller, PlansContact):
            stance = controller.stance(state.control)
        return metrics.update(
            params.window, state.metrics, sensors, state.time, controller.dt, controller.cycle_rate(own), path,
            stance, self.robot.terrain.height(position[0], position[1], params.terrain), self.own, params.servo_brake,
        )  # fmt: skip

    def last_reading(self, measured: metrics.MetricState, sensordata: Float[Array, "steps n"]) -> Sensors:
        """The readings that a controller receives for a tick.

        A diverged world continues with readings of zero, so that nothing non-finite enters the controller.
        """
        sensors = self.robot.sensors(sensordata)
        return jax.tree.map(lambda leaf: jnp.where(measured.lost | ~jnp.isfinite(leaf[-1]), 0.0, leaf[-1]), sensors)


def check_controller(robot: Robot, controller: ControllerLike) -> None:
    """Reject a controller whose functions are inconsistent, before anything is compiled.

    Raises:
        ParameterError: its state changes its structure from tick to tick, or it does not return servo angles.
    """
    if isinstance(controller, Controller):
        return  # its parts are checked by its tests, and tracing it takes half a second
    readings = jax.eval_shape(robot.sensors, jax.ShapeDtypeStruct((robot.model.nsensordata,), jnp.zeros(()).dtype))
    phase = jax.ShapeDtypeStruct((), jnp.zeros(()).dtype)
    params = controller.parameters
    first = jax.eval_shape(lambda *given: canonical(controller.init(*given)), params, readings, phase)
    servo = jax.eval_shape(controller.initial_servo, params, phase)
    after, now = jax.eval_shape(controller.update, params, first, readings)
    forms = [str(jax.tree.structure(state)) for state in (first, after)]
    shapes = [[leaf.shape for leaf in jax.tree.leaves(state)] for state in (first, after)]
    if forms[0] != forms[1] or shapes[0] != shapes[1]:
        raise ParameterError(
            f"controller.update makes a state of {forms[1]} with shapes {shapes[1]}: expected the form that init gives "
            f"it, {forms[0]} with shapes {shapes[0]}."
        )
    for name, angles in (("initial_servo", servo), ("update", now)):
        if not isinstance(angles, ServoAngles) or (angles.hip.shape, angles.knee.shape) != ((4,), (4,)):
            raise ParameterError(
                f"controller.{name} gives {type(angles).__name__}: expected ServoAngles with four hips and four knees."
            )
