"""Sweeps: read and check a sweep file, sample its variants, run them into a directory, summarize and plot."""

from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.provenance import machine, versions
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import Results, read_table
from nermo_mjx.sweep.run import SweepResult, merge_sweeps, run_sweep
from nermo_mjx.sweep.sampling import Rows, Sample, sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.table import summarize

__all__ = [
    "DirectoryError",
    "Results",
    "Rows",
    "Sample",
    "SpecError",
    "Sweep",
    "SweepResult",
    "machine",
    "merge_sweeps",
    "read_table",
    "run_sweep",
    "sample",
    "summarize",
    "versions",
]
