"""How far the published controller gets over planks, for docs/howto/own_scene.md, as JSON."""

from __future__ import annotations

import json

import numpy as np

from nermo_mjx import Run, Setup, Simulator

HEIGHTS = (0.0, 0.004, 0.008)  # [m]
STARTS = 24


def main() -> dict[str, str]:
    """Means over starts and places of the planks, in which a walk that ended counts as far as it got."""
    random = np.random.default_rng(0)
    starts = {
        "start.phase": random.uniform(0.0, 1.0, STARTS),
        "terrain.shift": random.uniform(-0.1, 0.1, STARTS),
    }
    values = {name: np.tile(each, len(HEIGHTS)) for name, each in starts.items()}
    values["terrain.height"] = np.repeat(HEIGHTS, STARTS)
    result = Simulator(Setup(scene="planks"), engine="c").run(
        values, Run(duration=10.0, warmup=1.0)
    )
    flat, *others = (
        np.asarray(result.metrics["distance"]).reshape(len(HEIGHTS), STARTS).mean(axis=1)
    )
    shares = zip(HEIGHTS[1:], others, strict=True)
    return {f"planks.{1e3 * height:.0f}": f"{100 * far / flat:.0f}" for height, far in shares}


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
