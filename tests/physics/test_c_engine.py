# Tests of physics/c_engine.py, physics/lanes.py
"""On the C engine a walk's numbers depend on nothing but the walk: not on its batch, its place in it, or the cores."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nermo_mjx.physics import c_engine
from nermo_mjx.physics.c_engine import BLOCK_WORLDS, CBodies, CEngine, _Block, _observed, _restarted
from nermo_mjx.physics.lanes import CHUNK_WORLDS as PIECE
from nermo_mjx.physics.lanes import Lanes
from nermo_mjx.rollout import Run, RunResult, Simulator
from nermo_mjx.rollout.path_metrics import begins_in_run, ticks_until
from nermo_mjx.rollout.saving import Saving
from nermo_mjx.rollout.setup import Setup, Window
from nermo_mjx.rollout.simulator import REPORT_TICKS

#: More worlds than one block, on any number of cores.
WORLDS = 41
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


@pytest.mark.release
def test_neither_the_batch_nor_the_place_in_it_changes_a_bit(simulator, walks) -> None:
    """Alone, in a small batch, and in the whole one in another order."""
    sim = simulator(spine="stride_extension")
    reference = sim.run(walks, RUN).metrics
    assert len(np.unique(reference["speed"])) == WORLDS
    order = np.random.default_rng(0).permutation(WORLDS)
    same(sim.run(some(walks, order), RUN).metrics, some(reference, order))
    for ids in ([7], [3, 40, 11, 12, 30]):
        same(sim.run(some(walks, np.array(ids)), RUN).metrics, some(reference, np.array(ids)))


@pytest.mark.release
def test_the_number_of_lanes_changes_no_bit(
    simulator, walks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other tests simulate 8 lanes, and users 32."""
    selection = some(walks, np.arange(3))
    expected = simulator(spine="stride_extension").run(selection, RUN).metrics
    assert c_engine.BLOCK_WORLDS == 8
    monkeypatch.setattr(c_engine, "BLOCK_WORLDS", 32)
    same(Simulator(Setup(spine="stride_extension"), "c").run(selection, RUN).metrics, expected)


@pytest.mark.release
def test_the_number_of_threads_changes_no_bit(simulator, walks) -> None:
    """One thread, fewer than blocks, and more."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(walks, RUN)
    trace = {}
    for threads in (1, 2, 64):
        engine = CEngine(sim.robot, sim.loop, threads=threads)
        trace[threads] = engine.open(batch.params, batch.qpos, batch.fields).record(40)
        for name in ("qpos", "qvel", "ctrl", "sensordata"):
            np.testing.assert_array_equal(
                getattr(trace[1], name), getattr(trace[threads], name), err_msg=name
            )


@pytest.fixture(scope="module")
def on_threads(simulator) -> Callable[[int], Simulator]:
    """`on_threads(count)`: a simulator on so many threads, which shares its programs with the others."""

    def make(count: int) -> Simulator:
        sim = copy.copy(simulator(spine="stride_extension", physics="fast"))
        sim.engine = copy.copy(sim.engine)
        sim.engine.threads = count
        sim.engine.__dict__.pop("pool", None)
        return sim

    return functools.cache(make)


#: Ends of runs around the multiples of a block of ticks, and far from them [ticks].
BESIDE = (-9.3, -1.5, -1.0, -0.9999, -0.5, -1e-3, -1e-7, 0.0, 1e-7, 1e-3, 0.4, 0.9995, 1.0, 1.3)
ENDS = np.add.outer(REPORT_TICKS * np.array([1, 2, 3]), BESIDE).ravel()[:WORLDS]
#: All runs by time; by distance, which some of them cover and others do not.
RUNS = {
    "time": Run(duration=0.01 * ENDS, warmup=np.full(WORLDS, 0.1)),
    "distance": Run(
        duration=0.01 * ENDS,
        warmup=np.full(WORLDS, 0.1),
        distance=np.resize([0.01, 0.02, 1.0], WORLDS),
    ),
}


def simulated(
    sim: Simulator, walks: dict[str, np.ndarray], run: Run, ids: np.ndarray, saved_data: str
) -> RunResult:
    """Some of the walks, `plain`, `recorded`, or with a `series` or `both`; `run` has one length for each walk."""
    lengths = {name: column[ids] for name, column in vars(run).items() if column is not None}
    save = Saving(("position_y",), rate=50.0) if saved_data in ("series", "both") else None
    return sim.run(
        some(walks, ids), Run(**lengths), record=saved_data in ("recorded", "both"), save=save
    )


def assert_same_run(result: RunResult, index: int, plain: RunResult, recorded: RunResult) -> None:
    """A run in company is the same as alone, `plain` and with both a recording and series."""
    same(
        {name: column[index : index + 1] for name, column in result.metrics.items()}, plain.metrics
    )
    assert result.status[index] == plain.status[0]
    assert result.ticks[index] == plain.ticks[0]
    if result.series is not None:
        left, right = result.series.take(slice(index, index + 1)), recorded.series
        assert left.count == right.count
        for name, values in right.values.items():
            np.testing.assert_array_equal(left.values[name][:, : int(left.count[0])], values)
    if result.trace is not None:
        left, right = result.recording(index), recorded.recording()
        for name in ("time", "qpos", "qvel", "ctrl"):
            np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)


@pytest.fixture(scope="module")
def single_run(on_threads, walks) -> Callable[[str, int, str], RunResult]:
    """`single_run(run, i, saved_data)`: a walk that nothing shares its batch with."""
    return functools.cache(
        lambda run, i, saved_data: simulated(
            on_threads(1), walks, RUNS[run], np.array([i]), saved_data
        )
    )


@pytest.mark.long
@pytest.mark.release
@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.integers(0, WORLDS - 1), min_size=1, max_size=12, unique=True),
    st.sampled_from([1, 2, 3, 4, 20]),
    st.integers(1, 3),
    st.sampled_from(["plain", "recorded", "series"]),
    st.sampled_from(sorted(RUNS)),
)
def test_what_shares_its_batch_changes_no_bit_of_a_run(
    on_threads, walks, single_run, order, size, threads, saved_data, run
):
    """Beside shorter and longer ones, recorded or not, in any block and order, on any number of threads."""
    for ids in np.split(np.array(order), range(size, len(order), size)):
        result = simulated(on_threads(threads), walks, RUNS[run], ids, saved_data)
        for index, i in enumerate(ids):
            assert_same_run(
                result, index, single_run(run, int(i), "plain"), single_run(run, int(i), "both")
            )


@pytest.mark.long
@pytest.mark.release
@pytest.mark.parametrize(
    ("profile", "scene"), [("exact", "flat"), ("as_published", "rough")], ids=str
)
def test_what_shares_its_batch_changes_no_bit_of_a_body_or_a_start(
    simulator, profile, scene
) -> None:
    """Geometry, build, masses, springs, servos, contact and terrain all differ from world to world."""
    sim = simulator(profile=profile, scene=scene)
    groups = ("geometry", "build", "mass", "stiffness", "damping", "servo", "contact", "start")
    draw = np.random.default_rng(5).uniform
    defaults = {
        name: float(value)
        for name, value in sim.setup.defaults().items()
        if name.split(".")[0] in groups
    }
    defaults |= {"servo.spine_torque": 0.9}
    bodies = {name: value * draw(1.0, 1.03, 10) for name, value in defaults.items()}
    bodies |= {"terrain.height": draw(0.004, 0.01, 10)} if scene == "rough" else {}
    batch_of_all = sim.prepare(bodies, RUN)
    assert {"tendon_range", "body_pos", "pair_friction"} <= batch_of_all.fields.keys()
    for i in (0, 4, 9):
        lone = sim.prepare(some(bodies, np.array([i])), RUN)
        same({name: column[i : i + 1] for name, column in batch_of_all.fields.items()}, lone.fields)
        np.testing.assert_array_equal(batch_of_all.qpos[i], lone.qpos[0])
        for left, right in zip(
            jax.tree.leaves(batch_of_all.params), jax.tree.leaves(lone.params), strict=True
        ):
            np.testing.assert_array_equal(np.asarray(left)[i], np.asarray(right)[0])


@pytest.mark.release
@pytest.mark.parametrize(
    ("run", "duration"),
    [
        (Run(duration=np.array([3.245, 4.0]), warmup=np.array([1.0, 1.0])), 2.245),
        (Run(duration=np.array([3.255, 3.25]), warmup=np.array([1.0, 1.0])), 2.255),
        (
            Run(cycles=np.array([3.0, 6.0]), warmup_cycles=np.array([1.0, 1.0])),
            2.0 / 0.9246450430370259,
        ),
    ],
    ids=["within the last tick of a block", "beside a shorter one", "in cycles"],
)
def test_a_run_measures_all_of_its_time(on_threads, run: Run, duration: float) -> None:
    """Alone, recorded and beside a longer or shorter run."""
    walks = {"frequency": np.array([0.8 if run.cycles is None else 0.9246450430370259, 0.8])}
    plain, recorded = (
        simulated(on_threads(1), walks, run, np.array([0]), saved_data)
        for saved_data in ("plain", "both")
    )
    for saved_data in ("plain", "recorded", "series"):
        result = simulated(on_threads(1), walks, run, np.array([1, 0]), saved_data)
        assert result.metrics["duration"][1] == pytest.approx(duration, abs=2e-6)
        assert_same_run(result, 1, plain, recorded)


@pytest.mark.release
def test_worlds_that_rest_do_not_change_the_others(simulator, walks) -> None:
    """Retired after different times, among others that go on."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(walks, RUN)
    session, undisturbed = (
        sim.engine.open(batch.params, batch.qpos, batch.fields) for _ in range(2)
    )
    is_resting = np.arange(WORLDS) % 3 == 0
    session.advance(10)
    session.retire(is_resting)
    session.advance(30)
    undisturbed.advance(40)
    np.testing.assert_array_equal(session.qpos[~is_resting], undisturbed.qpos[~is_resting])
    assert not np.isclose(session.qpos[is_resting], undisturbed.qpos[is_resting]).all()
    states = [
        jax.tree.leaves(engine_session.loop_state) for engine_session in (session, undisturbed)
    ]
    for left, right in zip(*states, strict=True):
        np.testing.assert_array_equal(left[~is_resting], right[~is_resting])


@pytest.mark.release
def test_a_batch_in_double_precision_runs_on_all_cores(simulator, walks) -> None:
    """Precision is a setting of each thread in JAX; the engine's threads have that of who opened the batch."""
    sim = simulator(spine="stride_extension")
    with jax.enable_x64(True):
        batch = sim.prepare(walks, RUN)
        engine = CEngine(sim.robot, sim.loop, threads=2)
        session = engine.open(batch.params, batch.qpos, batch.fields)
        session.advance(3)
        assert {leaf.dtype for leaf in jax.tree.leaves(session.loop_state)} >= {
            np.dtype(np.float64)
        }
        assert np.dtype(np.float32) not in {
            leaf.dtype for leaf in jax.tree.leaves(session.loop_state)
        }


@pytest.mark.parametrize("worlds", [1, PIECE, PIECE + 1])
def test_lanes_give_every_world_its_own_result(worlds: int) -> None:
    """Whole pieces and parts of them; several arguments and results."""
    x = np.arange(worlds, dtype=np.float32)
    total, pair = Lanes(lambda a, b: (a + b["c"], {"twice": 2 * a}))(
        x, {"c": np.ones(worlds, np.float32)}
    )
    np.testing.assert_array_equal(total, x + 1)
    np.testing.assert_array_equal(pair["twice"], 2 * x)


@pytest.mark.release
def test_the_loop_is_one_function_that_runs_on_the_thread_of_its_block(simulator, walks) -> None:
    """Otherwise there are a hundred, which XLA's threads run on the physics' cores; the engine is a tenth slower."""
    sim = simulator(spine="stride_extension")
    batch = sim.prepare(some(walks, np.arange(4)), RUN)
    session = sim.engine.open(batch.params, batch.qpos, batch.fields)
    program = session.loop.step.lower(*session.arguments).compile().as_text()
    entry = program[program.index("ENTRY") :]
    assert entry.count("xla_cpu_small_call") == 1
    assert entry.count(" fusion(") < 16


@pytest.mark.parametrize("dt", [0.01, 1.0 / 120.0])
def test_no_tick_after_those_of_a_run_begins_in_it(dt: float) -> None:
    """In float32, whose time is coarser than a tick at the end of the longest runs, and exactly for short ones."""
    draw = np.random.default_rng(1)
    integers = np.unique(np.geomspace(1, 1e5 / dt, 4000).astype(int))
    ends = np.concatenate(
        [
            integers,
            *(
                integers + draw.uniform(*offsets, len(integers))
                for offsets in ((-1e-5, 1e-5), (0, 1))
            ),
        ]
    )
    ticks = ticks_until(ends * dt, dt)

    @jax.jit
    @jax.vmap
    def begins(end: jax.Array, tick: jax.Array) -> jax.Array:
        return begins_in_run(
            Window(begin=jnp.zeros(()), end=end, distance=jnp.asarray(1e6)), tick * dt, dt
        )

    for later in range(3):
        assert not np.asarray(begins(ends * dt, ticks + later)).any()
    short = integers[integers * dt < 30.0]
    np.testing.assert_array_equal(ticks_until(short * dt, dt), short + 1)


class Passing:
    """A loop whose state is one number a world, and whose observation is the last reading."""

    steps_per_tick = 3

    def __init__(self) -> None:
        self.once = jax.device_put(np.int32(1))

    def pack(self, params: np.ndarray) -> np.ndarray:
        return params[:, None]

    def init(self, packed: np.ndarray, readings: np.ndarray) -> np.ndarray:
        return packed + readings[:, :1]

    def observe(
        self, worlds: int, params: np.ndarray, state: np.ndarray, readings: np.ndarray
    ) -> np.ndarray:
        return readings[:worlds, -1]


def test_a_world_that_is_reset_observes_its_new_start_and_leaves_the_others_alone() -> None:
    """Pendulums in MuJoCo: the observation after a reset is MuJoCo's of the new pose at rest."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='torso'><joint name='j' axis='0 1 0'/><geom size='.1' pos='0 0 -1'/></body>"
        "</worldbody><sensor><jointpos joint='j'/><jointvel joint='j'/></sensor></mujoco>"
    )
    engine, block, loop, lanes = (
        CEngine.__new__(CEngine),
        _Block.__new__(_Block),
        Passing(),
        np.zeros((BLOCK_WORLDS, 1)),
    )
    engine.model, engine.loop = model, loop
    CBodies.__init__(block, engine, np.full((4, 1), 0.5), {}, 1)
    block.loop, block.params, block._state = loop, lanes.copy(), lanes.copy()
    block._sensordata = np.zeros((BLOCK_WORLDS, loop.steps_per_tick, 2))
    for _ in range(20):
        block.move(block._sensordata[:4])
    former_observations = _observed(block).copy()
    assert (np.abs(former_observations[:, 1]) > 0.1).all(), "they swing"
    observations = _restarted(
        block, np.array([1, 3]), np.array([7.0, 8.0]), np.array([[0.2], [-0.4]]), {}
    )
    np.testing.assert_allclose(observations, [[0.2, 0.0], [-0.4, 0.0]], atol=1e-12)
    np.testing.assert_allclose(_observed(block)[[0, 2]], former_observations[[0, 2]])
    np.testing.assert_allclose(
        block.qpos[:, 0],
        [former_observations[0, 0], 0.2, former_observations[2, 0], -0.4],
        atol=1e-2,
    )
    assert block._state[:4, 0].tolist() == pytest.approx([0.0, 7.2, 0.0, 7.6])
    assert block.params[:4, 0].tolist() == [0.0, 7.0, 0.0, 8.0]
