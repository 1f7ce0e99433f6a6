# Tests of sweep/spec.py
"""Sweep files: what is read, and that everything wrong is refused with file, line, field and what is allowed."""

import numpy as np
import pytest
from command import refused

from nermo_mjx import all_metrics, all_parameters
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout.setup import RESERVED_NAMES
from nermo_mjx.sweep import SpecError, Sweep, run_sweep

GOOD = """\
robot: nermo_lite
scene: flat
gait: trot
spine: stride_extension
pilot: {straight: {distance: 2.0}}
run: {cycles: 8, warmup_cycles: 2}
set: {duty: 0.55}
vary:
  frequency: {linspace: [0.4, 1.2, 9]}
  spine.amplitude: {values: [0.0, 0.2, 0.4]}
  spine.phase: {linspace: [-3.1416, 3.1416, 13]}
sample: grid
randomize: {repeats: 3, contact.friction: {uniform: [1.0, 1.6]}}
"""
SCENE = '<mujoco model="step"><worldbody><geom name="floor" type="plane" size="5 5 1"/></worldbody></mujoco>'
WAY, ARC = [[0, 0], [0, -0.5], [0.3, -1]], {"arc": {"radius": 0.5, "direction": "left"}}
FREQUENCY = "{linspace: [0.4, 1.2, 9]}"
FRICTION = "contact.friction: {uniform: [1.0, 1.6]}"
RUN = "{cycles: 8, warmup_cycles: 2}"
STRAIGHT = "straight: {distance: 2.0}"

#: What is replaced by what, the line of the message, and what it must say.
WRONG = {
    "unknown field": (
        "gait: trot",
        "gate: trot",
        3,
        ["'gate' is not a field", "robot, scene", "did you mean 'gait'?"],
    ),
    "parameter as field": (
        "set:",
        "duty: 0.5\nset:",
        7,
        ["'duty' is a parameter", "'vary', 'set'"],
    ),
    "unknown parameter": (
        "spine.amplitude",
        "spine.amplitud",
        10,
        ["are spine.amplitude", "'spine.amplitude'?"],
    ),
    "parameter without group": (
        "spine.amplitude",
        "amplitude",
        10,
        ["spine.*", "did you mean 'spine.amplitude'?"],
    ),
    "unknown randomized": (
        FRICTION,
        "contact.fraction: {uniform: [1, 2]}",
        13,
        ["did you mean 'contact.friction'?"],
    ),
    "wrong type": ("duty: 0.55", "duty: half", 7, ["'duty' is the text 'half': expected a number"]),
    "truth value": ("duty: 0.55", "duty: true", 7, ["'duty' is the truth value true"]),
    "set is a list": (
        "{duty: 0.55}",
        "[0.55]",
        7,
        ["'set' is the list [0.55]: expected a mapping"],
    ),
    "set out of range": ("duty: 0.55", "duty: 1.5", 7, ["'duty' is 1.5: allowed is [0.01, 1)"]),
    "vary is a number": (
        FREQUENCY,
        "0.5",
        9,
        ["'frequency' is the number 0.5", "linspace", "under 'set'"],
    ),
    "vary out of range": (
        "[0.0, 0.2, 0.4]",
        "[0.0, 0.9]",
        10,
        ["'spine.amplitude' is 0.9: allowed is [0, 0.6] rad"],
    ),
    "linspace out of range": (
        FREQUENCY,
        "{linspace: [0.0, 1.2, 9]}",
        9,
        ["'frequency' is 0: allowed is [0.001, 5] Hz"],
    ),
    "NaN": ("[0.4, 1.2, 9]", "[.nan, 1.2, 9]", 9, ["'frequency' is nan"]),
    "text in a list": (
        "[0.0, 0.2, 0.4]",
        "[0.0, much]",
        10,
        ["'spine.amplitude' is the text 'much'"],
    ),
    "empty list": ("{values: [0.0, 0.2, 0.4]}", "[]", 10, ["empty list, so the grid is empty"]),
    "count zero": ("1.2, 9]", "1.2, 0]", 9, ["count 0, so the grid is empty"]),
    "count missing": (
        "1.2, 9]",
        "1.2]",
        9,
        ["linspace with 2 numbers: expected [from, to, count]"],
    ),
    "repeated value": ("[0.0, 0.2, 0.4]", "[0.0, 0.2, 0.2]", 10, ["lists 0.2 twice"]),
    "span of zero": ("[0.4, 1.2, 9]", "[0.4, 0.4, 9]", 9, ["the same value"]),
    "logspace of zero": (
        "{values: [0.0, 0.2, 0.4]}",
        "{logspace: [0, 0.4, 3]}",
        10,
        ["not exponents"],
    ),
    "unknown form": (
        "{linspace: [0.4",
        "{linspce: [0.4",
        9,
        ["the form 'linspce'", "did you mean 'linspace'?"],
    ),
    "uniform on a grid": (FREQUENCY, "{uniform: [0.4, 1.2]}", 9, ["a grid cannot list", "sobol"]),
    "nothing varied": (GOOD[GOOD.index("vary:") :], "vary: {}\n", 8, ["nothing to sweep"]),
    "too many": ("1.2, 9]", "1.2, 900000]", 8, ["105,300,000 runs", "a sampler"]),
    "unknown gait": (
        "gait: trot",
        "gait: trtt",
        3,
        ["'gait' is 'trtt'", "did you mean 'trot'?", "lateral_walk"],
    ),
    "unknown pilot": (
        STRAIGHT,
        "strait: {distance: 2.0}",
        5,
        ["'pilot' is 'strait'", "did you mean 'straight'?"],
    ),
    "pilot from Python": (f"{{{STRAIGHT}}}", "external", 5, ["from Python"]),
    "gait is a number": ("gait: trot", "gait: 3", 3, ["'gait' is the number 3: expected a name"]),
    "time step": ("scene: flat", "timestep: 0.0", 2, ["'timestep' is 0.0"]),
    "pilot's option": (
        "distance: 2.0",
        "distanc: 2.0",
        5,
        ["not an option of the pilot 'straight'", "'distance'?"],
    ),
    "pilot's distance": ("distance: 2.0", "distance: -2.0", 5, ["distance' is -2.0"]),
    "pilot's radius": (
        STRAIGHT,
        "arc: {radius: 0.001}",
        5,
        ["'pilot.radius' is 0.001: allowed is [0.05"],
    ),
    "unknown sampler": (
        "sample: grid",
        "sample: random",
        12,
        ["'sample' is the text 'random'", "latin_hypercube"],
    ),
    "misspelt sampler": (
        "sample: grid",
        "sample: {sobl: 64}",
        12,
        ["'sample.sobl'", "did you mean 'sobol'?"],
    ),
    "sampler without size": (
        "sample: grid",
        "sample: sobol",
        12,
        ["'sobol' without its value", "{sobol: N}"],
    ),
    "broken sample size": (
        "sample: grid",
        "sample: {sobol: 0}",
        12,
        ["'sample.sobol' is 0: expected a whole number"],
    ),
    "unknown bodies": (
        FRICTION,
        "from: identifed",
        13,
        ["'randomize.from' is the text 'identifed'", "'identified'?"],
    ),
    "body's parameter drawn": (
        FRICTION,
        f"from: identified, {FRICTION}",
        13,
        ["also drawn by 'randomize.from'"],
    ),
    "body's parameter set": (
        GOOD[GOOD.index("set:") :],
        "set: {servo.kp: 5.0}\nrandomize: {from: identified}\n",
        7,
        ["also drawn by"],
    ),
    "no repeats": ("repeats: 3", "repeats: 0", 13, ["'randomize.repeats' is 0"]),
    "draw out of range": (
        "[1.0, 1.6]",
        "[1.0, 16]",
        13,
        ["'contact.friction' is 16: allowed is [0.05, 5]"],
    ),
    "draw upside down": ("[1.0, 1.6]", "[1.6, 1.0]", 13, ["the lower one comes first"]),
    "no spread": ("uniform: [1.0, 1.6]", "normal: [1.0, 0]", 13, ["standard deviation 0"]),
    "varied and randomized": (
        FRICTION,
        "frequency: {uniform: [0.5, 0.6]}",
        13,
        ["'randomize' and also under 'vary'"],
    ),
    "varied and set": (
        "duty: 0.55",
        "frequency: 0.5",
        9,
        ["under 'vary' and also fixed under 'set'"],
    ),
    "set by the pilot too": (
        GOOD[GOOD.index("pilot:") : GOOD.index("vary:")],
        "pilot: {arc: {radius: 0.5}}\nset: {pilot.radius: 0.4}\n",
        6,
        ["'pilot.radius'", "one source"],
    ),
    "no effect": (
        "spine: stride_extension",
        "spine: none",
        10,
        ["'spine.amplitude' has no effect"],
    ),
    "warm-up too long": (
        RUN,
        "{cycles: 2, warmup_cycles: 2}",
        6,
        ["'run.warmup_cycles' is 2", "less than"],
    ),
    "two lengths": (RUN, "{cycles: 2, duration: 3}", 6, ["'run.duration'", "either"]),
    "unknown run field": (RUN, "{cycels: 2}", 6, ["'run.cycels'", "did you mean 'cycles'?"]),
    "stride past workspace": (
        FREQUENCY,
        "[0.5]\n  stance.max_stride: [0.08]\n  stride: [1.0, 1.2]",
        11,
        ["'stride' is 1.2", "a stride of"],
    ),
    "seed": ("sample: grid", "seed: -1", 12, ["'seed' is -1"]),
    "chunk": ("sample: grid", "chunk: 0", 12, ["'chunk' is 0"]),
    "plots": ("sample: grid", "plots: 3", 12, ["'plots' is the number 3: expected true or false"]),
    "duplicate key": ("sample: grid", "gait: trot", 12, ["'gait' stands twice"]),
    "YAML syntax": ("[0.4, 1.2, 9]", "[0.4, 1.2, 9", 9, ["not valid YAML"]),
    "not a mapping": (GOOD, "- 1\n- 2\n", 1, ["mapping of fields", "the list [1, 2]"]),
    "empty file": (GOOD, "", 1, ["mapping of fields", "nothing"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_line_field_and_remedy(tmp_path, case):
    """Every mistake is one sentence: file:line, the field, its value, what is allowed, the nearest name."""
    before, after, line, parts = WRONG[case]
    assert GOOD.count(before) >= 1
    path = tmp_path / "s.yaml"
    path.write_text(GOOD.replace(before, after, 1))
    with pytest.raises(SpecError) as caught:
        Sweep.from_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:{line}: "), message
    assert [part for part in parts if part not in message] == [], message
    assert "\n" not in message
    assert message[-1] in ".?"


def test_a_refused_sweep_leaves_no_directory(tmp_path):
    """A wrong sweep is refused before anything is written."""
    with pytest.raises(SpecError, match="sweep: field 'frequenzy'"):
        run_sweep({"vary": {"frequenzy": [0.5]}}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "cannot be read"),
        (lambda path: path.write_bytes(b"gait: \xff\xfe"), "UTF-8"),
    ],
)
def test_a_file_that_cannot_be_read_is_a_spec_error(tmp_path, make, message):
    """A missing file, a directory and a binary file are refused in words, not with a traceback's error."""
    make(tmp_path / "s.yaml")
    with pytest.raises(SpecError, match=message):
        Sweep.from_file(tmp_path / "s.yaml")


def test_spec_errors_are_parameter_errors():
    """Whoever catches the package's ParameterError catches a wrong sweep too."""
    with pytest.raises(ParameterError, match=r"sweep: field 'gait' is 'hop'"):
        Sweep.from_dict({"gait": "hop", "vary": {"frequency": [0.5]}})


def test_the_example_of_the_interface_is_read():
    """All sections arrive: choices, run, fixed values, axes in the order of the file, draws and repeats."""
    sweep = Sweep.from_text(GOOD)
    assert (sweep.setup.gait, sweep.setup.spine, sweep.setup.pilot) == (
        "trot",
        "stride_extension",
        "straight",
    )
    assert (sweep.run.cycles, sweep.run.warmup_cycles, sweep.run.distance) == (8, 2, 2.0)
    assert [axis.name for axis in sweep.axes] == ["frequency", "spine.amplitude", "spine.phase"]
    np.testing.assert_array_equal(
        sweep.axes[0].listed(), [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2]
    )
    assert sweep.variants == 9 * 3 * 13
    assert sweep.repeats == 3
    assert sweep.constants == {"duty": 0.55}


def test_repeats_perturb_the_start_and_a_single_run_does_not():
    """Repeats differ by a millimetre, a degree and a phase, unless the file places the start itself."""
    once = {"vary": {"frequency": [0.5]}, "randomize": {"contact.friction": {"uniform": [1, 2]}}}
    assert [draw.name for draw in Sweep.from_dict(once).draws] == ["contact.friction"]
    thrice = {"vary": {"frequency": [0.5]}, "randomize": {"repeats": 3}, "set": {"start.yaw": 0.1}}
    draws = {draw.name: draw.numbers for draw in Sweep.from_dict(thrice).draws}
    assert set(draws) == {"start.x", "start.y", "start.phase"}
    assert draws["start.x"] == (-1e-3, 1e-3)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"sample": {"sobol": 64}, "seed": 7, "chunk": 16, "plots": False},
        {"pilot": {"arc": {"radius": 0.4, "direction": "right"}}, "run": {"duration": 3}},
        {
            "pilot": {"open_loop": {"turn_rate": 0.3}},
            "run": {"cycles": 1},
            "tail": "articulated",
            "cone": "pyramidal",
        },
        {"randomize": {"repeats": 2, "mass.front": {"normal": [0.16, 0.01]}}},
        {"randomize": {"repeats": 3, "from": "identified", "mass.front": {"normal": [0.16, 0.01]}}},
        {"vary": {"contact.friction": {"logspace": [0.1, 1.0, 4]}, "contact.width": [1e-5, 1e-4]}},
        {
            "vary": {
                "gait": ["trot", "lateral_walk"],
                "spine": ["none", "stride_extension"],
                "spine.amplitude": [0.1, 0.2],
            }
        },
        {"vary": {"scene": ["flat", SCENE], "frequency": [0.5]}},
        {
            "vary": {
                "pilot": ["straight", {"waypoints": {"points": WAY}}, ARC],
                "robot": ["nermo_lite"],
            }
        },
        {"vary": {"physics": ["reference", "fast"], "steering": {"values": ["leg", "spine"]}}},
        {"vary": {"profile": ["exact", "as_published"], "routing": ["type1", "type3"]}},
    ],
)
def test_the_resolved_file_reads_back_as_the_same_sweep(change):
    """sweep.yaml in a result directory is enough to run the same sweep again."""
    sweep = Sweep.from_dict({"vary": {"frequency": {"linspace": [0.4, 1.2, 5]}}, **change})
    again = Sweep.from_text(sweep.to_yaml())
    assert again == sweep
    assert again.digest() == sweep.digest()


def test_the_digest_tells_sweeps_apart():
    """Chunks and figures do not change which sweep it is; a value, a seed or the order of the axes does."""
    base = {"vary": {"frequency": [0.5, 0.6], "duty": [0.5, 0.6]}}
    digest = Sweep.from_dict(base).digest()
    assert Sweep.from_dict(base | {"chunk": 3, "plots": False}).digest() == digest
    others = [
        {"seed": 1},
        {"gait": "lateral_walk"},
        {"run": {"cycles": 9}},
        {"vary": {"duty": [0.5, 0.6], "frequency": [0.5, 0.6]}},
    ]
    assert digest not in [Sweep.from_dict(base | change).digest() for change in others]


def test_bodies_are_part_of_what_a_sweep_is(monkeypatch):
    """Their source is in the resolved file and, with the content of the ensemble, in the digest."""
    from nermo_mjx.robot import identified

    spec = {"vary": {"frequency": [0.5, 0.6]}}
    without, with_bodies = (
        Sweep.from_dict(spec),
        Sweep.from_dict(spec | {"randomize": {"from": "identified"}}),
    )
    assert with_bodies.resolved()["randomize"] == {"repeats": 1, "from": "identified"}
    assert "from" not in without.resolved()["randomize"]
    digests = [without.digest(), with_bodies.digest()]
    assert digests[0] != digests[1]
    other_ensemble = identified.read_ensemble(["servo.kp,objective,weight", "5.0,0.1,1"])
    monkeypatch.setattr(identified, "bodies", lambda source="identified": other_ensemble)
    assert without.digest() == digests[0]
    assert with_bodies.digest() != digests[1]


def test_bodies_alone_are_enough_to_sweep():
    assert Sweep.from_dict({"randomize": {"from": "identified"}}).variants == 1


def test_pilot_options_become_parameters():
    """Radius, side and turn rate of a pilot are ordinary parameters for the simulator."""
    sweep = Sweep.from_dict(
        {"pilot": {"arc": {"radius": 0.4, "direction": "right"}}, "vary": {"frequency": [0.5]}}
    )
    assert sweep.constants == {"pilot.radius": 0.4, "pilot.direction": -1.0}


def test_arrays_may_stand_for_lists_in_a_dict():
    """A dict from Python may hold numpy arrays and tuples."""
    sweep = Sweep.from_dict({"vary": {"frequency": np.linspace(0.5, 1.0, 3), "duty": (0.5, 0.6)}})
    assert sweep.variants == 6
    np.testing.assert_array_equal(sweep.axes[0].listed(), [0.5, 0.75, 1.0])


def test_way_points_are_read():
    sweep = Sweep.from_dict({"pilot": {"waypoints": {"points": WAY}}, "vary": {"duty": [0.5]}})
    assert sweep.setup.waypoints == ((0.0, 0.0), (0.0, -0.5), (0.3, -1.0))


@pytest.mark.parametrize(
    ("pilot", "sentence"),
    [
        ("waypoints", "'pilot' is 'waypoints' without points: expected points"),
        ({"waypoints": {"points": [[0, 0], [0, -1, 2]]}}, r"has the list \[0, -1, 2\]"),
        ({"waypoints": {"points": [[0, 0], [0, 0], [1, 1]]}}, "Way point 1 repeats"),
        (
            {"waypoints": {"points": [[0, 0], [0, 1], [0, "a"]]}},
            "is the text 'a': expected a number",
        ),
    ],
)
def test_wrong_way_points_are_refused(pilot, sentence):
    with pytest.raises(SpecError, match=sentence):
        Sweep.from_dict({"pilot": pilot, "vary": {"duty": [0.5]}})


def test_no_parameter_has_the_name_of_another_column() -> None:
    names = set(all_parameters())
    assert not names & (set(all_metrics()) | RESERVED_NAMES)
    assert "commanded_speed" in names
    for form in (
        {"vary": {"speed": [0.05, 0.1]}},
        {"rows": [{"speed": 0.1}]},
        {"randomize": {"speed": {"uniform": [0, 1]}}},
    ):
        refused(
            Sweep.from_dict,
            "field 'speed' is a (metric, and not a parameter|column of results)",
            form,
        )
