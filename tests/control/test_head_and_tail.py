# Tests of control/head_and_tail.py, rollout/eye_metrics.py
"""Head and tail control: closed forms, signs, and their effect on the walking robot."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nermo_mjx import SERVOS, Run, Setup, load_robot, servo_table
from nermo_mjx.control import ControlParameters, Pace, head_and_tail
from nermo_mjx.control.head_and_tail import named_head, named_tail
from nermo_mjx.kinematics.spine import joint_angle, yaw
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import Sensors
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.quantity import replace_quantities
from nermo_mjx.sweep import Sweep

#: The published robot.
ROBOT = Geometry()

PACE = Pace(*(jnp.asarray(value, jnp.float32) for value in (0.0, 1.0, 0.0, 0.8)))


def sensors_at(
    rotation: Rotation, gyro: tuple[float, float, float] = (0.0, 0.0, 0.0), spine: float = 0.0
) -> Sensors:
    """What the robot reads with its torso turned so."""
    robot = load_robot()
    still = robot.sensors(jnp.zeros(robot.model.nsensordata))
    servo = still.servo_angle.at[SERVOS.index("spine")].set(spine)
    w_first = jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)
    turning = jnp.asarray(gyro, jnp.float32)
    return dataclasses.replace(still, orientation=w_first, gyro=turning, servo_angle=servo)


def params_with(**values: float) -> ControlParameters:
    values_by_name = {name.replace("_", ".", 1): value for name, value in values.items()}
    return replace_quantities(ControlParameters(), values_by_name)


TILTED = [
    Rotation.from_euler("ZXY", angles)
    for angles in ((0.3, 0.1, -0.15), (-2.9, -0.2, 0.3), (1.6, 0.0, 0.2))
]


@pytest.mark.parametrize("torso", TILTED, ids=["left", "behind", "rolled"])
@pytest.mark.parametrize("pan", [0.0, 0.3])
def test_the_head_looks_along_the_course_whatever_the_torso_does(
    torso: Rotation, pan: float
) -> None:
    """Torso, neck and tilt one after the other, by SciPy: the gaze is level, and `pan` beside the course."""
    params = params_with(head_lead=0.0, head_pan=pan)
    course = torso.as_euler("ZXY")[0] + 0.2
    estimate = head_and_tail.CourseEstimate(jnp.asarray(course, jnp.float32), jnp.zeros(()))
    _, angles = named_head("gaze").update(params, estimate, sensors_at(torso), PACE, 1e-9)
    looks = (
        torso
        * Rotation.from_euler("z", float(angles.neck))
        * Rotation.from_euler("x", float(angles.tilt))
    )
    expected = [np.sin(course + pan), -np.cos(course + pan), 0.0]
    np.testing.assert_allclose(looks.apply([0.0, -1.0, 0.0]), expected, atol=1e-6)


def test_the_gaze_is_where_the_torso_will_be_when_the_servos_have_followed() -> None:
    """At 2 rad/s a lead of 20 ms is worth 40 mrad, of which its first order leaves less than 1 mrad."""
    rate, lead = np.array([0.5, -0.7, 2.0]), 0.02
    torso = TILTED[0]
    future = torso * Rotation.from_rotvec(rate * lead)
    course = head_and_tail.CourseEstimate(jnp.asarray(0.3, jnp.float32), jnp.zeros(()))
    angles = [
        np.array(
            named_head("gaze").update(params_with(head_lead=ahead), course, sensors, PACE, 1e-9)[1]
        )
        for ahead, sensors in (
            (lead, sensors_at(torso, tuple(rate))),
            (0.0, sensors_at(future)),
            (0.0, sensors_at(torso)),
        )
    ]
    assert np.abs(angles[0] - angles[1]).max() < 1e-3 < 0.03 < np.abs(angles[2] - angles[1]).max()


def test_the_course_goes_along_with_a_steady_turn_and_leaves_sway_out() -> None:
    """A turn of 0.2 rad/s past half a turn without lag; of a sway at 0.8 Hz what |2 b s + b^2| / |s + b|^2 says."""
    dt, bandwidth, omega = 0.002, 2.0, 2.0 * np.pi * 0.8
    times = np.arange(10_000) * dt
    headings = 2.5 + 0.2 * times + 0.14 * np.sin(omega * times)
    # The spine bends as the torso sways by another 0.05 rad, which the body's heading does not have.
    servo = 0.3 * np.sin(3.0 * times)
    torso = headings + 0.5 * np.asarray(yaw(joint_angle(servo, ROBOT)))
    still = sensors_at(Rotation.identity())

    def tick(
        course: head_and_tail.CourseEstimate, readings: tuple[jax.Array, jax.Array]
    ) -> tuple[head_and_tail.CourseEstimate, jax.Array]:
        half, zero = 0.5 * readings[0], jnp.zeros(())
        turned = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
        bent = still.servo_angle.at[SERVOS.index("spine")].set(readings[1])
        sensors = dataclasses.replace(still, orientation=turned, servo_angle=bent)
        estimate = head_and_tail.observe_course(course, sensors, bandwidth, dt, ROBOT)
        return estimate, estimate.heading

    estimate = head_and_tail.CourseEstimate(jnp.asarray(2.5), jnp.asarray(0.2))
    courses = np.asarray(
        jax.lax.scan(tick, estimate, (jnp.asarray(torso), jnp.asarray(servo)))[1], float
    )[-5000:]
    residual = courses - (2.5 + 0.2 * times[-5000:])
    s = 1j * omega
    expected = 0.14 * abs((2 * bandwidth * s + bandwidth**2) / (s + bandwidth) ** 2)
    assert abs(residual.mean()) < 2e-3
    assert np.sqrt(2.0) * residual.std() == pytest.approx(expected, rel=0.02, abs=2e-4)


@pytest.mark.release
def test_a_gradient_goes_through_the_gaze() -> None:
    """Also where the robot stands upright on its course, which is a zero of roots and arcs."""

    def neck(gain: jax.Array, sensors: Sensors) -> jax.Array:
        params = replace_quantities(ControlParameters(), {"head.gain": gain})
        return sum(
            named_head("gaze").update(
                params, named_head("gaze").init(params, (), sensors), sensors, PACE, 0.01
            )[1]
        )

    for torso in (Rotation.identity(), TILTED[0]):
        slopes = jax.grad(neck, argnums=(0, 1))(jnp.asarray(1.0), sensors_at(torso))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


@pytest.mark.release
def test_the_head_looks_into_a_turn_and_where_it_is_held() -> None:
    """Without a gaze: `pan` and `into_turn` times the turn rate, in the open loop of a servo table."""
    values = {"head.pan": 0.1, "head.into_turn": 0.5, "pilot.turn_rate": 0.4, "frequency": 1.0}
    table = servo_table(Setup(), values, rate=10.0)
    np.testing.assert_allclose(table.angles[:, SERVOS.index("neck")], np.degrees(0.3), atol=1e-4)


@pytest.mark.release
@pytest.mark.parametrize(("speed", "amplitude"), [(0.2, 0.18), (1.0, 0.5)])
def test_the_tail_swings_as_in_the_authors_software(speed: float, amplitude: float) -> None:
    """min(4.5 v^2, 0.5) cos(2 pi phase), his positive angle to the right, where ours is negative."""
    values = {"commanded_speed": speed, "frequency": 1.0, "start.phase": 0.1}
    table = servo_table(Setup(tail="articulated", tail_motion="swing"), values, rate=20.0)
    phase = 0.1 + table.time
    expected = -np.degrees(amplitude) * np.cos(2.0 * np.pi * phase)
    np.testing.assert_allclose(table.angles[:, SERVOS.index("tail")], expected, atol=1e-3)


def test_the_tail_turns_with_the_body_and_props_it() -> None:
    """Torso 0.1 rad to the left of its course: tip to the right. Torso leaning 0.1 rad to the left: tip to the left."""
    params = params_with(tail_yaw_gain=3.0, tail_roll_gain=3.0)
    course = head_and_tail.CourseEstimate(jnp.zeros(()), jnp.zeros(()))
    turned, leaning = (sensors_at(Rotation.from_euler(axis, 0.1)) for axis in "zy")
    _, against_yaw = named_tail("counter_yaw").update(params, course, turned, PACE, 1e-9)
    _, against_roll = named_tail("counter_roll").update(params, (), leaning, PACE, 1e-9)
    assert (float(against_yaw), float(against_roll)) == (
        pytest.approx(-0.3, abs=1e-5),
        pytest.approx(0.3, abs=1e-5),
    )


WALK = Run(cycles=6, warmup_cycles=2)
#: The identified body of docs/model.md.
GAZING_VALUES = {
    "frequency": [0.8],
    "damping.knee": 0.02531,
    "damping.ankle": 0.02531,
    "damping.spine": 0.09242,
}


@pytest.fixture(scope="module")
def gazing(simulator):
    """Trots with the spine at 0.8 Hz, the head held and gazing, and with a head that tilts; recorded."""
    walks = {"none": {}, "gaze": {"head": "gaze"}, "tilting": {"head": "gaze", "robot": "nermo_41"}}
    return {
        name: simulator(spine="stride_extension", **choices).run(GAZING_VALUES, WALK, record=True)
        for name, choices in walks.items()
    }


@pytest.mark.long
@pytest.mark.release
def test_the_gaze_halves_the_yaw_of_the_head_and_more(gazing) -> None:
    """In trot with the spine, and with it the motion of the picture; the walk stays the same."""
    fixed, gaze = (gazing[head].metrics for head in ("none", "gaze"))
    assert np.degrees(fixed["head_yaw_std"]) == pytest.approx(
        np.degrees(fixed["yaw_std"]), rel=0.02
    )
    assert np.degrees(fixed["head_yaw_std"]) > 6.0
    assert gaze["head_yaw_std"] < 0.3 * fixed["head_yaw_std"]
    assert gaze["picture_motion"] < 0.8 * fixed["picture_motion"]
    assert gaze["speed"] == pytest.approx(fixed["speed"], rel=0.03)


@pytest.mark.release
def test_a_head_that_tilts_holds_its_pitch(gazing) -> None:
    """On Nermo 4.1 the picture is level, and moves half as much as where the neck alone turns."""
    torso, head = (
        gazing["tilting"].metrics["pitch_std"],
        gazing["tilting"].metrics["head_pitch_std"],
    )
    assert head < 0.3 * torso
    assert abs(np.degrees(gazing["tilting"].metrics["head_pitch_mean"])) < 0.3
    assert (
        gazing["tilting"].metrics["picture_motion"] < 0.8 * gazing["gaze"].metrics["picture_motion"]
    )


@pytest.mark.release
@pytest.mark.parametrize("head", ["none", "gaze", "tilting"])
def test_metrics_of_the_eyes_are_those_of_mujocos_head(gazing, head) -> None:
    """Where the head looks and how fast it turns, in each time step of MuJoCo between two recorded states."""
    result = gazing[head]
    body = {name: value for name, value in GAZING_VALUES.items() if name != "frequency"}
    model = compile_model(result.setup.load(), body)
    data = mujoco.MjData(model)
    qpos, qvel, ctrl = (
        np.asarray(getattr(result.trace, name))[0] for name in ("qpos", "qvel", "ctrl")
    )
    head_id, direction, squared_speed = model.body("head").id, [], []
    for i in range(round(2 / 0.8 * 100), len(qpos)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i - 1], qvel[i - 1], ctrl[i]
        for _ in range(round(0.01 / model.opt.timestep)):
            mujoco.mj_step(model, data)
            for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
                compute(model, data)
            velocity = np.empty(6)
            mujoco.mj_objectVelocity(
                model, data, mujoco.mjtObj.mjOBJ_BODY, head_id, velocity, flg_local=1
            )
            squared_speed.append(velocity[0] ** 2 + velocity[2] ** 2)
            direction.append(-data.body("head").xmat.reshape(3, 3)[:, 1])
        np.testing.assert_allclose(data.qpos, qpos[i], atol=1e-9)
    x, y, z = np.transpose(direction)
    yaw, pitch = np.unwrap(np.arctan2(x, -y)), -np.arcsin(z)
    expected = {
        "head_yaw_std": yaw.std(),
        "head_pitch_std": pitch.std(),
        "picture_motion": np.sqrt(np.mean(squared_speed)),
    }
    measured = {name: float(result.metrics[name][0]) for name in expected}
    assert measured == pytest.approx(expected, rel=0.02, abs=2e-4)
    assert float(result.metrics["head_yaw_mean"][0]) == pytest.approx(yaw.mean(), abs=2e-3)
    assert float(result.metrics["head_pitch_mean"][0]) == pytest.approx(pitch.mean(), abs=2e-3)


@pytest.mark.parametrize("robot", ["nermo_lite", "nermo_41"])
def test_the_eyes_look_out_of_their_lenses(robot: str) -> None:
    """A camera stands before the dome of its lens, as it is drawn, and looks along the dome's axis."""
    model = load_robot(robot).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mesh = model.mesh("head_lenses").id
    (geom,) = np.flatnonzero(
        (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_dataid == mesh)
    )
    first = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    glass = (
        data.geom_xpos[geom] + corners @ data.geom_xmat[geom].reshape(3, 3).T
    )  # the robot heads along -y
    for name, side in (("left_eye", 1.0), ("right_eye", -1.0)):
        camera = model.camera(name).id
        position, turn = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
        ahead = -turn[:, 2]
        dome = glass[side * glass[:, 0] > 0]
        depth = (dome - position) @ ahead
        lateral_distance = np.linalg.norm(dome - position - depth[:, None] * ahead, axis=1)
        assert -0.003 < depth.min() < depth.max() < -0.0004, "all of the lens is behind the camera"
        assert lateral_distance.min() < 1e-5, "its top in the middle of the view"
        assert abs(turn[2, 0]) < 1e-6, "upright"
        assert (turn[0, 0] < 0, side * ahead[0] > 0) == (True, True)


@pytest.mark.long
def test_the_moving_tail_does_what_it_is_for(simulator) -> None:
    """In trot at 0.8 Hz the tail lowers the yaw with the spine, and the roll without it."""
    for motion, spine, name in (
        ("counter_yaw", "stride_extension", "yaw"),
        ("counter_roll", "none", "roll"),
    ):
        sim = simulator(tail="articulated", tail_motion=motion, spine=spine)
        values = {"frequency": 0.8, f"tail.{name}_gain": [0.0, 2.0]}
        still, moving = sim.run(values, Run(cycles=10, warmup_cycles=3)).metrics[f"{name}_std"]
        assert moving < 0.97 * still


def test_a_sweep_varies_what_head_and_tail_do() -> None:
    """As structures."""
    sweep = Sweep.from_text(
        "tail: articulated\nvary:\n  head: [none, gaze]\n  tail_motion: [none, swing]\n"
        "  tail.swing_amplitude: [0.2, 0.4]\n"
    )
    structures = {
        (structure.setup.head, structure.setup.tail_motion) for structure in sweep.structures
    }
    assert structures == {(head, tail) for head in ("none", "gaze") for tail in ("none", "swing")}
