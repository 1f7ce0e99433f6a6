# Tests of progress.py
"""Where somebody looks, jobs and long walks show their progress in Python; else, or if told so, they are mute."""

from __future__ import annotations

import io
import itertools
import sys
import tempfile
import types

import pytest
from fakes.sweep_fake import SPEC, FakeSimulator

from nermo_mjx import Run, run_sweep
from nermo_mjx.progress import ProgressBar, shown_share, shows_progress
from nermo_mjx.runs.job import Watch


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def on_a_terminal(monkeypatch):
    """Standard error, which is one from now on; pytest sets its own between a fixture and the test."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def swept(**options):
    return run_sweep(SPEC, tempfile.mkdtemp(), simulator=FakeSimulator(), chunk=10, **options)


def test_a_job_shows_its_progress_on_a_terminal(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    swept()
    assert "sweep" in terminal.getvalue()
    assert "of 36 runs" in terminal.getvalue()


def test_a_job_is_mute_where_it_is_told_to_be_and_where_nobody_looks(monkeypatch):
    terminal = on_a_terminal(monkeypatch)
    swept(progress=False)
    events = []
    swept(watch=Watch(progress=events.append))
    assert events[-1].fraction == 1.0
    assert terminal.getvalue() == ""
    quiet = io.StringIO()
    monkeypatch.setattr(sys, "stderr", quiet)
    swept()
    assert quiet.getvalue() == ""


def test_in_a_notebook_a_job_writes_one_line_over_and_over(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=object))
    clock = itertools.count()
    monkeypatch.setattr(
        "nermo_mjx.progress.time", types.SimpleNamespace(monotonic=lambda: float(next(clock)))
    )
    swept()
    text = stream.getvalue()
    assert (text.count("\n"), text[-2:]) == (1, "\r\n")
    states = text.split("\r")[:-1]
    assert len(states) > 2
    assert states[-1].startswith("sweep: 100%, 36 of 36 runs")
    widths = [len(state) for state in states]
    assert all(
        next_width >= len(state.rstrip())
        for state, next_width in zip(states, widths[1:], strict=False)
    ), "nothing is left"


@pytest.mark.parametrize("watch", [3, "no", None, print])
def test_a_watch_of_another_type_is_refused(watch):
    with pytest.raises(
        TypeError, match=r"^watch is .*: expected a Watch, such as Watch\(warn=print\)\.$"
    ):
        swept(watch=watch)


@pytest.mark.release
def test_a_walk_is_shown_if_it_takes_long(simulator, monkeypatch):
    """And nothing inside of a job, which tells of its parts itself."""
    walker = simulator("c")
    walker.run({}, Run(duration=0.2))  # which compiles
    terminal = on_a_terminal(monkeypatch)
    walker.run({}, Run(duration=0.2))
    assert terminal.getvalue() == "", "it is over at once"
    monkeypatch.setattr("nermo_mjx.progress.STALL_SECONDS", -1.0)
    walker.run({}, Run(duration=0.2), progress=False)
    shares = []
    walker.run({}, Run(duration=0.2), progress=shares.append)
    assert shares[-1] == 1.0

    @shows_progress("job")
    def job(*, progress: bool) -> None:
        walker.run({}, Run(duration=0.2))

    job(progress=False)
    assert terminal.getvalue() == ""
    walker.run({}, Run(duration=0.2))
    assert "walk" in terminal.getvalue()
    assert "100%" in terminal.getvalue()


def test_a_walk_refuses_what_it_cannot_tell():
    with (
        pytest.raises(
            TypeError, match=r"^progress is 3: expected a function of the share done, or False"
        ),
        shown_share("x", 3),
    ):
        pass


def test_the_remaining_time_of_a_resumed_job_is_that_of_the_work_of_this_session(
    monkeypatch,
) -> None:
    """Eighty of a hundred were there; ten more take 20 s, so that the last ten take 20 s."""
    clock = iter([0.0, 0.0, 20.0])
    monkeypatch.setattr("nermo_mjx.progress.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    progress = ProgressBar("sweep", "runs", every=0.0, stream=stream)
    progress.share(0.8, 80, 100)
    progress.share(0.9, 90, 100)
    assert stream.getvalue().splitlines()[-1] == "sweep: 90%, 90 of 100 runs, 0.5 runs/s, 20 s left"
