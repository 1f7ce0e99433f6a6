# Tests of optimize/optimizers.py
"""Optimizers and schedules of optax by name, and Adam whose rate follows the objective."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from nermo_mjx.optimize.optimizers import Optimizer, optimizers, schedules
from nermo_mjx.robot.quantity import ParameterError


def walk(optimizer, steps=12):
    """The path of two starts under constant gradients, (steps, 2, 2)."""
    transformation, u = optimizer.build(), jnp.array([[0.5, -0.3], [1.0, 2.0]])
    state, path = jax.vmap(transformation.init)(u), []
    for _ in range(steps):
        slope = jnp.array([[3.0, -4.0], [0.3, 0.4]])
        step, state = jax.vmap(
            lambda g, s, u: transformation.update(g, s, u, value=jnp.sum(g * u))
        )(slope, state, u)
        u = u + step
        path.append(np.asarray(u))
    return np.stack(path)


@pytest.mark.release
def test_every_optimizer_with_gradients_alone_is_offered():
    """All of optax that has a learning rate is known by name; what works from gradients alone is accepted."""
    refused = {"lbfgs", "noisy_sgd"}
    assert refused <= set(optimizers())
    assert {"adam", "sgd", "lion", "rmsprop", "adamw", "nadam"} <= set(optimizers())
    for name in sorted(set(optimizers()) - refused):
        assert np.isfinite(walk(Optimizer(name), 2)).all(), name


def test_options_reach_optax():
    """The path is that of optax itself with the same options."""
    mine = walk(Optimizer("adam", {"learning_rate": 0.3, "b1": 0.5}))
    transformation, u = optax.adam(0.3, b1=0.5), jnp.array([1.0, 2.0])
    state = transformation.init(u)
    for row in mine[:, 1]:
        step, state = transformation.update(jnp.array([0.3, 0.4]), state, u)
        u = u + step
        np.testing.assert_allclose(row, u, rtol=1e-6)


@pytest.mark.parametrize(
    "written",
    [
        {"name": "cosine_decay_schedule", "init_value": 0.5, "decay_steps": 10},
        {"cosine": {"init_value": 0.5, "decay_steps": 10}},
        {"cosine_decay_schedule": {"init_value": 0.5, "decay_steps": 10}},
    ],
)
def test_a_schedule_may_be_the_learning_rate(written):
    """Steps of plain descent are the gradient times the schedule's value, which falls to zero."""
    steps = np.diff(walk(Optimizer("sgd", {"learning_rate": written}), 11)[:, 1, 0], prepend=1.0)
    expected = -0.3 * 0.25 * (1 + np.cos(np.pi * np.arange(11) / 10))
    np.testing.assert_allclose(steps, expected, atol=1e-6)


def test_steps_of_a_piecewise_schedule_are_whole_numbers():
    """YAML has texts as keys; the schedule gets numbers."""
    rate = {
        "name": "piecewise_constant_schedule",
        "init_value": 1.0,
        "boundaries_and_scales": {"2": 0.1},
    }
    steps = np.diff(walk(Optimizer("sgd", {"learning_rate": rate}), 4)[:, 1, 0], prepend=1.0)
    np.testing.assert_allclose(steps, [-0.3, -0.3, -0.03, -0.03], rtol=1e-5)


def test_each_start_is_clipped_by_itself():
    """A gradient of length 5 is shortened to 1, one of 0.5 beside it is not."""
    path = walk(Optimizer("sgd", {"learning_rate": 1.0}, clip=1.0), 1)
    np.testing.assert_allclose(
        path[0], [[0.5 - 0.6, -0.3 + 0.8], [1.0 - 0.3, 2.0 - 0.4]], rtol=1e-5
    )


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ({"name": "adamm"}, ["optimizer.name is 'adamm'", "did you mean 'adam'?"]),
        ({"name": "lbfgs"}, ["'lbfgs'", "does not work from gradients alone", "value_fn"]),
        ({"name": "noisy_sgd"}, ["random numbers of its own"]),
        ({"options": {"beta1": 0.9}}, ["optimizer.beta1 is not an option of adam", "b1, b2"]),
        (
            {"options": {"learning_rate": {"cosin": {"init_value": 1, "decay_steps": 4}}}},
            ["optimizer.learning_rate is the schedule 'cosin'", "cosine_decay_schedule"],
        ),
        (
            {"options": {"learning_rate": {"cosine": {"init_value": 1}}}},
            ["cosine_decay_schedule without decay_steps"],
        ),
        (
            {"options": {"learning_rate": {"cosine": {"init_value": 1, "decay_step": 4}}}},
            ["optimizer.learning_rate.decay_step", "did you mean 'decay_steps'?"],
        ),
        (
            {"options": {"learning_rate": {"cosine": {"init_value": 1, "decay_steps": -4}}}},
            ["refuses its options"],
        ),
        ({"options": {"learning_rate": {"constant": {"value": float("nan")}}}}, ["starts at nan"]),
        (
            {"options": {"learning_rate": {"a": 1, "b": 2}}},
            ["a mapping of a, b", "expected a number, or a schedule"],
        ),
        (
            {"name": "rprop", "options": {"learning_rate": {"constant": {"value": 0.1}}}},
            ["'rprop'"],
        ),
        ({"options": {"b1": "much"}}, ["optimizer.name is 'adam'"]),
        ({"options": {"b2": float("inf")}}, ["expected finite numbers"]),
        ({"clip": 0.0}, ["optimizer.clip is 0"]),
    ],
)
def test_what_cannot_work_is_refused_in_a_sentence(given, parts):
    """Before anything simulates: unknown names with the nearest, wrong options, optimizers that need more."""
    with pytest.raises(ParameterError) as caught:
        Optimizer(**{"name": "adam", **given})
    message = str(caught.value)
    assert [part for part in parts if part not in message] == [], message
    assert "\n" not in message
    assert message[-1] in ".?"


def test_schedules_are_those_of_optax():
    """The common ones are there, helpers that are no schedule are not."""
    assert {
        "cosine_decay_schedule",
        "exponential_decay",
        "linear_schedule",
        "warmup_cosine_decay_schedule",
    } <= set(schedules())
    assert not {"join_schedules", "scale_by_schedule", "incremental_update"} & set(schedules())


def rough(seed):
    """A bowl in two dimensions, level far off, with teeth on its slope that are as steep as itself."""
    rng = np.random.default_rng(seed)
    way, shifts = 2 * np.pi / 0.15 * rng.standard_normal((6, 2)), rng.uniform(0, 2 * np.pi, 6)
    height = 0.02 / np.linalg.norm(way, axis=1)

    def value(u):
        return (
            -0.1 * jnp.exp(-0.5 * (u[0] ** 2 + 3.0 * u[1] ** 2))
            + (height * jnp.sin(way @ u + shifts)).sum()
        )

    return jax.jit(jax.value_and_grad(value))


def lowest(optimizer, function, steps=20, falls=lambda u: False):
    """The lowest value of `steps` evaluations from a corner, and where they were."""
    transformation, u, path, values = optimizer.build(), jnp.array([1.2, -0.8]), [], []
    state, update = (
        transformation.init(u),
        jax.jit(lambda g, s, u, v: transformation.update(g, s, u, value=v)),
    )
    for _ in range(steps):
        value, slope = function(u)
        value, slope = (jnp.asarray(jnp.inf), jnp.zeros(2)) if falls(u) else (value, slope)
        values.append(float(value))
        path.append(np.asarray(u))
        step, state = update(slope, state, u, value)
        u = u + step
    return min(values), np.stack(path)


def test_a_rate_that_follows_the_objective_finds_the_bottom_of_rough_bowls():
    """From a first rate of 0.03 or of 1, to 2 % of their depth; Adam with either is left on the slope, or beyond."""
    bowls = [rough(seed) for seed in range(3)]
    for rate in (0.03, 0.3, 1.0):
        controlled = Optimizer("controlled_adam", {"rate": rate})
        assert max(lowest(controlled, bowl, 30)[0] for bowl in bowls) < -0.098
    for rate in (0.03, 1.0):
        assert (
            max(lowest(Optimizer("adam", {"learning_rate": rate}), bowl, 30)[0] for bowl in bowls)
            > -0.095
        )


def test_a_step_into_a_fall_is_taken_back():
    """The next point is nearer to the best one, in the same direction, and what follows stays out."""
    bowl = jax.jit(jax.value_and_grad(lambda u: -u[0]))
    best, path = lowest(Optimizer("controlled_adam"), bowl, 30, falls=lambda u: u[0] > 2.0)
    fell = np.flatnonzero(path[:, 0] > 2.0)
    assert len(fell)
    assert best < -1.9
    after = path[fell[fell < 29] + 1, 0]
    assert (after < path[fell[fell < 29], 0]).all()
    np.testing.assert_allclose(path[:, 1], -0.8)


def test_a_controlled_rate_has_no_rate_to_give():
    """Its one option is the first one."""
    with pytest.raises(
        ParameterError, match=r"learning_rate is not an option of controlled_adam; allowed are"
    ):
        Optimizer("controlled_adam", {"learning_rate": 0.1})
    assert Optimizer("controlled_adam", {"rate": 0.1}).written() == {
        "name": "controlled_adam",
        "rate": 0.1,
    }
