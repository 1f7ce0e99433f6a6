"""Learning: the robot as an environment of many worlds, its rewards, and training and running a policy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

from nermo_mjx.learn.acting import Modulation, Residual, Targets
from nermo_mjx.learn.algorithms import PPO
from nermo_mjx.learn.environment import SENTENCES, Environment, State
from nermo_mjx.learn.observing import Sensed
from nermo_mjx.learn.policy import Policy, load_policy
from nermo_mjx.learn.task import TERMS, Moment, Outcome, Task, Term, task_parameters

if TYPE_CHECKING:
    from nermo_mjx.learn.run import TrainingResult, run_training
    from nermo_mjx.learn.spec import Training

#: Names that import tables, figures and checkpoints, which running a policy does not need.
_LATER: Final = {"Training": "spec", "TrainingResult": "run", "run_training": "run"}

__all__ = ["PPO", "SENTENCES", "TERMS", "Environment", "Modulation", "Moment", "Outcome", "Policy", "Residual"]
__all__ += ["Sensed"]
__all__ += ["State", "Targets", "Task", "Term", "Training", "TrainingResult", "load_policy", "run_training"]
__all__ += ["task_parameters"]


def __getattr__(name: str) -> Any:
    if name == "ShortHorizon":  # of an AttributeError, `from nermo_mjx.learn import ...` would hide the message
        raise ImportError("nermo_mjx.learn.ShortHorizon was removed: use PPO.")
    if name not in _LATER:
        raise AttributeError(f"module 'nermo_mjx.learn' has no attribute {name!r}")
    return getattr(importlib.import_module(f"nermo_mjx.learn.{_LATER[name]}"), name)
