# Tests of rollout/differentiable.py
"""`Rollout` on the engine c: its derivative against MJX in float64 and over widths, all of JAX's transformations,
threads, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
import threading
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx import ParameterError, Rollout, Run, Setup
from nermo_mjx.rollout.differentiable import SLOPE_WIDTH

NAMES = ("spine.amplitude", "spine.phase")
POINT = np.array([0.2, -0.5])
SHORT = Run(duration=0.3, warmup=0.1)
BODY = {
    "mass.front": 0.16,
    "mass.rear": 0.12,
    "stiffness.ankle": 0.1,
    "stiffness.spine": 1.1,
    "contact.friction": 1.3,
    "servo.supply_voltage": 5.5,
    "servo.back_emf": 0.3,
    "geometry.rear_leg.upper": 0.033,
    "geometry.spine.segment": 0.0148,
    "geometry.tail.length": 0.14,
}


@pytest.fixture(scope="module")
def walk() -> Rollout:
    return Rollout(Setup(spine="stride_extension"), SHORT, "c")


@pytest.fixture(scope="module")
def long_walk() -> Rollout:
    return Rollout(Setup(spine="stride_extension"), Run(cycles=4, warmup_cycles=1), "c")


def speed_of(walk: Rollout):
    def speed(point):
        return walk({"frequency": 0.8} | dict(zip(NAMES, point, strict=True)))["speed"]

    return speed


@pytest.mark.long
@pytest.mark.release
def test_the_derivative_is_that_of_mjx_in_float64() -> None:
    """Of how far the robot has come after 250, 1,000 and 3,000 steps; `data/walk_mjx64.py` made the numbers."""
    stored = np.load(Path(__file__).parents[1] / "data" / "walk_mjx64.npz")
    walk = Rollout(Setup(spine="stride_extension"), Run(duration=6.0, warmup=1.0), "c")
    root = walk.robot.joints.root

    def places(point):
        values = {"frequency": 0.8} | dict(zip(NAMES, point, strict=True))
        return walk.record(values, qpos=stored["first"])[1].qpos[
            stored["ticks"] - 1, root : root + 2
        ]

    with jax.enable_x64(True):
        point = jnp.asarray(stored["point"])
        np.testing.assert_allclose(jax.jit(places)(point), stored["place"], atol=1e-7)
        slope = np.asarray(jax.jit(jax.jacfwd(places))(point))
    apart = np.linalg.norm(slope - stored["slope"], axis=(1, 2)) / np.linalg.norm(
        stored["slope"], axis=(1, 2)
    )
    assert (apart < 1e-4).all(), apart


#: Amplitudes and phases of four walks: small and large amplitudes, and phases of both signs. A jump lies beside the last
#: walk: its speed falls by 3e-9 m/s at a phase between 8.5e-7 and 9e-7 rad below, while it rises by 1.4e-3 m/s per rad.
COMPARED = (
    (0.0623, 1.3779),
    (0.3238, 0.2488),
    (0.2131, -2.8301),
    (0.27037314542276436, -2.991059498946983),
)


def values_of(point: tuple[float, float]) -> dict[str, float]:
    return {"frequency": 0.8} | dict(zip(NAMES, point, strict=True))


@pytest.mark.release
def test_three_widths_give_the_same_derivative_at_four_points(long_walk: Rollout) -> None:
    """The widest of them, ten times that of `Rollout`, at three: beside a jump it is no derivative."""
    for point in COMPARED:
        values = values_of(point)
        slopes = [
            long_walk.slopes(values, NAMES, width)["speed"]
            for width in (SLOPE_WIDTH, 0.1 * SLOPE_WIDTH, 10 * SLOPE_WIDTH)
        ]
        apart = [np.linalg.norm(slope - slopes[0]) / np.linalg.norm(slopes[0]) for slope in slopes]
        assert apart[1] < 1e-4, point
        assert (apart[2] < 1e-4) == (point != COMPARED[-1]), point


@pytest.mark.release
def test_a_jump_within_the_width_is_told(long_walk: Rollout) -> None:
    """By the spread of two widths, and by a warning."""
    values = values_of(COMPARED[-1])
    simulator = long_walk._differences._simulator
    phases = values["spine.phase"] + np.arange(-24, 1) * 5e-8
    with jax.enable_x64(True):
        rise = np.diff(
            simulator.run(values | {"spine.phase": phases}, long_walk.length).metrics["speed"]
        )
    before = int(np.argmin(rise))
    assert rise[before] < -20 * np.median(rise)
    beside = values | {"spine.phase": phases[before] - 2e-8}
    assert long_walk.gradient_spread(values, NAMES)["speed"].max() < 1e-4
    assert long_walk.gradient_spread(beside, NAMES)["speed"][1] > 0.9
    with (
        jax.enable_x64(True),
        pytest.warns(UserWarning, match="speed.* has a kink within the width"),
    ):
        jax.grad(lambda phase: long_walk(beside | {"spine.phase": phase})["speed"])(
            beside["spine.phase"]
        )


@pytest.mark.release
def test_three_widths_give_the_same_derivative_by_ten_numbers_of_the_body(
    long_walk: Rollout,
) -> None:
    values = BODY | {"frequency": 0.8, "spine.amplitude": 0.2, "spine.phase": -1.1}
    slopes = [
        long_walk.slopes(values, tuple(BODY), width)["speed"]
        for width in (10 * SLOPE_WIDTH, SLOPE_WIDTH, 0.1 * SLOPE_WIDTH)
    ]
    scaled = np.array(slopes) * np.array([*BODY.values()])
    apart = np.linalg.norm(scaled - scaled[1], axis=1) / np.linalg.norm(scaled[1])
    assert (apart < 1e-4).all(), apart


@pytest.mark.release
def test_all_transformations_agree_to_the_last_bit(walk: Rollout) -> None:
    speed, point = speed_of(walk), jnp.asarray(POINT)
    slope = jax.grad(speed)(point)
    assert np.abs(slope).min() > 0.0
    several = jnp.stack([point, point + 0.01, point - 0.02])
    rise = 0.1

    def ascent(point, _):
        return point + rise * jax.grad(speed)(point), point

    value, jitted = jax.jit(jax.value_and_grad(speed))(point)
    for name, transformed in {
        "jit": jitted,
        "jacfwd": jax.jacfwd(speed)(point),
        "jacrev": jax.jit(jax.jacrev(speed))(point),
        "vmap": jax.jit(jax.vmap(jax.grad(speed)))(several)[0],
        "jvp": [jax.jvp(speed, (point,), (way,))[1] for way in jnp.eye(2)],
    }.items():
        np.testing.assert_array_equal(slope, transformed, err_msg=name)
    assert value == speed(point) == jax.jit(speed)(point) == jax.vmap(speed)(several)[0]
    path = jax.jit(lambda point: jax.lax.scan(ascent, point, None, length=3)[1])(point)
    step = jax.jit(lambda point: ascent(point, None)[0])
    np.testing.assert_array_equal(path, [point, step(point), step(step(point))])


@pytest.mark.release
def test_only_what_is_differentiated_costs_walks(
    walk: Rollout, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator, counts = walk._differences._simulator, []
    run = simulator.run_batch
    monkeypatch.setattr(
        simulator,
        "run_batch",
        lambda batch, **how: counts.append(len(batch.qpos)) or run(batch, **how),
    )
    speed = speed_of(walk)
    jax.jit(jax.grad(lambda a, p: speed((a, p))))(0.2, -0.5)
    jax.jit(jax.vmap(jax.grad(speed)))(jnp.stack([jnp.asarray(POINT)] * 3))
    speed(jnp.asarray(POINT))
    assert counts == [3, 15, 1]


@pytest.mark.release
def test_the_path_is_differentiable_and_as_the_metrics_are(walk: Rollout) -> None:
    def ends(amplitude):
        metrics, path = walk.record(
            {"frequency": 0.8, "spine.amplitude": amplitude, "spine.phase": -0.5}
        )
        return metrics["speed"], path.qpos[-1], path.ctrl[-1]

    speed, qpos, ctrl = jax.jacfwd(ends)(0.2)
    assert speed == jax.grad(lambda a: speed_of(walk)((a, -0.5)))(0.2)
    assert qpos.shape == (walk.robot.model.nq,)
    assert np.isfinite(qpos).all()
    assert np.abs(ctrl).max() > 0.0


@pytest.mark.release
def test_a_frequency_needs_no_slowest_one_but_for_a_path() -> None:
    walk = Rollout(run=Run(cycles=0.3, warmup_cycles=0.0), engine="c")
    assert np.isfinite(jax.grad(lambda f: walk({"frequency": f})["speed"])(0.82))
    with pytest.raises(ParameterError, match=r"frequency is traced.*slowest"):
        jax.grad(lambda f: walk.record({"frequency": f})[0]["speed"])(0.82)


@pytest.mark.release
def test_at_a_bound_the_derivative_is_one_sided(walk: Rollout) -> None:
    slope = jax.grad(lambda a: speed_of(walk)((a, -0.5)))
    assert slope(0.0) == pytest.approx(float(slope(1e-5)), rel=0.01)


@pytest.mark.release
def test_a_kink_within_the_width_is_told() -> None:
    """At 0.8 Hz the measured time ends with a tick, where the measured way has a kink; at 0.82 Hz it has none."""
    walk = Rollout(run=Run(cycles=0.4, warmup_cycles=0.0), engine="c")
    slope = jax.jit(jax.grad(lambda f: walk({"frequency": f})["speed"]))
    with jax.enable_x64(True):
        with pytest.warns(
            UserWarning,
            match=r"speed.* kink within the width .*frequency 0.8: .* on one side and .* other",
        ):
            slope(0.8)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            slope(0.82)


@pytest.mark.release
def test_the_spread_of_two_widths_is_small_away_from_kinks(walk: Rollout) -> None:
    """Beside the kink at 0.8 Hz, which the wider differences contain and the narrower do not, it is not small."""
    spread = walk.gradient_spread(
        {"frequency": 0.8, "spine.amplitude": 0.2, "spine.phase": -0.5}, NAMES
    )
    assert spread["speed"].shape == (2,)
    assert (spread["speed"] < 1e-3).all()
    kinked = Rollout(run=Run(cycles=0.4, warmup_cycles=0.0), engine="c")
    assert (
        kinked.gradient_spread({"frequency": 0.8 * (1.0 + 0.2 * SLOPE_WIDTH)}, ["frequency"])[
            "speed"
        ]
        > 0.03
    )


def test_a_kink_between_the_two_widths_has_the_spread_of_its_slopes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The wider differences of |x| at half a width are a half, the narrower are 1; of 3 x both are 3."""
    rollout = Rollout(Setup(), SHORT, "c")

    def slopes(
        values: dict[str, float], names: tuple[str, ...], width: float
    ) -> dict[str, np.ndarray]:
        x = values["x"]
        return {
            "kinked": np.array([abs(x + width) - abs(x - width)]) / (2 * width),
            "straight": np.array([3.0]),
        }

    monkeypatch.setattr(rollout, "slopes", slopes)
    spread = rollout.gradient_spread({"x": 0.5 * SLOPE_WIDTH}, ["x"])
    assert spread["kinked"] == pytest.approx([0.5])
    assert spread["straight"] == [0.0]


@pytest.mark.parametrize(
    ("ask", "why"),
    [
        (lambda walk: jax.hessian(speed_of(walk))(POINT), "second derivative of a walk"),
        (
            lambda walk: jax.grad(lambda a: jax.grad(lambda b: speed_of(walk)((b, a)))(0.2))(0.1),
            "second derivative",
        ),
        (
            lambda walk: jax.grad(lambda q: walk({}, qpos=q)["speed"])(
                np.zeros(walk.robot.model.nq)
            ),
            "a start state",
        ),
        (lambda walk: walk({}, qvel=np.zeros(walk.robot.model.nv)), "start with velocities"),
        (
            lambda walk: jax.grad(lambda p: walk({}, policy=p)["speed"], allow_int=True)(
                walk.controller.parameters
            ),
            "policy",
        ),
    ],
)
def test_what_c_cannot_do_is_refused_and_the_engine_that_can_is_named(
    walk: Rollout, ask, why: str
) -> None:
    with pytest.raises(
        ParameterError,
        match=rf"(?i){why}.* not computed on engine c: take Rollout\(.*engine='mjx'\)",
    ):
        ask(walk)


@pytest.mark.release
def test_the_derivative_by_the_duty_is_the_difference_of_two_walks(walk: Rollout) -> None:
    """A duty factor brings its gait factor 1 / duty along; one of 0 has none, and is refused with its range."""

    def way(duty):
        return walk({"duty": duty})["distance"]

    with jax.enable_x64(True):
        slope = float(jax.grad(way)(0.53))
        assert slope == pytest.approx(float(way(0.53 + 1e-5) - way(0.53 - 1e-5)) / 2e-5, rel=1e-3)
    assert abs(slope) > 1e-4
    with pytest.raises(ParameterError, match=r"duty is 0: allowed is \[0.01, 1\)"):
        way(0.0)


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(ParameterError, match="engine is 'warp'"):
        Rollout(engine="warp")


def test_auto_takes_c_for_few_numbers_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    walk = Rollout(Setup(spine="harmonics"), SHORT)
    names = [
        f"foot.{pair}.{axis}{i}" for pair in ("front", "rear") for axis in "yz" for i in range(1, 9)
    ]
    engines = []

    def ask(amplitudes):
        engines.append(walk._chosen(dict(zip(names, amplitudes, strict=False)), None, None, None))

    for count in (2, 2, 24):
        jax.eval_shape(
            lambda amplitudes: ask(amplitudes), [jnp.float32(0.1)] * count
        )  # traced anew
    assert engines == ["c", "c", "mjx"]
    assert [record.message.split(",")[0] for record in caplog.records] == [
        "Rollout: engine c for 2 traced numbers",
        "Rollout: engine mjx for 24 traced numbers",
    ]


@pytest.mark.release
def test_threads_share_a_walk(walk: Rollout) -> None:
    slope, points = (
        jax.jit(jax.grad(speed_of(walk))),
        [jnp.asarray(POINT + 0.01 * i) for i in range(3)],
    )
    expected, slopes = [slope(point) for point in points], [None] * 3

    def work(i: int) -> None:
        slopes[i] = slope(points[i])

    threads = [threading.Thread(target=work, args=(i,), daemon=True) for i in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    np.testing.assert_array_equal(slopes, expected)


LATE = """
import jax, jax.numpy as jnp
jax.config.update("jax_cpu_enable_async_dispatch", True)
busy = jnp.ones((300, 300))
products = [busy @ busy for _ in range(20)]
import threading
from nermo_mjx import Rollout, Run, Setup
walk = Rollout(Setup(spine="stride_extension"), Run(duration=0.1, warmup=0.05))
slope = jax.jit(jax.grad(lambda a: walk({"spine.amplitude": a})["speed"]))
found = [slope(0.2 + 0.01 * i) for i in range(3)]
threads = [threading.Thread(target=slope, args=(0.2 + 0.01 * i,)) for i in range(3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
products = [busy @ busy for _ in range(20)]
print(float(slope(0.2)) == float(found[0]))
"""


@pytest.mark.long
@pytest.mark.release
def test_it_works_where_the_user_started_jax_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """With asynchronous dispatch, as in a notebook, and as few threads as there can be: no deadlock."""
    monkeypatch.setenv("PJRT_NPROC", "1")
    done = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == ["True"], done.stderr
