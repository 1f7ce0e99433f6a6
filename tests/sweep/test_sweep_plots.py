# Tests of sweep/plots.py
"""The figures of a sweep: which ones there are, and that they show the table's numbers in shown units."""

import matplotlib
import numpy as np
import pytest
from fakes.sweep_fake import AMPLITUDES, FREQUENCIES, PHASES, SPEC, FakeSimulator, speed
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.image import imread

from nermo_mjx.plotting.charts import colour_scale, heat_maps
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.shown import shown
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.sweep import Results, run_sweep
from nermo_mjx.sweep.plots import figures_of_results


def plots_of(spec, out, simulator=None):
    return run_sweep(spec, out, simulator=simulator or FakeSimulator()).plots


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """Figures of a sweep over three parameters, by file name."""
    return {
        path.name: path
        for path in plots_of(SPEC | {"plots": True}, tmp_path_factory.mktemp("plots"))
    }


@pytest.mark.release
def test_three_parameters_give_a_heat_map_for_each_pair(grid):
    """PNG and SVG of each of the three pairs, and of the spine's gain; the PNG is a picture of some size."""
    assert set(grid) == {
        f"speed-{name}.{form}"
        for name in (
            "over-frequency-and-spine.amplitude",
            "over-frequency-and-spine.phase",
            "over-spine.amplitude-and-spine.phase",
            "gain-over-spine.amplitude-and-spine.phase",
            "against-roll_std",
        )
        for form in ("png", "svg")
    }
    picture = imread(grid["speed-over-spine.amplitude-and-spine.phase.png"])
    assert min(picture.shape[:2]) > 250  # tests draw at half the size
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 30  # not blank


@pytest.mark.release
def test_axes_carry_shown_units_and_panels_their_value(grid):
    """Angles in degrees, speeds in mm/s, and one panel for each frequency."""
    text = grid["speed-over-spine.amplitude-and-spine.phase.svg"].read_text()
    assert "spine amplitude [deg]" in text
    assert "spine phase [deg]" in text
    assert "speed [mm/s]" in text
    assert [f"frequency = {value:g} Hz" in text for value in FREQUENCIES] == [True] * 4
    assert f"star: best, {1000 * speed(1.1, 0.4, 0.0):.4g} mm/s" in text


def meshes(figure):
    return [
        c
        for ax in figure.axes
        for c in ax.collections
        if isinstance(c, QuadMesh) and ax.get_label() != "<colorbar>"
    ]


def points():
    f, a, p = (
        column.ravel() for column in np.meshgrid(FREQUENCIES, AMPLITUDES, PHASES, indexing="ij")
    )
    return f, shown("spine.amplitude", "rad", a), shown("spine.phase", "rad", p), speed(f, a, p)


def test_cells_show_the_tables_numbers_on_one_colour_scale():
    """Each cell is the metric at its place, each panel on the scale of all."""
    f, x, y, z = points()
    panels = [(f"{value}", f == value) for value in FREQUENCIES]
    figure = heat_maps(x, y, shown("speed", "m/s", z), panels, "t", "")
    cells = meshes(figure)
    assert len(cells) == 4
    for mesh, value in zip(cells, FREQUENCIES, strict=True):
        expected = 1000 * speed(value, np.array(AMPLITUDES)[None, :], np.array(PHASES)[:, None])
        np.testing.assert_allclose(np.asarray(mesh.get_array()), expected, rtol=1e-9)
        assert mesh.get_clim() == pytest.approx((1000 * z.min(), 1000 * z.max()))
        assert mesh.get_cmap().name in ("viridis", "cividis")


def test_the_best_point_of_all_is_marked_where_it_is():
    """A single star stands at the maximum; the other panels have a ring at theirs."""
    f, x, y, z = points()
    figure = heat_maps(
        x, y, shown("speed", "m/s", z), [(f"{v}", f == v) for v in FREQUENCIES], "t", ""
    )
    marks = [
        (tuple(c.get_offsets()[0]), len(c.get_paths()[0].vertices))
        for ax in figure.axes
        for c in ax.collections
        if isinstance(c, PathCollection) and len(c.get_offsets()) == 1
    ]
    assert [mark[0] for mark in marks] == [pytest.approx((np.degrees(0.4), 0.0))] * 4
    star = len(matplotlib.markers.MarkerStyle("*").get_path().vertices)
    assert [mark[1] == star for mark in marks] == [False, False, False, True]


def test_a_cell_without_a_good_run_stays_empty(tmp_path):
    """Fallen runs leave their cell blank instead of a colour, and do not stretch the scale."""
    f, x, y, z = points()
    z = np.where(z > 0.1, np.nan, z)
    mesh = meshes(heat_maps(x, y, shown("speed", "m/s", z), [("", f == 1.1)], "t", ""))[0]
    masked = np.ma.getmaskarray(mesh.get_array())
    assert masked.sum() == np.isnan(z[f == 1.1]).sum() > 0
    spec = {"vary": {"frequency": [0.5, 1.0], "stride": [0.5, 1.0]}}
    svg = next(
        path
        for path in plots_of(spec, tmp_path, FakeSimulator(falls_above=0.07))
        if path.suffix == ".svg"
    )
    assert "star: best, 50 mm/s" in svg.read_text()


def test_repeats_share_a_cell_as_their_mean():
    """Two runs at one place show as one cell with their mean."""
    x, y = (
        shown("a", "1", np.array([0, 0, 1, 1, 0, 1])),
        shown("b", "1", np.array([0, 0, 0, 0, 1, 1])),
    )
    z = shown("c", "1", np.array([1.0, 3.0, 5.0, 5.0, 7.0, np.nan]))
    mesh = meshes(heat_maps(x, y, z, [("", np.full(6, True))], "t", ""))[0]
    assert np.ma.filled(mesh.get_array(), -1).tolist() == [[2.0, 5.0], [7.0, -1.0]]


GAIN = "speed-gain-over-spine.amplitude-and-spine.phase"


def gain_figure(table):
    with matplotlib.rc_context(STYLE):
        return next(figure for name, figure in figures_of_results(Results(table)) if name == GAIN)


@pytest.mark.release
def test_gain_figure_shows_speed_relative_to_the_stiff_spine_in_percent(tmp_path):
    """Each panel is 100 (v / v at amplitude 0 - 1) of its own frequency; white is 0; marks carry their percentage."""
    vary = SPEC["vary"] | {"spine.phase": [-3.0, 0.0, 1.0]}
    result = run_sweep(SPEC | {"vary": vary}, tmp_path / "run", simulator=FakeSimulator())
    figure = gain_figure(result.table)
    expected = 50 * np.array(AMPLITUDES)[None, :] * np.cos(vary["spine.phase"])[:, None]
    cells = meshes(figure)
    assert len(cells) == 4
    for mesh in cells:
        np.testing.assert_allclose(np.asarray(mesh.get_array()), expected, atol=1e-4)
        assert mesh.get_clim() == pytest.approx((-20, 20), abs=1e-4)
        assert mesh.get_cmap()(0.5)[:3] == pytest.approx((1, 1, 1), abs=0.05)
    marks = [(note.xy, note.get_text()) for ax in figure.axes for note in ax.texts]
    assert marks == [(pytest.approx((np.degrees(0.4), 0.0)), "+20 %")] * 4
    assert [ax.get_title() for ax in figure.axes[:4]] == [
        f"frequency = {value:g} Hz" for value in FREQUENCIES
    ]
    svg = next(
        path
        for path in write_figures(figures_of_results(Results(result.table)), tmp_path)
        if path.name == f"{GAIN}.svg"
    ).read_text()
    for text in (
        "spine amplitude [deg]",
        "spine phase [deg]",
        "speed relative to the stiff spine [%]",
        "+20 %",
        "profile exact",
    ):
        assert text in svg


def test_gain_figure_agrees_with_the_summary(tmp_path):
    """With repeats that differ, the marked percentage is the best ratio that the summary reports."""
    spec = SPEC | {"randomize": {"repeats": 3, "contact.friction": {"uniform": [0.5, 1.5]}}}
    result = run_sweep(spec, tmp_path, simulator=FakeSimulator())
    best = [100 * (line["best"]["ratio"] - 1) for line in result.summary["spine_gain"]]
    marks = [note.get_text() for ax in gain_figure(result.table).axes for note in ax.texts]
    assert marks == [f"{value:+.1f}".removesuffix(".0") + " %" for value in best]


def test_a_spine_that_only_slows_down_marks_its_least_loss(tmp_path):
    """The stiff spine itself is never the mark; far losses do not take the scale from the gains."""
    vary = SPEC["vary"] | {"spine.phase": [2.5, 3.1]}
    figure = gain_figure(
        run_sweep(SPEC | {"vary": vary}, tmp_path, simulator=FakeSimulator()).table
    )
    assert {note.get_text() for ax in figure.axes for note in ax.texts} == {"−8 %"}
    values = shown("gain", "%", np.array([0.0, 0.0, 5.0, -80.0]))
    x, y = shown("a", "1", np.array([0, 0, 1, 1])), shown("b", "1", np.array([0, 1, 0, 1]))
    figure = heat_maps(x, y, values, [("", np.full(4, True))], "t", "", gain=x.values > 0)
    assert meshes(figure)[0].get_clim() == (-25, 25)


@pytest.mark.parametrize(
    "vary",
    [
        {"spine.amplitude": [0.1, 0.2], "spine.phase": [0.0, 1.0]},
        {"spine.amplitude": [0.0, 0.2], "frequency": [0.5, 1.0]},
        {"spine.amplitude": [0.0], "spine.phase": [0.0, 1.0], "frequency": [0.5, 1.0]},
    ],
)
def test_no_gain_figure_without_a_stiff_spine_to_compare_with(tmp_path, vary):
    """Amplitude and phase must both vary, and amplitude 0 be among the values."""
    result = run_sweep(SPEC | {"vary": vary}, tmp_path, simulator=FakeSimulator())
    assert GAIN not in [name for name, _ in figures_of_results(Results(result.table))]


@pytest.mark.release(
    cases=("change3-names3-texts3", "change5-names5-texts5", "change4-names4-texts4")
)
@pytest.mark.parametrize(
    ("change", "names", "texts"),
    [
        (
            {"vary": {"frequency": [0.5, 0.7, 0.9]}},
            ["speed-over-frequency"],
            ["frequency [Hz]", "speed [mm/s]", "profile exact"],
        ),
        (
            {"vary": {"frequency": [0.5, 0.7]}, "randomize": {"repeats": 3}},
            ["speed-over-frequency"],
            ["profile exact; mean of 3 repeats"],
        ),
        (
            {"vary": {"frequency": [0.5, 0.7], "duty": [0.5, 0.6]}},
            ["speed-over-frequency-and-duty"],
            ["duty"],
        ),
        (
            {
                "vary": {"frequency": {"uniform": [0.5, 1]}, "duty": {"uniform": [0.5, 0.6]}},
                "sample": {"sobol": 32},
            },
            ["speed-over-each", "speed-over-pairs"],
            ["32 runs"],
        ),
        (
            {"randomize": {"repeats": 40, "contact.friction": {"uniform": [1.0, 1.6]}}},
            ["speed-over-each", "speed-over-pairs"],
            ["contact friction"],
        ),
        (
            {
                "vary": {
                    name: {"linspace": [0.5, 0.6, 2]}
                    for name in ("frequency", "duty", "stride", "turning.leg")
                }
            },
            ["speed-over-frequency-and-duty", "speed-over-stride-and-turning.leg"],
            ["mean over"],
        ),
        ({"vary": {"frequency": [0.5]}}, [], []),
        ({"vary": {"frequency": [0.5, 0.7]}, "plots": False}, [], []),
    ],
)
def test_each_kind_of_sweep_gets_its_figures(tmp_path, change, names, texts):
    """Lines for one parameter, maps for a grid, scatters for a sample or for randomized parameters alone; or none."""
    paths = plots_of(change, tmp_path)
    assert bool(paths) == bool(names)
    assert [name for name in names if f"{name}.png" not in {path.name for path in paths}] == []
    if names:
        svg = next(path for path in paths if path.name == f"{names[0]}.svg").read_text()
        assert [text for text in texts if text not in svg] == []


def test_the_same_table_gives_the_same_files(tmp_path):
    """Figures are byte-equal when drawn again, and need nothing but the table."""
    result = run_sweep(
        {"vary": {"frequency": [0.5, 0.7, 0.9]}}, tmp_path / "a", simulator=FakeSimulator()
    )
    again = write_figures(figures_of_results(Results(result.table)), tmp_path / "b")
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in result.plots]


def test_a_few_wild_values_do_not_take_the_colours():
    """Of a hundred values and two far above them, colours tell the hundred apart; of even ones nothing is cut off."""
    even = np.linspace(1.0, 2.0, 100)
    for wild, ends, extend in (
        ([], (1.0, 2.0), "neither"),
        ([300.0, 454.0], (1.0, 1.97), "max"),
        ([-300.0, -454.0], (1.03, 2.0), "min"),
        ([2.4], (1.0, 2.4), "neither"),
    ):
        scale, cut = colour_scale(np.array([*even, *wild, np.nan]))
        assert (scale.vmin, scale.vmax) == pytest.approx(ends, abs=0.01)
        assert cut == extend
