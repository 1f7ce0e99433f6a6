# Tests of robot/equipment.py
"""The preset `fast` walks as `reference` does, computes less, and is chosen by one name everywhere."""

from __future__ import annotations

import dataclasses
import math
import pickle

import mujoco
import numpy as np
import pytest

from nermo_mjx.control.parameters import published_values
from nermo_mjx.robot import LIMBS, Robot, load_robot
from nermo_mjx.robot.equipment import TRUNK_GEOMS
from nermo_mjx.robot.parameters import PRESETS
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.rollout.setup import all_parameters

#: The largest change of a gait metric that `fast` may bring: what docs/benchmarks/physics.md says. The identified servo
#: is stiff and hardly damped, and rings at 28 Hz, which longer steps change, and with it what depends on small motions:
#: the creep of soles, by which legs alone turn the robot.
BOUND = 0.025
BOUNDS = {
    "slip": 0.15,
    "servo_work": 0.065,
    "cost_of_transport": 0.065,
    "yaw_std": 0.15,
    "turning_radius": 0.05,
} | {f"duty_{limb}": 0.04 for limb in LIMBS}
#: Gaits, and the ends of the published range of frequencies [Hz].
GAITS, FREQUENCIES = ("trot", "walking_trot", "lateral_walk"), (0.5, 0.8)
GAIT_METRICS = (
    "speed",
    "distance",
    "roll_std",
    "pitch_std",
    "yaw_std",
    "slip",
    "servo_work",
    "cost_of_transport",
    *(f"duty_{limb}" for limb in LIMBS),
)
LEANING = math.radians(65.0)


def standing(robot: Robot) -> np.ndarray:
    """Servo targets of the published stance."""
    joints = robot.joints
    return robot.model.qpos0[
        [*joints.hip, *joints.pulley, joints.spine_pulley, joints.neck, *joints.tail_pulley]
    ]


def six_walks(**fixed: float) -> dict[str, np.ndarray]:
    """Every gait at both frequencies, as parameters of one batch."""
    rows = [
        published_values(gait, steering="mix") | {"frequency": frequency} | fixed
        for gait in GAITS
        for frequency in FREQUENCIES
    ]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


# --- the same gait


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    ("spine", "turn_rate"),
    [
        ("stride_extension", 0.0),
        pytest.param("none", 0.7, marks=pytest.mark.long),
        pytest.param("none", 0.0, marks=pytest.mark.long),
        pytest.param("stride_extension", 0.7, marks=pytest.mark.long),
    ],
)
def test_fast_keeps_every_gait_metric_within_its_bound(simulator, spine, turn_rate):
    """Three gaits at both ends of the published frequencies, with and without spine, straight and in a turn.

    In the mean of three starts in different phases: rounding alone moves a lateral walk's roll by 1 %.
    """
    metrics_values = six_walks(
        **{"pilot.turn_rate": turn_rate, "spine.amplitude": 0.2, "spine.phase": -0.5}
    )
    values = {name: np.tile(column, 3) for name, column in metrics_values.items()}
    values["start.phase"] = np.repeat([0.0, 1 / 3, 2 / 3], 6)
    pilot, run = "open_loop" if turn_rate else "straight", Run(cycles=6, warmup_cycles=2)
    ours, reference = (
        simulator(physics=physics, spine=spine, pilot=pilot, steering="mix").run(values, run)
        for physics in ("fast", "reference")
    )
    assert list(ours.status) == list(reference.status) == ["ok"] * 18
    for name in (*GAIT_METRICS, "turning_radius") if turn_rate else GAIT_METRICS:
        bound = BOUNDS.get(name, BOUND)
        fast, exact = (
            result.metrics[name].reshape(3, 6).mean(axis=0) for result in (ours, reference)
        )
        np.testing.assert_allclose(fast, exact, rtol=bound, err_msg=name)


@pytest.mark.release
def test_a_fall_is_reported_by_both(simulator):
    """A robot let go while it leans by 65 degrees has fallen, in the same tick; the one beside it walks on."""
    fell = []
    for physics in PRESETS:
        sim = simulator(physics=physics)
        batch = sim.prepare({"frequency": np.full(2, 0.8)}, Run(cycles=3, warmup_cycles=0))
        root, height = sim.robot.joints.root, 0.12
        batch.qpos[1, root + 2 : root + 7] = (
            height,
            math.cos(LEANING / 2),
            0.0,
            math.sin(LEANING / 2),
            0.0,
        )
        session = sim.engine.open(batch.params, batch.qpos, batch.fields)
        session.advance(150)
        measured = session.loop_state.metrics
        np.testing.assert_array_equal(measured.fell, [False, True])
        np.testing.assert_array_equal(measured.diverged, [False, False])
        fell.append(measured.failure_time[1])
    assert fell[0] == pytest.approx(fell[1], abs=0.011)


# --- less to compute


def test_fast_makes_three_steps_where_reference_makes_five(simulator):
    """A control period of 10 ms, in steps of 10/3 ms and of 2 ms."""
    steps = {physics: simulator(physics=physics).loop.steps_per_tick for physics in PRESETS}
    assert steps == {"reference": 5, "fast": 3}


@pytest.mark.parametrize("scene", ["flat", "maze"])
def test_only_the_soles_touch_the_ground_in_fast(scene):
    """The trunk's pairs with the floor are gone, and no others: obstacles still stop the whole robot."""

    def pairs(physics: str) -> set[frozenset[str]]:
        model = load_robot(scene=scene, physics=physics).model
        geom_pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
        return {frozenset(model.geom(int(geom)).name for geom in pair) for pair in geom_pairs}

    assert pairs("reference") - pairs("fast") == {
        frozenset(("floor", part)) for part in TRUNK_GEOMS
    }
    assert pairs("fast") < pairs("reference")


# --- one name


def test_the_default_is_the_reference():
    """Nothing named is `reference` at 2 ms, the same robot as with both named."""
    explicit = load_robot(physics="reference", timestep=0.002)
    assert (load_robot().config, load_robot().fingerprint) == (
        explicit.config,
        explicit.fingerprint,
    )
    assert Setup() == Setup(physics="reference", timestep=0.002)


def test_a_given_time_step_wins_over_the_presets():
    """What is given beside a preset counts, whether finer or coarser; the preset's other choices stay."""
    assert Setup(physics="fast").timestep == pytest.approx(0.01 / 3)
    assert Setup(physics="fast", timestep=0.001).load().model.opt.timestep == 0.001
    assert Setup(physics="fast", timestep=0.001).load().model.npair == len(LIMBS) + 1
    assert Setup(timestep=0.0025).load().model.npair == len(LIMBS) + 1 + len(TRUNK_GEOMS)


def test_another_preset_brings_its_time_step_unless_one_was_given():
    """`dataclasses.replace` of a setup; also after it was copied, pickled or replaced before."""
    fast = dataclasses.replace(Setup(), physics="fast")
    assert fast == Setup(physics="fast")
    assert dataclasses.replace(pickle.loads(pickle.dumps(fast)), physics="reference") == Setup()
    assert dataclasses.replace(Setup(timestep=0.002), physics="fast").timestep == 0.002
    assert dataclasses.replace(fast, timestep=0.001, physics="reference").timestep == 0.001


@pytest.mark.parametrize("physics", PRESETS)
def test_no_time_constant_is_lengthened_without_a_word(physics):
    """MuJoCo takes two time steps for what is shorter: the model says what it computes with."""
    model = load_robot(physics=physics).model
    for name in ("tendon_solref_lim", "pair_solref", "jnt_solref"):
        assert np.all(getattr(model, name)[:, 0] >= 2 * model.opt.timestep), name


@pytest.mark.release
def test_tendons_of_fast_yield_as_the_docs_say():
    """A tenth further under the same pull than those of `reference`: most of it is their onset, not their stiffness."""
    yields = {}
    for physics in PRESETS:
        model = load_robot(physics=physics).model
        data = mujoco.MjData(model)
        for _ in range(round(1.0 / model.opt.timestep)):
            data.ctrl[:] = standing(load_robot(physics=physics))
            mujoco.mj_step(model, data)
        stretch = data.ten_length - model.tendon_range[:, 1]
        yields[physics] = stretch[
            [i for i in range(model.ntendon) if model.tendon(i).name.startswith("rear")]
        ].mean()
    assert yields["reference"] == pytest.approx(7.9e-5, abs=5e-6)
    assert yields["fast"] == pytest.approx(8.7e-5, abs=5e-6)


def test_contacts_are_no_stiffer_than_the_step_allows():
    """MuJoCo would lengthen a time constant below two steps without a word."""
    names = {
        physics: all_parameters(Setup(physics=physics))["contact.time_constant"]
        for physics in PRESETS
    }
    assert names["reference"].low == 0.004
    assert names["fast"].low == pytest.approx(0.02 / 3)


def test_the_rest_of_the_model_is_the_same():
    """Nothing but the time step and the pairs differs: masses, springs, tendons, servos and sensors are equal."""
    ours, reference = (load_robot(physics=physics).model for physics in ("fast", "reference"))
    for field in (
        "body_mass",
        "body_inertia",
        "jnt_stiffness",
        "dof_damping",
        "dof_armature",
        "tendon_range",
        "wrap_type",
        "actuator_gainprm",
        "actuator_forcerange",
        "sensor_type",
        "qpos0",
        "geom_type",
        "site_pos",
    ):
        np.testing.assert_array_equal(
            getattr(ours, field), getattr(reference, field), err_msg=field
        )
    for option in (
        "integrator",
        "solver",
        "cone",
        "impratio",
        "tolerance",
        "iterations",
        "disableflags",
    ):
        assert getattr(ours.opt, option) == getattr(reference.opt, option), option
