# Tests of robot/geometry.py, robot/parts.py
"""Lengths and places as parameters: one number, and all that follows from it, in models, kinematics and walks."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.kinematics import body, leg, spine
from nermo_mjx.physics import Variation
from nermo_mjx.physics.variation import DERIVED_FIELDS, compile_model
from nermo_mjx.robot import LIMBS, ModelParameters, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.quantity import Quantity, quantities, replace_quantities
from nermo_mjx.robot.robot import mass_model_of
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.differentiable import Rollout

#: Every parameter of the geometry, without its group.
ALL: dict[str, Quantity] = dict(quantities(Geometry))
#: A robot of which no number is the published one.
OTHER = {
    name: quantity.low + (0.3 + 0.02 * i) * (quantity.high - quantity.low)
    for i, (name, quantity) in enumerate(ALL.items())
}
#: A sweep of three numbers of different kinds.
SWEPT = {
    "geometry.rear_leg.upper": np.array([0.0317, 0.029, 0.036]),
    "geometry.spine.segment": np.array([0.014, 0.018, 0.012]),
    "spine.amplitude": np.array([0.3, 0.0, 0.4]),
}


def geometry(**values: float) -> Geometry:
    return replace_quantities(
        Geometry(), {name: np.asarray(value) for name, value in values.items()}
    )


@functools.cache
def model_with(name: str, end: str) -> mujoco.MjModel:
    """The model that is assembled with one parameter at an end of its range, for all tests of this file."""
    return load_robot(tail="articulated").physical_with_geometry(
        geometry(**{name: getattr(ALL[name], end)})
    )


@jax.jit
def predicted(numbers: Geometry, angles: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Shoulders, hips and feet by the kinematics, from the spine base; feet before the spine, and behind it."""
    legs = leg.four_legs(numbers)
    feet = leg.points(legs, angles["hip"], angles["knee"], angles["ankle"]).foot
    bend = angles["spine"][0]
    return {
        "axes": jnp.concatenate([body.shoulders(numbers), body.hips(bend, numbers)]),
        "feet": body.feet_positions(bend, feet, numbers),
        "end": spine.transform(bend, numbers)[:3, 3],
    }


@jax.jit
def at_rest(numbers: Geometry) -> jax.Array:
    """Knee angles while all servos are at 0."""
    return leg.forward_kinematics(leg.four_legs(numbers), jnp.zeros((4, 2)), "type3").knee_angle


@pytest.mark.release(
    cases=(
        "hip.z-low",
        "hip.z-high",
        "front_leg.upper-low",
        "tail.length-low",
        "front_leg.upper-high",
    )
)
@pytest.mark.parametrize("end", ["low", "high"])
@pytest.mark.parametrize("name", ALL)
def test_a_number_moves_the_model_and_the_kinematics_alike(name, end):
    """At both ends of its range: axes and feet are where the assembled robot has them, to 1e-6 m.

    And tendons are cut to it: at servo angle 0 those of the legs hold the knee where the kinematics says, and those of
    spine and tail are just taut while all is straight.
    """
    model, robot = model_with(name, end), load_robot(tail="articulated")
    published = robot.physical
    assert any(
        not np.array_equal(getattr(model, field), getattr(published, field))
        for field in ("body_pos", "site_pos", "geom_size")
    )
    data, joints, rng = mujoco.MjData(model), robot.joints, np.random.default_rng(3)
    angles = {
        "hip": rng.uniform(-1.2, 1.2, 4),
        "knee": rng.uniform(0.3, 2.6, 4),
        "ankle": rng.uniform(-0.3, 0.3, 4),
        "spine": rng.uniform(-0.12, 0.12, 1),
    }
    for joint, values in angles.items():
        data.qpos[np.ravel(getattr(joints, joint))] = values
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    numbers = geometry(**{name: getattr(ALL[name], end)})
    with jax.enable_x64(True):
        ours, knees = jax.tree.map(np.asarray, (predicted(numbers, angles), at_rest(numbers)))
    base = data.body("torso").xpos
    feet = np.array([data.site(f"{limb}_foot").xpos for limb in LIMBS]) - base
    axes = np.array([data.body(f"{limb}_upper").xpos for limb in LIMBS]) - base
    np.testing.assert_allclose(axes, ours["axes"], atol=1e-6)
    np.testing.assert_allclose(data.site("spine_end").xpos - base, ours["end"], atol=1e-6)
    np.testing.assert_allclose(feet, ours["feet"], atol=1e-6)

    data.qpos[:] = model.qpos0
    data.qpos[list(joints.pulley)], data.qpos[np.ravel(joints.knee)] = 0.0, knees
    mujoco.mj_fwdPosition(model, data)
    np.testing.assert_allclose(data.ten_length, model.tendon_range[:, 1], atol=1e-8)


def test_links_are_drawn_as_long_as_they_are():
    """From joint to joint: each link of a leg that is longer by 5 mm ends 5 mm farther from its joint; so the bracket
    reaches to wider hips."""
    robot = load_robot()
    longer = {
        name: float(ALL[name].default) + 0.005
        for name in ("rear_leg.upper", "rear_leg.lower", "hip.x")
    }

    def reach(model: mujoco.MjModel, mesh: str) -> np.ndarray:
        """Least and largest coordinates of a mesh in the frame of its file."""
        number = model.mesh(mesh).id
        start, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
        turn, points = np.zeros(9), model.mesh_vert[start : start + count]
        mujoco.mju_quat2Mat(turn, model.mesh_quat[number])
        points = points @ turn.reshape(3, 3).T + model.mesh_pos[number]
        return np.stack([points.min(axis=0), points.max(axis=0)])

    longer_model = robot.with_geometry(geometry(**longer))
    for limb in ("rear_left", "rear_right"):
        for link in ("upper", "lower"):
            shift = reach(longer_model, f"{limb}_{link}") - reach(robot.model, f"{limb}_{link}")
            np.testing.assert_allclose(shift[:, 2], [-0.005, 0.0], atol=1e-4)
        np.testing.assert_allclose(
            longer_model.body(f"{limb}_lower").pos, [0.0, 0.0, -0.0367], atol=1e-12
        )
    shift = reach(longer_model, "hip_bracket") - reach(robot.model, "hip_bracket")
    np.testing.assert_allclose(shift[:, 0], [-0.005, 0.005], atol=1e-4)


@pytest.mark.release
@pytest.mark.parametrize(
    ("tail", "names"),
    [
        (
            "rigid",
            (
                "front_leg.upper",
                "rear_leg.foot",
                "hip.z",
                "foot.radius",
                "spine.pulley_radius",
                "tail.length",
            ),
        ),
        ("articulated", ("shoulder.x", "spine.segment", "tail.length")),
    ],
)
def test_a_world_of_a_batch_is_the_robot_assembled_with_its_geometry(tail, names):
    """Several numbers at once: every field that varies is that of a model compiled with them."""
    robot, robot_values = load_robot(tail=tail), {name: OTHER[name] for name in names}
    values = {
        f"geometry.{name}": np.array([float(ALL[name].default), value])
        for name, value in robot_values.items()
    }
    fields = Variation(robot).batch(replace_quantities(ModelParameters(), values), 2, values)
    assembled = robot.physical_with_geometry(geometry(**robot_values))
    assert {"body_pos", "body_ipos", "body_inertia", "site_pos", "geom_pos", "tendon_range"} <= set(
        fields
    )
    assert ("body_iquat" in fields) == (tail == "rigid")  # its tail turns the hip's axes of inertia
    for name, (published, varied) in fields.items():
        default, expected = getattr(robot.physical, name), getattr(assembled, name)
        np.testing.assert_allclose(published, default, rtol=1e-12, atol=1e-15, err_msg=name)
        # Limits of tendons are rounded to 10 nm where a model is assembled.
        atol = 1e-8 if name == "tendon_range" else 1e-13
        np.testing.assert_allclose(varied, expected, rtol=1e-9, atol=atol, err_msg=name)


@pytest.mark.long
@pytest.mark.release
def test_constants_and_their_derivatives_are_those_of_assembled_models():
    """What MuJoCo derives from places, and slopes of all fields, against models compiled a little on either side."""
    robot, names = load_robot(), ("spine.segment", "tail.length")
    first = np.array([OTHER[name] for name in names])
    variation = Variation(robot)

    def fields(values: jax.Array) -> dict[str, jax.Array]:
        geometry_values = {
            f"geometry.{name}": value for name, value in zip(names, values, strict=True)
        }
        return variation.differentiable(
            replace_quantities(ModelParameters(), geometry_values), geometry_values
        )

    def compiled(values: np.ndarray) -> mujoco.MjModel:
        return compile_model(
            robot, {f"geometry.{name}": value for name, value in zip(names, values, strict=True)}
        )

    with jax.enable_x64(True):
        push = jax.vmap(
            lambda direction: jax.jvp(fields, (first,), (direction,)), out_axes=(None, -1)
        )
        constants, slopes = jax.jit(push)(np.eye(len(names)))
    width, default = 1e-5, compiled(first)
    for i in range(len(names)):
        low, high = (compiled(first + sign * width * np.eye(len(names))[i]) for sign in (-1, 1))
        for name in set(DERIVED_FIELDS) | {"body_inertia", "body_ipos", "tendon_range"}:
            value, slope = (np.asarray(array) for array in (constants[name], slopes[name][..., i]))
            scale = np.abs(getattr(default, name)).max()
            np.testing.assert_allclose(
                value, getattr(default, name), rtol=1e-6, atol=1e-7 * scale, err_msg=name
            )
            difference = (getattr(high, name) - getattr(low, name)) / (2 * width)
            bound = 1e-3 if name == "tendon_range" else 1e-4 * max(np.abs(difference).max(), 1e-9)
            np.testing.assert_allclose(
                slope, difference, atol=bound, err_msg=f"{name} by {names[i]}"
            )


@pytest.mark.release
def test_worlds_stand_on_their_own_legs(simulator):
    """Put down, each world's lowest sole touches, and its feet are where its stance asks, in its own legs' frames."""
    sim = simulator(spine="stride_extension")
    values = {name: numbers for name, numbers in SWEPT.items() if name.startswith("geometry.")}
    values |= {
        "spine.amplitude": np.zeros(3),
        "stride": np.zeros(3),
        "geometry.foot.radius": np.array([0.002, 0.003, 0.004]),
    }
    batch = sim.prepare(values)
    for world in range(3):
        world_values = {
            name: float(numbers[world])
            for name, numbers in values.items()
            if name.startswith("geometry.")
        }
        model = compile_model(sim.robot, world_values)
        data = mujoco.MjData(model)
        data.qpos[:] = batch.qpos[world]
        mujoco.mj_kinematics(model, data)
        radius = world_values["geometry.foot.radius"]
        lowest = min(data.geom(f"{limb}_sole").xpos[2] for limb in LIMBS)
        assert lowest == pytest.approx(radius - 1e-5, abs=2e-6)
        stance = {"front": (-0.005, -0.045), "rear": (0.0, -0.050)}
        for limb in LIMBS:
            pair = limb.split("_")[0]
            _, y, z = data.site(f"{limb}_foot").xpos - data.body(f"{limb}_upper").xpos
            # A foot of a leg that swings is lifted; tendons are eased by 20 micrometres.
            assert y == pytest.approx(stance[pair][0], abs=1e-3), limb
            assert -0.006 < z - stance[pair][1] < 0.011, limb


@pytest.mark.release
def test_a_sweep_over_legs_spine_and_amplitude_is_one_batch_and_compiles_once(
    simulator, compilations
):
    """Worlds of three robots walk in one batch; other numbers of the same names compile nothing."""
    sim, run = simulator(spine="stride_extension"), Run(cycles=1, warmup_cycles=0)
    speed = sim.run(SWEPT, run).metrics["speed"]
    assert np.isfinite(speed).all()
    assert np.ptp(speed) > 1e-3
    compilations.clear()
    changed_speed = sim.run({name: 0.99 * values for name, values in SWEPT.items()}, run).metrics[
        "speed"
    ]
    assert compilations == []
    assert not np.array_equal(changed_speed, speed)


@pytest.mark.release
def test_a_world_with_the_published_numbers_is_the_published_robot(simulator):
    """Named with its default, a length changes a walk by rounding only; without one, controllers have constants."""
    sim, run = simulator(spine="stride_extension"), Run(cycles=1, warmup_cycles=0)
    plain = sim.run({"spine.amplitude": 0.3}, run).metrics
    published = sim.run({"spine.amplitude": 0.3, "geometry.hip.x": 0.0428}, run).metrics
    assert published["speed"] == pytest.approx(plain["speed"], rel=1e-4)
    assert Setup().world({}).control.geometry is None


@pytest.mark.release
def test_the_balance_knows_where_other_robots_have_their_mass():
    """The controller's two masses are those of the robot assembled with the geometry, to a micrometre."""
    robot, numbers = load_robot(), geometry(**OTHER)
    data = mujoco.MjData(model := robot.physical_with_geometry(numbers))
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        masses = jax.tree.map(np.asarray, mass_model_of(robot.config, numbers))
        com = np.asarray(body.centre_of_mass(masses, 0.0, numbers))
    common = data.subtree_com[0] - data.body("torso").xpos
    np.testing.assert_allclose(common, com, atol=1e-6)
    assert (
        np.abs(com - np.asarray(body.centre_of_mass(robot.mass_model, 0.0, Geometry()))).max()
        > 1e-3
    )


@pytest.mark.long
def test_gradients_of_a_walk_by_geometry_are_those_of_differences():
    """One gait cycle of three numbers: exact derivatives on `mjx` against differences of the engine `c`."""
    setup, run = Setup(spine="stride_extension"), Run(cycles=1, warmup_cycles=0)
    start = {
        "geometry.rear_leg.upper": 0.033,
        "geometry.spine.segment": 0.015,
        "geometry.tail.length": 0.14,
    }
    fixed, first = {"spine.amplitude": 0.2, "frequency": 0.82}, np.array(list(start.values()))
    with jax.enable_x64(True):
        rollout = Rollout(setup, run, "mjx", slowest=0.8)

        def speed(point: jax.Array) -> jax.Array:
            return rollout(fixed | dict(zip(start, point, strict=True)))["speed"]

        slopes = np.asarray(jax.jit(jax.jacfwd(speed))(first))
        widths = 1e-6 * first
        points = np.concatenate([first + np.diag(widths), first - np.diag(widths)])
        batch = {name: points[:, i] for i, name in enumerate(start)} | fixed
        speeds = Simulator(setup, "c").run(batch, run).metrics["speed"]
    differences = (speeds[:3] - speeds[3:]) / (2 * widths)
    np.testing.assert_allclose(slopes, differences, rtol=2e-2, atol=1e-3)
