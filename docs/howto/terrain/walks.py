"""The walks of docs/spine_on_terrain.md: each terrain with the spine free, stiff and passive, as short recordings.

Run as `python walks.py`; it writes walks/SCENE/SPINE.npz beside this file.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from search_gait import DAMPED, POLES

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.learn import load_policy
from nermo_mjx.recording import Recording

HERE = Path(__file__).parent
SPINES = ("free", "stiff", "passive")
HIGH = {"terrain.height": 0.01}
#: Pilot and values of each scene.
PLACES = {
    "planks": ({}, HIGH),
    "ramp": ({}, {}),
    "logs": ({}, HIGH),
    "stairs": ({}, HIGH),
    "spiral_stairs": ({"pilot": "arc"}, HIGH | {"pilot.radius": 0.5}),
    "rough": ({}, HIGH),
    "slalom": ({"pilot": "waypoints", "waypoints": POLES}, {}),
}
BEGIN, END, EVERY = 1.0, 5.0, 4  # [s], samples: 25 of 100 in a second


def short(recording: Recording) -> Recording:
    """What is shown, in single precision: 60 kB instead of 900."""
    whole = recording.between(BEGIN, END)

    def thin(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[::EVERY], np.float32)

    arrays = {name: thin(getattr(whole, name)) for name in ("qpos", "qvel", "ctrl")}
    sensors = {name: thin(values) for name, values in whole.sensors.items()}
    return dataclasses.replace(whole, time=whole.time[::EVERY], sensors=sensors, **arrays)


if __name__ == "__main__":
    for spine in SPINES:
        for scene, (pilot, values) in PLACES.items():
            policy = load_policy(HERE / f"{spine}.npz").upon(**pilot)
            simulator = Simulator(Setup(scene=scene, physics="fast", controller=policy), engine="c")
            run = Run(duration=10.0, warmup=1.0)
            result = simulator.run(DAMPED | values | {"contact.friction": 1.2}, run, record=True)
            speed, aside = (float(result.metrics[name][0]) for name in ("speed", "cross_track_peak"))
            outcome = f"{result.status[0]}, {1000 * speed:.0f} mm/s, {1000 * aside:.0f} mm aside"
            print(f"{spine} on {scene}: {outcome}", flush=True)
            short(result.recording()).save(HERE / "walks" / scene / f"{spine}.npz")
