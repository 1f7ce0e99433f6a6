"""Controller and metrics, joined: the loop between ticks of physics in one world. Pure; the same in every engine."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Container
from typing import Any, Final, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.controller import Controller, canonical, with_dtypes_of
from nermo_mjx.control.protocol import (
    ActsUpon,
    ControllerLike,
    FollowsPath,
    PlansContact,
    named_place,
    seeing,
    user_code,
)
from nermo_mjx.control.schedule import Schedule, scheduled
from nermo_mjx.robot import ParameterError, Robot, Sensors, ServoAngles
from nermo_mjx.robot.model_parameters import Servo
from nermo_mjx.robot.terrains import TerrainShape
from nermo_mjx.rollout import metrics, transitions
from nermo_mjx.rollout.custom_metrics import OwnMetric, check_metrics, described
from nermo_mjx.rollout.setup import Setup, Start, Window, WorldParameters
from nermo_mjx.runtime import start_jax
from nermo_mjx.shapes import Array, Count, Scalar

#: An angle that is this much beyond a servo's range is within it [rad].
ANGLE_ROUNDING_RAD: Final = 1e-6
#: How long a push lasts [s].
PUSH_SECONDS: Final = 0.1


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pushes:
    """Horizontal pushes of the torso in one world: one in each interval, at a random moment in a random direction.

    Attributes:
        force: of each [N].
        interval: [s], at least as long as a push.
        seed: of moments and directions, a whole number below 2^24.
    """

    force: Any
    interval: Any
    seed: Any

    def at(self, tick: Count, dt: float) -> Float[Array, " xy"]:
        """The force in a control tick, along the world's x and y [N]."""
        lasts = max(1, round(PUSH_SECONDS / dt))
        period = jnp.maximum(jnp.round(self.interval / dt).astype(jnp.int32), lasts)
        key = jax.random.fold_in(jax.random.key(self.seed), tick // period)
        moment, turn = jax.random.uniform(key, (2,))
        since = tick % period - jnp.floor(moment * (period - lasts + 1)).astype(jnp.int32)
        force = jnp.where((since >= 0) & (since < lasts), self.force, 0.0)
        return force * jnp.stack([jnp.cos(2.0 * jnp.pi * turn), jnp.sin(2.0 * jnp.pi * turn)])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopParameters:
    """Parameters of one world's loop.

    Attributes:
        control: of the controller.
        start, window: of the run.
        servo: parameters of the servos.
        terrain: shape of the ground, in a scene that has one; None for the compiled ground.
        servo_brake: of the servos by their back-EMF [N m s/rad]; None unless it is named.
        schedule: what changes of `control` while the robot walks; None for nothing.
        push: who pushes the robot; None for nobody.
    """

    control: Any
    start: Start
    window: Window
    servo: Servo
    terrain: TerrainShape | None = None
    servo_brake: Any = None
    schedule: Schedule | None = None
    push: Pushes | None = None


def loop_parameters(
    robot: Robot, world: WorldParameters, window: Window, named: Container[str]
) -> LoopParameters:
    """Parameters of the loop of worlds, measured in the window; `named` are those that are not the robot's defaults."""
    servo = world.model.servo
    brake = servo.brake if "servo.back_emf" in named else None
    terrain = terrain_of(robot, world)
    return LoopParameters(world.control, world.start, window, servo, terrain, brake, world.schedule)


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
        ctrl: the servos' targets, within their ranges [rad].
        clamped: 1 if the controller asked for an angle beyond a servo's range in this tick, else 0.
    """

    tick: Count
    time: Scalar
    control: Any
    metrics: metrics.MetricState
    ctrl: Float[Array, " n_servos"]
    clamped: Scalar


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
        control_params = self.control_at(params, 0.0)
        control = canonical(self._seeing(params).init(control_params, sensors, params.start.phase))
        servo = self.controller.initial_servo(control_params, params.start.phase).vector(
            self.robot.servos
        )
        servo = self._within_range(params, servo)
        first, now = jnp.zeros((), jnp.int32), jnp.zeros(())
        return LoopState(
            first,
            now,
            control,
            metrics.init(sensors, self.own, params.schedule is not None),
            servo.astype(now.dtype),
            now,
        )

    def step(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> tuple[LoopState, Float[Array, " ctrl"]]:
        """See `Loop.step`. Metrics get the tick that has just ended, the controller its last reading."""
        measured = self.measure(params, state, sensordata)
        controller, control_params = self._seeing(params), self.control_at(params, state.time)
        control, servo = controller.update(
            control_params, state.control, self.last_reading(measured, sensordata)
        )
        reach = params.servo.top_speed * controller.dt
        commanded = servo.vector(self.robot.servos)
        target = self._within_range(params, commanded)
        ctrl = state.ctrl + jnp.clip(target - state.ctrl, -reach, reach)
        tick = state.tick + 1
        clamped = jnp.any(jnp.abs(commanded - target) > ANGLE_ROUNDING_RAD).astype(ctrl.dtype)
        next_state = LoopState(
            tick,
            tick * controller.dt,
            with_dtypes_of(state.control, control),
            measured,
            ctrl,
            clamped,
        )
        if params.push is not None:
            ctrl = jnp.concatenate(
                [ctrl, params.push.at(state.tick, controller.dt).astype(ctrl.dtype)]
            )
        return with_dtypes_of(state, next_state), ctrl

    def control_at(self, params: LoopParameters, time: Scalar | float) -> Any:
        """The controller's parameters at a time [s]."""
        rate = self.controller.cycle_rate(params.control) if params.schedule is not None else None
        return scheduled(params.control, params.schedule, time, rate)

    def _seeing(self, params: LoopParameters) -> Any:
        """The controller over the ground of this world."""
        ground = functools.partial(self.robot.terrain.height, shape=params.terrain)
        return seeing(self.controller, ground)

    def _within_range(
        self, params: LoopParameters, angles: Float[Array, " n_servos"]
    ) -> Float[Array, " n_servos"]:
        low, high = jnp.asarray(self.robot.model.actuator_ctrlrange.T, angles.dtype)
        knee_margin = params.servo.knee_range * np.array(
            [name.endswith("_knee") for name in self.robot.servos]
        )
        return jnp.clip(angles, low - knee_margin, high + knee_margin)

    def measure(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> metrics.MetricState:
        """The metrics updated with the tick that has just ended."""
        sensors = self.robot.sensors(sensordata)
        controller, control_params = self.controller, self.control_at(params, state.time)
        path, stance = None, None
        position = jnp.where(jnp.isfinite(sensors.position[-1]), sensors.position[-1], 0.0)
        if isinstance(controller, FollowsPath):
            path = controller.path(control_params, state.control, position)
        if isinstance(controller, PlansContact):
            stance = controller.stance(state.control)
        is_in_range = None
        if params.schedule is not None:
            is_in_range = transitions.span(params.schedule, controller.cycle_rate(params.control))
        tick = metrics.Tick(
            sensors=sensors,
            time=state.time,
            dt=controller.dt,
            cycle_rate=controller.cycle_rate(control_params),
            path=path,
            stance=stance,
            ground=self.robot.terrain.height(position[0], position[1], params.terrain),
            brake=params.servo_brake,
            servo=params.servo,
            clamped=state.clamped,
            transition=is_in_range,
        )
        return metrics.update(params.window, state.metrics, tick, self.own)

    def last_reading(
        self, measured: metrics.MetricState, sensordata: Float[Array, "steps n"]
    ) -> Sensors:
        """The readings that a controller receives for a tick.

        A diverged world continues with readings of zero, so that nothing non-finite enters the controller.
        """
        sensors = self.robot.sensors(sensordata)
        return jax.tree.map(
            lambda leaf: jnp.where(measured.lost | ~jnp.isfinite(leaf[-1]), 0.0, leaf[-1]), sensors
        )


# Long because each part of the protocol is checked in its order.
def check_controller(robot: Robot, controller: ControllerLike) -> None:
    """Reject a controller whose functions fail, do not fit together, or give no finite numbers for a robot at rest.

    Raises:
        ParameterError: names the function, its file and line, and what is wrong.
    """
    if isinstance(controller, Controller):
        return  # its parts are checked by its tests, and tracing it takes half a second
    controller = seeing(controller, robot.terrain.height)
    readings = jax.eval_shape(
        robot.sensors, jax.ShapeDtypeStruct((robot.model.nsensordata,), jnp.zeros(()).dtype)
    )
    phase = jax.ShapeDtypeStruct((), jnp.zeros(()).dtype)
    params = controller.parameters

    def traced(
        name: str, *arguments: Any, settle: Callable[[Any], Any] = lambda traced_value: traced_value
    ) -> Any:
        with user_code(f"{named_place(controller, name)}, which fails"):
            return jax.eval_shape(
                lambda *args: settle(getattr(controller, name)(*args)), *arguments
            )

    def refuse(name: str, why: str) -> NoReturn:
        raise ParameterError(f"{named_place(controller, name)}, which {why}.")

    first = traced("init", params, readings, phase, settle=canonical)
    servo, rate = traced("initial_servo", params, phase), traced("cycle_rate", params)
    traced_value = traced("update", params, first, readings)
    if not isinstance(traced_value, tuple) or len(traced_value) != 2:
        refuse(
            "update",
            f"gives {described(traced_value)}: expected two, the next state and ServoAngles",
        )
    next_state, now = traced_value
    forms = [str(jax.tree.structure(state)) for state in (first, next_state)]
    shapes = [[leaf.shape for leaf in jax.tree.leaves(state)] for state in (first, next_state)]
    if forms[0] != forms[1] or shapes[0] != shapes[1]:
        refuse(
            "update",
            f"makes a state of {forms[1]} with shapes {shapes[1]}: expected the form that init gives it, "
            f"{forms[0]} with shapes {shapes[0]}",
        )
    for (path, old), new in zip(
        jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(next_state), strict=True
    ):
        if old.dtype != new.dtype and not np.can_cast(new.dtype, old.dtype, "same_kind"):
            refuse(
                "update",
                f"makes {new.dtype} of the state{jax.tree_util.keystr(path)}, which init begins as "
                f"{old.dtype}: each tick would lose what {old.dtype} cannot hold; begin it as "
                f"{new.dtype}",
            )
    for name, angles in (("initial_servo", servo), ("update", now)):
        if not isinstance(angles, ServoAngles):
            refuse(
                name,
                f"gives {described(angles)}: expected ServoAngles with four hips and four knees",
            )
        for part in dataclasses.fields(angles):
            angle, shape = getattr(angles, part.name), (4,) if part.name in ("hip", "knee") else ()
            if getattr(angle, "shape", None) != shape or np.dtype(angle.dtype).kind not in "fi":
                message = f"gives ServoAngles whose {part.name} is {described(angle)}"
                refuse(name, f"{message}: expected real numbers of shape {shape}")
    if getattr(rate, "shape", None) != ():
        refuse(
            "cycle_rate",
            f"gives {described(rate)}: expected one number, the gait cycles per second",
        )
    stance = traced("stance", first) if isinstance(controller, PlansContact) else jnp.ones(4, bool)
    if getattr(stance, "shape", None) != (4,):
        refuse("stance", f"gives {described(stance)}: expected the planned contact of four limbs")
    # A policy of this package takes seconds to compile.
    if not type(controller).__module__.startswith("nermo_mjx."):
        _check_at_rest(robot, controller)


def _check_at_rest(robot: Robot, controller: ControllerLike) -> None:
    """Reject servo angles and a state that are not finite numbers for a robot at rest."""

    def start(params: Any, reading: Array) -> Any:
        sensors, phase = robot.sensors(reading), jnp.zeros(())
        state = canonical(controller.init(params, sensors, phase))
        return {
            "cycle_rate": controller.cycle_rate(params),
            "init": state,
            "initial_servo": controller.initial_servo(params, phase),
            "update": controller.update(params, state, sensors),
        }

    start_jax()
    with jax.ensure_compile_time_eval():
        reading = robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0))
    with user_code("controller fails"):
        initial = jax.jit(start)(controller.parameters, reading)
    for name, several in initial.items():
        for leaf in jax.tree.leaves(several):
            if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
                raise ParameterError(
                    f"{named_place(controller, name)}, which gives {np.asarray(leaf).tolist()} for a robot at rest: "
                    "expected finite numbers; guard it, as by jnp.where."
                )


def checked_loop(setup: Setup) -> ClosedLoop:
    """The loop of a setup, whose own controller and metrics have been checked; warns of a policy that was judged in
    another physics.

    Raises:
        ParameterError: see `check_controller` and `check_metrics`; its first word is the setup's field.
    """
    loop = ClosedLoop(setup.load(), setup.make_controller(), setup.own_metrics)
    check_controller(loop.robot, loop.controller)
    check_metrics(loop.robot.config, loop.own)
    if isinstance(loop.controller, ActsUpon) and (
        why := loop.controller.elsewhere(setup.physics, setup.timestep)
    ):
        warnings.warn(why, stacklevel=3)
    return loop


def check_code(setup: Setup) -> None:
    """Reject a setup's own controller or metrics, before anything is simulated; see `checked_loop`."""
    if setup.controller is not None or setup.metrics:
        checked_loop(setup)
