# Tests of optimize/tuning_figures.py, optimize/landscape.py
"""Pictures of a tuning: which figures there are, that they show the history's numbers, and the landscape."""

import shutil

import matplotlib
import numpy as np
import pytest
from fakes.tune_fake import SPEC, FakeProblem, FakeWalker, speed
from matplotlib.collections import PathCollection
from matplotlib.contour import QuadContourSet
from matplotlib.image import imread

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.optimize import tuning_figures as figures
from nermo_mjx.optimize.landscape import Landscape, grid_axes, landscape_sweep, simulate_landscape
from nermo_mjx.optimize.tuner import Tuner, initial_state
from nermo_mjx.optimize.tuning_figures import MOST_STARTS, Traces, path_figure
from nermo_mjx.optimize.tuning_history import TuningHistory
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.job import SILENT
from nermo_mjx.sweep import read_table

#: A start that walks over the bound of the circle.
ROUND = {
    "tune": SPEC["tune"]
    | {"spine.phase": {"bounds": [-3.14159, 3.14159], "start": 3.0, "periodic": True}},
    "starts": 1,
    "iterations": 20,
    "optimizer": {"name": "sgd", "learning_rate": 1.0},
}


def tune(out, change=None, walker=None, **of_problem):
    """Run `SPEC` with plots and changes on the fakes."""
    tuning = Tuning.from_dict(SPEC | {"plots": True} | (change or {}))
    return run_tuning(tuning, out, problem=FakeProblem(tuning, **of_problem), simulator=walker)


def traces_of(change=None, **of_problem):
    """The traces of a tuning that needs no directory."""
    tuning = Tuning.from_dict(SPEC | (change or {}))
    tuner, state = Tuner(tuning, FakeProblem(tuning, **of_problem)), initial_state(tuning)
    history = TuningHistory(tuning)
    for _ in range(tuning.iterations + 1):
        state, iterate = tuner.step(state)
        history = history.extend(iterate, 0.1, "a")
    return Traces(tuning, history.table())


@pytest.fixture(autouse=True)
def _style():
    with matplotlib.rc_context(STYLE):
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A tuning that is done but for its pictures."""
    return tune(tmp_path_factory.mktemp("tuning"), {"plots": False})


@pytest.fixture
def again(finished, tmp_path):
    """`again(walker, change)`: the same command on a copy of it, so that nothing but the pictures is left to do."""

    def run(walker=None, change=None):
        if not (tmp_path / "out").exists():
            shutil.copytree(finished.out, tmp_path / "out")
        return tune(tmp_path / "out", change, walker)

    return run


@pytest.fixture
def undrawn(monkeypatch):
    """No figures; the landscapes that they would have had."""
    landscapes = []
    monkeypatch.setattr(
        figures, "tuning_figures_of", lambda *arguments: landscapes.append(arguments[-1]) or []
    )
    return landscapes


@pytest.fixture(scope="module")
def drawn_starts(finished, tmp_path_factory):
    """A tuning with all figures, and what walked for them."""
    out, walker = tmp_path_factory.mktemp("tuning") / "out", FakeWalker()
    shutil.copytree(finished.out, out)
    return tune(out, walker=walker), walker


def texts(figure):
    """All that is written in a figure."""
    return " ".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


def lines(ax, length):
    """y values of the lines of so many points."""
    return [
        np.asarray(line.get_ydata(), float) for line in ax.lines if len(line.get_ydata()) == length
    ]


def stars(figure):
    """Places of the stars, one an axes that has one."""
    long = len(matplotlib.markers.MarkerStyle("*").get_path().vertices)
    return [
        tuple(c.get_offsets()[0])
        for ax in figure.axes
        for c in ax.collections
        if isinstance(c, PathCollection) and len(c.get_paths()[0].vertices) == long
    ]


# --- figures over the iterations


@pytest.mark.release
def test_a_tuning_leaves_its_figures(drawn_starts):
    """PNG and SVG of each, and no blank picture."""
    result, _ = drawn_starts
    names = [
        f"{name}.{form}"
        for name in ("objective", "parameters", "gradients", "path")
        for form in ("png", "svg")
    ]
    assert [path.name for path in result.plots] == names
    for path in result.plots[::2]:
        assert len(np.unique(imread(path)[..., 0])) > 30
    assert {path.name for path in (result.out / "plots").iterdir()} == set(names)
    assert result.notes == ()


def test_objective_and_metrics_of_each_start_are_drawn():
    """A line a start in shown units, the best so far as steps below, and the star where the best is."""
    traces = traces_of()
    figure = figures.objective_figure(traces)
    objective, speeds, rolls = figure.axes
    value = traces.column("objective")
    *starts, best = lines(objective, 7)
    np.testing.assert_allclose(np.stack(starts, axis=1), value)
    np.testing.assert_allclose(best, np.minimum.accumulate(value.min(axis=1)))
    np.testing.assert_allclose(np.stack(lines(speeds, 7), axis=1), 1e3 * traces.column("speed"))
    np.testing.assert_allclose(
        np.stack(lines(rolls, 7), axis=1), np.degrees(traces.column("roll_std"))
    )
    iteration, start = traces.best
    assert stars(figure)[0] == pytest.approx((iteration, value[iteration, start]))
    text = texts(figure)
    assert "profile exact" in text
    for word in (
        "speed [mm/s]",
        "roll, standard deviation [deg]",
        "start 0 (given)",
        "more is better",
    ):
        assert word in text
    assert f"star: best, {value.min():.4g} in iteration 6 of start {start}" in text
    figure_held = figures.objective_figure(
        traces_of({"objective": [{"hold": "speed", "at": 0.09, "scale": 0.01}]})
    ).axes[1]
    assert [90.0, 90.0] in [
        np.asarray(line.get_ydata(), float).tolist() for line in figure_held.lines
    ]


def test_falls_are_marked_and_never_drawn_as_values():
    """Where a robot fell there is a gap in its lines, and a cross."""
    change = {
        "tune": SPEC["tune"] | {"spine.amplitude": {"bounds": [0.0, 0.4], "start": 0.05}},
        "iterations": 4,
    }
    traces = traces_of(
        change | {"starts": 1, "optimizer": {"name": "sgd", "learning_rate": 3.0}},
        falls=lambda points: points[:, 0] > 0.06,
    )
    assert not traces.ok.all()
    figure = figures.objective_figure(traces)
    assert np.array_equal(np.isfinite(lines(figure.axes[0], 5)[0]), traces.ok[:, 0])
    assert np.array_equal(np.isfinite(lines(figure.axes[1], 5)[0]), traces.ok[:, 0])
    (crosses,) = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert np.asarray(crosses.get_xdata()).tolist() == np.flatnonzero(~traces.ok[:, 0]).tolist()


def test_one_wild_value_does_not_flatten_the_rest():
    """The axis leaves out what is far above, and says so; the given start stays in sight."""
    ax = matplotlib.figure.Figure().subplots()
    values = np.concatenate([np.linspace(3.0, 1.0, 30), [1e6]])[:, None]
    ax.plot(values)
    figures._limit_axis(ax, values)
    assert 3.0 < ax.get_ylim()[1] < 20.0
    assert "1 higher" in [text.get_text() for text in ax.texts]


def test_parameters_are_in_shown_units_with_their_bounds():
    """Degrees, dashed bounds, and a periodic parameter that goes on beyond them."""
    traces = traces_of(ROUND)
    figure = figures.parameters_figure(traces)
    amplitude, phase = figure.axes
    np.testing.assert_allclose(
        lines(amplitude, 21)[0], np.degrees(traces.column("spine.amplitude")[:, 0])
    )
    bounds = [line.get_ydata()[0] for line in amplitude.lines if line.get_linestyle() == "--"]
    assert bounds == pytest.approx([0.0, np.degrees(0.4)])
    walked = lines(phase, 21)[0]
    assert np.abs(np.diff(walked)).max() < 90
    degrees = np.degrees(traces.column("spine.phase")[:, 0])
    np.testing.assert_allclose(np.cos(np.radians(walked)), np.cos(np.radians(degrees)), atol=1e-5)
    assert "spine phase\n[deg]" in texts(figure)
    assert "-180 to 180, periodic" in texts(figure)


def test_gradients_are_per_range():
    """The norm counts each component per whole range."""
    traces = traces_of()
    parts = [
        traces.column("gradient.spine.amplitude") * 0.4,
        traces.column("gradient.spine.phase") * 2 * np.pi,
    ]
    np.testing.assert_allclose(traces.gradient_norm(), np.hypot(*parts), rtol=1e-6)
    figure = figures.gradients_figure(traces)
    assert len(figure.axes) == 1
    assert figure.axes[0].get_yscale() == "log"


def test_many_starts_are_thinned_and_the_best_is_among_them():
    """No picture draws a hundred starts; the given and the best one have names of their own."""
    traces = traces_of({"starts": 100, "iterations": 1})
    assert len(traces.drawn_starts()) <= MOST_STARTS
    assert {0, traces.best[1]} <= set(traces.drawn_starts())
    text = texts(figures.objective_figure(traces))
    assert f"start {traces.best[1]} (best)" in text
    assert f"100 starts ({len(traces.drawn_starts())} of them drawn)" in text


# --- the landscape behind the paths


def walked(tuning, out, walker):
    """The landscape of a tuning whose best point does not matter."""
    return simulate_landscape(tuning, {}, out, lambda: walker, SILENT)


@pytest.mark.release
def test_the_landscape_is_a_sweep_of_the_grid(drawn_starts):
    """17 x 16 walks of both parameters, the circle's end being its beginning; values are the objective's."""
    result, _ = drawn_starts
    table = read_table(next((result.out / "landscape").iterdir()))
    amplitude, phase = (table.column(name).to_numpy() for name in result.tuning.names)
    np.testing.assert_allclose([amplitude.min(), amplitude.max()], [0.0004, 0.3996])
    np.testing.assert_allclose([phase.min(), phase.max()], [-np.pi, np.pi * 7 / 8], rtol=1e-6)
    landscape = walked(result.tuning, result.out, None)
    expected = -np.asarray(speed(amplitude, phase)) / 0.1 + 2 * (0.1 + 0.1 * amplitude**2)
    np.testing.assert_allclose(landscape.value[:, :-1].ravel(), expected, rtol=1e-5)
    np.testing.assert_array_equal(landscape.value[:, 0], landscape.value[:, -1])
    assert landscape.walks == "272 walks, engine c"


def test_a_stored_landscape_is_simulated_again_only_for_another_walk(again, undrawn):
    """The path over the landscape does not matter; the walk, and the values of other parameters do."""
    walker = FakeWalker()
    again(walker)
    before = len(walker.batches)
    again(walker)
    assert len(walker.batches) == before
    np.testing.assert_array_equal(undrawn[0].value, undrawn[1].value)

    def digest(change, best=None):
        return landscape_sweep(Tuning.from_dict(SPEC | change), best or {}).digest()

    assert digest({}) == digest({"optimizer": "sgd", "seed": 9, "starts": 3})
    assert digest({}) != digest({"set": {"frequency": 0.7}})
    three = {"tune": SPEC["tune"] | {"duty": {"bounds": [0.4, 0.7], "start": 0.5}}}
    assert digest(three, {"duty": 0.6}) != digest(three, {"duty": 0.5})


def test_one_parameter_has_a_line_for_a_landscape(tmp_path):
    """The objective over the only parameter, with the points that were visited on it."""
    traces = traces_of({"tune": {"spine.amplitude": SPEC["tune"]["spine.amplitude"]}})
    landscape = walked(traces.tuning, tmp_path, FakeWalker())
    assert landscape.value.shape == (37,)
    assert landscape.axes["spine.amplitude"][np.argmin(landscape.value)] == pytest.approx(
        2.5 / 10.4, abs=0.02
    )
    (ax,) = path_figure(traces, landscape).axes
    np.testing.assert_allclose(ax.lines[0].get_ydata(), landscape.value)
    visited = np.stack(
        [c.get_offsets() for c in ax.collections if len(c.get_offsets()) == 7], axis=1
    )
    np.testing.assert_allclose(visited[:, :, 0], np.degrees(traces.column("spine.amplitude")))
    np.testing.assert_allclose(visited[:, :, 1], traces.column("objective"))


def test_where_a_walk_falls_the_landscape_is_empty(tmp_path):
    """Fallen walks are NaN, and leave a hole in the contours."""
    traces, walker = traces_of(), FakeWalker(falls=lambda values: values["spine.amplitude"] > 0.3)
    landscape = walked(traces.tuning, tmp_path / "some", walker)
    fell = landscape.axes["spine.amplitude"] > 0.3
    assert (np.isnan(landscape.value) == fell[:, None]).all()
    ax = path_figure(traces, landscape).axes[0]
    filled = next(c for c in ax.collections if isinstance(c, QuadContourSet))
    assert max(
        path.vertices[:, 0].max() for path in filled.get_paths() if len(path.vertices)
    ) < np.degrees(0.31)
    nothing = walked(traces.tuning, tmp_path / "none", FakeWalker(falls=lambda values: True))
    path_figure(traces, nothing)


def test_a_landscape_that_cannot_be_walked_is_a_note(again, undrawn):
    """A corner of the bounds past the legs' workspace costs the landscape, and nothing else."""
    result = again(FakeWalker(error=ParameterError("stride is 1.5: the legs cannot reach so far.")))
    first, note = result.notes
    assert first.startswith("Start and best are not verified: stride is 1.5")
    assert note.startswith("There is no landscape behind the paths, ")
    assert note.endswith("stride is 1.5: the legs cannot reach so far.")
    assert undrawn == [None]


def test_paths_lie_on_the_landscape_and_go_on_at_the_other_side():
    """Contours of the grid's values; a start that walks over the bound of the circle is drawn on both sides of it."""
    traces = traces_of(ROUND)
    assert np.ptp(traces.column("spine.phase")) > 5.0, "it comes back at the other bound"
    axes = grid_axes(traces.tuning)
    value = -np.asarray(speed(axes["spine.amplitude"][:, None], axes["spine.phase"][None]))
    figure = path_figure(traces, Landscape(axes, value, "289 walks, engine c"))
    ax = figure.axes[0]
    assert ax.get_ylim() == pytest.approx((-180, 180), abs=1e-3)
    filled = next(c for c in ax.collections if isinstance(c, QuadContourSet))
    assert filled.levels[0] == pytest.approx(value.min())
    whole = lines(ax, 21)
    assert len(whole) == 2, "one path on each side"
    assert np.abs(whole[0] - whole[1]) == pytest.approx(np.full(21, 360.0))
    best = np.degrees([traces.column(name)[traces.best] for name in traces.tuning.names])
    assert stars(figure)[0] == pytest.approx(tuple(best), abs=1e-3)
    assert "profile exact; landscape: 289 walks, engine c" in texts(figure)
    assert "profile exact; colour: objective" in texts(path_figure(traces))


# --- what is made, and what is not


def test_what_is_not_asked_for_or_not_real_is_not_made(again, undrawn):
    """Without plots nothing is drawn and walked; a stand-in problem alone has no landscape."""
    walker = FakeWalker()
    result = again(walker, {"plots": False})
    assert (result.plots, walker.batches) == ((), [])
    assert not (result.out / "plots").exists()
    result = again()
    assert undrawn == [None]
    assert not (result.out / "landscape").exists()
