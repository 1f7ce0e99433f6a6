"""The sections of a tuning file that a sweep file does not have: tuned parameters, objective, optimizer, estimator."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.rollout import METRICS
from nermo_mjx.sweep.axes import check_value, read_number
from nermo_mjx.sweep.reading import Document, FieldPath, describe, nearest
from nermo_mjx.sweep.sections import named, read_whole
from nermo_mjx.tune.estimators import ESTIMATORS
from nermo_mjx.tune.objective import AIMS, OBJECTIVE_METRICS, TRAJECTORY_ERROR, Objective, Term
from nermo_mjx.tune.optimizer import LEARNING_RATE, Optimizer
from nermo_mjx.tune.sampling import COMMON, Estimator

#: Parameters that come back to the same place, and after how much.
PERIODS: Final = {"spine.phase": 2 * math.pi, "start.yaw": 2 * math.pi, "start.phase": 1.0, "offset": 1.0}
#: Share of a period by which written bounds may miss it: 3.14 is meant as pi.
_ROUNDING: Final = 1e-3
_OBJECTIVE: Final = "expected a list such as [{maximize: speed}, {minimize: roll_std, weight: 0.5, scale: 0.05}]"
_MOST_SAMPLES: Final = 100_000


@dataclasses.dataclass(frozen=True)
class Tuned:
    """One tuned parameter, in its own unit.

    Attributes:
        low, high: bounds; of a periodic parameter they are exactly one period apart.
        start: value of the first start.
        periodic: whether it may run over a bound and come back at the other.
    """

    name: str
    low: float
    high: float
    start: float
    periodic: bool = False

    def written(self) -> dict[str, Any]:
        """As it stands in a tuning file."""
        return {"bounds": [self.low, self.high], "start": self.start} | ({"periodic": True} if self.periodic else {})


def read_tuned(doc: Document, parameters: Mapping[str, Quantity]) -> tuple[Tuned, ...]:
    """The parameters under `tune`, in the order of the file."""
    entries = named(doc, "tune", parameters)
    tuned = tuple(_read_parameter(doc, name, value, parameters[name]) for name, value in entries)
    if not tuned:
        doc.fail(("tune",), "is missing or empty: expected parameters such as "
                            "{spine.amplitude: {bounds: [0, 0.4], start: 0.05}}.")  # fmt: skip
    return tuned


def _read_parameter(doc: Document, name: str, value: Any, about: Quantity) -> Tuned:
    path: FieldPath = ("tune", name)
    fields = ("bounds", "start", "periodic")
    given = {} if value is None else value
    if not isinstance(given, dict):
        doc.fail(path, f"is {describe(value)}: expected {{bounds: [low, high], start: number}}, both optional.", name)
    for key in given:
        if key not in fields:
            doc.fail((*path, key), f"is not a field of a tuned parameter; allowed are {', '.join(fields)}"
                                   f"{nearest(key, fields)}")  # fmt: skip
    if name in METRICS:
        doc.fail(path, "cannot be tuned: in the history its name is a metric's.", name)
    periodic = given.get("periodic", False)
    if not isinstance(periodic, bool):
        doc.fail((*path, "periodic"), f"is {describe(periodic)}: expected true or false.")
    low, high = _read_bounds(doc, name, given, about, periodic=periodic)
    if "start" not in given:
        start = float(about.default)  # type: ignore[arg-type]
        if not low <= start <= high:
            doc.fail(path, f"has no start, and its default {start:g} is outside of its bounds, [{low:g}, {high:g}]: "
                           "give a start.", name)  # fmt: skip
    else:
        start = read_number(doc, (*path, "start"), given["start"])
        check_value(doc, (*path, "start"), name, about, start)
        if not low <= start <= high:
            doc.fail((*path, "start"), f"is {start:g}: allowed is within the bounds, [{low:g}, {high:g}].")
    return Tuned(name, low, high, start, periodic)


def _read_bounds(
    doc: Document, name: str, given: Mapping[str, Any], about: Quantity, *, periodic: bool
) -> tuple[float, float]:
    path: FieldPath = ("tune", name, "bounds")
    pair = given.get("bounds", [about.low, about.high])
    if not isinstance(pair, list) or len(pair) != 2:
        doc.fail(path, f"is {describe(pair)}: expected the list [low, high].")
    low, high = (read_number(doc, (*path, i), number) for i, number in enumerate(pair))
    if not math.isfinite(low) or not math.isfinite(high):
        doc.fail(path, f"is [{low:g}, {high:g}]: expected finite numbers.")
    if low >= high:
        doc.fail(path, f"is [{low:g}, {high:g}]: the lower one comes first.")
    if periodic:
        low, high = _whole_period(doc, (*path[:2], "periodic"), name, low, high)
    # An open bound is allowed here, because no iterate ever stands on a bound; a closed one counts with its rounding.
    for bound in (low, high):
        if not about.low - 1e-6 * abs(about.low) <= bound <= about.high + 1e-6 * abs(about.high):
            doc.fail(path, f"has the bound {bound:g}: allowed is {about.allowed()}.")
    return low, high


def _whole_period(doc: Document, path: FieldPath, name: str, low: float, high: float) -> tuple[float, float]:
    """The bounds about their middle, exactly one period apart."""
    period = PERIODS.get(name, PERIODS.get(name.partition(".")[0]))
    if period is None:
        doc.fail(path, f"is true, but {name} does not come back to the same place; periodic are "
                       "spine.phase, start.phase, start.yaw and offset.*.")  # fmt: skip
    if abs(high - low - period) > _ROUNDING * period:
        doc.fail(path, f"is true, but the bounds [{low:g}, {high:g}] are not one period of {period:.5g} apart.")
    middle = 0.5 * (low + high)
    return middle - 0.5 * period, middle + 0.5 * period


def read_objective(doc: Document) -> Objective:
    """The weighted terms under `objective`."""
    given = doc.data.get("objective")
    if not isinstance(given, list) or not given:
        what = "is missing" if "objective" not in doc.data else f"is {describe(given)}"
        doc.fail(("objective",), f"{what}: {_OBJECTIVE}.")
    terms = tuple(_read_term(doc, ("objective", i), term) for i, term in enumerate(given))
    for i, term in enumerate(terms):
        if (term.aim, term.metric) in [(other.aim, other.metric) for other in terms[:i]]:
            doc.fail(("objective", i), f"is '{term.aim}: {term.metric}' again: give it once, with a weight.")
    return Objective(terms)


def _read_term(doc: Document, path: FieldPath, term: Any) -> Term:
    if not isinstance(term, dict):
        doc.fail(path, f"is {describe(term)}: {_OBJECTIVE}.")
    aims = [key for key in term if key in AIMS]
    allowed = (*AIMS, "at", "weight", "scale") if aims == ["hold"] else (*AIMS, "weight", "scale")
    for key in term:
        if key not in allowed:
            doc.fail((*path, key), f"is not a field of a term; allowed are {', '.join(allowed)}{nearest(key, allowed)}")
    if len(aims) != 1:
        doc.fail(path, f"is {describe(term)}: expected one of {', '.join(AIMS)} with the name of a metric.")
    aim, metric = aims[0], term[aims[0]]
    if not isinstance(metric, str) or metric not in OBJECTIVE_METRICS:
        doc.fail((*path, aim), f"is {describe(metric)}: allowed are {', '.join(OBJECTIVE_METRICS)}"
                               f"{nearest(str(metric), OBJECTIVE_METRICS)}")  # fmt: skip
    if aim == "hold" and "at" not in term:
        doc.fail(path, f"holds {metric} without 'at': give the value to hold it at.")
    numbers = {key: read_number(doc, (*path, key), term[key]) for key in ("weight", "scale", "at") if key in term}
    for key, number in numbers.items():
        if not math.isfinite(number) or (key != "at" and number <= 0):
            doc.fail((*path, key), f"is {number:g}: expected a finite number{'' if key == 'at' else ' above 0'}.")
    return Term(aim, metric, **numbers)


def read_recording(doc: Document, objective: Objective, *, needed: bool = True) -> Path | None:
    """The file under `recording`, which is there if it is `needed`; its path counts from the tuning file's folder."""
    wanted, given = TRAJECTORY_ERROR in objective.metrics, doc.data.get("recording")
    if given is None:
        if wanted:
            doc.fail(("objective",), f"names {TRAJECTORY_ERROR}, but there is no 'recording' to compare with: give the "
                                     "path of an NPZ.")  # fmt: skip
        return None
    if not isinstance(given, str):
        doc.fail(("recording",), f"is {describe(given)}: expected the path of an NPZ.")
    path = (Path(doc.source).parent / given if doc.lines else Path(given)).expanduser().resolve()
    if needed and not path.is_file():
        doc.fail(("recording",), f"is {given!r}: there is no file {path}.")
    if not wanted:
        doc.fail(("recording",), f"is not read: no term of the objective names {TRAJECTORY_ERROR}.")
    return path


def read_optimizer(doc: Document) -> Optimizer:
    """The optimizer: a name, or {name: NAME, option: value}."""
    given = doc.data.get("optimizer", "adam")
    options = {"name": given} if isinstance(given, str) else given
    if not isinstance(options, dict):
        doc.fail(("optimizer",), f"is {describe(given)}: expected a name or {{name: adam, learning_rate: 0.1}}.")
    options = {"name": "adam", "learning_rate": LEARNING_RATE, **options}
    for key, value in options.items():
        if key == "name" and not isinstance(value, str):
            doc.fail(("optimizer", key), f"is {describe(value)}: expected the name of an optimizer of optax.")
        if key == "clip" or (key == "learning_rate" and not isinstance(value, dict)):
            number = read_number(doc, ("optimizer", key), value)
            if not 0 < number < math.inf:
                doc.fail(("optimizer", key), f"is {number:g}: expected a finite number above 0.")
        if not isinstance(value, (bool, int, float, str, dict)):
            doc.fail(("optimizer", key), f"is {describe(value)}: expected a number, a name or a schedule.")
    clip = float(options.pop("clip")) if "clip" in options else None
    try:
        return Optimizer(options.pop("name"), options, clip)
    except ParameterError as error:
        subject, _, message = str(error).partition(" ")
        doc.fail(tuple(subject.split(".")), message, subject)


def read_estimator(doc: Document) -> Estimator:
    """The estimator: `exact`, or {NAME: {samples: 8, sigma: 0.1}}."""
    given, names = doc.data.get("estimator", "exact"), list(ESTIMATORS)
    expected = f"expected exact or one of {', '.join(names[1:])} as {{smoothed: {{samples: 8, sigma: 0.1}}}}"
    if isinstance(given, str):
        if given not in names:
            doc.fail(("estimator",), f"is '{given}': {expected}{nearest(given, names)}")
        if given != "exact":
            doc.fail(("estimator",), f"is '{given}' without samples and sigma: {expected}.")
        return Estimator()
    if not isinstance(given, dict) or len(given) != 1:
        doc.fail(("estimator",), f"is {describe(given)}: {expected}.")
    name, options = next(iter(given.items()))
    path: FieldPath = ("estimator", name)
    if name not in names:
        doc.fail(path, f"is not an estimator: {expected}{nearest(name, names)}")
    if name == "exact" and not options:
        return Estimator()
    allowed = () if name == "exact" else ("samples", "sigma", "common") + (("gamma",) if name == "mixture" else ())
    if not isinstance(options, dict):
        doc.fail(path, f"is {describe(options)}: expected a mapping of {', '.join(allowed) or 'nothing'}.")
    for key in options:
        if key not in allowed:
            known = f"allowed are {', '.join(allowed)}" if allowed else "it has none"
            doc.fail((*path, key), f"is not an option of '{name}'; {known}{nearest(key, allowed)}")
    return _sampled(doc, path, name, options)


def _sampled(doc: Document, path: FieldPath, name: str, options: Mapping[str, Any]) -> Estimator:
    for key in ("samples", "sigma"):
        if key not in options:
            doc.fail(path, f"has no '{key}': expected {{samples: 8, sigma: 0.1}}.")
    least = 4 if name == "mixture" else 2
    samples = read_whole(doc, (*path, "samples"), least, _MOST_SAMPLES)
    if samples % 2:
        doc.fail((*path, "samples"), f"is {samples}: expected an even number, because samples come in pairs.")
    numbers = {key: read_number(doc, (*path, key), options[key]) for key in ("sigma", "gamma") if key in options}
    for key, number in numbers.items():
        if not 0 < number < math.inf:
            doc.fail((*path, key), f"is {number:g}: expected a finite number above 0.")
    common = options.get("common", "none")
    if common not in COMMON:
        allowed = ", ".join(COMMON) + nearest(str(common), COMMON)
        doc.fail((*path, "common"), f"is {describe(common)}: allowed are {allowed}")
    return Estimator(name, samples, common=common, **numbers)
