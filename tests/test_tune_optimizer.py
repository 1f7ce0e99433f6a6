"""Optimizers and schedules of optax by name."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.tune.optimizer import Optimizer, optimizers, schedules


def walk(optimizer, steps=12):
    """The path of two starts under constant gradients, (steps, 2, 2)."""
    chosen, u = optimizer.build(), jnp.array([[0.5, -0.3], [1.0, 2.0]])
    state, path = jax.vmap(chosen.init)(u), []
    for _ in range(steps):
        step, state = jax.vmap(chosen.update)(jnp.array([[3.0, -4.0], [0.3, 0.4]]), state, u)
        u = u + step
        path.append(np.asarray(u))
    return np.stack(path)


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
    chosen, u = optax.adam(0.3, b1=0.5), jnp.array([1.0, 2.0])
    state = chosen.init(u)
    for row in mine[:, 1]:
        step, state = chosen.update(jnp.array([0.3, 0.4]), state, u)
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
    rate = {"name": "piecewise_constant_schedule", "init_value": 1.0, "boundaries_and_scales": {"2": 0.1}}
    steps = np.diff(walk(Optimizer("sgd", {"learning_rate": rate}), 4)[:, 1, 0], prepend=1.0)
    np.testing.assert_allclose(steps, [-0.3, -0.3, -0.03, -0.03], rtol=1e-5)


def test_each_start_is_clipped_by_itself():
    """A gradient of length 5 is shortened to 1, one of 0.5 beside it is not."""
    path = walk(Optimizer("sgd", {"learning_rate": 1.0}, clip=1.0), 1)
    np.testing.assert_allclose(path[0], [[0.5 - 0.6, -0.3 + 0.8], [1.0 - 0.3, 2.0 - 0.4]], rtol=1e-5)


@pytest.mark.parametrize(
    ("given", "parts"),
    [
        ({"name": "adamm"}, ["optimizer.name is 'adamm'", "did you mean 'adam'?"]),
        ({"name": "lbfgs"}, ["'lbfgs'", "does not work from gradients alone", "value_fn"]),
        ({"name": "noisy_sgd"}, ["random numbers of its own"]),
        ({"options": {"beta1": 0.9}}, ["optimizer.beta1 is not an option of adam", "b1, b2"]),
        ({"options": {"learning_rate": {"cosin": {"init_value": 1, "decay_steps": 4}}}},
         ["optimizer.learning_rate is the schedule 'cosin'", "cosine_decay_schedule"]),
        ({"options": {"learning_rate": {"cosine": {"init_value": 1}}}},
         ["cosine_decay_schedule without decay_steps"]),
        ({"options": {"learning_rate": {"cosine": {"init_value": 1, "decay_step": 4}}}},
         ["optimizer.learning_rate.decay_step", "did you mean 'decay_steps'?"]),
        ({"options": {"learning_rate": {"cosine": {"init_value": 1, "decay_steps": -4}}}}, ["refuses its options"]),
        ({"options": {"learning_rate": {"constant": {"value": float("nan")}}}}, ["starts at nan"]),
        ({"options": {"learning_rate": {"a": 1, "b": 2}}}, ["a mapping of a, b", "expected a number, or a schedule"]),
        ({"name": "rprop", "options": {"learning_rate": {"constant": {"value": 0.1}}}}, ["'rprop'"]),
        ({"options": {"b1": "much"}}, ["optimizer.name is 'adam'"]),
        ({"options": {"b2": float("inf")}}, ["expected finite numbers"]),
        ({"clip": 0.0}, ["optimizer.clip is 0"]),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused_in_a_sentence(given, parts):
    """Before anything simulates: unknown names with the nearest, wrong options, optimizers that need more."""
    with pytest.raises(ParameterError) as caught:
        Optimizer(**given)
    message = str(caught.value)
    assert [part for part in parts if part not in message] == [], message
    assert "\n" not in message
    assert message[-1] in ".?"


def test_schedules_are_those_of_optax():
    """The common ones are there, helpers that are no schedule are not."""
    assert {"cosine_decay_schedule", "exponential_decay", "linear_schedule", "warmup_cosine_decay_schedule"} <= set(
        schedules()
    )
    assert not {"join_schedules", "scale_by_schedule", "incremental_update"} & set(schedules())
