# Tests of view/explore.py, view/page.py
"""The page of a directory in headless Chromium and Firefox: what is drawn, pointer and keys, filters, recordings."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chromium
import firefox
import numpy as np
import pytest
from chromium import READY
from fakes.explore_data import MEASURES, NAMES, atlas, falling, many, posed, sweep
from fakes.sweep_fake import OPTIMUM, Noisy

from nermo_mjx import read_table, run_sweep
from nermo_mjx.view.explore import explore

pytestmark = pytest.mark.release
RECORDED = (3, 20)
SELECTED = "(explorer.chart.chosen < 0 ? null : explorer.table.rows[explorer.chart.chosen])"
COUNT = "explorer.filters.places.length"
TOLD = "document.getElementById('announcement').textContent"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("explore")


@pytest.fixture(scope="module")
def rows(folder: Path) -> dict[str, np.ndarray]:
    """The table of the sweep that most pages show."""
    table = read_table(sweep(folder / "sweep", RECORDED))
    return {
        name: np.asarray(table.column(name).to_numpy(zero_copy_only=False))
        for name in table.column_names
    }


@pytest.fixture(scope="module")
def page(folder: Path, rows: dict[str, np.ndarray]) -> Path:
    return explore(folder / "sweep").save(folder / "sweep.html")


@pytest.fixture(scope="module", params=[chromium, firefox], ids=["chromium", "firefox"])
def window(request: pytest.FixtureRequest) -> Iterator[Any]:
    """A page in each of both browsers."""
    with request.param.page() as page:
        yield page


@pytest.fixture
def tab(window: Any) -> Iterator[Any]:
    """The page, which must not have complained in the end, and whose controls have names."""
    yield window
    assert window.complaints() == []
    assert window.nameless() == []


def opened(tab: Any, path: Path, width: int = 1000, height: int = 640, dark: bool = False) -> Any:
    """The page; one that opens on a gain then shows the best speed over frequency and amplitude."""
    tab.open(path, width, height, dark)
    tab.wait(READY)
    if tab.evaluate("Boolean(explorer.table.field('speed_gain'))"):
        choose(tab, x="frequency", y="spine.amplitude", colour="speed", of="best")
    return tab


def choose(tab: Any, **choices: str) -> None:
    """Choose in the lists above the plot, as a user does."""
    for name, value in choices.items():
        tab.evaluate(f"""(() => {{ const list = document.getElementById({json.dumps(name)});
            list.value = {json.dumps(value)}; list.dispatchEvent(new Event("change")); return list.value; }})()""")


def place_of(tab: Any, row: int) -> tuple[float, float]:
    """Where a row is drawn in the window."""
    x, y = tab.evaluate(
        f"(({{x, y}}) => [x, y])(explorer.chart.itemOf(explorer.table.placeOf.get({row})))"
    )
    return tab.box("#marks")["left"] + x, tab.box("#marks")["top"] + y


def click(tab: Any, x: float, y: float) -> None:
    tab.mouse("mouseMoved", x, y)
    tab.mouse("mousePressed", x, y)
    tab.mouse("mouseReleased", x, y)


def drag(tab: Any, begin: tuple[float, float], end: tuple[float, float]) -> None:
    tab.mouse("mousePressed", *begin)
    tab.mouse("mouseMoved", (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2)
    tab.mouse("mouseMoved", *end)
    tab.mouse("mouseReleased", *end)


# --- what is drawn


def test_a_gain_is_white_at_none_and_red_where_it_is_a_loss(tab: Any, page: Path) -> None:
    tab.open(page, 1000, 640)
    tab.wait(READY)
    text = tab.evaluate("document.getElementById('scale').textContent")
    assert text.startswith("speed gain [%]")
    low, high = tab.evaluate("[explorer.chart.colouring.low, explorer.chart.colouring.high]")
    assert low == -high < 0

    def rgb(value: float) -> list[int]:
        script = f"explorer.chart.colouring.css(explorer.chart.colouring.level({value}))"
        return [int(tab.evaluate(script)[i : i + 2], 16) for i in (1, 3, 5)]

    neutral, loss, gain = map(rgb, (0, low, high))
    assert min(neutral) > 235
    assert loss[0] > loss[2]
    assert gain[2] > gain[0]
    groups = tab.evaluate(
        "[...document.querySelectorAll('#colour optgroup')].map((each) => each.label)"
    )
    assert {"Parameters", "Walk"} <= set(groups)
    choose(tab, colour="spine.phase")
    assert sum(abs(a - b) for a, b in zip(rgb(-3.14), rgb(3.14), strict=True)) < 30, (
        "both ends of a turn"
    )


def test_points_are_where_their_numbers_say_in_colours_of_viridis(
    tab: Any, page: Path, rows: dict[str, Any]
) -> None:
    opened(tab, page)
    tab.key("c")
    choose(tab, x="spine.phase", y="speed", colour="speed")
    good = np.flatnonzero(rows["status"] == "ok")
    places = np.array([place_of(tab, int(row)) for row in good])
    for column, values in ((0, rows["spine.phase"]), (1, rows["speed"])):
        line = np.polyfit(values[good], places[:, column], 1)
        np.testing.assert_allclose(np.polyval(line, values[good]), places[:, column], atol=0.6)
        assert (line[0] > 0) == (column == 0), "to the right, and up"
    pixels = tab.pixels()
    for row, colour in (
        (int(np.argmin(rows["speed"])), (68, 1, 84)),
        (int(np.argmax(rows["speed"])), (253, 231, 37)),
    ):
        x, y = np.round(place_of(tab, row)).astype(int)
        near = pixels[y - 6 : y + 7, x - 6 : x + 7].reshape(-1, 3)
        assert np.abs(near - colour).max(axis=1).min() < 12, (row, rows["status"][row])
    text = tab.evaluate("document.getElementById('scale').textContent")
    assert text.startswith("speed [mm/s]")
    assert "high is better" in text


def test_cells_have_the_best_the_mean_and_the_worst_of_their_runs(
    tab: Any, page: Path, rows: dict[str, Any]
) -> None:
    """Of those that count: a run that fell is in its cell, and not in its value."""
    opened(tab, page)
    for statistic, function in (("best", np.max), ("mean", np.mean), ("worst", np.min)):
        choose(tab, of=statistic)
        cell_positions = tab.evaluate(
            "explorer.chart.items.map((item) => [item.x, item.y, item.value, item.places.length, item.lost])"
        )
        assert len(cell_positions) == 12
        across, up = (sorted({round(item[i], 1) for item in cell_positions}) for i in (0, 1))
        for x, y, value, count, lost_runs in cell_positions:
            frequency = np.unique(rows["frequency"])[across.index(round(x, 1))]
            amplitude = np.unique(rows["spine.amplitude"])[::-1][up.index(round(y, 1))]
            inside = (rows["frequency"] == frequency) & (rows["spine.amplitude"] == amplitude)
            well = inside & (rows["status"] == "ok")
            assert value == pytest.approx(function(rows["speed"][well]), rel=1e-5)
            assert (
                (count, lost_runs)
                == (inside.sum(), inside.sum() - well.sum())
                == (3, 3 - well.sum())
            )


def test_an_atlas_shows_its_cells_where_its_measures_are(tab: Any, tmp_path: Path) -> None:
    path, values = atlas(tmp_path / "atlas")
    opened(tab, explore(path).save(tmp_path / "atlas.html"))
    elements = tab.evaluate(
        "explorer.chart.items.map((item) => [item.box, explorer.table.rows[item.place]])"
    )
    assert sorted(row for _, row in elements) == values["row"].tolist()
    frame = tab.evaluate("explorer.chart.frame")
    for (left, top, _, height), row in elements:
        cell = int(values["cell"][np.flatnonzero(values["row"] == row)[0]])
        across, up = cell // MEASURES[1]["cells"], cell % MEASURES[1]["cells"]
        assert left == pytest.approx(frame["left"] + across * frame["width"] / 5, abs=0.1)
        assert top + height == pytest.approx(
            frame["top"] + frame["height"] - up * frame["height"] / 4, abs=0.1
        )
    tab.evaluate(f"explorer.choose(explorer.table.placeOf.get({values['row'][0]}))")
    commands = tab.evaluate(
        "[...document.querySelectorAll('#row code')].map((code) => code.textContent)"
    )
    replay_command, walk = commands
    assert replay_command.startswith("nermo-mjx replay ")
    assert replay_command.endswith(f" --row {values['row'][0]}")
    assert (
        walk
        == f"nermo-mjx walk --gait lateral_walk --cycles 8 --warmup 2 --set frequency={values['frequency'][0]}"
    )


# --- pointer and keys


def test_a_click_shows_a_runs_numbers_and_its_commands(
    tab: Any, page: Path, folder: Path, rows: dict[str, Any]
) -> None:
    opened(tab, page)
    tab.key("c")
    choose(tab, x="spine.phase", y="speed")
    row = int(np.argmax(np.where(rows["status"] == "ok", rows["speed"], 0)))
    click(tab, *place_of(tab, row))
    assert tab.evaluate(SELECTED) == row
    text = tab.evaluate("document.getElementById('row').innerText").replace("\u202f", " ")
    assert f"Row {row}" in text
    assert f"{1e3 * rows['speed'][row]:.4g} mm/s" in text
    assert f"{np.rad2deg(rows['spine.phase'][row]):.4g} deg".replace("-", "−") in text
    commands = tab.evaluate(
        "[...document.querySelectorAll('#row code')].map((code) => code.textContent)"
    )
    assert commands[0] == f"nermo-mjx replay {folder / 'sweep'} --row {row}"
    assert f"--set frequency={rows['frequency'][row]}" in commands[1]
    assert tab.evaluate("document.getElementById('tip').innerText").startswith(f"row {row}")
    x, y = place_of(tab, row)
    click(tab, x, y + 60)
    tab.key("Escape")
    assert tab.evaluate(SELECTED) is None
    assert "Best by speed" in tab.evaluate("document.getElementById('row').innerText")


def test_a_command_is_copied(tab: Any, page: Path) -> None:
    opened(tab, page)
    tab.evaluate("explorer.choose(5)")
    tab.evaluate(
        """Object.defineProperty(navigator, 'clipboard',
            {value: {writeText: async (text) => (window.copied = text)}}) && 1"""
    )
    tab.click("#row .command button")
    tab.wait("document.querySelector('#row .command button').textContent === 'Copied'")
    assert tab.evaluate("window.copied === document.querySelector('#row code').textContent")


def test_keys_walk_choose_and_let_go(tab: Any, page: Path, rows: dict[str, Any]) -> None:
    opened(tab, page)
    tab.key("c")
    choose(tab, x="frequency", y="spine.amplitude")
    for _ in range(15):
        tab.key("Tab")
        if tab.evaluate("document.activeElement.id") == "marks":
            break
    assert tab.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    ranked = np.argsort(-rows["speed"], kind="stable")
    tab.key("Home")
    assert f"row {ranked[0]}," in tab.evaluate(TOLD)
    tab.key("PageDown")
    tab.key("PageDown")
    tab.key("PageUp")
    assert f"row {ranked[1]}," in tab.evaluate(TOLD)
    tab.key("Enter")
    assert tab.evaluate(SELECTED) == ranked[1]
    parameters = {name: rows[name][ranked[1]] for name in ("frequency", "spine.amplitude")}
    for key, name, next_one in (
        ("ArrowLeft", "frequency", -1),
        ("ArrowDown", "spine.amplitude", -1),
        ("ArrowRight", "frequency", 1),
    ):
        tab.key(key)
        values = np.unique(rows[name])
        parameters[name] = values[np.searchsorted(values, parameters[name]) + next_one]
        row = int(tab.evaluate("explorer.table.rows[explorer.chart.current.place]"))
        assert {column_name: rows[column_name][row] for column_name in parameters} == parameters, (
            key
        )
    assert tab.evaluate(SELECTED) == ranked[1], "walking chooses nothing"
    tab.key("End")
    assert f"row {ranked[-1]}," in tab.evaluate(TOLD)
    tab.key("Escape")
    assert tab.evaluate(SELECTED) is None
    tab.key("?", shift=True)
    assert "walk from run to run" in tab.evaluate("document.getElementById('help').innerText")
    tab.key("Escape")
    assert not tab.evaluate("document.getElementById('help').open")


# --- filters


def test_brushes_handles_and_names_keep_the_runs_that_they_say(
    tab: Any, page: Path, rows: dict[str, Any]
) -> None:
    opened(tab, page)
    tab.key("c")
    choose(tab, x="frequency", y="speed")
    box, frame = tab.box("#marks"), tab.evaluate("explorer.chart.frame")
    left, top = box["left"] + frame["left"], box["top"] + frame["top"]
    middle = left + 0.5 * frame["width"]
    drag(tab, (left + 4, top + 4), (middle, top + frame["height"] - 4))
    slow = rows["frequency"] < 0.8
    assert tab.evaluate(COUNT) == slow.sum()
    assert (
        tab.evaluate("document.getElementById('count').textContent")
        == f"{slow.sum()} of 36 runs shown"
    )
    # A handle of another column, moved by a key.
    tab.evaluate("document.querySelector('[data-field=\"spine.amplitude\"] input').focus()")
    tab.key("ArrowRight")
    bent = rows["spine.amplitude"] > 0
    assert tab.evaluate(COUNT) == (slow & bent).sum()
    tab.key("r")
    assert tab.evaluate(COUNT) == 36
    # A name: what fell is switched off.
    tab.click("[aria-label=status] button")
    assert (
        tab.evaluate(
            "document.querySelector('[aria-label=status] button').getAttribute('aria-pressed')"
        )
        == "false"
    )
    assert tab.evaluate(COUNT) == (rows["status"] == "ok").sum() < 36
    # Nothing left, and back again.
    tab.click("[aria-label=status] button:last-of-type")
    assert tab.evaluate("!document.getElementById('empty').hidden")
    tab.click("#empty-reset")
    assert tab.evaluate(COUNT) == 36
    # A histogram's first bars.
    bars = tab.box("[data-field=frequency] canvas")
    y = bars["top"] + 10
    drag(tab, (bars["left"] + 2, y), (bars["left"] + 0.4 * bars["width"], y))
    assert tab.evaluate(COUNT) == (rows["frequency"] < 0.8).sum()


def test_rows_shown_are_saved_as_csv_with_all_digits(
    tab: Any, page: Path, rows: dict[str, Any]
) -> None:
    opened(tab, page)
    tab.evaluate("explorer.filters.keep(explorer.table.field('frequency'), 0.6, 0.95)")
    text = tab.evaluate("explorer.csv")
    lines = list(csv.DictReader(io.StringIO(text)))
    inside = (rows["frequency"] > 0.6) & (rows["frequency"] < 0.95)
    assert list(lines[0]) == ["frequency", "spine.amplitude", "spine.phase"]
    for name in lines[0]:
        np.testing.assert_array_equal([float(line[name]) for line in lines], rows[name][inside])


@pytest.mark.parametrize("width", [390, 1280])
def test_the_answer_of_an_optimum_is_whole(tab: Any, folder: Path, width: int) -> None:
    """No cell is cut or beside the window; a line of the table is three lines of text, on a phone a card with heads."""
    out = folder / "optimum"
    if not out.exists():
        run_sweep(OPTIMUM, out, simulator=Noisy(), progress=False)
    tab.open(explore(out).save(folder / "optimum.html"), width, 800)
    tab.wait(READY)
    assert tab.evaluate("answer.scrollWidth <= answer.clientWidth")
    assert tab.evaluate(
        "[...answer.querySelectorAll('td')].every((each) => each.scrollWidth <= each.clientWidth + 1)"
    )
    heights = tab.evaluate(
        "[...answer.querySelectorAll('tr')].slice(1).map((each) => each.offsetHeight)"
    )
    assert len(heights) == 2
    assert max(heights) < (62 if width == 1280 else 230)
    heads = tab.evaluate(
        "[...answer.querySelectorAll('td')].map((td) => getComputedStyle(td, '::before').content)"
    )
    assert sum(head not in ("none", "normal") for head in heads) == (
        0 if width == 1280 else len(heads) - 2
    )
    first, second = (
        tab.evaluate(f"answer.querySelectorAll('tr')[{i}].classList.contains('shown')")
        for i in (1, 2)
    )
    assert (first, second) == (True, False)


def test_ten_thousand_rows_with_structures_answer_at_once(tab: Any, tmp_path: Path) -> None:
    path = tmp_path / "many"
    opened(tab, explore(many(path, 10_000)).save(tmp_path / "many.html"))
    table = read_table(path)
    gait, phase = (
        table.column("gait").to_numpy(zero_copy_only=False),
        table.column("spine.phase").to_numpy(),
    )
    assert tab.evaluate(
        "[...document.querySelectorAll('[aria-label=gait] button')].map((b) => b.firstChild.data)"
    ) == sorted(NAMES)
    tab.click("[aria-label=gait] button")
    assert tab.evaluate(COUNT) == (gait != sorted(NAMES)[0]).sum()
    choose(tab, x="gait", y="spine.phase", colour="gait")
    took = tab.evaluate(
        "(() => { const begin = performance.now(); explorer.filters.release(); return performance.now() - begin; })()"
    )
    assert took < 1500, "a tenth of that on a quiet machine [ms]"
    across = np.array(tab.evaluate("explorer.chart.items.map((item) => item.x)"))
    frame = tab.evaluate("explorer.chart.frame")
    band = np.floor((across - frame["left"]) / frame["width"] * 3).astype(int)
    np.testing.assert_array_equal(np.array(sorted(NAMES))[band], gait)
    choose(tab, x="radius", colour="speed")
    log = "['x', 'colour'].map((id) => document.getElementById(`${id}-log`).getAttribute('aria-pressed'))"
    assert tab.evaluate(log) == ["true", "false"], "three decades, and less than one"
    places = np.array(tab.evaluate("explorer.chart.items.map((item) => item.x)"))
    line = np.polyfit(np.log(table.column("radius").to_numpy()), places, 1)
    assert np.abs(np.polyval(line, np.log(table.column("radius").to_numpy())) - places).max() < 0.5
    tab.evaluate("explorer.choose(0)")
    text = tab.evaluate("document.getElementById('row').innerText")
    assert f"{np.rad2deg(phase[0]):.4g}".replace("-", "−") in text


# --- recordings


def test_a_recording_plays_in_3d_and_closes(tab: Any, page: Path) -> None:
    opened(tab, page)
    tab.evaluate(f"explorer.choose(explorer.table.placeOf.get({RECORDED[0]}))")
    tab.evaluate("document.getElementById('play-run').focus()")
    tab.key("Enter")
    inside = "document.querySelector('#theatre iframe')?.contentWindow?.viewer"
    tab.wait(f"{inside}?.player.time > 0.15")
    tab.evaluate(f"{inside}.player.toggle(false)")
    walk = falling()
    for sample in (9, 30):
        data = posed(walk, sample)
        tab.evaluate(f"{inside}.player.seek({walk.time[sample]})")
        for body in ("torso", "head", "rear_left_foot", "front_right_pulley"):
            position = tab.evaluate(f"""(() => {{ const [clip] = {inside}.clips; let found;
                clip.pose(clip.at({walk.time[sample]}), (body, position) => {{
                    if (body === {data.body(body).id}) found = Array.from(position); }}); return found; }})()""")
            np.testing.assert_allclose(
                position, data.body(body).xpos, atol=4e-4, err_msg=f"{body} at {sample}"
            )
    assert (
        tab.evaluate("document.getElementById('theatre-title').textContent") == f"Row {RECORDED[0]}"
    )
    tab.click("#theatre-after")
    tab.wait(
        f"{inside}?.player.time > 0.02 && document.querySelector('#theatre iframe').title.endsWith(' {RECORDED[1]}')"
    )
    assert tab.evaluate(SELECTED) == RECORDED[1]
    tab.wait("document.activeElement.tagName === 'IFRAME'")
    tab.key("Escape")
    tab.wait(
        "!document.getElementById('theatre').open && !document.querySelector('#theatre iframe')"
    )
    assert tab.evaluate("document.activeElement.id") == "marks"
    assert tab.evaluate(SELECTED) == RECORDED[1], "the run is still chosen"


# --- windows and access


def test_the_page_needs_nothing_else(tab: Any, page: Path) -> None:
    opened(tab, page)
    loaded = tab.evaluate("performance.getEntriesByType('resource').map((each) => each.name)")
    assert [name for name in loaded if not name.startswith(("data:", "blob:"))] == []
    assert tab.evaluate("document.title") == "Nermo: sweep, a sweep"


@pytest.mark.parametrize(("width", "height"), [(390, 780), (1280, 720), (800, 600)])
def test_everything_fits_its_window(tab: Any, page: Path, width: int, height: int) -> None:
    opened(tab, page, width, height)
    width, height = tab.evaluate(
        "[innerWidth, innerHeight]"
    )  # Firefox has no window as narrow as a phone
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.outside(["marks", "x", "save", "help"], width, height, 20) == []
    assert tab.box("#marks")["width"] * tab.box("#marks")["height"] > 0.3 * width * height
    tab.evaluate(
        "document.querySelector('[data-field=\"spine.phase\"] input').scrollIntoView() ?? null"
    )
    assert 0 <= tab.box("[data-field='spine.phase']")["top"] < height


def test_a_dark_page_is_dark_and_its_points_can_be_seen(
    tab: Any, page: Path, rows: dict[str, Any]
) -> None:
    light = opened(tab, page).pixels().mean()
    opened(tab, page, dark=True)
    assert tab.pixels().mean() < light / 2
    tab.key("c")
    pixels = tab.pixels()
    x, y = np.round(place_of(tab, int(np.argmin(rows["speed"])))).astype(int)
    disc = pixels[y - 8 : y + 9, x - 8 : x + 9].reshape(-1, 3).sum(axis=1)
    assert disc.max() - disc.min() > 120, "the darkest colour has an edge"
