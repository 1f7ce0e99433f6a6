# Tests of view/clip.py, view/page.py
"""The page in headless Chromium: it draws where MuJoCo says, plays, scrubs, takes keys, and fits its window."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import chromium
import mujoco
import numpy as np
import pytest
from chromium import READY
from fakes.explore_data import posed

from nermo_mjx import Recording, show
from nermo_mjx.view import robot_of
from nermo_mjx.view.recorded import motion_of

pytestmark = pytest.mark.release

#: What must be within reach in any window.
CONTROLS = ["play", "scrub", "speed", "loop", "plots-toggle", "help", "canvas", "plot-list", "view"]
#: The last change has been drawn as well as stills are.
RESTING = "!viewer.stage.stale && viewer.stage.quality.shown === viewer.stage.quality.still"


@pytest.fixture(scope="module")
def pair(walks) -> tuple[Recording, Recording]:
    """Two seconds of a trot with a bending spine, and of another without."""
    bent, stiff = (walks("c").recording(world).between(0.0, 2.0) for world in (5, 0))
    return bent, stiff


@pytest.fixture(scope="module")
def page_path(pair: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return show(pair[0]).save(tmp_path_factory.mktemp("pages") / "one.html")


@pytest.fixture(scope="module")
def two(pair: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return show(*pair).save(tmp_path_factory.mktemp("pages") / "two.html")


@pytest.fixture
def tab(browser: chromium.Browser) -> Iterator[chromium.Tab]:
    """A page, closed again, which must not have complained, and whose controls have names."""
    with browser.tab() as page:
        yield page
        assert page.complaints() == []
        assert page.nameless() == []


def opened(
    tab: chromium.Tab, path: Path, width: int = 560, height: int = 420, dark: bool = False
) -> chromium.Tab:
    """The page, held at its beginning."""
    tab.open(path, width, height, dark)
    tab.wait(READY)
    tab.evaluate("viewer.player.toggle(false), viewer.player.seek(viewer.player.begin)")
    return tab


def stage_picture(tab: chromium.Tab) -> np.ndarray:
    """The 3D picture without the overlaid tools."""
    tab.evaluate("viewer.stage.stale = true")
    tab.wait(RESTING)
    box = tab.box("#stage")
    return tab.pixels((box["left"], box["top"] + 34, box["right"], box["bottom"] - 30))


def share_changed(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the pixels that differ visibly."""
    return float((np.abs(a - b).max(axis=2) > 24).mean())


# --- data and pose


def test_the_page_has_all_it_needs_and_complains_of_nothing(
    tab: chromium.Tab, page_path: Path
) -> None:
    opened(tab, page_path)
    assert tab.requests() == [page_path.resolve().as_uri()]
    assert tab.evaluate("document.title") == "Nermo: Trot, 0.8 Hz, spine stride extension"
    assert "speed" in tab.evaluate("document.querySelector('.figures').textContent")


def test_bodies_are_where_mujoco_puts_them(
    tab: chromium.Tab, page_path: Path, pair: tuple[Recording, Recording]
) -> None:
    """Between samples they are between."""
    opened(tab, page_path)
    walk, bodies = pair[0], "viewer.stage.actors[0].robot.bodies"
    for sample in (0, 77, 150, 199):
        data = posed(walk, sample)
        tab.evaluate(f"viewer.player.seek({walk.time[sample]})")
        for body in (
            "torso",
            "head",
            "spine_hip",
            "front_left_foot",
            "rear_right_foot",
            "rear_left_pulley",
        ):
            element = f"{bodies}[{data.body(body).id}]"
            position, (x, y, z, w) = tab.evaluate(
                f"[{element}.position.toArray(), {element}.quaternion.toArray()]"
            )
            np.testing.assert_allclose(
                position, data.body(body).xpos, atol=1e-4, err_msg=f"{body} at sample {sample}"
            )
            assert abs(np.dot([w, x, y, z], data.body(body).xquat)) == pytest.approx(1, abs=1e-7), (
                body
            )
    tab.evaluate(f"viewer.player.seek({walk.time[100:102].mean()})")
    places = [posed(walk, sample).body("front_right_foot").xpos for sample in (100, 101)]
    position = tab.evaluate(f"{bodies}[{data.body('front_right_foot').id}].position.toArray()")
    np.testing.assert_allclose(position, np.mean(places, axis=0), atol=1e-4)


def test_tensions_and_forces_arrive_as_they_were(
    tab: chromium.Tab, page_path: Path, pair: tuple[Recording, Recording]
) -> None:
    opened(tab, page_path)
    motion = motion_of(pair[0], robot_of(pair[0]).model)
    for i, tendon in enumerate(motion.tendons):
        values_of_page = tab.evaluate(f"Array.from(viewer.clips[0].tendons[{i}].tension)")
        np.testing.assert_allclose(values_of_page, tendon.tension, atol=1e-3)
    for i, contact in enumerate(motion.contacts):
        values_of_page = tab.evaluate(f"Array.from(viewer.clips[0].contacts[{i}].force)")
        np.testing.assert_allclose(np.reshape(values_of_page, (-1, 3)), contact.force, atol=1e-3)


# --- time


def test_the_page_opens_in_motion(tab: chromium.Tab, page_path: Path) -> None:
    tab.open(page_path)
    tab.wait(READY)
    tab.wait("viewer.player.time > viewer.player.begin")
    assert tab.evaluate("viewer.player.playing")


def test_a_phone_cuts_no_number_and_names_both_recordings(
    tab: chromium.Tab, tmp_path: Path
) -> None:
    walks = Path(__file__).parents[2] / "docs" / "howto" / "terrain" / "walks" / "stairs"
    opened(tab, show(walks / "free.npz", walks / "stiff.npz").save(tmp_path / "two.html"), 390, 844)
    spans = "[...document.querySelectorAll('.figures span')]"
    assert tab.evaluate(f"{spans}.length") > 6
    assert tab.evaluate(
        f"{spans}.every((each) => each.getBoundingClientRect().right <= innerWidth - 100)"
    )
    heads = tab.evaluate(
        "[...document.querySelectorAll('.run h1')].map((each) => each.textContent)"
    )
    assert [head.partition(":")[0] for head in heads] == ["Afree", "Bstiff"]


def test_playing_goes_on_scrubbing_jumps_and_keys_step(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path)
    time = "viewer.player.time"
    tab.key(" ")
    tab.wait(f"{time} > 0.3")
    assert tab.evaluate("document.getElementById('play').getAttribute('aria-label')") == "Pause"
    tab.key(" ")
    stopped = tab.evaluate(time)
    assert not tab.evaluate("viewer.player.playing")
    tab.evaluate("new Promise((done) => setTimeout(done, 200))")
    assert tab.evaluate(time) == stopped
    tab.key("Home")
    assert tab.evaluate(time) == pytest.approx(0.01, abs=1e-6)
    tab.key("ArrowRight")
    assert tab.evaluate(time) == pytest.approx(0.02, abs=1e-6)
    tab.key("ArrowRight", shift=True)
    tab.key("ArrowLeft")
    assert tab.evaluate(time) == pytest.approx(0.11, abs=1e-6)
    tab.key("End")
    assert tab.evaluate(time) == pytest.approx(2.0, abs=0.02)
    tab.click("#scrub", 0.5)
    assert tab.evaluate(time) == pytest.approx(1.0, abs=0.05)
    assert tab.evaluate("document.getElementById('clock').textContent").startswith(
        f"{tab.evaluate(time):.2f} / 2.0"
    )


def test_speed_and_loop(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path)
    tab.key("ArrowDown")
    assert tab.evaluate("document.getElementById('speed').value") == "0.5"
    tab.evaluate("viewer.player.setSpeed(4)")
    tab.key("l")
    tab.evaluate("viewer.player.seek(1.5)")
    tab.key("k")
    tab.wait("!viewer.player.playing")
    assert tab.evaluate("viewer.player.time === viewer.player.end")
    tab.key("l")
    tab.evaluate("viewer.player.seek(1.9); viewer.player.toggle(true)")
    tab.wait("viewer.player.time < 1")
    assert tab.evaluate("viewer.player.playing")


def test_plots_go_with_the_time_and_a_click_seeks(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path, 1000, 700)
    tab.evaluate("viewer.player.seek(1.0)")
    cursor_position = "new DOMMatrix(getComputedStyle(document.querySelector('[data-plot=force] .cursor')).transform).e"
    middle = tab.evaluate(cursor_position)
    tab.evaluate("viewer.player.seek(1.5)")
    assert tab.evaluate(cursor_position) > middle + 40
    width = tab.evaluate("document.querySelector('[data-plot=force] .area').clientWidth")
    tab.click("[data-plot=force] .area", (40 + 0.25 * (width - 54)) / width)
    assert tab.evaluate("viewer.player.time") == pytest.approx(0.01 + 0.25 * 1.99, abs=0.02)
    reading = tab.evaluate(
        "document.querySelector('[data-plot=attitude] output').textContent"
    ).replace("−", "-")
    row = tab.evaluate("viewer.clips[0].rowAt(viewer.player.time)")
    roll = tab.evaluate(
        f"viewer.clips[0].plots.find((p) => p.key === 'attitude').lines[0].values[{row}]"
    )
    assert float(reading) == pytest.approx(roll, abs=0.06)


def test_a_tick_is_not_cut_where_values_hardly_differ(tab: chromium.Tab, page_path: Path) -> None:
    """As in the first moment of a drive: its forces are of a millionth of a newton."""
    opened(tab, page_path, 1000, 700)
    begins = tab.evaluate("""(() => {
        const paper = CanvasRenderingContext2D.prototype, { fillText } = paper, begins = [];
        paper.fillText = function (text, x, y) {
            if (this.textAlign === "right") begins.push(x - this.measureText(text).width);
        };
        for (const { values } of viewer.clips[0].plots.find(({ key }) => key === "force").lines) {
            values.forEach((_, i) => (values[i] = 1e-6 * (i % 2)));
        }
        viewer.plots.draw();
        Object.assign(paper, { fillText });
        return begins;
    })()""")
    assert len(begins) > 20
    assert min(begins) >= 0


# --- picture


def test_keys_change_the_picture_and_change_it_back(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path)
    tab.evaluate("viewer.player.seek(1.2)")
    picture = stage_picture(tab)
    for key in "tcrhg23456":
        tab.key(key)
        assert share_changed(picture, stage_picture(tab)) > 0.0005, key
        tab.key("1" if key.isdigit() else key)
    assert share_changed(picture, stage_picture(tab)) < 0.0005


def test_dragging_turns_and_the_camera_follows_unless_told_not_to(
    tab: chromium.Tab, page_path: Path
) -> None:
    opened(tab, page_path)
    tab.evaluate("viewer.player.seek(0.2)")
    camera = "viewer.stage.man.camera.position.toArray()"
    initial_camera = np.array(tab.evaluate(camera))
    tab.evaluate("viewer.player.seek(1.8)")
    followed = np.array(tab.evaluate(camera))
    assert (followed - initial_camera)[1] < -0.08, "it walks towards -y"
    tab.key("f")
    tab.evaluate("viewer.player.seek(0.2)")
    np.testing.assert_allclose(tab.evaluate(camera), followed)
    tab.mouse("mousePressed", 150, 200)
    tab.mouse("mouseMoved", 210, 220)
    tab.mouse("mouseReleased", 210, 220)
    assert np.linalg.norm(np.array(tab.evaluate(camera)) - followed) > 0.05
    turned = np.array(tab.evaluate(camera))
    tab.key("f")
    assert np.linalg.norm(np.array(tab.evaluate(camera)) - turned) > 0.05, "it catches up"


def test_a_dark_page_is_dark(tab: chromium.Tab, page_path: Path) -> None:
    light = stage_picture(opened(tab, page_path)).mean()
    assert stage_picture(opened(tab, page_path, dark=True)).mean() < light / 2


# --- two recordings


def test_two_recordings_are_shown_in_step(
    tab: chromium.Tab, two: Path, pair: tuple[Recording, Recording]
) -> None:
    opened(tab, two, 1000, 600)
    tab.evaluate(f"viewer.player.seek({pair[0].time[150]})")
    places = []
    for clip, walk in enumerate(pair):
        torso = posed(walk, 150).body("torso")
        position = tab.evaluate(
            f"viewer.stage.actors[{clip}].robot.bodies[{torso.id}].position.toArray()"
        )
        np.testing.assert_allclose(position, torso.xpos, atol=1e-4)
        places.append(position)
    assert tab.evaluate("document.querySelectorAll('#runs .mark').length") == 2
    over = stage_picture(tab)
    tab.key("b")
    shift = tab.evaluate("viewer.stage.actors[1].group.position.toArray()")
    assert shift[1] == pytest.approx(places[0][1] - places[1][1], abs=0.02), (
        "in the first one's place"
    )
    tab.key("b")
    assert (
        tab.evaluate(
            "viewer.stage.actors[1].group.position.x - viewer.stage.actors[0].group.position.x"
        )
        > 0.1
    )
    assert share_changed(over, stage_picture(tab)) > 0.05
    assert " | " in tab.evaluate("document.querySelector('[data-plot=force] output').textContent")
    tab.key("i")
    text = tab.evaluate("document.getElementById('details').textContent")
    assert "spine.amplitude22.92°0°" in text


# --- windows, access, and browsers that can less


@pytest.mark.parametrize(("width", "height"), [(390, 780), (640, 360), (1280, 720)])
def test_everything_fits_its_window(tab: chromium.Tab, two: Path, width: int, height: int) -> None:
    opened(tab, two, width, height)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.outside(CONTROLS, width, height) == []
    assert tab.box("#stage")["width"] * tab.box("#stage")["height"] > 0.3 * width * height


def test_a_control_shows_its_focus(tab: chromium.Tab, two: Path) -> None:
    opened(tab, two, 1000, 600)
    for tag in ("SUMMARY", "SUMMARY", "BUTTON"):
        tab.key("Tab")
        assert tab.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
        assert tab.evaluate("document.activeElement.tagName") == tag


def test_help_opens_lists_the_keys_and_closes(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path)
    tab.key("?", shift=True)
    assert tab.evaluate("document.getElementById('help').open")
    assert "play, pause" in tab.evaluate("document.getElementById('help').textContent")
    assert "ghost" not in tab.evaluate("document.getElementById('keys').textContent")
    tab.key("Escape")
    assert not tab.evaluate("document.getElementById('help').open")


def test_a_frame_in_a_notebook_works(
    tab: chromium.Tab, pair: tuple[Recording, Recording], tmp_path: Path
) -> None:
    path = tmp_path / "notebook.html"
    path.write_text(
        f"<!doctype html><meta charset=utf-8><body>{show(pair[0], height=400)._repr_html_()}</body>"
    )
    tab.open(path, 800, 500)
    tab.wait(
        "document.querySelector('iframe')?.contentDocument?.documentElement?.dataset.ready === 'yes'"
    )
    assert tab.evaluate("document.querySelector('iframe').clientHeight") == 400
    assert tab.evaluate("document.querySelector('iframe').contentWindow.viewer.stage !== null")


def test_a_page_of_another_model_draws_its_shapes_and_meshes(
    tab: chromium.Tab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>
        <geom type="plane" size="0 0 .1"/><geom type="box" size=".01 .02 .03"/>
        <body name="torso" pos="0 0 .2"><freejoint/><geom type="mesh" mesh="m" mass="1" rgba="1 0 0 1"/></body>
        </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    rows = []
    for _ in range(50):
        mujoco.mj_step(model, data)
        rows.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = (np.array(column) for column in zip(*rows, strict=True))
    monkeypatch.setattr(
        "nermo_mjx.view.clip.robot_of",
        lambda _: type("Robot", (), {"model": model, "config": None}),
    )
    monkeypatch.setattr("nermo_mjx.view.clip.recorded_model", lambda *_: model)
    recording = Recording(np.arange(1, 51) * model.opt.timestep, qpos, qvel, np.zeros((50, 0)))
    opened(tab, show(recording).save(tmp_path / "mesh.html"))
    picture = stage_picture(tab)
    red = (picture[..., 0] > 90) & (picture[..., 1] < 60) & (picture[..., 2] < 60)
    assert red.mean() > 0.005
    assert tab.evaluate("viewer.clips[0].model.fine[1].seen.attributes.position.count") == 12, (
        "four triangles"
    )


def test_the_curved_skull_is_smooth(tab: chromium.Tab, page_path: Path) -> None:
    """Corners of a triangle on a curved mesh have normals of their own; on a faceted one they share the face's."""
    opened(tab, page_path)
    shares = tab.evaluate("""(() => {
        const { bodies, fine } = viewer.clips[0].model;
        const { attributes, index } = fine[bodies.indexOf("head")].seen;
        const corner = (i) => [0, 1, 2].map((k) => attributes.normal.getComponent(index.getX(i), k));
        let flat = 0;
        for (let i = 0; i < index.count; i += 3) {
            const [a, b, c] = [corner(i), corner(i + 1), corner(i + 2)];
            const same = (p, q) => p.every((value, k) => Math.abs(value - q[k]) < 1e-3);
            if (same(a, b) && same(b, c)) flat++;
        }
        return flat / (index.count / 3);
    })()""")
    assert shares < 0.6


def test_moving_pictures_are_coarse_and_stills_are_fine(tab: chromium.Tab, page_path: Path) -> None:
    """Where there is no graphics card, as here."""
    opened(tab, page_path)
    tab.wait(RESTING)
    triangles, pixels = "viewer.stage.renderer.info.render.triangles", "viewer.stage.canvas.width"
    still = tab.evaluate(f"[{triangles}, {pixels}]")
    tab.key(" ")
    tab.wait("viewer.player.time > 0.3")
    moving = tab.evaluate(f"[{triangles}, {pixels}]")
    assert moving[0] < still[0] / 2
    assert moving[1] < still[1]
    tab.key(" ")
    tab.wait(RESTING)
    assert tab.evaluate(f"[{triangles}, {pixels}]") == still
    orbit = "viewer.stage.look('top')"
    assert (
        tab.evaluate(
            f"new Promise((done) => {{ {orbit}; requestAnimationFrame(() => done({triangles})); }})"
        )
        < still[0] / 2
    )


def test_a_coarse_robot_is_as_large_as_the_fine_one(tab: chromium.Tab, page_path: Path) -> None:
    opened(tab, page_path)
    boxes = tab.evaluate("""["fine", "coarse"].map((detail) => viewer.clips[0].model[detail].map(({ seen }) => {
        if (!seen) return null;
        seen.computeBoundingBox();
        return [...seen.boundingBox.min.toArray(), ...seen.boundingBox.max.toArray()];
    }))""")
    box_pairs = [(fine, coarse) for fine, coarse in zip(*boxes, strict=True) if fine]
    assert len(box_pairs) > 20
    for fine, coarse in box_pairs:
        np.testing.assert_allclose(coarse, fine, atol=1.5e-3)


def test_the_ground_is_as_light_without_lamps_as_with_them(
    tab: chromium.Tab, page_path: Path
) -> None:
    """Half of what is seen must not change its shade when the time begins to go on."""
    opened(tab, page_path)
    tab.evaluate("viewer.player.seek(1.0)")
    plain = stage_picture(tab)
    tab.evaluate(
        "viewer.stage.quality.still = { share: 1, plain: false, coarse: false }; viewer.player.seek(1.0)"
    )
    glossy = stage_picture(tab)
    assert np.median(np.abs(plain - glossy).max(axis=2)) <= 2
    # The shadows lie in the same places, and are as dark.
    dark = [
        (picture.max(axis=2) < 200) & (picture.min(axis=2) > 120) for picture in (plain, glossy)
    ]
    assert (dark[0] & dark[1]).sum() / (dark[0] | dark[1]).sum() > 0.6


def test_without_webgl_a_sentence_stands_for_the_picture_and_plots_work(
    program: str, page_path: Path
) -> None:
    with chromium.browser(program, webgl=False) as running, running.tab() as tab:
        opened(tab, page_path, 900, 600)
        assert tab.evaluate("viewer.stage") is None
        assert "no WebGL" in tab.evaluate("document.getElementById('no-picture').innerText")
        tab.key(" ")
        tab.wait("viewer.player.time > 0.1")
        assert tab.evaluate("document.querySelector('[data-plot=force] output').textContent") != ""


def test_a_page_that_may_not_start_says_so(
    browser: chromium.Browser, page_path: Path, tmp_path: Path
) -> None:
    """As in a frame whose host forbids scripts from data URLs."""
    rule = "<meta http-equiv='Content-Security-Policy' content=\"script-src 'unsafe-inline'\">"
    path = tmp_path / "forbidden.html"
    path.write_text(
        page_path.read_text(encoding="utf-8").replace("</title>", f"</title>{rule}", 1),
        encoding="utf-8",
    )
    with browser.tab() as tab:
        tab.open(path, 700, 400)
        tab.wait("document.getElementById('failed') && !document.getElementById('failed').hidden")
        assert "could not start" in tab.evaluate("document.getElementById('failed').innerText")
