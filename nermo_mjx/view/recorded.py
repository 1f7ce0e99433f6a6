"""What is read from a recording for all of its displays: robot and motion, signals, stance, titles and figures."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final, TypeVar

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from nermo_mjx.plotting.shown import shown as in_shown_unit
from nermo_mjx.plotting.shown import titled
from nermo_mjx.recording import LOG_PREFIX, Recording, RecordingError
from nermo_mjx.robot import LIMBS, ModelParameters, Robot, RobotConfig, load_robot
from nermo_mjx.robot.assembly import assemble
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.meshes.body import redraw
from nermo_mjx.robot.model_parameters import Build, gravity_values
from nermo_mjx.robot.parameters import servos_by_count
from nermo_mjx.robot.quantity import quantities, replace_quantities, values_of
from nermo_mjx.robot.terrains import terrain_values

Tree = TypeVar("Tree")


def robot_of(recording: Recording) -> Robot:
    """The robot in its scene, built from the recording's setup; unnamed choices have their defaults.

    Raises:
        ParameterError: the setup names something that this version does not have.
        RecordingError: the robot's model has changed since.
    """
    from nermo_mjx.specs.walk import RecordedSetup  # importing JAX takes a second

    names = [field.name for field in dataclasses.fields(RobotConfig)]
    robot = load_robot(**RecordedSetup.choices(recording.metadata.get("setup") or {}, *names))
    recording.check_model(robot.model)
    return robot


def own_geometry(recording: Recording) -> Geometry | None:
    """The recorded robot's geometry if it differs from the published one."""
    return _own(recording, Geometry(), "geometry.")


def own_build(recording: Recording) -> Build | None:
    """How the recorded robot was built, if not as drawn."""
    return _own(recording, ModelParameters().build, "build.")


def _own(recording: Recording, published: Tree, group: str) -> Tree | None:
    parameters, defaults = recording.metadata.get("parameters") or {}, dict(values_of(published))
    group_values = {
        name.removeprefix(group): value for name, value in parameters.items() if value is not None
    }
    changed = {
        name: np.asarray(group_values[name], float)
        for name in defaults.keys() & group_values.keys()
    }
    if all(float(value) == float(defaults[name]) for name, value in changed.items()):
        return None
    return replace_quantities(published, changed)


def shown_spec(recording: Recording, robot: Robot) -> mujoco.MjSpec | None:
    """An editable specification for rendering, with the geometry and the build of the recorded robot; None if these
    are the published ones."""
    geometry, build = own_geometry(recording), own_build(recording)
    return (
        None
        if geometry is build is None
        else robot.spec_with_geometry(geometry or Geometry(), build)
    )


def shown_model(recording: Recording, robot: Robot) -> mujoco.MjModel:
    """The robot's whole model for rendering, compiled from `shown_spec`."""
    spec = shown_spec(recording, robot)
    return robot.model if spec is None else spec.compile()


def recorded_spec(recording: Recording, robot: Robot) -> mujoco.MjSpec:
    """An editable specification of the robot with all body parameters of the run."""
    names = {name for name, _ in quantities(ModelParameters)}
    recorded = recording.metadata.get("parameters") or {}
    values = mass_values(robot.config.robot) | gravity_values(robot.gravity)
    values |= {
        name: value for name, value in recorded.items() if name in names and value is not None
    }
    parameters = replace_quantities(ModelParameters(), values)
    spec = assemble(robot.config, parameters)
    redraw(spec, parameters.geometry)
    return spec


def recorded_model(recording: Recording, robot: Robot) -> mujoco.MjModel:
    """The robot's whole model with the masses, springs, dampers, servos, contacts and geometry of the run.

    Returns:
        `robot.model` itself if the recording's parameters do not change the body.
    """
    from nermo_mjx.physics.variation import compile_model  # importing JAX takes a second

    defaults = {name: declaration.default for name, declaration in quantities(ModelParameters)}
    defaults |= terrain_values(str(robot.config.scene))
    parameters = recording.metadata.get("parameters") or {}
    changed = {
        name: value
        for name, value in parameters.items()
        if name in defaults and value not in (None, defaults[name])
    }
    return compile_model(robot, changed) if changed else robot.model


#: Number of points drawn between the two ends of a tendon's wrap.
ARC_POINTS: Final = 5


@dataclasses.dataclass(frozen=True)
class Tendon:
    """A tendon over time.

    Attributes:
        name: in the model.
        radius: as it is drawn [m].
        path: points of its polygon in the world [m]; the last is repeated where a tendon has fewer.
        tension: [N], 0 where it is slack.
    """

    name: str
    radius: float
    path: Float[np.ndarray, "T K 3"]
    tension: Float[np.ndarray, " T"]


@dataclasses.dataclass(frozen=True)
class RecordedContact:
    """A contact point between two geoms over time.

    Attributes:
        limb: which of `LIMBS` it belongs to, or -1.
        point: in the world [m]; without a contact, that of the nearest time with one.
        force: on the robot, in the world [N]; 0 where there is no contact.
    """

    limb: int
    point: Float[np.ndarray, "T 3"]
    force: Float[np.ndarray, "T 3"]


@dataclasses.dataclass(frozen=True)
class Motion:
    """The drawn motion of a run.

    Attributes:
        time: of each sample [s].
        position, quaternion: of every body of the model, the world first, in the world [m], (w, x, y, z).
        tendons, contacts: see there.
    """

    time: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T nbody 3"]
    quaternion: Float[np.ndarray, "T nbody 4"]
    tendons: tuple[Tendon, ...]
    contacts: tuple[RecordedContact, ...]


def motion_of(
    recording: Recording,
    model: mujoco.MjModel,
    limit: int | None = None,
    data: mujoco.MjData | None = None,
) -> Motion:
    """Evaluate a model at a recording's samples, up to the first that is not finite.

    Args:
        recording: the run.
        model: that was simulated, with the run's parameters (`recorded_model`).
        limit: maximum number of samples; of a longer recording every second, third, ... one is kept.
        data: of the model, to be used again where the recording is known to fit it.

    Raises:
        RecordingError: it does not fit the model, or has no finite state.
    """
    if data is None:
        recording.check_model(model)
    samples = finite_samples(recording, limit)
    data = data or mujoco.MjData(model)
    position = np.empty((len(samples), model.nbody, 3))
    quaternion = np.empty((len(samples), model.nbody, 4))
    tension = np.zeros((len(samples), model.ntendon))
    paths: list[list[np.ndarray]] = [[] for _ in range(model.ntendon)]
    segments: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray]] = {}
    for i, sample in enumerate(samples):
        data.qpos[:], data.qvel[:] = recording.qpos[sample], recording.qvel[sample]
        data.ctrl[:] = np.nan_to_num(recording.ctrl[sample])
        mujoco.mj_forward(model, data)
        position[i], quaternion[i] = data.xpos, data.xquat
        limits = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
        np.add.at(tension[i], data.efc_id[limits], data.efc_force[limits])
        for k, path in enumerate(paths):
            path.append(_path(data, k))
        for key, point, force in _contacts(model, data):
            places, forces = segments.setdefault(
                key, (np.full((len(samples), 3), np.nan), np.zeros((len(samples), 3)))
            )
            places[i], forces[i] = point, force
    tendons = []
    for k, path in enumerate(paths):
        longest = max(map(len, path))
        points = np.stack(
            [
                np.pad(segment, ((0, longest - len(segment)), (0, 0)), mode="edge")
                for segment in path
            ]
        )
        tendons.append(
            Tendon(model.tendon(k).name, float(model.tendon_width[k]), points, tension[:, k])
        )
    contacts = []
    for key in sorted(segments):
        places, forces = segments[key]
        # The point of the previous contact, and before the first contact the first one's.
        finite_rows = np.flatnonzero(np.isfinite(places[:, 0]))
        nearest = finite_rows[
            np.maximum(np.searchsorted(finite_rows, np.arange(len(places)), side="right") - 1, 0)
        ]
        bodies = [model.body(model.geom_bodyid[geom]).name for geom in key[:2]]
        limb = next(
            (i for i, limb in enumerate(LIMBS) if any(body.startswith(limb) for body in bodies)), -1
        )
        contacts.append(RecordedContact(limb, places[nearest], forces))
    return Motion(
        recording.time[samples].astype(float), position, quaternion, tuple(tendons), tuple(contacts)
    )


def finite_samples(recording: Recording, limit: int | None = None) -> np.ndarray:
    """Indices of the shown samples: those before the first that is not finite, at most `most` of them."""
    count = finite_count(np.isfinite(np.concatenate([recording.qpos, recording.qvel], axis=1)))
    return np.arange(0, count, 1 if limit is None else -(-count // limit))


def finite_count(finite: Bool[np.ndarray, "T n"]) -> int:
    """Number of samples before the first with a value that is not finite; raises `RecordingError` if there is none."""
    count = int(finite.all(axis=1).argmin()) if not finite.all() else len(finite)
    if count == 0:
        raise RecordingError("The recording has no finite state to show.")
    return count


def _path(data: mujoco.MjData, tendon: int) -> Float[np.ndarray, "K 3"]:
    """The polygon of a tendon, with an arc around each pulley."""
    first = data.ten_wrapadr[tendon]
    along = slice(first, first + data.ten_wrapnum[tendon])
    points, geoms = data.wrap_xpos.reshape(-1, 3)[along], data.wrap_obj.reshape(-1)[along]
    parts = [points[:1]]
    for begin, end, geom, following in zip(
        points[:-1], points[1:], geoms[:-1], geoms[1:], strict=True
    ):
        if geom >= 0 and geom == following:
            parts.append(_arc(begin, end, data.geom_xpos[geom], data.geom_xmat[geom, 2::3]))
        parts.append(end[None])
    return np.concatenate(parts)


def _arc(
    begin: np.ndarray, end: np.ndarray, centre: np.ndarray, axis: np.ndarray
) -> Float[np.ndarray, "ARC 3"]:
    """Points between two on a cylinder, along the shorter arc, since wraps are shorter than half a turn."""
    u, v = begin - centre, end - centre
    height_u, height_v = u @ axis, v @ axis
    u, v = u - height_u * axis, v - height_v * axis
    angle = np.arctan2(np.dot(axis, _cross(u, v)), u @ v)
    share = np.linspace(0.0, 1.0, ARC_POINTS + 2)[1:-1, None]
    turned = np.cos(share * angle) * u + np.sin(share * angle) * _cross(axis, u)
    return centre + turned + (height_u + share * (height_v - height_u)) * axis


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`np.cross` of two vectors, without its large overhead."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _contacts(
    model: mujoco.MjModel, data: mujoco.MjData
) -> list[tuple[tuple[int, int, int], np.ndarray, np.ndarray]]:
    """((geom, geom, number), point, force on the robot) of each contact."""
    result: list[Any] = []
    counts: dict[tuple[int, int], int] = {}
    wrench = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        if contact.efc_address < 0:
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        first_geom, second_geom = int(contact.geom1), int(contact.geom2)
        number = counts[first_geom, second_geom] = counts.get((first_geom, second_geom), -1) + 1
        # MuJoCo's normal points from the first geom to the second, and the force acts on the second.
        sign = -1.0 if model.body_weldid[model.geom_bodyid[second_geom]] == 0 else 1.0
        result.append(
            (
                (first_geom, second_geom, number),
                contact.pos.copy(),
                sign * (contact.frame.reshape(3, 3).T @ wrench[:3]),
            )
        )
    return result


#: A foot is in stance above this load [N]; the robot weighs 2.65 N. The metrics' smooth threshold is centred on it.
STANCE_NEWTONS: Final = 0.02


def stretches(flags: Bool[np.ndarray, " T"]) -> Int[np.ndarray, "n 2"]:
    """The first sample of each stretch that is true, and the one after its last."""
    return np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0)).reshape(-1, 2)


def spans(
    flags: Bool[np.ndarray, " T"], time: Float[np.ndarray, " T"]
) -> list[tuple[float, float]]:
    """(begin, length) [s] of each stretch that is true; a sample stands for the time since the one before."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    begins = np.concatenate([time - step, [time[-1]]])
    return [(float(begins[a]), float(begins[b] - begins[a])) for a, b in stretches(flags)]


#: Colours of curves that are no limb's.
_ORDINALS: Final = ("first", "second", "third")


@dataclasses.dataclass(frozen=True)
class Curve:
    """One curve.

    Attributes:
        name: in the legend.
        colour: a name that the page's style knows: a limb's, `tail`, or `first`, `second`, `third`.
        values: over time, in the plot's unit.
        faint: whether it belongs to the previous line, with the same colour.
    """

    name: str
    colour: str
    values: Float[np.ndarray, " T"]
    faint: bool = False


@dataclasses.dataclass(frozen=True)
class Plot:
    """Curves over time with one axis; `bars` shows where values are above zero."""

    key: str
    title: str
    unit: str
    lines: tuple[Curve, ...]
    bars: bool = False


# Long because each plot of the page is one statement.
def plots_of(recording: Recording, motion: Motion) -> list[Plot]:
    """The plots of a run at the motion's samples; those whose sensors the recording lacks are left out."""
    samples, time = np.searchsorted(recording.time, motion.time), motion.time
    sensors = {name: np.asarray(values)[samples] for name, values in recording.sensors.items()}
    plots = []
    for plot in beside_log(recording):
        lines = tuple(dataclasses.replace(line, values=line.values[samples]) for line in plot.lines)
        plots.append(dataclasses.replace(plot, lines=lines))
    if "foot_force" in sensors:
        loads = [
            (limb.replace("_", " "), limb, force)
            for limb, force in zip(LIMBS, sensors["foot_force"].T, strict=True)
        ]
        if "tail_force" in sensors:
            loads.append(("tail", "tail", sensors["tail_force"]))
        stance = tuple(
            Curve(name, colour, (force > STANCE_NEWTONS).astype(float))
            for name, colour, force in loads
        )
        plots.append(Plot("stance", "Feet and tail on the ground", "", stance, bars=True))
        plots.append(
            Plot("force", "Force on feet and tail", "N", tuple(Curve(*load) for load in loads))
        )
    if {"position", "orientation"} <= sensors.keys():
        angles, position = attitude_of(sensors["orientation"]), 1e3 * sensors["position"]
        names = zip(("roll", "pitch", "yaw"), _ORDINALS, angles.T, strict=True)
        plots.append(
            Plot("attitude", "Attitude of the torso", "°", tuple(Curve(*curve) for curve in names))
        )
        if "linear_velocity" in sensors:
            yaw, velocity = np.deg2rad(angles[:, 2]), 1e3 * sensors["linear_velocity"]
            forward = velocity[:, 0] * np.sin(yaw) - velocity[:, 1] * np.cos(yaw)
            parameters = recording.metadata.get("parameters") or {}
            period = float(parameters.get("tracking.clock_ratio") or 1.0) / float(
                parameters.get("frequency") or 1.0
            )
            mean = Curve("over a cycle", "first", _over_cycle(forward, time, period))
            plots.append(
                Plot(
                    "speed",
                    "Forward speed",
                    "mm/s",
                    (mean, Curve("at once", "first", forward, faint=True)),
                )
            )
        path_curves = (
            Curve("forward", "first", -position[:, 1]),
            Curve("to the left", "second", position[:, 0]),
        )
        plots.append(Plot("place", "Position of the torso", "mm", path_curves))
    tensions: dict[str, list[Curve]] = {"leg": []}
    for tendon in motion.tendons:
        limb = next((limb for limb in LIMBS if tendon.name.startswith(limb)), "")
        part, _, limb_name = ("leg", "", limb) if limb else tendon.name.partition("_")
        curves = tensions.setdefault(part, [])
        if limb or len(curves) < len(_ORDINALS):
            curves.append(
                Curve(limb_name.replace("_", " "), limb or _ORDINALS[len(curves)], tendon.tension)
            )
    for part, curves in tensions.items():
        key = "knee_tension" if part == "leg" else f"{part}_tension"
        plots += [Plot(key, f"Tension, {part} tendons", "N", tuple(curves))] if curves else []
    if "servo_angle" in sensors:
        plots += _servos(np.rad2deg(sensors["servo_angle"]), np.rad2deg(recording.ctrl[samples]))
    return plots


def beside_log(recording: Recording) -> list[Plot]:
    """Each channel of a robot's log that a recording holds: measured (NaN in gaps) and simulated, with the RMS of their
    difference, and the lag of measured behind simulated."""
    plots = []
    for name, channel_fields in (_part(recording, "log").get("channels") or {}).items():
        if (values := recording.sensors.get(LOG_PREFIX + name)) is not None:
            unit = str(channel_fields.get("unit", ""))
            value_pair, rms = (
                in_shown_unit("", unit, values_row)
                for values_row in (np.asarray(values, float), channel_fields["rms"])
            )
            curves = zip(
                ("measured", "simulated"), ("second", "first"), value_pair.values.T, strict=True
            )
            title = f"{name}: lag {1e3 * channel_fields['lag']:.0f} ms, RMS {float(rms.values):.3g}"  # in the plot's unit
            plots.append(
                Plot(
                    f"log_{name}", title, value_pair.unit, tuple(Curve(*curve) for curve in curves)
                )
            )
    return plots


def _servos(angle: np.ndarray, command: np.ndarray) -> list[Plot]:
    """Measured and commanded angles, (T, n_servos) [degrees]."""
    names = servos_by_count(angle.shape[1])
    # Key, title, and the name and colour of each servo's curve.
    groups: list[tuple[str, str, dict[str, tuple[str, str]]]] = [
        (
            kind,
            f"{kind.capitalize()} servos",
            {f"{limb}_{kind}": (limb.replace("_", " "), limb) for limb in LIMBS},
        )
        for kind in ("hip", "knee")
    ]
    for key, title, single in (
        ("body_servos", "Body servos, + left", ("spine", "neck", "tail")),
        ("vertical_servos", "Vertical servos, + hip up, nose down", ("spine_vertical", "head")),
    ):
        coloured = zip(single, _ORDINALS, strict=False)
        groups.append(
            (key, title, {name: (name.replace("_", " "), colour) for name, colour in coloured})
        )
    plots = []
    for key, title, servos in groups:
        curves: list[Curve] = []
        for servo in [servo for servo in servos if servo in names]:
            (name, colour), i = servos[servo], names.index(servo)
            curves.append(Curve(name, colour, angle[:, i]))
            curves.append(Curve(f"{name}, commanded", colour, command[:, i], faint=True))
        plots += [Plot(key, title, "°", tuple(curves))] if curves else []
    return plots


def attitude_of(quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 3"]:
    """(roll, pitch, yaw) as in `kinematics.body`, in degrees, with unwrapped yaw; NumPy, to plot without JAX."""
    w, x, y, z = quaternion.T
    r01, r11 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    roll, pitch = np.arctan2(-r20, r22), np.arctan2(r21, np.hypot(r20, r22))
    return np.rad2deg(np.stack([roll, pitch, np.unwrap(np.arctan2(-r01, r11))], axis=1))


def _over_cycle(values: np.ndarray, time: np.ndarray, period: float) -> np.ndarray:
    """Mean over one gait cycle around each sample; NaN where the cycle is not whole."""
    if len(values) < 2:
        return np.full(len(values), np.nan)
    way = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(time))])
    begin, end = time - period / 2, time + period / 2
    mean = (np.interp(end, time, way) - np.interp(begin, time, way)) / period
    return np.where((begin >= time[0] - 1e-9) & (end <= time[-1] + 1e-9), mean, np.nan)


#: Metrics in the page's head, and their labels.
_HEADLINE: Final = {
    "speed": "speed",
    "roll_std": "roll σ",
    "pitch_std": "pitch σ",
    "slip": "slip",
    "cost_of_transport": "cost of transport",
    "electrical_cost_of_transport": "electrical cost",
}


def title_of(recording: Recording) -> str:
    """The gait, its frequency and the spine mode, as far as known; or the name of an experiment's case."""
    if "case" in recording.metadata:
        return str(recording.metadata["case"])
    if file := _part(recording, "log").get("file"):
        return f"Commands of {str(file).rpartition('/')[2]}"
    setup, parameters = _part(recording, "setup"), _part(recording, "parameters")
    gait = setup.get("gait")
    controller = str(setup.get("controller") or "Recording").rpartition(":")[2]
    controller = controller.rpartition("/")[2]  # of a policy's file, its name
    parts = [titled(str(gait)) if gait else controller]
    if (frequency := parameters.get("frequency")) is not None:
        parts.append(f"{frequency:.3g} Hz")
    spine = str(setup.get("spine", "none")).replace("_", " ")
    if spine != "none":
        parts.append(f"spine {spine}")
    rate = parameters.get("pilot.turn_rate")
    if setup.get("pilot") == "open_loop" and rate:
        parts.append(f"turn rate {rate:g}")
    return ", ".join(parts)


def headline_of(recording: Recording) -> list[list[str]]:
    """A few metrics as (label, value with unit), their profile, and the status if something went wrong."""
    metrics = _part(recording, "metrics")
    units = _units(recording)
    labelled = [(name, label) for name, label in _HEADLINE.items() if name in metrics]
    rows = [[label, _shown(metrics[name], units[name], digits=3)] for name, label in labelled]
    status = metrics.get("status", "ok")
    profile = (_part(recording, "setup") | _part(recording, "labels")).get("profile")
    rows += [["profile", str(profile)]] if rows and profile else []
    return [row for row in rows if row[1] != "–"] + (
        [["status", str(status)]] if status != "ok" else []
    )


def details_of(recording: Recording) -> list[dict[str, Any]]:
    """Tables `{"title", "rows": [[name, value with unit], ...]}` of all metadata of the recording."""
    tables = []
    for key, title in (
        ("labels", "Case"),
        ("metrics", "Metrics"),
        ("parameters", "Parameters"),
        ("setup", "Setup"),
        ("run", "Run"),
        ("versions", "Versions"),
    ):
        units = _units(recording) if key in ("metrics", "parameters") else {}
        rows = [
            [name, _shown(value, units.get(name, ""))]
            for name, value in _part(recording, key).items()
        ]
        rows = [row for row in rows if row[1] not in ("–", "")]
        if rows:
            tables.append({"title": title, "rows": rows})
    return tables


def _part(recording: Recording, key: str) -> dict[str, Any]:
    value = recording.metadata.get(key)
    return dict(value) if isinstance(value, dict) else {}


def _units(recording: Recording) -> dict[str, str]:
    """Units of metrics and parameters by name, including the recording's custom metrics."""
    from nermo_mjx.rollout.metric_table import METRICS, TRANSITION  # starts JAX
    from nermo_mjx.rollout.setup import WorldParameters

    units = {name: declaration.unit for name, declaration in quantities(WorldParameters)}
    return (
        units
        | {name: metric.unit for name, metric in (METRICS | TRANSITION).items()}
        | _part(recording, "units")
    )


def _shown(value: Any, unit: str, digits: int = 4) -> str:
    """A value as people read it: degrees and millimetres."""
    if value is None or isinstance(value, bool) or not isinstance(value, (int, float)):
        return (
            "–"
            if value is None
            else ("no", "yes")[value]
            if isinstance(value, bool)
            else str(value)
        )
    if not math.isfinite(value):
        return "–"
    quantity = in_shown_unit("", unit, value)
    name = quantity.unit.replace("deg", "°")
    text = f"{quantity.values:{'#' if digits == 3 else ''}.{digits}g}".rstrip(".")
    return f"{text}{'' if name == '°' else ' '}{name}".rstrip()
