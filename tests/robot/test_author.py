# Tests of robot/parameters.py, control/controller.py
"""The published simulation, `as_published`, beside the author's own code and model: numbers, with their settings.

His model's numbers are of MuJoCo 3.17.0: MuJoCo 4 leads his tendons to the other side of their pulleys, and his model
walks at 54 instead of 75 mm/s in it.
"""

from __future__ import annotations

import copy
import functools
from pathlib import Path

import jax
import mujoco
import numpy as np
import pandas as pd
import pytest
from test_controller import walk

from nermo_mjx.control import control_parameters, published_controller
from nermo_mjx.control.parameters import PUBLISHED_BODY, PUBLISHED_PROFILE, published_values
from nermo_mjx.kinematics.body import hip_height_offset
from nermo_mjx.kinematics.leg import four_legs, inverse_kinematics
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import LIMBS
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import FRONT_LEG, REAR_LEG
from nermo_mjx.rollout import Run, Setup
from nermo_mjx.rollout.run import START_SPREAD

DATA = Path(__file__).parents[1] / "data"
STREAM = pd.read_csv(DATA / "author_servo_stream.csv", comment="#")
CYCLE = pd.read_csv(DATA / "author_servo_cycle.csv", comment="#")
GRID = pd.read_csv(DATA / "author_model_grid.csv", comment="#")
#: Neutral feet of his model, of the front and the rear legs, without gravity: (y, z) in the torso's frame from the
#: point between the shoulders [m].
HIS_FEET = ((-0.00377, -0.03960), (0.12699, -0.03718))
#: His `compute_leg_offset` at 0.4 rad, left and right [m]; feet as committed at 736e7ec.
HIS_OFFSETS = (-0.0061911, 0.0039782)
CASES = [
    key
    for key, _ in STREAM.groupby(["gait", "frequency", "stride_extension", "offset_compensation"])
]


@functools.cache
def commanded_ticks(
    gait: str, frequency: float, extends: int, offset: int, gain: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times of 100 Hz ticks on the author's clock (T,), and servo angles in his order (T, 9)."""
    controller = published_controller(
        "stride_extension" if extends else "none", "open_loop", pilot_rate=100.0
    )
    values = {
        "tracking.clock_ratio": 1.0,
        "tracking.foot_gain": gain,
        "spine.offset_compensation": float(offset),
    }
    params = control_parameters(gait, profile="as_published", frequency=frequency, **values)
    # His first tick is 3 ms after his clock's zero.
    states, servos = walk(controller, params, ticks=2400, phase=frequency * 0.003)
    legs = np.stack([servos.hip, servos.knee], axis=-1).reshape(-1, 8)
    ours = np.column_stack([legs, servos.spine])
    return np.asarray(states.time) + 0.003, ours


def commanded(
    gait: str, frequency: float, extends: int, offset: int, gain: float, times: np.ndarray
) -> np.ndarray:
    """Servo angles at times, in his order, (n, 9)."""
    ticks, angles = commanded_ticks(gait, frequency, extends, offset, gain)
    return np.column_stack([np.interp(times, ticks, column) for column in angles.T])


@pytest.mark.release(cases=("trt-0.5-0-0", "lat-0.8-1-1"))
@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_the_servos_are_commanded_as_by_the_authors_controller(case):
    """40 commands, sampled: legs within 1 degree rms and within half a tick of his against the spine.

    With 0.11 of the foot error closed per tick, as his code reads at first sight, legs are 1.25 ticks late.
    """
    rows = STREAM[
        (STREAM[["gait", "frequency", "stride_extension", "offset_compensation"]] == case).all(
            axis=1
        )
    ]
    his, time = rows.iloc[:, 5:].to_numpy(), rows["time"].to_numpy()
    shifts = np.arange(-2.0, 2.01, 0.25)

    def rms(gain: float, shift: float) -> float:
        ours = commanded(*case, gain, time + shift / 100.0)
        return float(np.degrees(np.sqrt(np.mean((ours - his)[:, :8] ** 2))))

    ours = commanded(*case, PUBLISHED_PROFILE["tracking.foot_gain"], time)
    np.testing.assert_allclose(ours[:, 8], his[:, 8], atol=2e-3)
    assert rms(PUBLISHED_PROFILE["tracking.foot_gain"], 0.0) < 1.0
    assert (
        abs(shifts[np.argmin([rms(PUBLISHED_PROFILE["tracking.foot_gain"], s) for s in shifts])])
        <= 0.5
    )
    assert shifts[np.argmin([rms(0.11, s) for s in shifts])] >= 1.0


@pytest.mark.release
def test_his_offset_compensation_takes_the_feet():
    """His function's offsets at 0.4 rad, of the left and the right foot, with the neutral feet of his tests [m]."""
    stance = {
        name.split(".")[1]: value
        for name, value in PUBLISHED_PROFILE.items()
        if name.startswith("stance.")
    }
    feet = np.array(
        [[stance[f"{pair}_y"], stance[f"{pair}_z"]] for pair in ("front", "front", "rear", "rear")]
    )
    theta = joint_angle(0.4, Geometry())
    rise = hip_height_offset(theta, Geometry(), feet)
    np.testing.assert_allclose(-rise, HIS_OFFSETS, atol=1e-4)
    assert np.abs(rise - hip_height_offset(theta, Geometry())).min() > 3e-4


# ---
# His body, in plain MuJoCo, moved by servo angles in his order: hips and knees of the limbs, and the spine.


@functools.cache
def body(built: bool = True) -> tuple[mujoco.MjModel, list[int]]:
    """The robot of `as_published` and the servos in his order; if not `built`, with legs and tendons as drawn."""
    robot = Setup(profile="as_published").load()
    values = PUBLISHED_BODY
    if not built:
        values = {
            name: value
            for name, value in values.items()
            if not name.startswith(("build.", "geometry."))
        }
    model = compile_model(robot, values)
    servos = [f"{limb}_{joint}" for limb in LIMBS for joint in ("hip", "knee")]
    return model, [robot.servos.index(name) for name in (*servos, "spine")]


def neutral(spine: float = 0.0) -> np.ndarray:
    """Servo angles that ask for the neutral feet of his tests."""
    feet = np.array(
        [PUBLISHED_PROFILE[f"stance.{pair}_{axis}"] for pair in ("front", "rear") for axis in "yz"]
    )
    with jax.enable_x64(True):
        servo = inverse_kinematics(
            four_legs(Geometry()), feet.reshape(2, 2).repeat(2, axis=0), "type3"
        ).servo
    return np.append(np.ravel(servo), spine)


def settled(model: mujoco.MjModel, order: list[int], angles: np.ndarray) -> mujoco.MjData:
    """The robot at rest, after the servos of its legs have turned there within a second, and then the spine's."""
    data, is_late = mujoco.MjData(model), np.arange(9) == 8
    for step in range(4000):
        data.ctrl[order] = angles * np.clip(step / 500 - is_late, 0.0, 1.0)
        mujoco.mj_step(model, data)
    return data


@pytest.mark.release
def test_the_neutral_feet_are_where_his_model_has_them():
    """Within 0.2 mm, without gravity and ground. With legs and tendons as drawn they are 5 and 6 mm off."""
    errors = []
    for built in (True, False):
        floating, order = body(built)
        model = copy.copy(floating)
        model.opt.gravity[:] = 0.0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = settled(model, order, neutral())
        axes = [data.body(f"{limb}_upper").xpos for limb in LIMBS[:2]]
        frame, middle = data.body("torso").xmat.reshape(3, 3), np.mean(axes, axis=0)
        feet = np.array([frame.T @ (data.site(f"{limb}_foot").xpos - middle) for limb in LIMBS])[
            :, 1:
        ]
        errors.append(
            np.linalg.norm(feet - np.repeat(HIS_FEET, 2, axis=0), axis=1).reshape(2, 2).max(axis=1)
        )
    assert errors[0].max() < 2e-4
    assert errors[1].min() > 1.5e-3


@pytest.mark.release
@pytest.mark.parametrize(("built", "lifted", "margin"), [(True, 1, -0.0031), (False, 2, 0.0031)])
def test_bent_to_the_left_the_robot_stands_on_the_side_of_the_diagonal_on_which_his_does(
    built, lifted, margin
):
    """The centre of mass is behind the diagonal from front left to rear right, by 3.1 mm in his model, 2.6 mm here, and
    the front right foot is in the air. As drawn, the robot falls to the other side, and its rear left foot is."""
    model, order = body(built)
    data = settled(model, order, neutral(0.4))
    feet = np.array([data.site(f"{limb}_foot").xpos for limb in LIMBS])
    along = (feet[3] - feet[0])[:2] / np.linalg.norm((feet[3] - feet[0])[:2])
    inside = np.array([-along[1], along[0]]) @ (data.subtree_com[0] - feet[0])[:2]
    assert inside == pytest.approx(margin, abs=1.5e-3)
    assert np.argmax(feet[:, 2]) == lifted
    assert feet[lifted, 2] > 0.005


def walked(
    model: mujoco.MjModel, order: list[int], compensated: int, cycles: int = 7
) -> tuple[float, float]:
    """Speed [mm/s of the controller's clock] and roll std [degrees] under his commands at a clock of 0.4."""
    reference = CYCLE[CYCLE["offset_compensation"] == compensated].to_numpy()[:, 1:]
    period = 0.4 / 0.67
    data = settled(model, order, reference[0, 1:])
    begin, step, rows = data.time, model.opt.timestep, []
    for tick in range(round(cycles * period / 0.004)):
        phase = tick * 0.004 / period % 1.0
        data.ctrl[order] = [
            np.interp(phase, reference[:, 0], column, period=1.0) for column in reference[:, 1:].T
        ]
        mujoco.mj_step(model, data, round(0.004 / step))
        frame = data.body("torso").xmat.reshape(3, 3)
        rows.append((*data.body("torso").xpos[:2], np.arctan2(-frame[2, 0], frame[2, 2])))
    assert data.time > begin
    x, y, roll = np.array(rows[len(rows) * 2 // cycles :]).T
    return 400.0 * np.hypot(x[-1] - x[0], y[-1] - y[0]) / (0.004 * (len(x) - 1)), float(
        np.degrees(roll.std())
    )


@pytest.mark.release
def test_compensation_lowers_the_roll_under_his_own_commands():
    """His model: 87 mm/s and roll 4.6 and 3.3 degrees, a ratio of 0.72; published 0.85. As drawn it was 1.9."""
    (speed, roll), (_, compensated) = (walked(*body(), compensation) for compensation in (0, 1))
    assert speed == pytest.approx(86.6, rel=0.06)
    assert roll == pytest.approx(4.62, rel=0.12)
    assert compensated == pytest.approx(3.30, rel=0.18)
    assert 0.65 < compensated / roll < 0.85


# ---
# The project's own loop.

PUBLISHED = {"profile": "as_published", "pilot": "open_loop", "spine": "stride_extension"}


def started(worlds: int, starts: int) -> dict[str, np.ndarray]:
    """The starts that `walk --seed` gives, in turn."""
    names = list(START_SPREAD)
    rows = [
        [np.random.default_rng(k).uniform(-START_SPREAD[n], START_SPREAD[n]) for n in names]
        for k in range(starts)
    ]
    return {
        name: np.tile([row[i] for row in rows], worlds // starts) for i, name in enumerate(names)
    }


@pytest.fixture(scope="module")
def published(simulator):
    """Means of three starts without a pilot, by frequency and spine: mm/s of the controller's clock, degrees."""
    assert Setup(**PUBLISHED).steering == "spine"
    frequency, amplitude = (
        axis_values.ravel()
        for axis_values in np.meshgrid([0.5, 0.67, 0.8], [0.0, 0.4], indexing="ij")
    )
    values = {
        "frequency": np.repeat(frequency, 3),
        "spine.amplitude": np.repeat(amplitude, 3),
    } | started(18, 3)
    metrics = simulator(**PUBLISHED).run(values, Run(cycles=9.0, warmup_cycles=4.0)).metrics
    means = {
        name: np.asarray(metrics[name]).reshape(3, 2, 3).mean(axis=-1)
        for name in ("speed", "roll_std", "pitch_std")
    }
    return {"speed": 400.0 * means.pop("speed")} | {
        name: np.degrees(value) for name, value in means.items()
    }


@pytest.mark.release
def test_the_published_simulation_walks_as_published(published):
    """Published: 86.4 mm/s at 0.8 Hz, 5 % to 22 % faster with the spine; Table 6.6 at 0.67 Hz, 3.09 and 4.13 degrees of
    roll, 0.75 and 1.25 of pitch. The bounds are those that were set before this profile was made."""
    speed, roll, pitch = published["speed"], published["roll_std"], published["pitch_std"]
    gain = speed[:, 1] / speed[:, 0]
    assert 82.0 < speed[2, 0] < 91.0
    assert 1.12 < gain[2] < 1.28
    assert 1.02 < gain[0] < 1.12
    # The author's model: 3.22 and 4.45.
    assert 2.5 < roll[1, 0] < 3.6
    assert 3.5 < roll[1, 1] < 4.8
    assert 0.55 < pitch[1, 0] < 0.95
    assert 0.8 < pitch[1, 1] < 1.45


@pytest.mark.release
def test_the_published_robot_stands_with_its_nose_up(simulator):
    """The author's model: -0.55 degrees. Neutral feet, no gait."""
    standing = {
        "commanded_speed": 0.0,
        "stance.swing_amplitude": 0.0,
        "stance.stance_amplitude": 0.0,
    }
    result = simulator(**PUBLISHED).run(
        standing | {"spine.amplitude": 0.0}, Run(duration=3.0, warmup=1.5)
    )
    assert -0.8 < np.degrees(result.metrics["pitch_mean"][0]) < -0.3


@pytest.fixture(scope="module")
def grid(simulator):
    """His 64 walks of the stance and the clock of the tests, and ours: two gaits, four frequencies, four strides, spine
    off and on."""
    rows = GRID[(GRID["stance"] == "tests") & (GRID["clock"] == 0.4)].reset_index(drop=True)
    assert len(rows) == 64
    profiles = [published_values(gait, profile="as_published") for gait in rows["gait"]]
    values = {name: np.array([row[name] for row in profiles]) for name in profiles[0]}
    values |= {name: rows[name].to_numpy() for name in ("frequency", "stride")}
    values |= {"spine.amplitude": 0.4 * rows["spine"].to_numpy()}
    metrics = simulator(**PUBLISHED).run(values, Run(cycles=8.0, warmup_cycles=4.0)).metrics
    ours = {"speed_mm_s": 400.0 * np.asarray(metrics["speed"])}
    ours |= {
        f"{axis}_std_deg": np.degrees(metrics[f"{axis}_std"]) for axis in ("roll", "pitch", "yaw")
    }
    return rows, pd.DataFrame(ours)


@pytest.mark.release
@pytest.mark.parametrize(
    ("measure", "spines", "correlation", "deviation", "fraction"),
    [
        ("speed_mm_s", (0, 1), 0.985, 0.035, 0.9),
        ("roll_std_deg", (0, 1), 0.9, 0.04, 0.9),
        ("pitch_std_deg", (0, 1), 0.9, 0.08, 0.7),
        ("yaw_std_deg", (1,), 0.6, 0.05, 0.9),
    ],
)
def test_walks_agree_with_the_authors_model_where_nobody_published(
    grid, measure, spines, correlation, deviation, fraction
):
    """A median of ratios alone hides that walks are ordered wrongly, so that agreement is threefold: r within each
    setting of the spine, the median deviation, and the share of the walks within 10 %. Yaw without the spine is below a
    degree in both. Walks at 1 Hz are not compared: there, the author's model differs from itself by up to 44 % in speed
    between initial states. Below, it repeats to 0.9 % in speed, 0.7 % in roll and 1.6 % in pitch."""
    rows, ours = grid
    is_repeatable = rows["frequency"] < 1.0
    rows, ours = rows[is_repeatable], ours[is_repeatable]
    for spine in spines:
        selection = rows["spine"] == spine
        assert (
            np.corrcoef(rows[selection][measure], ours[selection][measure])[0, 1] >= correlation
        ), spine
    selection = rows["spine"].isin(spines)
    error = np.abs(ours[selection][measure] / rows[selection][measure] - 1.0)
    assert np.median(error) <= deviation
    assert np.mean(error <= 0.1) >= fraction


def test_the_profile_is_what_his_repository_held():
    """Dated commits: the stance from 19 July to 2 September 2021, 100 Hz, 0.11 a tick, 0.4 N m; and A.7 elsewhere."""
    values = published_values("trot", profile="as_published")
    stance = tuple(
        values[f"stance.{coordinate}"] for coordinate in ("front_y", "front_z", "rear_y", "rear_z")
    )
    assert stance == (-0.005, -0.038, 0.01, -0.042)
    assert (values["tracking.clock_ratio"], values["turning.leg"], values["turning.spine"]) == (
        0.4,
        0.0,
        1.0,
    )
    assert values["tracking.foot_gain"] == pytest.approx(0.1258, abs=1e-4)
    assert PUBLISHED_BODY["servo.torque_limit"] * PUBLISHED_BODY[
        "servo.spine_torque"
    ] == pytest.approx(0.157)
    assert (FRONT_LEG.neutral_foot, REAR_LEG.neutral_foot) == ((-0.005, -0.045), (0.0, -0.05))
    assert published_values("trot", profile="as_built")["stride"] == 0.8
    assert Setup(steering="leg", profile="as_published").steering == "leg"
