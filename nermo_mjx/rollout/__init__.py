"""Controller x physics x metrics in one loop: from named parameters to named metrics."""

from nermo_mjx.rollout.custom_metrics import metric
from nermo_mjx.rollout.metric_table import METRICS, Metric
from nermo_mjx.rollout.run import Run
from nermo_mjx.rollout.saving import Saving, Series
from nermo_mjx.rollout.setup import Setup, all_metrics, all_parameters
from nermo_mjx.rollout.simulator import History, RunResult, Simulator
