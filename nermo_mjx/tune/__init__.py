"""Gradient tuning of named parameters: read and check a tuning file, step its starts, store every iteration, and plot
the results; and whether such gradients can be trusted."""

from nermo_mjx.tune.directory import load_tuning
from nermo_mjx.tune.history import read_history
from nermo_mjx.tune.landscape import LandscapeResult, run_landscape
from nermo_mjx.tune.objective import Evaluation, Objective, Problem, Term
from nermo_mjx.tune.run import TuningFailed, TuningInterrupted, TuningProgress, TuningResult, run_tuning
from nermo_mjx.tune.spec import Tuning

__all__ = [
    "Evaluation", "LandscapeResult", "Objective", "Problem", "Term", "Tuning", "TuningFailed", "TuningInterrupted",
    "TuningProgress", "TuningResult", "load_tuning", "read_history", "run_landscape", "run_tuning",
]  # fmt: skip
