"""Paths of the feet: in the leg's own frame, commanded and measured, and over the ground."""

from __future__ import annotations

import mujoco
import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nermo_mjx.kinematics.leg import forward, four_legs
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.style import FOOT, GRID, INK, horizontal_grid
from nermo_mjx.robot import LIMBS, Robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.view.plots.walk import Walk, name_of
from nermo_mjx.view.recorded_robot import recorded_geometry, recorded_model


def leg_paths(walk: Walk, robot: Robot) -> Figure | None:
    """Each foot in its leg's plane, from the hip or shoulder axis: measured, and as commanded to the servos."""
    if walk.recording.ctrl.shape[1] < 2 * len(LIMBS):
        return None
    part, what = walk.shown
    measured = in_leg_frame(recorded_model(walk.recording, robot), walk.recording.qpos[part])
    geometry = recorded_geometry(walk.recording)
    commanded = commanded_feet(walk.recording.ctrl[part], robot.config.routing, geometry)
    page = Page(f"Foot paths in the leg's frame{walk.title}", (7.4, 4.9), 2, 2, sharex=True, sharey="row")
    for i, (ax, limb) in enumerate(zip(page.axes.ravel(), LIMBS, strict=True)):
        ax.plot(-1e3 * commanded[:, i, 0], 1e3 * commanded[:, i, 1], color=INK, lw=1.0, ls=(0, (4, 2)), zorder=3)
        ax.plot(-1e3 * measured[:, i, 0], 1e3 * measured[:, i, 1], color=FOOT[limb], lw=1.6, zorder=4)
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
    return page.finish(handles, f"{what}; the axis is the shoulder's or the hip's; the robot walks to the right")


def over_ground(walk: Walk) -> Figure | None:
    """The height of each foot over its path along the robot's course; thick where it is loaded."""
    feet, position = walk.recording.sensors.get("foot_position"), walk.recording.sensors.get("position")
    if feet is None or position is None or walk.angles is None:
        return None
    part, what = walk.shown
    places = np.asarray(feet)[part]
    mean_yaw = np.radians(walk.angles[part, 2].mean())
    course = np.array([np.sin(mean_yaw), -np.cos(mean_yaw)])
    along = 1e3 * (places[..., :2] - np.asarray(position)[part][0, :2]) @ course
    height = 1e3 * places[..., 2]
    page = Page(f"Foot paths over the ground{walk.title}", (7.4, 6.0), 4, 1, sharex=True, sharey=True)
    for i, (ax, limb) in enumerate(zip(page.axes[:, 0], LIMBS, strict=True)):
        ax.plot(along[:, i], height[:, i], color=FOOT[limb], lw=1.0, zorder=3)
        if walk.contact is not None:
            loaded = np.where(walk.contact[part][:, i], height[:, i], np.nan)
            ax.plot(along[:, i], loaded, color=FOOT[limb], lw=4.0, solid_capstyle="butt", zorder=4)
        ax.annotate(name_of(limb), (0, 1.0), xycoords="axes fraction", va="bottom", color=INK)
        ax.margins(x=0.02, y=0.15)
        horizontal_grid(ax)
    page.axes[-1, 0].set_xlabel("along the course [mm]")
    page.figure.supylabel("height of the foot [mm]", fontsize=9.5)
    note = (
        f"{what}; thick: the foot bears a load, so that a long thick line is a slip; heights are drawn larger than ways"
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
    found = np.empty((len(qpos), len(LIMBS), 2))
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    straight = data.xmat[bodies].reshape(-1, 3, 3).copy()  # where y is backward and z up
    for k, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        turned = data.xmat[bodies].reshape(-1, 3, 3) @ straight.transpose(0, 2, 1)
        arm = data.site_xpos[feet] - data.site_xpos[axes]
        found[k] = np.einsum("lji,lj->li", turned, arm)[:, 1:]
    return found


def commanded_feet(ctrl: np.ndarray, routing: str, geometry: Geometry) -> np.ndarray:
    """Feet (T, 4, 2) as (y, z) from the axis [m] of commanded servo angles (T, nu), without compliance."""
    servo = np.stack([ctrl[:, : len(LIMBS)], ctrl[:, len(LIMBS) : 2 * len(LIMBS)]], axis=-1)
    return np.asarray(forward(four_legs(geometry), servo, routing).foot)
