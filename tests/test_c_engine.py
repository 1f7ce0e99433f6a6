"""On the C engine a walk's numbers depend on nothing but the walk: not on its batch, its place in it, or the cores."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from nermo_mjx.physics.c_engine import LANES, CEngine
from nermo_mjx.rollout import Run
from nermo_mjx.rollout.run import LANES as PIECE
from nermo_mjx.rollout.run import Lanes

#: More worlds than one block, on any number of cores.
WORLDS = LANES + 9
RUN = Run(duration=0.6, warmup=0.1)


@pytest.fixture(scope="module")
def walks() -> dict[str, np.ndarray]:
    """Walks of different gaits, soles and masses."""
    draw = np.random.default_rng(3).uniform
    return {
        "frequency": draw(0.5, 1.0, WORLDS),
        "stride": draw(0.5, 1.0, WORLDS),
        "spine.amplitude": draw(0.0, 0.4, WORLDS),
        "spine.phase": draw(-np.pi, np.pi, WORLDS),
        "contact.friction": draw(0.8, 1.5, WORLDS),
        "mass.front": draw(0.12, 0.2, WORLDS),
        "start.yaw": draw(-0.1, 0.1, WORLDS),
    }


def some(walks: dict[str, np.ndarray], ids: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[ids] for name, values in walks.items()}


def same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> None:
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def test_neither_the_batch_nor_the_place_in_it_changes_a_bit(simulator, walks) -> None:
    """Alone, in a small batch, and in the whole one in another order."""
    sim = simulator(spine="stride_extension")
    whole = sim.run(walks, RUN).metrics
    assert len(np.unique(whole["speed"])) == WORLDS
    order = np.random.default_rng(0).permutation(WORLDS)
    same(sim.run(some(walks, order), RUN).metrics, some(whole, order))
    for ids in ([7], [3, 40, 11, 12, 30]):
        same(sim.run(some(walks, np.array(ids)), RUN).metrics, some(whole, np.array(ids)))


@pytest.mark.parametrize("threads", [1, 3, 64])
def test_the_number_of_threads_changes_no_bit(simulator, walks, threads: int) -> None:
    """Fewer threads than blocks, as many, and more."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(walks, RUN)
    trace = {}
    for count in (2, threads):
        engine = CEngine(sim.robot, sim.loop, threads=count)
        trace[count] = engine.open(batch.params, batch.qpos, batch.fields).record(40)
    for name in ("qpos", "qvel", "ctrl", "sensordata"):
        np.testing.assert_array_equal(getattr(trace[2], name), getattr(trace[threads], name), err_msg=name)


def test_worlds_that_rest_do_not_change_the_others(simulator, walks) -> None:
    """Retired after different times, among others that go on."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(walks, RUN)
    session, undisturbed = (sim.engine.open(batch.params, batch.qpos, batch.fields) for _ in range(2))
    rest = np.arange(WORLDS) % 3 == 0
    session.advance(10)
    session.retire(rest)
    session.advance(30)
    undisturbed.advance(40)
    np.testing.assert_array_equal(session.qpos[~rest], undisturbed.qpos[~rest])
    assert not np.isclose(session.qpos[rest], undisturbed.qpos[rest]).all()
    states = [jax.tree.leaves(each.loop_state) for each in (session, undisturbed)]
    for left, right in zip(*states, strict=True):
        np.testing.assert_array_equal(left[~rest], right[~rest])


def test_a_batch_in_double_precision_runs_on_all_cores(simulator, walks) -> None:
    """Precision is a setting of each thread in JAX; the engine's threads have that of who opened the batch."""
    sim = simulator(spine="stride_extension")
    with jax.enable_x64(True):
        batch = sim.prepare(walks, RUN)
        engine = CEngine(sim.robot, sim.loop, threads=2)
        session = engine.open(batch.params, batch.qpos, batch.fields)
        session.advance(3)
        assert {leaf.dtype for leaf in jax.tree.leaves(session.loop_state)} >= {np.dtype(np.float64)}
        assert np.dtype(np.float32) not in {leaf.dtype for leaf in jax.tree.leaves(session.loop_state)}


@pytest.mark.parametrize("worlds", [1, PIECE, PIECE + 1])
def test_lanes_give_every_world_its_own_result(worlds: int) -> None:
    """Whole pieces and parts of them; several arguments and results."""
    x = np.arange(worlds, dtype=np.float32)
    total, pair = Lanes(lambda a, b: (a + b["c"], {"twice": 2 * a}))(x, {"c": np.ones(worlds, np.float32)})
    np.testing.assert_array_equal(total, x + 1)
    np.testing.assert_array_equal(pair["twice"], 2 * x)


def test_the_loop_is_one_function_that_runs_on_the_thread_of_its_block(simulator, walks) -> None:
    """Otherwise there are a hundred, which XLA's threads run on the physics' cores; the engine is a tenth slower."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(some(walks, np.arange(4)), RUN)
    session = sim.engine.open(batch.params, batch.qpos, batch.fields)
    program = session.loop.step.lower(*session.arguments).compile().as_text()
    entry = program[program.index("ENTRY") :]
    assert entry.count("xla_cpu_small_call") == 1
    assert entry.count(" fusion(") < 16
