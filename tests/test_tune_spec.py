"""Tuning files: what is read, and that everything wrong is refused with file, line, field and what is allowed."""

import math
from pathlib import Path

import numpy as np
import pytest

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.sweep import SpecError

GOOD = """\
robot: nermo_lite
gait: trt
spine: stride_extension
pilot: straight
run: {cycles: 6, warmup_cycles: 2}
set: {frequency: 0.8}
tune:
  spine.amplitude: {bounds: [0.0, 0.4], start: 0.05}
  spine.phase: {bounds: [-3.1416, 3.1416], start: 0.0, periodic: true}
  stride: {bounds: [0.5, 1.0], start: 0.9}
objective:
- {maximize: speed, scale: 0.1}
- {hold: roll_std, at: 0.1, scale: 0.05, weight: 2}
optimizer:
  name: adam
  learning_rate: {cosine: {init_value: 0.1, decay_steps: 20}}
  b1: 0.8
estimator: {mixture: {samples: 8, sigma: 0.1}}
starts: 3
iterations: 20
seed: 1
mode: forward
"""
TUNE = GOOD[GOOD.index("tune:") : GOOD.index("objective:")]
OBJECTIVE = GOOD[GOOD.index("objective:") : GOOD.index("optimizer:")]
OPTIMIZER = GOOD[GOOD.index("optimizer:") : GOOD.index("estimator:")]
AMPLITUDE = "{bounds: [0.0, 0.4], start: 0.05}"
PHASE = "{bounds: [-3.1416, 3.1416], start: 0.0, periodic: true}"
STRIDE = "stride: {bounds: [0.5, 1.0], start: 0.9}"
SPEED = "{maximize: speed, scale: 0.1}"
HOLD = "{hold: roll_std, at: 0.1, scale: 0.05, weight: 2}"
MIXTURE = "{mixture: {samples: 8, sigma: 0.1}}"
COSINE = "{cosine: {init_value: 0.1, decay_steps: 20}}"

#: What is replaced by what, the line of the message, and what it must say.
WRONG = {
    "unknown field": ("gait: trt", "gate: trt", 2, ["'gate' is not a field", "did you mean 'gait'?"]),
    "parameter as field": ("set:", "duty: 0.5\nset:", 6, ["'duty' is a parameter", "'tune' or 'set'"]),
    "sweep's field": ("mode: forward", "vary: {duty: [0.5]}", 22, ["'vary' is a field of a sweep", "'tune'"]),
    "unknown gait": ("gait: trt", "gait: trot", 2, ["'gait' is 'trot'", "did you mean 'trt'?"]),
    "unknown parameter": (
        "spine.amplitude",
        "spine.amplitud",
        8,
        ["is not a parameter", "did you mean 'spine.amplitude'?"],
    ),
    "nothing tuned": (TUNE, "tune: {}\n", 7, ["'tune' is missing or empty"]),
    "tune is a list": (TUNE, "tune: [duty]\n", 7, ["expected a mapping"]),
    "parameter is a number": (AMPLITUDE, "0.2", 8, ["'spine.amplitude' is the number 0.2", "bounds: [low, high]"]),
    "parameter's field": (
        AMPLITUDE,
        "{bound: [0, 0.4]}",
        8,
        ["'tune.spine.amplitude.bound'", "did you mean 'bounds'?"],
    ),
    "bounds reversed": (AMPLITUDE, "{bounds: [0.4, 0.0], start: 0.05}", 8, ["[0.4, 0]", "the lower one comes first"]),
    "bounds alike": (AMPLITUDE, "{bounds: [0.4, 0.4], start: 0.4}", 8, ["the lower one comes first"]),
    "bounds out of range": (AMPLITUDE, "{bounds: [0.0, 0.9]}", 8, ["the bound 0.9: allowed is [0, 0.6] rad"]),
    "one bound": (AMPLITUDE, "{bounds: [0.4]}", 8, ["the list [0.4]: expected the list [low, high]"]),
    "bounds are text": (AMPLITUDE, "{bounds: [0, much]}", 8, ["the text 'much': expected a number"]),
    "bounds are NaN": (AMPLITUDE, "{bounds: [0, .nan]}", 8, ["finite"]),
    "start out of bounds": (
        AMPLITUDE,
        "{bounds: [0.0, 0.4], start: 0.5}",
        8,
        ["start' is 0.5", "within the bounds, [0, 0.4]"],
    ),
    "start out of range": (AMPLITUDE, "{start: 0.7}", 8, ["'spine.amplitude' is 0.7: allowed is [0, 0.6] rad"]),
    "start is NaN": (AMPLITUDE, "{start: .nan}", 8, ["is nan"]),
    "start is text": (AMPLITUDE, "{start: low}", 8, ["the text 'low'"]),
    "default out of bounds": (AMPLITUDE, "{bounds: [0.0, 0.3]}", 8, ["its default 0.4 is outside", "give a start"]),
    "period missed": (PHASE, "{bounds: [-3, 3], start: 0, periodic: true}", 9, ["not one period of 6.2832 apart"]),
    "not periodic": (AMPLITUDE, "{bounds: [0.0, 0.4], periodic: true}", 8, ["does not come back", "spine.phase"]),
    "periodic is text": (PHASE, "{periodic: often}", 9, ["expected true or false"]),
    "tuned and set": (
        "frequency: 0.8",
        "stride: 0.8",
        10,
        ["'stride' is under 'tune' and also fixed under 'set'", "one source"],
    ),
    "tuned and set by the pilot": (
        STRIDE + "\n",
        "pilot.radius: {bounds: [0.3, 1]}\n",
        10,
        ["'pilot.radius' is under 'tune' and also set by 'pilot.arc'"],
    ),
    "set by the pilot too": (
        "set: {frequency: 0.8}",
        "set: {pilot.radius: 0.8}",
        6,
        ["also set by 'pilot.arc.radius'"],
    ),
    "no effect": ("spine: stride_extension", "spine: none", 8, ["'spine.amplitude' has no effect", "stride_extension"]),
    "a metric's name": (STRIDE, "speed: {bounds: [0, 1]}", 10, ["'speed' cannot be tuned", "a metric's"]),
    "slow frequency": (
        "set: {frequency: 0.8}\ntune:",
        "tune:\n  frequency: {bounds: [0.01, 1]}",
        7,
        ["begins at 0.01 Hz", "600 s", "0.05 Hz or more", "duration"],
    ),
    "no frequency": ("set: {frequency: 0.8}\ntune:", "tune:\n  frequency:", 7, ["would never end"]),
    "stride past workspace": (
        STRIDE,
        "stride: {bounds: [0.5, 1.2], start: 0.9}\n  stance.max_stride: {bounds: [0.05, 0.08]}",
        10,
        ["'stride' is 1.2", "reach a stride of"],
    ),
    "pilot's distance": (
        "pilot: straight",
        "pilot: {straight: {distance: 2}}",
        4,
        ["'pilot.straight.distance'", "no derivative"],
    ),
    "warm-up too long": ("cycles: 6", "cycles: 2", 5, ["'run.warmup_cycles' is 2", "less than"]),
    "no objective": (OBJECTIVE, "", 1, ["'objective' is missing"]),
    "objective is a name": (
        OBJECTIVE,
        "objective: speed\n",
        11,
        ["'objective' is the text 'speed'", "expected a list"],
    ),
    "term is a name": (SPEED, "speed", 12, ["'objective.0' is the text 'speed'"]),
    "unknown metric": (SPEED, "{maximize: sped}", 12, ["is the text 'sped'", "did you mean 'speed'?"]),
    "metric without aim": (SPEED, "{maximize: duration}", 12, ["is the text 'duration'", "allowed are speed,"]),
    "metric is a list": (SPEED, "{maximize: [speed]}", 12, ["is the list ['speed']"]),
    "unknown aim": (SPEED, "{maximise: speed}", 12, ["did you mean 'maximize'?"]),
    "two aims": (SPEED, "{maximize: speed, minimize: slip}", 12, ["expected one of maximize, minimize, hold"]),
    "weight is zero": (SPEED, "{maximize: speed, weight: 0}", 12, ["weight' is 0: expected a finite number above 0"]),
    "scale is text": (SPEED, "{maximize: speed, scale: big}", 12, ["the text 'big'"]),
    "hold without at": (HOLD, "{hold: roll_std}", 13, ["holds roll_std without 'at'"]),
    "at without hold": (SPEED, "{maximize: speed, at: 0.1}", 12, ["'objective.0.at' is not a field"]),
    "term twice": (HOLD, "{maximize: speed}", 13, ["'maximize: speed' again"]),
    "no recording": (HOLD, "{minimize: trajectory_error}", 11, ["there is no 'recording'"]),
    "recording unread": ("mode: forward", "recording: s.yaml", 22, ["is not read", "trajectory_error"]),
    "recording missing": ("mode: forward", "recording: nowhere.npz", 22, ["there is no file"]),
    "recording is a number": ("mode: forward", "recording: 3", 22, ["expected the path"]),
    "unknown optimizer": ("name: adam", "name: adamm", 15, ["'optimizer.name' is 'adamm'", "did you mean 'adam'?"]),
    "optimizer is a list": (OPTIMIZER, "optimizer: [adam]\n", 14, ["'optimizer' is the list ['adam']"]),
    "optimizer's name": ("name: adam", "name: 3", 15, ["'optimizer.name' is the number 3"]),
    "optimizer that needs more": ("name: adam", "name: lbfgs", 17, ["'optimizer.b1' is not an option of lbfgs"]),
    "unknown option": ("b1: 0.8", "b9: 0.8", 17, ["'optimizer.b9' is not an option of adam"]),
    "option is a list": ("b1: 0.8", "b1: [0.8]", 17, ["'optimizer.b1' is the list [0.8]"]),
    "learning rate is text": (COSINE, "fast", 16, ["'optimizer.learning_rate' is the text 'fast'"]),
    "learning rate below 0": (COSINE, "-0.1", 16, ["'optimizer.learning_rate' is -0.1", "above 0"]),
    "unknown schedule": (
        COSINE,
        "{cosinus: {init_value: 1, decay_steps: 2}}",
        16,
        ["the schedule 'cosinus'", "allowed are"],
    ),
    "schedule's option": ("decay_steps: 20", "decay_step: 20", 16, ["did you mean 'decay_steps'?"]),
    "schedule without option": (", decay_steps: 20", "", 16, ["cosine_decay_schedule without decay_steps"]),
    "clip": ("b1: 0.8", "clip: {a: 1}", 17, ["'optimizer.clip' is a mapping"]),
    "clip below 0": ("b1: 0.8", "clip: -1", 17, ["'optimizer.clip' is -1"]),
    "unknown estimator": (MIXTURE, "exakt", 18, ["'estimator' is 'exakt'", "did you mean 'exact'?"]),
    "misspelt estimator": (MIXTURE, "{mixtur: {samples: 8, sigma: 0.1}}", 18, ["did you mean 'mixture'?"]),
    "estimator without options": (MIXTURE, "mixture", 18, ["without samples and sigma"]),
    "estimator is a list": (MIXTURE, "[mixture]", 18, ["is the list ['mixture']"]),
    "estimator's options": (MIXTURE, "{mixture: 8}", 18, ["is the number 8: expected a mapping of samples, sigma"]),
    "estimator's option": ("sigma: 0.1", "sigmas: 0.1", 18, ["did you mean 'sigma'?"]),
    "exact has no options": (MIXTURE, "{exact: {samples: 2}}", 18, ["not an option of 'exact'; it has none"]),
    "samples missing": (MIXTURE, "{smoothed: {sigma: 0.1}}", 18, ["has no 'samples'"]),
    "odd samples": ("samples: 8", "samples: 7", 18, ["expected an even number", "pairs"]),
    "too few samples": ("samples: 8", "samples: 2", 18, ["samples' is 2: expected a whole number from 4"]),
    "sigma": ("sigma: 0.1", "sigma: 0", 18, ["sigma' is 0: expected a finite number above 0"]),
    "gamma": ("sigma: 0.1", "sigma: 0.1, gamma: -1", 18, ["gamma' is -1"]),
    "common": ("sigma: 0.1", "sigma: 0.1, common: start", 18, ["did you mean 'starts'?"]),
    "no starts": ("starts: 3", "starts: 0", 19, ["'starts' is 0: expected a whole number"]),
    "iterations": ("iterations: 20", "iterations: 2.5", 20, ["'iterations' is 2.5"]),
    "seed": ("seed: 1", "seed: -1", 21, ["'seed' is -1"]),
    "mode": ("mode: forward", "mode: revers", 22, ["'mode' is the text 'revers'", "did you mean 'reverse'?"]),
    "mode is a list": ("mode: forward", "mode: [forward]", 22, ["'mode' is the list"]),
    "plots": ("mode: forward", "plots: 3", 22, ["'plots' is the number 3: expected true or false"]),
    "video": ("mode: forward", "video: 3", 22, ["'video' is the number 3: expected true or false"]),
    "duplicate key": ("mode: forward", "gait: trt", 22, ["'gait' stands twice"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_line_field_and_remedy(tmp_path, case):
    """Every mistake is one sentence: file:line, the field, its value, what is allowed, the nearest name."""
    before, after, line, parts = WRONG[case]
    assert GOOD.count(before) >= 1
    text = GOOD.replace(before, after, 1)
    if "pilot.arc" in "".join(parts):
        text = text.replace("pilot: straight", "pilot: {arc: {radius: 0.5}}")
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(SpecError) as caught:
        Tuning.from_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:{line}: "), message
    assert [part for part in parts if part not in message] == [], message
    assert "\n" not in message
    assert message[-1] in ".?"


def test_a_refused_tuning_leaves_no_directory(tmp_path):
    """A wrong tuning is refused before anything is written."""
    with pytest.raises(SpecError, match="tuning: field 'frequenzy'"):
        run_tuning({"tune": {"frequenzy": {}}, "objective": [{"maximize": "speed"}]}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_all_sections_arrive():
    """Choices, bounds, starts, terms, optimizer and estimator are those of the file."""
    tuning = Tuning.from_text(GOOD)
    assert tuning.names == ("spine.amplitude", "spine.phase", "stride")
    assert tuning.setup.spine == "stride_extension"
    assert tuning.constants == {"frequency": 0.8}
    assert [(each.low, each.high) for each in tuning.tuned] == [(0, 0.4), (-math.pi, math.pi), (0.5, 1.0)]
    assert tuning.objective.metrics == ("speed", "roll_std")
    assert (tuning.estimator.name, tuning.estimator.worlds) == ("mixture", 9)
    assert (tuning.starts, tuning.iterations, tuning.seed, tuning.mode) == (3, 20, 1, "forward")
    np.testing.assert_array_equal(tuning.bounds.periodic, [False, True, False])


def test_everything_but_parameters_and_objective_has_a_default():
    """Bounds are the declared range, the start is the published value, and no rate is to be chosen."""
    tuning = Tuning.from_dict({"tune": {"duty": None, "frequency": {"bounds": [0.4, 1.2]}},
                               "objective": [{"maximize": "speed"}]})  # fmt: skip
    assert [(each.low, each.high, each.start) for each in tuning.tuned] == [(0, 1, 0.5), (0.4, 1.2, 0.67)]
    assert tuning.optimizer.written() == {"name": "controlled_adam"}
    assert (tuning.estimator.name, tuning.starts, tuning.iterations, tuning.mode) == ("exact", 1, 40, "auto")
    assert (tuning.plots, tuning.video) == (True, False)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"estimator": {"evolution": {"samples": 6, "sigma": 0.2, "common": "both"}}, "plots": False, "video": True},
        {"pilot": {"arc": {"radius": 0.4, "direction": "right"}}, "run": {"duration": 3}, "optimizer": "sgd"},
        {"tune": {"offset.rear_left": {"periodic": True}, "contact.friction": {"bounds": (0.7, 1.5)}}},
        {"objective": [{"hold": "speed", "at": 0.05, "weight": 10}, {"minimize": "speed", "scale": 2}]},
    ],
)
def test_the_resolved_file_reads_back_as_the_same_tuning(change):
    """tuning.yaml in a directory is enough to run the same tuning again."""
    tuning = Tuning.from_dict(
        {"tune": {"frequency": {"bounds": [0.4, 1.2]}}, "objective": [{"maximize": "speed"}], **change}
    )
    again = Tuning.from_text(tuning.to_yaml())
    assert again == tuning
    assert again.digest() == tuning.digest()


def test_the_digest_tells_tunings_apart():
    """What changes an iteration counts; the number of iterations, figures and video do not."""
    base = {"tune": {"duty": {"bounds": [0.4, 0.7]}}, "objective": [{"maximize": "speed"}]}
    digest = Tuning.from_dict(base).digest()
    assert Tuning.from_dict(base | {"iterations": 90, "plots": False, "video": True}).digest() == digest
    others = [
        {"seed": 1},
        {"starts": 2},
        {"mode": "reverse"},
        {"gait": "lat"},
        {"optimizer": "sgd"},
        {"set": {"frequency": 0.8}},
        {"run": {"cycles": 9}},
        {"objective": [{"maximize": "speed", "weight": 2}]},
        {"tune": {"duty": {"bounds": [0.4, 0.8]}}},
        {"estimator": {"smoothed": {"samples": 8, "sigma": 0.1}}},
    ]
    assert digest not in [Tuning.from_dict(base | other).digest() for other in others]


def test_starts_are_drawn_within_the_bounds():
    """The first is the given one; the others are Sobol points of the seed, the same whenever they are asked for."""
    tuning = Tuning.from_dict(Tuning.from_text(GOOD).resolved() | {"starts": 64})
    points = tuning.start_points()
    assert points.shape == (64, 3)
    np.testing.assert_array_equal(points[0], [0.05, 0.0, 0.9])
    assert ((points >= tuning.bounds.low) & (points <= tuning.bounds.high)).all()
    share = (points[1:] - tuning.bounds.low) / (tuning.bounds.high - tuning.bounds.low)
    assert np.abs(share.mean(axis=0) - 0.5).max() < 0.02  # far evener than 63 independent draws
    np.testing.assert_array_equal(points, tuning.start_points())
    np.testing.assert_array_equal(points[:5], Tuning.from_dict(tuning.resolved() | {"starts": 5}).start_points())
    other = Tuning.from_dict(tuning.resolved() | {"seed": 2}).start_points()
    assert (points[1:] != other[1:]).any()


def test_a_recording_counts_from_the_file_and_by_its_content(tmp_path):
    """Its path is relative to the tuning's file; another content is another tuning, another place is not."""
    (tmp_path / "walk.npz").write_bytes(b"one")
    text = "tune: {duty: {bounds: [0.4, 0.7]}}\nobjective: [{minimize: trajectory_error}]\nrecording: walk.npz\n"
    (tmp_path / "s.yaml").write_text(text)
    tuning = Tuning.from_file(tmp_path / "s.yaml")
    assert tuning.recording == tmp_path / "walk.npz"
    assert Tuning.from_text(tuning.to_yaml()).digest() == tuning.digest()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "s.yaml").write_text(text)
    (tmp_path / "elsewhere" / "walk.npz").write_bytes(b"one")
    assert Tuning.from_file(tmp_path / "elsewhere" / "s.yaml").digest() == tuning.digest()
    before = tuning.digest()
    (tmp_path / "walk.npz").write_bytes(b"two")
    assert tuning.digest() != before


FILES = sorted(Path(__file__).parents[1].glob("sweeps/tune_*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_tunings_of_the_repository_are_valid(path):
    """Every shipped tuning file is read, and reads back from its resolved form."""
    tuning = Tuning.from_file(path)
    assert Tuning.from_text(tuning.to_yaml()) == tuning
