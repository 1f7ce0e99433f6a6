"""The measurements by name, with their options: names, allowed values and defaults."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final

from nermo_mjx.robot import ParameterError


@dataclasses.dataclass(frozen=True)
class Option:
    """An option that a measurement is repeated over.

    Attributes:
        default: values that are measured by default.
        allowed: names or numbers; None for any positive number.
        whole: whether the number is whole.
        before: implicit value before the option existed; None for the first default.
    """

    default: tuple[Any, ...]
    allowed: tuple[Any, ...] | None = None
    whole: bool = False
    before: Any = None

    @property
    def unsaid(self) -> Any:
        """The value of a measurement that does not name this option."""
        return self.default[0] if self.before is None else self.before

    def check(self, name: str, value: Any) -> None:
        """Raises `ParameterError` unless the value is allowed."""
        if self.allowed is not None and value not in self.allowed:
            raise ParameterError(f"{name} is {value!r}: allowed is one of {', '.join(map(str, self.allowed))}.")
        if self.allowed is None and not (0 < value < float("inf") and (value == int(value) or not self.whole)):
            range_ = "a whole number from 1" if self.whole else "(0, inf)"
            raise ParameterError(f"{name} is {value:g}: allowed is {range_}.")


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """A measurement: a function of its options that returns one line of figures.

    Attributes:
        about: what it measures, for listings.
        place: module and name of the function; it is imported in the process that measures.
        options: by name.
        once: whether a measurement in a directory is not repeated: those that take hours in total.
        extra: required extra of this package, and the modules that it installs.
    """

    about: str
    place: str
    options: Mapping[str, Option]
    extra: tuple[str, tuple[str, ...]] = ("", ())
    once: bool = False

    def check(self, name: str) -> None:
        """Raises `ParameterError` unless what it needs is installed."""
        extra, modules = self.extra
        if missing := [module for module in modules if not _installed(module)]:
            raise ParameterError(
                f"{name} needs {missing[0]}, which is not installed: pip install 'nermo-mjx[{extra}]'."
            )

    def plan(self, chosen: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
        """The options of each measurement: all combinations of the chosen values, or the defaults."""
        values = [tuple(chosen.get(name) or option.default) for name, option in self.options.items()]
        return [dict(zip(self.options, each, strict=True)) for each in itertools.product(*values)]

    def measure(self, **options: Any) -> dict[str, Any]:
        """The figures of one measurement."""
        module, _, name = self.place.partition(":")
        figures: dict[str, Any] = getattr(importlib.import_module(module), name)(**options)
        return figures


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # not even its package is installed
        return False


_WORLDS = Option((64,), whole=True)

CASES: Final[dict[str, Benchmark]] = {
    "throughput": Benchmark(
        "a walk with its controller and metrics against plain physics",
        "nermo_mjx.bench.throughput:throughput_case",
        {"engine": Option(("c", "mjx"), ("c", "mjx", "warp")), "worlds": _WORLDS},
    ),
    "gradient": Benchmark(
        "value and gradient of a walk against the walk alone",
        "nermo_mjx.bench.gradient:gradient_case",
        {
            "mode": Option(("forward", "reverse"), ("forward", "reverse")),
            "worlds": Option((16,), whole=True),
            "cycles": Option((1.0,)),
        },
    ),
    "tuning": Benchmark(
        "the speed that tuning by gradient, and CMA-ES, reach on a tenth of a dense sweep's simulated time",
        "nermo_mjx.bench.tuning:tuning_case",
        {"frequency": Option((0.5, 0.8))},
    ),
    "search": Benchmark(
        "the speed that CMA-ES finds with each of ten seeds, against a dense sweep",
        "nermo_mjx.bench.search:search_case",
        {"frequency": Option((0.5, 0.8))},
    ),
    "gradients-pay": Benchmark(
        "the best gait that gradients and CMA-ES find on the same budget of processor time",
        "nermo_mjx.bench.paying:paying_case",
        {
            "parameters": Option((32, 8, 2, 16, 64), (2, 8, 16, 32, 64)),
            "task": Option(("speed", "transport"), ("speed", "transport")),
            "gait": Option(("trt", "trt1", "lat"), ("trt", "trt1", "lat")),
            "seed": Option((1, 2, 3, 4, 5), whole=True),
            "method": Option(("exact", "line_search", "cma", "mixture"), ("exact", "mixture", "line_search", "cma")),
            "cpu_s": Option((60.0,)),
        },
        once=True,
    ),
    "startup": Benchmark(
        "from a new process to the first control tick, stage by stage, with a cold and a warm cache",
        "nermo_mjx.bench.startup:startup_case",
        {"engine": Option(("c", "mjx"), ("c", "mjx", "warp")), "worlds": _WORLDS},
    ),
    "profile": Benchmark(
        "a physics step, stage by stage",
        "nermo_mjx.bench.profile:profile",
        {"engine": Option(("c", "mjx"), ("c", "mjx")), "worlds": _WORLDS},
    ),
    "speedtest": Benchmark(
        "MuJoCo's own speed test of MJX on the same model",
        "nermo_mjx.bench.speedtest:speedtest_case",
        {"worlds": _WORLDS},
    ),
    "gpu-plan": Benchmark(
        "estimates for the programs on NVIDIA GPUs, from XLA's compiler without one",
        "nermo_mjx.bench.gpu_plan:gpu_plan_case",
        {
            "target": Option(("h100",), ("h100", "a100", "l4", "t4")),
            "program": Option(("walk",), ("walk", "forward", "reverse")),
            "worlds": Option((1024, 8192, 65_536), whole=True),
        },
        ("gpu-plan", ("jax_cuda12_plugin", "nvidia.cuda_nvcc")),
    ),
}


def plan(cases: Sequence[str], chosen: Mapping[str, Sequence[Any]]) -> list[tuple[str, dict[str, Any]]]:
    """(name, options) of each measurement.

    Args:
        cases: names from `CASES`.
        chosen: option -> values; missing or empty ones have their default.

    Raises:
        ParameterError: an unknown case, a value that is not allowed, an option that none of the cases has, a case that
            needs what is not installed.
    """
    for name in cases:
        if name not in CASES:
            raise ParameterError(f"case is {name!r}: allowed is one of {', '.join(CASES)}.")
    for option, values in chosen.items():
        owners = [CASES[name].options[option] for name in cases if option in CASES[name].options]
        if values and not owners:
            having = [name for name, case in CASES.items() if option in case.options]
            raise ParameterError(f"{option} is given, but not measured: it is an option of {' and '.join(having)}.")
        for owner, value in itertools.product(owners, values or ()):
            owner.check(option, value)
    for name in cases:
        CASES[name].check(name)
    return [(name, options) for name in cases for options in CASES[name].plan(chosen)]
