"""What late and lost messages cost a robot that is driven over topics, for docs/howto/robot.md, as JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from nermo_mjx import Setup
from nermo_mjx.live.wire import RobotDriving, Way

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from fakes.wires import CHANNELS, Together

SECONDS, DRAWS = 8.0, 6
#: Mean delay [s] and share of lost messages, both ways.
WAYS = ((0.02, 0.0), (0.02, 0.01), (0.05, 0.01), (0.1, 0.05))


class Constant:
    """In place of random numbers: no message overtakes another, and none is lost."""

    def uniform(self, low: float, high: float) -> float:
        return (low + high) / 2

    def random(self) -> float:
        return 1.0


def distance(driving: RobotDriving, delay: float, loss: float, draw: int | None) -> float:
    """How far it walks [m]."""
    both = Together(driving, delay=delay, loss=loss)
    randoms = [
        Constant() if draw is None else np.random.default_rng([draw, way]) for way in range(2)
    ]
    both.body._inward, both.body.outward = (Way(delay, loss, random) for random in randoms)
    both.walk(SECONDS)
    return both.body.about["distance"]


def main() -> dict[str, str]:
    driving = RobotDriving(Setup(), channels=CHANNELS, rate=100.0)
    whole = distance(driving, 0.0, 0.0, None)
    found = {
        "messages.constant_20": f"{100 * (1 - distance(driving, 0.02, 0.0, None) / whole):.1f}"
    }
    for delay, loss in WAYS:
        lost = [100 * (1 - distance(driving, delay, loss, draw) / whole) for draw in range(DRAWS)]
        name = f"messages.{1e3 * delay:.0f}_{100 * loss:.0f}"
        found |= {
            name: f"{np.mean(lost):.0f}",
            f"{name}_range": f"{min(lost):.0f} to {max(lost):.0f}",
        }
    return found


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
