# Tests of optimize/landscape.py
"""Landscapes: which points are measured, that the measures are right, and the files."""

import json

import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.tune_fake import SPEC, FakeProblem

from nermo_mjx.optimize import Evaluation, Tuning, landscape, run_landscape
from nermo_mjx.optimize.landscape import CENTRES, WIDTHS, line_figure, lines_of, points_along, rows_of, sentences
from nermo_mjx.runs.files import WrongDirectory
from nermo_mjx.runs.job import SILENT, Watch
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep import SpecError

TUNING = Tuning.from_dict(SPEC)
#: Height of a stair, and stairs over the bounds of the amplitude.
STAIR, STAIRS = 0.01, 50


class Staircase(FakeProblem):
    """The fake robot on stairs along the amplitude, which its gradient does not see; it falls where `falls` says."""

    def evaluate(self, points, gradient):
        found = super().evaluate(points, gradient)
        stairs = STAIR * np.floor(np.asarray(points)[:, 0] / 0.4 * STAIRS)
        return Evaluation(found.value + jnp.asarray(stairs), found.gradient, found.metrics, found.ok)


def measure(out, kind=FakeProblem, change=None, watch=SILENT, **of_problem):
    tuning = Tuning.from_dict(SPEC | (change or {}))
    problem = kind(tuning, **of_problem)
    return run_landscape(tuning, out, problem=problem, watch=watch), problem


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    return measure(tmp_path_factory.mktemp("landscape"))


@pytest.fixture(scope="module")
def rough(tmp_path_factory):
    return measure(tmp_path_factory.mktemp("landscape"), Staircase)[0]


def by_width(result, name):
    """Measures of a parameter, by the width's share."""
    return {width["share"]: width for width in result.content["parameters"][name]["widths"]}


# --- points


def test_lines_run_through_the_start_from_bound_to_bound():
    """41 points each, short of the bounds as a tuner's are; what does not change stands at the start."""
    wanted = points_along(TUNING)
    for i, (low, high, other) in enumerate(((0.0, 0.4, 2.5), (-np.pi, np.pi, 0.05))):
        line = (wanted["line"] == TUNING.names[i]) & (wanted["side"] == 0)
        x = wanted[TUNING.names[i]][line]
        assert len(x) == 41
        assert (np.diff(x) > 0).all()
        assert x[[0, -1]] == pytest.approx([low + 0.001 * (high - low), high - 0.001 * (high - low)], rel=1e-4)
        assert (wanted[TUNING.names[1 - i]][line] == other).all()
    assert len(wanted["line"]) == 2 * (41 + 2 * len(CENTRES) * len(WIDTHS))


def test_secants_lie_about_points_of_the_line():
    """Each pair's middle is its centre, its distance its width; nine of each width, spread over the line."""
    wanted = points_along(TUNING)
    for name, extent in zip(TUNING.names, (0.4, 2 * np.pi), strict=True):
        along, x = wanted["line"] == name, wanted[name]
        line = x[along & (wanted["side"] == 0)]
        for width in WIDTHS:
            low, high = (along & (wanted["width"] == width) & (wanted["side"] == side) for side in (-1, 1))
            assert low.sum() == high.sum() == len(CENTRES)
            ends = x[low], x[high]
            np.testing.assert_allclose(ends[1] - ends[0], width * extent)
            np.testing.assert_allclose((ends[0] + ends[1]) / 2, line[wanted["centre"][low]], atol=1e-12)
            assert np.ptp(ends[0]) > 0.8 * extent


# --- evaluations


def test_all_points_are_evaluated_by_one_program(smooth):
    """262 walks with gradients in five batches of one size: one compilation."""
    result, problem = smooth
    assert result.evaluated == result.table.num_rows == 262
    assert problem.batches == [(53, True)] * 5
    assert problem.compiled == 1
    sizes = {count: landscape.batch_size(count) for count in (1, 64, 65, 262)}
    assert sizes == {1: 1, 64: 64, 65: 33, 262: 53}, "as even as they can be"


def test_the_table_holds_every_point_with_units_and_roles(smooth):
    """Values, gradients by all parameters and metrics, at the points as they were rounded."""
    result, problem = smooth
    stored = pq.read_table(result.out / "landscape.parquet")
    assert stored.equals(result.table)
    frame = stored.to_pandas()
    points = jnp.asarray(frame[list(TUNING.names)].to_numpy(), jnp.float32)
    again = problem.evaluate(points, True)
    np.testing.assert_allclose(frame["objective"], again.value, rtol=1e-6)
    np.testing.assert_allclose(frame["gradient.spine.phase"], np.asarray(again.gradient)[:, 1], rtol=1e-5, atol=1e-7)
    assert (frame["spine.amplitude"].to_numpy() == np.float32(frame["spine.amplitude"])).all()
    about = {field.name: field.metadata for field in stored.schema}
    assert about["gradient.spine.phase"][b"unit"] == b"1/(rad)"
    assert about["speed"][b"role"] == b"metric"
    assert {"line", "centre", "width", "side", "ok", "roll_std"} <= set(about)


def test_an_interrupted_landscape_is_gone_on_with(tmp_path, smooth):
    """Stopped in its fourth batch of five, and one of three damaged, it evaluates three, and has the same table."""
    with pytest.raises(KeyboardInterrupt, match=r"stopped; 159 of 262 walks are kept in .*run the same command again"):
        measure(tmp_path, stop_at=3)
    damaged = part_files(tmp_path)[1]
    damaged.write_text("damaged")
    said = []
    result, problem = measure(tmp_path, watch=Watch(warn=said.append))
    assert [size for size, _ in problem.batches] == [53, 53, 53]
    assert result.evaluated == 262 - 106
    assert result.table.equals(smooth[0].table)
    assert said == [f"{damaged} is damaged; it is kept in results.aside, and its runs are made again."]


def test_points_once_found_are_kept(tmp_path, monkeypatch):
    """Drawing fails: the table is there, and the same call resumes from it, evaluating nothing."""
    monkeypatch.setattr("nermo_mjx.optimize.landscape.line_figure", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        measure(tmp_path)
    assert (tmp_path / "landscape.parquet").exists()
    monkeypatch.undo()
    assert not landscape.landscape_status(tmp_path).complete
    result, problem = measure(tmp_path)
    assert (result.evaluated, problem.batches, landscape.landscape_status(tmp_path).complete) == (0, [], True)
    assert len(result.plots) == 4
    other, problem = measure(tmp_path, change={"optimizer": "sgd", "seed": 5, "starts": 7})
    assert other.evaluated == 0, "how a tuner would go does not matter"


def test_a_directory_belongs_to_one_landscape(tmp_path):
    """Another walk needs another directory, also of an unfinished one; a damaged table, or a lost record, does not."""
    with pytest.raises(KeyboardInterrupt):
        measure(tmp_path, stop_at=3)
    other = {"set": {"frequency": 0.7}}
    another = r"holds another landscape, with another set\.frequency \(0\.8 there, 0\.7 here\); choose another"
    with pytest.raises(WrongDirectory, match=another):
        measure(tmp_path, change=other)
    table = measure(tmp_path)[0].table
    with pytest.raises(WrongDirectory, match=another):
        measure(tmp_path, change=other)
    (tmp_path / "landscape.parquet").write_text("damaged")
    (tmp_path / "run.json").unlink()
    again = measure(tmp_path)[0]
    assert again.evaluated == 0
    assert again.table.equals(table)


def test_a_wrong_file_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(SpecError):
        run_landscape({"tune": {}}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- measures


def test_on_a_smooth_landscape_slopes_and_secants_agree(smooth):
    """At all widths but the narrowest, where float32 rounds, the error is that of a difference quotient."""
    result, _ = smooth
    for name in TUNING.names:
        widths = by_width(result, name)
        assert [width["secants"] for width in widths.values()] == [len(CENTRES)] * len(WIDTHS)
        for share in (0.005, 0.02, 0.05, 0.1):
            assert widths[share]["median_relative_error"] < 0.02
            assert widths[share]["sign_agreement"] == 1.0
        assert result.content["parameters"][name]["follows"] is True
    amplitude = result.content["parameters"]["spine.amplitude"]
    assert (amplitude["unit"], amplitude["bounds"], amplitude["start"]) == ("rad", [0.0, 0.4], 0.05)


def test_error_and_signs_are_those_of_their_definition(smooth):
    """The median of |slope - secant| / |secant|, from the table's own numbers."""
    result, _ = smooth
    frame = result.table.to_pandas()
    own = frame[(frame["line"] == "spine.phase") & (frame["width"] == 0.1)]
    low, high = (own[own["side"] == side].sort_values("centre") for side in (-1, 1))
    secant = (high["objective"].to_numpy() - low["objective"].to_numpy()) / (
        high["spine.phase"].to_numpy() - low["spine.phase"].to_numpy()
    )
    line = frame[(frame["line"] == "spine.phase") & (frame["side"] == 0)].reset_index()
    slope = line["gradient.spine.phase"].to_numpy()[low["centre"].to_numpy()]
    measured = by_width(result, "spine.phase")[0.1]
    assert measured["median_relative_error"] == pytest.approx(np.median(np.abs(slope - secant) / np.abs(secant)))
    assert measured["sign_agreement"] == np.mean(np.sign(slope) == np.sign(secant))
    # A sine's difference quotient over a tenth of its period is short by sinc(0.1).
    assert measured["median_relative_error"] == pytest.approx(1 / np.sinc(0.1) - 1, rel=0.05)


def test_stairs_are_seen_where_they_are(rough):
    """Along the amplitude wide secants see the stairs' rise, and the slope does not; the phase is as before."""
    assert rough.content["parameters"]["spine.amplitude"]["follows"] is False
    lines = {line.tuned.name: line for line in lines_of(rough.tuning, rough.table)}
    stairs = lines["spine.amplitude"]
    rise = stairs.secants[:, WIDTHS.index(0.1)] - stairs.slope[list(CENTRES)]
    np.testing.assert_allclose(rise, STAIR * STAIRS / 0.4, atol=STAIR / (0.1 * 0.4))
    assert rough.content["parameters"]["spine.phase"]["follows"] is True


def test_points_that_fall_are_left_out_and_counted(tmp_path):
    """A secant with an end at which the robot falls does not count; the rest does."""
    result, _ = measure(tmp_path, falls=lambda points: points[:, 0] > 0.3)
    about = result.content["parameters"]["spine.amplitude"]
    frame = result.table.to_pandas()
    line = frame[(frame["line"] == "spine.amplitude") & (frame["side"] == 0)]
    assert about["fell"] == (line["spine.amplitude"] > 0.3).sum() > 5
    assert frame["objective"].isna().equals(~frame["ok"])
    for width in about["widths"]:
        assert 0 < width["secants"] < len(CENTRES)
    assert about["follows"] is True
    assert sentences(result.content)[0].endswith(f" At {about['fell']} of 41 points the robot fell.")


def test_where_nothing_walks_nothing_is_said(tmp_path):
    """No number is made of nothing, and no figure."""
    result, _ = measure(tmp_path, falls=lambda points: jnp.ones(len(points), bool))
    assert result.plots == ()
    about = json.loads((tmp_path / "landscape.json").read_text())["parameters"]["spine.phase"]
    assert (about["follows"], about["fell"], about["widths"][0]["median_relative_error"]) == (None, 41, None)
    assert "too few places where the robot walks" in sentences(result.content)[1]


# --- files


def test_json_and_table_say_the_same(smooth):
    """A row a width, a figure a parameter that exists, and what was run."""
    result, _ = smooth
    stored = json.loads((result.out / "landscape.json").read_text())
    assert stored["plots"] == [path.relative_to(result.out).as_posix() for path in result.plots]
    rows = rows_of(stored)
    assert [row[2] for row in rows].count("2 %") == 2
    assert "7.2 deg" in [row[1] for row in rows]
    assert all("exact gradients can be followed" in sentence for sentence in sentences(stored))
    for name in TUNING.names:
        assert (result.out / f"plots/line-{name}.png").stat().st_size > 10_000
    assert {"versions", "machine", "command"} <= set(stored)


def test_figures_have_a_tangent_at_each_point_and_a_bar_for_each_secant(smooth):
    """In shown units: a slope per degree, tangents along the objective."""
    result, _ = smooth
    line = lines_of(result.tuning, result.table)[1]
    figure = line_figure(result.tuning, line)
    assert any("profile exact" in text.get_text() for text in figure.texts)
    above, below = figure.axes
    tangents = [each for each in above.lines if len(each.get_xdata()) == 2 and each.get_linewidth() == 1.5]
    assert len(tangents) == 41
    rise = [np.ptp(each.get_ydata()) / np.ptp(each.get_xdata()) for each in tangents]
    np.testing.assert_allclose(rise, np.abs(np.radians(1.0) * line.slope), rtol=1e-6)
    exact = next(each for each in below.lines if len(each.get_xdata()) == 41)
    np.testing.assert_allclose(exact.get_ydata(), np.radians(1.0) * line.slope)
    bars = np.concatenate([each.get_segments() for each in below.collections])
    assert sorted({round(float(np.ptp(bar[:, 0])), 3) for bar in bars}) == [0.36, 1.8, 7.2, 18.0, 36.0]
    assert below.get_ylabel() == "slope [1/deg]"


def test_a_landscape_of_a_recording_can_be_moved(tmp_path):
    """The recording is copied, and named from where the landscape stands."""
    (tmp_path / "walk.npz").write_bytes(b"a walk")
    compared = {"objective": [{"minimize": "trajectory_error"}], "recording": str(tmp_path / "walk.npz")}
    measure(tmp_path / "here", change=compared)
    (tmp_path / "here").rename(tmp_path / "there")
    (tmp_path / "walk.npz").unlink()
    assert len(list(landscape.landscape_figures(tmp_path / "there"))) == 2
    own = Tuning.from_file(tmp_path / "there" / "landscape.yaml")
    assert run_landscape(own, tmp_path / "there", problem=FakeProblem(own)).evaluated == 0
