# Tests of __init__.py, robot/quantity.py, rollout/setup.py, learn/task.py
"""What cannot be is refused in one sentence, before anything runs: the field, its value, and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import shared_simulator

from nermo_mjx import ParameterError, Rollout, Run, Setup, servo_table
from nermo_mjx.bench import run_bench
from nermo_mjx.control import control_parameters, published_controller
from nermo_mjx.control.path import course_through
from nermo_mjx.control.pilot import tabulated
from nermo_mjx.control.schedule import Switch
from nermo_mjx.hardware import connected
from nermo_mjx.kinematics import leg
from nermo_mjx.learn import Environment, Modulation, Residual, Task, Term, Training
from nermo_mjx.learn.task import select_terms
from nermo_mjx.physics import resolve_engine
from nermo_mjx.physics.engine import choose_devices
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import RobotConfig, assemble_leg, load_robot
from nermo_mjx.robot.parameters import FRONT_LEG
from nermo_mjx.robot.quantity import quantities
from nermo_mjx.rollout.setup import WorldParameters
from nermo_mjx.sweep import Sweep

DEVICES = len(jax.local_devices())
ONE_CYCLE = Run(cycles=1, warmup_cycles=0)
LINE = ((0.0, 0.0), (0.0, -0.7), (0.0, -1.0), (0.0, -2.0))
CIRCLE = [
    (0.03 * (1.0 - np.cos(angle)), -0.03 * np.sin(angle)) for angle in np.linspace(0.0, 3.0, 40)
]
STIFF = r"contact\.time_constant.*0\.005.*\[0\.00666667, 0\.1\] s"
FREE = "trajectory: free\nspine: harmonics\n"
SWITCHED = """run: {duration: 8.0}
schedule:
  - {at: 1.5, gait: lateral_walk, spine: stride_extension}
  - {at: 4.0, blend: 2.0, set: {stride: 0.8}}
vary:
  schedule.at.1: [1.2, 1.6]
  spine.amplitude: [0.2, 0.4]
"""
CHANNELS = {
    "spine": {"channel": 0, "direction": -1, "zero": 90.0},
    "front_left_hip": {"channel": 2},
}
TWO = {"scene": "ramp"}, {"scene": "rough"}


def named(function: Callable[..., Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda keywords: function(**keywords)


def of_world(values: dict[str, Any], **choices: Any) -> None:
    setup = Setup(**choices)
    setup.check(setup.world({name: np.asarray(value) for name, value in values.items()}))


def switched(switches: list[dict[str, Any]]) -> None:
    of_world({}, schedule=tuple(Switch(**{"at": 2.0, **switch}) for switch in switches))


def rollout(values: dict[str, Any]) -> Any:
    return Rollout(Setup(), ONE_CYCLE, "mjx")(values)


def fast(values: dict[str, Any]) -> None:
    """Of a simulator; a rollout says the same."""
    with pytest.raises(ParameterError) as error:
        Rollout(Setup(physics="fast"))(values)
    with pytest.raises(ParameterError, match=re.escape(str(error.value))):
        shared_simulator(Setup(physics="fast"), "c").parameters(values)
    raise error.value


def sweep(text: str) -> None:
    Sweep.from_text(text, "s.yaml")


def task(make: Callable[[], Task]) -> None:
    Environment(Setup(physics="fast"), worlds=1, task=make())


#: Function -> what it is given, and a part of the sentence: a text, or a pattern.
REFUSED: dict[Callable[[Any], Any], list[tuple[Any, str]]] = {
    named(RobotConfig): [
        ({"timestep": 0.1}, "timestep is 0.1: allowed is [1e-05, 0.005] s."),
        ({"timestep": float("nan")}, "timestep is nan: allowed is [1e-05, 0.005] s."),
        *(
            ({"hinges": hinges}, f"hinges is {hinges!r}: allowed is a whole number from 1 to 6.")
            for hinges in (0, 7, 2.0, True, "3")
        ),
    ],
    named(Setup): [
        (
            {"spine": "stride_extension+pitch_balance"},
            "which robot 'nermo_lite' does not have; it goes with robot",
        ),
        (
            {"tail_motion": "swing"},
            "tail_motion is 'swing' and tail 'rigid': take the tail 'articulated'",
        ),
        ({"hinges": 9}, "hinges is 9: allowed is a whole number from 1 to 6."),
    ],
    named(published_controller): [
        ({"spine": "stride_extension+balanse"}, "did you mean 'balance'?"),
        ({"routing": "type4"}, "routing is 'type4'"),
        ({"pilot": "external"}, "command is missing"),
        ({"command": tabulated([0.0], 0.1, 0.0)}, "command is given"),
        ({"spine": "balance"}, "masses is None"),
        ({"pilot_rate": 30.0}, "pilot_rate is 30: allowed is 100 Hz divided by a whole number"),
        ({"pilot_rate": 200.0}, "pilot_rate is 200"),
        ({"control_rate": 0.0}, "control_rate is 0: allowed is (0, inf) Hz"),
    ],
    named(control_parameters): [
        ({"duty": np.array([0.5, 1.0])}, "duty is 1: allowed is [0.01, 1)"),
        ({"frequenzy": 1.0}, "parameter is 'frequenzy': did you mean 'frequency'?"),
        (
            {"stance.max_stride": 0.08, "stance.front_z": -0.056},
            r"stance.max_stride is 0.08 m: .*is \[0, 0.056\] m",
        ),
        ({"stride": np.array([0.5, 1.2]), "stance.front_z": -0.058}, "stride is 1.2: .*allowed is"),
        ({"stance.rear_z": -0.072}, "stance.rear_z is -0.072 m"),
    ],
    course_through: [
        (LINE[:2], "The way points have shape (2, 2): expected at least three rows of (x, y)."),
        (
            [(0, 0, 0)] * 4,
            "The way points have shape (4, 3): expected at least three rows of (x, y).",
        ),
        (
            [(0, 0), (0, -1), (0, np.nan)],
            "Way point 2 is (0, nan): expected finite numbers, allowed up to 10000 m.",
        ),
        (
            [(0, 0), (0, -1), (0, -1e308)],
            "Way point 2 is (0, -1e+308): expected finite numbers, allowed up to 10000 m.",
        ),
        (
            [(-1e308, 0), (1e308, -1), (0, -2)],
            "Way point 0 is (-1e+308, 0): expected finite numbers, allowed up to 10000 m.",
        ),
        ([(0, 0), (0, 10**400), (0, -2)], "The way points are not numbers in rows of (x, y)."),
        ([(0, 0), (0, -9000), (9000, -9000)], "The course is 18000 m long: allowed are 10000 m."),
        ([(0, 0), (0, -1), (0, -1), (0, -2)], "Way point 2 repeats the one before it."),
        (CIRCLE, r"The course bends with a radius of 0.0\d+ m: allowed is at least 0.05 m."),
        (
            [(0, 0), (0, -1), (0, 0)],
            r"The course bends with a radius of \S+ m: allowed is at least 0.05 m.",
        ),
        ([(0, 0), (0, -1), (1,)], "The way points are not numbers in rows of (x, y)."),
    ],
    lambda arguments: tabulated(*arguments): [
        (([0.0, 0.0], 0.1, 0.0), "command.time is not increasing at 0 s"),
        (([], 0.1, 0.0), "command.time has shape"),
        (([0.0, 1.0], [0.1], 0.0), "command.speed has shape (1,): expected (2,)"),
        (([0.0, 1.0], 0.1, [0.0, 1.5]), "command.turn_rate is 1.5: allowed is [-1, 1]"),
        (([0.0, 1.0], -0.1, 0.0), "command.speed is -0.1: allowed is"),
        (([0.0, np.nan], 0.1, 0.0), "command.time is nan: expected finite numbers"),
        (([0.0, 1.0], "fast", 0.0), "command.speed is 'fast': expected numbers"),
    ],
    of_world: [
        (
            {"geometry.rear_leg.upper": 0.06},
            "geometry.rear_leg.upper is 0.06: allowed is [0.019, 0.0507] m.",
        ),
        (
            {"geometry.front_leg.attachment": 0.0228},
            "geometry.front_leg.attachment is 0.0228 m: the tendon would be tied beyond the ankle; allowed is at most "
            "geometry.front_leg.lower, 0.0225 m.",
        ),
        (
            {"geometry.hip.x": 0.03, "geometry.spine.pulley_radius": 0.008},
            "geometry.hip.x is 0.03 m: the hips' servos would overlap the spine's pulley, .* at least 0.0316 m.",
        ),
        (
            {"geometry.rear_leg.upper": 0.019, "geometry.rear_leg.lower": 0.0201},
            "the rear foot leaves its leg's workspace even without a stride, with geometry.rear_leg.upper 0.019 m and "
            "geometry.rear_leg.lower 0.0201 m.",
        ),
        (
            {"terrain.slope": 0.2},
            "terrain.slope has no effect: it is read only with scene ramp, and the scene is",
        ),
    ],
    fast: [
        ({"contact.time_constant": 0.005}, STIFF),
        (
            {"servo.kp": 100.0, "servo.kv": 0.3},
            "servo.kv is 0.3: allowed is [0, 0.184333] N m s/rad beside servo.kp",
        ),
    ],
    lambda values: shared_simulator(Setup(), "c").prepare(values, ONE_CYCLE): [
        (
            {"frequency": np.zeros((2, 2))},
            "frequency has shape (2, 2): allowed is a number, or (n,) with one for each",
        ),
        ({"frequency": "fast"}, "frequency is 'fast': expected a number"),
        ({"frequency": [0.5, [0.6]]}, "frequency is [0.5, [0.6]]: expected a number"),
    ],
    rollout: [
        ({"spine.amplitud": 0.2}, "spine.amplitud"),
        ({"frequency": -1.0}, "frequency is -1: allowed is"),
        ({"stride": np.array([0.5, 1.0])}, r"stride has shape \(2,\).*jax.vmap"),
        (
            {"terrain.slope": 0.2},
            "terrain.slope has no effect: it is read only with scene ramp, and the scene is",
        ),
    ],
    lambda name: jax.eval_shape(lambda value: rollout({name: value}), jnp.asarray(0.8)): [
        ("frequency", "frequency is traced.*slowest"),
    ],
    lambda run: Rollout(Setup(), run): [
        (Run(cycles=4, distance=1.0), "run.distance is given"),
        (Run(cycles=np.array([4.0, 5.0])), "one length for each world"),
    ],
    switched: [
        ([{"gait": "tro"}], "gait is 'tro': did you mean 'trot'?"),
        ([{}], "switch changes nothing"),
        (
            [{"values": {"freq": 1.0}}],
            "schedule.1 is refused: parameter is 'freq': did you mean 'frequency'?",
        ),
        ([{"values": {"mass.front": 0.2}}], "schedule.1 is refused: parameter is 'mass.front'"),
        (
            [{"values": {"frequency": 9.0}}],
            "schedule.1 is refused: frequency is 9: allowed is [0.001, 5] Hz",
        ),
        (
            [{"gait": "lateral_walk", "blend": 0.1}],
            "schedule.blend.1 is 0.1: allowed is more than 0.32 cycles",
        ),
        (
            [{"gait": "lateral_walk"}, {"at": 2.1, "gait": "trot"}],
            "schedule.at.2 is 2.1: allowed is at least 3.49",
        ),
        ([{"gait": "lateral_walk"}] * 9, "schedule has 9 switches: allowed are 8"),
        ([{"spine": "pitch_balance"}], "it goes with robot 'nermo_41'"),
        ([{"tail_motion": "swing"}], "tail_motion is 'swing' and tail 'rigid'"),
    ],
    sweep: [
        (
            FREE + "vary: {foot.middle.*: [0.0, 0.001]}",
            "s.yaml:3: field 'foot.middle.*' matches no parameter",
        ),
        (
            FREE + "vary:\n  foot.front.*: [0.001]\n  foot.*.y1: [0.0]",
            "s.yaml:5: .*and 'foot.front.*' both match foot.front.y1",
        ),
        (
            FREE + "vary:\n  foot.front.y1: [0.001]\n  limb.lift.*: [0.01, 0.5]",
            "s.yaml:5: .*'limb.lift.front' is 0.5: allowed is",
        ),
        (
            FREE + "set: {spine.amplitude: 0.1}\nvary: {spine.amplitude: [0.0]}",
            "s.yaml:4: .*also fixed under 'set'",
        ),
        *(
            (
                f"vary: {{{name}: [0.0, 0.001]}}",
                f"'{name}' has no effect: it is read only with {needs}",
            )
            for name, needs in (
                ("foot.front.y1", "trajectory: free"),
                ("spine.harmonics.cos1", "spine: harmonics"),
                ("head.gain", "head: gaze"),
                ("tail.angle", "tail: articulated"),
                ("terrain.height", "scene: planks"),
            )
        ),
        (
            "vary: {frequency: [0.5, 0.6]}\nphysics: fats\n",
            "s.yaml:2: field 'physics' is 'fats'.*did you mean 'fast'",
        ),
        ("vary: {contact.time_constant: [0.005, 0.01]}\nphysics: fast", STIFF),
        *(
            (SWITCHED.replace(old, new), expected)
            for old, new, expected in (
                (
                    "gait: lateral_walk",
                    "gait: laterl_walk",
                    "s.yaml:3: field 'schedule.0.gait' is 'laterl_walk'",
                ),
                (
                    "{stride: 0.8}",
                    "{strid: 0.8}",
                    "s.yaml:4: field 'schedule.1' is refused: parameter is 'strid'",
                ),
                (
                    "at: 4.0",
                    "at: soon",
                    "s.yaml:4: field 'schedule.1.at' is the text 'soon': expected a number",
                ),
                ("at: 1.5, ", "", "s.yaml:3: field 'schedule.0' has no 'at'"),
                ("[1.2, 1.6]", "[1.2, 3.9]", "s.yaml:6: field 'schedule.at.1'"),
                ("schedule.at.1", "schedule.at.3", "s.yaml:6: "),
            )
        ),
    ],
    task: [
        (lambda: Task(decimation=0), "decimation is 0: allowed is a whole number from 1 on."),
        (lambda: Task(episode_length=-1.0), "episode_length is -1.0: allowed is (0, inf)."),
        (
            lambda: Task(randomize={"contact.fricton": (1.0, 2.0)}),
            "did you mean 'contact.friction'?",
        ),
        (lambda: Task(randomize={"contact.friction": (0.0, 2.0)}), "allowed is [0.05, 5]"),
        (
            lambda: Task(randomize={"frequency": (1.0, 1.0)}),
            "the low end is not below the high one",
        ),
        (
            lambda: Task(set={"frequency": 1.0}, randomize={"frequency": (0.5, 1.0)}),
            "leave one out",
        ),
        (lambda: Task(set={"terrain.height": 0.01}), "which the scene 'flat' has not"),
        (
            lambda: Task(bodies=True, randomize={"servo.kp": (10.0, 20.0)}),
            "the identified bodies bring",
        ),
        (lambda: Task(observe=("gyro", "smell")), "observe has 'smell': allowed is servo_angle"),
        (lambda: Task(rewards={"progres": 1.0}), "did you mean 'progress'?"),
        (lambda: Task(rewards={"speed": 1.0}), "name command.speed under set or randomize"),
        (
            lambda: Task(action=Modulation({"frequencies": (0.4, 1.0)})),
            "no parameter of the controller",
        ),
        (lambda: Task(action=Residual(hip=3.0)), "residual.hip is 3.0: allowed is [0, 1.6] rad."),
    ],
    Training.from_dict: [
        (
            {"task": {"rewards": {"progres": 1.0}}},
            "field 'task.rewards.progres' is no term of the reward; allowed are",
        ),
        (
            {"task": {"observe": ["smell"]}},
            "field 'task.observe.0' is the text 'smell': allowed are",
        ),
        (
            {"task": {"action": "fly"}},
            "field 'task.action' is 'fly': expected residual, modulation or targets",
        ),
        ({"task": {"rewards": {"speed": 1.0}}}, "and nothing is commanded: name command.speed"),
        ({"randomize": {"contact.friction": [1.6, 1.0]}}, "the low end is not below the high one"),
        ({"randomize": {"contact.frictio": [1.0, 1.6]}}, "did you mean 'contact.friction'"),
        (
            {"worlds": 3, "algorithm": {"ppo": {"horizon": 5}}},
            "4 minibatches, .* choose a number that divides 15",
        ),
        ({"algorithm": "dqn"}, "field 'algorithm' is 'dqn': expected ppo as a name"),
        (
            {"algorithm": "short_horizon"},
            "field 'algorithm' is 'short_horizon', which was removed: use ppo.",
        ),
        (
            {"algorithm": {"short_horizon": {"horizon": 8}}},
            "is 'short_horizon', which was removed: use ppo.",
        ),
        ({"vary": {"frequency": [1.0]}}, "is no field of a training: .* stands under 'randomize'"),
        (
            {"schedule": [{"at": 1.5, "gait": "lateral_walk"}]},
            "field 'schedule' is of a walk, not of a training",
        ),
        ({"evaluate": {"scenes": ["moon"]}}, "moon"),
        (
            {"evaluate": {"set": {"terrain.height": 0.01}}},
            "'evaluate.set.terrain.height' is no parameter of the eval",
        ),
        (
            {"scene": "planks", "evaluate": {"set": {"terrain.height": 1}}},
            "is 1: allowed is [0, 0.05] m",
        ),
        (
            {"evaluate": {"randomize": {"terrain.height": [0, 0.01]}}},
            "'evaluate.randomize.terrain.height' is no param",
        ),
        (
            {"evaluate": {"randomize": {"start.yaw": [0.1, 0.0]}}},
            "the low end is not below the high one",
        ),
        (
            {"evaluate": {"set": {"start.yaw": 0.1}, "randomize": {"start.yaw": [0, 0.1]}}},
            "'evaluate.randomize.start.yaw' stands under set, too",
        ),
        ({"scenes": [{"scene": "planks"}]}, "field 'scenes' has 1: expected two or more"),
        (
            {"scene": "flat", "scenes": [{"scene": "planks"}]},
            "field 'scene' stands beside 'scenes'",
        ),
        (
            {"evaluate": {"physics": "slow"}},
            "'evaluate.physics' is the text 'slow': allowed are reference, fast",
        ),
        (
            {"until": {"success": 0.9}},
            "'until' stands without 'validation', the number of walks that decide",
        ),
        (
            {"validation": 9, "until": {"speed": 0.1}},
            "'until' has no 'success': expected {success: 0.95}",
        ),
        ({"validation": 9, "until": {"success": 1.5}}, "'until.success' is 1.5"),
        ({"scenes": [{"scene": "planks"}] * 2}, "'scenes.1.scene' is 'planks' for a second time"),
        (
            {"scenes": [TWO[0], {"scene": "slalom", "set": {"terrain.height": 0.01}}]},
            "'scenes.1.set' has 'terrain.height', which the scene 'slalom' has not",
        ),
        ({"scenes": [TWO[0], TWO[1] | {"pilot": "open_loop"}]}, "'rough', where a policy observes"),
        ({"scenes": [TWO[0], TWO[1] | {"corridor": 0.0}]}, "'scenes.1.corridor' is 0"),
        ({"worlds": 1, "scenes": [*TWO]}, "2 scenes need at least one world each"),
    ],
    named(servo_table): [
        ({"rate": 0.0}, "rate is 0 Hz: allowed is (0, 1000]."),
        ({"rate": 1.0}, "needs at least four rows"),
        ({"cycles": 0}, "allowed is a whole number from 1 on"),
        ({"cycles": 10**7}, "rows, of 1,000,000."),
        ({"values": {"frequncy": 1.0}}, "frequncy"),
        ({"values": {"frequency": np.array([0.5, 0.6])}}, "a servo table is of one gait"),
        ({"values": {"stride": 3.0, "stance.max_stride": 0.15}}, "stride"),
        ({"setup": Setup(head="gaze")}, "which answers to sensors: a servo table reads none"),
        (
            {"setup": Setup(tail="articulated", tail_motion="counter_roll")},
            "which answers to sensors",
        ),
        (
            {"rate": 30.0, "channels": {"front_left_hip": {"channel": 0, "high": 45}}},
            r"front_left_hip would go to 8\d\.\d deg at .* above its limit of 45\.0 deg",
        ),
        (
            {"channels": {"spine": {"channel": 0}, "tail": {"channel": 1}}},
            "tail is no servo of the robot with tail",
        ),
        (
            {"channels": {"whole_degrees": "floored", **CHANNELS}},
            "field 'whole_degrees' is 'floored': allowed is rounded or truncated",
        ),
        *(
            ({"channels": CHANNELS | wrong}, expected)
            for wrong, expected in (
                (
                    {"spin": {"channel": 3}},
                    "neck, tail, spine_vertical, head; did you mean 'spine'?",
                ),
                ({"neck": {"channel": 2}}, "is 2, which front_left_hip has already."),
                ({"neck": {"channel": -1}}, "is -1: expected a whole number from 0"),
                (
                    {"neck": {"zero": 90}},
                    "field 'neck' has no 'channel': expected a mapping such as {channel: 0",
                ),
                ({"neck": {"channel": 3, "direction": 2}}, "is 2: allowed is 1 or -1."),
                (
                    {"neck": {"channel": 3, "zeros": 2}},
                    "direction, zero, low, high, missing; did you mean 'zero'?",
                ),
                (
                    {"neck": {"channel": 3, "zero": "ninety"}},
                    "field 'neck.zero' is the text 'ninety': expected a number.",
                ),
                ({"neck": {"channel": 3, "low": 100, "high": 80}}, "low must be less."),
                ({"neck": 3}, "expected a mapping"),
            )
        ),
    ],
    lambda url: connected(url).__enter__(): [
        (
            "http://a",
            "send is 'http://a': allowed is mqtt://HOST[:PORT], ws://HOST[:PORT] or print:",
        ),
        *(
            (url, "with a port from 1 to 65535, and USER:PASSWORD@ before HOST")
            for url in (
                "mqtt://h:99999",
                "mqtt://h:0",
                "ws://h:x",
                "mqtt://:p@h",
                "mqtt://u:p#s@h",
                "mqtt://h/topic",
            )
        ),
    ],
    lambda arguments: run_bench(*arguments): [
        ((["speed"],), "case is 'speed': allowed is one of throughput, startup."),
        ((["throughput"], ["cpu"]), "engine is 'cpu': allowed is one of auto, c, mjx, warp."),
        ((["throughput"], ["c"], [0]), "worlds is 0: allowed is a whole number from 1."),
    ],
    choose_devices: [
        (devices, f"devices is {devices}: allowed is 1 to {DEVICES}, ") for devices in (0, -1, 100)
    ],
    assemble_leg: [("tail", "limb is 'tail': allowed is one of front_left, ")],
    lambda solve: solve(leg.leg_of(FRONT_LEG), np.zeros(2), "type4"): [
        (solve, "type4.*type1, type2, type3")
        for solve in (leg.forward_kinematics, leg.inverse_kinematics)
    ],
    lambda values: compile_model(load_robot(), values): [
        ({"contact.glue": 1.0}, "contact.glue is not a parameter.")
    ],
    resolve_engine: [("mujoco", "engine is 'mujoco': allowed is one of auto, c, mjx, warp.")],
    lambda term: select_terms({"work": 1.0, term: 1.0}, ()): [
        (Term("work", "J", "another", lambda m: m.speed), "two terms of one name"),
    ],
}


@pytest.mark.release
@pytest.mark.parametrize(
    ("act", "arguments", "expected"),
    [pytest.param(act, *case, id=case[1][:60]) for act, cases in REFUSED.items() for case in cases],
)
def test_what_cannot_be_is_refused_in_a_sentence(
    act: Callable[[Any], Any], arguments: Any, expected: str
) -> None:
    with pytest.raises(ParameterError) as error:
        act(arguments)
    sentence = str(error.value)
    assert expected in sentence or re.search(expected, sentence), sentence
    assert "\n" not in sentence
    assert sentence[-1] in ".?"


def test_a_choice_that_there_is_not_is_answered_with_those_that_there_are() -> None:
    fields = "robot tail routing cone physics gait spine steering profile pilot trajectory head tail_motion scene"
    for field in fields.split():
        default = str(getattr(Setup(), field))
        with pytest.raises(
            ParameterError, match=rf"^{field} is '{default}x': .*allowed is .*\b{default}\b.*\.$"
        ):
            Setup(**{field: f"{default}x"})


def test_a_value_out_of_its_range_is_answered_with_the_range() -> None:
    for name, quantity in quantities(WorldParameters):
        for end, outside in ((quantity.low, -0.01), (quantity.high, 0.01)):
            for value in [end + outside * (1.0 + abs(end))] * bool(np.isfinite(end)) + [
                np.nan,
                np.inf,
            ]:
                sentence = f"{name} is {value:g}: allowed is {quantity.allowed()}."
                with pytest.raises(ParameterError, match=f"^{re.escape(sentence)}$"):
                    quantity.check(name, [quantity.default, value])
        quantity.check(name, quantity.default)


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("spine.ampl", "spine.amplitude"),
        ("foot_radius", "geometry.foot.radius"),
        ("knee.damping", "damping.knee"),
        ("amplitude", "spine.amplitude"),
    ],
)
def test_an_unknown_parameter_has_the_nearest_beside_it(name: str, near: str) -> None:
    """By its last parts, in any order, also of the lengths, which a world has only if one is named."""
    with pytest.raises(
        ParameterError, match=f"^{re.escape(name)} is not a parameter; did you mean '{near}'"
    ):
        Setup(spine="stride_extension").world({name: 0.1})
