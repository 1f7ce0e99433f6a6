"""The first picture: a walking trot with the spine free and with it stiff, from above, the spine's bend coloured.

    python docs/hero.py

Writes docs/images/hero.webp in two minutes. Both robots have the profile `exact`, 0.8 Hz and the mean friction of
sweeps/three_gaits.yaml, 1.1. The free spine has an amplitude and a phase of which the sweep says that they may be the
fastest. The picture begins two cycles after the start; the speed is the distance since then over the time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.colors import to_rgb
from pictures import write_film
from PIL import Image

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.plotting.style import INK, OKABE_ITO
from nermo_mjx.view import offscreen, robot_of
from nermo_mjx.view.camera import put_pose, put_sun_overhead
from nermo_mjx.view.video import (
    blank_strip,
    frame_samples,
    pixels,
    root_path,
    smooth_path,
    write_text,
)

OUT = Path(__file__).parent / "images" / "hero.webp"
WALK = {"frequency": 0.8, "contact.friction": 1.1}
WALKS = {
    "Spine free": (
        Setup(gait="walking_trot", spine="stride_extension"),
        {"spine.amplitude": 0.3, "spine.phase": 0.0},
    ),
    "Spine stiff": (Setup(gait="walking_trot"), {}),
}
WARMUP, CYCLES, FPS = 2.0, 7.0, 8
WIDTH, HEIGHT, STRIP = 1280, 360, 60
SHOWN = 1120  # width of the film [pixels]
#: Size of the picture on the ground, distance between the robots, and place of their torsos at first [m].
WIDE, LANES, START = 1.12, 0.17, 0.3
#: Bend of a whole spine that has the full colour [rad], and the colours to the left and to the right.
FULL = 0.3
LEFT, RIGHT = (np.array(to_rgb(OKABE_ITO[name])) for name in ("blue", "vermilion"))


def colour_of(bend: float) -> np.ndarray:
    """White where the spine is straight, (3,)."""
    share = min(abs(bend) / FULL, 1.0)
    return (1 - share) * np.ones(3) + share * (LEFT if bend > 0 else RIGHT)


def draw_spine(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Lay a band over the spine, each piece with the colour of the bend of its joint; return the whole bend [rad]."""
    joints = [model.joint(f"spine_joint_{i}") for i in range(1, 5)]
    places = np.array([data.xanchor[each.id] for each in joints])
    middles = (places[1:] + places[:-1]) / 2
    ends = np.array([2 * places[0] - middles[0], *middles, 2 * places[-1] - middles[-1]])
    ends[:, 2] = places[:, 2].max() + 0.03
    bends = np.array([data.qpos[each.qposadr[0]] for each in joints])
    for bend, begin, end in zip(bends, ends, ends[1:], strict=False):
        rgba = np.array([*colour_of(4 * bend), 1.0], np.float32)
        geom = scene.geoms[scene.ngeom]
        scene.ngeom += 1
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba
        )
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.008, begin, end)
        geom.emission = 0.6
    return float(bends.sum())


def strip(name: str, bend: float, way: float, seconds: float) -> np.ndarray:
    """The line of one robot: its name, its bend, its way [m] and its speed."""
    figure = blank_strip(WIDTH, STRIP)
    write_text(figure, 12, 14, name, fontsize=22, fontweight="bold")
    side = (
        f"bent {math.degrees(abs(bend)):.0f}° to the {'left' if bend > 0 else 'right'}"
        if abs(bend) > 0.01
        else "straight"
    )
    colour = INK if side == "straight" else 0.75 * (LEFT if bend > 0 else RIGHT)
    write_text(figure, 330, 18, side, fontsize=17, color=colour)
    speed = f"{1e3 * way / seconds:.0f} mm/s" if seconds > 0.2 else ""
    write_text(figure, WIDTH - 12, 10, speed, fontsize=26, fontweight="bold", ha="right")
    return pixels(figure)


def main() -> None:
    recordings = []
    for setup, values in WALKS.values():
        result = Simulator(setup, engine="c").run(
            WALK | values, Run(cycles=CYCLES, warmup_cycles=WARMUP), record=True
        )
        print(
            setup.spine,
            {
                name: float(np.ravel(result.metrics[name])[0])
                for name in ("speed", "cost_of_transport")
            },
        )
        recording = result.recording(0)
        recordings.append(recording.between(recording.time[0] + WARMUP / 0.8, recording.time[-1]))
    offscreen.require_gl()
    model = robot_of(recordings[0]).model
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    model.mat_reflectance[:] = 0.0
    put_sun_overhead(model)
    data, other = mujoco.MjData(model), mujoco.MjData(model)
    samples = frame_samples(recordings[0], FPS, 1.0)
    # The place of each torso without the sway of the steps; forward is -y.
    paths = [smooth_path(root_path(each, model, data, samples), 1 / FPS) for each in recordings]
    begins = [path[0].copy() for path in paths]
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultCamera(camera)
    camera.azimuth, camera.elevation = 0.0, -89.9
    camera.distance = 1.0
    camera.orthographic, model.vis.global_.fovy = 1, WIDE * HEIGHT / WIDTH  # then a height [m]
    camera.lookat[:] = 0.0, START - WIDE / 2, 0.0

    def frames() -> Iterator[np.ndarray]:
        with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
            for i, sample in enumerate(samples):
                bends = []
                for lane, (each, state) in enumerate(zip(recordings, (data, other), strict=True)):
                    pose = each.qpos[sample].copy()
                    pose[0] += (0.5 - lane) * LANES - begins[lane][0]
                    pose[1] -= begins[lane][1]
                    put_pose(model, state, pose)
                    mujoco.mj_camlight(model, state)
                    mujoco.mj_tendon(model, state)
                renderer.update_scene(data, camera)
                moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
                option, push = mujoco.MjvOption(), mujoco.MjvPerturb()
                mujoco.mjv_addGeoms(model, other, option, push, moving, renderer.scene)
                bends = [draw_spine(renderer.scene, model, state) for state in (data, other)]
                ways = [begin[1] - path[i][1] for begin, path in zip(begins, paths, strict=True)]
                lines = [
                    strip(name, bend, way, i / FPS)
                    for name, bend, way in zip(WALKS, bends, ways, strict=True)
                ]
                yield np.concatenate([lines[0], renderer.render(), lines[1]])

    shown = [Image.fromarray(frame) for frame in frames()]
    write_film(shown, [1000 / FPS] * len(shown), OUT, width=SHOWN)


if __name__ == "__main__":
    main()
