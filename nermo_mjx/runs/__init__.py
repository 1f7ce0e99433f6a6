"""Run directories of every kind: who may write them, and which code made their contents."""

from nermo_mjx.runs.code import CodeStamp, session, stamp
from nermo_mjx.runs.directory import OtherCode, RunDirectory, Written, codes_of, engine_of, kind_of
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.job import Interrupted, JobFailed, Progress, Watch
