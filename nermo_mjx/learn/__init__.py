"""Learning: the robot as an environment of many worlds, what a policy does and observes there, and its rewards."""

from __future__ import annotations

from nermo_mjx.learn.acting import Modulation, Residual, Targets
from nermo_mjx.learn.environment import SENTENCES, Environment, State
from nermo_mjx.learn.rewards import TERMS, Term
from nermo_mjx.learn.task import Outcome, Task, task_parameters

__all__ = [
    "SENTENCES", "TERMS", "Environment", "Modulation", "Outcome", "Residual", "State", "Targets", "Task", "Term",
    "task_parameters",
]  # fmt: skip
