"""Better parameters: a tuning steps from given points, a search looks for the best point, a front, or an atlas.

from nermo_mjx.optimize import run_search, run_tuning
result = run_search("sweeps/search_speed.yaml", "runs/fast")
result.best["parameters"], result.best["metrics"]["speed"]
"""

from nermo_mjx.optimize.objective import Evaluation
from nermo_mjx.optimize.search_run import SearchResult, run_search
from nermo_mjx.optimize.search_spec import Search
from nermo_mjx.optimize.tuning_history import read_history
from nermo_mjx.optimize.tuning_run import TuningResult, run_tuning
from nermo_mjx.optimize.tuning_spec import Tuning
