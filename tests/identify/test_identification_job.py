# Tests of identify/run.py
"""The job of an identification: a directory that resumes, and that other code than its own does not affect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_identification import START, arm, logged

from nermo_mjx import IdentificationResult, run_identification
from nermo_mjx.identify import estimation, identification, run
from nermo_mjx.runs import Interrupted, Watch, code, codes_of


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of searches by Gauss-Newton, and the number after which the process is interrupted; without a report."""
    counts, search = [0, 99], estimation.minimize.least_squares

    def counted(*arguments: object, **options: object) -> object:
        if counts[0] == counts[1]:
            raise KeyboardInterrupt
        counts[0] += 1
        return search(*arguments, **options)

    monkeypatch.setattr(estimation.minimize, "least_squares", counted)
    monkeypatch.setattr(run, "write_identification", lambda *of: {})
    monkeypatch.setattr(identification, "SCANNED_POINTS", 8)
    return counts


def identified(folder: Path, out: str, **options: object) -> IdentificationResult:
    (folder / "arm.xml").write_text(arm(START))
    model, log = folder / "arm.xml", logged(1.0)
    return run_identification([log], folder / out, model=model, free=("damping",), **options)


def changed(monkeypatch: pytest.MonkeyPatch, subpackage: str) -> None:
    """Simulate a change of the sources of a subpackage."""
    sources: Callable[[tuple[str, ...]], str] = code.sources
    monkeypatch.setattr(
        code, "sources", lambda more=(): f"{sources(more)}{'0' * (subpackage in more)}"
    )


@pytest.mark.parametrize(
    ("subpackage", "seed", "again"),
    [
        ("experiments", 0, 0),
        pytest.param("identify", 0, 2, marks=pytest.mark.release),
        pytest.param("", 1, 2, marks=pytest.mark.release),
    ],
)
def test_an_identification_goes_on_after_its_last_search_with_its_own_code(
    tmp_path: Path,
    searches: list[int],
    monkeypatch: pytest.MonkeyPatch,
    subpackage: str,
    seed: int,
    again: int,
) -> None:
    """A change of other subpackages, such as of the plots of experiments, discards nothing."""
    whole, total, warnings = identified(tmp_path, "whole", seed=seed), searches[0], list[str]()
    searches[:] = [0, 2]
    with pytest.raises(Interrupted, match="run the same command again"):
        identified(tmp_path, "out")
    changed(monkeypatch, subpackage)
    searches[:] = [0, 99]
    resumed = identified(tmp_path, "out", seed=seed, watch=Watch(warn=warnings.append))
    assert searches[0] == total - 2 + again
    assert len(warnings) == (again > 0)
    assert len(codes_of(tmp_path / "out")) == 1 + (subpackage == "identify")
    np.testing.assert_array_equal(resumed.identification.fit.draws, whole.identification.fit.draws)
