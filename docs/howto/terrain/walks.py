"""The walks of docs/spine_on_terrain.md as short recordings, walks/SCENE/SPINE.npz beside this file, and the pictures
of that page and of docs/terrain.md.

python walks.py
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from search_gait import PLACES, SLACK, Ground, gaits

from nermo_mjx import Run
from nermo_mjx.recording import Recording

sys.path.insert(0, str(Path(__file__).parents[2]))
import pictures

HERE = Path(__file__).parent
IMAGES = HERE.parents[1] / "images"
SPINES = ("free", "stiff", "passive")
SHOWN = "0"  # the seed
BEGIN, END, EVERY = 1.0, 5.0, 4  # [s], samples: 25 of 100 in a second
WIDTH, HEIGHT = 200, 150  # of a robot's picture [pixels]
FPS = 8
FILM = "spiral_stairs"  # a film, where the other terrains have a picture
#: The sensors that the page in the browser shows.
SENSORS = ("position", "orientation", "linear_velocity", "servo_angle", "foot_force", "tail_force")


def short(recording: Recording) -> Recording:
    """What is shown, in single precision: 50 kB instead of 900."""
    whole = recording.between(BEGIN, END)

    def thin(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[::EVERY], np.float32)

    arrays = {name: thin(getattr(whole, name)) for name in ("qpos", "qvel", "ctrl")}
    sensors = {name: thin(whole.sensors[name]) for name in SENSORS}
    return dataclasses.replace(whole, time=whole.time[::EVERY], sensors=sensors, **arrays)


def recorded(ground: Ground, spine: str, seed: str, folder: Path) -> list[Path]:
    """A walk of a gait over each terrain, on the default body, from one start."""
    gait = gaits().loc[spine, seed].dropna().to_dict() | (SLACK if spine == "passive" else {})
    files = []
    for place in PLACES:
        values = {**gait, **place.values, "contact.friction": 1.2}
        values |= {} if None in place.heights else {"terrain.height": 0.01}
        result = ground.simulators[place.scene].run(
            values, Run(duration=10.0, warmup=1.0), record=True
        )
        speed, aside = (float(result.metrics[name][0]) for name in ("speed", "cross_track_peak"))
        outcome = f"{result.status[0]}, {1000 * speed:.0f} mm/s, {1000 * aside:.0f} mm aside"
        print(f"{spine} {seed} on {place.scene}: {outcome}", flush=True)
        files.append(short(result.recording()).save(folder / place.scene / f"{spine}.npz"))
    return files


def rendered(files: list[Path], out: Path) -> None:
    """Recordings side by side."""
    size = ["--fps", str(FPS), "--width", str(WIDTH), "--height", str(HEIGHT)]
    subprocess.run(["nermo-mjx", "render", *files, "--out", out, *size, "--quiet"], check=True)


if __name__ == "__main__":
    bent, straight = Ground("free"), Ground("stiff")
    beside = [
        recorded(bent if spine == "free" else straight, spine, SHOWN, HERE / "walks")
        for spine in SPINES
    ]
    with tempfile.TemporaryDirectory() as folder:
        for files in zip(*beside, strict=True):
            name, film = files[0].parent.name, Path(folder, "beside.gif")
            rendered(list(files), film)
            frames, durations = pictures.read_film(film)
            if name == FILM:
                pictures.write_film(
                    frames, durations, IMAGES / "spines" / f"{name}.webp", width=456
                )
            else:
                pictures.write_picture(frames[len(frames) // 2], IMAGES / "spines" / f"{name}.webp")
        films = []
        for file in recorded(straight, "passive", "begin", Path(folder)):
            rendered([file], file.with_suffix(".gif"))
            films.append(pictures.read_film(file.with_suffix(".gif"))[0])
    sheets = []
    for frames in zip(*films, strict=True):
        sheets.append(Image.new("RGB", (4 * WIDTH, 2 * HEIGHT), "white"))
        for i, frame in enumerate(frames):
            sheets[-1].paste(frame, (i % 4 * WIDTH, i // 4 * HEIGHT))
    pictures.write_film(sheets, [1000 / FPS] * len(sheets), IMAGES / "terrains.webp", width=640)
