"""The published experiments by name: how each is run, its description, and its video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Final

from nermo_mjx.experiments import balance, stands, walks
from nermo_mjx.experiments.cases import Outcome, Settings, settable
from nermo_mjx.experiments.lines import Figure, figures
from nermo_mjx.robot.quantity import choice


@dataclasses.dataclass(frozen=True)
class Shot:
    """The content of a video.

    Attributes:
        recording: part of the recording's name; if none matches, the last recording is shown.
        camera: a following view.
        speed: 1 is real time; a run that has an end is shown faster if it would take too long.
        until: column with the simulated time at which the run reached its end, if it has one.
    """

    recording: str = ""
    camera: str = "three_quarter"
    speed: float = 1.0
    until: str = ""

    def choose(self, outcome: Outcome) -> str | None:
        """Name of the recording that is shown; None if there is none."""
        names = list(outcome.recordings)
        return next((name for name in names if self.recording in name), names[-1] if names else None)


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A published experiment.

    Attributes:
        name: as on the command line.
        run: simulates all its cases.
        settable: parameters that may be set for all its worlds.
        title: for the report.
        description: what is done and when it counts, in sentences.
        quick: what a quick run omits.
        metrics: columns shown in the report for every case, with theory next to simulation.
        needs: column -> the column that must be a number for it to be meaningful.
        shot: the view of the video.
        walks: whether another controller can take the place of the published one.
        own_figures: in place of those of `published.yaml`.
    """

    name: str
    run: Callable[[Settings], Outcome]
    settable: frozenset[str]
    title: str
    description: str
    quick: str = "nothing is left out"
    metrics: tuple[str, ...] = ()
    needs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    shot: Shot = dataclasses.field(default_factory=Shot)
    walks: bool = False
    own_figures: tuple[Figure, ...] | None = None

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Published figures, and how they are measured here."""
        return figures(self.name) if self.own_figures is None else self.own_figures


_LINE: Final = f"""\
The robot walks {walks.DISTANCE:g} m straight ahead: trot (trt) and walking trot (trt1) without and with the spine's \
stride extension (0.1 rad in each joint), lateral sequence walk (lat) without it, each at 0.5, 0.67 and 0.8 Hz; trot \
at 0.8 Hz with shorter strides down to none; trot at 0.67 Hz with offset compensation; and it stands. `as_built` walks \
the trot and the lateral walk at the hardware's stride of {walks.HARDWARE_STRIDE:g}. Speed and orientation are \
measured after the start-up transient of two gait cycles, over whole gait cycles. The theory is the speed of feet that \
do not slip (5.21, 5.22, 5.33)."""
_TURNING: Final = f"""\
Quarter circles of {" and ".join(f"{r:g}" for r in walks.RADII)} m, and full lock (radius 0), at 0.5, 0.67 and 0.8 Hz \
in the gaits trt, trt1 and lat, turned by the legs, by the spine, or by both (mix), to the left; trt and trt1 at 0.67 \
Hz to the right as well. The stride is the largest; `as_built` walks the hardware's three circles at its stride of \
{walks.HARDWARE_STRIDE:g}. A path counts as *followed* if the torso, with all its sway, stays within \
{walks.BOUND_SHARE:.0%} of the radius of it, or {1e3 * walks.LEAST_BOUND:g} mm if that is more, and its end is reached \
in time. The smallest radius is that of the circle fitted to the torso's steady path at full lock; the theory is the \
radius without slip (5.40 to 5.44). (5.43), that of the spine, presumes shorter inner strides; point feet with equal \
strides turn in 0.44 m."""
_BALANCE: Final = """\
From its own static stance the robot lifts one leg, compresses it fully with the knee servo, and swings it through the \
whole range of hip or shoulder, -0.7 to 0.7 rad; each leg without and with spine balance compensation (SBC). It \
*passes* if it does not tip over its stability diagonal and the lifted foot never touches the ground during the swing. \
The theory is the distance of the centre of mass from that diagonal (5.35): positive inside."""
_MAZE: Final = f"""\
Trot at {walks.MAZE_FREQUENCY:g} Hz through the published maze, along way points of {walks.maze_course().length:.2f} \
m: without the spine, turned by the legs alone; with the spine, turned by legs and spine, with longer strides. The \
published path is not available; this one was drawn once, clear of the boxes, and is the same in all runs. A touch is \
a contact of any part of the robot with a box."""
_BODY: Final = f"""\
What is measured without a walk: dimensions of the standing robot by its visible parts, mass, and how far knees and \
spine bend under the load of the publication's finite elements, {stands.TORQUE:g} N m, on their test stands."""
_LEG_STAND: Final = """\
One leg without gravity, its hip axis fixed, for each routing of the knee's tendon: the downward pull at the neutral \
foot at which the first of its two servos reaches its torque limit; the speed of the rising foot per rad/s of the knee \
servo, times its 15 rad/s; the work of both servos, where they drive, in a slow swing of 60 mm that is 10 mm high; and \
the knee's bend per swing of the hip while the knee servo is held. The bend of the knee under the load of the finite \
elements is that of chains of hinges, too. The publication compares the routings in words (Table 5.2)."""
_SPINE_STAND: Final = """\
The spine without gravity, its base fixed, bent by one or both of its servos: the force against the bend at the hip of \
the straight spine at which a servo reaches its torque limit; the speed of the hip per rad/s of the servos, times \
their 15 rad/s; the work of a slow bend to 0.4 rad of the servos, and the range of the hip between both sides. The \
bend of the spine under the load of the finite elements is that of chains of hinges, too."""

EXPERIMENTS: Final[dict[str, Experiment]] = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "straight-line", walks.walk_line, settable(walks.line_cases()),
            f"Straight line, {walks.DISTANCE:.1f} m", _LINE,
            quick="0.8 Hz and the offset compensation only, over half a metre",
            metrics=(
                "speed", "theory_speed", "slip", "loaded_front", "loaded_rear", "front_load_share", "tail_time",
                "roll_std", "pitch_mean", "pitch_std", "yaw_std",
            ),
            shot=Shot("with spine"), walks=True,
        ),
        Experiment(
            "turning", walks.walk_turns, settable(walks.turn_cases()), "Turning", _TURNING,
            quick="trot at 0.67 Hz only, on 0.5 m and at full lock",
            metrics=(
                "speed", "time", "followed", "cross_track_peak", "turning_radius", "theory_radius",
                "theory_equal_strides",
            ),
            needs={"followed": "cross_track_peak"}, shot=Shot("mix", speed=2.0, until="time"), walks=True,
        ),
        Experiment(
            "balance", balance.run, balance.SETTABLE, "Balance", _BALANCE, quick="one repeat",
            metrics=(
                "passed", "upright", "clear", "impact", "tilt_max", "pitch_rest", "theory_margin", "com_margin_lift",
                "com_margin_swing",
            ),
            shot=Shot("rear_left sbc"),
        ),
        Experiment(
            "maze", walks.walk_maze, settable(walks.maze_cases()), "Maze", _MAZE,
            quick="the first metre only, so that no run reaches the end",
            metrics=("reached", "time", "mean_speed", "roll_std", "pitch_std", "touched", "boxes"),
            shot=Shot("as_published, with spine", camera="overview", speed=8.0, until="time"), walks=True,
        ),
        Experiment(
            "body", stands.run_body, stands.BODY_SETTABLE, "Body", _BODY, metrics=tuple(stands.BODY_ABOUT),
        ),
        Experiment(
            "leg-stand", stands.run_leg, stands.STAND_SETTABLE, "Leg on the test stand", _LEG_STAND,
            metrics=("force", "speed", "work", "coupling", "bend"),
        ),
        Experiment(
            "spine-stand", stands.run_spine, stands.STAND_SETTABLE, "Spine on the test stand", _SPINE_STAND,
            metrics=("joint_angle", "range", "force", "speed", "work", "bend"),
        ),
    )
}  # fmt: skip


def experiment(name: str) -> Experiment:
    """An experiment by name.

    Raises:
        ParameterError: an unknown name; the message suggests the closest one.
    """
    return EXPERIMENTS[choice("experiment", name, EXPERIMENTS)]
