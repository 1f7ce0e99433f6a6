# Tests of experiments/plots.py
"""The pictures of the experiments: what they show of made-up outcomes, in which units, beside what was published."""

import dataclasses
import functools
import itertools
import re

import matplotlib
import numpy as np
import pytest
from fakes.experiment_fake import BOTH, made_up
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.image import imread

from nermo_mjx.experiments import plots, walks
from nermo_mjx.experiments.cases import CaseRuns, texts
from nermo_mjx.experiments.published import Figure, Line, published_figures, published_lines
from nermo_mjx.experiments.run import EXPERIMENTS as CATALOGUE
from nermo_mjx.plotting.files import lay_out, write_figures
from nermo_mjx.plotting.style import STYLE
from nermo_mjx.recording import Recording
from nermo_mjx.robot import LIMBS

PHASES = {"stand": [0.0, 1.0], "shift": [1.0, 2.0], "lift": [2.0, 3.0], "swing": [3.0, 6.0]}
EXPERIMENTS = ("straight-line", "turning", "balance", "maze")
UNIT = re.compile(r"\[(deg|mm|mm/s|N|s|Hz|1)\]$")


def recorded(duration, labels, *, roll=0.0, position=None, **sensors):
    """A recording that rolls with this amplitude [rad], once a second."""
    time = np.arange(0.01, duration, 0.01)
    half = 0.5 * roll * np.sin(2 * np.pi * time)
    zero = np.zeros_like(time)
    place = np.zeros((len(time), 3)) if position is None else position(time)
    sensors |= {
        "orientation": np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1),
        "position": place,
    }
    return Recording(time, zero[:, None], zero[:, None], zero[:, None], sensors, metadata=labels)


SWAY = {
    f"{angle}_{what}": 0.1 for angle in ("roll", "pitch", "yaw") for what in ("mean", "std", "max")
}
SWAY |= {f"{angle}_min": -0.1 for angle in ("roll", "pitch", "yaw")}


def walked(profiles=BOTH, repeats=2, quick=False, **changed):
    runs = {}
    for spine in (False, True):
        labels = {"profile": profiles[0], "gait": "trot", "frequency": 1.0, "spine": spine}
        runs[f"spine {spine}"] = recorded(5.02, {"labels": labels}, roll=np.radians(6.0 + spine))
    measured = (
        SWAY
        | {"speed": lambda row: 0.08 + 0.01 * row["repeat"], "theory_speed": 0.1, "status": "ok"}
        | changed
    )
    cases = [case.labels for case in walks.line_cases(quick) if "exact" in case.profiles]
    return made_up("straight-line", cases, measured, profiles, repeats, runs)


def turned(profiles=BOTH, repeats=2, quick=False, **changed):
    def arc(time):
        angle = time / time[-1] * 1.1 * np.pi / 2
        return np.stack([0.5 - 0.5 * np.cos(angle), -0.5 * np.sin(angle), 0 * time], axis=-1)

    labels = {
        "profile": profiles[0],
        "gait": "trot",
        "frequency": 0.67,
        "radius": 0.5,
        "side": "left",
    }
    runs = {
        name: recorded(10.0, {"labels": labels | {"strategy": name}}, position=arc)
        for name in walks.STRATEGIES
    }
    measured = {
        "speed": 0.05,
        "time": 12.0,
        "followed": lambda row: row["strategy"] != "spine",
        "status": "ok",
        "turning_radius": lambda row: 0.15 if row["radius"] == 0 else np.nan,
        "theory_radius": lambda row: 0.14 if row["radius"] == 0 else np.nan,
    }
    cases = [case.labels for case in walks.turn_cases(quick) if "exact" in case.profiles]
    return made_up("turning", cases, measured | changed, profiles, repeats, runs)


def balanced(profiles=BOTH, repeats=2, quick=False, **changed):
    cases = [{"leg": leg, "sbc": sbc} for leg in LIMBS for sbc in (False, True)]
    runs = {}
    for case in cases:
        data = {"metrics": {"profile": profiles[0], **case}, "phases": PHASES}
        time = np.arange(0.01, 6.0, 0.01)
        shown = {
            "pitch": 0.01 * time,
            "com_margin": 0.005 - 0.001 * time,
            "foot_force": np.ones((len(time), 4)),
        }
        runs[f"{case}"] = recorded(6.0, data, **shown)
    measured = dict.fromkeys(texts("columns")["balance"].keys() - cases[0].keys(), 0.5) | {
        "passed": True
    }
    return made_up("balance", cases, measured | changed, profiles, repeats, runs)


def mazed(profiles=BOTH, repeats=2, quick=False, **changed):
    def ahead(time):
        return np.stack([0.1 * time, -0.1 * time, 0 * time], axis=-1)

    runs = {}
    for profile, spine in itertools.product(profiles, (False, True)):
        runs[f"{profile} {spine}"] = recorded(
            30.0, {"labels": {"profile": profile, "spine": spine}}, position=ahead
        )
    measured = SWAY | {"time": 25.0, "mean_speed": 0.06, "status": "ok"}
    cases = [case.labels for case in walks.maze_cases() if "exact" in case.profiles]
    return made_up("maze", cases, measured | changed, profiles, repeats, runs)


MADE = {"straight-line": walked, "turning": turned, "balance": balanced, "maze": mazed}


def line(experiment: str, figure: Figure, **measured) -> Line:
    """A line of the report with a made-up measurement."""
    nothing = CaseRuns(experiment, {"profile": np.array(["none"]), "repeat": np.array([0])}, {}, {})
    return dataclasses.replace(published_lines(nothing, None, [figure])[0], **measured)


def lines_of(experiment, exact=None):
    """The report's lines with what was published, and the same made-up measurement in each."""
    return [line(experiment, figure, exact=exact) for figure in published_figures(experiment)]


def pictures(outcome, lines):
    """The figures by the names of their pictures, in the house's style and laid out as in files."""
    with matplotlib.rc_context(STYLE):
        drawn = {
            name.removeprefix(f"{outcome.experiment}-"): figure
            for name, figure in plots.figures_of_experiment(outcome, lines)
        }
        for figure in drawn.values():
            lay_out(figure)
    return drawn


def figures_of(outcome, **lines):
    return pictures(outcome, lines_of(outcome.experiment, **lines))


@functools.cache
def whole(experiment):
    """The figures of an experiment with all its cases, both profiles and a report; drawn once for many tests."""
    return figures_of(MADE[experiment](), exact=1.0)


def marks(ax, gid):
    """(x, y) of the marks of a kind."""
    scattered = [
        tuple(c.get_offsets()[0])
        for c in ax.collections
        if isinstance(c, PathCollection) and c.get_gid() == gid
    ]
    return scattered + [
        (line.get_xdata()[0], line.get_ydata()[0]) for line in ax.lines if line.get_gid() == gid
    ]


def bars(ax):
    """(centre, height) of the bars."""
    return [(patch.get_x() + patch.get_width() / 2, patch.get_height()) for patch in ax.patches]


def entries(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("experiment", ["turning", "maze"])
def test_each_picture_is_a_png_and_an_svg(experiment, tmp_path):
    """Both files of each, named after the experiment, and nothing else; the PNG is not blank.

    Files of the straight line are in test_plot_command.py, and those of the balance in a notebook.
    """
    outcome = MADE[experiment](quick=True)
    files = write_figures(
        plots.figures_of_experiment(outcome, lines_of(experiment, exact=1.0)), tmp_path / "plots"
    )
    assert {path.suffix for path in files} == {".png", ".svg"}
    assert sorted(files) == sorted((tmp_path / "plots").iterdir())
    assert all(path.name.startswith(f"{experiment}-") for path in files)
    assert len({path.stem for path in files}) == len(files) / 2 >= 4
    picture = imread(files[0])
    assert min(picture.shape[:2]) > 250  # tests draw at half the size
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 30


@pytest.mark.release
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_one_profile_is_enough(experiment):
    """With `exact` alone, the same pictures are drawn, and no legend speaks of profiles."""
    alone = figures_of(MADE[experiment](profiles=BOTH[1:], repeats=1))
    assert set(alone) >= set(whole(experiment)) - {"report"}
    assert all(
        "as published" not in entries(figure) for name, figure in alone.items() if name != "report"
    )


@pytest.mark.release
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_a_picture_of_nothing_is_not_drawn(experiment):
    """Without recordings and lines, what needs them is left out, and the rest is drawn."""
    bare = pictures(dataclasses.replace(MADE[experiment](), recordings={}), [])
    left_out = {
        "straight-line": {"orientation"},
        "turning": {"paths"},
        "balance": {"pitch", "stability", "forces"},
        "maze": {"ways", "sway"},
    }
    assert set(whole(experiment)) - set(bare) == left_out[experiment] | {"report"}


def test_a_single_case_is_drawn():
    """One trot, and nothing else of the straight line, gives its speed and no picture over the stride."""
    only = walked()
    keep = only.where(gait="trot", frequency=0.5, spine=False)
    drawn = figures_of(
        dataclasses.replace(only, columns={k: v[keep] for k, v in only.columns.items()})
    )
    assert "speed" in drawn
    assert not {"speed-over-stride", "offset-compensation"} & set(drawn)


@pytest.mark.release
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_axes_carry_their_units(experiment):
    """Every axis with a scale says its unit: degrees, mm, mm/s, N, s, Hz, or 1 for a pure number."""
    for name, figure in whole(experiment).items():
        if name == "verdicts":
            continue
        for ax in figure.axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or label == "spine" or UNIT.search(label), f"{name}: {label}"
        assert any(UNIT.search(ax.get_ylabel() or ax.get_xlabel()) for ax in figure.axes), name


def test_published_numbers_come_from_the_report():
    """Every name by which a picture looks for a published number is a figure of the report."""
    used = {
        "straight-line": [
            plots.SPEED,
            plots.GAIN,
            plots.OVER_LATERAL,
            plots.LARGEST_ROLL,
            *plots.COMPENSATION.values(),
        ],
        "turning": [*plots.TIME.values(), *plots.RADIUS.values()],
        "maze": [
            f"{column.replace('_', ' ')} {which}"
            for column in plots._TITLES
            for which in plots.WITH.values()
        ],
    }
    for experiment, names in used.items():
        assert set(names) <= {figure.figure for figure in published_figures(experiment)}
    assert set(plots._DRAWERS) == set(CATALOGUE) - {"body"}


@pytest.mark.release
def test_published_speeds_stand_where_they_say():
    """86.4 mm/s for the trot at 0.8 Hz, 22 % more with the spine, and the lateral walk at a ratio of 1.27."""
    trot, walking, lateral = whole("straight-line")["speed"].axes
    (x_off, off), (x_on, on) = sorted(marks(trot, "published"))
    assert (off, on) == pytest.approx((86.4, 86.4 * 1.22))
    assert min(abs(x - x_off) for x, _ in bars(trot)) < 1e-9  # in the middle of its bar
    assert x_on > x_off
    assert not marks(walking, "published")
    assert marks(lateral, "published")[0][1] == pytest.approx(86.4 / 1.27)
    assert "published" in entries(whole("straight-line")["speed"])


@pytest.mark.release
def test_published_turns_and_walks_stand_where_they_say():
    """Times of the quarter circle and of the maze in s, the speed from them in mm/s, and the radius in mm."""
    drawn = whole("turning")
    assert [y for _, y in marks(drawn["time"].axes[0], "published")] == [18.4, 13.0, 14.5]
    speeds = [y for ax in drawn["speed"].axes for _, y in marks(ax, "published")]
    assert speeds == pytest.approx([500 * np.pi / 2 / time for time in (18.4, 13.0, 14.5)])
    assert {y for _, y in marks(drawn["smallest-radius"].axes[0], "published")} == {174.0, 135.0}
    walk = whole("maze")["walk"].axes
    found = [[y for _, y in marks(ax, "published")] for ax in walk]
    assert found == [[85.7, 61.1], [60.0, 82.0], [3.09, 4.13], [0.75, 1.25]]


@pytest.mark.release
def test_bars_show_the_mean_and_the_spread_in_shown_units():
    """Means of the repeats in mm/s; those of `as_published` on the controller's clock, 2.5 times slower."""
    figure = whole("straight-line")["speed"]
    heights = [height for _, height in bars(figure.axes[0])]
    assert heights == pytest.approx([34.0, 85.0] * (len(heights) // 2))
    assert len(
        [c for c in figure.axes[0].containers if type(c).__name__ == "ErrorbarContainer"]
    ) == len(heights)
    theory = [line for line in figure.axes[0].lines if line.get_gid() == "theory"]
    assert {round(line.get_ydata()[0], 6) for line in theory} == {100.0, 40.0}


@pytest.mark.release
def test_failed_repeats_are_marked_and_do_not_count():
    """A fallen or NaN repeat leaves the mean of the others and a cross; with no other there is the cross alone."""

    def status(row):
        fails = row["frequency"] == 0.5 or (row["frequency"] == 0.8 and row["repeat"] == 1)
        return "fell" if fails and row["gait"] == "walking_trot" else "ok"

    def speed(row):
        return (
            np.nan
            if row["gait"] == "walking_trot" and row["frequency"] == 0.67
            else 0.08 + 0.1 * row["repeat"]
        )

    figure = figures_of(walked(profiles=("exact",), status=status, speed=speed))["speed"]
    trot, walking, _ = figure.axes
    assert not marks(trot, "failed")
    assert len(marks(walking, "failed")) == 6  # no frequency went well
    assert [height for _, height in bars(walking)] == pytest.approx([80.0, 80.0])
    assert "a repeat without result" in entries(figure)


@pytest.mark.release
def test_paths_not_followed_are_hatched():
    """Bars of the spine-based turns, which strayed, are hatched, the others are not; the legend says why."""
    figure = figures_of(turned(profiles=("exact",)))["speed"]
    assert [bool(patch.get_hatch()) for patch in figure.axes[0].patches] == [False, True, False] * 3
    assert any("did not follow" in entry for entry in entries(figure))


@pytest.mark.release
def test_paths_turn_left_on_the_page():
    """A left turn goes up and then left; the mean over a cycle stays on the circle."""
    (ax,) = whole("turning")["paths"].axes
    assert ax.get_aspect() == 1.0
    mean = max(
        (line for line in ax.lines if line.get_linewidth() > 2),
        key=lambda line: line.get_linewidth(),
    )
    x, y = mean.get_xdata(), mean.get_ydata()
    assert np.all(np.diff(x) < 0)
    assert np.all(np.diff(y) > 0)
    assert np.hypot(x + 500, y) == pytest.approx(500, abs=5)


@pytest.mark.release
def test_orientation_spans_two_cycles_in_degrees():
    """Roll of 6 degrees shows as 6, over cycles 0 to 2; the published range is drawn at 8."""
    roll = whole("straight-line")["orientation"].axes[0]
    assert roll.get_xlim() == (0, 2)
    curve = roll.lines[0]
    assert np.ptp(curve.get_xdata()) == pytest.approx(2.0, abs=0.02)
    assert np.max(curve.get_ydata()) == pytest.approx(6.0, abs=0.02)
    assert sorted(line.get_ydata()[0] for line in roll.lines if line.get_gid() == "published") == [
        -8.0,
        8.0,
    ]


def test_the_maze_is_seen_from_above():
    """Boxes, the course from the start at the bottom to the end at the left, and both ways in each profile's axes."""
    drawn = figures_of(mazed(time=lambda row: np.nan if row["spine"] else 25.0))["ways"]
    assert len(drawn.axes) == 2
    for ax in drawn.axes:
        assert ax.get_aspect() == 1.0
        boxes = next(c for c in ax.collections if isinstance(c, PolyCollection))
        assert len(boxes.get_paths()) == 40
        course = next(line for line in ax.lines if line.get_linestyle() == "--")
        assert course.get_ydata()[0] == 0.0
        assert course.get_xdata()[-1] == pytest.approx(-1080.0)
        assert len(marks(ax, "failed")) == 1  # the way with the spine does not come to the end
    assert "end not reached" in entries(drawn)


@pytest.mark.release
def test_verdicts_say_what_was_published_and_what_differs():
    """A tile a source; where ours is not as published, it is framed."""
    outcome = balanced(
        passed=lambda row: row["sbc"] or (row["leg"] != "front_left" and row["repeat"] == 0)
    )
    without, with_it = figures_of(outcome)["verdicts"].axes
    texts = [text.get_text() for text in without.texts]
    assert texts[:4] == [
        "pass",
        "fail",
        "fail",
        "fail",
    ]  # front left: published, exact, as published, hardware
    assert texts[4:8] == ["pass", "1 of 2", "1 of 2", "fail"]
    assert [text.get_text() for text in with_it.texts] == ["pass"] * 16
    assert sum(patch.get_gid() == "differs" for patch in without.patches) == 8
    assert not any(patch.get_gid() == "differs" for patch in with_it.patches)


@pytest.mark.release
def test_stability_has_its_limit_and_its_phases():
    """The distance is in mm, a line at 0 is where the robot tips, and each phase is named."""
    ax = whole("balance")["stability"].axes[0]
    assert ax.lines[0].get_ydata()[0] == pytest.approx(5.0, abs=0.02)
    assert any(list(line.get_ydata()) == [0, 0] for line in ax.lines)
    assert [text.get_text() for text in ax.texts] == list(PHASES)


def test_the_report_shows_numbers_as_shares_of_the_published():
    """A number stands at its share, one beyond the axis at the axis' end, and one that was not measured is missing.

    A ratio that is an effect stands at the share of its effect: 1.3 of 1.2 is 1.5, and 0.9 is -0.5.
    """

    def row(name, rule, published, as_published, exact, holds, unit="s"):
        made = Figure(name, "predicted", rule, lambda of: 1, published, unit=unit)
        return line("maze", made, as_published=as_published, exact=exact, holds=holds)

    lines = [
        row("a", "number", 2.0, None, 3.0, False),
        row("b", "range", [1.0, 3.0], 20.0, 2.0, True),
        row("c", "number", 2.0, None, None, None),
        row("d", "outcome", True, True, True, True, ""),
        row("e", "effect", 1.2, 0.9, 1.3, False, ""),
        row("f", "gain", 0.4, None, 0.2, False, ""),
    ]
    ax, table = pictures(mazed(), lines)["report"].axes
    assert [label.get_text() for label in ax.get_yticklabels()] == ["a", "b", "e", "f"]
    np.testing.assert_allclose(marks(ax, "exact"), [(1.5, 0), (1.0, 1), (1.5, 2), (0.5, 3)])
    np.testing.assert_allclose(marks(ax, "as_published"), [(2.5, 1), (-0.5, 2)])
    assert marks(ax, "published") == [(1, 0), (1, 1), (1, 2), (1, 3)]
    assert {"3 s", "1 to 3 s", "20 s", "1.3"} <= {text.get_text() for text in table.texts}


def test_pictures_leave_the_callers_style_alone():
    """Drawing does not change matplotlib's settings."""
    before = dict(matplotlib.rcParams)
    pictures(mazed(), [])
    assert dict(matplotlib.rcParams) == before
    assert any(before[name] != value for name, value in STYLE.items())
