# Tests of dynamics/collision.py
"""Contacts of all pairs of geoms that MJX collides are MuJoCo C's, or a sentence says that they may not be."""

from __future__ import annotations

import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from nermo_mjx.dynamics import approximated, make_data, put_model, step, tree
from nermo_mjx.dynamics.mjx_copy import adapted
from nermo_mjx.runtime import compiler_options

GEOMS = {
    "plane": 'type="plane" size="1 1 .1"',
    "hfield": 'type="hfield" hfield="h"',
    "sphere": 'size=".05"',
    "capsule": 'type="capsule" size=".05 .1"',
    "ellipsoid": 'type="ellipsoid" size=".05 .04 .03"',
    "cylinder": 'type="cylinder" size=".05 .1"',
    "box": 'type="box" size=".05 .04 .03"',
    "mesh": 'type="mesh" mesh="m"',
}
ASSETS = """<asset><hfield name="h" nrow="2" ncol="2" size=".3 .3 .05 .1" elevation="0 1 0 0"/>
<mesh name="m" vertex=".05 0 0 -.05 0 0 0 .05 0 0 -.05 0 0 0 .06 0 0 -.06"/></asset>"""
PAIRS = [tuple(kind.name.lower() for kind in pair) for pair in collision_driver._COLLISION_FUNC]


def model_of(first: str, second: str, elements: str = "") -> mujoco.MjModel:
    """Two geoms, of which the second moves, with C's tolerance of smooth shapes at rounding."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco>{ASSETS}<worldbody><geom name="a" {first}/><body><freejoint/><geom name="b" {second} mass="1"/></body>'
        f"</worldbody>{elements}</mujoco>"
    )
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-13, 1000
    return model


def in_c(data: mujoco.MjData, pose: np.ndarray) -> list[np.ndarray]:
    """Distance, position and frame of each contact."""
    data.qpos[:] = pose
    mujoco.mj_fwdPosition(data.model, data)
    return [
        np.array([contact.dist, *contact.pos, *contact.frame])
        for contact in data.contact
        if contact.dist < 0.0
    ]


def in_mjx(model: mujoco.MjModel, poses: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The same for many poses."""
    with jax.enable_x64(True):
        device = put_model(model)
        blank = make_data(device)

        def contacts(pose: Any) -> Any:
            contact = adapted.collision_driver.collision(
                device, tree.kinematics(device, blank.replace(qpos=pose))
            )._impl.contact
            return jnp.concatenate(
                [contact.dist[:, None], contact.pos, contact.frame.reshape(-1, 9)], 1
            )

        contacts_of_poses = jax.jit(jax.vmap(contacts), compiler_options=compiler_options())(
            jnp.array(poses)
        )
    return [
        [contact for contact in rows if contact[0] < 0.0] for rows in np.asarray(contacts_of_poses)
    ]


def apart(ours: list[np.ndarray], theirs: list[np.ndarray]) -> tuple[float, float]:
    """The largest difference of distances and positions, and of directions; inf if the numbers of contacts differ.

    The tangents of a frame may change places and signs: the pyramid and the ellipse of friction are the same.
    """
    if len(ours) != len(theirs):
        return np.inf, np.inf
    distance = turn = 0.0
    for contact in theirs:
        mine = ours.pop(int(np.argmin([np.abs(mine[:4] - contact[:4]).sum() for mine in ours])))
        distance = max(distance, np.abs(mine[:4] - contact[:4]).max())
        cosines = np.abs(mine[4:].reshape(3, 3) @ contact[4:].reshape(3, 3).T)
        swapped = cosines[:, [0, 2, 1]]
        turn = max(
            turn,
            np.abs(mine[4:7] - contact[4:7]).max(),
            min(np.abs(m - np.eye(3)).max() for m in (cosines, swapped)),
        )
    return float(distance), float(turn)


def poses_of(model: mujoco.MjModel) -> list[np.ndarray]:
    """The second geom, aligned and at random, moved from a direction until it is 0.1 or 10 mm deep."""
    rng, poses, data = np.random.default_rng(0), [], mujoco.MjData(model)
    turns = [np.array([1.0, 0.0, 0.0, 0.0])]
    for axis, angle in (
        ((1, 0, 0), 90),
        ((0, 1, 0), 90),
        ((0, 1, 0), 45),
        ((1, 0, 0), 180),
        ((0, 0, 1), 30),
    ):
        turn = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.array(axis, float), np.deg2rad(angle))
        turns.append(turn)
    directions = [
        np.array(direction) for direction in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.1, 0.2, 0.97])
    ]
    if model.geom_type[0] not in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
        directions += [np.array(direction) for direction in ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0])]
    todo = [(turn, direction) for turn in turns for direction in directions]
    todo += [
        (rng.normal(size=4), np.abs(rng.normal(size=3)) + np.array([0.0, 0.0, 0.3]))
        for _ in range(20)
    ]
    for turn, direction in todo:
        unit, turn = direction / np.linalg.norm(direction), turn / np.linalg.norm(turn)
        near, far = 0.0, 1.0
        for _ in range(45):
            middle = 0.5 * (near + far)
            touches = bool(in_c(data, np.concatenate([middle * unit, turn])))
            near, far = (middle, far) if touches else (near, middle)
        poses += [np.concatenate([(near - depth) * unit, turn]) for depth in (1e-4, 1e-2)]
    return poses


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_contacts_are_those_of_c_or_it_is_said(pair: tuple[str, str]) -> None:
    model = model_of(*(GEOMS[kind] for kind in pair))
    approximations = approximated(model)
    if approximations and pair != ("plane", "cylinder"):
        assert re.fullmatch(
            rf"geom 'a' and geom 'b' are {pair[0]} and {pair[1]}: their contacts are MJX's, .*",
            approximations[0],
        )
        return
    poses, data = poses_of(model), mujoco.MjData(model)
    places, turns = np.transpose(
        [
            apart(ours, in_c(data, pose))
            for pose, ours in zip(poses, in_mjx(model, poses), strict=True)
        ]
    )
    smooth = "ellipsoid" in pair and "plane" not in pair  # C's descent ends there, too
    assert places.max() < (1e-6 if smooth else 1e-14)
    assert turns.max() < (1e-4 if smooth else 1e-12)


@pytest.mark.parametrize(("half", "other_half"), [(0.1, 0.1), (0.1, 0.05), (0.03, 0.2)])
def test_parallel_capsules_of_any_lengths_collide_as_in_c(half: float, other_half: float) -> None:
    """Beside each other, past each other's ends, head to tail, and with a tilt around C's limit."""
    model = model_of(*(f'type="capsule" size=".05 {length}"' for length in (half, other_half)))
    rng, poses, data = np.random.default_rng(0), [], mujoco.MjData(model)
    for tilt in (0.0, 0.0, 1e-9, 1e-7, 3e-6, 1e-3):
        for along in (0.0, half + other_half, half - other_half, *rng.uniform(-0.3, 0.3, 6)):
            for flipped in (False, True):
                axis, turn, angle = rng.normal(size=3), np.zeros(4), rng.uniform(0.0, 6.0)
                mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), tilt)
                if flipped:
                    mujoco.mju_mulQuat(turn, turn.copy(), np.array([0.0, 1.0, 0.0, 0.0]))
                poses.append(np.array([0.09 * np.cos(angle), 0.09 * np.sin(angle), along, *turn]))
    errors = [
        apart(ours, in_c(data, pose))
        for pose, ours in zip(poses, in_mjx(model, poses), strict=True)
    ]
    assert np.max(errors) < 1e-5
    assert max(len(in_c(data, pose)) for pose in poses) == 2


@pytest.mark.parametrize("kind", ["sphere", "capsule", "box", "cylinder"])
def test_coincident_centres_have_the_normal_of_c(kind: str) -> None:
    model = model_of(GEOMS["sphere"], GEOMS[kind])
    data = mujoco.MjData(model)
    poses = [
        np.array([0.0, 0.0, 0.0, *turn])
        for turn in ([1.0, 0, 0, 0], [0.8, 0.6, 0, 0], [0.5, 0.5, 0.5, 0.5])
    ]
    for pose, ours in zip(poses, in_mjx(model, poses), strict=True):
        assert max(apart(ours, in_c(data, pose))) < 1e-14


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize("kind", ["sphere", "capsule", "ellipsoid"])
def test_a_contact_of_an_ellipsoid_has_its_derivative(kind: str) -> None:
    """In both modes, against differences of the values, which are C's; aligned, across, and at random."""
    model = model_of(GEOMS[kind], GEOMS["ellipsoid"])
    poses = poses_of(model)[::7]
    with jax.enable_x64(True):
        device = put_model(model)
        blank = make_data(device)

        def contact(pose: Any) -> Any:
            contact = adapted.collision_driver.collision(
                device, tree.kinematics(device, blank.replace(qpos=pose))
            )._impl.contact
            return jnp.concatenate([contact.dist, contact.pos.ravel(), contact.frame[:, 0].ravel()])

        def all_of(pose: Any) -> Any:
            ends = jax.vmap(contact)(pose + 1e-6 * jnp.concatenate([jnp.eye(7), -jnp.eye(7)]))
            return (
                jax.jacfwd(contact)(pose),
                jax.jacrev(contact)(pose),
                (ends[:7] - ends[7:]).T / 2e-6,
            )

        ahead, back, differences = jax.jit(jax.vmap(all_of), compiler_options=compiler_options())(
            jnp.array(poses)
        )
    np.testing.assert_allclose(back, ahead, atol=1e-9)
    np.testing.assert_allclose(ahead, differences, atol=1e-6 * np.abs(differences).max())


@pytest.mark.release
def test_the_step_warns_of_what_is_approximate_and_refuses_data_of_mjx_with_other_contacts() -> (
    None
):
    model = model_of(GEOMS["box"], GEOMS["box"])
    device = put_model(model)
    with pytest.warns(
        UserWarning, match=r"^geom 'a' and geom 'b' are box and box: their contacts are MJX's"
    ):
        jax.eval_shape(step, device, make_data(device))
    model = model_of(GEOMS["capsule"], GEOMS["capsule"])
    device = put_model(model)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(step, device, make_data(device))
    message = "data has 1 contacts: allowed are 2, those of the model; use nermo_mjx.dynamics.make_data or put_data."
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        step(device, mjx.make_data(device))
