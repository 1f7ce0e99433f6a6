"""Maze: trot at 0.67 Hz along the way points, turned by the legs alone, and by legs and spine with longer strides."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.experiments.cases import AMPLITUDE, LABELS, Case, recordings_of, table_of, worlds
from nermo_mjx.experiments.maze_course import MAZE_COURSE, maze_course
from nermo_mjx.experiments.outcome import BODY, Column, Outcome
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.robot import Robot
from nermo_mjx.rollout import History, Run, Simulator

NAME: Final = "maze"
FREQUENCY: Final = 0.67
#: The end is reached if the torso passes it within this distance [m], half the robot's length.
_PASSES: Final = 0.1
#: Ticks between two checks of the contacts: a touch lasts longer than 20 ms.
_LOOK: Final = 2
#: A run ends after the time needed at this share of the theoretical speed.
_SLOWEST: Final = 0.45
_LABELS: Final = {name: LABELS[name] for name in ("profile", "repeat", BODY)}
_ABOUT: Final = {
    "spine": Column("1", "whether the spine turns along and extends the strides"),
    "time": Column("s", "simulated time from the start to the end of the path; NaN if it is not reached"),
    "mean_speed": Column("m/s", "length of the path over time"),
    "reached": Column("1", "1 if the end was reached, 0 if not; NaN if only the first metre was walked"),
    "touched": Column("s", "simulated time in contact with a box"),
    "boxes": Column("1", "numbers of the boxes touched, joined by spaces"),
}


def cases() -> tuple[Case, ...]:
    """Without the spine: leg-based turning. With it: mix-based turning and stride extension."""
    return tuple(
        Case({"spine": spine}, "trt", strategy, {"frequency": FREQUENCY, "spine.amplitude": AMPLITUDE * spine})
        for spine, strategy in ((False, "leg"), (True, "mix"))
    )


def run(settings: Settings) -> Outcome:
    """Walk through the maze in all cases, in one batch.

    Quick: the first metre only, so that no run reaches the end.
    """
    setup = settings.setup("maze", spine="stride_extension", pilot="waypoints", waypoints=MAZE_COURSE)
    simulator = Simulator(setup, engine=settings.engine)
    batch = worlds(cases(), setup.defaults(), settings)
    length = 1.0 if settings.quick else maze_course().length + 2 * _PASSES
    cycles = np.ceil(length / (_SLOWEST * 0.12))
    walk = Run(cycles=cycles, warmup_cycles=2.0, distance=length)
    result = simulator.run(batch.values, walk, record=True, progress=settings.progress)
    assert result.trace is not None
    columns, about = table_of(batch, result)
    columns |= _arrivals(result.trace) | touches(simulator.robot, result.trace)
    if settings.quick:
        columns["reached"] = np.full(len(columns["reached"]), np.nan)
    shown = (batch.labels["repeat"] == 0) & (settings.bodies is None)
    names = [
        f"{profile}, {'with' if spine else 'without'} spine"
        for profile, spine in zip(batch.labels["profile"], batch.labels["spine"], strict=True)
    ]
    recordings = recordings_of(simulator, batch, result, {i: names[i] for i in np.flatnonzero(shown).tolist()})
    return Outcome(NAME, columns, _LABELS | _ABOUT | about, recordings)


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
