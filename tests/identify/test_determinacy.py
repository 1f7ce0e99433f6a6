# Tests of identify/determinacy.py, identify/estimation.py
"""What a log determines of named parameters: values, intervals, combinations, and classes of models."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nermo_mjx.identify import determinacy
from nermo_mjx.identify.estimation import (
    Estimation,
    Fit,
    LoggedSamples,
    Parameter,
    ParameterSpace,
    repeat_searches,
)


def parameter(
    name: str, value: float = 1.0, low: float = 0.1, high: float = 10.0, neutral: float = 1.0
) -> Parameter:
    return Parameter(name, name, "1", value, low, high, "a test", neutral)


def problem(
    function, truth: list[float], noise: np.ndarray, quantum: float = 0.0
) -> SimpleNamespace:
    """Measured values of a function of time (n,) and parameters (p, 1)."""
    time = np.linspace(0.0, 10.0, len(noise))
    values = function(time, np.array(truth)[:, None])[0] if len(np.shape(truth)) else None
    measured = LoggedSamples(values + noise, np.zeros(len(noise), int), time, np.array([quantum]))
    return SimpleNamespace(
        measured=measured,
        predict=lambda values: np.array([function(time, v[:, None])[0] for v in values]),
        parts=(np.array([]), np.zeros(1, int)),
        linearize=lambda values: None,
        project=lambda residual, sigma: residual,
    )


def estimate(function, truth, parameters, noise) -> Fit:
    return Estimation(ParameterSpace(parameters), problem(function, truth, noise)).fit()


def white(n: int = 400, seed: int = 0, size: float = 0.01) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, size, n)


def line(time: np.ndarray, p: np.ndarray) -> np.ndarray:
    return p[0:1] + p[1:2] * time


def test_intervals_of_white_noise_cover_as_often_as_they_say() -> None:
    inside = []
    for seed in range(60):
        found = estimate(line, [2.0, 0.5], [parameter("a"), parameter("b")], white(seed=seed))
        assert found.determined.all()
        inside += [
            low <= true <= high
            for (low, high), true in zip(found.intervals, (2.0, 0.5), strict=True)
        ]
    assert 0.83 <= np.mean(inside) <= 0.97  # of 120, 90 % with three standard deviations


def test_intervals_of_correlated_noise_are_wider_and_cover_too() -> None:
    inside, width = [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        noise = np.zeros(400)
        for i in range(1, 400):
            noise[i] = 0.9 * noise[i - 1] + random.normal(0.0, 0.01)
        found = estimate(line, [2.0, 0.5], [parameter("a"), parameter("b")], noise)
        inside += [
            low <= true <= high
            for (low, high), true in zip(found.intervals, (2.0, 0.5), strict=True)
        ]
        plain = np.linalg.inv(found.jacobian.T @ found.jacobian)
        width.append(np.sqrt(plain[0, 0]) / np.std(found.draws[:, 0]))
    assert np.median(width) < 0.5  # what the residuals would give if they were white
    assert 0.8 <= np.mean(inside) <= 0.98


@pytest.mark.release
def test_where_many_bodies_explain_the_data_the_interval_is_over_all_of_them() -> None:
    """Errors that grow and turn with time, as those of a walk after its contacts: the truth is one minimum of many."""

    def rugged(time: np.ndarray, p: np.ndarray) -> np.ndarray:
        share, a = time / 10, np.log(p[0:1])
        return share * a + 0.05 * share * np.sin(100 * share * a + 0.7 * time)

    inside, of_one = [], []
    for seed in range(40):
        truth = float(np.random.default_rng((seed, 5)).uniform(0.7, 1.5))
        found = Estimation(
            ParameterSpace([parameter("a")]), problem(rugged, [truth], white(seed=seed, size=0.1))
        )
        for kept, fit in (
            (inside, repeat_searches([found], *found.search(np.zeros(1)), 15, 6, seed)),
            (of_one, found.fit()),
        ):
            ((low, high),) = fit.intervals
            kept.append(low <= truth <= high)
    assert np.mean(of_one) < 0.5  # a single minimum's, of 90 %
    assert np.mean(inside) >= 0.8


def test_a_search_that_ends_at_its_result_again_ends() -> None:
    found = Estimation(
        ParameterSpace([parameter("a"), parameter("b")]), problem(line, [2.0, 0.5], white())
    )
    told: list[int] = []
    fit = repeat_searches([found], *found.search(np.zeros(2)), 15, 6, report=told.append)
    assert told == [0, 1]
    assert not len(fit.others)


def test_a_ratio_that_is_known_is_named_though_its_parameters_are_not() -> None:
    found = estimate(
        lambda time, p: np.sin(time * p[0:1] / p[1:2]),
        [2.0, 3.0],
        [parameter("kp"), parameter("mass")],
        white(),
    )
    assert not found.determined.any()
    ((formula, deviation, names),) = determinacy.find_combinations(found)
    assert formula == "kp / mass"
    assert deviation < 0.01
    assert names == ("kp", "mass")
    assert found.values[0] / found.values[1] == pytest.approx(2 / 3, rel=3 * deviation)
    said = " ".join(determinacy.describe_determinacy(found))
    assert "Determined only together: kp / mass" in said
    assert "Not determined by these data: kp, mass" in said


def test_a_product_with_a_power_is_named() -> None:
    found = estimate(
        lambda time, p: np.sin(time * p[0:1] * p[1:2] ** 2),
        [0.5, 1.2],
        [parameter("m"), parameter("l")],
        white(),
    )
    ((formula, _, _),) = determinacy.find_combinations(found)
    assert formula in ("m * l^2", "l * m^0.5")


def test_a_parameter_that_does_nothing_is_not_determined_and_stays_at_its_start() -> None:
    found = estimate(
        lambda time, p: np.sin(time * p[0:1]),
        [1.1, 4.0],
        [parameter("w"), parameter("nothing", 2.0)],
        white(),
    )
    assert found.determined.tolist() == [True, False]
    assert found.values[1] == pytest.approx(2.0)
    low, high = found.intervals[1]
    assert high / low > 10  # most of its range
    assert found.share[-1] == pytest.approx(1.0)


def test_a_parameter_at_its_bound_is_said_to_be() -> None:
    found = estimate(line, [20.0, 0.5], [parameter("a"), parameter("b")], white())
    assert found.at_bound[0] == "upper"
    assert "a is at its upper bound." in determinacy.describe_determinacy(found)


@pytest.mark.parametrize(("error", "right"), [(0.0, True), (0.05, False)])
def test_smooth_residuals_are_no_noise(error: float, right: bool) -> None:
    time = np.linspace(0.0, 10.0, 400)
    measured = LoggedSamples(np.zeros(400), np.zeros(400, int), time, np.zeros(1))
    judged = determinacy.evaluate_residuals(measured, white() + error * np.sin(2 * time))
    assert judged.right is right
    assert judged.noise[0] == pytest.approx(0.01, rel=0.1)


def test_kinds_that_the_data_do_not_ask_for_are_dispensable() -> None:
    parameters = [parameter("a"), parameter("b"), parameter("offset", 0.0, -1.0, 1.0, neutral=0.0)]
    found = estimate(
        lambda time, p: p[0:1] * np.sin(time) + p[1:2] * time + p[2:3],
        [2.0, 0.5, 0.0],
        parameters,
        white(),
    )
    assert determinacy.find_dispensable_kinds(found) == ["offset"]


def test_another_experiment_shrinks_the_direction_it_sees() -> None:
    found = estimate(
        lambda time, p: np.sin(time * p[0:1] / p[1:2]),
        [2.0, 3.0],
        [parameter("kp"), parameter("mass")],
        white(),
    )
    assert determinacy.compute_remaining_share(np.zeros((5, 2)), found) == pytest.approx(1.0)
    assert determinacy.compute_remaining_share(np.array([[0.0, 100.0]]), found) < 0.05


def test_a_model_that_fails_is_far_away_but_does_not_stop_the_search() -> None:
    def fails(time: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.where(p[0:1] > 5.0, np.nan, p[0:1]) + 0.0 * time

    found = Estimation(ParameterSpace([parameter("a", 1.0)]), problem(fails, [4.0], white())).fit(
        np.array([1.7])
    )
    assert found.values[0] == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize("touch", [0.0, 0.3])
def test_parts_that_do_not_act_on_each_other_share_simulations(touch: float) -> None:
    """Two parts of three parameters and a channel each; where the other one moves a channel, too, each counts alone."""
    space, widths = ParameterSpace([parameter(name) for name in "abcdef"]), list[int]()
    channel, time = np.arange(400) % 2, np.linspace(0.0, 10.0, 400)

    def predict(values: np.ndarray) -> np.ndarray:
        widths.append(len(values))
        one, other = (
            v[:, 0:1] * np.sin(time) + v[:, 1:2] * time + v[:, 2:3]
            for v in (values[:, :3], values[:, 3:])
        )
        return np.where(channel == 0, one + touch * other, other)

    def jacobian(of: list[int], seen: list[int]) -> np.ndarray:
        of_two = problem(lambda time, p: 0 * time + p[0], [1.0], white())
        of_two.measured = LoggedSamples(white(), channel, time, np.zeros(2))
        of_two.predict, of_two.parts = predict, (np.array(of), np.array(seen))
        widths.clear()
        return Estimation(space, of_two).jacobian(np.zeros(6), np.ones(2))

    np.testing.assert_allclose(
        jacobian([4, 4, 4, 9, 9, 9], [4, 9]), jacobian([-1] * 6, [-1, -1]), rtol=1e-6, atol=1e-9
    )
    assert max(widths) == 6
    jacobian([4, 4, 4, 9, 9, 9], [4, 9])
    assert widths == ([1, 5, 5] if not touch else [1, 5, 6, 5, 6])


def test_a_search_over_the_whole_ranges_is_not_stopped_by_local_minima() -> None:
    """Of a frequency Gauss-Newton finds the nearest minimum; the search finds the true one, and both then agree."""

    def wave(time: np.ndarray, p: np.ndarray) -> np.ndarray:
        return p[1:2] * np.sin(p[0:1] * time)

    space = ParameterSpace([parameter("frequency"), parameter("amplitude")])
    estimation = Estimation(space, problem(wave, [4.0, 2.0], white()))
    near, _ = estimation.search(np.zeros(2))
    assert abs(space.values(near)[0] - 4.0) > 0.5
    *_, far = estimation.search_globally(60, 30, seed=0)
    found, _ = estimation.search(far)
    assert space.values(found) == pytest.approx([4.0, 2.0], rel=5e-3)
