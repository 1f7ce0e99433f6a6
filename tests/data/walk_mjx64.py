"""Makes walk_mjx64.npz: how far a walk has come after some ticks, and its derivative by MJX in float64."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from nermo_mjx import Rollout, Run, Setup, Simulator, compiler_options

TICKS = np.array([50, 200, 600])

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    setup, run, names = (
        Setup(spine="stride_extension"),
        Run(duration=6.0, warmup=1.0),
        ("spine.amplitude", "spine.phase"),
    )
    point = np.array([0.2, -0.5])
    first = (
        Simulator(setup, "c")
        .prepare({"frequency": 0.8} | dict(zip(names, point, strict=True)), run)
        .qpos[0]
    )
    rollout = Rollout(setup, run, "mjx")

    def places(point: jax.Array) -> jax.Array:
        _, path = rollout.record(
            {"frequency": 0.8} | dict(zip(names, point, strict=True)), qpos=first
        )
        return path.qpos[TICKS - 1, rollout.robot.joints.root : rollout.robot.joints.root + 2]

    place, slope = jax.jit(
        lambda point: (places(point), jax.jacfwd(places)(point)),
        compiler_options=compiler_options(),
    )(jnp.asarray(point))
    file = Path(__file__).with_suffix(".npz")
    np.savez(
        file,
        ticks=TICKS,
        first=first,
        point=point,
        place=np.asarray(place),
        slope=np.asarray(slope),
    )
