"""The balance experiment: its protocol, measurements and run."""

from nermo_mjx.experiments.balance.experiment import NAME, SETTABLE, run

__all__ = ["NAME", "SETTABLE", "run"]
