"""A robot that measures itself: a log made by a simulation of another hand than the package's, in plain MuJoCo."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

import nermo_mjx


def body(gain: float = 1.0) -> mujoco.MjModel:
    """The robot on its feet, with servos of another gain than the default's."""
    model = mujoco.MjModel.from_xml_string(nermo_mjx.load_robot().to_xml())
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1] *= gain
    return model


def commanded(time: float, model: mujoco.MjModel) -> np.ndarray:
    """Sines of small angles and frequencies that differ."""
    ctrl = np.zeros(model.nu)
    for k in range(model.nu):
        ctrl[k] = 0.12 * np.sin(2 * np.pi * (0.7 + 0.13 * k) * time + k) * (1 - np.exp(-3 * time))
    return ctrl


def write_log(
    folder: Path,
    seconds: float = 6.0,
    rate: float = 100.0,
    delay: float = 0.0,
    delays: dict[str, float] | None = None,
    noise: float = 0.002,
    lost: float = 0.0,
    quantum: float = 0.0,
    gain: float = 1.0,
    seed: int = 0,
    name: str = "robot",
) -> tuple[Path, Path]:
    """NAME.csv in degrees, g and mm, and NAME.yaml; commands act `delay` later [s].

    Angles of `late` are those of so long ago [s], and rounded to a quantum [rad]; a sample is lost with a probability.
    """
    model, random = body(gain), np.random.default_rng(seed)
    data = mujoco.MjData(model)
    torso = model.body("torso").id
    names = [model.actuator(i).name.removesuffix("_servo") for i in range(model.nu)]
    joints = [int(model.jnt_qposadr[model.actuator_trnid[i, 0]]) for i in range(model.nu)]
    places = {
        sensor_name: int(model.sensor_adr[model.sensor(sensor_name).id])
        for sensor_name in ("gyro", "accelerometer")
    }
    every, rows = round(1 / rate / model.opt.timestep), []
    history = {servo: [] for servo in names}
    data.ctrl[:] = commanded(0.0, model)
    mujoco.mj_step(model, data, nstep=1000)  # it comes to rest on its feet
    for step in range(round(seconds / model.opt.timestep)):
        now = step * model.opt.timestep
        data.ctrl[:] = commanded(max(0.0, now - delay), model)
        for servo, joint in zip(names, joints, strict=True):
            history[servo].append(data.qpos[joint])
        if step % every == 0:
            angles = []
            for servo in names:
                back = round((delays or {}).get(servo, 0.0) / model.opt.timestep)
                angles.append(history[servo][max(0, len(history[servo]) - 1 - back)])
            angles = np.array(angles) + noise * random.standard_normal(model.nu)
            angles = np.round(angles / quantum) * quantum if quantum else angles
            gyro, felt = (data.sensordata[address : address + 3] for address in places.values())
            turn = data.xmat[torso].reshape(3, 3)
            yaw = np.arctan2(-turn[0, 1], turn[1, 1])
            imu = [
                *np.degrees(gyro + 0.01 * random.standard_normal(3)),
                *(felt + 0.05 * random.standard_normal(3)) / 9.80665,
            ]
            marker = [
                *1e3 * (data.xpos[torso, :2] + 2e-4 * random.standard_normal(2)),
                np.degrees(yaw),
            ]
            row = [
                1e3 * now,
                *np.degrees(commanded(now, model)),
                *np.degrees(angles),
                *imu,
                *marker,
            ]
            if random.random() >= lost:
                rows.append(row)
        mujoco.mj_step(model, data)
    columns = [
        "t_ms",
        *(f"cmd_{servo}" for servo in names),
        *(f"pos_{servo}" for servo in names),
    ]
    columns += ["gx", "gy", "gz", "ax", "ay", "az", "x", "y", "heading"]
    csv = folder / f"{name}.csv"
    csv.write_text(
        "\n".join([",".join(columns), *(",".join(f"{v:.5g}" for v in row) for row in rows)]) + "\n"
    )
    lines = ["time: {column: t_ms, unit: ms}", "channels:"]
    for servo in names:
        lines.append(f"  cmd_{servo}: {{quantity: command, of: {servo}, unit: deg}}")
        lines.append(f"  pos_{servo}: {{quantity: angle, of: {servo}, unit: deg}}")
    lines += [
        "  gyro: {quantity: gyro, columns: [gx, gy, gz], unit: deg/s}",
        "  accelerometer: {quantity: accelerometer, columns: [ax, ay, az], unit: g}",
        "  marker: {quantity: position, columns: [x, y], unit: mm}",
        "  heading: {quantity: yaw, unit: deg}",
    ]
    yaml = folder / f"{name}.yaml"
    yaml.write_text("\n".join(lines) + "\n")
    return csv, yaml
