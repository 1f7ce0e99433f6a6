# Tests of plotting/charts.py, plotting/shown.py, plotting/style.py, sweep/plots.py
"""Figures over all variants of a sweep, Pareto fronts and parallel coordinates, and figures of chosen columns."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from scipy import stats

from nermo_mjx.plotting.charts import CROWD_POINTS, named_points, pareto_front, scatters
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.shown import ShownValues, spoken
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.robot import ParameterError
from nermo_mjx.sweep import Results
from nermo_mjx.sweep.plots import (
    BEST_LINES,
    MOST_LINES,
    chosen_figure,
    chosen_lines,
    figures_of_results,
    points_of,
    survey_figures,
)
from nermo_mjx.sweep.table import Columns

PARAMETERS = {
    "frequency": ("Hz", 0.4, 1.2),
    "spine.phase": ("rad", -3.0, 3.0),
    "contact.friction": ("1", 0.5, 2.0),
}


def table(
    rows: int = 200, parameters: dict = PARAMETERS, sampler: str = "sobol", repeats: int = 1
) -> pa.Table:
    """A sampled sweep in closed form; some runs fell."""
    random, columns = np.random.default_rng(0), Columns()
    variants = rows // repeats
    columns.add("row", np.arange(rows), "index", "1", "")
    columns.add("variant", np.repeat(np.arange(variants), repeats), "index", "1", "")
    columns.add("repeat", np.tile(np.arange(repeats), variants), "index", "1", "")
    values = {}
    for name, (unit, low, high) in parameters.items():
        values[name] = np.repeat(random.uniform(low, high, variants), repeats)
        columns.add(name, values[name], "varied", unit, "", scale="linear")
    noise = random.normal(0, 0.002, rows)
    columns.add("speed", 0.1 * values["frequency"] + noise, "metric", "m/s", "")
    columns.add(
        "roll_std",
        0.05 + 0.1 * values["frequency"] + random.normal(0, 0.03, rows),
        "metric",
        "rad",
        "",
    )
    columns.add("slip", random.uniform(0, 0.1, rows), "metric", "m/s", "")
    columns.add("duration", random.uniform(5, 9, rows), "metric", "s", "")
    columns.add("status", np.where(np.arange(rows) % 17 == 3, "fell", "ok"), "status", "1", "")
    return columns.table({"sampler": sampler})


def texts(figure: matplotlib.figure.Figure) -> str:
    return " ".join(
        text.get_text().replace("\n", " ") for text in figure.findobj(matplotlib.text.Text)
    )


# --- the front


def beaten(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether some other point beats each, by comparing all pairs."""
    better = (
        (x[None] <= x[:, None])
        & (y[None] <= y[:, None])
        & ((x[None] < x[:, None]) | (y[None] < y[:, None]))
    )
    return better.any(axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_nothing_beats_a_point_of_the_front_and_all_else_is_beaten(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, y = random.integers(0, 40, (2, 300)).astype(float)
    best = pareto_front(x, y)
    is_beaten = beaten(x, y)
    assert not is_beaten[best].any()
    on_it = {(x[i], y[i]) for i in best}
    assert {(x[i], y[i]) for i in np.flatnonzero(~is_beaten)} == on_it
    assert len(on_it) == len(best), "points that are best in both count once"
    assert (np.diff(x[best]) > 0).all()
    assert (np.diff(y[best]) < 0).all()
    assert pareto_front(np.append(x, np.nan), np.append(y, 0.0)).tolist() == best.tolist()
    assert pareto_front(x[:0], y[:0]).tolist() == []


def test_named_points_are_both_ends_and_some_between() -> None:
    x = np.linspace(0, 1, 50)
    assert named_points(x, 1 - x).tolist() == [0, 12, 24, 37, 49]
    assert named_points(x[:3], x[:3]).tolist() == [0, 1, 2]


def figures(data: pa.Table, metric: str = "speed") -> dict[str, matplotlib.figure.Figure]:
    with matplotlib.rc_context(STYLE):
        return dict(survey_figures(Results(data), metric))


def test_the_front_names_its_best_points_with_their_parameters() -> None:
    """The fastest is named with its own parameters in shown units; runs that fell are not drawn."""
    data = table()
    figure = figures(data)["speed-against-roll_std"]
    well = np.array(data.column("status").to_pylist()) == "ok"
    speed, roll = (data.column(name).to_numpy() for name in ("speed", "roll_std"))
    (ax,) = [ax for ax in figure.axes if ax.get_xlabel()]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("speed [mm/s]", "roll, standard deviation [deg]")
    points, best = [c for c in ax.collections if isinstance(c, PathCollection)]
    np.testing.assert_allclose(np.sort(points.get_offsets()[:, 0]), np.sort(1e3 * speed[well]))
    is_beaten = beaten(-speed[well], roll[well])
    np.testing.assert_allclose(
        np.sort(best.get_offsets()[:, 0]), np.sort(1e3 * speed[well][~is_beaten])
    )
    fastest = int(np.argmax(np.where(well, speed, -1)))
    text = texts(figure)
    assert (
        f"A   speed {1e3 * speed[fastest]:.4g} mm/s, roll, standard deviation {np.degrees(roll[fastest]):.4g} deg"
        in text
    )
    assert f"frequency {data.column('frequency')[fastest].as_py():.4g} Hz" in text
    assert f"{well.sum()} runs" in text


def test_repeats_are_one_point_at_their_mean() -> None:
    """A variant is the mean of those of its runs that went well."""
    data = table(rows=120, repeats=3)
    points = points_of(Results(data), ["speed"])
    well = np.array(data.column("status").to_pylist()) == "ok"
    speed = np.where(well, data.column("speed").to_numpy(), np.nan).reshape(-1, 3)
    np.testing.assert_allclose(points.metrics["speed"].values, 1e3 * np.nanmean(speed, axis=1))
    assert points.what == "40 variants, each the mean of its runs"
    frequency = data.column("frequency").to_numpy()[::3]
    np.testing.assert_allclose(
        points.of(["frequency"], np.array([4, 7]))[0].values, frequency[[4, 7]]
    )


# --- parallel coordinates


def test_each_line_goes_through_its_variants_values() -> None:
    """Heights are shares of each axis' range; the best few are drawn again, thick; names have units."""
    data = table()
    figure = figures(data)["speed-parallel"]
    ax = figure.axes[0]
    other_lines, _, best = [c for c in ax.collections if isinstance(c, LineCollection)]
    well = np.array(data.column("status").to_pylist()) == "ok"
    columns = [data.column(name).to_numpy()[well] for name in (*PARAMETERS, "speed")]
    shares = np.stack([(c - c.min()) / np.ptp(c) for c in columns], axis=-1)
    order = np.argsort(columns[-1])
    values_of_lines = np.array([path.vertices[:, 1] for path in other_lines.get_paths()])
    np.testing.assert_allclose(values_of_lines, shares[order][:-BEST_LINES], atol=1e-9)
    thick = np.array([path.vertices[:, 1] for path in best.get_paths()])
    np.testing.assert_allclose(thick, shares[order][-BEST_LINES:], atol=1e-9)
    labels = [label.get_text().replace("\n", " ") for label in ax.get_xticklabels()]
    assert labels == ["frequency [Hz]", "spine phase [deg]", "contact friction [1]", "speed [mm/s]"]


def test_too_many_lines_are_chosen_evenly_and_nothing_is_dropped_silently() -> None:
    costs = np.random.default_rng(1).normal(size=50_000)
    costs[::7] = np.nan
    indices = chosen_lines(costs)
    assert len(indices) == MOST_LINES + BEST_LINES == len(np.unique(indices))
    assert np.isfinite(costs[indices]).all()
    assert (
        indices[-BEST_LINES:].tolist()
        == np.argsort(np.where(np.isnan(costs), 9, costs))[BEST_LINES - 1 :: -1].tolist()
    )
    assert np.median(costs[indices]) == pytest.approx(np.nanmedian(costs), abs=0.01)
    text = texts(figures(table(3000))["speed-parallel"])
    assert "800 of 2,823 runs, evenly by rank, and the best 5" in text


def test_a_hundred_thousand_rows_are_drawn_as_a_sample_in_small_files(tmp_path: Path) -> None:
    data = table(100_000)
    with matplotlib.rc_context(STYLE):
        figures = list(survey_figures(Results(data), "speed"))
        for _, figure in figures:
            figure.savefig(tmp_path / "a.svg")
            assert (tmp_path / "a.svg").stat().st_size < 3e6
    assert "20,000 of 94,117 runs, and the whole front" in texts(
        dict(figures)["speed-against-roll_std"]
    )


def test_one_parameter_has_no_survey() -> None:
    assert figures(table(parameters={"frequency": PARAMETERS["frequency"]})) == {}


# --- chosen columns


@pytest.mark.parametrize(
    ("choice", "name"),
    [
        ({"x": "speed", "y": "roll_std"}, "speed-against-roll_std"),
        ({"x": "speed", "y": "slip"}, "speed-against-slip"),
        ({"x": "frequency"}, "speed-over-frequency"),
        ({"x": "frequency", "y": "slip"}, "slip-over-frequency"),
        ({"x": "frequency", "y": "spine.phase"}, "speed-over-frequency-and-spine.phase"),
        ({"x": "speed", "y": "slip", "color": "frequency"}, "frequency-over-speed-and-slip"),
    ],
)
def test_columns_of_choice_give_their_figure(choice: dict, name: str, tmp_path: Path) -> None:
    files = write_figures(chosen_figure(Results(table()), **choice), tmp_path)
    assert [file.name for file in files] == [f"{name}.png", f"{name}.svg"]
    svg = files[1].read_text()
    for column in choice.values():
        assert f"{spoken(column)} [" in svg


def test_two_parameters_of_a_grid_give_a_heat_map_whose_star_is_the_best(tmp_path: Path) -> None:
    columns = Columns()
    x, y = (axis.ravel() for axis in np.meshgrid([0.4, 0.8, 1.2], [0.5, 1.0]))
    for name in ("row", "variant"):
        columns.add(name, np.arange(6), "index", "1", "")
    columns.add("repeat", np.zeros(6, int), "index", "1", "")
    columns.add("frequency", x, "varied", "Hz", "", scale="linear")
    columns.add("stride", y, "varied", "1", "", scale="linear")
    columns.add("speed", 0.1 * x * y, "metric", "m/s", "")
    columns.add("slip", 0.02 + 0.01 * x * y, "metric", "m/s", "")
    columns.add("status", np.full(6, "ok"), "status", "1", "")
    results = Results(columns.table({"sampler": "grid"}))
    svg = write_figures(chosen_figure(results, "frequency", "stride", "slip"), tmp_path)[
        1
    ].read_text()
    assert "star: best, 22 mm/s" in svg
    svg = write_figures(chosen_figure(results, "frequency", "stride"), tmp_path)[1].read_text()
    assert "star: best, 120 mm/s" in svg


def test_a_column_that_is_none_is_refused_with_the_nearest() -> None:
    with pytest.raises(
        ParameterError, match=r"y is 'rol_std', no column of the table; did you mean 'roll_std'\?"
    ):
        chosen_figure(Results(table()), "speed", "rol_std")
    fallen = table().filter(pa.compute.equal(table().column("status"), "fell"))
    with pytest.raises(ParameterError, match="no run in the table succeeded"):
        chosen_figure(Results(fallen), "speed", "slip")


@pytest.mark.parametrize(("count", "crowd"), [(CROWD_POINTS - 1, False), (CROWD_POINTS, True)])
def test_a_crowd_of_points_is_drawn_as_density_and_its_note_says_so(
    count: int, crowd: bool
) -> None:
    """Tens of thousands of dots would be one solid block."""
    values = np.random.default_rng(0)
    x = ShownValues("stiffness.ankle", "N m/rad", 10.0 ** values.uniform(-2, 0, count), log=True)
    z = ShownValues("speed", "mm/s", values.normal(80.0, 10.0, count))
    figure = scatters([x], z, [""], "Speed", "some runs")
    hexagons = figure.axes[0].collections[0]
    assert isinstance(hexagons, PolyCollection) is crowd
    notes = [text.get_text() for text in figure.texts]
    assert any("darker: more runs" in note for note in notes) is crowd
    if crowd:
        assert hexagons.get_array().sum() == count, "each point is in one hexagon"


def test_less_is_better_where_it_is() -> None:
    """The best lines of a metric to be small are the lowest."""
    data = table()
    text = texts(figures(data, "slip")["slip-parallel"])
    well = np.array(data.column("status").to_pylist()) == "ok"
    assert (
        f"of which the first is {1e3 * data.column('slip').to_numpy()[well].min():.4g} mm/s" in text
    )
    assert "highest" in texts(figures(data, "duration")["duration-parallel"])


@pytest.mark.release
def test_a_scatter_of_too_many_points_is_thinned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The note says how many of all are drawn; correlations and the star still count all of them."""
    monkeypatch.setattr("nermo_mjx.sweep.plots.MAX_SCATTER_POINTS", 20)
    data = table(1000)
    well = np.array(data.column("status").to_pylist()) == "ok"
    speed, frequency = (data.column(name).to_numpy()[well] for name in ("speed", "frequency"))
    svg = {
        file.name: file.read_text()
        for file in write_figures(figures_of_results(Results(data)), tmp_path, formats=["svg"])
    }
    assert f"star: best, {1e3 * speed.max():.4g} mm/s" in svg["speed-over-pairs.svg"]
    for name in ("speed-over-each.svg", "speed-over-pairs.svg"):
        assert "20 of 941 runs" in svg[name]
    assert (
        f"rank correlation {stats.spearmanr(frequency, speed).statistic:+.2f}"
        in svg["speed-over-each.svg"]
    )
