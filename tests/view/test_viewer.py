# Tests of view/recorded.py, view/clip.py, view/page.py
"""The page of a recording, without a browser: forces and tensions against physics, what is packed, the command."""

from __future__ import annotations

import dataclasses
import gzip
import json
import re
from base64 import b64decode
from pathlib import Path

import mujoco
import numpy as np
import pytest
from command import call
from fakes.explore_data import posed

from nermo_mjx import Recording, load_robot, show
from nermo_mjx.plotting.style import FOOT
from nermo_mjx.robot import LIMBS
from nermo_mjx.view import RecordingError, robot_of
from nermo_mjx.view.clip import shapes_of
from nermo_mjx.view.page import NAN_STEP, Packer, Page
from nermo_mjx.view.recorded import (
    Motion,
    details_of,
    finite_samples,
    headline_of,
    motion_of,
    plots_of,
    recorded_model,
    title_of,
)

WEB = Path(__file__).parents[2] / "nermo_mjx" / "view" / "web"


@pytest.fixture(scope="module")
def walk(walks) -> Recording:
    """Three seconds of a trot with a bending spine."""
    return walks("c").recording(5).between(0.0, 3.0)


@pytest.fixture(scope="module")
def motion(walk: Recording) -> Motion:
    return motion_of(walk, robot_of(walk).model)


# --- what is drawn


@pytest.mark.release
def test_the_ground_carries_the_robot(walk: Recording, motion: Motion) -> None:
    """All contacts together are MuJoCo's constraint force on the free joint; on average, the weight.

    Within a tenth: the samples lie at the ends of ticks, where the servos' targets have just taken a step.
    """
    total = sum(contact.force for contact in motion.contacts)
    for sample in range(50, 300, 10):
        np.testing.assert_allclose(
            total[sample], posed(walk, sample).qfrc_constraint[:3], atol=1e-3
        )
    assert total[50:300, 2].mean() == pytest.approx(
        9.81 * load_robot().model.body_mass.sum(), rel=0.1
    )


@pytest.mark.release
def test_contact_forces_are_those_that_the_feet_felt(walk: Recording) -> None:
    """Sensors were read before a tick's last step: of the states there, the forces must be what was recorded."""
    model = load_robot().physical
    data = mujoco.MjData(model)
    steps = round((walk.time[1] - walk.time[0]) / model.opt.timestep)
    states = []
    for sample in range(20, 280):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (
            walk.qpos[sample],
            walk.qvel[sample],
            walk.ctrl[sample + 1],
        )
        mujoco.mj_step(model, data, steps - 1)
        states.append((data.qpos.copy(), data.qvel.copy()))
    window = slice(21, 281)
    qpos, qvel = (np.array(column) for column in zip(*states, strict=True))
    section = Recording(
        walk.time[window], qpos, qvel, walk.ctrl[window], model_hash=walk.model_hash
    )
    motion = motion_of(section, load_robot().model)
    for limb in range(4):
        normal = sum(contact.force[:, 2] for contact in motion.contacts if contact.limb == limb)
        error = normal - walk.sensors["foot_force"][window, limb]
        # The engine's solver began each step where the one before had ended; at impacts that shows.
        assert np.quantile(np.abs(error), 0.9) < 0.01, f"{limb}: {np.sort(np.abs(error))[-30:]}"


@pytest.mark.release
def test_contact_points_are_at_the_feet_on_the_ground(walk: Recording, motion: Motion) -> None:
    for contact in motion.contacts:
        loaded = np.linalg.norm(contact.force, axis=1) > 0.1
        # In the middle between sole and ground, and soles give by up to 3 mm.
        np.testing.assert_allclose(contact.point[loaded, 2], 0.0, atol=0.0015)
        if contact.limb < 0:  # the tail
            continue
        # A sole is a sphere of 3.8 mm. The sensors' readings are one step old, so that the pose gives the foot.
        for sample in np.flatnonzero(loaded)[::5]:
            foot = posed(walk, sample).site(f"{LIMBS[contact.limb]}_foot").xpos
            assert np.linalg.norm(contact.point[sample] - foot) < 0.0038


def test_tensions_are_those_that_turn_the_pulleys(walk: Recording, motion: Motion) -> None:
    """Nothing else constrains a knee's pulley, so that its constraint torque is the tension times the radius."""
    tendons = {tendon.name: tendon for tendon in motion.tendons}
    for sample in range(20, 300, 35):
        data = posed(walk, sample)
        for limb in LIMBS:
            dof = data.model.joint(f"{limb}_pulley").dofadr[0]
            # From a cold start the solver ends elsewhere within its tolerance. MuJoCo's wrap is that of the rim.
            torque = abs(data.qfrc_constraint[dof]) / 0.008
            assert tendons[f"{limb}_tendon"].tension[sample] == pytest.approx(torque, abs=0.02)
    assert all(tendon.tension.min() >= 0 for tendon in motion.tendons)


def test_drawn_tendons_are_as_long_as_mujocos(walk: Recording, motion: Motion) -> None:
    for sample in (10, 120, 290):
        data = posed(walk, sample)
        for i, tendon in enumerate(motion.tendons):
            length = np.linalg.norm(np.diff(tendon.path[sample], axis=0), axis=1).sum()
            # The arcs are polygons of six chords.
            assert length == pytest.approx(data.ten_length[i], rel=0.005)


def test_forces_are_those_of_the_runs_own_body(walk: Recording) -> None:
    heavy = dataclasses.replace(
        walk, metadata={**walk.metadata, "parameters": {"mass.front": 0.3, "frequency": 0.8}}
    )
    model = recorded_model(heavy, robot_of(heavy))
    assert model.body_mass.sum() - load_robot().model.body_mass.sum() == pytest.approx(
        0.3 - 0.1695, abs=1e-3
    )
    robot = robot_of(walk)
    assert recorded_model(walk, robot) is robot.model


def test_a_run_is_shown_up_to_where_it_lost_its_numbers(walk: Recording) -> None:
    invalid_qpos = walk.qpos.copy()
    invalid_qpos[120:] = np.nan
    invalid_recording = dataclasses.replace(walk, qpos=invalid_qpos)
    assert len(motion_of(invalid_recording, load_robot().model).time) == 120
    assert '"cut":true' in show(invalid_recording).html
    nothing = dataclasses.replace(walk, qpos=np.full_like(walk.qpos, np.nan))
    with pytest.raises(RecordingError, match="no finite state"):
        show(nothing)


def test_a_long_run_is_thinned_evenly(walk: Recording) -> None:
    samples = finite_samples(walk, 90)
    assert len(samples) <= 90
    assert set(np.diff(samples)) == {4}


def test_all_shapes_are_packed_with_their_colours() -> None:
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/><material name="red" rgba="1 0 0 1"/>
        <texture name="half" type="2d" builtin="flat" rgb1=".5 .5 .5" width="4" height="4"/>
        <material name="dull" texture="half" rgba="1 .5 1 1"/></asset><worldbody>
        <geom type="plane" size="0 0 .1"/><geom type="box" size=".1 .2 .3" material="red"/>
        <geom type="sphere" size=".1" material="dull"/><geom type="capsule" size=".1 .2" rgba="0 1 0 .5"/>
        <geom type="cylinder" size=".1 .2" group="3"/><geom type="ellipsoid" size=".1 .2 .3"/>
        <body><joint/><geom type="mesh" mesh="m" mass="1"/></body></worldbody></mujoco>""")
    shapes = shapes_of(model, Packer())
    kinds = [geom["kind"] for geom in shapes["geoms"]]
    assert kinds == ["plane", "box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh"]
    colours = {geom["kind"]: geom["rgba"] for geom in shapes["geoms"]}
    assert colours["box"] == [1, 0, 0, 1]
    np.testing.assert_allclose(colours["sphere"], [0.5, 0.25, 0.5, 1], atol=0.01)
    assert colours["capsule"] == [0, 1, 0, 0.5]
    assert [geom["collides"] for geom in shapes["geoms"]] == [
        False,
        False,
        False,
        False,
        True,
        False,
        False,
    ]
    assert shapes["meshes"][0]["vertices"]["shape"] == [4, 3]
    assert shapes["meshes"][0]["faces"]["shape"][1] == 3


# --- what is plotted


def test_plots_show_what_the_sensors_read(walk: Recording, motion: Motion) -> None:
    from nermo_mjx.kinematics.body import attitude

    plots = {plot.key: plot for plot in plots_of(walk, motion)}
    angles = np.rad2deg(np.asarray(attitude(walk.sensors["orientation"])))
    for i, line in enumerate(plots["attitude"].lines):
        np.testing.assert_allclose(line.values, angles[:, i], atol=1e-3)
    np.testing.assert_array_equal(plots["force"].lines[2].values, walk.sensors["foot_force"][:, 2])
    limbs = ["front left", "front right", "rear left", "rear right"]
    assert [line.name for line in plots["force"].lines] == [*limbs, "tail"]
    np.testing.assert_array_equal(plots["force"].lines[4].values, walk.sensors["tail_force"])
    knee, commanded = plots["knee"].lines[:2]
    np.testing.assert_allclose(knee.values, np.rad2deg(walk.sensors["servo_angle"][:, 4]))
    np.testing.assert_allclose(commanded.values, np.rad2deg(walk.ctrl[:, 4]))
    smooth = plots["speed"].lines[0].values
    speed = -np.diff(walk.sensors["position"][:, 1])[62:187].sum() / 1.25
    assert np.nanmean(smooth[100:150]) == pytest.approx(1e3 * speed, rel=0.15)
    assert {plot.unit for plot in plots.values()} == {"", "N", "°", "mm/s", "mm"}


def test_a_recording_without_sensors_has_fewer_plots(walk: Recording) -> None:
    bare = dataclasses.replace(walk, sensors={}, metadata={})
    keys = [plot.key for plot in plots_of(bare, motion_of(bare, load_robot().model))]
    assert keys == ["knee_tension", "spine_tension"]
    assert show(bare).samples == len(bare.time)


# --- packing


def test_packed_steps_are_within_half_a_step() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(40, 3, 2)).cumsum(axis=0)
    values[5, 1, 1] = np.nan
    packer = Packer()
    packer.plain(np.arange(3.0))
    entry = packer.steps(values)
    content = gzip.decompress(b64decode(packer.text()))
    size = values.size
    raw = np.frombuffer(content, np.uint8, 2 * size, entry["at"])
    words = (raw[:size].astype(np.uint16) << 8 | raw[size:]).view(np.int16).reshape(6, 40)
    steps = np.cumsum(words, axis=1, dtype=np.int16).T.reshape(values.shape)
    decoded = np.where(steps == NAN_STEP, np.nan, entry["zero"] + entry["scale"] * steps)
    np.testing.assert_allclose(decoded, values, atol=np.nanmax(np.abs(values)) / 60_000)
    assert np.isnan(decoded[5, 1, 1])


def test_constant_and_empty_values_can_be_packed() -> None:
    packer = Packer()
    assert packer.steps(np.full((4, 2), 3.0))["zero"] == 3.0
    assert packer.steps(np.full((4,), np.nan))["scale"] == 1.0
    json.dumps(packer.steps(np.zeros((3, 0, 3))), allow_nan=False)


# --- the page


def test_a_page_needs_nothing_else_and_is_small(walk: Recording) -> None:
    page = show(walk, walk)
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page.html), (
        "something is loaded from elsewhere"
    )
    assert "<!--" not in page.html.replace("<!doctype", "")
    # Two walks of 3 s; one of 10 s is about as large.
    assert len(page.html) < 2.5e6
    assert page.samples == len(walk.time)


def test_texts_of_a_recording_cannot_break_the_page(walk: Recording) -> None:
    evil = dataclasses.replace(
        walk, metadata={**walk.metadata, "versions": {"x": "</script><script>alert(1)//"}}
    )
    assert "</script><script>alert" not in show(evil).html


def test_a_page_is_saved_whole_or_not_at_all(tmp_path: Path) -> None:
    page = Page("<p>ü</p>")
    assert page.save(tmp_path / "new" / "a.html").read_text(encoding="utf-8") == "<p>ü</p>"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.html"]
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        page.save(tmp_path / "file" / "a.html")


@pytest.mark.parametrize(
    ("name", "version", "file"),
    [
        ("three", r"three@0\.(\d+)\.\d+", "three.min.js"),
        ("meshoptimizer", r"meshoptimizer@([\d.]+)", "simplifier.min.js"),
    ],
)
def test_vendored_libraries_have_licence_and_version(name: str, version: str, file: str) -> None:
    folder = WEB / "vendor" / name
    assert "MIT License" in (folder / "LICENSE").read_text()
    assert re.search(version, (WEB / "vendor" / "build.sh").read_text()) is not None
    assert "</script" not in (folder / file).read_text()


def test_an_experiments_recording_has_its_cases_name_and_figures(walk: Recording) -> None:
    metadata = {
        "case": "trot, 0.67 Hz, with spine",
        "labels": {"profile": "exact", "spine": True},
        "metrics": {"speed": 0.0791, "status": "ok"},
        "parameters": {"frequency": 0.67},
    }
    recording = dataclasses.replace(walk, metadata=metadata)
    assert title_of(recording) == "trot, 0.67 Hz, with spine"
    assert headline_of(recording) == [["speed", "79.1 mm/s"], ["profile", "exact"]]
    assert details_of(recording)[0] == {
        "title": "Case",
        "rows": [["profile", "exact"], ["spine", "yes"]],
    }


def test_limbs_have_the_colours_of_all_figures() -> None:
    style = (WEB / "style.css").read_text()
    assert {limb: re.search(rf"--{limb}: light-dark\((#\w+),", style)[1] for limb in FOOT} == FOOT


# --- the command


def test_the_command_writes_a_page(walk: Recording, tmp_path: Path) -> None:
    path = walk.save(tmp_path / "walk.npz")
    out = tmp_path / "walk.html"
    result = call("view", path, path, "--out", out, "--no-open", "--json")
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    assert output == {
        "page": str(out),
        "bytes": out.stat().st_size,
        "samples": len(walk.time),
        "opened": False,
    }


@pytest.mark.release
def test_the_command_opens_a_browser_where_there_is_one(
    walk: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: not opened.append(url))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = walk.save(tmp_path / "walk.npz")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    result_without_browser = call("view", path)
    assert opened == []
    assert "no browser was found" in result_without_browser.stdout
    monkeypatch.setenv("DISPLAY", ":0")
    result = call("view", path)
    assert len(opened) == 1
    assert opened[0].startswith("file:///")
    assert result.stdout.startswith("wrote ")
    assert Path(opened[0].removeprefix("file://")).stat().st_mode & 0o044 == 0o044
    assert call("view", path, "--no-open", "--quiet").stdout.startswith("wrote "), (
        "else nobody knows where it lies"
    )
    assert len(opened) == 1


def test_the_command_refuses_another_scene_and_another_kind_of_file(
    walk: Recording, tmp_path: Path
) -> None:
    """What is no recording of this robot is refused by all commands alike, see test_cli.py."""
    path = walk.save(tmp_path / "walk.npz")
    dataclasses.replace(walk, metadata={"setup": {"scene": "moon"}}).save(tmp_path / "moon.npz")
    for arguments, code, sentence in (
        ([tmp_path / "moon.npz"], 2, "scene is 'moon'"),
        ([path, "--out", tmp_path / "walk.pdf"], 2, "a page ends in .html, not in '.pdf'"),
        ([path, "--out", path / "x.html"], 1, "cannot be written"),
    ):
        result = call("view", *arguments)
        assert (result.exit_code, result.stdout) == (code, ""), arguments
        assert sentence in result.stderr
