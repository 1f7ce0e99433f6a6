# Tests of view/video.py, view/camera.py, view/offscreen.py
"""Videos: right size, right length, something moves in them, and every failure is one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio.v2 as imageio
import mujoco
import numpy as np
import pytest
from PIL import Image, ImageSequence

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.view import Recording, RecordingError, VideoError, offscreen, render, video
from nermo_mjx.view.camera import (
    INSIDE_COLOUR,
    OUTSIDE_COLOUR,
    draw_support,
    is_inside,
    smooth_path,
    support_polygon,
)
from nermo_mjx.view.video import Pane, frame_samples, write_video

SCENE = """
<mujoco>
  <asset><texture name='c' type='2d' builtin='checker' width='64' height='64' rgb1='1 1 1' rgb2='.2 .2 .2'/>
  <material name='c' texture='c' texrepeat='4 4' texuniform='true'/></asset>
  <worldbody>
    <light pos='0 0 2'/><geom type='plane' size='0 0 .1' material='c'/>
    <camera name='own' pos='0 -1 .5' xyaxes='1 0 0 0 .4 1'/>
    <body name='torso' pos='0 0 .1'><freejoint/><geom type='box' size='.05 .1 .03' rgba='1 0 0 1'/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SCENE)


def walk(
    model: mujoco.MjModel, seconds: float = 0.3, rate: float = 100.0, speed: float = 0.5
) -> Recording:
    """A box that glides to -y at `speed` m/s."""
    time = np.arange(round(seconds * rate) + 1) / rate
    qpos = np.tile(model.qpos0, (len(time), 1))
    qpos[:, 1] = -speed * time
    return Recording(time, qpos, np.zeros((len(time), model.nv)), np.zeros((len(time), 0)))


@pytest.mark.usefixtures("drawing")
def test_an_mp4_has_the_size_and_length_asked_for_and_moves(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    calls: list[tuple[int, int]] = []
    path = render(
        walk(model),
        model,
        tmp_path / "a" / "walk.mp4",
        fps=20,
        width=128,
        height=96,
        progress=lambda completed, total: calls.append((completed, total)),
    )
    with imageio.get_reader(path) as reader:
        frames, meta = [np.asarray(frame) for frame in reader], reader.get_meta_data()
    assert (meta["codec"], meta["pix_fmt"][:7], meta["fps"]) == ("h264", "yuv420p", 20), (
        "as players can play it"
    )
    assert len(frames) == 7, "0.3 s at 20 frames/s, both ends included"
    assert frames[0].shape == (96, 128, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1.0, (
        "the floor passes under the robot"
    )
    assert calls == [(i, 7) for i in range(1, 8)]
    assert [file.name for file in path.parent.iterdir()] == ["walk.mp4"]


@pytest.mark.usefixtures("drawing")
def test_a_gif_by_its_suffix_at_half_speed_from_a_camera_of_the_model(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    path = render(
        walk(model),
        model,
        tmp_path / "walk.gif",
        fps=20,
        width=63,
        height=49,
        speed=0.5,
        camera="own",
    )
    frames = imageio.mimread(path)
    assert len(frames) == 13
    assert frames[0].shape[:2] == (49, 63)


@pytest.mark.usefixtures("drawing")
def test_a_webp_shows_what_a_gif_shows(model: mujoco.MjModel, tmp_path: Path) -> None:
    """All frames, without end, in real time, and the same picture but for its compression."""
    options: dict = {"fps": 10, "width": 64, "height": 48}
    gif, webp = (
        render(walk(model), model, tmp_path / f"walk.{kind}", **options) for kind in ("gif", "webp")
    )
    with Image.open(gif) as gif_image, Image.open(webp) as webp_image:
        assert webp_image.format == "WEBP"
        assert webp_image.info["loop"] == 0
        assert webp_image.n_frames == gif_image.n_frames == 4
        for first, second in zip(
            ImageSequence.Iterator(gif_image), ImageSequence.Iterator(webp_image), strict=True
        ):
            difference = np.subtract(first.convert("RGB"), second.convert("RGB"), dtype=float)
            assert np.abs(difference).mean() < 8.0
            assert second.info["duration"] == 100


@pytest.mark.parametrize(("fps", "count"), [(13, 60), (17, 60), (30, 60), (50, 60), (20, 1)])
def test_a_gif_lasts_as_long_as_its_frames_should(tmp_path: Path, fps: int, count: int) -> None:
    """To half of the hundredth of a second that the format counts in, whatever the rate; also a single frame."""
    frames = (np.full((8, 8, 3), 4 * i, np.uint8) for i in range(count))
    path = write_video(tmp_path / "v.gif", frames, count, fps=fps, width=8, height=8)
    with Image.open(path) as gif:
        lasts = sum(frame.info["duration"] for frame in ImageSequence.Iterator(gif))
    assert lasts == pytest.approx(1000 * count / fps, abs=5.0)


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("camera", ["side", "top", "three_quarter", "high", "front", "rear"])
def test_every_following_view_keeps_the_robot_in_the_middle(
    model: mujoco.MjModel, tmp_path: Path, camera: str
) -> None:
    path = render(
        walk(model, seconds=4.0),
        model,
        tmp_path / "w.gif",
        fps=1,
        width=64,
        height=48,
        camera=camera,
    )
    for frame in imageio.mimread(path):
        colour = np.asarray(frame)[..., :3].astype(int)
        red = (colour[..., 0] > 1.5 * colour[..., 1]) & (colour[..., 0] > 60)
        rows, columns = np.nonzero(red)
        assert 0.02 < red.mean() < 0.7
        assert abs(columns.mean() - 32) < 10
        assert abs(rows.mean() - 24) < 13


@pytest.mark.parametrize(
    ("file", "options", "sentence"),
    [
        ("walk.avi", {}, "ends in .mp4, .gif or .webp"),
        ("walk", {}, "ends in .mp4, .gif or .webp"),
        ("walk.mp4", {"width": 63}, "even width"),
        ("walk.mp4", {"fps": 0}, "1 to 240 frames/s"),
        ("walk.gif", {"fps": 51}, r"^fps is 51: allowed is \[1, 50\] in a GIF"),
        ("walk.mp4", {"speed": -1.0}, "speed above 0"),
        (
            "walk.gif",
            {"camera": "nose"},
            "camera is 'nose': allowed is one of three_quarter, .*own",
        ),
        (
            "walk.gif",
            {"overlays": ("tail",)},
            "overlay is 'tail': allowed is one of gait, servos, support",
        ),
        ("walk.gif", {"overlays": ("gait",)}, "needs the sensor 'foot_force'"),
        ("walk.gif", {"overlays": ("gait", "gait")}, "each name once"),
    ],
)
def test_what_cannot_be_made_is_said_in_one_sentence(
    model: mujoco.MjModel, tmp_path: Path, file: str, options: dict, sentence: str
) -> None:
    with pytest.raises((ParameterError, RecordingError), match=sentence):
        render(walk(model), model, tmp_path / file, **options)
    assert not list(tmp_path.iterdir())


def test_a_diverged_run_is_shown_up_to_where_it_diverged(model: mujoco.MjModel) -> None:
    recording = walk(model, seconds=1.0)
    recording.qpos[50:] = np.nan
    assert frame_samples(recording, fps=50, speed=1.0).max() == 49 - 1
    recording.qpos[:] = np.nan
    with pytest.raises(RecordingError, match="no finite state"):
        frame_samples(recording, fps=50, speed=1.0)


def test_frames_show_the_nearest_sample(model: mujoco.MjModel) -> None:
    np.testing.assert_array_equal(
        frame_samples(walk(model, 1.0, rate=100), 25, 1.0), np.arange(0, 101, 4)
    )
    slow = frame_samples(walk(model, 1.0, rate=10), 50, 1.0)
    np.testing.assert_array_equal(slow, np.round(np.arange(51) / 5 + 1e-9).astype(int))


def test_the_camera_follows_a_steady_walk_without_lag_and_without_shaking() -> None:
    time = np.arange(200) / 50
    steady = np.stack([0.1 * time, -0.2 * time, 0 * time], axis=1)
    np.testing.assert_allclose(smooth_path(steady, 1 / 50), steady, atol=1e-9)
    shaken = steady + 0.01 * np.sin(2 * np.pi * 2.0 * time)[:, None]
    assert np.abs(smooth_path(shaken, 1 / 50) - steady)[25:-25].max() < 0.001


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_side_by_side_shows_both_in_step_with_captions_and_ways(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    slow, fast = walk(model, seconds=2.0, speed=0.1), walk(model, seconds=1.0, speed=0.2)
    panes = [
        Pane(slow, "Start", ["speed 100 mm/s"]),
        Pane(fast, "Best", ["speed 200 mm/s", "a long line " * 12]),
    ]
    path = render(panes, model, tmp_path / "both.mp4", fps=4, width=120, height=80, speed=0.5)
    frames = [np.asarray(frame).astype(int) for frame in imageio.get_reader(path)]
    assert len(frames) == 9, (
        "as long as the shorter one, 1 s at half speed and 4 frames/s, both ends included"
    )
    assert frames[0].shape[1] == 2 * 120 + 4
    assert frames[0].shape[0] > 80 + 3 * 18 + 40, "long captions have more lines"
    bars = frames[-1][-40 + 11, :, 0] < 100
    left, right = bars[:120].sum(), bars[124:].sum()
    assert right == pytest.approx(104, abs=3), "the furthest fills its track"
    assert left == pytest.approx(right / 2, abs=3)
    assert np.abs(frames[0] - frames[-1])[:60].mean() < 1.0, "captions stand still"


def test_side_by_side_needs_a_recording_and_an_even_picture(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    with pytest.raises(ParameterError, match="at least one recording"):
        render([], model, tmp_path / "v.mp4")
    with pytest.raises(ParameterError, match="even width"):
        render([Pane(walk(model), "a")], model, tmp_path / "v.mp4", width=63)


def trotting(model: mujoco.MjModel, seconds: float = 4.0) -> Recording:
    """A box with the sensors of a robot: the diagonal pairs stand alternately, for half a second each."""
    bare = walk(model, seconds, speed=0.1)
    first = (bare.time % 1.0) < 0.5
    force = np.stack([first, ~first, ~first, first], axis=1) * 0.7
    feet = np.array(
        [[0.04, -0.06, 0.0], [-0.04, -0.06, 0.0], [0.04, 0.06, 0.0], [-0.04, 0.06, 0.0]]
    )
    position = (
        feet + np.pad(bare.qpos[:, None, 1:2], ((0, 0), (0, 3), (1, 1)), mode="constant")[:, :1]
    )
    angle = np.sin(2 * np.pi * bare.time)[:, None] * np.ones(9)
    sensors = {"foot_force": force, "foot_position": position, "servo_angle": angle}
    return Recording(bare.time, bare.qpos, bare.qvel, angle, sensors=sensors)


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_the_footfall_passes_below_the_picture_in_step_with_the_time(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    """Left of the cursor is what was: its width says when the feet last changed."""
    recording = trotting(model)
    path = render(
        recording,
        model,
        tmp_path / "w.mp4",
        fps=4,
        width=320,
        height=96,
        overlays=("gait", "support"),
    )
    frames = [np.asarray(frame).astype(int) for frame in imageio.get_reader(path)]
    assert (
        frames[0].shape[0] == 96 + video.Strip(recording, video.gait_panels(recording), 320).height
    )
    room = 320 - video.MARGIN_PIXELS
    for i, seconds in ((1, 0.25), (8, 2.0), (11, 2.75), (16, 4.0)):
        strip = frames[i][96 + 11, video.MARGIN_PIXELS :]  # the row of the front left foot
        blue = strip[:, 2] - strip[:, 0] > 100
        first = np.clip(
            seconds - video.PAST_SECONDS, 0.0, 4.0 - video.PAST_SECONDS - video.FUTURE_SECONDS
        )
        for share in (0.1, 0.3, 0.5, 0.65):
            moment = first + share * (video.PAST_SECONDS + video.FUTURE_SECONDS)
            if moment < seconds and 0.04 < moment % 0.5 < 0.46:
                assert blue[round(share * room)] == (moment % 1.0 < 0.5), (seconds, moment)


def test_the_support_polygon_is_that_of_the_feet_that_stand() -> None:
    feet = np.array([[1.0, -1.0], [-1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    centre, outside = np.zeros(2), np.array([0.5, -0.6])
    four = support_polygon(feet, np.array([True] * 4))
    assert len(four) == 4
    assert is_inside(four, centre)
    three = support_polygon(feet, np.array([False, True, True, True]))
    assert is_inside(three, np.array([-0.3, 0.4]))
    assert not is_inside(three, outside)
    pair = support_polygon(feet, np.array([True, False, False, True]))
    assert len(pair) == 2
    assert not is_inside(pair, centre)
    assert len(support_polygon(feet, np.zeros(4, bool))) == 0


PAIR = np.array([1.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("force", "tail", "colour", "parts"),
    [
        (np.ones(4), None, INSIDE_COLOUR, 4 + 4 + 3),
        (PAIR, None, OUTSIDE_COLOUR, 1 + 2 + 3),
        (np.zeros(4), None, OUTSIDE_COLOUR, 3),
        (PAIR, 0.5, INSIDE_COLOUR, 3 + 3 + 3),
        (PAIR, 0.0, OUTSIDE_COLOUR, 1 + 2 + 3),
    ],
)
def test_the_scene_shows_polygon_and_centre_of_mass(
    model: mujoco.MjModel,
    force: np.ndarray,
    tail: float | None,
    colour: tuple[float, ...],
    parts: int,
) -> None:
    """Four feet are corners, two make a line, which nothing is inside of; with a tail that bears a load, a triangle."""
    recording = trotting(model, seconds=0.2)
    recording.sensors["foot_force"][:] = force
    if tail is not None:
        recording.sensors["tail_force"] = np.full(len(recording.time), tail)
    scene, centre = mujoco.MjvScene(model, 100), np.array([0.002, recording.qpos[3, 1] + 0.01, 0.1])
    draw_support(
        scene, recording, 3, centre, None if tail is None else np.array([0.02, 0.25, 0.004])
    )
    assert scene.ngeom == parts
    np.testing.assert_allclose(scene.geoms[parts - 1].rgba, colour, atol=1e-6)
    np.testing.assert_allclose(scene.geoms[parts - 1].pos, centre, atol=1e-6)


def without_gl(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(offscreen, "_headless_backend", lambda: None)


@pytest.mark.parametrize(
    ("lacks", "remedy"),
    [
        (without_gl, "apt-get install libosmesa6"),
        (
            lambda patch: patch.setitem(sys.modules, "imageio_ffmpeg", None),
            r"pip install imageio-ffmpeg",
        ),
        (
            lambda patch: patch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere/ffmpeg"),
            r"IMAGEIO_FFMPEG_EXE is '/nowhere/ffmpeg', .* or write a \.gif",
        ),
    ],
    ids=["GL", "ffmpeg", "its program"],
)
def test_a_machine_that_lacks_something_gets_the_remedy(
    model: mujoco.MjModel,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lacks: Callable,
    remedy: str,
) -> None:
    lacks(monkeypatch)
    with pytest.raises(VideoError, match=remedy):
        render(walk(model), model, tmp_path / "walk.mp4", width=64, height=48)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_what_cannot_be_written_is_refused_in_a_line_before_anything_is_drawn(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    def frames() -> Iterator[np.ndarray]:
        raise AssertionError("drawn")
        yield

    (tmp_path / "file").write_text("")
    with pytest.raises(VideoError, match=r"cannot be written \([^\n]*\)\.$"):
        write_video(tmp_path / "file" / f"a{suffix}", frames(), 1, fps=10, width=64, height=48)
    with pytest.raises(VideoError, match=r"cannot be written \(No such file or directory\)\.$"):
        write_video(Path("/proc") / f"a{suffix}", frames(), 1, fps=10, width=64, height=48)
    assert capfd.readouterr() == ("", "")
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


@pytest.mark.release
def test_the_order_of_imports_does_not_matter_without_a_display() -> None:
    script = (
        "import mujoco\nmodel = mujoco.MjModel.from_xml_string('<mujoco/>')\nimport nermo_mjx\n"
        "from nermo_mjx.view import offscreen\noffscreen.require_gl()\n"
        "with mujoco.Renderer(model, 32, 48) as renderer:\n    print(renderer.render().shape)\n"
    )
    hidden = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"}
    environment = {key: value for key, value in os.environ.items() if key not in hidden}
    process = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert process.stdout == "(32, 48, 3)\n"
