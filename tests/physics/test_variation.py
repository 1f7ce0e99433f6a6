# Tests of physics/variation.py, physics/geometry_fields.py, robot/model_parameters.py
"""Variation of the body: named parameters against the model fields, constants and motion they must give."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from nermo_mjx.dynamics import differentiable, make_data, put_model
from nermo_mjx.physics import Variation
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.physics.servo_play import PLAY_FIELDS
from nermo_mjx.physics.variation import DERIVED_FIELDS, compile_model
from nermo_mjx.robot import LIMBS, ModelParameters, Robot, assemble, load_robot
from nermo_mjx.robot.masses import is_front, reduced_model
from nermo_mjx.robot.model_parameters import gravity_vector
from nermo_mjx.robot.parameters import FOOT_RADIUS
from nermo_mjx.robot.quantity import quantities, replace_quantities
from nermo_mjx.rollout import Setup, Simulator

ALL = {name: float(quantity.default) for name, quantity in quantities(ModelParameters)}
#: A value for every parameter that is not the default, all different.
OTHER = {name: (value or 0.5) * (0.6 + 0.03 * i) for i, (name, value) in enumerate(ALL.items())}


class Standing:
    """A loop that holds the standing pose, and swings every servo a little."""

    steps_per_tick = 5

    def __init__(self, robot: Robot) -> None:
        joints, model = robot.joints, robot.model
        single = (joints.spine_pulley, joints.neck, *joints.tail_pulley)
        self.stance = model.qpos0[[*joints.hip, *joints.pulley, *single]]

    def init(self, params, sensordata):
        return jnp.zeros(())

    def step(self, params, state, sensordata):
        return state + 1.0, jnp.asarray(self.stance) + params * jnp.sin(0.3 * state)


def varied(robot: Robot, values: Mapping[str, np.ndarray], worlds: int) -> dict[str, np.ndarray]:
    return Variation(robot).batch(replace_quantities(ModelParameters(), values), worlds, values)


def assert_same_model(first: mujoco.MjModel, second: mujoco.MjModel, rtol: float = 1e-9) -> None:
    """Every number in two compiled models is the same, derived constants included.

    But for `stat.meaninertia`, which `mj_setConst` leaves alone: it only scales the solver's tolerance.
    """
    for name in (name for name in dir(first) if not name.startswith("_")):
        value = getattr(first, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            np.testing.assert_allclose(
                value, getattr(second, name), rtol=rtol, atol=1e-12, err_msg=name
            )


def scaled(robot: Robot, front: float, rear: float) -> mujoco.MjModel:
    """The robot compiled anew, with mass and inertia of all its bodies scaled by hand to these totals."""
    spec = assemble(robot.config)
    totals = {True: front / ALL["mass.front"], False: rear / ALL["mass.rear"]}
    for body in spec.bodies[1:]:
        share = totals[is_front(body.name)]
        body.mass, body.inertia = body.mass * share, body.inertia * share
    return spec.compile()


def test_nothing_named_gives_no_fields():
    """A batch that names no body parameter leaves the model alone, whatever else it names."""
    variation = Variation(load_robot())
    assert variation.batch(ModelParameters(), 4, ()) == {}
    assert (
        variation.batch(
            ModelParameters(), 4, ("frequency", "spine.phase", "start.yaw", "stance.front_z")
        )
        == {}
    )


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("tail", ["rigid", pytest.param("articulated", marks=pytest.mark.release)])
def test_defaults_are_the_values_of_the_compiled_model(tail):
    """Named with their defaults, the parameters give the numbers that assembly has written."""
    robot = load_robot(tail=tail)
    fields = varied(robot, ALL, 1)
    assert set(PLAY_FIELDS) < set(fields)
    for name, values in fields.items():
        if name in PLAY_FIELDS:  # not of the model: what engines do about dead band and backlash
            continue
        base = attrgetter(name)(robot.physical)
        assert values.shape == (1, *base.shape)
        np.testing.assert_allclose(values[0], base, rtol=1e-12, atol=1e-15, err_msg=name)
    assert_same_model(compile_model(robot, ALL), robot.model)


def test_which_fields_vary_depends_on_names_alone():
    """A group's fields come with any of its names, also at the default: new values never change a program's inputs."""
    robot = load_robot()
    at_default = varied(robot, {"contact.friction": np.array([1.0, 1.0])}, 2)
    values = varied(robot, {"contact.friction": np.array([0.5, 1.5])}, 2)
    assert list(at_default) == list(values) == ["pair_friction", "pair_solref", "pair_solimp"]
    assert set(varied(robot, {"mass.front": np.array([0.2])}, 1)) == {"body_mass", "body_inertia"}


@pytest.mark.release(cases=("maze",))
@pytest.mark.parametrize("scene", ["flat", "maze"])
def test_contact_parameters_reach_what_they_name(scene):
    """Solref and solimp of soles and tail on the ground change world by world, and friction of each kind of pair."""
    robot, worlds = load_robot(scene=scene), np.array([0.5, 1.5])
    friction = {
        "sole": worlds,
        "tail": np.array([0.2, 0.7]),
        "trunk": np.array([0.3, 0.8]),
        "obstacle": worlds / 4,
    }
    values = {
        "contact.friction": friction["sole"],
        "contact.tail_friction": friction["tail"],
        "contact.trunk_friction": friction["trunk"],
        "contact.obstacle_friction": friction["obstacle"],
        "contact.time_constant": np.array([0.008, 0.02]),
        "contact.damping_ratio": worlds,
        "contact.impedance": np.array([0.9, 0.99]),
        "contact.width": np.array([0.002, 0.003]),
    }
    fields = varied(robot, values, 2)
    for i in range(robot.model.npair):
        ground, _, part = robot.model.pair(i).name.partition("_")
        kind = (
            "obstacle"
            if ground != "floor"
            else "sole"
            if part.endswith("sole")
            else part.partition("_")[0]
        )
        expected = friction[kind if kind in friction else "trunk"]
        np.testing.assert_allclose(
            fields["pair_friction"][:, i, :2], np.stack([expected, expected], 1)
        )
        if kind in ("sole", "tail"):
            np.testing.assert_allclose(fields["pair_solref"][:, i], [(0.008, 0.5), (0.02, 1.5)])
            np.testing.assert_allclose(
                fields["pair_solimp"][:, i, :3], [(0, 0.9, 0.002), (0, 0.99, 0.003)]
            )
        else:
            for name in ("pair_solref", "pair_solimp"):
                np.testing.assert_array_equal(
                    fields[name][:, i], [getattr(robot.model, name)[i]] * 2
                )


def test_springs_and_dampers_reach_their_joints():
    """Every spring and damper changes in the joints it names, left and right, and in no other."""
    robot = load_robot(tail="articulated")
    model, names = (
        robot.model,
        [name for name in OTHER if name.startswith(("stiffness", "damping"))],
    )
    fields = varied(robot, {name: OTHER[name] for name in names}, 1)
    for i in range(1, model.njnt):
        joint, dof = model.joint(i).name, model.jnt_dofadr[i]
        kind = "spine" if joint.startswith("spine_joint") else joint.rsplit("_", 1)[-1]
        spring = f"stiffness.{joint.split('_')[0]}_knee" if kind == "knee" else f"stiffness.{kind}"
        expected = OTHER.get(spring, model.jnt_stiffness[i])
        assert fields["jnt_stiffness"][0, i] == pytest.approx(expected, rel=1e-12), joint
        # What else brakes a joint, as its servo may, stays.
        damper = "damping.pulley" if kind == "neck" else f"damping.{kind}"
        expected = model.dof_damping[dof] + OTHER.get(damper, 0.0) - ALL.get(damper, 0.0)
        assert fields["dof_damping"][0, dof] == pytest.approx(expected, rel=1e-12), joint
    assert fields["dof_damping"][0, :6] == pytest.approx(0.0)


def test_servo_parameters_reach_all_servos():
    """Gain, torque limit and damping of the servos change in every actuator and on every joint with a servo."""
    robot = load_robot()
    model = robot.model
    fields = varied(
        robot, {"servo.kp": np.array([3.0, 9.0]), "servo.torque_limit": 0.1, "servo.kv": 0.05}, 2
    )
    difference = 0.05 - float(ModelParameters().servo.kv)
    damping = fields.get("dof_damping", np.stack([model.dof_damping] * 2))
    for world, kp in enumerate((3.0, 9.0)):
        np.testing.assert_allclose(fields["actuator_gainprm"][world, :, 0], kp)
        np.testing.assert_allclose(fields["actuator_biasprm"][world, :, 1], -kp)
        np.testing.assert_allclose(fields["actuator_forcerange"][world], [[-0.1, 0.1]] * model.nu)
        # Wherever the damping is applied, a servo turning at 1 rad/s is braked by the difference of the dampings.
        dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        braking = damping[world][dofs] - fields["actuator_biasprm"][world][:, 2]
        default = model.dof_damping[dofs] - model.actuator_biasprm[:, 2]
        np.testing.assert_allclose(braking - default, difference, rtol=1e-9)


def test_faults_of_the_built_robot_reach_what_they_name():
    """Slack lengthens the tendons of legs or spine alone; the asymmetry stiffens left knees and softens right ones."""
    robot = load_robot(tail="articulated")
    model = robot.model
    fields = varied(
        robot, {"build.leg_slack": 0.001, "build.spine_slack": 0.002, "build.asymmetry": 0.2}, 1
    )
    for i in range(model.ntendon):
        kind = model.tendon(i).name.split("_")[0]
        slack = {"front": 0.001, "rear": 0.001, "spine": 0.002, "tail": 0.0}[kind]
        np.testing.assert_allclose(
            fields["tendon_range"][0, i], model.tendon_range[i] + [0.0, slack], atol=1e-12
        )
    for i in range(1, model.njnt):
        name = model.joint(i).name
        share = {"left": 1.2, "right": 0.8}[name.split("_")[1]] if name.endswith("_knee") else 1.0
        assert fields["jnt_stiffness"][0, i] == pytest.approx(
            share * model.jnt_stiffness[i], rel=1e-12
        ), name


@pytest.mark.release
def test_slack_and_another_geometry_add_up():
    """A tendon of longer legs is longer by its slack, too."""
    robot, name = load_robot(), "geometry.front_leg.lower"
    values = {name: np.array(1.1 * ALL[name]), "build.leg_slack": np.array(0.001)}
    parameters = replace_quantities(ModelParameters(), values)
    reach = assemble(robot.config, parameters).compile().tendon_range
    np.testing.assert_allclose(varied(robot, values, 1)["tendon_range"][0], reach, atol=1e-9)
    np.testing.assert_allclose(
        compile_model(robot, {key: float(value) for key, value in values.items()}).tendon_range,
        reach,
        atol=1e-12,
    )


def test_masses_scale_in_proportion():
    """Front and rear take the wanted mass; parts keep their shares, inertias scale along."""
    robot = load_robot()
    model = robot.model
    fields = varied(
        robot, {"mass.front": np.array([0.2, 0.1]), "mass.rear": np.array([0.1053, 0.2])}, 2
    )
    front = np.array([is_front(model.body(i).name) for i in range(model.nbody)])
    for world, (ahead, behind) in enumerate([(0.2, 0.1053), (0.1, 0.2)]):
        mass, inertia = fields["body_mass"][world], fields["body_inertia"][world]
        assert mass[front].sum() == pytest.approx(ahead)
        assert mass[~front].sum() == pytest.approx(behind)
        np.testing.assert_allclose(
            mass[front] / ahead, model.body_mass[front] / model.body_mass[front].sum()
        )
        np.testing.assert_allclose(
            inertia[1:] / mass[1:, None], model.body_inertia[1:] / model.body_mass[1:, None]
        )


def test_varied_masses_are_those_of_a_model_compiled_with_them():
    """A varied model equals one whose bodies were scaled before compilation, derived constants included."""
    robot = load_robot()
    values = {"mass.front": 0.2, "mass.rear": 0.09}
    assert_same_model(compile_model(robot, values), scaled(robot, 0.2, 0.09))
    assert robot.model.body_mass.sum() == pytest.approx(0.270)  # the robot's own model is untouched


@pytest.mark.parametrize(
    "group", ["servo", "contact", "stiffness", "damping", "mass", "build", "ground"]
)
def test_varied_and_assembled_parameters_agree(group):
    """Every parameter gives the same model whether it is varied in a batch or handed to assembly."""
    robot = load_robot()
    values = {name: value for name, value in OTHER.items() if name.startswith(group)}
    assembled = assemble(robot.config, replace_quantities(ModelParameters(), values)).compile()
    assert_same_model(compile_model(robot, values), assembled)


def test_c_engine_worlds_move_like_models_compiled_for_them():
    """Worlds of different masses, friction and slope are, bit for bit, `mj_step` of models compiled with them.

    Jacobians are sparse in all.
    """
    robot = load_robot()
    loop, worlds = Standing(robot), 3
    values = {
        "mass.front": np.array([0.15, 0.1647, 0.22]),
        "mass.rear": np.array([0.13, 0.1053, 0.08]),
        "contact.friction": np.array([0.3, 1.0, 1.5]),
        "stiffness.rear_knee": np.array([0.15, 0.19, 0.25]),
        "ground.slope": np.array([0.0, 0.1, -0.2]),
        "ground.gravity": np.array([9.81, 9.0, 5.0]),
    }
    qpos = np.tile(robot.model.qpos0, (worlds, 1))
    swing = np.full(worlds, 0.2, np.float32)
    trace = CEngine(robot, loop).open(swing, qpos, varied(robot, values, worlds)).record(30)
    for world in range(worlds):
        model = compile_model(robot, {name: value[world] for name, value in values.items()})
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for tick in range(30):
            data.ctrl[:] = trace.ctrl[world, tick]
            mujoco.mj_step(model, data, loop.steps_per_tick)
            np.testing.assert_array_equal(data.qpos, trace.qpos[world, tick])
    assert np.abs(trace.qpos[0] - trace.qpos[2]).max() > 1e-3


def test_mjx_worlds_have_the_constants_of_models_compiled_for_them():
    """MJX has no `mj_setConst`: with varied masses its fields carry what MuJoCo derives from them, world by world."""
    robot = load_robot()
    engine = MjxEngine(robot, Standing(robot))
    qpos, swing = np.tile(robot.model.qpos0, (2, 1)), np.zeros(2, np.float32)
    masses = {"mass.front": np.array([0.12, 0.22]), "mass.rear": np.array([0.15, 0.08])}
    session = engine.open(swing, qpos, varied(robot, masses, 2))
    assert set(session.fields) == {"body_mass", "body_inertia", *DERIVED_FIELDS}
    for world in range(2):
        model = compile_model(robot, {name: value[world] for name, value in masses.items()})
        for name, values in session.fields.items():
            np.testing.assert_allclose(
                values[world], getattr(model, name), rtol=1e-5, atol=1e-9, err_msg=name
            )
    # Nothing is derived from friction, and nothing varied leaves the model as it was compiled.
    friction = engine.open(
        swing, qpos, varied(robot, {"contact.friction": np.array([0.5, 1.5])}, 2)
    )
    assert set(friction.fields) == {"pair_friction", "pair_solref", "pair_solimp"}
    assert engine.open(swing, qpos, {}).fields == {}


def test_no_constant_that_mjx_reads_is_left_out():
    """What MuJoCo derives from masses is in `DERIVED_FIELDS`, save cameras and lights that follow a mass."""
    robot = load_robot()
    compiled = compile_model(robot, {"mass.front": 0.2, "mass.rear": 0.09})
    changed = {
        name
        for name, value in (
            (name, getattr(compiled, name)) for name in dir(compiled) if not name.startswith("_")
        )
        if isinstance(value, np.ndarray) and value.dtype.kind == "f"
        if not np.allclose(value, getattr(robot.model, name), rtol=1e-9, atol=0.0)
    }
    physical = {name for name in changed if not name.startswith(("cam_", "light_"))}
    assert physical == {"body_mass", "body_inertia", *DERIVED_FIELDS}


def test_a_slope_turns_gravity_in_mjx_and_has_a_derivative():
    """A ball in free fall: after one step its velocity, and its derivatives along size, slope and direction."""
    ball = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
    )
    model, point = put_model(ball), np.array([9.0, 0.3, 0.5])
    blank, dt = make_data(model), ball.opt.timestep

    def velocity(ground: Any) -> Any:
        fields = {"opt.gravity": gravity_vector(*ground, jnp)}
        return differentiable.step(model.tree_replace(fields), blank).qvel[:3]

    push = jax.vmap(
        lambda direction: jax.jvp(velocity, (point,), (direction,)), out_axes=(None, -1)
    )
    value, slopes = jax.jit(push)(np.eye(3))
    np.testing.assert_allclose(value, dt * gravity_vector(*point), rtol=1e-5)
    differences = [
        (gravity_vector(*(point + d)) - gravity_vector(*(point - d))) * dt / 2e-6
        for d in 1e-6 * np.eye(3)
    ]
    np.testing.assert_allclose(slopes, np.array(differences).T, rtol=1e-4, atol=1e-7)


#: How a robot is built that is not as drawn, in every way that moves its feet.
BUILT = {
    "build.front_slack": 0.0007,
    "build.rear_slack": -0.0003,
    "build.leg_slack": 0.0002,
    "build.rear_softness": 90.0,
    "build.spine_softness": 40.0,
    "build.front_tilt": 0.05,
    "build.rear_tilt": -0.0855,
}


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(("routing", "tail"), [("type2", "articulated"), ("type3", "rigid")])
def test_a_built_robot_is_the_same_in_a_batch_and_assembled(routing, tail):
    """Tendons, their softness and the turned mounts, left and right; beside another geometry, too."""
    robot = load_robot(routing=routing, tail=tail)
    values = {name: np.array(value) for name, value in (BUILT | {"geometry.hip.z": -0.011}).items()}
    assembled = varied_model(robot, values)
    fields = varied(robot, values, 1)
    assert {
        "body_pos",
        "body_quat",
        "site_pos",
        "tendon_range",
        "tendon_solref_lim",
    } <= fields.keys()
    for name in ("body_pos", "body_quat", "site_pos", "tendon_range", "tendon_solref_lim"):
        np.testing.assert_allclose(
            fields[name][0], getattr(assembled, name), atol=1e-9, err_msg=name
        )
    parameters = replace_quantities(
        ModelParameters(), {name: np.array(value) for name, value in BUILT.items()}
    )
    assert_same_model(compile_model(robot, BUILT), assemble(robot.config, parameters).compile())
    unchanged = varied(robot, {"build.rear_tilt": np.array(0.0)}, 1)
    for name, field in unchanged.items():
        np.testing.assert_allclose(
            field[0], getattr(robot.physical, name), atol=1e-15, err_msg=name
        )


@pytest.mark.release
def test_turned_mounts_carry_the_feet_and_slack_lowers_them():
    """A rear leg turned by -0.0855 rad has its foot 3.9 mm further forward; the start stands on all feet as built."""
    simulator = Simulator(Setup(), engine="c")
    still = {"commanded_speed": 0.0, "stance.swing_amplitude": 0.0, "stance.stance_amplitude": 0.0}

    def feet(**build: float) -> np.ndarray:
        values = still | {f"build.{name}": value for name, value in build.items()}
        model = compile_model(
            simulator.robot, {f"build.{name}": value for name, value in build.items()}
        )
        data = mujoco.MjData(model)
        data.qpos[:] = simulator.prepare(values).qpos[0]
        mujoco.mj_kinematics(model, data)
        soles = [data.geom(f"{limb}_sole").xpos[2] - FOOT_RADIUS for limb in LIMBS]
        assert min(soles) == pytest.approx(-1e-5, abs=2e-6)
        return np.array(
            [data.site(f"{limb}_foot").xpos - data.body("torso").xpos for limb in LIMBS]
        )

    default, turned, slack = feet(), feet(rear_tilt=-0.0855), feet(rear_slack=0.001)
    np.testing.assert_allclose(turned[:2, 1:], default[:2, 1:], atol=1e-6)
    down = 0.0499  # from the rear legs' axis to their feet
    np.testing.assert_allclose(turned[2:, 1] - default[2:, 1], -down * np.sin(0.0855), atol=4e-4)
    assert (slack[2:, 2] < default[2:, 2] - 5e-4).all()
    np.testing.assert_allclose(slack[:2, 1:], default[:2, 1:], atol=1e-6)


@pytest.mark.release
def test_derivatives_by_the_build_are_those_of_compiled_models():
    """Of the places of legs, tendons and what MuJoCo derives from them, by tilt and softness."""
    robot, names = load_robot(), ("build.rear_tilt", "build.rear_softness", "build.front_slack")
    first, widths = np.array([-0.08, 90.0, 0.0007]), np.array([1e-5, 1e-2, 1e-6])
    variation = Variation(robot)

    def fields(values: jax.Array) -> dict[str, jax.Array]:
        build_values = dict(zip(names, values, strict=True))
        return variation.differentiable(
            replace_quantities(ModelParameters(), build_values), build_values
        )

    with jax.enable_x64(True):
        slopes = jax.jit(jax.jacfwd(fields))(first)
    for i in range(len(names)):
        low, high = (
            varied_model(
                robot, dict(zip(names, first + sign * widths[i] * np.eye(3)[i], strict=True))
            )
            for sign in (-1.0, 1.0)
        )
        for name in (
            "body_pos",
            "body_quat",
            "site_pos",
            "tendon_range",
            "tendon_solref_lim",
            "tendon_invweight0",
        ):
            difference = (getattr(high, name) - getattr(low, name)) / (2.0 * widths[i])
            scale = max(np.abs(difference).max(), 1e-9)
            np.testing.assert_allclose(
                slopes[name][..., i], difference, atol=1e-4 * scale, err_msg=name
            )


def varied_model(robot: Robot, values: Mapping[str, float]) -> mujoco.MjModel:
    """The model that engines step, assembled with these values."""
    site_names = [robot.physical.site(i).name for i in range(robot.physical.nsite)]
    parameters = replace_quantities(
        ModelParameters(), {name: np.array(value) for name, value in values.items()}
    )
    return reduced_model(assemble(robot.config, parameters), site_names)
