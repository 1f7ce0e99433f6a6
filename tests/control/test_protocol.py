# Tests of control/protocol.py
"""Custom controllers: in a simulator, in sweep and tuning files, and under `jax.grad`."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import Controller, Rollout, Run, Setup, Simulator, leg_servos
from nermo_mjx.control import SpineModes, load_controller, published_controller
from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.control.path import straight
from nermo_mjx.optimize import Tuning
from nermo_mjx.robot.model_parameters import Servo
from nermo_mjx.robot.quantity import ParameterError, parameter_tree, quantity
from nermo_mjx.rollout.loop import ClosedLoop, LoopParameters, check_controller
from nermo_mjx.rollout.setup import Window
from nermo_mjx.runs import DirectoryError
from nermo_mjx.runtime import compiler_options
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep import Sweep, run_sweep
from nermo_mjx.sweep.spec import Sample
from nermo_mjx.sweep.store import simulated_seconds

EXAMPLES = Path(__file__).parents[2] / "docs" / "howto" / "controllers"
BOUND = f"{EXAMPLES / 'bound.py'}:Bound"
SHORT = Run(duration=0.5, warmup=0.1)


@parameter_tree
class Parameters:
    """Of `Still`."""

    height: Any = quantity(0.045, unit="m", low=0.03, high=0.055, doc="of the hips")


class Still:
    """Stands; what the tests take away from it, or change, is in `changes`."""

    dt = 0.01
    parameters: Any = Parameters()

    def __init__(self, **changes: Any) -> None:
        for name, value in changes.items():
            setattr(self, name, value)

    def init(self, params, sensors, phase):
        return {"ticks": jnp.zeros((), int)}

    def initial_servo(self, params, phase):
        return leg_servos(
            jnp.stack([jnp.zeros(4), -params.height - jnp.array([0.0, 0.0, 0.005, 0.005])], axis=-1)
        )

    def update(self, params, state, sensors):
        return {"ticks": state["ticks"] + 1}, self.initial_servo(params, None)

    def cycle_rate(self, params):
        return 1.0


class Watched(Still):
    """Stands on a path, and plans to have its rear feet in the air."""

    def path(self, params, state, position):
        return straight(ControlParameters().pilot, position + jnp.array([0.01, 0.0, 0.0]))

    def stance(self, state):
        return jnp.array([True, True, False, False])


@pytest.fixture(scope="module")
def bound() -> Simulator:
    return Simulator(engine="c", controller=BOUND)


# --- in a simulator


@pytest.mark.release
def test_a_controller_of_thirty_lines_walks(bound: Simulator) -> None:
    """Its parameters are named beside those of the body, and are as many."""
    values = {"reach": np.array([0.0, 0.05]), "contact.friction": 1.2}
    result = bound.run(values, Run(cycles=3, warmup_cycles=1))
    assert result.status.tolist() == ["ok", "ok"]
    still, walking = result.metrics["speed"]
    assert walking > still + 0.01
    np.testing.assert_allclose(
        result.metrics["duration"], 2 / 1.2, rtol=1e-6
    )  # gait cycles, at its own rate
    assert np.isnan(result.metrics["cross_track_rms"]).all()  # it has no path
    assert bound.setup.defaults()["reach"] == 0.03
    assert "stride" not in bound.setup.defaults()
    description = result.about(1)
    assert (description["parameters"]["reach"], description["setup"]["controller"]) == (0.05, BOUND)


@pytest.mark.release
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"reach": 0.07}, r"reach is 0.07: allowed is \[0, 0.06\] m"),
        ({"stride": 1.0}, "stride is not a parameter"),
        (
            {"reach": [0.01, 0.02], "lift": [0.0, 0.01, 0.02]},
            "lift has 3 values|reach has 2 values",
        ),
        ({"reach": []}, "reach has no values: a batch has at least one world"),
    ],
)
def test_values_are_checked_by_the_controllers_own_ranges(
    bound: Simulator, values: Any, message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        bound.prepare(values)


@pytest.mark.release
def test_a_policy_is_for_all_worlds_or_for_each(bound: Simulator) -> None:
    """A leaf with an axis more has one entry a world; what is named comes into the policy."""
    parameters = bound.controller.parameters
    policy = dataclasses.replace(
        parameters, reach=np.array([0.01, 0.02, 0.03]), lift=np.asarray(0.005)
    )
    batch = bound.prepare({"lag": 0.25}, policy=policy)
    np.testing.assert_allclose(batch.params.control.reach, [0.01, 0.02, 0.03])
    np.testing.assert_allclose(batch.params.control.lift, np.full(3, 0.005))
    np.testing.assert_allclose(batch.params.control.lag, np.full(3, 0.25))
    with pytest.raises(ParameterError, match="policy has a leaf of shape"):
        bound.prepare({}, policy=dataclasses.replace(parameters, reach=np.zeros((2, 2))))
    with pytest.raises(
        ParameterError, match="expected the structure of the controller's parameters"
    ):
        bound.prepare({}, policy=[0.03])


@pytest.mark.release
def test_metrics_know_a_path_and_planned_contact_where_the_controller_has_them() -> None:
    simulator = Simulator(engine="c", controller=Watched())
    measured = simulator({"height": np.array([0.04, 0.045])}, SHORT)
    np.testing.assert_allclose(measured["cross_track_rms"], 0.01, atol=1e-3)
    assert (measured["swing_loaded_rear"] > 0.9).all()
    assert np.isnan(measured["swing_loaded_front"]).all()


@pytest.mark.release
def test_the_controller_sees_each_tick_once_and_keeps_its_whole_numbers() -> None:
    simulator = Simulator(engine="c", controller=Still())
    batch = simulator.prepare({}, SHORT)
    session = simulator.engine.open(batch.params, batch.qpos, batch.fields)
    session.advance(7)
    ticks = session.loop_state.control["ticks"]
    assert (ticks.tolist(), ticks.dtype.kind) == ([7], "i")


# --- what a setup takes


@parameter_tree
class Clashing:
    x: Any = quantity(0.0, unit="m", doc="of nothing")


@parameter_tree
class Nested:
    start: Any = dataclasses.field(default_factory=Clashing)


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"controller": 3}, "controller is of type int, which has no dt and no parameters"),
        (
            {"controller": Still(), "gait": "lateral_walk"},
            "gait is 'lateral_walk' beside a custom controller",
        ),
        (
            {"controller": Controller(), "spine": "balance"},
            "spine is 'balance' beside a custom controller",
        ),
        (
            {"controller": Still(dt=0.007)},
            "timestep is 0.002: allowed is the control period 0.007 s divided by",
        ),
        (
            {"controller": Still(parameters=Nested())},
            "controller has a parameter 'start.x', which is one of the robot",
        ),
        (
            {"controller": "bound"},
            "controller is 'bound': expected FILE.py:NAME, MODULE:NAME or FILE.npz",
        ),
        (
            {"controller": "nowhere.py:Bound"},
            r"nowhere.py cannot be read \(No such file or directory\)",
        ),
        ({"controller": "no_such_module:Bound"}, "there is no module 'no_such_module' here"),
        ({"controller": f"{EXAMPLES / 'bound.py'}:Bond"}, "has no 'Bond'; did you mean 'Bound'?"),
        ({"controller": "math:pi"}, "controller is of type float"),
    ],
)
def test_a_setup_refuses_what_does_not_fit(choices: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Setup(**choices)


def test_no_robot_is_built_to_check_a_setup(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nermo_mjx.rollout.setup.load_robot", None)
    setup = Setup(spine="stride_extension+balance", tail="articulated")
    assert setup.defaults()["frequency"] == 0.67
    assert setup.timing == {"frequency", "tracking.clock_ratio"}


# --- the published controller's parts


def test_each_part_of_the_published_controller_can_be_replaced() -> None:
    """With the part that it has, it is the same controller; a custom spine is a function."""
    assert Controller(spine=SpineModes("stride_extension")) == published_controller(
        spine="stride_extension"
    )
    waving = Controller(
        spine=lambda params, phase, turn_rate, feet, stance: params.spine.amplitude * phase
    )
    params = Setup(controller=waving, gait="lateral_walk").world({"spine.amplitude": 0.2}).control
    assert params.gait.duty == pytest.approx(0.68)
    robot = Setup().load()
    state = jax.jit(waving.init)(params, robot.sensors(np.zeros(robot.model.nsensordata)), 0.5)
    assert float(state.spine) == pytest.approx(0.1)
    assert float(jax.jit(waving.servo_angles)(params, state).spine) == pytest.approx(0.1)


# --- in files


SPEC = {
    "controller": BOUND,
    "run": {"duration": 0.3},
    "plots": False,
    "vary": {"reach": [0.01, 0.03], "lag": [0, 0.5]},
}


@pytest.mark.release
def test_a_sweep_runs_another_controller(bound: Simulator, tmp_path: Path) -> None:
    result = run_sweep(SPEC, tmp_path / "there", simulator=bound)
    assert result.complete
    assert result.table.column("reach").to_pylist() == [0.01, 0.01, 0.03, 0.03]
    assert np.isfinite(result.table.column("speed").to_numpy()).all()
    # The directory has a copy of the controller: it goes on where the file is not, and elsewhere.
    shutil.move(tmp_path / "there", tmp_path / "here")
    sweep_of_copy = Sweep.from_file(tmp_path / "here" / "sweep.yaml")
    assert (
        sweep_of_copy.setup.controller == f"{(tmp_path / 'here' / 'controller.py').resolve()}:Bound"
    )
    assert sweep_of_copy.digest() == Sweep.from_dict(SPEC).digest()
    assert run_sweep(SPEC, tmp_path / "here", simulator=bound).chunks_run == 0


@pytest.mark.release
def test_rows_of_two_controllers_are_not_mixed(bound: Simulator, tmp_path: Path) -> None:
    """The content of the file counts, and not its name."""
    text = (EXAMPLES / "bound.py").read_text()
    (tmp_path / "mine.py").write_text(text)
    spec = SPEC | {"controller": f"{tmp_path / 'mine.py'}:Bound"}
    assert Sweep.from_dict(spec).digest() == Sweep.from_dict(SPEC).digest()
    run_sweep(spec, tmp_path / "out", simulator=bound)
    (tmp_path / "mine.py").write_text(text.replace("dt = 0.01", "dt = 0.02"))
    assert Sweep.from_dict(spec).digest() != Sweep.from_dict(SPEC).digest()
    with pytest.raises(
        DirectoryError, match=r"another sweep: controller is Bound .* there and Bound .* here"
    ):
        run_sweep(spec, tmp_path / "out", simulator=bound)


def test_a_run_in_cycles_lasts_as_the_controller_says() -> None:
    sweep = Sweep.from_dict(
        SPEC | {"run": {"cycles": 6, "warmup_cycles": 0}, "vary": {"frequency": [1.0, 3.0]}}
    )
    np.testing.assert_allclose(simulated_seconds(sweep, Sample(sweep)), [6.0, 2.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"vary": {"stride": [0.5, 1.0]}},
            "'stride' is not a parameter; allowed are frequency, reach, lift, lag",
        ),
        ({"vary": {"reech": [0.01]}}, "did you mean 'reach'?"),
        ({"vary": {"reach": [0.01, 0.1]}}, r"is 0.1: allowed is \[0, 0.06\] m"),
        ({"gait": "lateral_walk"}, "field 'gait' is 'lateral_walk' beside a custom controller"),
        (
            {"controller": "bund.py:Bound"},
            "field 'controller' is '.*bund.py:Bound': .* cannot be read",
        ),
        ({"controller": 3}, "field 'controller' is the number 3: expected FILE.py:NAME"),
    ],
)
def test_a_file_is_checked_against_its_controller(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        Sweep.from_dict(SPEC | change)


def test_the_path_of_a_controller_counts_from_its_files_folder(tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / "bound.py", tmp_path)
    (tmp_path / "sweep.yaml").write_text(
        "controller: bound.py:Bound\nvary: {reach: [0.01, 0.02]}\n"
    )
    sweep = Sweep.from_file(tmp_path / "sweep.yaml")
    assert sweep.setup.controller == f"{(tmp_path / 'bound.py').resolve()}:Bound"
    assert Sweep.from_text(sweep.to_yaml()).digest() == sweep.digest()


def test_the_gait_of_a_controller_with_other_parts_stands_in_the_file(tmp_path: Path) -> None:
    """Which reads back as the same sweep."""
    (tmp_path / "stiff.py").write_text(
        "from nermo_mjx import Controller\n"
        "stiff = Controller(spine=lambda params, phase, turn_rate, feet, stance: 0.0 * phase)\n"
    )
    sweep = Sweep.from_dict(
        {
            "controller": f"{tmp_path / 'stiff.py'}:stiff",
            "gait": "lateral_walk",
            "vary": {"stride": [0.5, 1]},
        }
    )
    reloaded = Sweep.from_text(sweep.to_yaml())
    assert (reloaded.setup.gait, reloaded.digest()) == ("lateral_walk", sweep.digest())
    assert reloaded.setup.defaults()["duty"] == 0.68


def test_a_tuning_may_tune_another_controllers_parameters() -> None:
    tuning = Tuning.from_dict(
        {
            "controller": BOUND,
            "run": {"duration": 1.0},
            "objective": [{"maximize": "speed"}],
            "tune": {"reach": {"bounds": [0.01, 0.05]}},
        }
    )
    assert (tuning.names, tuning.tuned[0].start) == (("reach",), 0.03)
    assert tuning.identity()["fields"]["controller"].startswith("Bound ")
    assert Tuning.from_text(tuning.to_yaml()).digest() == tuning.digest()


# --- under jax.grad


def lengths(function: Callable[[Any], float], argument: Any) -> float:
    """Arguments of a function that are collected in one traced call."""
    length_of_run = []
    jax.eval_shape(lambda traced: length_of_run.append(function(traced)), argument)
    return length_of_run[0]


def test_the_length_of_a_run_is_known_unless_it_hangs_on_what_is_traced() -> None:
    rollout = Rollout(run=Run(cycles=3, warmup_cycles=0), controller=BOUND)
    parameters = rollout.controller.parameters
    assert lengths(lambda reach: rollout.seconds({"frequency": 2.0, "reach": reach}), 0.03) == 1.5
    with pytest.raises(
        ParameterError, match="frequency is traced and the run is given in gait cycles"
    ):
        lengths(lambda frequency: rollout.seconds({"frequency": frequency}), 2.0)
    with pytest.raises(
        ParameterError, match="policy is traced and the run is given in gait cycles"
    ):
        lengths(lambda policy: rollout.seconds({}, policy), parameters)
    assert lengths(lambda policy: rollout.seconds({"frequency": 2.0}, policy), parameters) == 1.5
    rollout.slowest = 1.0
    assert lengths(lambda policy: rollout.seconds({}, policy), parameters) == 3.0


def without_touch(network: Any) -> Any:
    """A network without foot forces, which read zero at the start of a `Rollout`."""

    class Blind(type(network)):
        def reads(self, phase, sensors):
            return super().reads(phase, dataclasses.replace(sensors, foot_force=jnp.zeros(4)))

    return Blind()


@pytest.mark.release
def test_the_gradient_of_the_commands_by_the_policy_is_that_of_finite_differences() -> None:
    """Of all servos' targets after some ticks of controller, metrics and limits, on readings that are made up."""
    with jax.enable_x64(True):
        controller, robot = load_controller(f"{EXAMPLES / 'network.py'}:Network"), Setup().load()
        loop, random = ClosedLoop(robot, controller), np.random.default_rng(0)
        parameters = controller.parameters
        policy, direction = (
            jax.tree.map(lambda leaf: jnp.asarray(0.1 * random.normal(size=leaf.shape)), parameters)
            for _ in "ab"
        )
        rest_sensors = robot.sensordata_at_rest(jnp.asarray(robot.model.qpos0))
        readings = rest_sensors + 0.1 * random.normal(
            size=(4, loop.steps_per_tick, rest_sensors.size)
        )

        def commands(share):
            now = jax.tree.map(lambda leaf, to: leaf + share * to, policy, direction)
            world = Setup(controller=controller).world({}, now)
            params = LoopParameters(world.control, world.start, Window(), Servo(speed=1000.0))
            state = loop.init(params, rest_sensors)
            return jax.lax.scan(
                lambda state, sensors: loop.step(params, state, sensors), state, readings
            )[1][-1]

        program = jax.jit(commands)
        slope = jax.jit(jax.jacrev(commands))(0.0)
        expected = (program(1e-5) - program(-1e-5)) / 2e-5
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.long
def test_the_gradient_of_a_network_is_that_of_the_c_engine() -> None:
    """Along a direction in all weights, against central differences of another implementation, whose two worlds have
    policies of their own."""
    run, eps = Run(duration=0.3, warmup=0.1), 1e-5
    with jax.enable_x64(True):
        controller = without_touch(load_controller(f"{EXAMPLES / 'network.py'}:Network"))
        rollout = Rollout(run=run, controller=controller)
        random = np.random.default_rng(0)
        policy = jax.tree.map(
            lambda leaf: jnp.asarray(leaf + 0.1 * random.normal(size=leaf.shape), float),
            controller.parameters,
        )
        direction = jax.tree.map(
            lambda leaf: random.normal(size=leaf.shape) / leaf.size**0.5, policy
        )
        program = jax.jit(
            jax.grad(lambda policy: rollout({}, policy=policy)["speed"]),
            compiler_options=compiler_options(),
        )
        slope = program(policy)
        program.trace(policy).lower(
            lowering_platforms=("cuda", "tpu")
        )  # refused where an operation is missing there
        along = sum(
            float(jnp.vdot(a, b))
            for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(direction), strict=True)
        )
        simulator = Simulator(engine="c", controller=controller)
        simulator.engine.model.opt.tolerance = 0.0
        policies = jax.tree.map(
            lambda values, to: np.stack([values + eps * to, values - eps * to]), policy, direction
        )
        high, low = simulator({}, run, policy=policies)["speed"]
    assert all(np.abs(leaf).max() > 0.0 for leaf in jax.tree.leaves(slope))
    assert along == pytest.approx((high - low) / (2 * eps), rel=1e-3)


@pytest.mark.parametrize(
    "name", ["bound.py:Bound", "pattern.py:PatternGenerator", "network.py:Network"]
)
def test_an_example_is_a_page_and_a_controller(name: str) -> None:
    file, _, _ = name.partition(":")
    assert len((EXAMPLES / file).read_text().splitlines()) <= 75
    check_controller(Setup().load(), load_controller(str(EXAMPLES / name)))
