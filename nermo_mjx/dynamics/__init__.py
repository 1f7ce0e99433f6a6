"""Forward dynamics of any model in MJX, with derivatives through contacts, limits and tendons.

`step` and `forward` take the place of `mjx.step` and `mjx.forward`, for models and data of `put_model`, `make_data` and
`put_data`; `step_with_verdict` also says how well a step was solved, `checkpointed_scan` takes the place of
`jax.lax.scan` where a long run is differentiated in reverse mode, `check_gradient` compares a gradient with
differences, `not_simulated` says what they leave out of a model and `approximated` what they do otherwise than
MuJoCo C, `fitted` makes a model fit for MJX, and `MassConstants` and `PlaceConstants` compute the constants that MuJoCo
derives from masses, and from masses and positions. Nothing here depends on the robot, and MJX stays unchanged.
docs/howto/step.md shows the use with any model.

Names are imported on first use: `precision`, for example, works without MJX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nermo_mjx.dynamics.checking import GradientCheck, check_gradient
    from nermo_mjx.dynamics.checkpointing import checkpointed_scan
    from nermo_mjx.dynamics.constants import MassConstants, PlaceConstants
    from nermo_mjx.dynamics.coverage import approximated, not_simulated
    from nermo_mjx.dynamics.differentiable import Verdict, forward, step, step_with_verdict
    from nermo_mjx.dynamics.mjx_copy import make_data, put_data, put_model
    from nermo_mjx.dynamics.preparing import fitted

_HOMES = {
    "nermo_mjx.dynamics.checking": ("GradientCheck", "check_gradient"),
    "nermo_mjx.dynamics.checkpointing": ("checkpointed_scan",),
    "nermo_mjx.dynamics.constants": ("MassConstants", "PlaceConstants"),
    "nermo_mjx.dynamics.coverage": ("approximated", "not_simulated"),
    "nermo_mjx.dynamics.differentiable": ("Verdict", "forward", "step", "step_with_verdict"),
    "nermo_mjx.dynamics.mjx_copy": ("make_data", "put_data", "put_model"),
    "nermo_mjx.dynamics.preparing": ("fitted",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["GradientCheck", "MassConstants", "PlaceConstants", "Verdict", "approximated", "check_gradient"]
__all__ += ["checkpointed_scan", "fitted", "forward", "make_data", "not_simulated", "put_data", "put_model", "step"]
__all__ += ["step_with_verdict"]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nermo_mjx.dynamics' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)
