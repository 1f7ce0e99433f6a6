"""Which of a training's policies is kept: the best of the checkpoints, by walks that no training or evaluation draws.

What counts is the success on the scene where it is least, as in a training's summary; its mean decides between equals.
The untrained policy, which leaves the controller as it is, is the first candidate: a training whose corrections do harm
does not end with them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from nermo_mjx.learn.directory import POLICY as POLICY_FILE
from nermo_mjx.learn.evaluation import POLICY, Draws, Evaluator, summary_of
from nermo_mjx.learn.policy import Policy, load_policy
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import RunDirectory
from nermo_mjx.runs.files import content_of, parquet_bytes, parquet_table

#: The table of what was tried: one row per checkpoint.
VALIDATION: Final = "validation.parquet"
#: Added to a training's seed; another number than that of the evaluation.
_KEY: Final = 0xB0D1E5


class _Tried(NamedTuple):
    """A policy's steps of training, and its share of successes on each scene."""

    steps: int
    scenes: Mapping[str, float]

    @property
    def rank(self) -> tuple[float, float]:
        """More is better: the least share of successes, and their mean."""
        shares = list(self.scenes.values())
        return min(shares), float(np.mean(shares))


class Choice:
    """The best policy of a training's directory so far, which is what its policy file holds.

    The file is written before the table that names it, so a killed training tries its last policy again and comes to
    the same choice.
    """

    def __init__(
        self, held: RunDirectory, walks: Callable[[Policy], Mapping[str, float]], warn: Callable[[str], None]
    ) -> None:
        """
        Args:
            held: the directory.
            walks: the share of a policy's successes on each scene.
            warn: called with a message if the chosen policy is gone.
        """
        self._held, self._walks, self._warn = held, walks, warn
        table = parquet_table(content_of(held.out / VALIDATION) or b"")
        rows = [] if table is None else table.to_pylist()
        self._tried = [_Tried(row.pop("steps"), row) for row in rows]

    def of(self, policy: Policy) -> Policy:
        """The best of all policies tried, this one included; of equals the earliest."""
        steps = int(policy.about["trained"]["steps"])
        kept = self._kept()
        best = next((each for each in self._tried if each.steps == _steps_of(kept)), None)
        if self._tried and best is None and _steps_of(kept) != steps:
            self._warn(f"{self._held.out / POLICY_FILE} is not the policy that was chosen: the choice begins anew.")
            self._tried = []
        if steps not in [each.steps for each in self._tried]:
            found = _Tried(steps, dict(self._walks(policy)))
            if best is None or found.rank > best.rank:
                self._held.write(POLICY_FILE, policy.content())
                kept = policy
            self._tried.append(found)
            rows = [{"steps": each.steps, **each.scenes} for each in self._tried]
            self._held.write(VALIDATION, parquet_bytes(pa.Table.from_pylist(rows)))
        return kept or policy

    def _kept(self) -> Policy | None:
        """The policy in the file; None if there is none that can be read."""
        try:
            return load_policy(Path(self._held.out) / POLICY_FILE)
        except ParameterError:
            return None


def _steps_of(policy: Policy | None) -> int | None:
    return None if policy is None else policy.about.get("trained", {}).get("steps")


def successes(evaluator: Evaluator, policy: Policy) -> dict[str, float]:
    """The share of a policy's walks that succeed: `validation` of them on each scene of the training's evaluation."""
    table = evaluator(policy, draws=Draws(evaluator.training.validation, _KEY), walkers=(POLICY,))
    return {scene: about[POLICY]["success"] for scene, about in summary_of(table).items()}
