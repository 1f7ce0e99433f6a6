"""Static choices by name, made before anything compiles: robot, scene, gait, modes."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import jax
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.controller import Controller, published_controller
from nermo_mjx.control.head_and_tail import HeadName, TailMotionName
from nermo_mjx.control.parameters import (
    ControlParameters,
    ProfileName,
    SteeringName,
    author_body,
    body_values,
    control_rate_of,
    published_values,
    robot_choices,
    steering_of,
    with_geometry,
)
from nermo_mjx.control.pilot import Command, PilotName
from nermo_mjx.control.protocol import (
    ActsUpon,
    ChecksParameters,
    CompletesValues,
    ControllerLike,
    check_form,
    load_controller,
    named_place,
    user_code,
)
from nermo_mjx.control.schedule import (
    MAX_SWITCHES,
    MODE_CHOICES,
    Schedule,
    Switch,
    check_schedule,
    schedule_of,
)
from nermo_mjx.control.spine_modes import SAGITTAL_MODES, SpineModes, mode_names
from nermo_mjx.control.stepping import TrajectoryName
from nermo_mjx.robot import GAIT_CODES, ParameterError, Robot, RobotConfig, load_robot
from nermo_mjx.robot.equipment import check_servo, highest_kp, highest_kv
from nermo_mjx.robot.geometry import Geometry, check_geometry, names_geometry
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.model_parameters import ModelParameters, gravity_values
from nermo_mjx.robot.parameters import GaitName, PresetTimestep, ProfileChoice, ProfileRate
from nermo_mjx.robot.quantity import (
    Quantity,
    check_quantities,
    flat,
    group,
    of_type,
    parameter_tree,
    quantities,
    quantity,
    replace_quantities,
    static,
    values_of,
    with_attributes,
)
from nermo_mjx.robot.scene import is_mjcf, load_scene
from nermo_mjx.robot.terrains import scenes_reading, terrain_values
from nermo_mjx.rollout.custom_metrics import OwnMetric, load_metrics
from nermo_mjx.rollout.metric_table import METRICS, RUN_COLUMNS, TRANSITION, Metric

# ---
# Everything that may differ between the worlds of a batch, under one set of names.


@parameter_tree
class Start:
    """Position, heading and gait phase at the start."""

    x: Any = quantity(0.0, "m", -100.0, 100.0, "start to the left of the path")
    y: Any = quantity(0.0, "m", -100.0, 100.0, "start behind the origin")
    yaw: Any = quantity(0.0, "rad", -np.pi, np.pi, "heading at the start, positive to the left")
    phase: Any = quantity(0.0, "1", -1.0, 1.0, "phase of the gait cycle at the start")


@parameter_tree
class Window:
    """When a run is measured; set from `Run`, not by name."""

    begin: Any = quantity(0.0, "s", 0.0, 1e6, "end of the warm-up")
    end: Any = quantity(1e6, "s", 0.0, 1e6, "end of the run")
    distance: Any = quantity(1e6, "m", 0.0, 1e6, "path length after which measuring stops")


@parameter_tree
class WorldParameters:
    """The parameters that a sweep can name: controller, body and start. The parameters of another controller may be any
    pytree."""

    control: Any = flat(ControlParameters)
    model: ModelParameters = flat(ModelParameters)
    start: Start = group(Start)
    schedule: Schedule | None = None


def bounded_by_step(declarations: Mapping[str, Quantity], timestep: float) -> dict[str, Quantity]:
    """The parameters whose range depends on the time step, with their remaining range."""
    contact, kp, kv = (
        declarations[name] for name in ("contact.time_constant", "servo.kp", "servo.kv")
    )
    stiffest = highest_kp(timestep, float(kv.default))  # type: ignore[arg-type]
    most_damped = highest_kv(timestep, float(kp.default))  # type: ignore[arg-type]
    return {
        # MuJoCo silently lengthens time constants shorter than two time steps.
        "contact.time_constant": dataclasses.replace(contact, low=max(contact.low, 2 * timestep)),
        "servo.kp": dataclasses.replace(kp, high=min(kp.high, stiffest)),
        "servo.kv": dataclasses.replace(kv, high=min(kv.high, most_damped)),
    }


# ---
# Checks of a setup's choices and of the names of its controller and metrics; each raises a `ParameterError`.


#: Columns of tables, and keys beside parameters in files: reserved names for metrics and parameters.
RESERVED_NAMES: Final = frozenset(
    (
        *(
            *RUN_COLUMNS,
            "batch",
            "cell",
            "time",
            "objective",
        ),
        *(
            "iteration",
            "start",
            "ok",
            "discarded",
            "simulated_seconds",
            "wall_seconds",
            "trajectory_error",
        ),
        *(
            "line",
            "centre",
            "width",
            "side",
            "repeats",
            "quality",
            *RobotConfig.__dataclass_fields__,
        ),
        *("gait", "spine", "steering", "pilot", "profile", "trajectory", "head", "tail_motion"),
    )
)
#: First parts of columns that are named after a parameter: `gradient.stride`.
PREFIXES: Final = ("gradient", "gradient_error", "first_order")


def check_spine(spine: str, robot: str) -> None:
    """Reject unknown modes, and those of joints that the robot does not have."""
    for mode in mode_names(spine):
        if mode in SAGITTAL_MODES and robot != "nermo_41":
            raise ParameterError(
                f"spine is {spine!r}: {mode} bends vertical spine joints, which robot {robot!r} does not have; it goes "
                "with robot 'nermo_41'."
            )


def check_names(controller: ControllerLike, metrics: Sequence[OwnMetric]) -> None:
    """Reject parameters of a controller, and custom metrics, whose names are taken."""
    sources: dict[str, str] = {}
    for custom_metric in metrics:
        if (
            custom_metric.name in METRICS
            or custom_metric.name in RESERVED_NAMES
            or custom_metric.name in TRANSITION
        ):
            whose = (
                "a metric that every run has"
                if custom_metric.name in METRICS
                else "a column that every table has"
            )
            raise ParameterError(
                f"metrics has {custom_metric.place}, but {custom_metric.name} is {whose}: give it another name."
            )
        if custom_metric.name in sources:
            raise ParameterError(
                f"metrics has {custom_metric.place} and {sources[custom_metric.name]}: give one of them another name."
            )
        sources[custom_metric.name] = custom_metric.place
    shared = ControlParameters(geometry=Geometry())
    reserved = {name for name, _ in quantities(WorldParameters)} - {
        name for name, _ in quantities(shared)
    }
    names = [name for name, _ in quantities(controller.parameters)]
    for name in names:
        whose = (
            "one of the robot or its start"
            if name in reserved
            else "a metric that every run has"
            if name in METRICS
            else "a column that tables have"
            if name in RESERVED_NAMES or name.partition(".")[0] in PREFIXES
            else ""
        )
        if whose:
            raise ParameterError(
                f"controller has a parameter {name!r}, which is {whose}: give it another name."
            )
    for custom_metric in metrics:
        if custom_metric.name in reserved or custom_metric.name in names:
            raise ParameterError(
                f"metrics has {custom_metric.place}, but {custom_metric.name} is a parameter: give it another name."
            )


def check_terrain(scene: str, values: Mapping[str, Any]) -> None:
    """Reject a terrain shape that the scene does not read; its default is harmless."""
    for name in values.keys() - terrain_values(scene).keys():
        scenes, value = scenes_reading(name), values[name]
        if not scenes:
            continue
        default = dict(quantities(ModelParameters))[name].default
        if isinstance(value, jax.core.Tracer) or not np.allclose(value, default, rtol=1e-6):
            here = "a custom one" if is_mjcf(scene) else repr(scene)
            raise ParameterError(
                f"{name} has no effect: it is read only with scene {' or '.join(scenes)}, and the scene is {here}."
            )


#: Choices that only the published controller has.
PUBLISHED: Final = (
    *("gait", "spine", "steering", "profile", "pilot", "waypoints", "command"),
    *("trajectory", "head", "tail_motion", "control_rate"),
)
#: Choices that only set defaults of parameters.
PRESETTINGS: Final = ("gait", "steering", "profile")


@with_attributes
@dataclasses.dataclass(frozen=True)
class Setup(RobotConfig):
    """Static choices of a simulation; every name is checked at construction.

    >>> Setup(gait="lateral_walk", spine="stride_extension").defaults()["duty"]
    0.68

    `dataclasses.replace` with another preset of the physics takes that preset's time step, unless one was given. A
    custom scene, a file or an `MjSpec`, is stored as MJCF, so that setups with the same scene are equal.

    The choices from `gait` to `tail_motion` belong to the published controller and cannot be combined with another; of
    those, gait, steering and profile can with a `Controller` of other parts. A policy has its own pilot, which a choice
    other than `straight` replaces.

    Raises:
        ParameterError: an unknown name, or choices that cannot be combined; the message says what is allowed.
    """

    gait: GaitName = static("trot", "defaults of duty, offsets and gait factor")
    spine: str = static(
        "none",
        "its auxiliary modes, none or several joined by +: stride_extension, balance, harmonics, and with the robot "
        "nermo_41 sagittal_extension and pitch_balance",
    )
    steering: SteeringName = static(
        steering_of("exact"), "what turns the robot; in the profile as_published by default spine"
    )
    profile: ProfileName = static(
        "exact",
        "as_published is the published simulation with its body, as_built has the body of the built robot",
    )
    control_rate: float = static(
        control_rate_of("exact"),
        "ticks of the controller per simulated second [Hz]; in as_published by default 250, which are 100 Hz of its clock",
    )
    pilot: PilotName = static("straight", "what steers the robot")
    waypoints: tuple[tuple[float, float], ...] | None = static(
        None, "for the pilot waypoints, (x, y) of each [m], see `control.path.course_through`"
    )
    command: Command | None = static(None, "for the pilot external, see `control.pilot.tabulated`")
    trajectory: TrajectoryName = static(
        "cubic", "form of the foot path; free: cubic, with movable points and numbers of limbs"
    )
    head: HeadName = static("none", "gaze keeps its direction in the world")
    tail_motion: TailMotionName = static("none", "what the articulated tail does")
    controller: ControllerLike | str | None = static(
        None,
        "another controller (see `ControllerLike`): FILE.py:NAME or FILE.npz, a policy, or MODULE:NAME",
    )
    metrics: tuple[OwnMetric | str, ...] = static(
        (),
        "custom metrics: created by `metric`, or FILE.py, FILE.py:NAME, MODULE or MODULE:NAME; one, or a list",
    )
    schedule: tuple[Switch, ...] = static(
        (), "what changes while the robot walks, see `control.schedule`"
    )

    def __post_init__(self) -> None:
        of_type("spine", self.spine, str, "a name")
        of_type("timestep", self.timestep, (float, int), "a number of seconds")
        of_type("schedule", self.schedule, (tuple, list), "a list of Switch")
        for switch in self.schedule:
            of_type("schedule", switch, Switch, "a list of Switch")
        of_type(
            "metrics", self.metrics, (tuple, list, str, OwnMetric), "a metric, or a list of such"
        )
        of_type("control_rate", self.control_rate, (float, int), "a number of hertz")
        # In `as_published`, Nermo-Lite is the author's model of it.
        is_published_lite = self.profile == "as_published" and self.robot == "nermo_lite"
        for name, choice in robot_choices(self.profile).items():
            is_default = isinstance(getattr(self, name), ProfileChoice)
            if is_default or (name == "robot" and is_published_lite):
                object.__setattr__(self, name, choice)
        if isinstance(self.control_rate, ProfileRate) and self.controller is None:
            object.__setattr__(self, "control_rate", control_rate_of(self.profile))
        object.__setattr__(self, "gait", GAIT_CODES.get(str(self.gait), self.gait))
        super().__post_init__()
        if isinstance(self.timestep, PresetTimestep) and self.controller is None:
            # The longest step of which the control period is a multiple, up to that of the preset.
            steps = math.ceil(self._unbalanced.dt / self.preset.timestep - 1e-9)
            object.__setattr__(self, "timestep", PresetTimestep(self._unbalanced.dt / steps))
        if isinstance(self.steering, ProfileChoice) and self._applies("steering"):
            object.__setattr__(self, "steering", steering_of(self.profile))
        object.__setattr__(self, "schedule", tuple(self.schedule))
        for spine in (self.spine, *(switch.spine for switch in self.schedule)):
            check_spine(spine or "none", self.robot)
        if self.modes["tail_motion"] and self.tail == "rigid":
            motion = self.modes["tail_motion"][0]
            raise ParameterError(
                f"tail_motion is {motion!r} and tail 'rigid': take the tail 'articulated'."
            )
        metrics: Any = self.metrics
        object.__setattr__(
            self, "metrics", (metrics,) if isinstance(metrics, (str, OwnMetric)) else tuple(metrics)
        )
        for metric in self.metrics:
            if not isinstance(metric, (str, OwnMetric)):
                raise ParameterError(
                    f"metrics has {metric!r}: expected a function under @metric, or its FILE.py:NAME."
                )
        ratio = (period := self._unbalanced.dt) / self.timestep
        if abs(ratio - round(ratio)) > 1e-9 * ratio or round(ratio) < 1:
            raise ParameterError(
                f"timestep is {self.timestep}: allowed is the control period {period:g} s divided by a whole number."
            )
        for field in dataclasses.fields(self):
            if not self._applies(field.name) and getattr(self, field.name) != field.default:
                raise ParameterError(
                    f"{field.name} is {getattr(self, field.name)!r} beside a custom controller: it goes with the "
                    "published controller; leave it out."
                )
        check_names(self._unbalanced, self.own_metrics)
        if self.schedule:
            self.defaults()  # which reads it
        if is_mjcf(
            str(self.scene)
        ):  # a custom scene, which has not been checked with the robot yet
            self.load()

    def __getstate__(self) -> dict[str, Any]:
        """Pickled state without derived objects, which the other process recreates."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def fields(self) -> dict[str, Any]:
        """The applicable choices as JSON values; an object is represented by its type's name."""
        fields = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if self._applies(field.name)
        }
        metrics, switches = (
            fields.pop("metrics"),
            [switch.written() for switch in fields.pop("schedule")],
        )
        if metrics:
            fields["metrics"] = tuple(
                field if isinstance(field, str) else field.name for field in metrics
            )
        # Without the type that YAML cannot write.
        fields |= {
            name: str(value) for name, value in fields.items() if isinstance(value, ProfileChoice)
        }
        fields |= {"control_rate": float(self.control_rate)} if "control_rate" in fields else {}
        plain = (str, int, float, tuple, type(None))
        changed = {
            name: value if isinstance(value, plain) else type(value).__name__
            for name, value in fields.items()
        }
        return changed | ({"schedule": switches} if switches else {})

    @property
    def _start(self) -> Switch:
        """The modes at the start."""
        return Switch(0.0, spine=self.spine, head=self.head, tail_motion=self.tail_motion)

    @functools.cached_property
    def modes(self) -> dict[str, tuple[str, ...]]:
        """Modes of the spine, the head and the tail that act at any time of the run, by the choice that makes them."""
        entries = [self._start, *self.schedule]
        return {
            field: tuple(
                dict.fromkeys(name for entry in entries for name in entry.modes.get(field, ()))
            )
            for field in MODE_CHOICES
        }

    @functools.cached_property
    def own_metrics(self) -> tuple[OwnMetric, ...]:
        """The custom metrics; a file is read once, like that of a controller."""
        loaded = (
            load_metrics(reference) if isinstance(reference, str) else (reference,)
            for reference in self.metrics
        )
        return tuple(metric for several in loaded for metric in several)

    def load(self) -> Robot:
        """The assembled robot in its scene."""
        return load_robot(
            RobotConfig(*(getattr(self, field.name) for field in dataclasses.fields(RobotConfig)))
        )

    def make_controller(self) -> ControllerLike:
        """The controller with these choices."""
        if self.controller is not None or "balance" not in self.modes["spine"]:
            return self._unbalanced
        controller = self._unbalanced
        assert isinstance(controller, Controller)
        assert isinstance(controller.spine, SpineModes)
        robot = self.load()
        modes = SpineModes((*controller.spine.modes, "balance"), robot.mass_model, robot.config)
        return dataclasses.replace(controller, spine=modes)

    @functools.cached_property
    def _unbalanced(self) -> ControllerLike:
        """The controller without the spine's balance, which needs the robot. A file is read only once, so later changes
        do not affect the setup."""
        if self.controller is not None:
            controller: Any = (
                load_controller(self.controller)
                if isinstance(self.controller, str)
                else self.controller
            )
            check_form(controller)
            if isinstance(controller, ActsUpon) and self.pilot not in (Setup.pilot, "external"):
                return controller.upon(pilot=self.pilot, waypoints=self.waypoints)
            return controller
        spine, head, tail = self.modes.values()
        return published_controller(
            tuple(set(spine) - {"balance"}),
            self.pilot,
            waypoints=self.waypoints,
            command=self.command,
            trajectory=self.trajectory,
            head="+".join(head) or "none",
            tail_motion="+".join(tail) or "none",
            routing=self.routing,
            control_rate=self.control_rate,
            pilot_rate=self.control_rate / (1 if self.profile == "as_published" else 2),
        )

    def _applies(self, name: str) -> bool:
        """Whether a choice applies to the controller."""
        if self.controller is None or name not in PUBLISHED:
            return True
        if isinstance(self._unbalanced, ActsUpon) and self.pilot not in (Setup.pilot, "external"):
            return name == "pilot" or (name == "waypoints" and self.pilot == name)
        return isinstance(self._unbalanced, Controller) and name in ("gait", "steering", "profile")

    def defaults(self) -> dict[str, float]:
        """Default of every parameter."""
        return {name: float(value) for name, value in values_of(self._world)}

    @functools.cached_property
    def _world(self) -> WorldParameters:
        """Default parameters."""
        controller = self._unbalanced
        world = WorldParameters(control=controller.parameters)
        world = replace_quantities(world, mass_values(self.robot) | terrain_values(str(self.scene)))
        world = replace_quantities(
            world, gravity_values(np.asarray(load_scene(str(self.scene)).option.gravity))
        )
        shortest = max(float(world.model.contact.time_constant), 2 * self.timestep)
        world = replace_quantities(world, {"contact.time_constant": shortest})
        if self.schedule:
            declarations = dict(quantities(controller.parameters))
            world = dataclasses.replace(
                world, schedule=schedule_of(self._start, self.schedule, declarations)
            )
        if not isinstance(controller, Controller):
            return replace_quantities(world, self.body)
        values = published_values(self.gait, steering=self.steering, profile=self.profile)
        return replace_quantities(world, values | self.body)

    @property
    def body(self) -> dict[str, float]:
        """Parameters of the body that the profile or the robot model `author` sets, which are simulated as if they were
        named."""
        if self.robot == "author":
            return author_body(self.simplifications)
        return body_values(self.profile) if isinstance(self._unbalanced, Controller) else {}

    @functools.cached_property
    def _quantities(self) -> dict[str, Quantity]:
        """See `all_parameters`."""
        declarations, defaults = dict(quantities(self._world)), self.defaults()
        quantities_of_setup = {
            name: dataclasses.replace(declarations[name], default=value)
            for name, value in defaults.items()
            if repr(declarations[name].default) != repr(value)
        }
        declarations |= quantities_of_setup
        for number in range(len(self.schedule) + 1, MAX_SWITCHES + 1):
            for name in ("at", "blend"):
                declarations.pop(f"schedule.{name}.{number}", None)
        return declarations | bounded_by_step(declarations, self.timestep)

    def world(self, values: Mapping[str, Any], policy: Any = None) -> WorldParameters:
        """Parameters of worlds, with the named values filled in; only the names are checked.

        Args:
            values: parameter name -> number or array; unnamed ones have the setup's default.
            policy: the controller's parameters, instead of the setup's; named values override it.

        Raises:
            ParameterError: an unknown name, a shape of the terrain that the scene does not read, or a policy of another
                structure than the controller's parameters.
        """
        check_terrain(str(self.scene), values)
        # New arrays, as `quantity` creates for each tree: see there.
        world = jax.tree.map(
            lambda leaf: leaf.copy() if isinstance(leaf, np.ndarray) else leaf, self._world
        )
        if policy is not None:
            policy_structure, control_structure = map(
                str, map(jax.tree.structure, (policy, world.control))
            )
            if policy_structure != control_structure:
                raise ParameterError(
                    f"policy is {policy_structure}: expected the structure of the controller's parameters, {control_structure}."
                )
            world = dataclasses.replace(world, control=policy)
        if names_geometry(values):
            world = dataclasses.replace(world, control=with_geometry(world.control))
        return replace_quantities(world, self._completed(values))

    def numbers(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Named values with SI numbers in the place of texts such as `-45 deg`; unknown names are not refused here.

        Raises:
            ParameterError: it is no mapping, a text is no number, or it has a unit that does not convert.
        """
        for name in of_type("values", values, Mapping, "a mapping such as {'frequency': 0.8}"):
            of_type("values", name, str, "names of parameters as keys")
        declarations = self._quantities
        return {
            name: declarations[name].numbers(name, value) if name in declarations else value
            for name, value in values.items()
        }

    def _completed(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Named values plus derived ones."""
        controller = self._unbalanced
        return (
            controller.complete(dict(values)) if isinstance(controller, CompletesValues) else values
        )

    def check(self, world: WorldParameters, *, jointly: bool = True) -> None:
        """Reject parameters that are not finite, out of range, or not allowed by time step or controller.

        Args:
            world: concrete (not traced); leaves may carry leading batch axes.
            jointly: also run the controller's check and its `cycle_rate`, which may depend on several parameters.

        Raises:
            ParameterError: with the field's name, its value and what is allowed.
        """
        check_quantities(world)
        for name, declaration in bounded_by_step(
            dict(quantities(ModelParameters)), self.timestep
        ).items():
            part, field = name.split(".")
            declaration.check(name, getattr(getattr(world.model, part), field))
        check_geometry(world.model.geometry)
        check_servo(world.model.servo.kp, world.model.servo.kv, self.timestep)
        if self.robot == "author" and "servos" not in self.simplified:
            for field in ("dead_band", "backlash"):
                if np.any(getattr(world.model.servo, field)):
                    raise ParameterError(
                        f"servo.{field} is not 0: its model needs servos of one gain, which robot 'author' has with "
                        "simplifications 'servos+contact+noslip'."
                    )
        controller = self._unbalanced
        if jointly and world.schedule is not None:
            check_schedule(
                world.control,
                world.schedule,
                len(self.schedule),
                controller.cycle_rate(world.control),
            )
        if jointly and isinstance(controller, ChecksParameters):
            controller.check(world.control)
        if jointly and not isinstance(controller, Controller):
            location = named_place(controller, "cycle_rate")
            with user_code(f"{location}, which fails"):
                rate = np.asarray(controller.cycle_rate(world.control), float)
            bad = ~((rate > 0.0) & (rate < np.inf))
            if bad.any():
                raise ParameterError(
                    f"{location}, which gives {rate[bad].flat[0]:g}: expected finite gait cycles per second above 0."
                )

    @functools.cached_property
    def timing(self) -> frozenset[str]:
        """Names of the parameters that determine the length of a gait cycle."""
        names = [name for name, _ in values_of(self._world.control)]
        probes = {
            name: np.full(len(names), value) for name, value in values_of(self._world.control)
        }
        for world, name in enumerate(names):
            for derived_name, value in self._completed({name: np.nan}).items():
                probes[derived_name][world] = value
        decides = np.broadcast_to(np.isnan(self.cycle_rate(probes)), len(names))
        return frozenset(name for name, does in zip(names, decides, strict=True) if does)

    def cycle_rate(
        self, values: Mapping[str, Any], policy: Any = None
    ) -> Float[np.ndarray, "*batch"]:
        """Gait cycles per simulated second [1/s].

        Args:
            values: as for `world`, of numbers or arrays (n,).
            policy: see `world`.
        """
        control = self.world(values, policy).control
        with jax.ensure_compile_time_eval():
            return np.asarray(self._unbalanced.cycle_rate(control), float)


def with_own(
    setup: Setup | None,
    controller: ControllerLike | str | None = None,
    metrics: Sequence[OwnMetric | str] | str = (),
) -> Setup:
    """The setup, or the default one, with its controller replaced if one is given, and with additional metrics."""
    setup = of_type("setup", Setup() if setup is None else setup, Setup, "a Setup")
    of_type("metrics", metrics, (tuple, list, str, OwnMetric), "a metric, or a list of such")
    setup = setup if controller is None else dataclasses.replace(setup, controller=controller)
    additional = (metrics,) if isinstance(metrics, (str, OwnMetric)) else tuple(metrics)
    return (
        dataclasses.replace(setup, metrics=(*setup.metrics, *additional)) if additional else setup
    )


def all_metrics(setup: Setup | None = None) -> dict[str, Metric]:
    """Every metric of a run of `setup`, in the order of the columns: built-in ones, those of switches, custom ones.

    >>> all_metrics()["cost_of_transport"].better
    'low'
    """
    setup_with_metrics = with_own(setup)
    return (
        METRICS
        | (TRANSITION if setup_with_metrics.schedule else {})
        | {custom_metric.name: custom_metric for custom_metric in setup_with_metrics.own_metrics}
    )


def without_presettings(setup: Setup) -> Setup:
    """The setup with the first choices of `PRESETTINGS`: setups for which it is equal run the same programs."""
    preset_choices: Any = {name: str(getattr(setup, name)) for name in robot_choices(setup.profile)}
    preset_choices["timestep"] = float(setup.timestep)
    if setup.controller is None:
        preset_choices["control_rate"] = float(setup.control_rate)
    return dataclasses.replace(
        setup, **preset_choices, **{name: getattr(Setup, name) for name in PRESETTINGS}
    )


def all_parameters(setup: Setup | None = None) -> dict[str, Quantity]:
    """Every parameter a sweep may name, with the defaults of `setup`.

    >>> all_parameters()["spine.amplitude"].allowed()
    '[0, 0.6] rad'
    """
    return dict(with_own(setup)._quantities)
