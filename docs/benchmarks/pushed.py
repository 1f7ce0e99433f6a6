"""How often a policy and the controller that it corrects fall when they are pushed from the side.

    python docs/benchmarks/pushed.py POLICY.npz

The torso is pushed for 0.1 s, to the left or to the right, at ten phases of the gait cycle after 1.5 s of a walk on
flat ground. A walk falls if the torso leans by more than 60 degrees at any time of the 2 s that follow.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np

from nermo_mjx.learn import load_policy
from nermo_mjx.live.driving import Driving
from nermo_mjx.rollout import Setup

FORCES = (0.5, 1.0, 2.0, 4.0)


def fell(driving: Driving, force: float, phase: float) -> bool:
    """Whether the robot fell, pushed with a force [N] at a phase of its cycle."""
    driving.reset()
    pushed = 1.5 + phase / driving.values["frequency"]
    while driving.time < pushed:
        driving.tick()
    model = driving.simulator.robot.model
    driving.push(model.body("torso").id, (force, 0.0, 0.0), 0.1)
    while driving.time < pushed + 2.0:
        driving.tick()
    qpos = driving.recording().qpos
    upright = 1.0 - 2.0 * (
        qpos[:, 4] ** 2 + qpos[:, 5] ** 2
    )  # the z component of the torso's vertical axis
    return bool((upright < 0.5).any())


def main() -> None:
    policy = load_policy(sys.argv[1])
    for name, setup in (
        ("policy", Setup(controller=policy)),
        ("controller alone", Setup(gait="trot")),
    ):
        driving = Driving(setup, {"frequency": setup.defaults()["frequency"]})
        for force in FORCES:
            cases = itertools.product((-force, force), np.arange(10) / 10)
            falls = sum(fell(driving, *case) for case in cases)
            print(f"{name:17s} {force:4.1f} N: {falls:2d} of 20 fall", flush=True)


if __name__ == "__main__":
    main()
