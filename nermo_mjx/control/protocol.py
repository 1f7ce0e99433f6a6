"""The interface of controllers for simulators, metrics, sweeps and tunings; the user's controllers by their names.

A controller consists of pure functions of pytrees. Spec files and commands name an object in a Python file or module.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nermo_mjx.control.path import PathPoint
from nermo_mjx.files import MAX_ARRAY_BYTES, MAX_JSON_BYTES, read_bytes
from nermo_mjx.kinematics.leg import four_legs, inverse_kinematics
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.parameters import Sensors, ServoAngles
from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.shapes import Array, Scalar
from nermo_mjx.trust import CODE_EXECUTION, DATA_CONTROLLERS, MESSAGE_HANDLER, one_line

#: What every controller has.
REQUIRED_ATTRIBUTES = ("dt", "parameters", "init", "initial_servo", "update", "cycle_rate")


@runtime_checkable
class ControllerLike(Protocol):
    """A controller. `params` and its state are any pytrees; values are unbatched, and engines `vmap`.

    Where `parameters` is a parameter tree (`nermo_mjx.parameter_tree`), each of its quantities can be named like those
    of the published controller: in `values`, and in sweep and tuning files.
    """

    @property
    def dt(self) -> float:
        """Simulated duration of a control tick [s], a whole number of physics steps."""

    @property
    def parameters(self) -> Any:
        """Default parameters of one world; they define the structure and shapes of all others."""

    def init(self, params: Any, sensors: Sensors, phase: Scalar) -> Any:
        """State at the start, from the readings at rest; `phase` is `start.phase`."""

    def initial_servo(self, params: Any, phase: Scalar) -> ServoAngles:
        """Servo angles of the start pose."""

    def update(self, params: Any, state: Any, sensors: Sensors) -> tuple[Any, ServoAngles]:
        """One control tick: the state and the servo angles `dt` later."""

    def cycle_rate(self, params: Any) -> Any:
        """Gait cycles per simulated second [1/s], in which runs are counted and over which metrics are averaged.

        Elementwise: in a batch the leaves of `params` have a leading axis.
        """


@runtime_checkable
class FollowsPath(Protocol):
    """A controller with a path, relative to which the robot is measured (`cross_track_rms`, progress along it)."""

    def path(self, params: Any, state: Any, position: Float[Array, " 3"]) -> PathPoint | None:
        """The point of the path closest to a position [m]; None if it does not follow one."""


@runtime_checkable
class ActsUpon(Protocol):
    """A controller that acts upon the published one, such as a policy."""

    def upon(self, **choices: Any) -> ControllerLike:
        """The same controller upon a published one with other choices, named as in `Setup`: `pilot`, `spine`.

        Raises:
            ParameterError: it cannot act upon that one.
        """

    def elsewhere(self, physics: str, timestep: float) -> str:
        """A sentence on why it may walk otherwise in this physics, with this time step [s]; empty if nothing is known
        of that."""


#: Height of the ground [m] at (x, y) in the world [m], which broadcast.
Ground = Callable[[Any, Any], Array]


@runtime_checkable
class SeesGround(Protocol):
    """A controller that may observe the ground, which the loop knows."""

    def over(self, ground: Ground) -> ControllerLike:
        """The same controller over a ground of this height."""


def seeing(controller: Any, ground: Ground) -> Any:
    """A controller over a ground, which it sees if it can."""
    return controller.over(ground) if isinstance(controller, SeesGround) else controller


@runtime_checkable
class PlansContact(Protocol):
    """A controller that plans contacts (for `swing_loaded_rear`)."""

    def stance(self, state: Any) -> Bool[Array, " 4"]:
        """Planned contact of the limbs."""


@runtime_checkable
class ChecksParameters(Protocol):
    """A controller with checks of its parameters beyond the ranges of its quantities."""

    def check(self, params: Any) -> None:
        """Raise `ParameterError` with one sentence. `params` are not traced, and may have leading batch axes."""


@runtime_checkable
class CompletesValues(Protocol):
    """A controller with parameters that are derived from others, unless both are named."""

    def complete(self, values: dict[str, Any]) -> dict[str, Any]:
        """Named values plus derived ones."""


def leg_servos(
    feet: Float[Array, "4 2"],
    spine: Any = 0.0,
    routing: str = "type3",
    geometry: Geometry | None = None,
) -> ServoAngles:
    """Servo angles for feet (y, z) in their legs' frames [m] and the spine's servo [rad]; neck and tail are straight.

    >>> leg_servos(jnp.asarray([[0.0, -0.045], [0.0, -0.045], [0.0, -0.05], [0.0, -0.05]])).hip.shape
    (4,)

    Args:
        feet: y is backward, z up from the hip's axis; unreachable positions are moved to the edge of the workspace.
        spine: positive turns left.
        routing: knee tendon routing of the robot.
        geometry: of the robot, by default the published one. If a controller's parameters have a group `geometry:
            Geometry`, it receives that of its world.
    """
    servo = inverse_kinematics(four_legs(geometry or Geometry()), feet, routing).servo
    spine = jnp.asarray(spine, servo.dtype)
    zeros = jnp.zeros_like(spine)
    return ServoAngles(hip=servo[..., 0], knee=servo[..., 1], spine=spine, neck=zeros, tail=zeros)


# ---
# The user's Python files and modules, whose objects spec files and commands can name.


@dataclasses.dataclass(frozen=True)
class Source:
    """A Python file or module that a text names, with or without the name of an object in it.

    Attributes:
        subject: the beginning of messages: `controller is 'bound.py:Bound'`.
        place: `FILE.py` or the name of a module.
        name: of the object; "" without one.
        form: the expected form, for messages.
    """

    subject: str
    place: str
    name: str
    form: str

    @classmethod
    def named(cls, field: str, text: str, form: str) -> Source:
        """What a text names: FILE.py, FILE.py:NAME, MODULE or MODULE:NAME.

        Raises:
            ParameterError: the text has another form.
        """
        path, colon, name = (text, "", "") if text.endswith(".py") else text.rpartition(":")
        path, name = (path, name) if colon else (text, "")
        if not path or (colon and not name.isidentifier()):
            raise ParameterError(f"{field} {text!r}: expected {form}.")
        return cls(f"{field} {text!r}", path, name, form)

    def content(self) -> tuple[str, bytes]:
        """Path and content of the file.

        Raises:
            ParameterError: the file or module does not exist or cannot be read.
        """
        path = Path(self.place)
        if not self.place.endswith(".py"):
            self._check_may_run()  # to find a module, Python runs the packages that it is in
            try:
                spec = importlib.util.find_spec(self.place)
            except (ImportError, ValueError):
                spec = None
            if spec is None or spec.origin is None:
                raise ParameterError(
                    f"{self.subject}: there is no module {self.place!r} here; expected {self.form}."
                )
            path = Path(spec.origin)
        try:
            return str(path.resolve()), read_bytes(path, MAX_JSON_BYTES)
        except OSError as error:
            raise ParameterError(
                f"{self.subject}: {path} cannot be read ({error.strerror})."
            ) from None

    def digest(self, *names: str) -> str:
        """A hash of names and of the file, not of what it imports; the errors are those of `content`."""
        return hashlib.sha256(
            "".join(f"{name}\0" for name in names).encode() + self.content()[1]
        ).hexdigest()[:16]

    def module(self) -> ModuleType:
        """The module; a file is executed once for each version of its content.

        Raises:
            ParameterError: see `content`; or it cannot be imported, or nothing may be run here.
        """
        self._check_may_run()
        path, content = self.content()
        with user_code(f"{self.subject}: it cannot be imported"):
            return _imported(self.place, path, content)

    def missing(self, names: list[str]) -> ParameterError:
        """The error for a name that it does not have, with the closest of those that it has."""
        hint = did_you_mean(self.name, names)
        return ParameterError(f"{self.subject}: {self.place} has no {self.name!r}{hint}")

    def _check_may_run(self) -> None:
        if not CODE_EXECUTION.get():
            raise ParameterError(
                f"{self.subject}: it is code, which a command that only reads does not run."
            )


#: Errors of functions that cannot be traced.
_TRACING_ERRORS: Final = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerBoolConversionError,
    jax.errors.TracerIntegerConversionError,
)
#: Packages whose lines are not the user's, where an error arises.
_LIBRARY_PACKAGES: Final = (
    "jax",
    "jaxlib",
    "numpy",
    "nermo_mjx",
    "importlib",
    "contextlib",
    "_sitebuiltins",
)


@contextlib.contextmanager
def user_code(subject: str) -> Iterator[None]:
    """Turn any error of the user's code into one sentence: the subject, the user's file and line, and what is wrong.

    Raises:
        ParameterError: instead of the error.
    """
    try:
        yield
    except ParameterError:
        raise
    except (Exception, SystemExit) as error:
        frames = [
            f"{Path(frame.f_code.co_filename).name}:{line}"
            for frame, line in traceback.walk_tb(error.__traceback__)
            if frame.f_globals.get("__name__", "").partition(".")[0] not in _LIBRARY_PACKAGES
        ]
        location = f" at {frames[-1]}" if frames else ""
        if isinstance(error, _TRACING_ERRORS):
            raise ParameterError(
                f"{subject}{location}: it cannot be compiled, as it branches on readings or other traced values, or makes "
                "NumPy's numbers of them; use jax.numpy, and jnp.where instead of if."
            ) from None
        hint, wrong = "", (str(error).strip().splitlines() or [""])[0].rstrip(".")[:200]
        if isinstance(error, AttributeError) and (
            isinstance(error.obj, Sensors) or hasattr(error.obj, "_fields")
        ):
            object_type: Any = type(error.obj)
            fields = (
                [field.name for field in dataclasses.fields(object_type)]
                if object_type is Sensors
                else list(object_type._fields)
            )
            verb = "are" if object_type is Sensors else "has"
            hint = f"{did_you_mean(str(error.name), fields)} {object_type.__name__} {verb} {', '.join(fields)}"
        raise ParameterError(
            f"{subject}{location}: {type(error).__name__}: {wrong}{hint}."
        ) from None


@functools.lru_cache(maxsize=32)
def _imported(source: str, path: str, content: bytes) -> ModuleType:
    MESSAGE_HANDLER.get()(f"the Python code of {one_line(path)} is run.")
    if not source.endswith(".py"):
        return importlib.import_module(source)
    name = f"nermo_mjx_own_{hashlib.sha256(path.encode() + content).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses look their module up
    exec(compile(content, path, "exec"), module.__dict__)
    return module


#: How a text names a controller.
CONTROLLER_FORM: Final = "FILE.py:NAME, MODULE:NAME or FILE.npz"
#: How a text names an object in a Python file or module.
OBJECT_FORM: Final = "FILE.py:NAME or MODULE:NAME"


def named_object(field: str, text: str, form: str = OBJECT_FORM) -> Source:
    """The file or module, and the object in it, that a text names; `field` begins messages, such as "rewards has".

    Raises:
        ParameterError: the text has another form.
    """
    source = Source.named(field, text, form)
    if not source.name:
        raise ParameterError(f"{source.subject}: expected {form}.")
    return source


def load_object(source: Source) -> Any:
    """The object; raises `ParameterError` if there is none, see `Source.module`."""
    module = source.module()
    value = getattr(module, source.name, None)
    if value is None:
        raise source.missing([name for name in vars(module) if not name.startswith("_")])
    return value


def load_controller(text: str) -> Any:
    """The controller that a text names; the same object as long as its file does not change.

    Args:
        text: `FILE.py:NAME` or `MODULE:NAME`, the name being that of a controller, or of a class or function that
            returns one when called without arguments; or `FILE.npz`, a policy from `nermo-mjx train`, and
            `FILE.npz:FILE.py` for one that observes something of one's own.

    Raises:
        ParameterError: the file, module or name does not exist, it cannot be imported, or it is not a controller.
    """
    if (data := data_of(text)) is not None:
        return pkgutil.resolve_name(DATA_CONTROLLERS[Path(data[0]).suffix])(*data)
    controller = load_object(named_object("controller is", text, CONTROLLER_FORM))
    if isinstance(controller, (type, FunctionType)):
        controller = _made(text, controller)
    check_form(controller)
    return controller


def controller_digest(text: str) -> str:
    """A hash of the controller's name, if it has one, and of the file that defines it; not of what that file imports.

    Raises:
        ParameterError: see `load_controller`.
    """
    if (data := data_of(text)) is not None:
        load_controller(text)
        return hashlib.sha256(read_bytes(Path(data[0]), MAX_ARRAY_BYTES)).hexdigest()[:16]
    source = named_object("controller is", text, CONTROLLER_FORM)
    return source.digest(source.name)


def data_of(text: str) -> tuple[str, str] | None:
    """The file of a text that names a controller that is data, and the code that the text gives it; None for code.

    >>> import nermo_mjx
    >>> data_of("policy.npz"), data_of("policy.npz:my.py"), data_of("my.py:walker")
    (('policy.npz', ''), ('policy.npz', 'my.py'), None)
    """
    for suffix in DATA_CONTROLLERS:
        path, end, code = text.partition(f"{suffix}:")
        if end or text.endswith(suffix):
            return path.removesuffix(suffix) + suffix, code
    return None


def check_form(controller: Any) -> None:
    """Reject objects that are not controllers, see `ControllerLike`.

    Raises:
        ParameterError: the message names what is missing, or what of it is wrong.
    """
    kind = type(controller).__name__
    with user_code(f"controller is of type {kind}, which fails"):
        missing = [name for name in REQUIRED_ATTRIBUTES if not hasattr(controller, name)]
        if missing:
            raise ParameterError(
                f"controller is of type {kind}, which has no {' and no '.join(missing)}: a controller has "
                f"{', '.join(REQUIRED_ATTRIBUTES)}."
            )
        dt, leaves = controller.dt, jax.tree.leaves(controller.parameters)
    if not isinstance(dt, (int, float, np.number)) or not 0.0 < dt < np.inf:
        raise ParameterError(
            f"controller has dt {dt!r}: expected the seconds of a tick, a finite number above 0."
        )
    for leaf in leaves:
        if np.asarray(leaf).dtype.kind not in "fiub":
            raise ParameterError(
                f"controller has parameters with {leaf!r}: expected a pytree of numbers, such as an object of a class "
                "under nermo_mjx.parameter_tree."
            )


def named_place(controller: Any, name: str) -> str:
    """A function of a controller and where it stands, for messages: `controller has update (bound.py:37)`."""
    return f"controller has {function_place(name, getattr(controller, name))}"


def function_place(name: str, function: Any) -> str:
    """The name of a function and where it stands, for messages: `yaw_shake (my_metrics.py:4)`."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return name if code is None else f"{name} ({Path(code.co_filename).name}:{code.co_firstlineno})"


@functools.lru_cache(maxsize=32)
def _made(text: str, maker: Any) -> Any:
    with user_code(f"controller is {text!r}: it cannot be made without arguments"):
        return maker()
