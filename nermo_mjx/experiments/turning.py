"""Turning: quarter circles and full lock, over gait, frequency and turning strategy.

The publication's text on this test (A.4.2) keeps the normalised stride "constant at 0.08", a misprint of 0.8
(erratum 6), so that all cases run at 0.8. The circles of 0.5 m and full lock also run at the other reading, 1.0, to
which the publication's speeds on the straight line correspond (erratum 13).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from nermo_mjx.experiments import theory
from nermo_mjx.experiments.cases import AMPLITUDE, FREQUENCIES, LABELS, Case, Label, Worlds, measured, recorded, worlds
from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.experiments.settings import Settings
from nermo_mjx.recording import Recording
from nermo_mjx.rollout import Run, Simulator

NAME: Final = "turning"
RADII: Final = (1.0, 0.5)
#: Radius that represents full lock, as in the publication: the turn rate is held at its maximum.
FULL_LOCK: Final = 0.0
STRATEGIES: Final = ("leg", "spine", "mix")
GAITS: Final = ("trt", "trt1", "lat")
SIDES: Final = {"left": 1.0, "right": -1.0}
#: Normalised stride of the test, and the other reading of its text.
STRIDE: Final = 0.8
OTHER_STRIDE: Final = 1.0
#: A path is followed if the torso, including its sway, stays this close to it: 5 % of its radius, at least 2.5 cm.
BOUND_SHARE: Final = 0.05
LEAST_BOUND: Final = 0.025
#: In time means at least this share of the theoretical speed.
_SLOWEST: Final = 0.3
_WARMUP: Final = 1.0
_LOCK_CYCLES: Final = 14.0
_ABOUT: Final = {
    "radius": Column("m", "of the quarter circle; 0 is full lock"),
    "strategy": Column("1", "what turns the robot: leg, spine, or mix of both"),
    "side": Column("1", "left or right"),
    "stride": Column("1", "stride length, as a share of the maximum"),
    "time": Column("s", "simulated time for the quarter circle at the measured speed; NaN at full lock"),
    "followed": Column("1", "whether the path was followed to its end in time; false at full lock"),
    "theory_radius": Column("m", "at full lock without slip (5.40-5.44); NaN on a quarter circle"),
    "theory_equal_strides": Column(
        "m", "at full lock by the spine, two feet with equal strides that slip least; NaN for other cases"
    ),
}


def _case(gait: str, frequency: float, radius: float, strategy: str, side: str, stride: float = STRIDE) -> Case:
    values = {"frequency": frequency, "stride": stride, "spine.amplitude": 0.0, "spine.max_servo_angle": AMPLITUDE}
    if radius == FULL_LOCK:
        values["pilot.turn_rate"] = SIDES[side]
    else:
        values |= {"pilot.radius": radius, "pilot.direction": SIDES[side]}
    labels: dict[str, Label] = {"gait": gait, "frequency": frequency, "radius": radius, "strategy": strategy,
                                "side": side, "stride": stride}  # fmt: skip
    return Case(labels, gait, strategy, values)


def cases(quick: bool = False) -> tuple[Case, ...]:
    """The published cases to the left, and trot and walking trot at 0.67 Hz to the right as well.

    R = 0.5 m and full lock to the left also with the other stride. `quick`: trot at 0.67 Hz, R = 0.5 m and full lock.
    """
    gaits, frequencies = (("trt",), (0.67,)) if quick else (GAITS, FREQUENCIES)
    small = (0.5, FULL_LOCK)
    radii = small if quick else (*RADII, FULL_LOCK)
    left, other = (
        [
            _case(gait, f, radius, strategy, "left", stride)
            for gait, f, radius, strategy in itertools.product(gaits, frequencies, chosen, STRATEGIES)
        ]
        for chosen, stride in ((radii, STRIDE), (small, OTHER_STRIDE))
    )
    right = [
        _case(gait, 0.67, radius, strategy, "right")
        for gait, radius, strategy in itertools.product(gaits[:2], radii, STRATEGIES)
    ]
    return (*left, *right, *other)


def run(settings: Settings) -> Outcome:
    """Turn in all cases: the quarter circles in one batch, full lock in another, whose pilot holds its command.

    Full lock is left out for a controller that needs a path.
    """
    parts: list[tuple[float, dict[str, np.ndarray]]] = []
    about: dict[str, Column] = {}
    recordings: dict[str, Recording] = {}
    locks = settings.controller is None or not settings.controller.needs_path
    for pilot, share in (("arc", 0.8), ("open_loop", 0.2)) if locks else (("arc", 1.0),):
        chosen = [
            case for case in cases(settings.quick) if (case.labels["radius"] == FULL_LOCK) == (pilot == "open_loop")
        ]
        simulator = Simulator(settings.setup("quarter_circles", pilot=pilot), engine=settings.engine)
        defaults = simulator.setup.defaults()
        batch = _mirrored_starts(worlds(chosen, defaults, settings))
        before = sum(done for done, _ in parts)
        everything = batch.all_values(defaults)
        length = _length(everything, batch.labels["radius"])
        report = None if settings.progress is None else _part(settings.progress, before, share)
        columns, about = measured(simulator, batch, length, progress=report)
        warmup, end = length.seconds(everything["frequency"] / everything["tracking.clock_ratio"])
        parts.append((share, _judged(columns, end - warmup, everything["stance.max_stride"])))
        if pilot == "arc" and settings.bodies is None:
            recordings = _recordings(simulator, settings)
    joined = {name: np.concatenate([columns[name] for _, columns in parts]) for name in parts[0][1]}
    return Outcome(NAME, joined, LABELS | _ABOUT | about, recordings)


def _mirrored_starts(batch: Worlds) -> Worlds:
    """The batch, with right turns as the mirror images of left ones: they also start on the other pair of legs.

    Only for trot and walking trot, whose two diagonal pairs are half a cycle apart.
    """
    right = batch.labels["side"] == "right"
    start = {name: np.where(right, -batch.values[name], batch.values[name]) for name in ("start.x", "start.yaw")}
    return Worlds(batch.labels, batch.values | start | {"start.phase": batch.values["start.phase"] + 0.5 * right})


def _part(progress: Callable[[float], None], before: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(before + share * done)


def _length(values: Mapping[str, np.ndarray], radius: np.ndarray) -> Run:
    """Time for a quarter circle at the slowest accepted speed; some cycles at full lock."""
    if (radius == FULL_LOCK).all():
        return Run(cycles=_LOCK_CYCLES, warmup_cycles=2.0)
    arc = radius * np.pi / 2
    cycle = theory.speed(values) / values["frequency"] * values["tracking.clock_ratio"]
    return Run(cycles=_WARMUP + np.ceil(arc / (_SLOWEST * cycle)), warmup_cycles=_WARMUP, distance=arc)


def _judged(columns: dict[str, np.ndarray], longest: np.ndarray, max_stride: np.ndarray) -> dict[str, np.ndarray]:
    """Adds time, `followed` and the radii of theory; a world that has not arrived was measured for `longest` [s]."""
    radius, strategy = columns["radius"], columns["strategy"]
    lock = radius == FULL_LOCK
    time = np.where(lock, np.nan, radius * np.pi / 2 / columns["speed"])
    near = columns["cross_track_peak"] <= bound(radius)
    arrived = columns["duration"] < longest - 0.05
    strides = columns["stride"] * max_stride
    theory_radius = [theory.smallest_radius(str(name), l_s) for name, l_s in zip(strategy, strides, strict=True)]
    equal = [theory.equal_stride_radius(AMPLITUDE, l_s) for l_s in strides.tolist()]
    return columns | {
        "time": time,
        "followed": near & arrived & (columns["status"] == "ok") & ~lock,
        "theory_radius": np.where(lock, theory_radius, np.nan),
        "theory_equal_strides": np.where(lock & (strategy == "spine"), equal, np.nan),
    }


def bound(radius: np.ndarray) -> np.ndarray:
    """Largest cross-track error of the torso on a path that counts as followed [m]."""
    return np.maximum(BOUND_SHARE * radius, LEAST_BOUND)


def _recordings(simulator: Simulator, settings: Settings) -> dict[str, Recording]:
    shown = [_case("trt", 0.67, 0.5, strategy, "left") for strategy in STRATEGIES]
    batch = worlds(shown, simulator.setup.defaults(), settings.of_one_run())
    names = [f"trt, 0.67 Hz, R = 0.5 m, {case.labels['strategy']}" for case in shown]
    length = _length(batch.all_values(simulator.setup.defaults()), batch.labels["radius"])
    return recorded(simulator, batch, length, names)
