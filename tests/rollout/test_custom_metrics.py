# Tests of rollout/custom_metrics.py, rollout/metric_table.py, rollout/reduction.py
"""Custom metrics: reductions of a function of the sensors, where it may be named, and what is rejected."""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from conftest import shared_simulator
from fakes.sweep_fake import FakeSimulator
from test_metrics import DT, STEPS, stream

from nermo_mjx import METRICS, ParameterError, Rollout, Run, Setup, Simulator, all_metrics, metric
from nermo_mjx.cli import main
from nermo_mjx.optimize import Tuning
from nermo_mjx.optimize.tuning_history import history_columns as columns
from nermo_mjx.rollout import metrics as measures
from nermo_mjx.rollout.custom_metrics import ACROSS, REDUCTIONS, OwnMetric, load_metrics
from nermo_mjx.rollout.setup import Window
from nermo_mjx.sweep import Sweep, read_table, run_sweep
from nermo_mjx.sweep.plots import sweep_figures
from nermo_mjx.sweep.table import meta
from nermo_mjx.view.recorded import details_of

SHAKE = '''\
import jax.numpy as jnp
from nermo_mjx import metric

@metric(unit="rad/s", better="low", reduce="rms")
def yaw_shake(sensors):
    """Turning about its own axis.

    More is told below.
    """
    return sensors.gyro[2]

@metric(unit="N", reduce="peak")
def hardest_step(sensors):
    return jnp.max(sensors.foot_force)
'''
SWEEP = {"vary": {"frequency": [0.8, 0.9]}, "run": {"duration": 0.4, "warmup": 0.1}, "plots": False}


@pytest.fixture(scope="module")
def shake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed: simulators with these metrics are shared."""
    path = tmp_path_factory.mktemp("own") / "shake.py"
    path.write_text(SHAKE)
    return path


class Measuring(FakeSimulator):
    """It shakes the more, the faster it is."""

    def run(self, values: Any, run: Any, **how: Any) -> Any:
        result = super().run(values, run, **how)
        result.metrics |= {
            "yaw_shake": result.metrics["speed"] * 2,
            "hardest_step": result.metrics["speed"],
        }
        return result


def own(reduce: str, function: Any = lambda sensors: sensors.gyro[2]) -> OwnMetric:
    return OwnMetric("rad/s", reduce, None, reduce, function, reduce)


def reduced(readings: np.ndarray, begin: float, end: float) -> dict[str, float]:
    """What all reductions make of the yaw rate, (ticks, STEPS), of a robot that stands, from `begin` to `end`."""
    custom = tuple(own(name) for name in REDUCTIONS)
    gyro = np.zeros((*readings.shape, 3))
    gyro[..., 2] = readings
    readings_of_ticks, window = (
        stream(len(readings), gyro=gyro),
        Window(begin=begin, end=end, distance=1e6),
    )

    def tick(state: Any, now: Any) -> tuple[Any, None]:
        tick_record = measures.Tick(now[1], now[0], DT, 1.0)
        return measures.update(window, state, tick_record, custom), None

    start = measures.init(
        jax.tree.map(lambda leaf: jnp.asarray(leaf[0, -1], jnp.float32), readings_of_ticks), custom
    )
    state, _ = jax.lax.scan(tick, start, (DT * np.arange(len(readings)), readings_of_ticks))
    result = measures.result(state, jnp.asarray(0.27), custom=custom)
    return {name: float(result[name]) for name in REDUCTIONS}


# --- reductions


@pytest.mark.release
def test_reductions_are_those_of_numpy() -> None:
    """Over whole ticks, in both of which readings stand for the step before them: NumPy over the same readings."""
    random = np.random.default_rng(0).normal(size=(12, STEPS)).astype(np.float32)
    actual = reduced(random, 3 * DT, 11 * DT)
    values = random[4:].ravel()  # the first reading is that at rest, which ends at time 0
    between = np.concatenate(
        [random[3, -1:], values]
    )  # a value goes straight from one reading to the next
    expected = {
        "mean": values.mean(),
        "rms": np.sqrt((values**2).mean()),
        "std": values.std(),
        "min": between.min(),
        "max": between.max(),
        "peak": np.abs(between).max(),
        "range": np.ptp(between),
        "last": values[-1],
        "integral": values.mean() * 8 * DT,
    }
    assert actual == pytest.approx(
        {name: float(value) for name, value in expected.items()}, rel=1e-5, abs=1e-6
    )


@pytest.mark.release
def test_a_metric_of_a_stride_is_reduced_from_touch_down_to_touch_down() -> None:
    """Mean, deviation and coefficient of variation over the strides of the foot that is named, by NumPy."""
    ticks, period, stance = 401, 100, 60
    down = (np.arange(ticks)[:, None] - [30, 55, 30, 55]) % period < stance
    random = np.random.default_rng(1).normal(2.0, 1.0, (ticks, STEPS)).astype(np.float32)
    gyro = np.zeros((ticks, STEPS, 3))
    gyro[..., 2] = random
    readings_of_ticks = stream(ticks, gyro=gyro, foot_force=0.66 * down[:, None])
    custom = tuple(
        dataclasses.replace(
            own(reduce), name=f"{reduce}_{across}", per="stride", limb="front_right", across=across
        )
        for reduce in ("mean", "range", "integral")
        for across in ACROSS
    )

    def tick(state: Any, now: Any) -> tuple[Any, None]:
        tick_record = measures.Tick(now[1], now[0], DT, 0.95)
        window = Window(begin=0.0, end=1e6, distance=1e6)
        return measures.update(window, state, tick_record, custom), None

    start = measures.init(
        jax.tree.map(lambda leaf: jnp.asarray(leaf[0, -1], jnp.float32), readings_of_ticks), custom
    )
    state, _ = jax.lax.scan(tick, start, (DT * np.arange(ticks), readings_of_ticks))
    result = measures.result(state, jnp.asarray(0.27), custom=custom)
    # The front right foot is down from ticks 55, 155, 255 and 355 on, and settles in the eleventh tick.
    strides = [random[begin : begin + period] for begin in (66, 166, 266)]
    ranges = [
        np.ptp(random[begin - 1 : begin + period].ravel()[STEPS - 1 :]) for begin in (66, 166, 266)
    ]
    values = {
        "mean": [stride.mean() for stride in strides],
        "range": ranges,
        "integral": [stride.mean() for stride in strides],
    }
    for reduce, stride in values.items():
        std = np.std(stride, ddof=1)
        expected = {"mean": np.mean(stride), "std": std, "cv": std / np.mean(stride)}
        for across, value in expected.items():
            assert float(result[f"{reduce}_{across}"]) == pytest.approx(value, rel=2e-3), (
                reduce,
                across,
            )


@pytest.mark.release
def test_a_metric_is_continuous_where_the_measuring_begins_and_ends() -> None:
    """Of a yaw rate that grows by 1 rad/s a second: the extremes are the values at both ends of any window."""
    ramp = (DT * np.arange(-1, 11)[:, None] + DT * np.arange(1, STEPS + 1) / STEPS).astype(
        np.float32
    )
    for begin, end in ((0.0311, 0.0902), (0.03, 0.0999), (0.0349, 0.0451)):
        actual = reduced(ramp, begin, end)
        assert (actual["min"], actual["max"], actual["last"]) == pytest.approx(
            (begin, end, end), abs=2e-6
        )
        assert actual["range"] == pytest.approx(end - begin, abs=4e-6)


@pytest.mark.release
def test_what_was_never_measured_is_not_a_number() -> None:
    assert all(math.isnan(value) for value in reduced(np.ones((3, STEPS)), 1.0, 2.0).values())


@pytest.mark.release
def test_what_is_not_measured_does_no_harm_to_value_and_slope() -> None:
    """The root of a force has no slope at zero, which it reads before the first tick and where numbers are lost."""
    root = own("mean", lambda sensors: jnp.sqrt(sensors.foot_force[0]))

    def mean(weight: Any) -> Any:
        tick, readings_of_ticks = np.arange(4)[:, None, None], jax.tree.map(jnp.asarray, stream(4))
        force = jnp.where(tick == 0, 0.0, weight * 4.0) * np.ones((4, STEPS, 4))
        readings_of_ticks = dataclasses.replace(
            readings_of_ticks, foot_force=jnp.where(tick == 3, jnp.nan, force)
        )
        start = measures.init(jax.tree.map(lambda leaf: leaf[0, -1], readings_of_ticks), (root,))

        def add(state: Any, now: Any) -> tuple[Any, None]:
            tick_record = measures.Tick(now[1], now[0], DT, 1.0)
            return measures.update(Window(begin=0.0), state, tick_record, (root,)), None

        state, _ = jax.lax.scan(add, start, (DT * np.arange(4), readings_of_ticks))
        return measures.result(state, jnp.asarray(0.27), custom=(root,))["mean"]

    assert float(jax.jit(mean)(1.0)) == pytest.approx(2.0)
    for derivative in (jax.grad, jax.jacfwd):
        assert float(jax.jit(derivative(mean))(1.0)) == pytest.approx(1.0)


# --- in a simulator


@pytest.mark.release
def test_a_simulator_measures_what_its_recording_shows(shake: Path) -> None:
    """The readings of a tick's end, of a signal that five steps hardly change; other metrics keep their last bit."""
    run = Run(duration=0.4, warmup=0.1)
    simulator = shared_simulator(Setup(metrics=str(shake)), "c")
    result = simulator.run({"frequency": [0.8, 1.0]}, run, record=True)
    assert result.trace is not None
    measured = result.trace.time > 0.1 + 1e-9
    shaken = np.sqrt((result.trace.sensors["gyro"][:, measured, 2] ** 2).mean(axis=1))
    np.testing.assert_allclose(result.metrics["yaw_shake"], shaken, rtol=0.2)
    assert set(result.metrics) == set(all_metrics(simulator.setup))
    plain = shared_simulator(Setup(), "c").run({"frequency": [0.8, 1.0]}, run)
    for name, column in plain.metrics.items():
        np.testing.assert_array_equal(column, result.metrics[name], err_msg=name)
    recording = result.recording(1)
    assert recording.metadata["setup"]["metrics"] == [str(shake)]
    (rows,) = (table["rows"] for table in details_of(recording) if table["title"] == "Metrics")
    assert ["hardest_step", f"{result.metrics['hardest_step'][1]:.4g} N"] in [
        list(row) for row in rows
    ]


@pytest.mark.long
def test_a_metric_of_ones_own_has_the_derivative_of_the_engine_c(shake: Path) -> None:
    """By central differences of another implementation."""
    with jax.enable_x64(True):
        run, amplitude, eps = Run(duration=0.25, warmup=0.1), 0.2, 1e-5
        setup = Setup(spine="stride_extension", metrics=str(shake))
        rollout = Rollout(setup, run, "mjx")
        slope = jax.jit(jax.jacfwd(lambda x: rollout({"spine.amplitude": x})["yaw_shake"]))(
            amplitude
        )
        simulator = Simulator(setup, engine="c")
        simulator.engine.model.opt.tolerance = 0.0
        high, low = simulator({"spine.amplitude": [amplitude + eps, amplitude - eps]}, run)[
            "yaw_shake"
        ]
    assert float(slope) == pytest.approx((high - low) / (2 * eps), rel=1e-3)


@pytest.mark.release
@pytest.mark.usefixtures("shared_simulators")
def test_a_walk_prints_its_own_metrics(shake: Path) -> None:
    words = [
        "walk",
        "--engine",
        "c",
        "--duration",
        "0.1",
        "--warmup",
        "0.02",
        "--metrics",
        str(shake),
    ]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert re.search(r"^hardest_step +\d\S* +N$", result.stdout, re.MULTILINE)
    wrong = CliRunner().invoke(main, [*words[:-1], str(shake.with_name("no.py"))])
    assert wrong.exit_code == 2
    assert wrong.stderr.endswith("no.py cannot be read (No such file or directory).\n")


# --- files


def test_a_file_gives_its_metrics_with_unit_side_and_description(shake: Path) -> None:
    first, second = load_metrics(str(shake))
    assert (first.name, first.unit, first.better) == ("yaw_shake", "rad/s", "low")
    assert first.doc == "Turning about its own axis"
    assert second.doc == "peak of hardest_step"
    assert load_metrics(f"{shake}:hardest_step") == (second,)
    setup = Setup(metrics=[f"{shake}:hardest_step", own("drop")])
    assert [*all_metrics(setup)] == [*METRICS, "hardest_step", "drop"]
    assert setup.fields()["metrics"] == (f"{shake}:hardest_step", "drop")


def test_the_directory_keeps_the_file_and_its_content_counts(shake: Path, tmp_path: Path) -> None:
    copy = tmp_path / "shake.py"
    shutil.copy(shake, copy)
    (tmp_path / "sweep.yaml").write_text(
        "metrics: shake.py\nvary: {frequency: [0.8, 0.9]}\nplots: false\nrun: {duration: 0.4}\n"
    )
    sweep, out = Sweep.from_file(tmp_path / "sweep.yaml"), tmp_path / "out"
    digest = sweep.digest()
    run_sweep(sweep, out, simulator=Measuring())
    assert (out / "metrics.py").read_text() == SHAKE
    stored = Sweep.from_file(out / "sweep.yaml")
    assert stored.digest() == digest, "wherever the file is"
    table = read_table(out)
    assert meta(table.schema.field("yaw_shake")) == {
        "unit": "rad/s",
        "description": "Turning about its own axis",
        "role": "metric",
        "better": "low",
    }
    assert "better" not in meta(table.schema.field("hardest_step"))
    assert meta(table.schema.field("speed"))["better"] == "high"
    copy.write_text(SHAKE.replace("gyro[2]", "gyro[1]"))
    assert Sweep.from_file(tmp_path / "sweep.yaml").digest() != digest
    assert Sweep.from_file(out / "sweep.yaml").digest() == digest


def test_summary_and_figures_know_which_side_is_better(shake: Path, tmp_path: Path) -> None:
    """Of what shakes less is better, and of what has no side the highest is marked, and not called the best."""
    spec = {**SWEEP, "metrics": str(shake), "vary": {"frequency": [0.7, 0.8, 0.9]}}
    best = run_sweep(spec, tmp_path, simulator=Measuring()).summary["best"]
    assert (best["yaw_shake"]["side"], best["yaw_shake"]["parameters"]) == (
        "min",
        {"frequency": 0.7},
    )
    assert "hardest_step" not in best
    for name, star in (
        ("yaw_shake", "star: best, .* at 0.7 Hz"),
        ("hardest_step", "star: highest, .* at 0.9 Hz"),
    ):
        texts = [
            text.get_text()
            for _, figure in sweep_figures(tmp_path, color=name)
            for text in figure.texts
        ]
        assert any(re.search(star, text) for text in texts), texts


def test_a_sweep_without_metrics_of_its_own_is_the_sweep_it_was() -> None:
    assert "metrics" not in Sweep.from_dict(SWEEP).resolved()
    assert "metrics" not in Setup().fields()


def test_a_tuning_may_aim_at_a_metric_of_its_own(shake: Path) -> None:
    file = {
        "metrics": [f"{shake}:yaw_shake"],
        "run": {"duration": 0.5},
        "tune": {"stride": {"bounds": [0.5, 1.0]}},
        "objective": [{"maximize": "speed"}, {"minimize": "yaw_shake", "scale": 0.1}],
    }
    tuning = Tuning.from_dict(file)
    assert tuning.objective.metrics == ("speed", "yaw_shake")
    assert tuning.objective_metrics["yaw_shake"].unit == "rad/s"
    assert Tuning.from_text(tuning.to_yaml()).digest() == tuning.digest()
    assert [
        (c.unit, c.description) for c in columns(tuning, ("yaw_shake",)) if c.name == "yaw_shake"
    ] == [("rad/s", "Turning about its own axis")]
    with pytest.raises(ParameterError, match="is the text 'yaw_shake': allowed are speed"):
        Tuning.from_dict({**file, "metrics": []})
    with pytest.raises(ParameterError, match=r"did you mean 'yaw_shake'\?"):
        Tuning.from_dict({**file, "objective": [{"minimize": "yaw_shak"}]})


# --- what is refused

#: A file's function, and what a sweep says of it.
WRONG = {
    "an array": (
        "return sensors.gyro",
        r"field 'metrics' has bad \(m.py:3\), which gives an array of shape \(3,\): "
        "expected one number.",
    ),
    "nothing": ("pass", "which gives NoneType: expected one number"),
    "not a number": (
        "return sensors.foot_force[0] / jnp.sum(sensors.foot_force)",
        "which gives nan for a robot at rest, where forces and velocities are 0: guard it, as by jnp.where.",
    ),
    "an exception": (
        "return undefined",
        "which fails at m.py:5: NameError: name 'undefined' is not defined.",
    ),
    "an unknown sensor": (
        "return sensors.gyros[2]",
        "did you mean 'gyro'. Sensors are position, orientation",
    ),
    "a branch": (
        "return 1.0 if sensors.gyro[2] > 0 else 0.0",
        "which fails at m.py:5: it cannot be compiled, as it branches on readings",
    ),
    "NumPy": (
        "import numpy; return numpy.max(numpy.asarray(sensors.gyro))",
        "or makes NumPy's numbers of them",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_function_that_is_none_is_refused_before_the_sweep_starts(
    tmp_path: Path, case: str
) -> None:
    body, message = WRONG[case]
    (tmp_path / "m.py").write_text(
        f"import jax.numpy as jnp\nfrom nermo_mjx import metric\n@metric(unit='1')\ndef bad(sensors):\n    {body}\n"
    )
    (tmp_path / "s.yaml").write_text("metrics: m.py\nvary: {frequency: [0.8, 0.9]}\n")
    with pytest.raises(ParameterError, match=message) as refused:
        Sweep.from_file(tmp_path / "s.yaml")
    assert str(refused.value).startswith(f"{tmp_path / 's.yaml'}:1: field 'metrics' ")


def named(name: str) -> OwnMetric:
    return OwnMetric("1", "", None, name, lambda sensors: 0.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            [named("speed")],
            "metrics has speed .*is a metric that every run has: give it another name",
        ),
        ([named("status")], "status is a column that every table has"),
        ([named("frequency")], "frequency is a parameter"),
        ([named("a"), named("a")], "metrics has a .* and a .*: give one of them another name"),
        ([3], "metrics has 3: expected a function under @metric"),
        ("none.py", "metrics has 'none.py': none.py cannot be read"),
        ("json", "metrics has 'json': it has no metric"),
        ("json:loads", "loads is no metric; write @metric"),
        ("no_such_module:x", "there is no module 'no_such_module' here; expected FILE.py"),
        ("a b:", "metrics has 'a b:': expected FILE.py, FILE.py:NAME, MODULE or MODULE:NAME"),
    ],
)
def test_names_that_are_taken_and_what_is_no_metric(wrong: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Setup(metrics=wrong)


def test_a_misspelled_name_gets_the_nearest(shake: Path) -> None:
    with pytest.raises(
        ParameterError, match=r"shake.py has no 'yaw_shak'; did you mean 'yaw_shake'\?"
    ):
        Setup(metrics=f"{shake}:yaw_shak")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"unit": ""}, "with the unit '': expected a text"),
        (
            {"unit": "1", "better": "lower"},
            "better='lower': allowed is None, high, low, zero; did you mean 'low'",
        ),
        ({"unit": "1", "reduce": "maximum"}, "reduce='maximum': allowed is mean, rms"),
        ({"unit": "1", "per": "step"}, "per='step': allowed is run, stride"),
        (
            {"unit": "1", "per": "stride", "limb": "left_front"},
            "limb='left_front': allowed is front_left",
        ),
        (
            {"unit": "1", "per": "stride", "across": "sd"},
            "across='sd': allowed is mean, std, cv; did you mean 'std'",
        ),
    ],
)
def test_what_a_metric_is_declared_with_is_checked(how: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        metric(**how)(lambda_named_f)


def lambda_named_f(sensors: Any) -> float:
    return 0.0


def test_a_sweep_names_no_objects() -> None:
    sweep = dataclasses.replace(Sweep.from_dict(SWEEP), setup=Setup(metrics=[named("own")]))
    with pytest.raises(
        ParameterError, match=r"metrics has own .*: name it as FILE.py:NAME or MODULE:NAME"
    ):
        sweep.digest()
