# Tests of optimize/tuning_spec.py
"""Tuning files: what is read, and that everything wrong is refused with file, line, field and what is allowed."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from command import refused
from conftest import shared_simulator

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.optimize.tuning_run import tuning_forecasts
from nermo_mjx.rollout import Run
from nermo_mjx.sweep import SpecError

GOOD = """\
robot: nermo_lite
gait: trot
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
starts: 3
iterations: 20
seed: 1
"""
TUNE = GOOD[GOOD.index("tune:") : GOOD.index("objective:")]
OBJECTIVE = GOOD[GOOD.index("objective:") : GOOD.index("optimizer:")]
OPTIMIZER = GOOD[GOOD.index("optimizer:") : GOOD.index("starts:")]
AMPLITUDE = "{bounds: [0.0, 0.4], start: 0.05}"
PHASE = "{bounds: [-3.1416, 3.1416], start: 0.0, periodic: true}"
STRIDE = "stride: {bounds: [0.5, 1.0], start: 0.9}"
SPEED = "{maximize: speed, scale: 0.1}"
HOLD = "{hold: roll_std, at: 0.1, scale: 0.05, weight: 2}"
COSINE = "{cosine: {init_value: 0.1, decay_steps: 20}}"
#: The file from its pilot to its last parameter, and the same on an arc.
ARC = (GOOD[GOOD.index("pilot:") : GOOD.index("objective:")], "")
ARC = (ARC[0], ARC[0].replace("straight", "{arc: {radius: 0.5}}").replace("frequency: 0.8", "SET"))

SMALL = {"tune": {"duty": {"bounds": [0.4, 0.7]}}, "objective": [{"maximize": "speed"}]}
#: For each rule: what is replaced by what, and the line and the field of the message.
WRONG = [
    ("gait: trot", "gate: trot", 2, "gate"),
    ("set:", "duty: 0.5\nset:", 6, "duty"),
    ("seed: 1", "vary: {duty: [0.5]}", 20, "vary"),
    ("seed: 1", "gait: trot", 20, "gait"),
    ("spine.amplitude", "spine.amplitud", 8, "spine.amplitud"),
    (TUNE, "tune: {}\n", 7, "tune"),
    (AMPLITUDE, "0.2", 8, "spine.amplitude"),
    (AMPLITUDE, "{bound: [0, 0.4]}", 8, "tune.spine.amplitude.bound"),
    (AMPLITUDE, "{bounds: [0.4, 0.0], start: 0.05}", 8, "tune.spine.amplitude.bounds"),
    (AMPLITUDE, "{bounds: [0.0, 0.9]}", 8, "tune.spine.amplitude.bounds"),
    (AMPLITUDE, "{bounds: [0.4]}", 8, "tune.spine.amplitude.bounds"),
    (AMPLITUDE, "{bounds: [0, .nan]}", 8, "tune.spine.amplitude.bounds"),
    (AMPLITUDE, "{bounds: [0.0, 0.4], start: 0.5}", 8, "tune.spine.amplitude.start"),
    (AMPLITUDE, "{start: 0.7}", 8, "spine.amplitude"),
    (AMPLITUDE, "{bounds: [0.0, 0.3]}", 8, "spine.amplitude"),
    (PHASE, "{bounds: [-3, 3], start: 0, periodic: true}", 9, "tune.spine.phase.periodic"),
    (AMPLITUDE, "{bounds: [0.0, 0.4], periodic: true}", 8, "tune.spine.amplitude.periodic"),
    ("frequency: 0.8", "stride: 0.8", 10, "stride"),
    (
        ARC[0],
        ARC[1].replace("SET", "frequency: 0.8").replace("stride:", "pilot.radius:"),
        10,
        "pilot.radius",
    ),
    (ARC[0], ARC[1].replace("SET", "pilot.radius: 0.8"), 6, "pilot.radius"),
    ("spine: stride_extension", "spine: none", 8, "spine.amplitude"),
    (STRIDE, "speed: {bounds: [0, 1]}", 10, "speed"),
    (
        "set: {frequency: 0.8}\ntune:",
        "tune:\n  frequency: {bounds: [0.01, 1]}",
        7,
        "tune.frequency.bounds",
    ),
    (
        STRIDE,
        "stride: {bounds: [0.5, 1.2], start: 0.9}\n  stance.max_stride: {bounds: [0.05, 0.08]}",
        10,
        "stride",
    ),
    ("pilot: straight", "pilot: {straight: {distance: 2}}", 4, "pilot.straight.distance"),
    ("cycles: 6", "cycles: 2", 5, "run.warmup_cycles"),
    (OBJECTIVE, "", 1, "objective"),
    (SPEED, "speed", 12, "objective.0"),
    (SPEED, "{maximize: duration}", 12, "objective.0.maximize"),
    (SPEED, "{maximise: speed}", 12, "objective.0.maximise"),
    (SPEED, "{maximize: speed, minimize: slip}", 12, "objective.0"),
    (SPEED, "{weight: 1}", 12, "objective.0"),
    (SPEED, "{maximize: speed, weight: 0}", 12, "objective.0.weight"),
    (HOLD, "{hold: roll_std}", 13, "objective.1"),
    (SPEED, "{maximize: speed, at: 0.1}", 12, "objective.0.at"),
    (HOLD, "{maximize: speed}", 13, "objective.1"),
    (HOLD, "{minimize: trajectory_error}", 11, "objective"),
    ("seed: 1", "recording: s.yaml", 20, "recording"),
    ("seed: 1", "recording: nowhere.npz", 20, "recording"),
    ("name: adam", "name: adamm", 15, "optimizer.name"),
    (OPTIMIZER, "optimizer: [adam]\n", 14, "optimizer"),
    ("b1: 0.8", "b9: 0.8", 17, "optimizer.b9"),
    (COSINE, "{cosinus: {init_value: 1, decay_steps: 2}}", 16, "optimizer.learning_rate"),
    (", decay_steps: 20", "", 16, "optimizer.learning_rate"),
    ("b1: 0.8", "clip: -1", 17, "optimizer.clip"),
    ("iterations: 20", "iterations: 2.5", 19, "iterations"),
    ("starts: 3", "method: {cma: {population: 8}}", 18, "method"),
    ("starts: 3", "video: true", 18, "video"),
]


@pytest.mark.parametrize(("before", "after", "line", "field"), WRONG)
def test_a_wrong_file_is_refused_with_line_and_field(tmp_path, before, after, line, field):
    """Every mistake is one sentence about the line and the field; a misspelt name gets the right one."""
    assert before in GOOD
    path = tmp_path / "s.yaml"
    path.write_text(GOOD.replace(before, after, 1))
    with pytest.raises(SpecError) as caught:
        Tuning.from_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:{line}: field '{field}' "), message
    assert message[-1] in ".?"
    assert "\n" not in message
    misspelt = {"gate", "spine.amplitud", "objective.0.maximise", "optimizer.name"}
    assert ("did you mean" in message) or field not in misspelt, message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"method": "gradiant"},
            "field 'method' is 'gradiant': expected local_gradient or wide_differences .*",
        ),
        (
            {"method": "cma"},
            "field 'method' is 'cma', which was removed: run nermo-mjx search with method: cma.",
        ),
        (
            {"method": {"cma": {"population": 8}}},
            "is 'cma', which was removed: run nermo-mjx search with method: cma.",
        ),
        (
            {"video": True},
            "field 'video' was removed: run .* nermo-mjx replay RUNS --row 0 --video FILE.mp4.",
        ),
        (
            {"method": {"wide_differences": {"scheme": "left"}}},
            "is the text 'left': allowed are central, forward",
        ),
    ],
)
def test_what_a_method_cannot_use_is_said(change, message):
    with pytest.raises(SpecError, match=message):
        Tuning.from_dict(SMALL | change)


def test_a_refused_tuning_leaves_no_directory(tmp_path):
    """A wrong tuning is refused before anything is written."""
    with pytest.raises(SpecError, match="tuning: field 'frequenzy'"):
        run_tuning(
            {"tune": {"frequenzy": {}}, "objective": [{"maximize": "speed"}]}, tmp_path / "out"
        )
    assert not (tmp_path / "out").exists()


def test_all_sections_arrive():
    """Choices, bounds, starts, terms and optimizer are those of the file."""
    tuning = Tuning.from_text(GOOD)
    assert tuning.names == ("spine.amplitude", "spine.phase", "stride")
    assert tuning.setup.spine == "stride_extension"
    assert tuning.constants == {"frequency": 0.8}
    assert [(parameter.low, parameter.high) for parameter in tuning.tuned] == [
        (0, 0.4),
        (-math.pi, math.pi),
        (0.5, 1.0),
    ]
    assert tuning.objective.metrics == ("speed", "roll_std")
    assert (tuning.starts, tuning.iterations, tuning.seed) == (3, 20, 1)
    np.testing.assert_array_equal(tuning.bounds.periodic, [False, True, False])


def test_everything_but_parameters_and_objective_has_a_default():
    """Bounds are the declared range, the start is the published value, and no rate is to be chosen."""
    tuning = Tuning.from_dict(
        {
            "tune": {"duty": None, "frequency": {"bounds": [0.4, 1.2]}},
            "objective": [{"maximize": "speed"}],
        }
    )
    assert [(parameter.low, parameter.high, parameter.start) for parameter in tuning.tuned] == [
        (0.01, 1, 0.5),
        (0.4, 1.2, 0.67),
    ]
    assert tuning.optimizer.written() == {"name": "controlled_adam"}
    assert (tuning.starts, tuning.iterations) == (1, 40)
    assert tuning.plots


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"plots": False},
        {
            "pilot": {"arc": {"radius": 0.4, "direction": "right"}},
            "run": {"duration": 3},
            "optimizer": "sgd",
        },
        {
            "tune": {
                "offset.rear_left": {"periodic": True},
                "contact.friction": {"bounds": (0.7, 1.5)},
            }
        },
        {
            "objective": [
                {"hold": "speed", "at": 0.05, "weight": 10},
                {"minimize": "speed", "scale": 2},
            ]
        },
        {"method": "wide_differences"},
    ],
)
def test_the_resolved_file_reads_back_as_the_same_tuning(change):
    """tuning.yaml in a directory is enough to run the same tuning again."""
    tuning = Tuning.from_dict(
        {"tune": {"frequency": {"bounds": [0.4, 1.2]}}, "objective": SMALL["objective"]} | change
    )
    again = Tuning.from_text(tuning.to_yaml())
    assert again == tuning
    assert again.digest() == tuning.digest()
    assert ("method" in tuning.resolved()) == ("method" in change), (
        "what is not given is not written"
    )


def test_the_digest_tells_tunings_apart():
    """What changes an iteration counts; the number of iterations and figures do not, nor do removed fields."""
    digest = Tuning.from_dict(SMALL).digest()
    assert (
        Tuning.from_dict(SMALL | {"iterations": 90, "plots": False, "video": False}).digest()
        == digest
    )
    others = [
        {"seed": 1},
        {"starts": 2},
        {"gait": "lateral_walk"},
        {"optimizer": "sgd"},
        {"set": {"frequency": 0.8}},
        {"run": {"cycles": 9}},
        {"objective": [{"maximize": "speed", "weight": 2}]},
        {"tune": {"duty": {"bounds": [0.4, 0.8]}}},
        {"method": "wide_differences"},
    ]
    assert digest not in [Tuning.from_dict(SMALL | change).digest() for change in others]


@pytest.mark.parametrize(
    ("count", "name"),
    [(8, "local_gradient"), (9, "wide_differences"), (32, "wide_differences"), (33, None)],
)
def test_the_default_method_hangs_on_the_number_of_parameters(count, name):
    """What the rematch found (docs/benchmarks/rematch.md); it is not written to the resolved file."""
    names = [
        f"foot.{foot}.{axis}{i}"
        for foot in ("front", "rear", "front_left")
        for axis in "yz"
        for i in range(1, 9)
    ]
    tune = {each: {"bounds": [-0.01, 0.01]} for each in names[:count]}
    spec = {"tune": tune, "objective": SMALL["objective"], "trajectory": "free"}
    if name is None:
        with pytest.raises(
            SpecError, match=r"'method' is missing: with more than 32 .* search with method: cma"
        ):
            Tuning.from_dict(spec)
        spec |= {"method": "wide_differences"}
    tuning = Tuning.from_dict(spec)
    assert tuning.method.name == (name or "wide_differences")
    assert ("method" in tuning.resolved()) == (name is None)
    assert Tuning.from_text(tuning.to_yaml()) == tuning


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("gradient", {"local_gradient": {}}),
        ({"gradient": None}, {"local_gradient": {}}),
        (
            {"differences": {"step": 0.01}},
            {"wide_differences": {"scheme": "central", "step": 0.01}},
        ),
    ],
)
def test_a_former_name_of_a_method_is_read_with_a_warning(former, present):
    """A warning that is always shown, because users write these files."""
    tune = {
        f"foot.front.{axis}{i}": {"bounds": [-0.01, 0.01]} for axis in "yz" for i in range(1, 9)
    }
    spec = {
        "tune": tune,
        "objective": SMALL["objective"],
        "trajectory": "free",
    }  # neither is the default of 16
    (old,), (new,) = [former] if isinstance(former, str) else former, present
    with pytest.warns(
        FutureWarning, match=f"method: {old} is a former name, .*: use method: {new}.$"
    ):
        tuning = Tuning.from_dict(spec | {"method": former})
    assert tuning.resolved()["method"] == present
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Tuning.from_text(tuning.to_yaml()) == tuning
    with (
        pytest.warns(FutureWarning),
        pytest.raises(SpecError, match="field 'method' is the text 'left'"),
    ):
        Tuning.from_dict(spec | {"method": {"differences": {"scheme": "left"}}})


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
    np.testing.assert_array_equal(
        points[:5], Tuning.from_dict(tuning.resolved() | {"starts": 5}).start_points()
    )
    other_points = Tuning.from_dict(tuning.resolved() | {"seed": 2}).start_points()
    assert (points[1:] != other_points[1:]).any()


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


FILES = sorted(Path(__file__).parents[2].glob("sweeps/tune_*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_tunings_of_the_repository_are_valid(path):
    """Every shipped tuning file is read, and reads back from its resolved form."""
    tuning = Tuning.from_file(path)
    assert Tuning.from_text(tuning.to_yaml()) == tuning


@pytest.mark.release
def test_a_dry_run_refuses_the_recording_that_the_run_refuses(tmp_path: Path) -> None:
    shared_simulator(engine="c").run({}, Run(duration=0.2), record=True).recording().save(
        tmp_path / "short.npz"
    )
    (tmp_path / "text.npz").write_text("no recording")
    for name, message in (
        ("short.npz", "expected all of the run, from its start to 1 s"),
        ("text.npz", "recording is"),
    ):
        tuning = {
            "objective": [{"minimize": "trajectory_error"}],
            "recording": str(tmp_path / name),
            "run": {"duration": 1.0},
            "tune": {"stride": {"bounds": [0.5, 1.0]}},
        }
        refused(lambda spec=tuning: tuning_forecasts(Tuning.from_dict(spec)), message)
