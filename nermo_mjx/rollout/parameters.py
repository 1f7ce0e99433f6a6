"""Everything that may differ between the worlds of a batch, under one set of names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.robot.geometry import check_geometry
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import Quantity, check_quantities, flat, group, parameter_tree, quantities, quantity
from nermo_mjx.robot.servo_limits import check_servo, highest_kp, highest_kv


@parameter_tree
class Start:
    """Position, heading and gait phase at the start."""

    x: Any = quantity(0.0, "m", -100.0, 100.0, "start to the left of the path")
    y: Any = quantity(0.0, "m", -100.0, 100.0, "start behind the origin")
    yaw: Any = quantity(0.0, "rad", -np.pi, np.pi, "heading at the start, positive to the left")
    phase: Any = quantity(0.0, "1", -1.0, 1.0, "phase of the gait cycle at the start")


@parameter_tree
class Window:
    """When a run is measured; set from `Run`, not by name."""

    begin: Any = quantity(0.0, "s", 0.0, 1e6, "end of the warm-up")
    end: Any = quantity(1e6, "s", 0.0, 1e6, "end of the run")
    distance: Any = quantity(1e6, "m", 0.0, 1e6, "path length after which measuring stops")


@parameter_tree
class WorldParameters:
    """The parameters that a sweep can name: controller, body and start. The parameters of another controller may be any
    pytree."""

    control: Any = flat(ControlParameters)
    model: ModelParameters = flat(ModelParameters)
    start: Start = group(Start)


def check_ranges(world: WorldParameters, timestep: float) -> None:
    """Reject parameters that are not finite, out of range, or not allowed by the time step [s]; see `Setup.check`."""
    check_quantities(world)
    for name, about in bounded_by_step(dict(quantities(ModelParameters)), timestep).items():
        part, field = name.split(".")
        about.check(name, getattr(getattr(world.model, part), field))
    check_geometry(world.model.geometry)
    check_servo(world.model.servo.kp, world.model.servo.kv, timestep)


def bounded_by_step(known: Mapping[str, Quantity], timestep: float) -> dict[str, Quantity]:
    """The parameters whose range depends on the time step, with their remaining range."""
    contact, kp, kv = (known[name] for name in ("contact.time_constant", "servo.kp", "servo.kv"))
    stiffest, most_damped = highest_kp(timestep, float(kv.default)), highest_kv(timestep, float(kp.default))  # type: ignore[arg-type]
    return {
        # MuJoCo silently lengthens time constants shorter than two time steps.
        "contact.time_constant": dataclasses.replace(contact, low=max(contact.low, 2 * timestep)),
        "servo.kp": dataclasses.replace(kp, high=min(kp.high, stiffest)),
        "servo.kv": dataclasses.replace(kv, high=min(kv.high, most_damped)),
    }
