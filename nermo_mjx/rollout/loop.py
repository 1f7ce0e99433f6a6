"""`ClosedLoop` joins a controller and the metrics: an engine calls it between the control ticks of one world.

All functions of the loop are pure, so that every engine runs the same code. A control tick is one update of the
controller, and lasts for several physics steps.
"""

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

#: Tolerance for rounding: a command that exceeds a servo's range by less does not count as clamped [rad].
ANGLE_ROUNDING_RAD: Final = 1e-6
#: Duration of a push [s].
PUSH_SECONDS: Final = 0.1


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pushes:
    """Horizontal pushes of the torso in one world: one push in each interval, at a random time in a random direction.

    Attributes:
        force: Force of a push [N].
        interval: Length of an interval [s], at least as long as a push.
        seed: Seed of the random times and directions, a whole number below 2^24.
    """

    force: Any
    interval: Any
    seed: Any

    def at(self, tick: Count, dt: float) -> Float[Array, " xy"]:
        """The force in control tick number `tick`, of `dt` seconds, along the world's x and y [N]."""
        push_ticks = max(1, round(PUSH_SECONDS / dt))
        interval_ticks = jnp.maximum(jnp.round(self.interval / dt).astype(jnp.int32), push_ticks)
        key = jax.random.fold_in(jax.random.key(self.seed), tick // interval_ticks)
        # Two samples from [0, 1): when in the interval the push begins, and its direction as a fraction of a turn.
        delay, turn = jax.random.uniform(key, (2,))
        begin = jnp.floor(delay * (interval_ticks - push_ticks + 1)).astype(jnp.int32)
        elapsed = tick % interval_ticks - begin
        force = jnp.where((elapsed >= 0) & (elapsed < push_ticks), self.force, 0.0)
        return force * jnp.stack([jnp.cos(2.0 * jnp.pi * turn), jnp.sin(2.0 * jnp.pi * turn)])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopParameters:
    """Parameters of one world's loop.

    Attributes:
        control: Parameters of the controller.
        start: Position, heading and gait phase at the start of the run.
        window: Time in which metrics are measured.
        servo: Parameters of the servos.
        terrain: Shape of the ground in a scene whose ground has parameters; None for the compiled ground.
        servo_brake: Braking of the servos by their back-EMF [N m s/rad]; None if the caller did not set `servo.back_emf`.
        schedule: Changes of `control` while the robot walks; None if `control` is constant.
        push: Pushes of the torso; None without pushes.
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
    robot: Robot, world: WorldParameters, window: Window, set_names: Container[str]
) -> LoopParameters:
    """Parameters of the loop, from the parameters of the world.

    Args:
        robot: Robot that walks.
        world: Parameters of one world, or of a batch.
        window: Time in which metrics are measured.
        set_names: Names of the parameters that the caller has set; all others have the robot's default values.
    """
    servo = world.model.servo
    brake = servo.brake if "servo.back_emf" in set_names else None
    terrain = terrain_of(robot, world)
    return LoopParameters(world.control, world.start, window, servo, terrain, brake, world.schedule)


def terrain_of(robot: Robot, world: WorldParameters) -> TerrainShape | None:
    """Shape of the ground; None in a scene whose ground has no parameters."""
    return world.model.terrain if robot.terrain.has_shape else None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopState:
    """The loop's state in one world.

    Attributes:
        tick: Number of control ticks since the start.
        time: Simulated time since the start [s].
        control: State of the controller.
        metrics: Accumulators of the metrics.
        ctrl: Target angles of the servos, within their ranges and their speed [rad].
        clamped: 1 if the controller commanded an angle beyond a servo's range in this tick, else 0.
    """

    tick: Count
    time: Scalar
    control: Any
    metrics: metrics.MetricState
    ctrl: Float[Array, " n_servos"]
    clamped: Scalar


@dataclasses.dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Implements `physics.engine.Loop` for a robot and a controller, with built-in and custom metrics.

    Attributes:
        robot: Robot, with its model and its sensors.
        controller: Controller, the published one or any other.
        custom_metrics: Metrics of the user, in addition to the built-in ones.
    """

    robot: Robot
    controller: ControllerLike
    custom_metrics: tuple[OwnMetric, ...] = ()

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""
        return round(self.controller.dt / self.robot.config.timestep)

    def init(self, params: LoopParameters, sensordata: Float[Array, " n"]) -> LoopState:
        """See `Loop.init`."""
        sensors = self.robot.sensors(sensordata)
        control_params = self.control_at(params, 0.0)
        controller = self._controller_on_ground(params)
        control = canonical(controller.init(control_params, sensors, params.start.phase))
        servo = self.controller.initial_servo(control_params, params.start.phase).vector(
            self.robot.servos
        )
        servo = self._within_range(params, servo)
        zero = jnp.zeros(())
        return LoopState(
            tick=jnp.zeros((), jnp.int32),
            time=zero,
            control=control,
            metrics=metrics.init(sensors, self.custom_metrics, params.schedule is not None),
            ctrl=servo.astype(zero.dtype),
            clamped=zero,
        )

    def step(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> tuple[LoopState, Float[Array, " ctrl"]]:
        """See `Loop.step`. The metrics use all readings of the tick that has just ended, the controller the last one."""
        metric_state = self.measure(params, state, sensordata)
        controller = self._controller_on_ground(params)
        control_params = self.control_at(params, state.time)
        control, servo = controller.update(
            control_params, state.control, self.last_reading(metric_state, sensordata)
        )
        # The target of a servo moves no faster than the servo can turn.
        largest_move = params.servo.top_speed * controller.dt
        commanded = servo.vector(self.robot.servos)
        target = self._within_range(params, commanded)
        ctrl = state.ctrl + jnp.clip(target - state.ctrl, -largest_move, largest_move)
        tick = state.tick + 1
        clamped = jnp.any(jnp.abs(commanded - target) > ANGLE_ROUNDING_RAD).astype(ctrl.dtype)
        next_state = LoopState(
            tick=tick,
            time=tick * controller.dt,
            control=with_dtypes_of(state.control, control),
            metrics=metric_state,
            ctrl=ctrl,
            clamped=clamped,
        )
        if params.push is not None:
            # The force on the torso follows the servos' targets, see `Loop.step`.
            ctrl = jnp.concatenate(
                [ctrl, params.push.at(state.tick, controller.dt).astype(ctrl.dtype)]
            )
        return with_dtypes_of(state, next_state), ctrl

    def control_at(self, params: LoopParameters, time: Scalar | float) -> Any:
        """The controller's parameters at a time since the start [s]; only a schedule changes them."""
        rate = self.controller.cycle_rate(params.control) if params.schedule is not None else None
        return scheduled(params.control, params.schedule, time, rate)

    def _controller_on_ground(self, params: LoopParameters) -> Any:
        """The controller, which observes the ground of this world if it can (`SeesGround`)."""
        ground = functools.partial(self.robot.terrain.height, shape=params.terrain)
        return seeing(self.controller, ground)

    def _within_range(
        self, params: LoopParameters, angles: Float[Array, " n_servos"]
    ) -> Float[Array, " n_servos"]:
        """Angles clipped to the ranges of the servos; `servo.knee_range` widens the ranges of the knees [rad]."""
        low, high = jnp.asarray(self.robot.model.actuator_ctrlrange.T, angles.dtype)
        knee_margin = params.servo.knee_range * np.array(
            [name.endswith("_knee") for name in self.robot.servos]
        )
        return jnp.clip(angles, low - knee_margin, high + knee_margin)

    def measure(
        self, params: LoopParameters, state: LoopState, sensordata: Float[Array, "steps n"]
    ) -> metrics.MetricState:
        """State of the metrics, updated with the tick that has just ended."""
        sensors = self.robot.sensors(sensordata)
        controller, control_params = self.controller, self.control_at(params, state.time)
        path, stance = None, None
        # The position of a diverged world is not finite.
        position = jnp.where(jnp.isfinite(sensors.position[-1]), sensors.position[-1], 0.0)
        if isinstance(controller, FollowsPath):
            path = controller.path(control_params, state.control, position)
        if isinstance(controller, PlansContact):
            stance = controller.stance(state.control)
        transition_times = None
        if params.schedule is not None:
            cycle_rate = controller.cycle_rate(params.control)
            transition_times = transitions.span(params.schedule, cycle_rate)
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
            transition=transition_times,
        )
        return metrics.update(params.window, state.metrics, tick, self.custom_metrics)

    def last_reading(
        self, metric_state: metrics.MetricState, sensordata: Float[Array, "steps n"]
    ) -> Sensors:
        """The readings that a controller receives for a tick.

        A diverged world (`metric_state.lost`) continues with readings of zero, so that every value that the controller
        receives is finite.
        """
        sensors = self.robot.sensors(sensordata)
        is_lost = metric_state.lost
        return jax.tree.map(
            lambda leaf: jnp.where(is_lost | ~jnp.isfinite(leaf[-1]), 0.0, leaf[-1]), sensors
        )


# Long because each function of the protocol is checked in turn.
def check_controller(robot: Robot, controller: ControllerLike) -> None:
    """Reject a controller whose functions fail, do not fit together, or return non-finite numbers for a robot at rest.

    The functions are traced with abstract arrays, so that only shapes and types are computed.

    Raises:
        ParameterError: The message names the function, its file and line, and the fault.
    """
    if isinstance(controller, Controller):
        return  # the tests check the published controller, and tracing it takes half a second
    controller = seeing(controller, robot.terrain.height)
    readings = jax.eval_shape(
        robot.sensors, jax.ShapeDtypeStruct((robot.model.nsensordata,), jnp.zeros(()).dtype)
    )
    phase = jax.ShapeDtypeStruct((), jnp.zeros(()).dtype)
    params = controller.parameters

    def trace(
        name: str, *arguments: Any, convert: Callable[[Any], Any] = lambda result: result
    ) -> Any:
        """Shapes and types of the result of a function of the controller; `convert` is applied to this result."""
        with user_code(f"{named_place(controller, name)}, which fails"):
            return jax.eval_shape(
                lambda *args: convert(getattr(controller, name)(*args)), *arguments
            )

    def refuse(name: str, why: str) -> NoReturn:
        raise ParameterError(f"{named_place(controller, name)}, which {why}.")

    initial_state = trace("init", params, readings, phase, convert=canonical)
    initial_servo = trace("initial_servo", params, phase)
    cycle_rate = trace("cycle_rate", params)
    result = trace("update", params, initial_state, readings)
    if not isinstance(result, tuple) or len(result) != 2:
        refuse(
            "update",
            f"gives {described(result)}: expected two, the next state and ServoAngles",
        )
    next_state, servo = result
    states = (initial_state, next_state)
    forms = [str(jax.tree.structure(state)) for state in states]
    shapes = [[leaf.shape for leaf in jax.tree.leaves(state)] for state in states]
    if forms[0] != forms[1] or shapes[0] != shapes[1]:
        refuse(
            "update",
            f"makes a state of {forms[1]} with shapes {shapes[1]}: expected the form that init gives it, "
            f"{forms[0]} with shapes {shapes[0]}",
        )
    for (path, old), new in zip(
        jax.tree_util.tree_leaves_with_path(initial_state),
        jax.tree.leaves(next_state),
        strict=True,
    ):
        if old.dtype != new.dtype and not np.can_cast(new.dtype, old.dtype, "same_kind"):
            refuse(
                "update",
                f"makes {new.dtype} of the state{jax.tree_util.keystr(path)}, which init begins as "
                f"{old.dtype}: each tick would lose what {old.dtype} cannot hold; begin it as "
                f"{new.dtype}",
            )
    for name, angles in (("initial_servo", initial_servo), ("update", servo)):
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
    if getattr(cycle_rate, "shape", None) != ():
        refuse(
            "cycle_rate",
            f"gives {described(cycle_rate)}: expected one number, the gait cycles per second",
        )
    if isinstance(controller, PlansContact):
        stance = trace("stance", initial_state)
        if getattr(stance, "shape", None) != (4,):
            refuse(
                "stance", f"gives {described(stance)}: expected the planned contact of four limbs"
            )
    # A policy of this package is trusted, because compiling it takes seconds.
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
        results = jax.jit(start)(controller.parameters, reading)
    for name, result in results.items():
        for leaf in jax.tree.leaves(result):
            if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
                raise ParameterError(
                    f"{named_place(controller, name)}, which gives {np.asarray(leaf).tolist()} for a robot at rest: "
                    "expected finite numbers; guard it, as by jnp.where."
                )


def checked_loop(setup: Setup) -> ClosedLoop:
    """The loop of a setup, after a check of its controller and of its custom metrics.

    Warns if the controller is a policy that was evaluated with another physics or time step.

    Raises:
        ParameterError: See `check_controller` and `check_metrics`; the message begins with the field of the setup.
    """
    loop = ClosedLoop(setup.load(), setup.make_controller(), setup.own_metrics)
    check_controller(loop.robot, loop.controller)
    check_metrics(loop.robot.config, loop.custom_metrics)
    if isinstance(loop.controller, ActsUpon) and (
        warning := loop.controller.elsewhere(setup.physics, setup.timestep)
    ):
        warnings.warn(warning, stacklevel=3)
    return loop


def check_code(setup: Setup) -> None:
    """Check a custom controller and custom metrics before anything is simulated; see `checked_loop`."""
    if setup.controller is not None or setup.metrics:
        checked_loop(setup)
