"""The figures of a recording: gait diagram, orientation, foot paths, servo angles, path over the ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Final

import jax.numpy as jnp
import mujoco
import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nermo_mjx.control.parameters import ControlParameters, published_values
from nermo_mjx.control.stepping import FREE_TRAJECTORY, FreeStepping, Stepping
from nermo_mjx.kinematics.leg import forward_kinematics, four_legs
from nermo_mjx.plotting.charts import FigurePage, draw_horizontal_grid
from nermo_mjx.plotting.shown import spoken
from nermo_mjx.plotting.style import (
    FOOT,
    GRID,
    INK,
    LINE_COLOUR,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
    TAIL_COLOUR,
)
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import GAIT_CODES, GAITS, LIMBS, ParameterError, Robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import servos_by_count
from nermo_mjx.robot.quantity import quantities, replace_quantities
from nermo_mjx.view.recorded import (
    STANCE_NEWTONS,
    attitude_of,
    beside_log,
    own_geometry,
    recorded_model,
    robot_of,
    spans,
)

#: Gait cycles shown in figures of single steps: the last whole ones.
SHOWN_CYCLES: Final = 4


@dataclasses.dataclass(frozen=True)
class RecordedGait:
    """A recording, with the gait from its metadata."""

    recording: Recording

    @cached_property
    def values(self) -> dict[str, float]:
        """The parameters that are known by name."""
        setup = self.recording.metadata.get("setup", {})
        gait = GAIT_CODES.get(setup.get("gait"), setup.get("gait"))
        preset: dict[str, Any] = published_values(gait) if gait in GAITS else {}
        return preset | dict(self.recording.metadata.get("parameters", {}))

    @property
    def cycle(self) -> float | None:
        """Simulated time of a gait cycle [s]; None if the recording does not say."""
        frequency = self.values.get("frequency", 0.0)
        return self.values.get("tracking.clock_ratio", 1.0) / frequency if frequency > 0 else None

    @property
    def title(self) -> str:
        """The gait in words, after a colon, its frequency and the profile; empty if unknown."""
        setup = self.recording.metadata.get("setup", {})
        labels = self.recording.metadata.get("labels", {})
        gait = spoken(setup.get("gait") or labels.get("gait") or "")
        rate = "" if self.cycle is None else f" at {self.values['frequency']:.3g} Hz"
        profile = labels.get("profile") or setup.get("profile")
        return (f": {gait}" if gait else "") + rate + (f", profile {profile}" if profile else "")

    @cached_property
    def shown(self) -> tuple[slice, str]:
        """The samples of the last whole gait cycles, or all, and their description."""
        time = self.recording.time
        if self.cycle is None or time[-1] < self.cycle:
            return slice(None), "the whole recording"
        whole = int(time[-1] / self.cycle + 1e-6)
        count = min(SHOWN_CYCLES, whole)
        begin, end = np.searchsorted(
            time, [(whole - count) * self.cycle - 1e-9, whole * self.cycle + 1e-9]
        )
        return slice(
            int(begin), max(int(end), int(begin) + 2)
        ), f"the last {count} whole gait cycles"

    @cached_property
    def planned(self) -> np.ndarray | None:
        """Planned contact of each foot, (T, 4); None if the recording does not contain it."""
        if self.cycle is None or not {"duty", *(f"offset.{limb}" for limb in LIMBS)} <= set(
            self.values
        ):
            return None
        phase = (self.values.get("start.phase", 0.0) + self.recording.time / self.cycle) % 1.0
        names = {name for name, _ in quantities(ControlParameters)}
        values = {name: np.asarray(value) for name, value in self.values.items() if name in names}
        free = self.recording.metadata.get("setup", {}).get("trajectory") == FREE_TRAJECTORY
        stepping = FreeStepping() if free else Stepping()
        limbs = stepping.limbs(replace_quantities(ControlParameters(), values), jnp.asarray(phase))
        return np.asarray(limbs.stance)

    @cached_property
    def contact(self) -> np.ndarray | None:
        """Whether each foot bears a load, (T, 4); None without such a sensor."""
        force = self.recording.sensors.get("foot_force")
        return None if force is None else np.asarray(force) > STANCE_NEWTONS

    @cached_property
    def angles(self) -> np.ndarray | None:
        """Roll, pitch and yaw of the torso, (T, 3) [deg]; the yaw does not jump. None without such a sensor."""
        orientation = self.recording.sensors.get("orientation")
        return None if orientation is None else attitude_of(np.asarray(orientation, float))


def name_of(limb: str) -> str:
    """A limb's display name."""
    return limb.replace("_", " ")


def gait_diagram(walk: RecordedGait) -> Figure | None:
    """Hildebrand's bars: the measured contact in the foot's colour, the planned one as a thin black bar above it."""
    if walk.contact is None:
        return None
    part, what = walk.shown
    time, contact = walk.recording.time[part], walk.contact[part]
    planned = None if walk.planned is None else walk.planned[part]
    page = FigurePage(f"Gait diagram{walk.title}", (7.4, 3.9))
    ax = page.axes[0, 0]
    shares, names = [], [name_of(limb) for limb in LIMBS]
    for row, limb in enumerate(LIMBS):
        ax.broken_barh(
            spans(contact[:, row], time), (row - 0.18, 0.5), color=FOOT[limb], lw=0, zorder=3
        )
        share = f"{contact[:, row].mean():.2f}"
        if planned is not None:
            ax.broken_barh(
                spans(planned[:, row], time), (row - 0.36, 0.11), color=INK, lw=0, zorder=3
            )
            share = f"{share} ({planned[:, row].mean():.2f})"
        shares.append(share)
        ax.axhline(row + 0.5, color="white", lw=0)
    tail = walk.recording.sensors.get("tail_force")
    if tail is not None:
        bears = np.asarray(tail)[part] > STANCE_NEWTONS
        ax.broken_barh(
            spans(bears, time), (len(names) - 0.18, 0.5), color=TAIL_COLOUR, lw=0, zorder=3
        )
        shares.append(f"{bears.mean():.2f}")
        names.append("tail")
    if walk.cycle is not None:
        first = np.ceil(time[0] / walk.cycle - 1e-6)
        for k in np.arange(first, time[-1] / walk.cycle + 1e-6):
            ax.axvline(k * walk.cycle, color=MISSING_COLOUR, lw=0.9, zorder=1)
        above = ax.secondary_xaxis(
            "top", functions=(lambda t: t / walk.cycle, lambda c: c * walk.cycle)
        )
        above.set_xlabel("gait cycles [1]")
        above.xaxis.get_major_locator().set_params(integer=True)
        above.spines["top"].set_visible(False)
    ax.set_yticks(range(len(names)), names)
    right = ax.secondary_yaxis("right")
    right.set_yticks(range(len(names)), shares)
    right.set_ylabel("duty factor [1]")
    right.spines["right"].set_visible(False)
    for axis in (ax, right):
        axis.tick_params(axis="y", length=0, labelcolor=INK)
    ax.set(xlim=(time[0], time[-1]), ylim=(len(names) - 0.45, -0.6), xlabel="time [s]")
    ax.spines["left"].set_visible(False)
    handles: list[Artist] = [Patch(fc=MUTED_INK, label="measured, in the foot's colour")]
    if planned is not None:
        handles.append(Patch(fc=INK, label="planned"))
    note = f"{what}; measured: bears more than {STANCE_NEWTONS:g} N; duty factor: share of the time on the ground"
    return page.finish(handles, note + (", in brackets as planned" if planned is not None else ""))


#: With more gait cycles, the grid of cycles would be a grey area.
_MAX_GRID_CYCLES = 30


def orientation(walk: RecordedGait) -> Figure | None:
    """Roll, pitch and yaw over the whole recording."""
    if walk.angles is None:
        return None
    page = FigurePage(f"Orientation of the torso{walk.title}", (7.4, 5.6), 3, 1, sharex=True)
    time = walk.recording.time
    for ax, name, values in zip(
        page.axes[:, 0], ("roll", "pitch", "yaw"), walk.angles.T, strict=True
    ):
        ax.plot(time, values, color=LINE_COLOUR, lw=1.3, zorder=3)
        ax.set_ylabel(f"{name} [deg]")
        ax.margins(y=0.08)
        draw_horizontal_grid(ax)
        ax.annotate(
            f"{values.mean():.1f} ± {values.std():.1f}".replace("-", "−"),
            (1, 1.01),
            xycoords="axes fraction",
            ha="right",
            va="bottom",
            fontsize=8,
            color=MUTED_INK,
        )
        if walk.cycle is not None and time[-1] < _MAX_GRID_CYCLES * walk.cycle:
            for cycle in np.arange(walk.cycle, time[-1], walk.cycle):
                ax.axvline(cycle, color=GRID, lw=0.8, zorder=0)
    page.axes[-1, 0].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    page.figure.align_ylabels(page.axes[:, 0])
    return page.finish(
        [],
        "positive: leaning left, nose down, turned left; above each: mean ± standard deviation; grid: gait cycles",
    )


def ground_path(walk: RecordedGait) -> Figure | None:
    """The torso's path from above, its mean over a gait cycle, and the footfalls."""
    position = walk.recording.sensors.get("position")
    if position is None:
        return None
    start = np.asarray(position)[0, :2]

    def seen(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(ahead, left) [mm]: x is to the robot's left, y behind it."""
        return -1e3 * (places[..., 1] - start[1]), 1e3 * (places[..., 0] - start[0])

    ahead, left = seen(np.asarray(position))
    feet = walk.recording.sensors.get("foot_position")
    tall = (float(np.ptp(left)) + 120) / (float(np.ptp(ahead)) + 120)
    page = FigurePage(
        f"Way on the ground, seen from above{walk.title}",
        (7.4, 1.9 + min(max(6.4 * tall, 1.3), 5.6)),
    )
    ax = page.axes[0, 0]
    handles: list[Artist] = [Line2D([], [], color=INK, lw=0.9, label="torso")]
    ax.plot(ahead, left, color=INK, lw=0.8, zorder=4)
    mean = _cycle_mean(walk, np.asarray(position)[:, :2])
    if len(mean) > 1:
        ax.plot(*seen(mean), color=LINE_COLOUR, lw=2.0, zorder=5)
        handles.append(Line2D([], [], color=LINE_COLOUR, lw=2.0, label="mean over a gait cycle"))
    ax.scatter(ahead[0], left[0], s=50, fc="white", ec=INK, lw=1.4, zorder=6)
    if feet is not None and walk.contact is not None:
        put_down = walk.contact[1:] & ~walk.contact[:-1]
        for i, limb in enumerate(LIMBS):
            ax.scatter(
                *seen(np.asarray(feet)[1:][put_down[:, i], i]),
                s=12,
                color=FOOT[limb],
                lw=0,
                zorder=3,
            )
            handles.append(
                Line2D(
                    [],
                    [],
                    ls="none",
                    marker="o",
                    ms=4.5,
                    color=FOOT[limb],
                    label=f"{name_of(limb)} foot",
                )
            )
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(color=MISSING_COLOUR, lw=0.6)
    ax.set_axisbelow(True)
    ax.margins(0.06)
    ax.set(xlabel="ahead of the start [mm]", ylabel="to its left [mm]")
    return page.finish(
        handles, "the robot starts to the right; ring: start; dots: where a foot is put down"
    )


def _cycle_mean(walk: RecordedGait, places: np.ndarray) -> np.ndarray:
    """Running mean (T', 2) over a gait cycle of positions (T, 2); empty if there is no whole cycle."""
    if walk.cycle is None or len(places) < 2:
        return places[:0]
    ticks = round(walk.cycle / float(np.median(np.diff(walk.recording.time))))
    if ticks < 1 or len(places) <= ticks:
        return places[:0]
    sums = np.cumsum(np.concatenate([np.zeros((1, 2)), places]), axis=0)
    return (sums[ticks:] - sums[:-ticks]) / ticks


def leg_paths(walk: RecordedGait, robot: Robot) -> Figure | None:
    """Each foot in its leg's plane, from the hip or shoulder axis: measured, and as commanded to the servos."""
    if walk.recording.ctrl.shape[1] < 2 * len(LIMBS):
        return None
    part, what = walk.shown
    measured = in_leg_frame(recorded_model(walk.recording, robot), walk.recording.qpos[part])
    geometry = own_geometry(walk.recording) or Geometry()
    commanded = commanded_feet(walk.recording.ctrl[part], robot.config.routing, geometry)
    page = FigurePage(
        f"Foot paths in the leg's frame{walk.title}", (7.4, 4.9), 2, 2, sharex=True, sharey="row"
    )
    for i, (ax, limb) in enumerate(zip(page.axes.ravel(), LIMBS, strict=True)):
        ax.plot(
            -1e3 * commanded[:, i, 0],
            1e3 * commanded[:, i, 1],
            color=INK,
            lw=1.0,
            ls=(0, (4, 2)),
            zorder=3,
        )
        ax.plot(
            -1e3 * measured[:, i, 0], 1e3 * measured[:, i, 1], color=FOOT[limb], lw=1.6, zorder=4
        )
        ax.set_title(name_of(limb))
        ax.set_aspect("equal")
        ax.grid(color=GRID, lw=0.8)
        ax.margins(0.1)
    for ax in page.axes[:, 0]:
        ax.set_ylabel("above the axis [mm]")
    for ax in page.axes[-1]:
        ax.set_xlabel("ahead of the axis [mm]")
    handles: list[Artist] = [
        Line2D([], [], color=FOOT["front_left"], lw=1.6, label="measured, in the foot's colour"),
        Line2D([], [], color=INK, lw=1.0, ls=(0, (4, 2)), label="commanded"),
    ]
    return page.finish(
        handles, f"{what}; the axis is the shoulder's or the hip's; the robot walks to the right"
    )


def over_ground(walk: RecordedGait) -> Figure | None:
    """The height of each foot over its path along the robot's course; thick where it is loaded."""
    feet = walk.recording.sensors.get("foot_position")
    position = walk.recording.sensors.get("position")
    if feet is None or position is None or walk.angles is None:
        return None
    part, what = walk.shown
    places = np.asarray(feet)[part]
    mean_yaw = np.radians(walk.angles[part, 2].mean())
    course = np.array([np.sin(mean_yaw), -np.cos(mean_yaw)])
    along = 1e3 * (places[..., :2] - np.asarray(position)[part][0, :2]) @ course
    height = 1e3 * places[..., 2]
    page = FigurePage(
        f"Foot paths over the ground{walk.title}", (7.4, 6.0), 4, 1, sharex=True, sharey=True
    )
    for i, (ax, limb) in enumerate(zip(page.axes[:, 0], LIMBS, strict=True)):
        ax.plot(along[:, i], height[:, i], color=FOOT[limb], lw=1.0, zorder=3)
        if walk.contact is not None:
            loaded = np.where(walk.contact[part][:, i], height[:, i], np.nan)
            ax.plot(along[:, i], loaded, color=FOOT[limb], lw=4.0, solid_capstyle="butt", zorder=4)
        ax.annotate(name_of(limb), (0, 1.0), xycoords="axes fraction", va="bottom", color=INK)
        ax.margins(x=0.02, y=0.15)
        draw_horizontal_grid(ax)
    page.axes[-1, 0].set_xlabel("along the course [mm]")
    page.figure.supylabel("height of the foot [mm]", fontsize=9.5)
    note = (
        f"{what}; thick: the foot bears a load, so that a long thick line is a slip;"
        " heights are drawn larger than ways"
    )
    return page.finish([], note)


def in_leg_frame(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Feet (T, 4, 2) as (y, z) from the hip or shoulder axis, in the frame of the torso or the hip that bears it [m].

    Args:
        model: of the recorded robot.
        qpos: (T, nq).
    """
    data = mujoco.MjData(model)
    axes = [model.site(f"{limb}_axis").id for limb in LIMBS]
    feet = [model.site(f"{limb}_foot").id for limb in LIMBS]
    bodies = model.site_bodyid[axes]
    angles = np.empty((len(qpos), len(LIMBS), 2))
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    straight = data.xmat[bodies].reshape(-1, 3, 3).copy()  # where y is backward and z up
    for k, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        turned = data.xmat[bodies].reshape(-1, 3, 3) @ straight.transpose(0, 2, 1)
        arm = data.site_xpos[feet] - data.site_xpos[axes]
        angles[k] = np.einsum("lji,lj->li", turned, arm)[:, 1:]
    return angles


def commanded_feet(ctrl: np.ndarray, routing: str, geometry: Geometry) -> np.ndarray:
    """Feet (T, 4, 2) as (y, z) from the axis [m] of commanded servo angles (T, nu), without compliance."""
    servo = np.stack([ctrl[:, : len(LIMBS)], ctrl[:, len(LIMBS) : 2 * len(LIMBS)]], axis=-1)
    return np.asarray(forward_kinematics(four_legs(geometry), servo, routing).foot)


_HIP_COLOUR, _KNEE_COLOUR, _OTHER_COLOUR = SERIES[0], SERIES[1], SERIES[2]
#: A servo that moves less than this is left out, unless it is a leg's [deg].
_SMALLEST_MOTION_DEG = 0.5


def servo_angles_figure(walk: RecordedGait) -> Figure | None:
    """Hip and knee of each leg, and the other servos that move."""
    measured = walk.recording.sensors.get("servo_angle")
    if measured is None:
        return None
    part, description = walk.shown
    time, aim, angle = (
        np.asarray(samples)[part]
        for samples in (walk.recording.time, walk.recording.ctrl, measured)
    )
    aim, angle = np.degrees(aim), np.degrees(angle)
    names = servos_by_count(angle.shape[1])
    others = [
        i
        for i in range(2 * len(LIMBS), len(names))
        if np.ptp(aim[:, i]) > _SMALLEST_MOTION_DEG or np.ptp(angle[:, i]) > _SMALLEST_MOTION_DEG
    ]
    rows = [
        (f"{name_of(limb)} leg", [(i, _HIP_COLOUR), (i + len(LIMBS), _KNEE_COLOUR)])
        for i, limb in enumerate(LIMBS)
    ]
    rows += [(names[i].replace("_", " "), [(i, _OTHER_COLOUR)]) for i in others]
    page = FigurePage(
        f"Servo angles{walk.title}", (7.4, 1.3 + 1.3 * len(rows)), len(rows), 1, sharex=True
    )
    for ax, (name, lines) in zip(page.axes[:, 0], rows, strict=True):
        for i, colour in lines:
            ax.plot(time, angle[:, i], color=colour, lw=1.5, zorder=3)
            ax.plot(time, aim[:, i], color=INK, lw=0.9, ls=(0, (4, 2)), zorder=4)
        ax.annotate(name, (0, 1.0), xycoords="axes fraction", va="bottom", color=INK)
        ax.margins(y=0.1)
        draw_horizontal_grid(ax)
    page.axes[-1, 0].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    page.figure.supylabel("servo angle [deg]", fontsize=9.5)
    handles: list[Artist] = [
        Line2D([], [], color=_HIP_COLOUR, lw=1.5, label="hip or shoulder, measured"),
        Line2D([], [], color=_KNEE_COLOUR, lw=1.5, label="knee, measured"),
    ]
    if others:
        listing = ", ".join(names[i].replace("_", " ") for i in others)
        handles.append(Line2D([], [], color=_OTHER_COLOUR, lw=1.5, label=f"{listing}, measured"))
    handles.append(Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 2)), label="commanded"))
    return page.finish(
        handles,
        f"{description}; hip 0: leg straight down, positive: backward; spine positive: to the left",
    )


def beside_robot(walk: RecordedGait) -> Figure | None:
    """Each channel of a robot's log beside the twin that was driven by its commands, and their difference."""
    channels, time = beside_log(walk.recording), walk.recording.time
    if not channels:
        return None
    rows = -(-len(channels) // 2)
    page = FigurePage(
        "The robot's log beside the twin", (9.6, 1.3 + 1.35 * rows), rows, 2, sharex=True
    )
    for ax, channel in zip(page.axes.T.ravel(), channels, strict=False):
        measured, simulated = (line.values for line in channel.lines)
        ax.plot(time, simulated, color=SERIES[0], lw=1.8, zorder=3)
        ax.plot(time, measured, color=INK, lw=0.7, zorder=4)
        ax.plot(time, measured - simulated, color=SERIES[1], lw=0.7, zorder=2)
        title = f"{channel.title} [{channel.unit}]"
        ax.annotate(title, (0, 1.0), xycoords="axes fraction", va="bottom", color=INK, fontsize=8.5)
        ax.margins(y=0.1)
        draw_horizontal_grid(ax)
    for ax in page.axes.T.ravel()[len(channels) :]:
        ax.remove()
    for ax in page.axes.T.ravel()[[rows - 1, len(channels) - 1]]:
        ax.tick_params(labelbottom=True)
        ax.set(xlabel="time [s]", xlim=(time[0], time[-1]))
    lines = (
        (INK, 0.7, "measured"),
        (SERIES[0], 1.8, "simulated"),
        (SERIES[1], 0.7, "measured minus simulated"),
    )
    handles: list[Artist] = [
        Line2D([], [], color=colour, lw=width, label=label) for colour, width, label in lines
    ]
    return page.finish(handles, "lag: of what was measured behind what was simulated")


def figures_of_recording(
    recording: Recording, notify: Callable[[str], None]
) -> Iterator[tuple[str, Figure]]:
    """The figures of a recording: `gait-diagram`, `orientation`, `foot-paths`, `foot-paths-over-ground`,
    `servo-angles` and `ground-path`; of one with a robot's log, `beside-robot`.

    Args:
        recording: figures of missing data are left out.
        notify: called with a message about each figure that cannot be drawn.
    """
    walk = RecordedGait(recording)
    for name, draw in (
        ("gait-diagram", gait_diagram),
        ("orientation", orientation),
        ("foot-paths", lambda walk: leg_paths(walk, robot_of(recording))),
        ("foot-paths-over-ground", over_ground),
        ("servo-angles", servo_angles_figure),
        ("ground-path", ground_path),
        *([("beside-robot", beside_robot)] if "log" in recording.metadata else []),
    ):
        try:
            figure, reason = draw(walk), "the recording lacks its sensors."
        except (RecordingError, ParameterError) as error:
            figure, reason = None, str(error)
        if figure is None:
            notify(f"There is no {name}: {reason}")
        else:
            yield name, figure
