# Tests of sweep/optimum.py, sweep/selection.py, sweep/optimum_tables.py, sweep/optimum_figure.py
"""The optimum of a sweep: how often its region and its interval hold the truth, and its runs, files and refusals."""

from __future__ import annotations

import itertools
import types

import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import OPTIMUM as SPEC
from fakes.sweep_fake import FakeSimulator, Noisy
from matplotlib.text import Text
from scipy import stats

from nermo_mjx.sweep import SpecError, Sweep, run_sweep
from nermo_mjx.sweep.counting import two_stage
from nermo_mjx.sweep.optimum import optimum_in
from nermo_mjx.sweep.plots import sweep_figures
from nermo_mjx.sweep.selection import hsu_margin, judged, undistinguished
from nermo_mjx.sweep.spec import SoughtOptimum, sample

REPEATS, FRESH, TRIALS = 4, 24, 400
AMPLITUDES, PHASES = np.array([0.1, 0.2, 0.3, 0.4])[:, None], np.arange(12) * np.pi / 6
#: Gains of 48 points [m/s]: one phase is best and the amplitude hardly matters; a plateau; and one clear best point.
LANDSCAPES = {
    "ridge": (0.008 * np.cos(PHASES - 0.3) - 0.002 * (AMPLITUDES - 0.3) ** 2).ravel(),
    "plateau": np.where(np.arange(48) == 17, 1e-9, 0.0),
    "peak": (0.02 * AMPLITUDES * np.cos(PHASES - 0.3) - 0.1 * (AMPLITUDES - 0.32) ** 2).ravel(),
}


def draws(
    rng: np.random.Generator, truth: np.ndarray, repeats: int, spread: float, noise: str
) -> np.ndarray:
    """Runs (repeats, points): what a repeat's friction does to all of them, and noise of each."""
    common = rng.normal(0.0, 0.005, (repeats, 1))
    noise_values = (
        rng.normal(size=(repeats, len(truth)))
        if noise == "normal"
        else rng.exponential(size=(repeats, len(truth))) - 1
    )
    return truth + common + spread * noise_values


def study(rng, truth, question: SoughtOptimum, spread=0.002, noise="normal"):
    """Judge a landscape as a sweep does, with the runs that are asked for: the verdict, and its gain with interval on
    fresh runs and on those that chose."""
    size = (REPEATS + question.fresh + REPEATS * (2 + question.budget // REPEATS), len(truth))
    all_runs = draws(rng, truth, size[0], spread, noise)
    is_there = np.zeros(size, bool)
    while True:
        verdict = judged(np.where(is_there, all_runs, np.nan), is_there, question, REPEATS)
        if not len(verdict.wanted[0]):
            break
        is_there[verdict.wanted] = True
    assert not is_there[REPEATS : REPEATS + question.fresh].any(), "fresh runs choose nothing"
    assert is_there[REPEATS:].sum() == verdict.spent <= question.budget
    base = draws(
        rng, np.zeros(1), len(all_runs), spread, noise
    )  # of the same draws, but for the friction: added below
    base += (all_runs - truth).mean(axis=1, keepdims=True)
    gains = all_runs[:, verdict.best] - base[:, 0]
    chose = is_there[:, verdict.best]
    samples = [gains[REPEATS : REPEATS + question.fresh], gains[chose]]
    return verdict, [
        two_stage(sample[:, None], np.zeros(len(sample), int), np.zeros(1, int))
        for sample in samples
    ]


def shares(landscape: str, noise: str, budget: int) -> dict[str, float]:
    """Of 400 landscapes: how often the region holds the best point, and both intervals the gain; sizes and biases."""
    rng, truth, outcomes = np.random.default_rng(7), LANDSCAPES[landscape], []
    question = SoughtOptimum.model_validate(
        {"over": ["a"], "base": {"b": "none"}, "fresh": FRESH, "budget": budget}
    )
    for _ in range(TRIALS):
        verdict, intervals = study(rng, truth, question, noise=noise)
        gain = truth[verdict.best]
        line = {"region holds it": verdict.region[truth.argmax()], "points": verdict.region.sum()}
        for name, interval in zip(("fresh", "chosen"), intervals, strict=True):
            line |= {
                name: interval.low[0] <= gain <= interval.high[0],
                f"{name} bias": 1e3 * (interval.estimate[0] - gain),
            }
        outcomes.append(line)
    return {name: float(np.mean([line[name] for line in outcomes])) for name in outcomes[0]}


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    ("landscape", "noise", "budget"),
    [
        ("plateau", "normal", 0),
        ("plateau", "skewed", 200),
        ("ridge", "normal", 200),
        ("ridge", "skewed", 0),
    ],
)
def test_the_region_and_the_interval_hold_the_truth_as_often_as_they_say(landscape, noise, budget):
    """400 landscapes with a known optimum: a standard error of a hundredth. The region holds it 95 times of 100 where
    all points are alike, which is the case that the method is made for, and more often where most are worse."""
    shares_found = shares(landscape, noise, budget)
    # Of skewed noise the variances of the points differ by chance, which makes their margins wider than they need be.
    most = 0.98 if (landscape, noise) == ("plateau", "normal") else 0.999
    assert 0.93 <= shares_found["region holds it"] <= most, shares_found
    assert shares_found["points"] <= (
        48 if landscape == "plateau" else 14 if noise == "normal" else 20
    ), shares_found
    # Differences of two skewed sides are symmetric with long tails, where Student's t is a little too wide.
    assert (
        0.925
        <= shares_found["fresh"]
        <= (0.985 if (landscape, noise) == ("plateau", "skewed") else 0.975)
    ), shares_found
    assert abs(shares_found["fresh bias"]) <= 0.1, (
        shares_found
    )  # of noise of 0.6 mm/s: 400 means have a standard error of 0.03
    assert shares_found["chosen bias"] >= 0.4, "the winner's curse"


@pytest.mark.long
@pytest.mark.release
def test_a_second_stage_narrows_a_clear_optimum():
    """A peak: three points instead of seven or more, none of them lost."""
    first, second = (shares("peak", "normal", budget) for budget in (0, 200))
    assert second["points"] < 0.5 * first["points"]
    assert min(first["region holds it"], second["region holds it"]) >= 0.98


def test_the_margin_is_the_quantile_of_the_largest_difference():
    """Of two points Student's t; of five and 48 as drawn 200,000 times."""
    assert hsu_margin(2, 10, 0.95) == pytest.approx(stats.t.ppf(0.95, 10), abs=0.01)
    rng = np.random.default_rng(0)
    for points, freedom in ((5, 10), (48, 141)):
        z, s = (
            rng.normal(size=(200_000, points)),
            np.sqrt(rng.chisquare(freedom, 200_000) / freedom),
        )
        largest = ((z[:, 1:] - z[:, :1]) / np.sqrt(2) / s[:, None]).max(axis=1)
        assert hsu_margin(points, freedom, 0.95) == pytest.approx(
            np.quantile(largest, 0.95), abs=0.02
        )


# --- through a sweep: its runs, files and refusals


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The sweep, complete."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("sweep"), simulator=Noisy())


def test_further_runs_are_rows_of_the_table_and_fresh_ones_chose_nothing(done):
    """Draws of all points and the base are pairs; of the second stage only points of the region have rows."""
    table, optimum = done.table.to_pandas(), done.summary["optimum"]
    variants = 2 * (1 + 6)
    assert done.complete
    assert done.rows == len(table) == done.rows_done
    first_rows = table[table.row < 3 * variants]
    assert len(first_rows) == 3 * variants
    assert (first_rows.groupby(["repeat"]).seed.nunique() == 1).all(), (
        "paired, also across gaits and with the base"
    )
    for answer in optimum["answers"]:
        here = table[table.gait == answer["for"]["gait"]]
        fresh = here[(here.repeat >= 3) & (here.repeat < 7)]
        best = fresh[fresh.spine != "none"]
        assert (best["spine.amplitude"] == answer["at"]["spine.amplitude"]).all()
        assert (best["spine.phase"] == answer["at"]["spine.phase"]).all()
        assert len(best) == 4 == answer["metrics"]["speed"]["pairs"]
        base = fresh[fresh.spine == "none"].set_index("seed").speed
        gain = best.set_index("seed").speed - base
        line = answer["metrics"]["speed"]
        interval = stats.ttest_1samp(gain, 0.0).confidence_interval(0.95)
        assert line["difference"] == pytest.approx(gain.mean())
        assert (line["low"], line["high"]) == pytest.approx(tuple(interval))
        ratios = best.set_index("seed").speed / base
        assert line["relative"] == pytest.approx(np.exp(np.log(ratios).mean()) - 1.0)
        half = stats.t.ppf(0.975, 3) * best.speed.std() / 2
        assert line["mean_high"] - line["mean"] == pytest.approx(half)
        second = here[here.repeat >= 7]
        assert len(second) == answer["spent"] <= 30
        assert answer["ended"] in ("few", "budget")
        assert {point["spine.amplitude"] for point in answer["region"]} == {0.3}
        assert min(point["spine.phase"] for point in answer["region"]) >= 0.0


def test_files_say_the_same(done):
    """Parquet, CSV and LaTeX."""
    lines = pq.read_table(done.out / "optimum.parquet").to_pylist()
    assert [line["metric"] for line in lines[:3]] == [
        "speed",
        "cost_of_transport",
        "electrical_cost_of_transport",
    ]
    assert (done.out / "optimum.csv").read_text().count("\n") == len(lines) + 1 == 7
    latex = (done.out / "optimum.tex").read_text()
    share = 100 * done.summary["optimum"]["answers"][0]["metrics"]["speed"]["relative"]
    assert f"+{share:.1f} \\%" in latex
    assert "Lateral walk" in latex
    assert "the stiff spine" in latex


def texts(figure) -> str:
    """All that stands in a figure."""
    return " ".join(" ".join(text.get_text() for text in figure.findobj(Text)).split())


def test_the_figure_has_a_map_for_each_gait_with_the_gain_on_fresh_runs(done):
    figure = dict(sweep_figures(done.out))["optimum"]
    for answer, ax in zip(done.summary["optimum"]["answers"], figure.axes, strict=False):
        line = answer["metrics"]["speed"]
        assert f"{100 * line['relative']:+.1f} %" in ax.get_title()
        (colours,) = (
            collection for collection in ax.collections if collection.get_array() is not None
        )
        assert colours.get_array().size == 6
    figure_texts = texts(figure)
    for words in (
        "Trot",
        "Lateral walk",
        "Mechanical cost",
        "intervals over contact",
        "exact",
    ):
        assert words in figure_texts


def test_one_parameter_is_a_line_and_less_may_be_better(tmp_path):
    spec = SPEC | {
        "vary": {"spine": ["none", "stride_extension"], "spine.amplitude": [0.1, 0.2, 0.3]}
    }
    spec["randomize"] = {"repeats": 3, "paired": ["spine.amplitude"]}
    asked = {
        "minimize": "cost_of_transport",
        "over": ["spine.amplitude"],
        "base": {"spine": "none"},
        "fresh": 4,
    }
    spec["optimum"] = asked
    result = run_sweep(spec, tmp_path, simulator=Noisy())
    (answer,) = result.summary["optimum"]["answers"]
    assert answer["at"] == {"spine.amplitude": 0.3}
    assert answer["metrics"]["cost_of_transport"]["relative"] < 0
    figure = dict(sweep_figures(tmp_path))["optimum"]
    assert "Lowest mechanical cost of transport over spine amplitude" in texts(figure)
    assert figure.axes[0].get_xlabel() == "spine amplitude [deg]"


def test_gains_and_best_variants_are_told_for_each_structure(tmp_path):
    """A grid from amplitude 0 over two gaits: a map of the gain for each, and no mean over the stiff runs."""
    vary = {
        "gait": ["trot", "lateral_walk"],
        "spine.amplitude": [0.0, 0.2, 0.4],
        "spine.phase": [-1.0, 0.0, 1.0],
    }
    spec = {
        "run": {"duration": 0.2, "warmup": 0},
        "plots": False,
        "vary": vary,
        "spine": "stride_extension",
    }
    result = run_sweep(spec, tmp_path, simulator=FakeSimulator())
    figure = dict(sweep_figures(tmp_path))["speed-gain-over-spine.amplitude-and-spine.phase"]
    assert [ax.get_title() for ax in figure.axes[:2]] == ["trot", "lateral walk"]
    best = result.summary["best_of_each"]
    assert len({point["parameters"]["gait"] for point in best}) == len(best) == 2
    assert all(point["parameters"]["spine.amplitude"] == 0.4 for point in best)


@pytest.mark.release
@pytest.mark.parametrize("stop", [2, 5, 7])
def test_it_resumes_anywhere_with_the_same_rows(tmp_path, done, stop):
    """Interrupted in the first stage, the second one, and in fresh runs."""
    from nermo_mjx.runs import Interrupted

    with pytest.raises(Interrupted):
        run_sweep(SPEC, tmp_path, simulator=Noisy(stop_at=stop))
    again = run_sweep(SPEC, tmp_path, simulator=Noisy())
    assert again.table.equals(done.table)
    assert again.summary["optimum"] == done.summary["optimum"]
    idle = Noisy()
    run_sweep(SPEC, tmp_path, simulator=idle)
    assert not idle.batches


def test_it_may_be_sought_in_a_finished_directory(tmp_path):
    """No row of it depends on what is sought; without common draws the gain is not of pairs."""
    spec = {key: value for key, value in SPEC.items() if key != "optimum"}
    spec |= {
        "spine": "stride_extension",
        "randomize": {"repeats": 3, "contact.friction": {"uniform": [0.8, 1.4]}},
    }
    spec["vary"] = {
        "gait": ["trot"],
        "spine.amplitude": [0.0, 0.1, 0.3],
        "spine.phase": [-1.0, 0.0, 1.0],
    }
    first = run_sweep(spec, tmp_path, simulator=Noisy()).table
    sweep = Sweep.from_directory(tmp_path).seeking(
        "{over: [spine.amplitude, spine.phase], base: {spine.amplitude: 0}, fresh: 4}"
    )
    result = run_sweep(sweep, tmp_path, simulator=Noisy())
    assert result.table.slice(0, len(first)).equals(first)
    assert result.rows == len(first) + 8
    (answer,) = result.summary["optimum"]["answers"]
    assert answer["at"]["spine.amplitude"] == 0.3
    assert answer["points"] == 6
    assert answer["metrics"]["speed"]["pairs"] == 0
    (sentence,) = (
        candidate for candidate in optimum_in(tmp_path).how() if "fresh runs each" in candidate
    )
    assert "3 runs a point, 4 fresh runs each, no pairs (randomize.paired makes them)" in sentence
    fresh = result.table.slice(len(first)).to_pandas()
    best, base = (fresh[fresh["spine.amplitude"] == candidate].speed for candidate in (0.3, 0.0))
    welch = stats.ttest_ind(best, base, equal_var=False)
    assert answer["metrics"]["speed"]["p"] == pytest.approx(welch.pvalue, rel=0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"over": ["spine.phse"]},
            "names 'spine.phse', which is not varied; did you mean 'spine.phase'?",
        ),
        ({"for": ["spine"]}, "names 'spine', of which the best value is sought"),
        ({"for": []}, "leaves out gait, which varies, too"),
        ({"base": {"spine": "balance"}}, "no value of spine; allowed are none, stride_extension"),
        ({"base": {}}, "expected one column and its value"),
        ({"maximize": "sped"}, "is 'sped', no metric; did you mean 'speed'?"),
        ({"maximize": "speed", "minimize": "slip"}, "one metric is best at a time"),
    ],
)
def test_what_cannot_be_sought_is_refused(change, message):
    with pytest.raises(SpecError, match=r"optimum") as refused:
        Sweep.from_dict(SPEC | {"optimum": SPEC["optimum"] | change})
    assert message in str(refused.value)


def test_single_runs_and_unlisted_values_tell_no_optimum():
    with pytest.raises(SpecError, match="needs repeats, because a single run tells no noise"):
        Sweep.from_dict(SPEC | {"randomize": {}})
    with pytest.raises(SpecError, match="drawn between bounds"):
        Sweep.from_dict(
            SPEC
            | {"vary": SPEC["vary"] | {"spine.phase": {"uniform": [-1, 1]}}, "sample": {"sobol": 8}}
        )
    with pytest.raises(SpecError, match="names 'gait', which is no varied parameter"):
        Sweep.from_dict(SPEC | {"randomize": {"repeats": 2, "paired": ["gait"]}})


def test_lost_points_are_not_the_best(tmp_path):
    """The fastest points fall: the best is among those that lost no run, and how many are out is said."""
    result = run_sweep(SPEC, tmp_path, simulator=Noisy(falls_above=0.0755))
    table = result.table.to_pandas()
    chose = (table.repeat < 3) | (table.repeat >= 7)
    fell = table[(table.status == "fell") & chose]
    assert {*fell["spine.amplitude"]} >= {0.3}
    for answer in result.summary["optimum"]["answers"]:
        gait_rows = fell[fell.gait == answer["for"]["gait"]]
        for point in answer["region"]:
            assert not np.all(gait_rows[[*point]] == [*point.values()], axis=1).any()


def test_runs_that_measure_the_gain_are_not_among_those_that_choose():
    """Blocks of a second stage begin after the fresh runs: of repeats 0, 1, fresh 2 to 6, the next are 7 and 8."""
    question = SoughtOptimum.model_validate(
        {"over": ["a"], "base": {"b": "none"}, "fresh": 5, "budget": 40, "until": 1}
    )
    values = np.random.default_rng(0).normal(size=(30, 4))
    values[:2] = [[1.0, 1.01, 0.99, -9.0], [1.02, 1.0, 0.98, -9.1]]
    is_there = np.zeros(values.shape, bool)
    is_there[:2] = True
    first = judged(values, is_there, question, 2)
    assert sorted(set(first.wanted[0].tolist())) == [7, 8]
    is_there[first.wanted] = True
    second = judged(values, is_there, question, 2)
    assert set(second.wanted[0].tolist()) <= {9, 10}


# --- one point, samples, seeds and outliers


class GainsWithFriction:
    """A spine that makes the fake robot 5 % faster at a friction of 0.8 and 11 % at 1.4, with noise of 0.05 points.

    The true mean gain over the uniform distribution is that of the middle, 8 %. With the spine, runs with more friction
    than `stumbles_above` lose half of their speed.
    """

    engine = "fake"

    def __init__(self, stumbles_above: float = np.inf) -> None:
        self.random, self.stumbles_above = np.random.default_rng(0), stumbles_above

    def run(self, values, run, *, progress=None, notify=None):
        friction = values["contact.friction"]
        gain = 0.08 + 0.1 * (friction - 1.1) + 0.0005 * self.random.normal(size=len(friction))
        gain[friction > self.stumbles_above] = -0.5
        is_bent = np.nan_to_num(values.get("spine.amplitude", np.zeros(len(friction)))) > 0.0
        speed = 0.1 * friction * np.where(is_bent, 1.0 + gain, 1.0)
        metrics = {"speed": speed, "fell": np.zeros(len(speed))}
        status = np.full(len(speed), "ok")
        return types.SimpleNamespace(metrics=metrics, status=status, engine="fake", steps=1)


ONE_POINT = {
    "run": {"duration": 0.2, "warmup": 0},
    "plots": False,
    "vary": {"spine": ["none", "stride_extension"], "spine.amplitude": [0.2]},
    "randomize": {
        "repeats": 4,
        "paired": ["spine.amplitude"],
        "contact.friction": {"uniform": [0.8, 1.4]},
    },
    "optimum": {
        "over": ["spine.amplitude"],
        "base": {"spine": "none"},
        "fresh": 24,
        "explain": "contact.friction",
    },
}


def gain_of(out, seed: int = 0, stumbles_above: float = np.inf):
    """The answer on the gain of the one point, and the sentences."""
    run_sweep(ONE_POINT | {"seed": seed}, out, simulator=GainsWithFriction(stumbles_above))
    optimum = optimum_in(out)
    (answer,) = optimum.answers
    return answer.lines["speed"], optimum.how()


def test_one_point_has_a_gain_and_another_seed_agrees(tmp_path):
    """The interval contains the noise and not the sample: it holds the true mean in 19 of 20 seeds, and it is narrow."""
    lines = [gain_of(tmp_path / str(seed), seed)[0] for seed in range(20)]
    holds = [line["relative_low"] <= 0.08 <= line["relative_high"] for line in lines]
    assert sum(holds) >= 19
    assert max(line["relative_high"] - line["relative_low"] for line in lines) < 0.002
    agreements = [
        line["relative_low"] - 0.0005 <= other["relative"] <= line["relative_high"] + 0.0005
        for line, other in itertools.pairwise(lines)
    ]
    assert sum(agreements) == 19


def test_friction_explains_the_gain(tmp_path):
    line, sentences = gain_of(tmp_path)
    assert line["r2"] > 0.98
    assert line["slope"] == pytest.approx(0.1, abs=0.005)
    assert any("contact friction explains" in sentence for sentence in sentences)
    with pytest.raises(SpecError, match=r"explain.*needs pairs of runs: name spine.amplitude"):
        Sweep.from_dict(
            ONE_POINT
            | {
                "randomize": {
                    key: value for key, value in ONE_POINT["randomize"].items() if key != "paired"
                }
            }
        )
    with pytest.raises(SpecError, match=r"explain.*names 'friction', which is not randomized"):
        Sweep.from_dict(ONE_POINT | {"optimum": ONE_POINT["optimum"] | {"explain": "friction"}})


def test_outliers_are_reported(tmp_path):
    line, sentences = gain_of(tmp_path, stumbles_above=1.36)
    assert line["outliers"] == 2
    assert any("2 of 24 pairs are outliers" in sentence for sentence in sentences)


def test_one_contender_is_the_answer():
    """Two of three points lose a run: the third one is the best point and its region."""
    question = SoughtOptimum.model_validate({"over": ["a"], "base": {"b": "none"}})
    values = np.array([[1.0, 2.0, 3.0], [1.1, np.nan, np.nan]])
    verdict = judged(values, np.full(values.shape, True), question, 2)
    assert (verdict.best, verdict.region.tolist()) == (0, [True, False, False])


def test_a_noisy_point_does_not_widen_the_margin_of_the_others():
    """One point has sixty times the noise of the others: it may be the best, and clear differences stay clear."""
    random = np.random.default_rng(1)
    truth = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.5])
    values = truth + random.normal(size=(6, 6)) * np.array([0.01, 0.01, 0.01, 0.01, 0.01, 0.6])
    assert undistinguished(values).tolist()[:5] == [True, False, False, False, False]


@pytest.mark.release
def test_points_of_unequal_spread_keep_the_best_one():
    """A plateau of 48 points, of which each has its own spread (log-normal, 1.2): the pooled noise held it in 75 %."""
    random, shares_held = np.random.default_rng(1), []
    truth = LANDSCAPES["plateau"]
    spread = 0.001 * np.exp(1.2 * np.random.default_rng(9).normal(size=48))
    for _ in range(150):
        values = truth + spread * random.normal(size=(4, 48))
        shares_held.append(undistinguished(values)[17])
    assert np.mean(shares_held) > 0.9


def test_samples_are_stratified_and_more_of_them_keep_the_first():
    """Of 16 repeats one in each sixteenth of each range; 24 are the first of 64; structures share them."""
    randomize = ONE_POINT["randomize"] | {"mass.front": {"uniform": [0.15, 0.19]}}

    def frictions(repeats: int, name: str = "contact.friction") -> np.ndarray:
        spec = {key: value for key, value in ONE_POINT.items() if key != "optimum"}
        rows = sample(Sweep.from_dict(spec | {"randomize": randomize | {"repeats": repeats}}))
        return rows.values[name].reshape(-1, repeats)

    for name, low, width in (("contact.friction", 0.8, 0.6), ("mass.front", 0.15, 0.04)):
        stiff, bent = frictions(16, name)
        np.testing.assert_array_equal(stiff, bent)
        assert sorted(np.floor((stiff - low) / width * 16).astype(int)) == list(range(16))
        np.testing.assert_array_equal(frictions(24, name), frictions(64, name)[:, :24])
    assert frictions(24)[0].mean() == pytest.approx(1.1, abs=0.01)
