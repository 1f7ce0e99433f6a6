"""Learning: the robot as an environment of many worlds, its rewards, and training and running a policy.

Names are imported on first use: running a policy does not need tables, figures and checkpoints, for example.
"""

# ruff: noqa: I001  (one statement for each module)
from __future__ import annotations

from typing import TYPE_CHECKING

from nermo_mjx.lazy import lazy_names

if TYPE_CHECKING:
    from nermo_mjx.learn.acting import (
        Modulation as Modulation,
        Residual as Residual,
        Targets as Targets,
    )
    from nermo_mjx.learn.algorithms import PPO as PPO
    from nermo_mjx.learn.environment import (
        SENTENCES as SENTENCES,
        Environment as Environment,
        State as State,
    )
    from nermo_mjx.learn.evaluation import played_task as played_task
    from nermo_mjx.learn.observing import Sensed as Sensed
    from nermo_mjx.learn.policy import Policy as Policy, load_policy as load_policy
    from nermo_mjx.learn.run import TrainingResult as TrainingResult, run_training as run_training
    from nermo_mjx.learn.spec import Training as Training
    from nermo_mjx.learn.task import (
        TERMS as TERMS,
        Moment as Moment,
        Outcome as Outcome,
        Task as Task,
        Term as Term,
        task_parameters as task_parameters,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, removed={"ShortHorizon": "use PPO"})
