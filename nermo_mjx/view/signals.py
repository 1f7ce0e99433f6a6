"""Signals plotted next to a run: attitude, speed, foot forces and stance, tensions, servo angles."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from jaxtyping import Float

from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.interface import servos_by_count
from nermo_mjx.view.motion import Motion
from nermo_mjx.view.standing import STANDING

_LIMB_TITLES: Final = tuple(limb.replace("_", " ") for limb in LIMBS)


@dataclasses.dataclass(frozen=True)
class Curve:
    """One curve.

    Attributes:
        name: in the legend.
        colour: a name that the page's style knows: a limb's, `tail`, or `first`, `second`, `third`.
        values: over time, in the plot's unit.
        faint: whether it belongs to the previous line, with the same colour.
    """

    name: str
    colour: str
    values: Float[np.ndarray, " T"]
    faint: bool = False


@dataclasses.dataclass(frozen=True)
class Plot:
    """Curves over time with one axis; `bars` shows where values are above zero."""

    key: str
    title: str
    unit: str
    lines: tuple[Curve, ...]
    bars: bool = False


def plots_of(recording: Recording, motion: Motion) -> list[Plot]:
    """The plots of a run at the motion's samples; those whose sensors the recording lacks are left out."""
    samples = np.searchsorted(recording.time, motion.time)
    sensors = {name: np.asarray(values)[samples] for name, values in recording.sensors.items()}
    plots = []
    if "foot_force" in sensors:
        force = sensors["foot_force"]
        stance, forces = _per_limb((force > STANDING).astype(float)), _per_limb(force)
        if "tail_force" in sensors:
            tail = sensors["tail_force"]
            stance += (Curve("tail", "tail", (tail > STANDING).astype(float)),)
            forces += (Curve("tail", "tail", tail),)
        plots.append(Plot("stance", "Feet and tail on the ground", "", stance, bars=True))
        plots.append(Plot("force", "Force on feet and tail", "N", forces))
    if {"position", "orientation"} <= sensors.keys():
        plots += _body(recording, motion.time, sensors)
    plots += _tensions(motion)
    if "servo_angle" in sensors:
        plots += _servos(np.rad2deg(sensors["servo_angle"]), np.rad2deg(recording.ctrl[samples]))
    return plots


def _per_limb(values: np.ndarray, faint: np.ndarray | None = None) -> tuple[Curve, ...]:
    lines = []
    for i, (limb, title) in enumerate(zip(LIMBS, _LIMB_TITLES, strict=True)):
        lines.append(Curve(title, limb, values[:, i]))
        if faint is not None:
            lines.append(Curve(f"{title}, commanded", limb, faint[:, i], faint=True))
    return tuple(lines)


def _body(recording: Recording, time: np.ndarray, sensors: dict[str, np.ndarray]) -> list[Plot]:
    angles = _attitude(sensors["orientation"])
    orientation = tuple(
        Curve(name, colour, angles[:, i])
        for i, (name, colour) in enumerate((("roll", "first"), ("pitch", "second"), ("yaw", "third")))
    )
    place = 1e3 * sensors["position"]
    plots = [Plot("attitude", "Attitude of the torso", "°", orientation)]
    if "linear_velocity" in sensors:
        yaw = np.deg2rad(angles[:, 2])
        velocity = 1e3 * sensors["linear_velocity"]
        forward = velocity[:, 0] * np.sin(yaw) - velocity[:, 1] * np.cos(yaw)
        parameters = recording.metadata.get("parameters") or {}
        period = float(parameters.get("tracking.clock_ratio") or 1.0) / float(parameters.get("frequency") or 1.0)
        lines = (Curve("over a cycle", "first", _over_cycle(forward, time, period)),
                 Curve("at once", "first", forward, faint=True))  # fmt: skip
        plots.append(Plot("speed", "Forward speed", "mm/s", lines))
    way = (Curve("forward", "first", -place[:, 1]), Curve("to the left", "second", place[:, 0]))
    return [*plots, Plot("place", "Position of the torso", "mm", way)]


def _attitude(quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 3"]:
    """(roll, pitch, yaw) as in `kinematics.attitude`, in degrees, with unwrapped yaw; NumPy, to plot without JAX."""
    w, x, y, z = quaternion.T
    r01, r11 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    roll, pitch = np.arctan2(-r20, r22), np.arctan2(r21, np.hypot(r20, r22))
    return np.rad2deg(np.stack([roll, pitch, np.unwrap(np.arctan2(-r01, r11))], axis=1))


def _over_cycle(values: np.ndarray, time: np.ndarray, period: float) -> np.ndarray:
    """Mean over one gait cycle around each sample; NaN where the cycle is not whole."""
    if len(values) < 2:
        return np.full(len(values), np.nan)
    way = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(time))])
    begin, end = time - period / 2, time + period / 2
    mean = (np.interp(end, time, way) - np.interp(begin, time, way)) / period
    return np.where((begin >= time[0] - 1e-9) & (end <= time[-1] + 1e-9), mean, np.nan)


def _tensions(motion: Motion) -> list[Plot]:
    knees, others = [], []
    for tendon in motion.tendons:
        limb = next((i for i, name in enumerate(LIMBS) if tendon.name.startswith(name)), None)
        if limb is not None:
            knees.append(Curve(_LIMB_TITLES[limb], LIMBS[limb], tendon.tension))
        else:
            others.append(tendon)
    plots = [Plot("knee_tension", "Tension, leg tendons", "N", tuple(knees))] if knees else []
    for part in dict.fromkeys(tendon.name.split("_")[0] for tendon in others):
        mine = [tendon for tendon in others if tendon.name.split("_")[0] == part]
        lines = tuple(
            Curve(tendon.name.removeprefix(f"{part}_").replace("_", " "), colour, tendon.tension)
            for tendon, colour in zip(mine, ("first", "second", "third"), strict=False)
        )
        plots.append(Plot(f"{part}_tension", f"Tension, {part} tendons", "N", lines))
    return plots


def _servos(angle: np.ndarray, command: np.ndarray) -> list[Plot]:
    names = servos_by_count(angle.shape[1])
    plots = []
    for kind in ("hip", "knee"):
        chosen = [names.index(f"{limb}_{kind}") for limb in LIMBS]
        plots.append(Plot(kind, f"{kind.capitalize()} servos", "°", _per_limb(angle[:, chosen], command[:, chosen])))
    for key, title, servos in (
        ("body_servos", "Body servos, + left", ("spine", "neck", "tail")),
        ("vertical_servos", "Vertical servos, + hip up, nose down", ("spine_vertical", "head")),
    ):
        single: list[Curve] = []
        for name, colour in zip(servos, ("first", "second", "third"), strict=False):
            if name in names:
                i, called = names.index(name), name.replace("_", " ")
                single += [Curve(called, colour, angle[:, i]),
                           Curve(f"{called}, commanded", colour, command[:, i], faint=True)]  # fmt: skip
        plots += [Plot(key, title, "°", tuple(single))] if single else []
    return plots
