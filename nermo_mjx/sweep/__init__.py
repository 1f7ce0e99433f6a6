"""Sweeps: read and check a sweep file, sample its variants, run them into a directory, summarize and plot."""

from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.merging import merge_sweeps
from nermo_mjx.sweep.run import SweepResult, run_sweep
from nermo_mjx.sweep.spec import Sweep, sample
from nermo_mjx.sweep.table import Results, read_table
