"""Controller x physics x metrics in one loop: from named parameters to named metrics."""

from nermo_mjx.rollout.own_metrics import METRICS, Metric, metric
from nermo_mjx.rollout.run import Run
from nermo_mjx.rollout.saving import Saving, Series
from nermo_mjx.rollout.setup import Setup, all_metrics, all_parameters
from nermo_mjx.rollout.simulator import History, RunResult, Simulator
