"""Every published figure has a line, judged as it must be, and of the right kind; numbers are typed from the thesis."""

import re

import numpy as np
import pytest

from nermo_mjx.experiments import maze, straight_line, turning
from nermo_mjx.experiments.judgement import AtMost, Number
from nermo_mjx.experiments.line import KINDS, agrees, measured
from nermo_mjx.experiments.outcome import Outcome
from nermo_mjx.experiments.published import FIGURES
from nermo_mjx.robot import LIMBS

#: Experiment -> published figure (part of the line's name) -> what was published, as the report shows it.
PUBLISHED = {
    "straight-line": {
        "theory: speed of trt, 0.8 Hz, no spine": 96.0, "theory: speed of trt, 0.8 Hz, spine": 120.0,
        "theory: longer stride by the spine": 15.0, "theory: speed of the spine alone (stride 0), 0.8 Hz": 24.0,
        "speed of the spine alone (stride 0), 0.8 Hz": 19.0, "speed of trt, 0.8 Hz, no spine": 86.4,
        "speed of trt over its theory, 0.8 Hz": 0.90, "speed of trt1 over its theory, mean of the frequencies": 0.90,
        "speed of lat over its theory, mean of the frequencies": 0.90,
        "trot > walking trot > lateral walk at each frequency": True,
        "trt faster with the spine at each frequency": True, "trt1 faster with the spine at each frequency": True,
        "speed of trt, 0.5 Hz, spine over none": 1.05, "speed of trt, 0.8 Hz, spine over none": 1.22,
        "speed of trt over lat, 0.8 Hz, no spine": 1.27, "speed of trt with spine over lat, 0.8 Hz": 1.48,
        "speed of trt linear in frequency": True, "speed of trt1 linear in frequency": True,
        "speed of lat saturates with frequency": True, "speed over stride, R^2 of a line": (0.98, 1.0),
        "speed over stride with the spine: a line, above that without": True,
        "roll std higher with the spine": True, "pitch std higher with the spine": True,
        "yaw std higher with the spine": True, "roll std of trt, 0.8 Hz, spine over none": (1.25, 1.40),
        "yaw std of trt, 0.8 Hz, spine over none": 2.86, "yaw amplitude of trt, 0.8 Hz, spine over none": 1.50,
        "yaw follows the spine's angle": True, "largest roll of trt, 0.8 Hz, spine": 8.0,
        "roll std falls with duty: trt > trt1 > lat at each frequency": True,
        "yaw std largest at the lowest duty": True,
        "roll std of trt, 0.67 Hz, spine, compensated over not": 0.85,
        "roll amplitude of trt, 0.67 Hz, spine, compensated over not": 0.875,
        "compensation lowers the roll, and leaves pitch and yaw": True,
        "mean pitch of trt, 0.8 Hz, no spine": -0.5,
        "mean pitch of trt, 0.8 Hz, no spine, from the standing attitude": -0.5,
        "largest pitch std of all cases": (0.0, 2.0), "pitch std of trt, 0.8 Hz, spine over none": (1.0, 1.25),
        "pitch std of trt, 0.8 Hz, stride 1.0 over 0.8": (0.0, 1.5),
        "upward pitch peak of trt, 0.8 Hz, spine over none": 2.0,
        "upward pitch peak of trt, 0.8 Hz, stride 1.0 over 0.8": 1.5,
        "pitch peaks in a gait cycle of trt, 0.8 Hz": 2, "largest upward pitch of trt, 0.8 Hz": 4.0,
        "pitch of trt at lift-off above its mean, 0.8 Hz": 4.0,
        "front feet carry more than rear feet": True, "rear feet slip most at lift-off": True,
        "hardware: speed of trt, 0.67 Hz, no spine": 67.0, "hardware: speed of trt, 0.67 Hz, spine": 77.0,
        "hardware: speed of trt, 0.67 Hz, spine over none": (1.15, 1.22),
        "hardware: speed of trt over lat, mean of the frequencies": 1.11,
        "hardware below simulation, trt, no spine": 0.12, "hardware below simulation, trt, spine": 0.06,
        "hardware below simulation, lat": 0.05,
    },
    "turning": {
        "spine-based turning fastest wherever it follows the path": True,
        "mix-based turning between leg- and spine-based": True,
        "speed, spine- over leg-based, mean of all paths": (1.18, 1.43),
        "largest gain in speed, spine- over leg-based": 0.40,
        "speed, spine- over mix-based, trt, 1.0 m, 0.5 Hz": 1.01,
        "speed, spine- over mix-based, trt1, 1.0 m, 0.5 Hz": 1.03,
        "paths not followed": "lat, 0.8 Hz, spine, 0.5 m",
        "time for 0.5 m, trt, 0.67 Hz, spine-based": 13.0, "time for 0.5 m, trt, 0.67 Hz, leg-based": 18.4,
        "time for 0.5 m, trt, 0.67 Hz, mix-based": 14.5,
        "time for 0.5 m, trt, 0.67 Hz, spine- over leg-based": 0.71,
        "time for 0.5 m, trt, 0.67 Hz, mix- over leg-based": 0.79,
        "theory: smallest radius, leg-based": 0.151, "theory: smallest radius, mix-based": 0.134,
        "theory: spine-based full lock, two feet with equal strides": None,
        "smallest radius of trt, leg-based": 0.174, "smallest radius of trt, mix-based": 0.135,
        "smallest radius of all, mix-based": 0.12, "smallest radius of trt, mix-based below leg-based": 0.22,
        "smallest radius of trt1, mix-based below leg-based": (0.25, 0.30),
        "smallest radius of lat, mix-based below leg-based": (0.25, 0.30),
        "smallest radius of trt above theory, leg-based": 0.15,
        "smallest radius of trt above theory, mix-based": 0.0, "smallest radius off theory, mean of all cases": 0.20,
        "hardware: time for 0.5 m, trt, 0.67 Hz, spine-based": 15.5,
        "hardware: time for 0.5 m, trt, 0.67 Hz, leg-based": 22.0,
        "hardware: time for 0.5 m, trt, 0.67 Hz, mix-based": 16.3,
        "hardware: 0.5 m, trt, 0.67 Hz, followed, spine-based": False,
        "hardware: 0.5 m, trt, 0.67 Hz, followed, leg-based": True,
        "hardware: 0.5 m, trt, 0.67 Hz, followed, mix-based": True,
        "paths not followed at stride 1.0": "lat, 0.8 Hz, spine, 0.5 m",
        "time for 0.5 m, trt, 0.67 Hz, spine-based at stride 1.0": 13.0,
        "time for 0.5 m, trt, 0.67 Hz, leg-based at stride 1.0": 18.4,
        "time for 0.5 m, trt, 0.67 Hz, mix-based at stride 1.0": 14.5,
        "smallest radius of trt, leg-based at stride 1.0": 0.174,
        "smallest radius of trt, mix-based at stride 1.0": 0.135,
        "smallest radius of all, mix-based at stride 1.0": 0.12,
    },
    "balance": {
        **{f"{limb.replace('_', ' ')} lifted, without balance compensation": verdict
           for limb, verdict in zip(LIMBS, ("pass", "pass", "fail", "fail"), strict=True)},
        **{f"{limb.replace('_', ' ')} lifted, with balance compensation": "pass" for limb in LIMBS},
        **{f"hardware: {limb.replace('_', ' ')} lifted, without compensation": "fail" for limb in LIMBS},
        **{f"hardware: {limb.replace('_', ' ')} lifted, with compensation": "pass" for limb in LIMBS},
        "resting pitch reduced by compensation, front legs": 0.30,
        "resting pitch reduced by compensation, rear legs": 0.73, "height of the centre of mass": 57.0,
        "force of the rear left foot, without compensation": 0.73,
        "force of the rear left foot, with compensation": 0.16,
        "force of the front right foot, with compensation": 0.35,
        "front left and rear right carry most, with compensation": True,
    },
    "maze": {
        "end reached without spine": True, "end reached with spine": True, "no box touched without spine": True,
        "no box touched with spine": True, "time without spine": 85.7, "time with spine": 61.1,
        "time with spine over without": 0.713, "mean speed without spine": 60.0, "mean speed with spine": 82.0,
        "mean speed with spine over without": 1.37, "roll std without spine": 3.09, "roll std with spine": 4.13,
        "roll std with spine over without": 1.34, "pitch std without spine": 0.75, "pitch std with spine": 1.25,
        "pitch std with spine over without": 1.67, "roll std higher with the spine": True,
        "pitch std higher with the spine": True, "hardware: time saved with the spine": 0.32,
    },
    "body": {
        "mass": 270.0, "servos": 11, "length": 405.0, "height": 91.0, "width": 90.0, "shoulder to hip": 117.0,
        "bend of a front knee under load": 0.95, "bend of a rear knee under load": 0.65,
        "bend of the spine under load": 0.42, "largest angle of a spine joint": 0.2,
    },
    "leg-stand": {"bend of a front knee under load, 4 hinges": 0.95, "bend of a rear knee under load, 4 hinges": 0.65},
    "spine-stand": {"bend of the spine under load, 4 hinges": 0.42},
}  # fmt: skip

ALL = [(name, figure) for name, figures in FIGURES.items() for figure in figures]


@pytest.mark.parametrize(("experiment", "figure"), [(name, key) for name, all_ in PUBLISHED.items() for key in all_])
def test_every_published_figure_has_a_line(experiment, figure):
    (found,) = [each for each in FIGURES[experiment] if each.name == figure]
    wanted = PUBLISHED[experiment][figure]
    assert found.reported.published == (wanted if wanted is None or isinstance(wanted, tuple) else pytest.approx(wanted)
                                        if isinstance(wanted, float) else wanted)  # fmt: skip


def test_a_ratio_or_a_gain_is_judged_as_an_effect():
    """By its name: "over", "below", "above theory", "reduced", "saved", "gain"; a plain number compares nothing."""
    for _, figure in ALL:
        if isinstance(figure.reported, Number):
            assert not re.search(r" over | below |above theory|reduced|saved|gain", figure.name), figure.name
    judged = {figure.name: figure.reported.name for _, figure in ALL}
    assert (
        judged["speed of trt, 0.8 Hz, spine over none"] == judged["speed of trt over lat, 0.8 Hz, no spine"] == "effect"
    )
    assert judged["largest pitch std of all cases"] == "bound"
    assert judged["hardware: time saved with the spine"] == "gain"
    assert judged["speed of the spine alone (stride 0), 0.8 Hz"] == "number"


def test_what_is_ambiguous_is_shown_both_ways_and_not_judged():
    mean_pitch = [figure for _, figure in ALL if figure.name.startswith("mean pitch of trt")]
    assert len(mean_pitch) == 2
    for figure in mean_pitch:
        assert agrees(-0.5, figure) is None
        assert "not judged" in figure.source


# --- kinds

#: Terms of the identification, section 6.2.1.
FITTED = {
    "speed of trt, 0.8 Hz, no spine", "speed of trt over its theory, 0.8 Hz",
    "trot > walking trot > lateral walk at each frequency", "trt faster with the spine at each frequency",
    "trt1 faster with the spine at each frequency", "speed of trt, 0.5 Hz, spine over none",
    "speed of trt, 0.8 Hz, spine over none", "speed of trt over lat, 0.8 Hz, no spine",
    "speed of trt with spine over lat, 0.8 Hz",
}  # fmt: skip


def test_kinds_are_known_and_terms_of_the_identification_are_fitted():
    kinds = {figure.name: figure.kind for _, figure in ALL}
    assert set(kinds.values()) == set(KINDS)
    assert {name for name, kind in kinds.items() if kind == "fitted"} >= FITTED
    assert all((figure.kind == "theory") == figure.name.startswith("theory: ") for _, figure in ALL)


@pytest.mark.parametrize("experiment", ["turning", "balance", "body"])
def test_nothing_is_a_prediction_where_something_was_decided_with_it_in_view(experiment):
    assert {figure.kind for figure in FIGURES[experiment]} <= {"chosen", "theory"}


def test_the_maze_the_sway_and_the_spine_alone_are_predictions():
    assert {figure.kind for figure in FIGURES["maze"]} == {"predicted"}
    kinds = {figure.name: figure.kind for figure in FIGURES["straight-line"]}
    for name in (
        "speed of the spine alone (stride 0), 0.8 Hz", "front feet carry more than rear feet",
        "rear feet slip most at lift-off", "roll std of trt, 0.8 Hz, spine over none",
        "speed of lat saturates with frequency", "speed over stride, R^2 of a line",
        "hardware: speed of trt over lat, mean of the frequencies",
    ):  # fmt: skip
        assert kinds[name] == "predicted"


def test_sections_are_those_of_the_publication():
    """6.2.1 to 6.2.4 and chapter 7; there are no sections 6.3 to 6.5 (but a Table 6.4)."""
    for _, figure in ALL:
        assert figure.source, figure.name
        assert not re.search(r"(?<!Table )\b6\.[345]\b", figure.source), figure.source


# --- a spine that does nothing

GAITS = {"trt": 0.108, "trt1": 0.100, "lat": 0.086}


def outcome_of(experiment, cases, columns):
    rows = [{"profile": "exact", **case, "repeat": 0} for case in cases]
    rows = [row | {name: value(row) for name, value in columns.items()} for row in rows]
    return Outcome(experiment, {name: np.array([row[name] for row in rows]) for name in rows[0]}, {}, {})


def straight(effect):
    """The straight line with all published effects of the spine (`effect` 1), or with none (0)."""

    def spine(with_it):
        return lambda row: 1.0 + effect * (with_it(row) - 1.0) * row["spine"]

    gain = spine(lambda row: {0.5: 1.05, 0.67: 1.15, 0.8: 1.22}[row["frequency"]])

    def speed(row):
        bent = {0.5: 0.0, 0.67: 0.001, 0.8: 0.004}[row["frequency"]] if row["gait"] == "lat" else 0.0
        alone = effect * 0.019 * (1.0 - row["stride"]) * row["spine"]
        return GAITS[row["gait"]] * row["frequency"] * row["stride"] * gain(row) - bent + alone

    duty = {"trt": 1.3, "trt1": 1.2, "lat": 1.0}

    def compensated(share):
        return lambda row: 1.0 + effect * (share - 1.0) * row["compensated"]

    def wave(angle, size, ratio, less=1.0):
        std = spine(lambda row: ratio)
        return {
            f"{angle}_std": lambda row: np.radians(size) * duty[row["gait"]] * std(row) * compensated(less)(row),
            f"{angle}_max": lambda row: np.radians(8.0) * std(row) * compensated(0.875)(row),
            f"{angle}_min": lambda row: -np.radians(8.0) * std(row) * compensated(0.875)(row),
        }

    peak = spine(lambda row: 2.0)
    columns = {
        "speed": speed, **wave("roll", 3.0, 1.3, 0.85), **wave("pitch", 1.0, 1.1), **wave("yaw", 1.0, 2.86),
        "yaw_min": lambda row: -np.radians(3.0) * spine(lambda _: 1.5)(row),
        "yaw_max": lambda row: np.radians(3.0) * spine(lambda _: 1.5)(row),
        "roll_min": lambda row: -np.radians(8.0) * compensated(0.875)(row),
        "pitch_peak_up": lambda row: 0.01 * peak(row) * (1.5 if row["stride"] == 1.0 else 1.0),
        "theory_speed": lambda row: 0.12 * row["frequency"],
        "yaw_spine_correlation": lambda row: 0.95 if effect * row["spine"] else np.nan,
    }  # fmt: skip
    return outcome_of("straight-line", [case.labels for case in straight_line.cases()], columns)


def turned(effect):
    faster = {"leg": 1.0, "mix": 1.0 + 0.27 * effect, "spine": 1.0 + 0.40 * effect}
    tighter = {"leg": 0.174, "mix": 0.174 - 0.039 * effect, "spine": 0.174 + 0.23 * effect}
    columns = {
        "speed": lambda row: 0.04 * faster[row["strategy"]],
        "time": lambda row: 18.4 / faster[row["strategy"]] if row["radius"] else np.nan,
        "followed": lambda row: row["radius"] > 0,
        "turning_radius": lambda row: np.nan if row["radius"] else tighter[row["strategy"]],
        "theory_radius": lambda row: np.nan if row["radius"] else 0.151,
    }
    return outcome_of("turning", [case.labels for case in turning.cases()], columns)


def mazed(effect):
    def with_spine(without, with_it):
        return lambda row: without + effect * (with_it - without) * row["spine"]

    columns = {
        "time": with_spine(85.7, 61.1), "mean_speed": with_spine(0.060, 0.082), "reached": lambda row: 1.0,
        "touched": lambda row: 0.0, "roll_std": with_spine(0.0539, 0.0721), "pitch_std": with_spine(0.0131, 0.0218),
    }  # fmt: skip
    return outcome_of("maze", [case.labels for case in maze.cases()], columns)


def balanced(effect):
    """On four feet 0.73 N on each rear foot; with compensation the foot to be lifted is relieved."""

    def force(foot):
        def of(row):
            if not (row["sbc"] and effect):
                return 0.73 if foot.startswith("rear") else 0.6
            opposite = {LIMBS[i]: LIMBS[3 - i] for i in range(4)}
            side = {LIMBS[i]: LIMBS[i ^ 2] for i in range(4)}[row["leg"]]
            return {row["leg"]: 0.16, opposite[row["leg"]]: 0.35}.get(foot, 1.0 if foot == side else 1.1)

        return of

    reduced = {"front": 0.30, "rear": 0.73}
    columns = {
        "passed": lambda row: bool(row["leg"].startswith("front") or (row["sbc"] and effect)),
        "pitch_rest": lambda row: 0.05 * (1.0 - effect * reduced[row["leg"].split("_")[0]] * row["sbc"]),
        **{f"force_shift_{foot}": force(foot) for foot in LIMBS},
    }
    return outcome_of("balance", [{"leg": leg, "sbc": sbc} for leg in LIMBS for sbc in (False, True)], columns)


WITH_SPINE = {
    "straight-line": (straight, lambda o: o.columns["spine"]),
    "turning": (turned, lambda o: o.columns["strategy"] != "leg"),
    "maze": (mazed, lambda o: o.columns["spine"]),
    "balance": (balanced, lambda o: o.columns["sbc"]),
}
#: Lines that compare a case with the spine with one without, in each experiment.
ABOUT_THE_SPINE = {
    "straight-line": [
        "speed of the spine alone (stride 0), 0.8 Hz", "trt faster with the spine at each frequency",
        "trt1 faster with the spine at each frequency", "speed of trt, 0.5 Hz, spine over none",
        "speed of trt, 0.8 Hz, spine over none", "speed over stride with the spine: a line, above that without",
        "roll std higher with the spine", "pitch std higher with the spine", "yaw std higher with the spine",
        "roll std of trt, 0.8 Hz, spine over none", "yaw std of trt, 0.8 Hz, spine over none",
        "yaw amplitude of trt, 0.8 Hz, spine over none", "yaw follows the spine's angle",
        "pitch std of trt, 0.8 Hz, spine over none", "upward pitch peak of trt, 0.8 Hz, spine over none",
        "hardware: speed of trt, 0.67 Hz, spine over none", "roll std of trt, 0.67 Hz, spine, compensated over not",
        "compensation lowers the roll, and leaves pitch and yaw",
    ],
    "turning": [
        "spine-based turning fastest wherever it follows the path", "mix-based turning between leg- and spine-based",
        "speed, spine- over leg-based, mean of all paths", "largest gain in speed, spine- over leg-based",
        "time for 0.5 m, trt, 0.67 Hz, spine- over leg-based", "time for 0.5 m, trt, 0.67 Hz, mix- over leg-based",
        "smallest radius of trt, mix-based below leg-based", "smallest radius of trt, mix-based below spine-based",
    ],
    "maze": [
        "time with spine over without", "mean speed with spine over without", "roll std with spine over without",
        "pitch std with spine over without", "roll std higher with the spine", "pitch std higher with the spine",
        "hardware: time saved with the spine",
    ],
    "balance": [
        "rear left lifted, with balance compensation", "rear right lifted, with balance compensation",
        "resting pitch reduced by compensation, front legs", "resting pitch reduced by compensation, rear legs",
        "force of the rear left foot, with compensation", "front left and rear right carry most, with compensation",
    ],
}  # fmt: skip
#: Outcomes of one case, which a robot may have without its spine as well.
ONE_CASE = r"lifted, with |^end reached |^no box touched |followed, (leg|mix)-based$|^right turns"


def judged(outcome):
    return {figure.name: agrees(measured(outcome, figure, "exact"), figure) for figure in FIGURES[outcome.experiment]}


@pytest.mark.parametrize("experiment", WITH_SPINE)
def test_a_spine_with_the_published_effects_holds(experiment):
    """So that it is the missing effect, and nothing else, by which the next test's lines fail."""
    holds = judged(WITH_SPINE[experiment][0](1.0))
    assert {name for name in ABOUT_THE_SPINE[experiment] if not holds[name]} == set()


@pytest.mark.parametrize("experiment", WITH_SPINE)
def test_a_spine_that_does_nothing_fails_every_line_about_the_spine(experiment):
    make, has_spine = WITH_SPINE[experiment]
    nothing = make(0.0)
    holds = judged(nothing)
    assert {name for name in ABOUT_THE_SPINE[experiment] if holds[name]} == set()
    # And every other line that hangs on a case with the spine is a plain number, a bound, or the outcome of one case.
    rows = ~np.asarray(has_spine(nothing), bool)
    without = Outcome(experiment, {name: column[rows] for name, column in nothing.columns.items()}, {}, {})
    for figure in FIGURES[experiment]:
        plain = isinstance(figure.reported, (Number, AtMost)) or re.search(ONE_CASE, figure.name)
        if holds[figure.name] and not plain:
            alike = measured(without, figure, "exact")
            assert alike is not None, figure.name
            assert alike == pytest.approx(measured(nothing, figure, "exact")), figure.name
