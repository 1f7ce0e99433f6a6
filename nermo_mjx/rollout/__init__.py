"""Controller x physics x metrics in one loop: from named parameters to named metrics."""

from nermo_mjx.rollout.catalogue import METRICS, Metric
from nermo_mjx.rollout.length import Run
from nermo_mjx.rollout.own_metrics import OwnMetric, metric
from nermo_mjx.rollout.result import History, RunResult
from nermo_mjx.rollout.saving import Saving, Series
from nermo_mjx.rollout.setup import Setup, all_metrics, all_parameters
from nermo_mjx.rollout.simulator import Simulator

__all__ = [
    "METRICS", "History", "Metric", "OwnMetric", "Run", "RunResult", "Saving", "Series", "Setup", "Simulator",
    "all_metrics", "all_parameters", "metric",
]  # fmt: skip
