"""Custom functions of a task: rewards, observations, terminations, and the sampler of an episode's commands.

A task refers to a function as FILE.py:NAME or MODULE:NAME, in Python also by the function itself. Each function is
compiled and called for a robot at rest before the first simulation, so that a mistake in it is reported in one sentence
with the file and the line.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx.control.protocol import Ground, function_place, load_object, named_object, user_code
from nermo_mjx.learn.observing import POLICY_INPUTS, SENSED_READINGS, Sensed
from nermo_mjx.robot import ParameterError, RobotConfig, Sensors
from nermo_mjx.rollout.custom_metrics import at_rest, described, numbers_at_rest
from nermo_mjx.runtime import start_jax

#: Samples commands of an episode: (key, control steps of the training so far) -> values by names of parameters.
Sampler = Callable[[Any, Any], Mapping[str, Any]]


def is_custom(value: Any) -> bool:
    """Whether an entry of a task is a custom one: an object, or a text with a colon.

    >>> is_custom("my.py:spine_rate"), is_custom("progress")
    (True, False)
    """
    return not isinstance(value, str) or ":" in value


def custom_object(field: str, value: Any) -> Any:
    """The object to which a text refers, or the object itself; raises `ParameterError`."""
    return load_object(named_object(f"{field} has", value)) if isinstance(value, str) else value


def custom_name(value: Any) -> str:
    """Name of a custom entry: the name of the object in its file, or of the function."""
    if isinstance(value, str):
        return value.rpartition(":")[2]
    return getattr(
        value.read if isinstance(value, Sensed) else value, "__name__", type(value).__name__
    )


def custom_function(field: str, value: Any) -> Callable[..., Any]:
    """A custom function; raises `ParameterError` if the value is not a function."""
    function = custom_object(field, value)
    if not callable(function) or isinstance(function, type):
        raise ParameterError(
            f"{field} has {value!r}, which is {described(function)}: expected a function."
        )
    return function


def custom_readings(config: RobotConfig, observe: Iterable[Any]) -> dict[str, Sensed]:
    """The custom groups of readings in the observations of a task, by name.

    Raises:
        ParameterError: A function fails, does not return finite numbers, or its name is in use.
    """
    readings: dict[str, Sensed] = {}
    for reference in filter(is_custom, observe):
        name = custom_name(reference)
        if name in (*SENSED_READINGS, *POLICY_INPUTS, *readings):
            raise ParameterError(
                f"observe has {reference!r}, but {name} is observed already: give it another name."
            )
        group = custom_object("observe", reference)
        if not isinstance(group, Sensed):
            group = Sensed(custom_function("observe", reference))
        readings[name] = _readings(config, name, group)
    return readings


@functools.lru_cache(maxsize=32)
def _readings(config: RobotConfig, name: str, group: Sensed) -> Sensed:
    """A group of readings with a label for each of its numbers."""
    subject = f"observe has {function_place(name, group.read)}"
    level = (
        (lambda x, y: jnp.zeros(jnp.broadcast_shapes(jnp.shape(x), jnp.shape(y))),)
        if group.ground
        else ()
    )
    size = numbers_at_rest(
        subject, lambda sensors: group.read(sensors, *level), at_rest(config), several=True
    )
    labels = group.labels or (tuple(map(str, range(size.size))) if size.ndim else ("",))
    if len(labels) != size.size:
        raise ParameterError(
            f"{subject}, which gives {described(size)}: it has {len(labels)} labels."
        )

    def read(sensors: Sensors, *ground: Ground) -> Any:
        return jnp.reshape(jnp.asarray(group.read(sensors, *ground), sensors.position.dtype), -1)

    return Sensed(read, group.scale, labels, group.ground)


def custom_terminations(
    config: RobotConfig, references: Iterable[Any]
) -> dict[str, Callable[[Sensors], Any]]:
    """The terminations of a task by name: functions of the sensors that are true if an episode has failed.

    Raises:
        ParameterError: A function fails, does not return one boolean, or two functions have the same name.
    """
    conditions: dict[str, Callable[[Sensors], Any]] = {}
    for reference in references:
        name, function = custom_name(reference), custom_function("terminations", reference)
        subject = f"terminations has {function_place(name, function)}"
        value = numbers_at_rest(subject, function, at_rest(config))
        if value.dtype != bool:
            raise ParameterError(
                f"{subject}, which gives {described(value)}: expected a truth, such as z < 0.02."
            )
        if name in conditions:
            raise ParameterError(
                f"terminations has two of the name {name}: give one of them another."
            )
        conditions[name] = function
    return conditions


#: Number of samples of a sampler that are checked for the first step of a training, and for an evaluation.
_CHECKED_SAMPLES = 64


@functools.lru_cache(maxsize=32)
def _sample_commands(reference: Any, content: Any) -> tuple[str, dict[str, np.ndarray]]:
    """The place of a sampler's code for messages, and sampled values by parameter (2 * _CHECKED_SAMPLES,)."""
    function = custom_function("commands", reference)
    subject = f"commands has {function_place(custom_name(reference), function)}"
    start_jax()
    keys = jnp.tile(jax.random.split(jax.random.key(0), _CHECKED_SAMPLES), 2)
    with user_code(f"{subject}, which fails"):
        samples = jax.jit(jax.vmap(function))(
            keys, jnp.repeat(jnp.array([0.0, jnp.inf]), _CHECKED_SAMPLES)
        )
    if not isinstance(samples, dict) or not samples:
        raise ParameterError(
            f"{subject}, which gives {described(samples)}: expected values by parameters' names."
        )
    for name, values in samples.items():
        if not isinstance(name, str) or getattr(values, "ndim", 0) != 1:
            raise ParameterError(f"{subject}, which gives no single number for {name!r}.")
        wrong = np.asarray(values)[~np.isfinite(values)]
        if wrong.size:
            raise ParameterError(
                f"{subject}, which gives {wrong[0]:g} for {name} at steps of 0 or, as in an evaluation, infinity: "
                "guard it, as by jnp.clip."
            )
    return subject, {name: np.asarray(values, float) for name, values in samples.items()}


def sample_commands(commands: Any) -> tuple[str, dict[str, np.ndarray]]:
    """The beginning of messages about a sampler of commands, and sampled values (2 * _CHECKED_SAMPLES,) by parameter.

    Raises:
        ParameterError: The sampler fails, or does not return finite numbers.
    """
    content = (
        named_object("commands has", commands).content() if isinstance(commands, str) else None
    )
    return _sample_commands(commands, content)


def custom_code_file(observe: Iterable[Any]) -> str:
    """The file or module of a task's custom observations; empty if there are none.

    Raises:
        ParameterError: The observations are in several files; a policy can only refer to one.
    """
    references = [
        named_object("observe has", name)
        for name in observe
        if isinstance(name, str) and is_custom(name)
    ]
    places = list(dict.fromkeys(name.place for name in references))
    if len(places) > 1:
        files = " and ".join(Path(name).name for name in places)
        raise ParameterError(
            f"observe has functions of {files}: put them in one file, which a policy needs beside it."
        )
    return places[0] if places else ""
