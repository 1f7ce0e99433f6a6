"""The protocol of a search's optimizers: asked for a batch, and told its results. They have no other input.

So a search is repeated, or resumed, by telling it the contents of its table again.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from nermo_mjx.search.scoring import Scores


@dataclasses.dataclass(frozen=True)
class Asked:
    """Points to evaluate.

    Attributes:
        shares: of the bounds, (n, p) in [0, 1].
        gradients: of this number, from the first on, gradients are requested, too.
    """

    shares: np.ndarray
    gradients: int = 0


class Optimizer(Protocol):
    """Chooses points; `ask` and `tell` alternate, and the same results lead to the same requests."""

    def ask(self) -> Asked:
        """The next batch."""
        ...

    def tell(self, found: Scores) -> None:
        """The results of the batch, in its order."""
        ...
