"""How well `identify --log` says what it knows: logs of simulated robots whose parameters are known.

Run from the repository's root; each prints a line of JSON for a robot, and at the end a summary:

    python docs/benchmarks/identification.py nermo --robots 10
    python docs/benchmarks/identification.py tracks --robots 10
    python docs/benchmarks/identification.py classes --robots 50
    python docs/benchmarks/identification.py quadruped

The logs are made by `mj_step` on a compiled model, one robot at a time, whose commands are held as a servo holds them:
of the code that is judged only the model and the names of its parameters are used.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from pathlib import Path

import mujoco
import numpy as np
from scipy.stats import binomtest

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.twin import SETTLING_SECONDS
from nermo_mjx.identify.body import NermoBody
from nermo_mjx.identify.identification import Identification, identify_log
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import load_robot
from nermo_mjx.robot.masses import mass_values

#: Of the commands and of the sensors [Hz].
RATE = 100
#: Noise (standard deviation), and the smallest step of a sensor.
NOISE = {
    "angle": (math.radians(0.2), math.radians(0.3)),
    "gyro": (0.02, 0.001),
    "accelerometer": (0.3, 0.005),
    "position": (1e-3, 1e-4),
    "yaw": (math.radians(0.5), 1e-4),
}
#: Kinds that are free for Nermo.
FREE = ("kp", "damping", "mass", "friction", "delay")
#: Kinds that marker tracks are asked for.
FEW = ("kp", "mass", "friction", "delay")


def measured(kind: str, values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Values as a sensor gives them."""
    noise, step = NOISE[kind]
    return np.round((values + random.normal(0.0, noise, values.shape)) / step) * step


def walk(duration: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and commands of a walk of the default body, which stands first (n,), (n, servos)."""
    frequency = 0.6 + 0.4 * np.random.default_rng(seed).random()
    result = Simulator(Setup(pilot="straight", spine="stride_extension"), engine="c").run(
        {"frequency": frequency}, Run(duration=duration), record=True
    )
    recording = result.recording()
    return recording.time - recording.time[0], recording.ctrl


def nermo_log(
    values: dict[str, float], times: np.ndarray, commands: np.ndarray, random: np.random.Generator
) -> Log:
    """A log of Nermo with these parameters, under commands (n, servos) at times (n,)."""
    robot = load_robot("nermo_lite")
    own = {
        name: value
        for name, value in values.items()
        if "." in name and not name.startswith("bias.")
    }
    model = compile_model(robot, mass_values("nermo_lite") | own)
    data = mujoco.MjData(model)
    bias = np.array([values.get(f"bias.{servo}", 0.0) for servo in robot.servos])
    step = model.opt.timestep
    settle, steps = round(SETTLING_SECONDS / step), math.floor(times[-1] / step)
    gyro, acceleration = (
        model.sensor(name).adr[0] + np.arange(3) for name in ("gyro", "accelerometer")
    )
    servos = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    torso = model.body("torso").id
    rows = []
    for k in range(-settle, steps):
        at = np.searchsorted(times, k * step + 1e-9 - values.get("delay", 0.0), side="right") - 1
        data.ctrl[:] = commands[max(at, 0)] + bias
        angles = data.qpos[servos].copy()
        mujoco.mj_step(model, data)
        if k >= 0:
            yaw = math.atan2(data.xmat[torso, 3], data.xmat[torso, 0])
            rows.append(
                [
                    *angles,
                    *data.sensordata[gyro],
                    *data.sensordata[acceleration],
                    *data.xpos[torso, :2],
                    yaw,
                ]
            )
    every = round(1 / (RATE * step))
    seen, n = np.array(rows)[::every], len(servos)
    at = np.arange(len(seen)) * every * step
    channels = [
        Channel(f"command_{s}", "command", s, times, commands[:, i])
        for i, s in enumerate(robot.servos)
    ]
    channels += [
        Channel(f"angle_{s}", "angle", s, at, measured("angle", seen[:, i], random))
        for i, s in enumerate(robot.servos)
        if s != "neck"
    ]
    channels += [
        Channel("gyro", "gyro", "imu", at, measured("gyro", seen[:, n : n + 3], random)),
        Channel(
            "accelerometer",
            "accelerometer",
            "imu",
            at,
            measured("accelerometer", seen[:, n + 3 : n + 6], random),
        ),
        Channel(
            "position",
            "position",
            "torso",
            at,
            measured("position", seen[:, n + 6 : n + 8], random),
        ),
        Channel("yaw", "yaw", "torso", at, measured("yaw", np.unwrap(seen[:, n + 8]), random)),
    ]
    return Log(tuple(channels), "simulated")


def drawn(body: NermoBody, random: np.random.Generator) -> dict[str, float]:
    """Parameters in the middle of their ranges; a delay is whole steps, since the log's simulation knows no other."""
    found = {}
    for each in body.parameters.values():
        share = random.uniform(0.25, 0.75)
        low, high = max(each.low, 0.0) if each.kind == "delay" else each.low, each.high
        high = min(high, 0.04) if each.kind == "delay" else high
        found[each.name] = low * (high / low) ** share if low > 0 else low + share * (high - low)
    if "delay" in found:
        found["delay"] = round(found["delay"] / body.model.opt.timestep) * body.model.opt.timestep
    return found


def compared(
    found: Identification, truth: dict[str, float], noise: np.ndarray | None = None
) -> dict[str, object]:
    """What an identification says beside the truth."""
    names = [each.name for each in found.fit.space.parameters]
    inside = {n: bool(a <= truth[n] <= b) for n, (a, b) in zip(names, found.intervals, strict=True)}
    known = {n: bool(d) for n, d in zip(names, found.fit.determined, strict=True)}
    return {
        "determined": [n for n in names if known[n]],
        "covered": [n for n in names if known[n] and inside[n]],
        "loose": [n for n in names if not known[n]],
        "loose_covered": [n for n in names if not known[n] and inside[n]],
        "error": found.errors["identified"],
        "default": found.errors["default body"],
        "right": found.right,
        "seconds": found.seconds,
    }


def summary(rows: list[dict]) -> dict[str, object]:
    """Over all robots."""
    known, inside = (sum(len(row[key]) for row in rows) for key in ("determined", "covered"))
    loose, held = (sum(len(row[key]) for row in rows) for key in ("loose", "loose_covered"))
    return {
        "robots": len(rows),
        "determined": known / max(known + loose, 1),
        "coverage of determined": inside / max(known, 1),
        "its 95 % interval (Wilson)": [
            *binomtest(inside, max(known, 1)).proportion_ci(method="wilson")
        ],
        "coverage of the others": held / max(loose, 1),
        "median error [noise]": float(np.median([row["error"] for row in rows])),
        "called right": float(np.mean([row["right"] for row in rows])),
        "median seconds": float(np.median([row["seconds"] for row in rows])),
    }


def nermos(robots: int, first: int, tracks: bool, duration: float) -> None:
    """Nermos whose parameters are drawn; with tracks alone, only the marker's path is seen."""
    rows, free = [], FEW if tracks else FREE
    for seed in range(first, first + robots):
        random = np.random.default_rng((seed, tracks))
        body = NermoBody("nermo_lite", free)
        truth = drawn(body, random)
        log = nermo_log(truth, *walk(duration, seed), random)
        seen = (
            ("command", "position", "yaw")
            if tracks
            else ("command", "angle", "gyro", "accelerometer")
        )
        log = dataclasses.replace(
            log, channels=tuple(each for each in log.channels if each.quantity in seen)
        )
        found = identify_log([log], free=free)
        rows.append({"seed": seed} | compared(found, truth))
        print(json.dumps(rows[-1]), flush=True)
    print(json.dumps(summary(rows)))


#: An arm of three servos; its damping and inertia are such that all kinds of parameters matter.
ARM = """<mujoco><option timestep="0.002"/><default><joint damping="0.2" armature="0.002"/>
<geom type="capsule" size="0.01" contype="0" conaffinity="0"/></default><worldbody>
<body name="a"><joint name="a" axis="0 1 0"/><geom fromto="0 0 0 0.15 0 0" mass="0.1"/>
<body name="b" pos="0.15 0 0"><joint name="b" axis="0 1 0"/><geom fromto="0 0 0 0.12 0 0" mass="0.08"/>
<body name="c" pos="0.12 0 0"><joint name="c" axis="1 0 0"/><geom fromto="0 0 0 0 0.05 0" mass="0.05"/>
</body></body></body></worldbody><actuator>
<position name="a" joint="a" kp="40" forcerange="-1.2 1.2"/><position name="b" joint="b" kp="30" forcerange="-0.9 0.9"/>
<position name="c" joint="c" kp="20" forcerange="-0.6 0.6"/></actuator></mujoco>"""


def driven(
    model: mujoco.MjModel, values: dict[str, float], seed: int, duration: float, noise: float = 1e-3
) -> Log:
    """A log of position servos under a chirp each, with delay, biases, and play in their gears."""
    random, data, step = np.random.default_rng(seed), mujoco.MjData(model), model.opt.timestep
    names = [model.actuator(i).name for i in range(model.nu)]
    times = np.arange(round(duration * RATE)) / RATE
    phase, top = random.uniform(0, 2 * np.pi, model.nu), 2.0
    turned = 2 * np.pi * (0.1 * times + (top - 0.1) * times**2 / (2 * duration))
    commands = 0.35 * np.sin(turned[:, None] + phase)
    bias = np.array([values.get(f"bias.{name}", 0.0) for name in names])
    servos = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    half, kp = values.get("backlash", 0.0) / 2, model.actuator_gainprm[:, 0]
    motor, rows, start = np.zeros(model.nu), [], commands[0] + bias
    data.qpos[servos] = start
    for k in range(math.floor(times[-1] / step)):
        at = np.searchsorted(times, k * step + 1e-9 - values.get("delay", 0.0), side="right") - 1
        target, angle = commands[max(at, 0)] + bias, data.qpos[servos].copy()
        if half:  # the motor turns at 15 rad/s of its torque's share of the limit, and pushes at an end of its play
            drive = np.clip(kp * (target - angle) / model.actuator_forcerange[:, 1], -1, 1)
            motor = np.clip(motor + step * (15.0 * drive - data.qvel), -half, half)
            touches = np.where(drive > 0, motor >= half, motor <= -half)
            data.ctrl[:] = angle + np.where(touches, target - angle, 0.0)
        else:
            data.ctrl[:] = target
        rows.append(angle)
        mujoco.mj_step(model, data)
    every = round(1 / (RATE * step))
    seen = np.array(rows)[::every]
    at = np.arange(len(seen)) * every * step
    channels = [
        Channel(f"command_{n}", "command", n, times, commands[:, i]) for i, n in enumerate(names)
    ]
    angles = seen + random.normal(0.0, noise, seen.shape)
    joints = [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]]
    channels += [Channel(f"angle_{n}", "angle", n, at, angles[:, i]) for i, n in enumerate(joints)]
    return Log(tuple(channels), "simulated")


def classes(robots: int, first: int, folder: Path) -> None:
    """Arms of which a wrong class is fitted: biases where a gain is off, or no backlash; and the right one of gains."""
    path = folder / "arm.xml"
    path.write_text(ARM)
    rows = []
    for seed in range(first, first + robots):
        random, wrong = np.random.default_rng(seed), ("gain", "backlash")[seed % 2]
        model = mujoco.MjModel.from_xml_string(ARM)
        model.dof_damping[:] *= np.exp(random.normal(0, 0.4, model.nv))
        values = {
            f"bias.{model.actuator(i).name}": random.uniform(-0.1, 0.1) for i in range(model.nu)
        }
        if wrong == "gain":
            factor = np.exp(random.choice([-1, 1]) * random.uniform(0.15, 0.6))
            model.actuator_gainprm[:, 0] *= factor
            model.actuator_biasprm[:, 1] *= factor
        else:
            values["backlash"] = random.uniform(0.03, 0.08)
        log = driven(model, values, seed, 6.0, 3e-4)
        found = identify_log([log], path, ("damping", "bias"))
        row = {
            "seed": seed,
            "wrong": wrong,
            "named": not found.right,
            "missing": dict(found.missing),
        }
        if wrong == "gain":
            row["right class"] = identify_log([log], path, ("damping", "bias", "kp")).right
        rows.append(row)
        print(json.dumps(row), flush=True)
    named = {
        kind: [row["named"] for row in rows if row["wrong"] == kind]
        for kind in ("gain", "backlash")
    }
    cause = []
    for row in rows:
        own, most = (
            "kp" if row["wrong"] == "gain" else "backlash",
            max(row["missing"].values(), default=0.0),
        )
        cause.append(row["missing"].get(own, 0.0) > 0.8 * most)
    accepted = [row["right class"] for row in rows if "right class" in row]
    said = {kind: float(np.mean(each)) for kind, each in named.items() if each}
    print(
        json.dumps(
            {
                "named": said,
                "cause": float(np.mean(cause)),
                "right class accepted": float(np.mean(accepted)),
            }
        )
    )


def quadruped_xml(base: bool) -> str:
    """Twelve servos, of the size of a dog."""
    legs, servos = "", ""
    for name, x, y in (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("rl", -0.2, 0.1), ("rr", -0.2, -0.1)):
        legs += f"""<body name="{name}_hip" pos="{x} {y} 0"><joint name="{name}_haa" axis="1 0 0"/>
<geom type="sphere" size="0.04" mass="1.5"/><body name="{name}_thigh" pos="0 {0.6 * y} 0">
<joint name="{name}_hfe" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.025" mass="1.2"/>
<body name="{name}_shank" pos="0 0 -0.25"><joint name="{name}_kfe" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.015" mass="0.3"/></body></body></body>"""
        for joint in ("haa", "hfe", "kfe"):
            servos += f'<position name="{name}_{joint}" joint="{name}_{joint}" kp="85" kv="0.6"/>'
    free = "<freejoint/>" if base else ""
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><default>
<joint damping="0.1" armature="0.01"/><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="base" pos="0 0 1">{free}<geom type="box" size="0.25 0.1 0.05" mass="12"/>{legs}</body></worldbody>
<actuator>{servos}</actuator></mujoco>"""


def quadruped(folder: Path) -> None:
    """49 parameters of a quadruped that hangs, 23 s at 200 Hz, twice."""
    global RATE
    RATE = 250  # the nearest of which the step of 2 ms is a part
    path, random = folder / "quadruped.xml", np.random.default_rng(0)
    path.write_text(quadruped_xml(True))
    model = mujoco.MjModel.from_xml_string(quadruped_xml(False))
    model.dof_armature[:] = 0.01 * np.exp(random.normal(0, 0.5, model.nv))
    model.dof_damping[:] = 0.5 * np.exp(random.normal(0, 0.7, model.nv))
    model.dof_frictionloss[:] = random.uniform(0, 1.5, model.nv)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    names = [model.joint(i).name for i in range(model.nv)]
    truth = {f"bias.{name}": random.uniform(-0.1, 0.1) for name in names} | {"delay": 0.008}
    log = driven(model, truth, 0, 23.0)
    for kind in ("armature", "damping", "frictionloss"):
        truth |= dict(
            zip([f"{kind}.{name}" for name in names], getattr(model, f"dof_{kind}"), strict=True)
        )
    results = []
    for _ in range(2):
        began = time.process_time()
        found = identify_log([log], path, ("armature", "damping", "frictionloss", "bias", "delay"))
        results.append(found.fit.values)
        row = compared(found, truth) | {
            "parameters": len(truth),
            "cpu": time.process_time() - began,
        }
        print(json.dumps(row), flush=True)
    print(json.dumps({"the same twice": bool(np.array_equal(*results))}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("nermo", "tracks", "classes", "quadruped"))
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--folder", type=Path, default=Path("."), help="for the models")
    given = parser.parse_args()
    if given.what in ("nermo", "tracks"):
        nermos(given.robots, given.first, given.what == "tracks", given.duration)
    elif given.what == "classes":
        classes(given.robots, given.first, given.folder)
    else:
        quadruped(given.folder)
