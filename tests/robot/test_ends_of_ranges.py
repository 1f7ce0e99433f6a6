# Tests of robot/quantity.py, robot/model_parameters.py
"""At both ends of every parameter's range, alone and combined: what is not refused is simulated, or said not to be."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from nermo_mjx import ParameterError, Run, Setup, Simulator
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.quantity import gathered
from nermo_mjx.rollout.setup import all_parameters

#: Choices that together read every parameter, with those of the scenes' terrain.
ALL = {
    "spine": "stride_extension+balance+harmonics",
    "trajectory": "free",
    "steering": "mix",
    "tail": "articulated",
    "tail_motion": "swing",
    "head": "gaze",
    "pilot": "arc",
    "physics": "fast",
}
LONG_TERRAINS = [
    pytest.param(scene, marks=pytest.mark.long) for scene in ("ramp", "logs", "stairs", "slalom")
]
COMBINED = (
    {"spine": "stride_extension"},
    {"gait": "walking_trot", "spine": "balance", "steering": "spine", "pilot": "open_loop"},
    {
        "gait": "lateral_walk",
        "spine": "stride_extension+harmonics",
        "steering": "mix",
        "pilot": "arc",
        "trajectory": "free",
    },
    {"gait": "bound", "trajectory": "linear", "tail": "articulated", "tail_motion": "counter_yaw"},
    {"gait": "gallop", "spine": "sagittal_extension", "robot": "nermo_41", "head": "gaze"},
    {
        "spine": "stride_extension+pitch_balance",
        "robot": "nermo_41",
        "routing": "type1",
        "profile": "as_published",
    },
)
#: Without a number where nothing failed, turned, moved, swung or stood.
WITHOUT = (
    "failure_time",
    "stride_",
    "stance_time",
    "duty_factor",
    "cross_track",
    "turning_radius",
    "cost_of_transport",
    "electrical_cost",
    "swing",
    "slip",
    "front_load",
    "tail_load",
)


def ends(setup: Setup) -> dict[str, tuple[float, float]]:
    """Both ends of each range; where a bound itself is excluded, a value close to it."""
    ranges = {}
    for name, quantity in all_parameters(setup).items():
        low, high = float(quantity.low), float(quantity.high)
        width = high - low if math.isfinite(high) else 1.0
        ranges[name] = (
            low + 1e-3 * width * quantity.open_low,
            high - 1e-3 * width * quantity.open_high,
        )
    return ranges


def accepted(setup: Setup, values: dict[str, float]) -> bool:
    """Whether a run of the values would be begun."""
    try:
        setup.check(setup.world({name: np.asarray(value) for name, value in values.items()}))
    except ParameterError:
        return False
    return True


def check(setup: Setup, worlds: list[dict[str, float]], seconds: float) -> None:
    """Run worlds, and hold what is `ok` to what is true of every walk."""
    defaults, simulator = setup.defaults(), Simulator(setup, engine="c")
    names = sorted({name for world in worlds for name in world})
    values = {
        name: np.array([world.get(name, defaults[name]) for world in worlds]) for name in names
    }
    result = simulator.run(values, Run(duration=seconds, warmup=0.2 * seconds), record=True)
    metrics, trace, model, parameters = (
        result.metrics,
        result.trace,
        simulator.robot.model,
        result.parameters,
    )
    low, high = model.actuator_ctrlrange.T
    knees = np.array(["knee" in model.actuator(i).name for i in range(model.nu)])
    margin = knees * np.asarray(parameters["servo.knee_range"])[:, None, None]
    low, high = low - margin, high + margin
    assert ((trace.ctrl >= low - 1e-6) & (trace.ctrl <= high + 1e-6)).all()
    for i, world in enumerate(worlds):
        if result.status[i] != "ok":
            continue
        undefined = [name for name, column in metrics.items() if not np.isfinite(column[i])]
        assert all(name.startswith(WITHOUT) for name in undefined), (world, undefined)
        assert np.isfinite(trace.qpos[i]).all(), world
        assert np.isfinite(trace.qvel[i]).all(), world
        # A walk is no faster than its feet go back; on a slope without friction it slides as fast as it may.
        world_parameters = {name: column[i] for name, column in parameters.items()}
        feet = (
            world_parameters["stride"]
            * world_parameters["stance.max_stride"]
            * world_parameters["frequency"]
            * world_parameters["gait_factor"]
        )
        fastest = max(0.5, 1.5 * feet / world_parameters["tracking.clock_ratio"])
        assert abs(metrics["speed"][i]) < fastest + 9.81 * seconds * ("ground.slope" in world), (
            world
        )
        body = [world_parameters[f"mass.{half}"] for half in ("front", "rear")]
        weight = world_parameters["ground.gravity"] * sum(body)
        if setup.scene == "flat" and "ground.slope" not in world:
            assert trace.sensors["foot_position"][i, ..., 2].min() > -0.004, world
            assert 0.0 < trace.qpos[i, :, 2].min() < trace.qpos[i, :, 2].max() < 0.25, world
            assert sum(metrics[f"load_{limb}"][i] for limb in LIMBS) < 1.5 * weight, world
        power = metrics["electrical_power"][i] * metrics["duration"][i]
        assert power >= metrics["servo_work"][i] * (1 - 1e-6) >= 0.0, world
        # The robot's kinetic energy cannot exceed what servos, the fall from its start and the slope have given.
        energy = (
            0.5 * sum(body) * np.sum(np.linalg.norm(trace.sensors["linear_velocity"][i, -1]) ** 2)
        )
        distance = np.linalg.norm(trace.qpos[i, -1, :2] - trace.qpos[i, 0, :2])
        fallen = 0.2 + distance * abs(np.sin(world_parameters["ground.slope"]))
        assert energy < metrics["servo_work"][i] / 0.8 + fallen * weight, world


@pytest.mark.long
@pytest.mark.release
def test_each_parameter_alone():
    """Of a row of numbers that differ in their place alone the first one; combinations have all of them."""
    setup = Setup(**ALL)
    bounds = ends(setup)
    names = [line.partition(" ... ")[0] for line, _ in gathered(all_parameters(setup))]
    worlds = [{name: value} for name in names for value in bounds[name]]
    accepted_worlds = [world for world in worlds if accepted(setup, world)]
    assert len(accepted_worlds) > 0.9 * len(
        [world for world in worlds if "terrain" not in str(world)]
    )
    check(setup, accepted_worlds, 0.5)


@pytest.mark.release
@pytest.mark.parametrize(
    "scene", [pytest.param("planks", marks=pytest.mark.release), "rough", *LONG_TERRAINS]
)
def test_each_parameter_of_a_terrain(scene):
    setup = Setup(scene=scene, physics="fast")
    worlds = [
        {name: value}
        for name, range_ends in ends(setup).items()
        if name.startswith("terrain")
        for value in range_ends
    ]
    accepted_worlds = [world for world in worlds if accepted(setup, world)]
    assert accepted_worlds
    check(setup, accepted_worlds, 0.5)


def combined(choices: dict[str, str], count: int, seed: int) -> None:
    """Worlds of which from three parameters to half of all are at an end."""
    setup, draw = Setup(physics="fast", **choices), random.Random(seed)
    bounds = ends(setup)
    excluded = ("terrain.", "geometry.", "start.x", "start.y")
    excluded += () if setup.trajectory == "free" else ("foot.", "limb.", "trim.")
    pool = [name for name in bounds if not name.startswith(excluded)]
    worlds: list[dict[str, float]] = []
    while len(worlds) < count:
        names = draw.sample(pool, draw.choice([3, 6, 12, len(pool) // 2]))
        world = {name: draw.choice(bounds[name]) for name in names}
        worlds += [world] if accepted(setup, world) else []
    check(setup, worlds, 1.0)


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    "choices",
    [
        COMBINED[0],
        *(pytest.param(combination, marks=pytest.mark.release) for combination in COMBINED[5::5]),
    ],
    ids=str,
)
def test_combinations(choices):
    combined(choices, 24, seed=0)


@pytest.mark.long
@pytest.mark.parametrize("choices", COMBINED, ids=str)
def test_a_thousand_combinations(choices):
    combined(choices, 170, seed=1)
