"""From the options of `walk` to a setup, a run and named parameters, each checked before anything compiles."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from nermo_mjx.cli.assignments import LISTED, assigned
from nermo_mjx.cli.group import WrongUse

if TYPE_CHECKING:
    from nermo_mjx.rollout import Run, Setup

#: Options that set one parameter, and the setup for which the parameter has an effect.
PARAMETER_OPTIONS: dict[str, tuple[str, tuple[str, str] | None]] = {
    "frequency": ("frequency", None),
    "stride": ("stride", None),
    "spine_amplitude": ("spine.amplitude", ("spine", "stride_extension")),
    "spine_phase": ("spine.phase", ("spine", "stride_extension")),
    "turn_rate": ("pilot.turn_rate", ("pilot", "open_loop")),
    "offset_compensation": ("spine.offset_compensation", None),
}
SETUP_OPTIONS = ("robot", "scene", "tail", "physics", "gait", "spine", "steering", "profile", "trajectory",
                 "head", "tail_motion", "controller", "metrics")  # fmt: skip
DEFAULT_CYCLES, DEFAULT_WARMUP = 8.0, 2.0


@dataclasses.dataclass(frozen=True)
class Plan:
    """One run: its static choices, its length, the values the user gave, and all parameters with their defaults."""

    setup: Setup
    run: Run
    values: Mapping[str, float]
    parameters: Mapping[str, float]

    @property
    def theory(self) -> float:
        """Speed of feet that neither slip nor lag, strides lengthened by the spine (5.21, 5.33) [m/s, simulated].

        NaN for custom controllers.
        """
        import numpy as np

        from nermo_mjx.experiments import theory

        if self.setup.controller is not None:
            return float("nan")
        values = {name: np.asarray(value) for name, value in self.parameters.items()}
        # Only the bend at the moment when the diagonal pairs switch lengthens a stride.
        extends = "stride_extension" in self.setup.spine.split("+")
        values["spine.amplitude"] = values["spine.amplitude"] * extends * np.cos(values["spine.phase"])
        return float(theory.speed(values))


def plan(
    *,
    pilot: str | None,
    assignments: tuple[str, ...],
    seed: int | None,
    cycles: float | None,
    duration: float | None,
    warmup: float | None,
    **options: Any,
) -> Plan:
    """Join and check the options; raises `WrongUse` or `ParameterError`."""
    from nermo_mjx.robot.quantity import values_of
    from nermo_mjx.rollout import Setup, all_parameters

    pilot = pilot or ("straight" if options["turn_rate"] is None else "open_loop")
    setup = Setup(pilot=pilot, **{name: options[name] for name in SETUP_OPTIONS if options.get(name) is not None})
    known = all_parameters(setup)
    values: dict[str, float] = {} if seed is None else _shifted_start(seed)
    for option, (name, needs) in PARAMETER_OPTIONS.items():
        if options[option] is None:
            continue
        flag = f"--{option.replace('_', '-')}"
        if name not in known:
            raise WrongUse(f"{flag} sets {name}, which is not a parameter of {setup.controller}.")
        if setup.controller is None and needs is not None and needs[1] not in getattr(setup, needs[0]).split("+"):
            raise WrongUse(
                f"{flag} has no effect with --{needs[0]} {getattr(setup, needs[0])}: add --{needs[0]} {needs[1]}."
            )
        values[name] = options[option]
    values |= assigned(assignments, known, LISTED)
    for name, value in values.items():
        known[name].check(name, value)
    parameters = {name: float(value) for name, value in values_of(setup.world(values))}
    return Plan(setup, _length(cycles, duration, warmup), values, parameters)


def _length(cycles: float | None, duration: float | None, warmup: float | None) -> Run:
    from nermo_mjx.rollout import Run

    if cycles is not None and duration is not None:
        raise WrongUse("Give --cycles or --duration, not both.")
    total = duration if duration is not None else cycles if cycles is not None else DEFAULT_CYCLES
    before = min(DEFAULT_WARMUP, total / 4) if warmup is None else warmup
    if before >= total:
        raise WrongUse(f"--warmup is {before:g}: it must be shorter than the run, {total:g}.")
    return Run(cycles=total, warmup_cycles=before) if duration is None else Run(duration=total, warmup=before)


def _shifted_start(seed: int) -> dict[str, float]:
    import numpy as np

    from nermo_mjx.rollout.start import START_SPREAD

    random = np.random.default_rng(seed)
    return {name: float(random.uniform(-width, width)) for name, width in START_SPREAD.items()}
