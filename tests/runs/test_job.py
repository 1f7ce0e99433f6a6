# Tests of runs/job.py
"""When an interruption ends a job."""

from __future__ import annotations

import signal

import pytest

from nermo_mjx.runs.job import interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_while_a_file_is_written_ends_the_job_afterwards(
    number: signal.Signals,
) -> None:
    events = []

    def job() -> None:
        with interruptible() as interruption:
            with interruption.shielded():
                signal.raise_signal(number)
                events.append("the rest of the file")
            events.append("the next file")

    with pytest.raises(KeyboardInterrupt):
        job()
    assert events == ["the rest of the file"]


def test_an_interruption_that_a_library_swallows_ends_the_job_at_the_next_check() -> None:
    with interruptible() as interruption:
        interruption.check()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interruption.check()
