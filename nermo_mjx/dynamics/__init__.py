"""Forward dynamics of any model in MJX, with derivatives through contacts, limits and tendons.

- `step` and `forward` replace `mjx.step` and `mjx.forward`, for the results of `put_model`, `make_data` and `put_data`.
- `step_with_verdict` also returns whether the constraint solver converged.
- `checkpointed_scan` replaces `jax.lax.scan` for the reverse mode of long runs.
- `check_gradient` compares a gradient with finite differences.
- `not_simulated` lists the elements of a model that `step` omits, and `approximated` the differences to MuJoCo C.
- `fitted` changes a model so that MJX supports it.
- `MassConstants` and `PlaceConstants` compute the constants that MuJoCo derives from masses, and from masses and positions.

This subpackage does not depend on the robot, and MJX stays unchanged. docs/howto/step.md shows the use with any model.

Names are imported on first use: `precision`, for example, works without MJX.
"""

# ruff: noqa: I001  (one statement for each module)
from __future__ import annotations

from typing import TYPE_CHECKING

from nermo_mjx.lazy import lazy_names

if TYPE_CHECKING:
    from nermo_mjx.dynamics.checking import (
        GradientCheck as GradientCheck,
        check_gradient as check_gradient,
    )
    from nermo_mjx.dynamics.checkpointing import checkpointed_scan as checkpointed_scan
    from nermo_mjx.dynamics.constants import (
        MassConstants as MassConstants,
        PlaceConstants as PlaceConstants,
    )
    from nermo_mjx.dynamics.coverage import (
        approximated as approximated,
        not_simulated as not_simulated,
    )
    from nermo_mjx.dynamics.differentiable import (
        Verdict as Verdict,
        forward as forward,
        step as step,
        step_with_verdict as step_with_verdict,
    )
    from nermo_mjx.dynamics.mjx_copy import (
        make_data as make_data,
        put_data as put_data,
        put_model as put_model,
    )
    from nermo_mjx.dynamics.preparing import fitted as fitted
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
