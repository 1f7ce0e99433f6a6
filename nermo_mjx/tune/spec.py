"""What a tuning is: the checked content of a tuning file. All errors in it are reported here, before work begins."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import jax.numpy as jnp
import numpy as np
from pydantic import ConfigDict, Field
from scipy.stats import qmc

from nermo_mjx.rollout import Metric, all_parameters
from nermo_mjx.specs.controllers import code_identity, known_names
from nermo_mjx.specs.described import Described, digest_of
from nermo_mjx.specs.fields import Refused, optional, read
from nermo_mjx.specs.patterns import written_out
from nermo_mjx.specs.reading import Document, SpecError, read_file
from nermo_mjx.specs.values import ByParameter, Choice, Whole
from nermo_mjx.specs.walk import WalkSpec, check_sources, read_walk
from nermo_mjx.specs.walk_fields import WalkFields
from nermo_mjx.specs.workspace import check_workspace
from nermo_mjx.tune import methods, sections
from nermo_mjx.tune.bounds import Bounds
from nermo_mjx.tune.methods import Method
from nermo_mjx.tune.objective import Objective, objective_metrics
from nermo_mjx.tune.optimizer import Optimizer
from nermo_mjx.tune.sampling import Estimator
from nermo_mjx.tune.sections import Tuned

#: How a derivative is computed: chosen by parameter count, in forward mode, or in reverse mode.
MODES: Final = ("auto", "forward", "reverse")
#: Default number of iterations that may gain almost nothing before a tuning stops.
PATIENCE: Final = 6
#: A run counted in gait cycles may not grow longer than this where the frequency is tuned [s].
LONGEST_RUN: Final = 120.0
#: Fields that do not change what an iteration computes: a tuning may be resumed with others.
FREE: Final = ("iterations", "patience", "plots", "video")
#: Fields that a tuning has as they stand in its file.
_PLAIN: Final = ("starts", "iterations", "patience", "seed", "mode", "plots", "video")


class TuningFile(WalkFields):
    """A file for `nermo-mjx tune` and `nermo-mjx landscape`."""

    model_config = ConfigDict(
        json_schema_extra={"required": ["tune", "objective"], "if": {"required": ["metrics"]},
                           "else": {"properties": {"objective": {"items": sections.KNOWN_METRICS}}}}
    )  # fmt: skip
    what: ClassVar = "a field of a tuning"
    sources: ClassVar = "'tune' or 'set'"
    tune: Annotated[dict[str, sections.TunedFields | None], ByParameter()] = Field({}, description="tuned parameters")
    objective: list[sections.TermFields] = optional("terms whose sum is minimized", minItems=1)
    recording: Any = optional("path of the NPZ that trajectory_error compares with", type=["string", "null"])
    method: methods.MethodFields = optional("how an iteration finds its step, by default along exact gradients")
    optimizer: sections.OptimizerFields = optional("how an iteration steps")
    estimator: sections.EstimatorFields = Field(sections.EstimatorFields(exact=None), description="of gradients")
    starts: Annotated[int, Whole(1, 100_000)] = Field(1, description="points tuned in parallel")
    iterations: Annotated[int, Whole(1, 1_000_000)] = Field(40, description="steps")
    patience: Annotated[int, Whole(1, 1_000_000)] = Field(
        PATIENCE, description="iterations in a row that may gain almost nothing before the tuning stops"
    )
    seed: Annotated[int, Whole(0, 2**32 - 1)] = Field(0, description="of the other starts, and of perturbations")
    mode: Annotated[str, Choice(MODES)] = Field("auto", description="how a derivative is computed")
    plots: bool = Field(True, description="whether figures are made at the end")
    video: bool = Field(False, description="whether a video of the best is made at the end")

    @classmethod
    def refuse(cls, key: str) -> None:
        if key in ("vary", "randomize", "sample"):
            raise Refused("is a field of a sweep, not of a tuning: what is to change stands under 'tune'.", key)
        super().refuse(key)


@dataclasses.dataclass(frozen=True)
class Tuning(WalkSpec, Described):
    """A checked tuning of p parameters. Build it with `from_file`, `from_text` or `from_dict`.

    Attributes:
        setup, run, fixed, pilot: see `WalkSpec`.
        tuned: the tuned parameters in the order of the file.
        objective: what is minimized.
        recording: what `trajectory_error` compares with.
        method: by gradient, by differences, or by CMA-ES, whose generations replace the starts.
        optimizer, estimator: how an iteration steps, and from which gradient.
        starts: points that are tuned in parallel in one batch; the first is the given one, the others are drawn.
        iterations: steps; there is one more evaluation, of the point reached by the last step.
        patience: iterations that may gain next to nothing before it stops, see `nermo_mjx.tune.stopping`.
        seed: of the other starts, and of the estimator's perturbations.
        mode: how derivatives are taken: `auto`, `forward` or `reverse`.
        plots, video: whether figures, and a video of the best, are made in the end.
    """

    kind: ClassVar = "tuning"
    tuned: tuple[Tuned, ...]
    objective: Objective
    recording: Path | None = None
    optimizer: Optimizer = dataclasses.field(default_factory=Optimizer)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    starts: int = 1
    iterations: int = 40
    patience: int = PATIENCE
    seed: int = 0
    mode: str = "auto"
    plots: bool = True
    video: bool = False
    method: Method = dataclasses.field(default_factory=Method)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], *, recorded: bool = True) -> Tuning:
        """Read a YAML tuning file; raises `SpecError`. Without `recorded`, its recording may be gone."""
        return _read(read_file(path, cls.kind), recorded=recorded)

    @classmethod
    def of_document(cls, doc: Document) -> Tuning:
        return _read(doc)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p tuned parameters; numbers of a point come in this order."""
        return tuple(each.name for each in self.tuned)

    @property
    def objective_metrics(self) -> dict[str, Metric]:
        """What a term may name, by name."""
        return objective_metrics(self.metrics)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the tuned parameters, as arrays (p,)."""
        low, high = (jnp.array([getattr(each, end) for each in self.tuned], float) for end in ("low", "high"))
        return Bounds(low, high, jnp.array([each.periodic for each in self.tuned]))

    def start_points(self) -> np.ndarray:
        """Where each start begins (starts, p): the given point, then Sobol points within the bounds."""
        given = np.array([[each.start for each in self.tuned]])
        exponent = max(self.starts - 2, 0).bit_length()  # a power of two keeps the sequence balanced
        sobol = qmc.Sobol(len(self.tuned), rng=np.random.default_rng(self.seed))
        shares = sobol.random_base2(exponent)[: self.starts - 1]
        low, high = (np.array([getattr(each, end) for each in self.tuned]) for end in ("low", "high"))
        return np.concatenate([given, low + (high - low) * shares])

    def resolved(self, folder: Path | None = None) -> dict[str, Any]:
        data = self.walk_fields(folder)
        data["tune"] = {each.name: each.written() for each in self.tuned}
        data["objective"] = [term.written() for term in self.objective.terms]
        if self.recording is not None:
            data["recording"] = self.recording.name if self.recording.parent == folder else str(self.recording)
        data |= self.method.written()
        data["optimizer"] = self.optimizer.written()
        data["estimator"] = self.estimator.written()
        data |= {name: getattr(self, name) for name in _PLAIN}
        return {name: value for name, value in data.items() if methods.reads(self.method.name, name)}

    def decisive(self) -> dict[str, Any]:
        """The fields that may not change: a recording counts beside them, a controller by what it is."""
        data = {key: value for key, value in self.resolved().items() if key not in (*FREE, "recording")}
        return data | code_identity(self.setup)

    def identity(self) -> dict[str, Any]:
        """All that decides an iteration: the `fields`, `defaults` of what they do not name, the `recording`'s digest.

        The number of iterations, figures and video do not count: a tuning can be extended.

        Raises:
            SpecError: the recording cannot be read.
        """
        try:
            recorded = b"" if self.recording is None else self.recording.read_bytes()
        except OSError as error:
            raise SpecError(f"recording is {self.recording}: cannot be read ({error.strerror or error}).") from None
        return {
            "fields": self.decisive(),
            "defaults": {name: about.default for name, about in self.parameters.items()},
            "recording": "" if self.recording is None else hashlib.sha256(recorded).hexdigest(),
        }

    def digest(self) -> str:
        """A hash of the `identity`."""
        return digest_of(*self.identity().values())


def _read(doc: Document, *, recorded: bool = True) -> Tuning:
    with known_names(doc):
        doc = written_out(doc)
        file = read(doc, TuningFile)
    walk = read_walk(doc, file)
    if "distance" in walk["pilot"]:
        doc.fail(("pilot", "straight", "distance"), "ends each run at a distance: such a length jumps by whole cycles "
                 "and has no derivative; give run: {cycles: 8}.")  # fmt: skip
    objective = sections.read_objective(doc, file.objective)
    method = methods.read_method(doc, file.method)
    tuning = Tuning(
        **walk,
        tuned=sections.read_tuned(doc, file.tune, all_parameters(walk["setup"])),
        objective=objective,
        recording=sections.read_recording(doc, file.recording, objective, needed=recorded),
        optimizer=sections.read_optimizer(doc),
        estimator=sections.read_estimator(file.estimator),
        method=method,
        **{name: getattr(file, name) for name in _PLAIN},
    )
    if method.name == "cma":
        tuning = dataclasses.replace(tuning, starts=method.population)
    _check_together(doc, tuning)
    return tuning


def _check_together(doc: Document, tuning: Tuning) -> None:
    """Checks of several fields: a parameter with two sources or without effect, a run too long, a leg too short."""
    check_sources(doc, tuning, {"tune": list(tuning.names)})
    _check_length(doc, tuning)
    ranges = {each.name: np.linspace(each.low, each.high, 5) for each in tuning.tuned}
    check_workspace(doc, tuning.setup, tuning.fixed, {"tune": ranges})


def _check_length(doc: Document, tuning: Tuning) -> None:
    """A run of a given number of cycles lasts longer at a lower frequency."""
    low = {each.name: each.low for each in tuning.tuned}.get("frequency")
    if low is None or "frequency" not in tuning.setup.timing or tuning.run.duration is not None:
        return
    cycles = float(tuning.run.cycles)  # type: ignore[arg-type]
    if cycles > LONGEST_RUN * low:
        lasts = f"would last {cycles / low:g} s" if low > 0 else "would never end"
        doc.fail(("tune", "frequency", "bounds"), f"begins at {low:g} Hz, where {cycles:g} cycles {lasts}: allowed is "
                 f"{cycles / LONGEST_RUN:.3g} Hz or more, or give run: {{duration: seconds}}.")  # fmt: skip
