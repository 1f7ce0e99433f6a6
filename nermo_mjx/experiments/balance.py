"""The balance test: each leg lifted and swung, with and without spine balance compensation (SBC), in one batch.

Published: without SBC the front legs pass and the rear legs fail; with it all four pass, and it reduces the resting
pitch by 30 % (front legs) and 73 % (rear legs).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from nermo_mjx.control import spine_modes
from nermo_mjx.control.parameters import BUILT_PROFILE, ControlParameters, Spine, body_values
from nermo_mjx.experiments.cases import BODY, CaseRuns, Settings, clock
from nermo_mjx.kinematics import body as kinematics
from nermo_mjx.kinematics.body import attitude, diagonal_distance, hips, shoulders
from nermo_mjx.kinematics.leg import forward_kinematics, four_legs, inverse_kinematics
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.physics import Variation, make_engine
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.recording import recording_of
from nermo_mjx.robot import LIMBS, ModelParameters, Robot, ServoAngles, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import FOOT_RADIUS
from nermo_mjx.robot.quantity import (
    check_quantities,
    choice,
    quantities,
    replace_quantities,
    values_of,
)
from nermo_mjx.rollout.run import TAUT
from nermo_mjx.rollout.simulator import REPORT_TICKS, History

# --- protocol: a `physics.engine.Loop` whose servo angles are a pure function of (parameters, time). The published test
# commands joint angles instead of feet, so the foot tracking lag of `as_published` does not apply; its clock does.

#: Neutral stance of the balance test (q1, q2) of each limb [rad]: `balance_stance` of the reference parameters.
STANCE: Final = np.array([[0.42, 0.60], [0.42, 0.60], [-0.15, -0.66], [-0.15, -0.66]])
#: Change of q2 that compresses a leg fully [rad]. Erratum 14: 0.6 in front, 0.7 behind; the text says "rear" twice.
COMPRESSION: Final = np.array([-0.6, -0.6, 0.7, 0.7])
#: The whole range of the hip and shoulder [rad], through which the lifted leg swings.
SWING_RANGE: Final = (-0.7, 0.7)
ROUTING: Final = "type3"


@dataclasses.dataclass(frozen=True)
class Phase:
    """A phase of the protocol, in seconds of its clock: changes happen within `ramp`, then hold."""

    begin: float
    end: float
    ramp: float

    @property
    def still(self) -> tuple[float, float]:
        """The second half of the hold, when everything is at rest."""
        return (self.begin + self.ramp + self.end) / 2, self.end


#: `stand`: the robot moves from its perturbed initial state to the stance; `shift`: the spine bends (with SBC); `lift`: the
#: leg is compressed; `swing`: the leg moves to one end of its range, to the other end, and back, a third of the phase each.
PHASES: Final = {
    "stand": Phase(0.0, 1.0, 0.4),
    "shift": Phase(1.0, 2.0, 0.5),
    "lift": Phase(2.0, 3.0, 0.5),
    "swing": Phase(3.0, 6.0, 3.0),
}
DURATION: Final = PHASES["swing"].end


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BalanceParameters:
    """One world of the test.

    Attributes:
        lifted: 1 for the limb that is lifted, otherwise 0.
        sbc: 1 with spine balance compensation, otherwise 0.
        clock_ratio: Simulated seconds per second of the protocol.
        spine: Limit of the servo, d_lift of (5.35), and share of the offset compensation (5.31).
        start: Initial offsets of q1 and q2 of the legs from the stance [rad].
        servo_speed: Maximum rate of change of a servo's target [rad/s].
    """

    lifted: Float[ArrayLike, " 4"]
    sbc: Float[ArrayLike, ""]
    clock_ratio: Float[ArrayLike, ""]
    spine: Spine
    start: Float[ArrayLike, "4 2"]
    servo_speed: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BalanceState:
    """The state of the loop: number of completed ticks, and servo targets [rad]."""

    tick: Array
    ctrl: Float[Array, " n_servos"]


def ramp(time: ArrayLike, begin: float, duration: float) -> Float[Array, "*batch"]:
    """0 before `begin`, 1 after `begin + duration`, between them the minimum-jerk polynomial."""
    share = jnp.clip((jnp.asarray(time) - begin) / duration, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def during(time: ArrayLike, phase: str) -> Float[Array, "*batch"]:
    """Progress of a phase's ramp, in [0, 1]."""
    return ramp(time, PHASES[phase].begin, PHASES[phase].ramp)


@dataclasses.dataclass(frozen=True, eq=False)
class BalanceLoop:
    """Implements `physics.engine.Loop` for the balance test; no sensor is read, as published."""

    robot: Robot
    dt: float = 0.01

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per control tick."""
        return round(self.dt / self.robot.config.timestep)

    def init(self, params: BalanceParameters, sensordata: Float[Array, " n"]) -> BalanceState:
        """See `Loop.init`."""
        return BalanceState(
            jnp.zeros((), jnp.int32), self.servos(params, 0.0).vector(self.robot.servos)
        )

    def step(
        self, params: BalanceParameters, state: BalanceState, sensordata: Float[Array, "steps n"]
    ) -> tuple[BalanceState, Float[Array, " n_servos"]]:
        """See `Loop.step`."""
        commanded = self.servos(params, state.tick * self.dt / params.clock_ratio).vector(
            self.robot.servos
        )
        reach = params.servo_speed * self.dt
        ctrl = state.ctrl + jnp.clip(commanded - state.ctrl, -reach, reach)
        return BalanceState(state.tick + 1, ctrl), ctrl

    def spine_servo(self, params: BalanceParameters) -> Float[Array, ""]:
        """Servo angle that balances the robot on the three other feet [rad] (5.35, 5.45); 0 without SBC."""
        feet = forward_kinematics(four_legs(Geometry()), STANCE, ROUTING).foot
        angle = spine_modes.balance(
            params.spine, self.robot.mass_model, feet, jnp.asarray(params.lifted) < 0.5, Geometry()
        )
        return jnp.asarray(params.sbc) * spine_modes.fuse(params.spine, jnp.zeros(()), angle)

    def servos(self, params: BalanceParameters, time: ArrayLike) -> ServoAngles:
        """Commanded angles at a time of the protocol [s], continuous in time.

        A spine bent by 0.1 rad per joint raises one hip by 5 mm and lowers the other by 4 mm, so three legs of neutral
        length would tilt the robot towards the foot to be lifted. The loaded feet compensate for that (5.31).
        """
        spine = during(time, "shift") * self.spine_servo(params)
        lifted = jnp.asarray(params.lifted)[:, None]
        legs = four_legs(Geometry())
        shift = (1.0 - lifted) * spine_modes.compensation(params.spine, spine, Geometry())
        level = inverse_kinematics(
            legs, forward_kinematics(legs, STANCE, ROUTING).foot + shift, ROUTING
        ).servo
        # Use the stance itself if there is nothing to compensate, because inverse kinematics would round it.
        stance = jnp.where(shift[:, 1:] == 0.0, jnp.asarray(STANCE, level.dtype), level)
        angles = stance + (1.0 - during(time, "stand")) * params.start

        compression = np.stack([np.zeros(4), COMPRESSION], axis=-1)
        angles = angles + lifted * during(time, "lift") * compression
        first, middle, last = (ramp(time, PHASES["swing"].begin + part, 1.0) for part in range(3))
        low, high = SWING_RANGE
        rest = STANCE[:, 0]
        swing = first * (low - rest) + middle * (high - low) + last * (rest - high)
        hip, knee = angles[:, 0] + lifted[:, 0] * swing, angles[:, 1]
        zero = jnp.zeros_like(spine)
        return ServoAngles(hip=hip, knee=knee, spine=spine, neck=zero, tail=zero)


# --- initial poses: on four feet, with a small random perturbation for each repeat

#: Largest perturbations of the position of the body [m], and of its attitude and the leg servos [rad].
PLACE, TURN = 0.001, math.radians(1.0)


@dataclasses.dataclass(frozen=True)
class Nudge:
    """The perturbation of an initial pose.

    Attributes:
        place: Shift of the position (3,) [m]; its third component is a drop height, which is not negative.
        turn: Rotation about x, y and z (3,) [rad].
        servo: Shift of q1 and q2 of the legs (4, 2) [rad].
    """

    place: np.ndarray
    turn: np.ndarray
    servo: np.ndarray


def nudge(seed: int, case: int, repeat: int) -> Nudge:
    """Sample a perturbation from a uniform distribution, independent of the rest of the batch."""
    draw = np.random.default_rng([seed, case, repeat])
    position = draw.uniform(-PLACE, PLACE, 3)
    position[2] = abs(position[2])
    return Nudge(position, draw.uniform(-TURN, TURN, 3), draw.uniform(-TURN, TURN, (4, 2)))


def start_pose(robot: Robot, start: Nudge) -> np.ndarray:
    """Positions (nq,) of the neutral stance with perturbation: heading -y, and the four soles level with the ground."""
    legs = four_legs(Geometry())
    axes = np.concatenate([shoulders(Geometry()), hips(0.0, Geometry())]).astype(float)
    neutral = _soles(axes, np.asarray(forward_kinematics(legs, STANCE, ROUTING).foot, float))
    # Front and rear legs differ in length, so the torso pitches by a fraction of a degree when all four feet stand.
    pitch = math.atan2(neutral[0, 2] - neutral[2, 2], neutral[2, 1] - neutral[0, 1])

    servo = STANCE + start.servo
    eased = servo + np.stack(
        [np.zeros(4), legs.servo_direction * TAUT / legs.pulley_radius], axis=-1
    )
    pose = forward_kinematics(legs, eased, ROUTING)
    attitude = Rotation.from_euler("ZXY", start.turn[[2, 0, 1]] + np.array([0.0, pitch, 0.0]))
    lowest = attitude.apply(_soles(axes, np.asarray(pose.foot, float)))[:, 2].min()
    radius = robot.model.geom(f"{LIMBS[0]}_sole").size[0]

    qpos, joints = robot.model.qpos0.copy(), robot.joints
    qpos[joints.root : joints.root + 3] = start.place + np.array([0.0, 0.0, radius - lowest])
    qpos[joints.root + 3 : joints.root + 7] = attitude.as_quat(scalar_first=True)
    qpos[list(joints.hip)], qpos[list(joints.pulley)] = servo.T
    qpos[np.array(joints.knee)] = pose.knee_angle[:, None] / robot.config.hinges
    return qpos


def _soles(axes: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Feet (4, 3) in the torso's frame, from the axes of the legs (4, 3) and the feet (4, 2) = (y, z) from them."""
    return axes + np.column_stack([np.zeros(4), feet])


# --- measurements in each world, and the criterion for passing

#: For each lifted limb, the front and the rear foot of the diagonal over which the robot may tip. The third standing foot
#: is opposite to the limb, 3 - limb; it carries load if the centre of mass is inside the diagonal.
DIAGONAL: Final = ((1, 2), (0, 3), (0, 3), (1, 2))
#: Force above which a foot is in contact [N]. The sensor sums contact forces and reads exactly 0 without contact, so
#: any small number will do; this one is a thousandth of a foot's load.
TOUCH: Final = 0.001


@functools.cache
def tip_angle() -> float:
    """Rotation about the diagonal at which the lifted foot comes down again [rad].

    Height by which full compression lifts a foot, over that foot's distance from the diagonal, both from the kinematics
    of the level stance: 0.20 rad in front, 0.15 rad behind. The smaller one is used for all cases.
    """
    feet, raised = (
        np.asarray(
            forward_kinematics(
                four_legs(Geometry()), STANCE + [[0.0, q2] for q2 in change], ROUTING
            ).foot,
            float,
        )
        for change in (np.zeros(4), COMPRESSION)
    )
    axes = np.concatenate([shoulders(Geometry()), hips(0.0, Geometry())])
    ground = axes[:, :2] + np.column_stack([np.zeros(4), feet[:, 0]])
    lever = [
        abs(float(diagonal_distance(ground[limb], ground[front], ground[rear])))
        for limb, (front, rear) in enumerate(DIAGONAL)
    ]
    return float(np.arctan((raised - feet)[:, 1] / lever).min())


def verdict(
    force: Float[np.ndarray, "*batch T"], tilt: Float[np.ndarray, "*batch S"]
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the robot stayed upright, and whether the lifted foot stayed clear. A world passes if both are true.

    Args:
        force: Force of the lifted foot during the swing [N].
        tilt: Tilt of the torso after the begin of the lift [rad]. Non-finite values do not pass.
    """
    return np.all(tilt < tip_angle(), axis=-1), np.all(force <= TOUCH, axis=-1)


def inside(
    limb: int, com: Float[np.ndarray, "T 3"], feet: Float[np.ndarray, "T 4 3"]
) -> Float[np.ndarray, " T"]:
    """Distance of the centre of mass from the diagonal beside the lifted limb [m], positive towards the third foot."""
    com, feet = com[:, :2], feet[:, :, :2]
    front, rear = (feet[:, foot] for foot in DIAGONAL[limb])
    side = diagonal_distance(feet[:, 3 - limb], front, rear)
    return np.asarray(diagonal_distance(com, front, rear) * np.sign(side), float)


def measured_centre_of_mass(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "T nq"]
) -> Float[np.ndarray, "T 3"]:
    """Centre of mass of the whole robot [m], from the simulated model."""
    data, com = mujoco.MjData(model), np.full((len(qpos), 3), np.nan)
    root = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    for i in np.flatnonzero(np.isfinite(qpos).all(axis=1)):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        com[i] = data.subtree_com[root]
    return com


def readings(
    limb: int, model: mujoco.MjModel, qpos: np.ndarray, sensors: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Time histories of one world: `roll`, `pitch`, `tilt` (T,) [rad], `centre_of_mass` (T, 3) and `com_margin` [m].

    Args:
        limb: Lifted limb.
        model: Simulated model.
        qpos: Positions (T, nq).
        sensors: Sensors by the names of `robot.Sensors`, (T, ...).
    """
    orientation = np.asarray(sensors["orientation"], float)
    roll, pitch, _ = np.asarray(attitude(jnp.asarray(orientation)), float).T
    up = 1.0 - 2.0 * (orientation[:, 1] ** 2 + orientation[:, 2] ** 2)
    com = measured_centre_of_mass(model, qpos)
    return {
        "roll": roll,
        "pitch": pitch,
        "tilt": np.arccos(np.clip(up, -1.0, 1.0)),
        "centre_of_mass": com,
        "com_margin": inside(limb, com, sensors["foot_position"]),
    }


def measure(
    limb: int,
    time: Float[np.ndarray, " T"],
    sensors: Mapping[str, np.ndarray],
    readings_shown: Mapping[str, np.ndarray],
    sole: float,
) -> dict[str, float | bool]:
    """All measured columns of one world; see `experiments.yaml`.

    Args:
        limb: Lifted limb.
        time: End of each tick on the clock of the protocol [s].
        sensors: Argument of `readings`.
        readings_shown: Result of `readings`.
        sole: Radius of the sole [m].
    """

    def within(begin: float, end: float) -> np.ndarray:
        return (time > begin + 1e-6) & (time < end + 1e-6)

    force, pitch, margin = (
        sensors["foot_force"],
        readings_shown["pitch"],
        readings_shown["com_margin"],
    )
    still = {name: within(*phase.still) for name, phase in PHASES.items()}
    swing = still["swing"] = within(PHASES["swing"].begin, PHASES["swing"].end)
    upright, clear = verdict(
        force[swing, limb], readings_shown["tilt"][within(PHASES["lift"].begin, math.inf)]
    )
    height = sensors["foot_position"][swing, limb, 2] - sole
    lifted = time > PHASES["lift"].begin
    down = lifted & (np.cumsum(lifted & (force[:, limb] <= TOUCH)) > 0) & (force[:, limb] > TOUCH)
    values = {
        "passed": bool(upright and clear),
        "upright": bool(upright),
        "clear": bool(clear),
        "contact_share": np.mean(force[swing, limb] > TOUCH),
        "clearance": height.min(),
        "tilt_max": readings_shown["tilt"][within(PHASES["lift"].begin, math.inf)].max(),
        "pitch_stand": pitch[still["stand"]].mean(),
        "pitch_rest": pitch[still["lift"]].mean(),
        "roll_rest": readings_shown["roll"][still["lift"]].mean(),
        "pitch_swing_min": pitch[swing].min(),
        "pitch_swing_max": pitch[swing].max(),
        "com_height": readings_shown["centre_of_mass"][still["stand"], 2].mean(),
        **{
            f"com_margin_{phase}": margin[still[phase]].mean()
            for phase in ("stand", "shift", "lift")
        },
        "com_margin_swing": margin[swing].min(),
        "impact": time[np.argmax(down)] - PHASES["lift"].begin if down.any() else math.nan,
        "third_share": np.mean(force[swing, 3 - limb] > TOUCH),
    }
    for phase, is_still in still.items():
        values |= {
            f"force_{phase}_{name}": force[is_still, i].mean() for i, name in enumerate(LIMBS)
        }
    return values


# --- the experiment

#: Parameters of the controller that apply here; those of the body come from `ModelParameters`. The protocol is written
#: for the published geometry.
SPINE_NAMES: Final = ("spine.max_servo_angle", "spine.balance_lift", "spine.offset_compensation")
#: Parameters that can be set for all worlds.
SETTABLE: Final = frozenset(SPINE_NAMES) | {
    name for name, _ in quantities(ModelParameters) if not name.startswith("geometry.")
}
#: The published offset compensation (5.31) is on; the text of the balance test does not specify it. Without it the bent
#: robot rests on either side of its diagonal, depending on the speed of the bend: see `BalanceLoop.servos`.
OFFSET_COMPENSATION: Final = 1.0


def balance_world_count(settings: Settings) -> int:
    """Number of worlds that `run` simulates."""
    repeats = 1 if settings.quick else settings.repeats
    return max(settings.body_count, 1) * len(settings.profiles) * len(LIMBS) * 2 * repeats


@dataclasses.dataclass(frozen=True)
class _Worlds:
    """All worlds of the test.

    Attributes:
        labels: Columns of the case of each world.
        columns: Name of a parameter that is set -> values (n,).
        starts: Perturbation of each initial pose.
        body, spine: Parameters of all worlds.
    """

    labels: list[dict[str, Any]]
    columns: dict[str, np.ndarray]
    starts: list[Nudge]
    body: ModelParameters
    spine: Spine

    @property
    def limbs(self) -> list[int]:
        """The lifted limb of each world."""
        return [LIMBS.index(row["leg"]) for row in self.labels]

    @property
    def ratios(self) -> np.ndarray:
        """Simulated seconds per second of the protocol, (n,)."""
        return np.array([clock(row["profile"]) for row in self.labels])

    @property
    def on_body(self) -> dict[str, np.ndarray]:
        """The columns of the body's parameters."""
        return {name: column for name, column in self.columns.items() if name not in SPINE_NAMES}

    def parameters(self) -> BalanceParameters:
        """Parameters of the loop, every leaf with a leading axis, in JAX's default precision."""
        n, spine = len(self.labels), self.spine
        spines = jax.tree.map(
            lambda leaf: np.broadcast_to(leaf, n), dataclasses.replace(spine, harmonics=0.0)
        )
        params = BalanceParameters(
            lifted=np.eye(4)[self.limbs],
            sbc=np.array([row["sbc"] for row in self.labels]),
            clock_ratio=self.ratios,
            spine=dataclasses.replace(
                spines, harmonics=np.broadcast_to(spine.harmonics, (n, *np.shape(spine.harmonics)))
            ),
            start=np.stack([start.servo for start in self.starts]),
            servo_speed=np.broadcast_to(self.body.servo.top_speed, n),
        )
        real = jax.dtypes.canonicalize_dtype(float)
        return jax.tree.map(lambda leaf: np.asarray(leaf).astype(real), params)


def _worlds(settings: Settings) -> _Worlds:
    """The worlds of all cases, initial poses and parameter sets; errors as for `run`."""
    bodies = settings.bodies or {}
    for name in {**settings.values, **bodies}:
        choice("values", name, sorted(SETTABLE))
    labels: list[dict[str, Any]] = []
    rows: list[dict[str, float]] = []
    starts: list[Nudge] = []
    numbers = range(1, settings.body_count + 1) or (0,)
    repeats = range(1 if settings.quick else settings.repeats)
    for body, profile, limb, sbc, repeat in itertools.product(
        numbers, settings.profiles, range(4), (False, True), repeats
    ):
        numbered = {BODY: body} if body else {}
        labels.append(
            {"profile": profile, **numbered, "leg": LIMBS[limb], "sbc": sbc, "repeat": repeat}
        )
        built = (
            {name: BUILT_PROFILE[name] for name in SPINE_NAMES if name in BUILT_PROFILE}
            if profile == "as_built"
            else {}
        )
        body_sample = {name: float(values[body - 1]) for name, values in bodies.items()}
        parameters = body_values(profile) | built | dict(settings.values) | body_sample
        rows.append({"spine.offset_compensation": OFFSET_COMPENSATION} | parameters)
        # The perturbation of a start is the same in all profiles.
        starts.append(nudge(settings.seed, 2 * limb + sbc, repeat + max(body - 1, 0)))
    defaults = dict(values_of(ModelParameters())) | {
        f"spine.{name}": value for name, value in values_of(ControlParameters().spine)
    }
    columns = {
        name: np.array([row.get(name, defaults[name]) for row in rows], float)
        for name in dict.fromkeys(itertools.chain.from_iterable(rows))
    }
    on_spine = {name.split(".")[1]: columns[name] for name in SPINE_NAMES if name in columns}
    on_body = {name: column for name, column in columns.items() if name not in SPINE_NAMES}
    body_parameters = replace_quantities(ModelParameters(), on_body)
    spine = replace_quantities(ControlParameters().spine, on_spine)
    check_quantities(body_parameters)
    check_quantities(spine, "spine.")
    return _Worlds(labels, columns, starts, body_parameters, spine)


def run(settings: Settings) -> CaseRuns:
    """Run the balance experiment.

    The recordings also contain `readings` as sensors, and in their metadata `phases`: begin and end of each phase in
    simulated time [s].

    Args:
        settings: Settings. Profiles affect the body and the clock; a quick run has one repeat; values are parameters of
            the body such as `contact.friction`, and `SPINE_NAMES`.

    Raises:
        ParameterError: A parameter does not apply here.
    """
    worlds = _worlds(settings)
    robot = load_robot(scene="balance_stand", **settings.robot)
    loop = BalanceLoop(robot)
    engine, params = make_engine(settings.engine, robot, loop), worlds.parameters()

    @jax.jit
    def posture(params: BalanceParameters) -> tuple[jax.Array, jax.Array]:
        """Feet in the stance, and the angle of each world's spine joints."""
        bends = joint_angle(jax.vmap(loop.spine_servo)(params), Geometry())
        return forward_kinematics(four_legs(Geometry()), STANCE, ROUTING).foot, bends

    feet, bends = (np.asarray(array) for array in posture(params))
    ticks = [round(DURATION * ratio / loop.dt) for ratio in worlds.ratios]
    qpos = np.stack([start_pose(robot, start) for start in worlds.starts])
    variation = Variation(robot).batch(worlds.body, len(ticks), worlds.on_body)
    session, blocks = engine.open(params, qpos, variation), []
    # Whole blocks only: a recorded block of another length would need another program.
    for first_tick in range(0, max(ticks), REPORT_TICKS):
        blocks.append(session.record(REPORT_TICKS))
        if settings.progress:
            settings.progress(min(1.0, (first_tick + REPORT_TICKS) / max(ticks)))
    traces = [
        np.concatenate([np.asarray(getattr(block, name), float) for block in blocks], axis=1)
        for name in ("qpos", "qvel", "ctrl", "sensordata")
    ]
    sensor_readings = robot.sensors(traces.pop()[:, : max(ticks)])
    arrays = {
        field.name: np.asarray(getattr(sensor_readings, field.name))
        for field in dataclasses.fields(sensor_readings)
    }

    @functools.cache
    def model_of(masses: tuple[tuple[str, float], ...]) -> mujoco.MjModel:
        """The model that gives the centre of mass."""
        return compile_model(robot, dict(masses))

    radii = worlds.on_body.get("geometry.foot.radius", [FOOT_RADIUS] * len(ticks))
    rows, recordings = [], {}
    for i, (row, length, ratio) in enumerate(zip(worlds.labels, ticks, worlds.ratios, strict=True)):
        masses = [(name, column) for name, column in worlds.on_body.items() if name[:5] == "mass."]
        model = model_of(tuple((name, column[i]) for name, column in masses))
        limb, time = worlds.limbs[i], (1 + np.arange(length)) * loop.dt
        sensors = {name: column[i, :length] for name, column in arrays.items()}
        limb_readings = readings(limb, model, traces[0][i, :length], sensors)
        labels = row
        row = row | measure(limb, time / ratio, sensors, limb_readings, radii[i])
        ground = np.asarray(kinematics.feet_positions(float(bends[i]), feet, Geometry()))
        com = np.asarray(kinematics.centre_of_mass(robot.mass_model, float(bends[i]), Geometry()))
        margin = inside(limb, com[None], ground[None])[0]  # (5.35)
        rows.append(row | {"theory_margin": float(margin)})
        if row["repeat"] == row.get(BODY, 0) == 0 and row["profile"] == rows[0]["profile"]:
            metadata = _about(
                row,
                labels,
                {name: float(column[i]) for name, column in worlds.columns.items()},
                ratio,
            )
            metadata |= {"setup": dataclasses.asdict(robot.config), "engine": engine.name}
            world = {name: reading[None] for name, reading in (sensors | limb_readings).items()}
            poses, speeds, ctrl = (trace[i : i + 1, :length] for trace in traces)
            history = History(time, poses, speeds, ctrl, world)
            recordings[metadata["case"]] = recording_of(history, model, metadata=metadata)
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return CaseRuns.of("balance", columns, recordings)


def _about(
    row: Mapping[str, Any], labels: Mapping[str, Any], parameters: Mapping[str, float], ratio: float
) -> dict[str, Any]:
    """Metadata of the recording of a world."""
    return {
        "experiment": "balance",
        "case": f"balance {row['leg']}" + (" sbc" if row["sbc"] else ""),
        "labels": dict(labels),
        "metrics": {
            name: value if isinstance(value, str) else float(value) for name, value in row.items()
        },
        "phases": {
            name: [phase.begin * ratio, phase.end * ratio] for name, phase in PHASES.items()
        },
        "parameters": dict(parameters),
    }
