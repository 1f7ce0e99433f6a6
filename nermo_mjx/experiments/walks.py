"""The experiments with walks: straight line, turning and maze. The cases of an experiment run in one batch.

The simulated profiles have full strides. The hardware and `as_built` have a normalised stride of 0.8 (Table 6.1). The
text on the turning test (A.4.2) keeps the stride "constant at 0.08", evidently a misprint (erratum 6).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping
from typing import Any, Final

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from nermo_mjx.control.path import Course, course_through
from nermo_mjx.experiments import cases, theory
from nermo_mjx.experiments.cases import (
    AMPLITUDE,
    FREQUENCIES,
    SIMULATED,
    Case,
    CaseRuns,
    Label,
    Settings,
    Worlds,
)
from nermo_mjx.kinematics.body import attitude
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS, Robot
from nermo_mjx.robot.parameters import SERVOS
from nermo_mjx.rollout import History, Run, Simulator

HARDWARE_STRIDE: Final = 0.8
#: Paths are followed by this project's pilot in all profiles. None of the author's gains (25 and 200 on 2 August 2021,
#: 40 and 300 on the 8th) is known to be that of a test; with the former no circle of 0.5 m is followed within 25 mm.
_GUIDED: Final = {"pilot.guidance": 1.0, "pilot.error_gain": 0.0, "pilot.change_gain": 0.0}
_BUILT: Final = ("as_built",)


def _record(
    simulator: Simulator, chosen: list[Case], settings: Settings, length: Any, names: list[str]
) -> Any:
    """Recordings of cases with the first initial state in the first profile, by name; empty for identified bodies."""
    one = settings.but(profiles=settings.profiles[:1], repeats=1)
    chosen = [case for case in chosen if one.profiles[0] in case.profiles]
    if settings.bodies is not None or not chosen:
        return {}
    batch = cases.worlds(chosen, simulator.setup.defaults(), one)
    run = length(batch) if callable(length) else length
    result = simulator.run(batch.values, run, record=True)
    return cases.recordings_of(simulator, batch, result, dict(enumerate(names)))


# --- straight line, 2.0 m: speed and orientation over gait, frequency, stride and spine

DISTANCE: Final = 2.0
#: Maximum number of gait cycles of a run that does not reach the end of the line, such as one without a stride.
_LONGEST_RUN_CYCLES: Final = 60.0
_WARMUP: Final = 2.0
_RECORDED: Final = 8.0


def _line(gait: str, frequency: float, spine: bool, stride: float = 1.0, **options: Any) -> Case:
    """A case of the straight line; `options` are `compensated` and `profiles`."""
    compensated = options.get("compensated", False)
    labels: dict[str, Label] = {
        "gait": gait,
        "frequency": frequency,
        "stride": stride,
        "spine": spine,
    }
    # Without the PD pilot of the author, as in the author's model. The guidance of the other profiles has no such gains.
    values = {"frequency": frequency, "stride": stride, "spine.amplitude": AMPLITUDE * spine}
    values |= {
        "spine.offset_compensation": float(compensated),
        "pilot.error_gain": 0.0,
        "pilot.change_gain": 0.0,
    }
    profiles = options.get("profiles", SIMULATED)
    return Case(labels | {"compensated": compensated}, gait, values=values, profiles=profiles)


def line_cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases, and a standing robot; with `quick`, the cases at 0.8 Hz and the offset compensation."""
    frequencies = FREQUENCIES[-1:] if quick else FREQUENCIES
    spine_values = (False, True)
    still = {"stance.swing_amplitude": 0.0, "stance.stance_amplitude": 0.0}
    stands = _line("trot", 0.8, False, 0.0)  # on its neutral feet
    stands = Case(
        {**stands.labels, "gait": "stand"},
        "trot",
        values={**stands.values, **still},
        profiles=SIMULATED,
    )
    gaits = [
        _line(gait, f, spine)
        for f in frequencies
        for gait in ("trot", "walking_trot")
        for spine in spine_values
    ]
    lateral = [_line("lateral_walk", f, False) for f in frequencies]
    strides = [
        _line("trot", 0.8, spine, stride) for stride in (0.0, 0.5, 0.8) for spine in spine_values
    ]
    compensated = [_line("trot", 0.67, True, compensated=True)] + (
        [_line("trot", 0.67, True)] if quick else []
    )
    hardware = (("trot", False), ("trot", True), ("lateral_walk", False))
    built = [
        _line(gait, f, spine, HARDWARE_STRIDE, profiles=_BUILT)
        for f in FREQUENCIES
        for gait, spine in hardware
    ]
    return (stands, *gaits, *lateral, *strides, *compensated, *built)


def walk_line(settings: Settings) -> CaseRuns:
    """Simulate all cases in one batch, and the cases with an analysed gait cycle in another batch, which is recorded.

    A quick run has fewer cases, and half a metre.
    """
    simulator = Simulator(
        settings.setup("straight_line", spine="stride_extension"), engine=settings.engine
    )
    defaults, quick = simulator.setup.defaults(), settings.quick
    batch = cases.worlds(line_cases(quick), defaults, settings)
    length = Run(
        cycles=_LONGEST_RUN_CYCLES / (4 if quick else 1),
        warmup_cycles=_WARMUP,
        distance=0.5 if quick else DISTANCE,
    )
    columns = cases.measured(batch, simulator.run(batch.values, length, progress=settings.progress))
    columns["theory_speed"] = theory.speed(batch.all_values(defaults))
    # The publication describes the gait cycle of the trot at 0.8 Hz, with two strides.
    described = [
        _line("trot", 0.8, spine, stride).labels for stride in (0.8, 1.0) for spine in (False, True)
    ]
    looked_into = np.logical_or.reduce(
        [
            np.logical_and.reduce([batch.labels[name] == labels[name] for name in labels])
            for labels in described
        ]
    )
    columns |= gait_cycle(
        simulator, batch, looked_into, Run(_WARMUP + (4.0 if quick else _RECORDED), _WARMUP)
    )
    names = [f"trot, 0.67 Hz, {spine_word} spine" for spine_word in ("without", "with")]
    shown_cases = [_line("trot", 0.67, spine) for spine in (False, True)]
    recordings = _record(
        simulator, shown_cases, settings, Run(cycles=4.0 if quick else _RECORDED), names
    )
    return CaseRuns.of("straight-line", columns, recordings)


# --- the gait cycle: pitch, yaw and the spine's angle of recorded walks are folded over the phase of the gait, on the
# controller's clock, so that noise does not count as a peak; slip over the stance

#: Parts of a gait cycle over which curves are folded; in the profile as_published it has 50 ticks.
PARTS: Final = 50
#: A peak counts if its prominence is this fraction of the curve's range.
PROMINENT: Final = 0.2
#: A foot bears load above this force [N], as in `rollout.metrics`.
LOADED_FOOT_NEWTONS: Final = 0.02
#: The lift-off of a foot begins at this share of its stance, and ends this share of the cycle after it.
LAST_OF_STANCE: Final = 2 / 3
AFTER_STANCE: Final = 1 / 6
#: Share of the cycle after a leg's planned lift-off in which the pitch is attributed to the lift-off.
LIFT_OFF: Final = 0.25
#: Number of worlds recorded at once: 2 MB each.
_RECORDED_WORLDS: Final = 64
_attitude = jax.jit(attitude)

_SLIP: Final = ("slip_rear_touch_down", "slip_rear_mid_stance", "slip_rear_lift_off")
#: Columns that are measured over the gait cycle.
CYCLE: Final = ("pitch_peaks", "pitch_peak_up", "pitch_lift_off", "yaw_spine_correlation", *_SLIP)


def gait_cycle(
    simulator: Simulator, batch: Worlds, row_numbers: np.ndarray, run: Run
) -> dict[str, np.ndarray]:
    """Columns `CYCLE` of selected worlds of a batch, which are simulated again and recorded; NaN for the other worlds.

    Args:
        simulator: Simulator of the worlds.
        batch: Worlds.
        row_numbers: Mask (n,) of the selected worlds.
        run: Duration; its warm-up is excluded, and the rest consists of whole gait cycles.
    """
    columns = {name: np.full(len(row_numbers), np.nan) for name in CYCLE}
    everything, rows = batch.all_values(simulator.setup.defaults()), np.flatnonzero(row_numbers)
    for begin in range(0, len(rows), _RECORDED_WORLDS):
        batch_rows = rows[begin : begin + _RECORDED_WORLDS]
        result = simulator.run(
            {name: values[batch_rows] for name, values in batch.values.items()}, run, record=True
        )
        assert result.trace is not None
        for i, row in enumerate(batch_rows):
            if result.status[i] == "ok":
                values = {name: float(column[row]) for name, column in everything.items()}
                for name, value in of_world(result.trace, i, values, run).items():
                    columns[name][row] = value
    return columns


def of_world(trace: History, world: int, values: Mapping[str, float], run: Run) -> dict[str, float]:
    """`CYCLE` of one recorded world; `values` are all its parameters, by name."""
    rate = values["frequency"] / values["tracking.clock_ratio"]
    warmup, end = run.seconds(np.asarray(rate))
    inside = (trace.time > float(warmup) + 1e-6) & (trace.time < float(end) + 1e-6)
    phase = values["start.phase"] + rate * trace.time[inside]
    sensors = {
        name: np.asarray(trace.sensors[name][world][inside], float)
        for name in ("servo_angle", "foot_force", "foot_velocity")
    }
    # The whole trace has the same length for all worlds, so that one program suffices.
    _, pitch, yaw = np.asarray(_attitude(trace.sensors["orientation"][world]), float)[inside].T
    spine = sensors["servo_angle"][:, SERVOS.index("spine")]
    stance = {limb: values["offset." + limb] for limb in LIMBS}
    courses = folded(phase, np.unwrap(yaw)), folded(phase, spine)
    still = min(map(np.ptp, courses)) < 1e-3  # [rad]
    return {
        **pitch_course(folded(phase, pitch), values["duty"], list(stance.values())),
        "yaw_spine_correlation": float("nan") if still else float(np.corrcoef(*courses)[0, 1]),
        **rear_slip(phase, sensors["foot_force"], sensors["foot_velocity"], values["duty"], stance),
    }


def folded(
    phase: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"]
) -> Float[np.ndarray, " parts"]:
    """Mean course over a gait cycle, minus its mean and the drift over the walk; phase in cycles."""
    drift = np.polynomial.Polynomial.fit(phase, values, 1)(phase)
    part = np.floor((phase % 1.0) * PARTS).astype(int) % PARTS
    count = np.maximum(np.bincount(part, minlength=PARTS), 1)
    course = np.bincount(part, values - drift, minlength=PARTS) / count
    return course - course.mean()


def pitch_course(
    pitch: Float[np.ndarray, " parts"], duty: float, offsets: list[float]
) -> dict[str, float]:
    """The columns of the pitch in `CYCLE`, from its mean course.

    Args:
        pitch: Pitch, positive nose down [rad].
        duty, offsets: Duty factor and offsets of the gait; a leg is planned to lift off at offset + duty.
    """
    up = -pitch
    twice = np.tile(up, 3)
    peaks, _ = (
        find_peaks(twice, prominence=PROMINENT * np.ptp(up))
        if np.ptp(up) > 0.0
        else (np.zeros(0), {})
    )
    middle = (np.arange(PARTS) + 0.5) / PARTS
    after = [((middle - offset - duty) % 1.0) < LIFT_OFF for offset in offsets]
    return {
        "pitch_peaks": float(np.sum((peaks >= PARTS) & (peaks < 2 * PARTS))),
        "pitch_peak_up": float(up.max()),
        "pitch_lift_off": float(up[np.logical_or.reduce(after)].max()),
    }


def rear_slip(
    phase: Float[np.ndarray, " T"],
    force: Float[np.ndarray, "T 4"],
    velocity: Float[np.ndarray, "T 4 3"],
    duty: float,
    offsets: Mapping[str, float],
) -> dict[str, float]:
    """The columns of the slip in `CYCLE`: mean horizontal speed of the loaded rear feet in three parts of their stance."""
    speed, distances = np.linalg.norm(velocity[..., :2], axis=-1), np.zeros((3, 2))
    for i, limb in enumerate(LIMBS):
        if not limb.startswith("rear"):
            continue
        since = (phase - offsets[limb]) % 1.0
        loaded = force[:, i] > LOADED_FOOT_NEWTONS
        bounds = (0.0, duty / 3, LAST_OF_STANCE * duty, duty + AFTER_STANCE)
        for part, (begin, end) in enumerate(itertools.pairwise(bounds)):
            is_counted = loaded & (since >= begin) & (since < end)
            distances[part] += speed[is_counted, i].sum(), is_counted.sum()
    means = np.divide(
        distances[:, 0], distances[:, 1], out=np.full(3, np.nan), where=distances[:, 1] > 0
    )
    return dict(zip(_SLIP, means.tolist(), strict=True))


# --- turning: quarter circles and full lock over gait, frequency and strategy

RADII: Final = (1.0, 0.5)
#: Radius that represents full lock, as in the publication: the turn rate is held at its maximum.
FULL_LOCK: Final = 0.0
STRATEGIES: Final = ("leg", "spine", "mix")
WALK_GAITS: Final = ("trot", "walking_trot", "lateral_walk")
TURN_SIGNS: Final = {"left": 1.0, "right": -1.0}
#: A path is followed if the torso, including its sway, stays this close to it: 5 % of its radius, at least 2.5 cm.
BOUND_SHARE: Final = 0.05
LEAST_BOUND: Final = 0.025
#: Minimum speed of a world that arrives in time, as a share of the theoretical speed.
_IN_TIME: Final = 0.3
_LOCK_CYCLES: Final = 14.0


def _turn(
    gait: str,
    frequency: float,
    radius: float,
    strategy: str,
    side: str = "left",
    stride: float = 1.0,
    **options: Any,
) -> Case:
    """A case of the turning test; `options` are its `profiles`."""
    values = {
        "frequency": frequency,
        "stride": stride,
        "spine.amplitude": 0.0,
        "spine.max_servo_angle": AMPLITUDE,
    }
    if radius == FULL_LOCK:
        values["pilot.turn_rate"] = TURN_SIGNS[side]
    else:
        values |= {"pilot.radius": radius, "pilot.direction": TURN_SIGNS[side], **_GUIDED}
    labels: dict[str, Label] = {
        "gait": gait,
        "frequency": frequency,
        "radius": radius,
        "strategy": strategy,
    }
    labels |= {"side": side, "stride": stride}
    return Case(labels, gait, strategy, values, options.get("profiles", SIMULATED))


def turn_cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases to the left, trot and walking trot at 0.67 Hz to the right as well, and the hardware's.

    `quick`: trot at 0.67 Hz, R = 0.5 m and full lock.
    """
    gaits, frequencies = (("trot",), (0.67,)) if quick else (WALK_GAITS, FREQUENCIES)
    radii = (0.5, FULL_LOCK) if quick else (*RADII, FULL_LOCK)
    left = [_turn(*case) for case in itertools.product(gaits, frequencies, radii, STRATEGIES)]
    right = [
        _turn(*case)
        for case in itertools.product(gaits[:2], (0.67,), radii, STRATEGIES, ("right",))
    ]
    built = [
        _turn("trot", 0.67, 0.5, name, stride=HARDWARE_STRIDE, profiles=_BUILT)
        for name in STRATEGIES
    ]
    return (*left, *right, *built)


def walked_turns(settings: Settings) -> list[Case]:
    """The cases that are simulated: without full lock if the controller requires a path."""
    locks = settings.controller is None or not settings.controller.needs_path
    return [
        case for case in turn_cases(settings.quick) if locks or case.labels["radius"] != FULL_LOCK
    ]


def walk_turns(settings: Settings) -> CaseRuns:
    """Turn in all cases: the quarter circles in one batch, full lock in another, whose pilot holds its command.

    Full lock is omitted for a controller that requires a path.
    """
    parts: list[dict[str, np.ndarray]] = []
    recordings: dict[str, Recording] = {}
    walked = walked_turns(settings)
    locks = any(case.labels["radius"] == FULL_LOCK for case in walked)
    previous_length = 0.0
    for pilot, share in (("arc", 0.8), ("open_loop", 0.2)) if locks else (("arc", 1.0),):
        turn_cases = [
            case
            for case in walked
            if (case.labels["radius"] == FULL_LOCK) == (pilot == "open_loop")
            and set(case.profiles) & set(settings.profiles)
        ]
        if not turn_cases:
            continue
        simulator = Simulator(
            settings.setup("quarter_circles", pilot=pilot), engine=settings.engine
        )
        defaults = simulator.setup.defaults()
        batch = cases.worlds(turn_cases, defaults, settings)
        # Right turns are mirror images of left ones: they also start on the other pair of legs. Only trot and walking
        # trot turn right, whose two diagonal pairs are half a cycle apart.
        right = batch.labels["side"] == "right"
        start = {
            name: np.where(right, -batch.values[name], batch.values[name])
            for name in ("start.x", "start.yaw")
        }
        start["start.phase"] = batch.values["start.phase"] + 0.5 * right
        batch = Worlds(batch.labels, batch.values | start)
        values = batch.all_values(defaults)
        length = _turn_length(values, batch.labels["radius"])

        def tell(done: float, before: float = previous_length, share: float = share) -> None:
            settings.progress(before + share * done) if settings.progress else None

        result = simulator.run(batch.values, length, progress=tell)
        warmup, end = length.seconds(values["frequency"] / values["tracking.clock_ratio"])
        parts.append(
            _judged(cases.measured(batch, result), end - warmup, values["stance.max_stride"])
        )
        previous_length += share
        if pilot == "arc":
            stride = HARDWARE_STRIDE if settings.profiles[0] == "as_built" else 1.0
            shown_cases = [
                _turn("trot", 0.67, 0.5, name, "left", stride, profiles=settings.profiles)
                for name in STRATEGIES
            ]
            names = [f"trot, 0.67 Hz, R = 0.5 m, {name}" for name in STRATEGIES]

            def length_of(worlds_of_case: Worlds, defaults: Mapping[str, float] = defaults) -> Run:
                return _turn_length(
                    worlds_of_case.all_values(defaults), worlds_of_case.labels["radius"]
                )

            recordings = _record(simulator, shown_cases, settings, length_of, names)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return CaseRuns.of("turning", columns, recordings)


def _turn_length(values: Mapping[str, np.ndarray], radius: np.ndarray) -> Run:
    """Time for a quarter circle at the slowest accepted speed; some cycles at full lock."""
    if (radius == FULL_LOCK).all():
        return Run(cycles=_LOCK_CYCLES, warmup_cycles=2.0)
    arc = radius * np.pi / 2
    cycle_length = theory.speed(values) / values["frequency"] * values["tracking.clock_ratio"]
    return Run(
        cycles=1.0 + np.ceil(arc / (_IN_TIME * cycle_length)), warmup_cycles=1.0, distance=arc
    )


def _judged(
    columns: dict[str, np.ndarray], longest: np.ndarray, max_stride: np.ndarray
) -> dict[str, np.ndarray]:
    """Add time, `followed` and theoretical radii; a world that did not arrive was measured for `longest` [s]."""
    radius, strategy = columns["radius"], columns["strategy"]
    lock = radius == FULL_LOCK
    near = columns["cross_track_peak"] <= bound(radius)
    arrived = columns["duration"] < longest - 0.05
    strides = columns["stride"] * max_stride
    theory_radius = [
        theory.theory_radius(str(name), l_s) for name, l_s in zip(strategy, strides, strict=True)
    ]
    equal = [theory.equal_stride_radius(AMPLITUDE, l_s) for l_s in strides.tolist()]
    return columns | {
        "time": np.where(lock, np.nan, radius * np.pi / 2 / columns["speed"]),
        "followed": near & arrived & (columns["status"] == "ok") & ~lock,
        "theory_radius": np.where(lock, theory_radius, np.nan),
        "theory_equal_strides": np.where(lock & (strategy == "spine"), equal, np.nan),
    }


def bound(radius: np.ndarray) -> np.ndarray:
    """Largest cross-track error of the torso on a path that counts as followed [m]."""
    return np.maximum(BOUND_SHARE * radius, LEAST_BOUND)


# --- maze: along way points, turned by the legs alone, and by legs and spine with longer strides

MAZE_FREQUENCY: Final = 0.67
#: Way points (x, y) of the maze's path [m]; see `experiments.yaml`.
MAZE_COURSE: Final[tuple[tuple[float, float], ...]] = tuple(
    (x, y) for x, y in cases.texts("maze_course")
)
#: The end is reached if the torso passes it within this distance [m], half the robot's length.
_PASSES: Final = 0.1
#: Ticks between two checks of the contacts: a touch lasts longer than 20 ms.
_LOOK: Final = 2
#: A run ends after the time needed at this share of the theoretical speed.
_SLOWEST: Final = 0.28


@functools.cache
def maze_course() -> Course:
    """The smooth course through `MAZE_COURSE`."""
    return course_through(MAZE_COURSE)


def maze_cases() -> tuple[Case, ...]:
    """Without the spine: leg-based turning. With it: mix-based turning and stride extension.

    Path and pilot are not the author's, with which `as_published` runs into a box at the first bends.
    """
    cases = []
    for profiles, stride in ((SIMULATED, 1.0), (_BUILT, HARDWARE_STRIDE)):
        for spine, steering in ((False, "leg"), (True, "mix")):
            values = {
                "frequency": MAZE_FREQUENCY,
                "spine.amplitude": AMPLITUDE * spine,
                "stride": stride,
                **_GUIDED,
            }
            cases.append(Case({"spine": spine}, "trot", steering, values, profiles))
    return tuple(cases)


def walk_maze(settings: Settings) -> CaseRuns:
    """Walk through the maze in all cases, in one batch.

    A quick run covers the first metre only, so that no world reaches the end.
    """
    setup = settings.setup(
        "maze", spine="stride_extension", pilot="waypoints", waypoints=MAZE_COURSE
    )
    simulator = Simulator(setup, engine=settings.engine)
    batch = cases.worlds(maze_cases(), setup.defaults(), settings)
    length = 1.0 if settings.quick else maze_course().length + 2 * _PASSES
    walk = Run(cycles=np.ceil(length / (_SLOWEST * 0.12)), warmup_cycles=2.0, distance=length)
    result = simulator.run(batch.values, walk, record=True, progress=settings.progress)
    assert result.trace is not None
    columns = (
        cases.measured(batch, result)
        | _arrivals(result.trace)
        | touches(simulator.robot, result.trace)
    )
    if settings.quick:
        columns["reached"] = np.full(len(columns["reached"]), np.nan)
    labels = batch.labels
    shown_rows = np.flatnonzero((labels["repeat"] == 0) & (settings.bodies is None)).tolist()
    names = {
        i: f"{labels['profile'][i]}, {'with' if labels['spine'][i] else 'without'} spine"
        for i in shown_rows
    }
    return CaseRuns.of("maze", columns, cases.recordings_of(simulator, batch, result, names))


def _arrivals(trace: History) -> dict[str, np.ndarray]:
    """Time at which each world's torso passes the end of the path."""
    course = maze_course()
    end = np.array([course.x[-1], course.y[-1]])
    ahead = np.array([np.cos(course.heading[-1]), np.sin(course.heading[-1])])
    beyond = trace.sensors["position"][..., :2] - end
    past = (beyond @ ahead >= 0.0) & (np.linalg.norm(beyond, axis=-1) < _PASSES)
    reached = past.any(axis=1)
    time = np.where(reached, trace.time[np.argmax(past, axis=1)], np.nan)
    return {"time": time, "mean_speed": course.length / time, "reached": reached.astype(float)}


def touches(robot: Robot, trace: History) -> dict[str, np.ndarray]:
    """Duration of each world's contacts with boxes, and the boxes touched, from MuJoCo's contacts in the recorded
    poses."""
    data = mujoco.MjData(robot.model)
    obstacles = np.array(robot.obstacles)
    seconds, names = [], []
    for poses in trace.qpos:
        time, boxes = 0.0, set[int]()
        for qpos in poses[::_LOOK]:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(robot.model, data)
            mujoco.mj_comPos(robot.model, data)
            mujoco.mj_collision(robot.model, data)
            geoms = data.contact.geom[data.contact.dist < 0.0]
            hit = set(np.intersect1d(geoms, obstacles).tolist())
            boxes |= hit
            time += bool(hit) * _LOOK * float(trace.time[0])
        seconds.append(time)
        names.append(
            " ".join(robot.model.geom(box).name.removeprefix("obstacle_") for box in sorted(boxes))
        )
    return {"touched": np.array(seconds), "boxes": np.array(names)}


def box_outlines(robot: Robot) -> np.ndarray:
    """Corners of the boxes seen from above, (boxes, 4, 2) [m]."""
    model: Any = robot.model
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    outlines = []
    for box in robot.obstacles:
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[box])
        turned = corners * model.geom_size[box][:2] @ turn.reshape(3, 3)[:2, :2].T
        outlines.append(model.geom_pos[box][:2] + turned)
    return np.array(outlines)
