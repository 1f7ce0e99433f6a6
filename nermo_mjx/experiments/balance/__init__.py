"""The balance experiment: its protocol, what is measured, and the run."""

from nermo_mjx.experiments.balance.experiment import NAME, SETTABLE, run

__all__ = ["NAME", "SETTABLE", "run"]
