"""The experiments that walk: straight line, turning and maze. A design is a list of named rows, walked in one batch.

The simulated profiles walk with full strides. The hardware ran at a normalised stride of 0.8 (Table 6.1), and so does
`as_built`. The text on the turning test (A.4.2) keeps the stride "constant at 0.08", evidently a misprint (erratum 6).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.control.parameters import SIMULATED
from nermo_mjx.control.path import Course, course_through
from nermo_mjx.experiments import cycle, theory
from nermo_mjx.experiments.cases import (
    AMPLITUDE,
    BODY,
    FREQUENCIES,
    LABELS,
    Case,
    Column,
    Label,
    Outcome,
    Settings,
    Worlds,
    columns_of,
    measured,
    recorded,
    recordings_of,
    worlds,
)
from nermo_mjx.recording import Recording
from nermo_mjx.robot import Robot
from nermo_mjx.rollout import History, Run, Simulator

HARDWARE_STRIDE: Final = 0.8
#: Paths are followed by this project's pilot in all profiles. None of the author's gains (25 and 200 on 2 August 2021,
#: 40 and 300 on the 8th) is known to be that of a test; with the former no circle of 0.5 m is followed within 25 mm.
_GUIDED: Final = {"pilot.guidance": 1.0, "pilot.error_gain": 0.0, "pilot.change_gain": 0.0}
_BUILT: Final = ("as_built",)

# --- straight line, 2.0 m: speed and orientation over gait, frequency, stride and spine

DISTANCE: Final = 2.0
#: Maximum number of gait cycles of a run that does not reach the end of the line, such as one without a stride.
_LONGEST: Final = 60.0
_WARMUP: Final = 2.0
_RECORDED: Final = 8.0
_LINE: Final = {
    "stride": Column("1", "stride length, as a share of the maximum"),
    "spine": Column("1", "whether the spine extends the strides"),
    "compensated": Column("1", "whether the rear legs compensate the hips' rise"),
    "theory_speed": Column("m/s", "speed without slip (5.21, 5.22, 5.33)"),
}


def _line(
    gait: str, frequency: float, spine: bool, stride: float = 1.0, compensated: bool = False,
    profiles: tuple[str, ...] = SIMULATED,
) -> Case:  # fmt: skip
    labels: dict[str, Label] = {
        "gait": gait, "frequency": frequency, "stride": stride, "spine": spine, "compensated": compensated,
    }  # fmt: skip
    # Without the author's PD pilot, as his own model beside it. The guidance of the other profiles has no such gains.
    values = {"frequency": frequency, "stride": stride, "spine.amplitude": AMPLITUDE * spine,
              "spine.offset_compensation": float(compensated),
              "pilot.error_gain": 0.0, "pilot.change_gain": 0.0}  # fmt: skip
    return Case(labels, gait, values=values, profiles=profiles)


def _standing() -> Case:
    """The robot that stands on its neutral feet."""
    case = _line("trt", 0.8, False, 0.0)
    still = {"stance.swing_amplitude": 0.0, "stance.stance_amplitude": 0.0}
    return Case({**case.labels, "gait": "stand"}, "trt", values={**case.values, **still}, profiles=case.profiles)


def line_cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases, and a robot that stands; `quick` keeps those at 0.8 Hz and the compensation's."""
    frequencies = FREQUENCIES[-1:] if quick else FREQUENCIES
    both = (False, True)
    gaits = [_line(gait, f, spine) for f in frequencies for gait in ("trt", "trt1") for spine in both]
    lateral = [_line("lat", f, False) for f in frequencies]
    strides = [_line("trt", 0.8, spine, stride) for stride in (0.0, 0.5, 0.8) for spine in both]
    compensated = [_line("trt", 0.67, True, compensated=True)] + ([_line("trt", 0.67, True)] if quick else [])
    built = [
        _line(gait, f, spine, HARDWARE_STRIDE, profiles=_BUILT)
        for f in FREQUENCIES
        for gait, spine in (("trt", False), ("trt", True), ("lat", False))
    ]
    return (_standing(), *gaits, *lateral, *strides, *compensated, *built)


def walk_line(settings: Settings) -> Outcome:
    """Simulate all cases in one batch, and those whose gait cycle is analysed in another, which is recorded.

    Quick: fewer cases, and half a metre.
    """
    simulator = Simulator(settings.setup("straight_line", spine="stride_extension"), engine=settings.engine)
    defaults, quick = simulator.setup.defaults(), settings.quick
    batch = worlds(line_cases(quick), defaults, settings)
    length = Run(cycles=_LONGEST / (4 if quick else 1), warmup_cycles=_WARMUP, distance=0.5 if quick else DISTANCE)
    columns, about = measured(simulator, batch, length, progress=settings.progress)
    columns["theory_speed"] = theory.speed(batch.all_values(defaults))
    # The publication describes the gait cycle of the trot at 0.8 Hz, with two strides.
    looked_into = np.logical_or.reduce(
        [_is(batch, _line("trt", 0.8, spine, stride)) for stride in (0.8, 1.0) for spine in (False, True)]
    )
    columns |= cycle.measured(simulator, batch, looked_into, Run(_WARMUP + (4.0 if quick else _RECORDED), _WARMUP))
    recordings = {}
    if settings.bodies is None:
        shown = [_line("trt", 0.67, False), _line("trt", 0.67, True)]
        names = [f"trt, 0.67 Hz, {'with' if case.labels['spine'] else 'without'} spine" for case in shown]
        one = settings.of_one_run()
        if one.profiles[0] in SIMULATED:
            runs = worlds(shown, defaults, one)
            recordings = recorded(simulator, runs, Run(cycles=4.0 if quick else _RECORDED), names)
    return Outcome("straight-line", columns, LABELS | _LINE | about | cycle.ABOUT, recordings)


def _is(batch: Worlds, case: Case) -> np.ndarray:
    """Mask (n,) of the worlds of a case."""
    return np.logical_and.reduce([batch.labels[name] == value for name, value in case.labels.items()])


# --- turning: quarter circles and full lock over gait, frequency and strategy

RADII: Final = (1.0, 0.5)
#: Radius that represents full lock, as in the publication: the turn rate is held at its maximum.
FULL_LOCK: Final = 0.0
STRATEGIES: Final = ("leg", "spine", "mix")
GAITS: Final = ("trt", "trt1", "lat")
SIDES: Final = {"left": 1.0, "right": -1.0}
#: A path is followed if the torso, including its sway, stays this close to it: 5 % of its radius, at least 2.5 cm.
BOUND_SHARE: Final = 0.05
LEAST_BOUND: Final = 0.025
#: In time means at least this share of the theoretical speed.
_IN_TIME: Final = 0.3
_LOCK_CYCLES: Final = 14.0
_TURN: Final = {
    "radius": Column("m", "of the quarter circle; 0 is full lock"),
    "strategy": Column("1", "what turns the robot: leg, spine, or mix of both"),
    "side": Column("1", "left or right"),
    "stride": Column("1", "stride length, as a share of the maximum"),
    "time": Column("s", "simulated time for the quarter circle at the measured speed; NaN at full lock"),
    "followed": Column("1", "whether the path was followed to its end in time; false at full lock"),
    "theory_radius": Column("m", "at full lock without slip (5.40-5.44); NaN on a quarter circle"),
    "theory_equal_strides": Column(
        "m", "at full lock by the spine, two feet with equal strides that slip least; NaN for other cases"
    ),
}


def _turn(
    gait: str, frequency: float, radius: float, strategy: str, side: str = "left", stride: float = 1.0,
    profiles: tuple[str, ...] = SIMULATED,
) -> Case:  # fmt: skip
    values = {"frequency": frequency, "stride": stride, "spine.amplitude": 0.0, "spine.max_servo_angle": AMPLITUDE}
    if radius == FULL_LOCK:
        values["pilot.turn_rate"] = SIDES[side]
    else:
        values |= {"pilot.radius": radius, "pilot.direction": SIDES[side], **_GUIDED}
    labels: dict[str, Label] = {"gait": gait, "frequency": frequency, "radius": radius, "strategy": strategy,
                                "side": side, "stride": stride}  # fmt: skip
    return Case(labels, gait, strategy, values, profiles)


def turn_cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases to the left, trot and walking trot at 0.67 Hz to the right as well, and the hardware's.

    `quick`: trot at 0.67 Hz, R = 0.5 m and full lock.
    """
    gaits, frequencies = (("trt",), (0.67,)) if quick else (GAITS, FREQUENCIES)
    radii = (0.5, FULL_LOCK) if quick else (*RADII, FULL_LOCK)
    left = [_turn(*case) for case in itertools.product(gaits, frequencies, radii, STRATEGIES)]
    right = [_turn(*case) for case in itertools.product(gaits[:2], (0.67,), radii, STRATEGIES, ("right",))]
    built = [_turn("trt", 0.67, 0.5, name, stride=HARDWARE_STRIDE, profiles=_BUILT) for name in STRATEGIES]
    return (*left, *right, *built)


def walk_turns(settings: Settings) -> Outcome:
    """Turn in all cases: the quarter circles in one batch, full lock in another, whose pilot holds its command.

    Full lock is left out for a controller that needs a path.
    """
    parts: list[dict[str, np.ndarray]] = []
    about: dict[str, Column] = {}
    recordings: dict[str, Recording] = {}
    locks = settings.controller is None or not settings.controller.needs_path
    before = 0.0
    for pilot, share in (("arc", 0.8), ("open_loop", 0.2)) if locks else (("arc", 1.0),):
        locked = pilot == "open_loop"
        chosen = [
            case for case in turn_cases(settings.quick)
            if (case.labels["radius"] == FULL_LOCK) == locked and set(case.profiles) & set(settings.profiles)
        ]  # fmt: skip
        if not chosen:
            continue
        simulator = Simulator(settings.setup("quarter_circles", pilot=pilot), engine=settings.engine)
        defaults = simulator.setup.defaults()
        batch = _mirrored_starts(worlds(chosen, defaults, settings))
        everything = batch.all_values(defaults)
        length = _turn_length(everything, batch.labels["radius"])
        report = None if settings.progress is None else _part(settings.progress, before, share)
        columns, about = measured(simulator, batch, length, progress=report)
        warmup, end = length.seconds(everything["frequency"] / everything["tracking.clock_ratio"])
        parts.append(_judged(columns, end - warmup, everything["stance.max_stride"]))
        before += share
        if not locked and settings.bodies is None:
            stride = HARDWARE_STRIDE if settings.profiles[0] == "as_built" else 1.0
            shown = [
                _turn("trt", 0.67, 0.5, name, stride=stride, profiles=tuple(settings.profiles)) for name in STRATEGIES
            ]
            one = worlds(shown, defaults, settings.of_one_run())
            names = [f"trt, 0.67 Hz, R = 0.5 m, {case.labels['strategy']}" for case in shown]
            recordings = recorded(simulator, one, _turn_length(one.all_values(defaults), one.labels["radius"]), names)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Outcome("turning", columns, LABELS | _TURN | about, recordings)


def _mirrored_starts(batch: Worlds) -> Worlds:
    """The batch, with right turns as the mirror images of left ones: they also start on the other pair of legs.

    Only for trot and walking trot, whose two diagonal pairs are half a cycle apart.
    """
    right = batch.labels["side"] == "right"
    start = {name: np.where(right, -batch.values[name], batch.values[name]) for name in ("start.x", "start.yaw")}
    return Worlds(batch.labels, batch.values | start | {"start.phase": batch.values["start.phase"] + 0.5 * right})


def _part(progress: Callable[[float], None], before: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(before + share * done)


def _turn_length(values: Mapping[str, np.ndarray], radius: np.ndarray) -> Run:
    """Time for a quarter circle at the slowest accepted speed; some cycles at full lock."""
    if (radius == FULL_LOCK).all():
        return Run(cycles=_LOCK_CYCLES, warmup_cycles=2.0)
    arc = radius * np.pi / 2
    cycle_length = theory.speed(values) / values["frequency"] * values["tracking.clock_ratio"]
    return Run(cycles=1.0 + np.ceil(arc / (_IN_TIME * cycle_length)), warmup_cycles=1.0, distance=arc)


def _judged(columns: dict[str, np.ndarray], longest: np.ndarray, max_stride: np.ndarray) -> dict[str, np.ndarray]:
    """Adds time, `followed` and the radii of theory; a world that has not arrived was measured for `longest` [s]."""
    radius, strategy = columns["radius"], columns["strategy"]
    lock = radius == FULL_LOCK
    near = columns["cross_track_peak"] <= bound(radius)
    arrived = columns["duration"] < longest - 0.05
    strides = columns["stride"] * max_stride
    theory_radius = [theory.smallest_radius(str(name), l_s) for name, l_s in zip(strategy, strides, strict=True)]
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
#: Way points (x, y) of the maze's path [m], in the frame of the scene `maze` (x left, y backward). The published path
#: is not available; this one follows the published layout: from the origin, heading -y, through the corridor between
#: the boxes 32 and 39, past the island (boxes 1 to 7) on its left, once around it to the right, and out between the
#: boxes 8 and 34, until the tail has left the gap, too. The points were placed once by maximizing the clearance from
#: the boxes while bounding the curvature, and rounded to 5 mm. As drawn: 4.97 m long, at least 0.150 m from every box,
#: radius of curvature at least 0.354 m (checked by a test).
MAZE_COURSE: Final[tuple[tuple[float, float], ...]] = (
    (0.0, 0.0), (0.0, -0.15), (0.0, -0.345), (0.02, -0.61), (0.12, -0.845), (0.265, -1.105), (0.265, -1.335),
    (0.145, -1.52), (-0.195, -1.615), (-0.43, -1.485), (-0.525, -1.26), (-0.465, -1.02), (-0.205, -0.84),
    (0.08, -0.885), (0.34, -1.075), (0.59, -1.175), (0.865, -1.12), (1.025, -0.95), (1.075, -0.695), (1.08, -0.48),
)  # fmt: skip
#: The end is reached if the torso passes it within this distance [m], half the robot's length.
_PASSES: Final = 0.1
#: Ticks between two checks of the contacts: a touch lasts longer than 20 ms.
_LOOK: Final = 2
#: A run ends after the time needed at this share of the theoretical speed.
_SLOWEST: Final = 0.28
_MAZE: Final = {
    "spine": Column("1", "whether the spine turns along and extends the strides"),
    "time": Column("s", "simulated time from the start to the end of the path; NaN if it is not reached"),
    "mean_speed": Column("m/s", "length of the path over time"),
    "reached": Column("1", "1 if the end was reached, 0 if not; NaN if only the first metre was walked"),
    "touched": Column("s", "simulated time in contact with a box"),
    "boxes": Column("1", "numbers of the boxes touched, joined by spaces"),
}


@functools.cache
def maze_course() -> Course:
    """The smooth course through `MAZE_COURSE`."""
    return course_through(MAZE_COURSE)


def maze_cases() -> tuple[Case, ...]:
    """Without the spine: leg-based turning. With it: mix-based turning and stride extension.

    Path and pilot are this project's: with the author's, `as_published` runs into a box at the first bends.
    """
    return tuple(
        Case({"spine": spine}, "trt", strategy,
             {"frequency": MAZE_FREQUENCY, "spine.amplitude": AMPLITUDE * spine, "stride": stride, **_GUIDED}, profiles)
        for profiles, stride in ((SIMULATED, 1.0), (_BUILT, HARDWARE_STRIDE))
        for spine, strategy in ((False, "leg"), (True, "mix"))
    )  # fmt: skip


def walk_maze(settings: Settings) -> Outcome:
    """Walk through the maze in all cases, in one batch.

    Quick: the first metre only, so that no run reaches the end.
    """
    setup = settings.setup("maze", spine="stride_extension", pilot="waypoints", waypoints=MAZE_COURSE)
    simulator = Simulator(setup, engine=settings.engine)
    batch = worlds(maze_cases(), setup.defaults(), settings)
    length = 1.0 if settings.quick else maze_course().length + 2 * _PASSES
    walk = Run(cycles=np.ceil(length / (_SLOWEST * 0.12)), warmup_cycles=2.0, distance=length)
    result = simulator.run(batch.values, walk, record=True, progress=settings.progress)
    assert result.trace is not None
    columns, about = columns_of(batch, result)
    columns |= _arrivals(result.trace) | touches(simulator.robot, result.trace)
    if settings.quick:
        columns["reached"] = np.full(len(columns["reached"]), np.nan)
    shown = (batch.labels["repeat"] == 0) & (settings.bodies is None)
    names = [
        f"{profile}, {'with' if spine else 'without'} spine"
        for profile, spine in zip(batch.labels["profile"], batch.labels["spine"], strict=True)
    ]
    recordings = recordings_of(simulator, batch, result, {i: names[i] for i in np.flatnonzero(shown).tolist()})
    labels = {name: LABELS[name] for name in ("profile", "repeat", BODY)}
    return Outcome("maze", columns, labels | _MAZE | about, recordings)


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
        names.append(" ".join(robot.model.geom(box).name.removeprefix("obstacle_") for box in sorted(boxes)))
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
