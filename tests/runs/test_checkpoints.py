# Tests of runs/checkpoints.py
"""Checkpoints of a directory."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from nermo_mjx.runs.checkpoints import Checkpoints
from nermo_mjx.runs.directory import RunDirectory
from nermo_mjx.runs.files import DirectoryError


@pytest.mark.parametrize("reason", [os.strerror(errno.ENOSPC), "a disk was pulled out"])
def test_a_write_that_fails_in_orbaxs_threads_is_one_error_and_loses_no_checkpoint(
    tmp_path, monkeypatch, reason
):
    """They raise a ValueError for whatever happens: a disk that fills meanwhile counts as one that is full."""

    def fails(*_, **__):
        raise ValueError(
            f"RESOURCE_EXHAUSTED: Error writing local file: {reason} [os_error_code='0']"
        )

    parts = {"state": {"x": np.arange(3.0)}}
    with (
        RunDirectory(tmp_path, "tuning") as directory,
        Checkpoints(directory, "tuning") as checkpoints,
    ):
        checkpoints.save(1, parts, {"identity": "it"})
        with monkeypatch.context() as patch:
            patch.setattr(checkpoints._manager, "save", fails)
            with pytest.raises((OSError, DirectoryError), match=reason) as raised:
                checkpoints.save(2, parts, {"identity": "it"})
        assert isinstance(raised.value, OSError) == (reason == os.strerror(errno.ENOSPC))
        state_and_metadata = checkpoints.restore(lambda metadata: parts)
    assert state_and_metadata is not None
    np.testing.assert_array_equal(state_and_metadata[0]["state"]["x"], np.arange(3.0))
