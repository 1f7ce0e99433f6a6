# Tests of specs/values.py
"""Numbers with units: each place that takes a parameter's number takes a text, and refuses what does not convert."""

from __future__ import annotations

import math

import jsonschema
import numpy as np
import pytest
from command import call, json_of
from ruamel.yaml import YAML

from nermo_mjx import ParameterError, Rollout, Run, Setup, Simulator, Sweep, servo_table
from nermo_mjx.control.schedule import Switch
from nermo_mjx.learn.spec import Training, TrainingFile
from nermo_mjx.optimize import Search, Tuning
from nermo_mjx.rollout import all_parameters
from nermo_mjx.specs.fields import schema_of
from nermo_mjx.specs.reading import read_text

DEGREE = math.pi / 180


@pytest.mark.parametrize(
    ("name", "text", "number"),
    [
        ("spine.phase", "-45 deg", -math.pi / 4),
        ("spine.phase", "-45deg", -math.pi / 4),
        ("spine.phase", " 1e2 deg ", 100 * DEGREE),
        ("spine.phase", "0.5", 0.5),
        ("spine.phase", ".5 rad", 0.5),
        ("frequency", "0.8 Hz", 0.8),
        ("geometry.foot.radius", "12 mm", 0.012),
        ("geometry.foot.radius", "1.2cm", 0.012),
        ("contact.time_constant", "30 ms", 0.03),
        ("mass.front", "5 g", 0.005),
        ("duty", "20 %", 0.2),
        ("servo.speed", "600 deg/s", 600 * DEGREE),
        ("ground.gravity", "9.81 m/s^2", 9.81),
    ],
)
def test_a_text_is_its_number_in_si_units(name, text, number):
    assert all_parameters()[name].number(text) == pytest.approx(number, rel=1e-14)
    assert Setup().numbers({name: [text, 1]}) == {name: [pytest.approx(number, rel=1e-14), 1]}


@pytest.mark.parametrize(
    "text", ["12 mm", "fast", "", "Hz", "0.8 hz", "0.8 Hz 2", "1,5 Hz", "--1 Hz", "1 % Hz", "nan"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(ParameterError) as refused:
        Setup().numbers({"frequency": text})
    assert str(refused.value) == f"frequency is {text!r}: expected a number in Hz, such as 0.67 Hz."


@pytest.mark.parametrize(
    "value", [True, None, [0.8, False], np.array([True]), np.array(["0.8 Hz", "1 g"])]
)
def test_what_is_no_number_is_refused(value):
    """A truth value is no number, though NumPy takes it for one."""
    with pytest.raises(
        ParameterError, match=r"^frequency is .*: expected a number in Hz, such as 0\.67 Hz\.$"
    ):
        Setup().numbers({"frequency": value})


IN_UNITS = """
spine: stride_extension
pilot: {arc: {radius: 50 cm}}
run: {duration: 2 s, warmup: 500 ms}
set: {frequency: 0.8 Hz, duty: 55 %}
schedule: [{at: 500 ms, set: {stride: 50 %}}]
vary:
  spine.phase: {linspace: [-180 deg, 180deg, 9]}
  spine.amplitude: [0 deg, 10 deg]
  geometry.foot.radius: [2 mm, 0.003]
randomize: {repeats: 2, contact.friction: {normal: [60 %, 5 %]}, contact.time_constant: {uniform: [5 ms, 0.01 s]}}
optimum: {over: [spine.phase], base: {spine.amplitude: 0 deg}}
"""
IN_SI = f"""
spine: stride_extension
pilot: {{arc: {{radius: 0.5}}}}
run: {{duration: 2, warmup: 0.5}}
set: {{frequency: 0.8, duty: 0.55}}
schedule: [{{at: 0.5, set: {{stride: 0.5}}}}]
vary:
  spine.phase: {{linspace: [{-math.pi!r}, {math.pi!r}, 9]}}
  spine.amplitude: [0, {math.pi / 18!r}]
  geometry.foot.radius: [0.002, 0.003]
randomize: {{repeats: 2, contact.friction: {{normal: [0.6, 0.05]}}, contact.time_constant: {{uniform: [0.005, 0.01]}}}}
optimum: {{over: [spine.phase], base: {{spine.amplitude: 0}}}}
"""


def test_a_sweep_in_units_is_that_in_si_numbers():
    assert Sweep.from_text(IN_UNITS) == Sweep.from_text(IN_SI)
    assert "deg" not in Sweep.from_text(IN_UNITS).to_yaml()


def test_a_tuning_a_search_and_a_training_take_units():
    text = "spine: stride_extension\ntune: {{spine.phase: {{bounds: [{}], start: {}}}}}"
    text += "\nobjective: [{{maximize: speed}}]"
    assert Tuning.from_text(text.format("-90 deg, 90 deg", "45 deg")) == Tuning.from_text(
        text.format(f"{-math.pi / 2!r}, {math.pi / 2!r}", math.pi / 4)
    )
    text = "spine: stride_extension\nvary: {{spine.phase: {{uniform: [{}]}}}}\nobjective: [{{maximize: speed}}]"
    assert Search.from_text(text.format("-90 deg, 90 deg")) == Search.from_text(
        text.format(f"{-math.pi / 2!r}, {math.pi / 2!r}")
    )
    training = Training.from_text(
        "randomize: {contact.friction: [60 %, 0.9]}\nset: {frequency: 0.8 Hz}"
    )
    assert training.task.randomize["contact.friction"] == (0.6, 0.9)
    assert training.task.set["frequency"] == 0.8


@pytest.mark.release
def test_a_trainings_task_and_scenes_take_units_and_editors_know_it():
    """Sensing is a training's own: no sweep knows its parameters."""
    text = "task: {{episode_length: {}, corridor: {}, set: {{sensing.delay: {}}}}}\nscenes:\n- {{scene: flat}}\n"
    text += "- {{scene: planks, corridor: {}, set: {{terrain.height: {}}}, randomize: {{start.yaw: {}}}}}"
    units = text.format("8 s", "10 cm", "5 ms", "300 mm", "5 mm", "[-5 deg, 5 deg]")
    numbers = text.format(8.0, 0.1, 0.005, 0.3, 0.005, [-math.radians(5), math.radians(5)])
    assert Training.from_text(units).task == Training.from_text(numbers).task
    assert Training.from_text(units).scenes == Training.from_text(numbers).scenes
    schema = jsonschema.Draft202012Validator(schema_of(TrainingFile))
    assert not [error.message for error in schema.iter_errors(YAML(typ="safe").load(units))]


def test_a_compared_base_is_a_value_whatever_its_unit():
    spec = {"spine": "stride_extension", "vary": {"spine.phase": ["-45 deg", 0.0]}}
    for base in ("-45 deg", -math.pi / 4, 0, "0 deg"):
        Sweep.from_dict(spec | {"compare": {"by": "spine.phase", "base": base}})
    message = r"compare.base' is the text .* no value of spine.phase; allowed are -0.78"
    for base in ("-45", "-44 deg", "45 mm", "none"):
        with pytest.raises(ParameterError, match=message):
            Sweep.from_dict(spec | {"compare": {"by": "spine.phase", "base": base}})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "schedule: [{at: -1 s, gait: trot}]",
            "field 'schedule.0.at' is the text '-1 s': expected a number of at least",
        ),
        (
            "set: {frequency: 12 mm}",
            "field 'frequency' is the text '12 mm': expected a number in Hz, such as 0.67 Hz.",
        ),
        (
            "vary: {frequency: [0.8, 3 s]}",
            "field 'frequency' is the text '3 s': expected a number in Hz",
        ),
        (
            "vary: {frequency: {linspace: [1, fast, 3]}}",
            "field 'frequency' is the text 'fast': expected a number.",
        ),
        (
            "randomize: {duty: {normal: [1 m, 1]}}",
            "field 'duty' is the text '1 m': expected a number, or one in %,",
        ),
        (
            "rows: [{frequency: 1}, {frequency: 3 g}]",
            "field 'rows.1.frequency' is the text '3 g': expected a number in Hz",
        ),
        (
            "pilot: {arc: {radius: 3 deg}}",
            "field 'pilot.arc.radius' is the text '3 deg': expected a number in m, mm",
        ),
        (
            "pilot: {straight: {distance: 3 s}}",
            "'pilot.straight.distance' is the text '3 s': expected a number in m,",
        ),
        (
            "run: {duration: 3 m}",
            "field 'run.duration' is the text '3 m': expected a number in s or ms, such as 1 s.",
        ),
        (
            "schedule: [{at: 1, set: {duty: 3 g}}]",
            "field 'schedule.0.set.duty' is the text '3 g': expected a number,",
        ),
        (
            "optimum: {base: {frequency: 3 g}}",
            "field 'optimum.base.frequency' is the text '3 g': expected a number in",
        ),
    ],
)
def test_a_file_refuses_a_unit_that_does_not_convert(text, message):
    with pytest.raises(ParameterError) as refused:
        Sweep.from_text(f"\n{text}")
    assert str(refused.value).startswith(
        f"sweep:2: {message}" if "field" in message else f"sweep:2: field {message}"
    )


def test_rows_of_a_table_may_have_units(tmp_path):
    (tmp_path / "rows.csv").write_text("spine.phase,frequency\n-45 deg,0.8 Hz\n0,0.9\n")
    (tmp_path / "s.yaml").write_text("spine: stride_extension\nrows: rows.csv\n")
    rows = Sweep.from_file(tmp_path / "s.yaml").rows
    np.testing.assert_allclose(rows.values["spine.phase"], [-math.pi / 4, 0.0], rtol=1e-15)
    assert rows.values["frequency"].tolist() == [0.8, 0.9]


def test_an_editor_accepts_what_is_read():
    schema = json_of("schema", "sweep")
    check = jsonschema.Draft7Validator(schema)
    assert not list(check.iter_errors(read_text(IN_UNITS, "s").data))
    for wrong in (
        "{set: {frequency: 12 mm}}",
        "{vary: {frequency: [fast]}}",
        "{run: {duration: 3 m}}",
    ):
        assert list(check.iter_errors(read_text(wrong, "s").data)), wrong


@pytest.mark.release
def test_python_takes_units(simulator):
    """A walk and a servo table in units are those in SI numbers."""
    setup = Setup(spine="stride_extension")
    units = {
        "frequency": "0.8 Hz",
        "spine.phase": ["-45 deg", "45deg"],
        "spine.amplitude": "10 deg",
    }
    numbers = {
        "frequency": 0.8,
        "spine.phase": [-math.pi / 4, math.pi / 4],
        "spine.amplitude": math.pi / 18,
    }
    prepared = [
        Simulator(setup, engine="c").prepare(parameters, Run(duration=0.2))
        for parameters in (units, numbers)
    ]
    assert prepared[0].named == prepared[1].named
    for name, values in prepared[0].worlds.control.spine.__dict__.items():
        np.testing.assert_allclose(
            values, getattr(prepared[1].worlds.control.spine, name), rtol=1e-15
        )
    table = servo_table(setup, units | {"spine.phase": "-45 deg"}, rate=20.0)
    np.testing.assert_array_equal(
        table.angles, servo_table(setup, numbers | {"spine.phase": -math.pi / 4}, rate=20.0).angles
    )
    assert Switch(1.0, values={"frequency": "0.8 Hz"}).values == (("frequency", 0.8),)
    rollout = Rollout(setup, Run(duration=0.1), engine="c")
    for wrong in (
        lambda: rollout({"frequency": "3 s"}),
        lambda: servo_table(setup, {"frequency": "3 s"}),
    ):
        with pytest.raises(
            ParameterError,
            match=r"^frequency is '3 s': expected a number in Hz, such as 0\.67 Hz\.$",
        ):
            wrong()


@pytest.mark.release
def test_commands_take_units(tmp_path):
    """A table of servo angles by options in units is that in SI numbers."""
    tables = []
    for i, angle, rate in ((0, "-45 deg", "0.8 Hz"), (1, repr(-math.pi / 4), "0.8")):
        out = tmp_path / f"{i}.csv"
        options = (
            "--spine",
            "stride_extension",
            "--spine-phase",
            angle,
            "--frequency",
            rate,
            "--set",
            "duty=55 %",
        )
        ran = call("servos", *options, "--rate", "20", "--out", out)
        assert ran.exit_code == 0, ran.output
        tables.append(out.read_text().partition("\n")[2])
    assert tables[0] == tables[1]
    ran = call("walk", "--set", "frequency=12 mm")
    assert ran.exit_code == 2
    assert (
        "--set frequency=12 mm: frequency is '12 mm': expected a number in Hz, such as 0.67 Hz."
        in ran.output
    )
    ran = call("walk", "--frequency", "12 mm")
    assert (ran.exit_code, "--frequency is '12 mm': expected a number in Hz" in ran.output) == (
        2,
        True,
    )
    ran = call("walk", "--switch", "2,frequency=12 mm")
    assert (ran.exit_code, "frequency is '12 mm': expected a number in Hz" in ran.output) == (
        2,
        True,
    )
