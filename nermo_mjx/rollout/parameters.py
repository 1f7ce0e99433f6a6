"""Everything that may differ between the worlds of a batch, under one set of names."""

from __future__ import annotations

from typing import Any

import numpy as np

from nermo_mjx.control.parameters import ControlParameters
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.quantity import flat, group, parameter_tree, quantity


@parameter_tree
class Start:
    """Position, heading and gait phase at the start."""

    x: Any = quantity(0.0, unit="m", low=-100.0, high=100.0, doc="start to the left of the path")
    y: Any = quantity(0.0, unit="m", low=-100.0, high=100.0, doc="start behind the origin")
    yaw: Any = quantity(0.0, unit="rad", low=-np.pi, high=np.pi, doc="heading at the start, positive to the left")
    phase: Any = quantity(0.0, unit="1", low=-1.0, high=1.0, doc="phase of the gait cycle at the start")


@parameter_tree
class Window:
    """When a run is measured; set from `Run`, not by name."""

    begin: Any = quantity(0.0, unit="s", low=0.0, high=1e6, doc="end of the warm-up")
    end: Any = quantity(1e6, unit="s", low=0.0, high=1e6, doc="end of the run")
    distance: Any = quantity(1e6, unit="m", low=0.0, high=1e6, doc="path length after which measuring stops")


@parameter_tree
class WorldParameters:
    """The parameters that a sweep can name: controller, body and start. The parameters of another controller may be any
    pytree."""

    control: Any = flat(ControlParameters)
    model: ModelParameters = flat(ModelParameters)
    start: Start = group(Start)
