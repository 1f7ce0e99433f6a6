"""The balance experiment: each leg lifted and swung, with and without spine balance compensation (SBC).

All cases, profiles and repeats are one batch. Published: without SBC the front legs pass and the rear legs fail; with
it all four pass, and it reduces the resting pitch by 30 % (front legs) and 73 % (rear legs).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import jax
import mujoco
import numpy as np

from nermo_mjx.control.parameters import ControlParameters, Spine
from nermo_mjx.control.published import PUBLISHED_CLOCK_RATIO
from nermo_mjx.experiments.balance import measures
from nermo_mjx.experiments.balance.protocol import (
    DURATION,
    PHASES,
    ROUTING,
    STANCE,
    BalanceLoop,
    BalanceParameters,
)  # fmt: skip
from nermo_mjx.experiments.balance.start import Nudge, nudge, start_pose
from nermo_mjx.experiments.outcome import BODY, Column, Outcome
from nermo_mjx.experiments.settings import Settings, body_count
from nermo_mjx.experiments.theory import stability
from nermo_mjx.kinematics.leg import forward, four_legs
from nermo_mjx.kinematics.spine import joint_angle
from nermo_mjx.physics import Engine, Trace, Variation, make_engine
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.recording import Recording, recording_of
from nermo_mjx.robot import LIMBS, ModelParameters, Robot, load_robot
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.nearest import choice
from nermo_mjx.robot.quantity import check_quantities, quantities, replace_quantities
from nermo_mjx.rollout.result import History
from nermo_mjx.rollout.simulator import BLOCK

NAME: Final = "balance"
SCENE: Final = "balance_stand"
#: Parameters of the controller that apply here; those of the body come from `ModelParameters`. The protocol is written
#: for the published geometry.
SPINE_NAMES: Final = ("spine.max_servo_angle", "spine.balance_lift", "spine.offset_compensation")
#: Parameters that may be set for all worlds.
SETTABLE: Final = frozenset(SPINE_NAMES) | {
    name for name, _ in quantities(ModelParameters) if not name.startswith("geometry.")
}
#: The published offset compensation (5.31) is on; the text of the balance test does not specify it. Without it the bent
#: robot rests on either side of its diagonal, depending on the speed of the bend: see `BalanceLoop.servos`.
OFFSET_COMPENSATION: Final = 1.0

CASE_COLUMNS: Final = {
    "profile": Column("1", "exact or as_published"),
    "leg": Column("1", "the lifted leg"),
    "sbc": Column("1", "with spine balance compensation"),
    "repeat": Column("1", "number of the repeat; each starts a little differently"),
}
_BODY_COLUMN: Final = {BODY: Column("1", "number of the identified body")}
THEORY_COLUMN: Final = {
    "theory_margin": Column("m", "(5.34, 5.35): distance of the centre of mass from the diagonal, positive inside")
}


@dataclasses.dataclass(frozen=True)
class Lift:
    """One world: profile, lifted limb (index in `LIMBS`), SBC or not, number of the repeat and of the body.

    The body is 0 if there is only one.
    """

    profile: str
    limb: int
    sbc: bool
    repeat: int
    body: int = 0

    @property
    def name(self) -> str:
        """Name of its recording."""
        return f"balance {LIMBS[self.limb]}" + (" sbc" if self.sbc else "")

    @property
    def clock_ratio(self) -> float:
        """Simulated seconds per second of the protocol."""
        return PUBLISHED_CLOCK_RATIO if self.profile == "as_published" else 1.0

    def columns(self) -> dict[str, Any]:
        """Its cells in `CASE_COLUMNS`."""
        body = {BODY: self.body} if self.body else {}
        return {"profile": self.profile, **body, "leg": LIMBS[self.limb], "sbc": self.sbc, "repeat": self.repeat}

    def nudge(self, seed: int) -> Nudge:
        """The perturbation of its start; the same in both profiles."""
        return nudge(seed, 2 * self.limb + self.sbc, self.repeat)


def run(settings: Settings, scene: str = SCENE) -> Outcome:
    """Run the balance experiment.

    Args:
        settings: of the profile `as_published` only the clock applies (see `protocol`); quick: one repeat; values:
            body parameters such as `contact.friction`, and `SPINE_NAMES`.
        scene: see `RobotConfig`.

    Raises:
        ParameterError: a parameter that does not apply here.
    """
    cases, values, bodies = list(_cases(settings)), settings.values, settings.bodies
    which = np.array([case.body - 1 for case in cases])
    everything = {**values} | {name: np.asarray(of, float)[which] for name, of in (bodies or {}).items()}
    model_parameters, spine = _parameters(everything)
    robot = load_robot(scene=scene)
    loop = BalanceLoop(robot)
    runner = make_engine(settings.engine, robot, loop)
    starts = [case.nudge(settings.seed) for case in cases]
    params = _batch(cases, starts, spine, np.broadcast_to(model_parameters.servo.top_speed, len(cases)))
    qpos = np.stack([start_pose(robot, start) for start in starts])
    fields = Variation(robot).batch(model_parameters, len(cases), everything)
    ticks = [round(DURATION * case.clock_ratio / loop.dt) for case in cases]
    margins = _theory(loop, params, len(cases))
    history = _simulate(runner, loop, params, qpos, fields, max(ticks), settings.progress)

    models = [compile_model(robot, body) for body in _measured_bodies(values, bodies)]
    rows, recordings = [], {}
    for i, (case, length) in enumerate(zip(cases, ticks, strict=True)):
        row, recording = _evaluate(case, _one(history, i, length), robot, models[max(case.body - 1, 0) % len(models)])
        rows.append(row | {"theory_margin": margins[i]})
        if case.repeat == case.body == 0 and case.profile == cases[0].profile:
            about = {"engine": runner.name, "parameters": {name: float(value) for name, value in values.items()}}
            recordings[case.name] = dataclasses.replace(recording, metadata={**recording.metadata, **about})
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    known = CASE_COLUMNS | _BODY_COLUMN | measures.ABOUT | THEORY_COLUMN
    return Outcome(NAME, columns, {name: known[name] for name in columns}, recordings)


def _measured_bodies(values: Mapping[str, float], bodies: Mapping[str, np.ndarray] | None) -> list[dict[str, float]]:
    """Body parameters of the models whose centre of mass is measured: one for all, or one per body if masses differ."""
    common = {name: value for name, value in values.items() if name not in SPINE_NAMES}
    masses = {name: of for name, of in (bodies or {}).items() if name.startswith("mass.")}
    if not masses:
        return [common]
    return [common | {name: float(of[i]) for name, of in masses.items()} for i in range(body_count(masses))]


def _theory(loop: BalanceLoop, params: BalanceParameters, worlds: int) -> list[float]:
    """Margin of each world by (5.34, 5.35), in the commanded posture [m]."""

    @jax.jit
    def posture(params: BalanceParameters) -> tuple[jax.Array, jax.Array]:
        """Feet in the stance, and the angle of each world's spine joints."""
        bends = joint_angle(jax.vmap(loop.spine_servo)(params), Geometry())
        return forward(four_legs(Geometry()), STANCE, ROUTING).foot, bends

    feet, bends = (np.asarray(each) for each in posture(params))
    limbs = np.argmax(np.asarray(params.lifted), axis=1)
    return [stability(loop.robot.mass_model, feet, limbs[i], float(bends[i])) for i in range(worlds)]


def _cases(settings: Settings) -> Iterator[Lift]:
    """All worlds; the profile `exact` first, whose runs are recorded."""
    numbers = range(1, body_count(settings.bodies) + 1) or (0,)
    repeats = range(1 if settings.quick else settings.repeats)
    for body, profile, limb, sbc, repeat in itertools.product(
        numbers, settings.profiles, range(4), (False, True), repeats
    ):
        yield Lift(profile, limb, sbc, repeat, body)


def _parameters(values: Mapping[str, Any]) -> tuple[ModelParameters, Spine]:
    """Checked parameters of the body, and of the spine's controller; each is a number, or has one value per world."""
    for name in values:
        choice("values", name, sorted(SETTABLE))
    given = {name: np.asarray(value, float) for name, value in values.items()}
    model = replace_quantities(ModelParameters(), {name: given[name] for name in given if name not in SPINE_NAMES})
    spine = {"offset_compensation": np.asarray(OFFSET_COMPENSATION)}
    spine |= {name.split(".")[1]: given[name] for name in SPINE_NAMES if name in given}
    controller = replace_quantities(ControlParameters().spine, spine)
    check_quantities(model)
    check_quantities(controller, "spine.")
    return model, controller


def _batch(cases: Sequence[Lift], starts: Sequence[Nudge], spine: Spine, servo_speed: np.ndarray) -> BalanceParameters:
    """Parameters of all worlds, every leaf with a leading axis, in JAX's default precision."""
    values, harmonics = dataclasses.replace(spine, harmonics=0.0), np.asarray(spine.harmonics)
    spines = [
        dataclasses.replace(
            jax.tree.map(lambda leaf, i=i: np.broadcast_to(leaf, len(cases))[i], values), harmonics=harmonics
        )
        for i in range(len(cases))
    ]
    worlds = [
        BalanceParameters(np.eye(4)[case.limb], float(case.sbc), case.clock_ratio, each, start.servo, float(speed))
        for case, start, each, speed in zip(cases, starts, spines, servo_speed, strict=True)
    ]
    real = jax.dtypes.canonicalize_dtype(float)
    return jax.tree.map(lambda *leaves: np.stack(leaves).astype(real), *worlds)


def _simulate(
    engine: Engine,
    loop: BalanceLoop,
    params: BalanceParameters,
    qpos: np.ndarray,
    fields: dict[str, np.ndarray],
    ticks: int,
    progress: Callable[[float], None] | None,
) -> History:
    """Run all worlds, and record every tick."""
    session = engine.open(params, qpos, fields)
    blocks: list[Trace] = []
    # Whole blocks only: a recorded block of another length would need another program.
    for done in range(0, ticks, BLOCK):
        blocks.append(session.record(BLOCK))
        if progress:
            progress(min(1.0, (done + BLOCK) / ticks))
    qpos, qvel, ctrl, data = (
        np.concatenate([np.asarray(getattr(block, name), float) for block in blocks], axis=1)[:, :ticks]
        for name in ("qpos", "qvel", "ctrl", "sensordata")
    )
    sensors = loop.robot.sensors(data)
    named = {field.name: np.asarray(getattr(sensors, field.name)) for field in dataclasses.fields(sensors)}
    return History((1 + np.arange(ticks)) * loop.dt, qpos, qvel, ctrl, named)


def _one(history: History, world: int, ticks: int) -> History:
    """The first ticks of one world; its axis stays, with length 1."""
    one = slice(world, world + 1)
    qpos, qvel, ctrl = (values[one, :ticks] for values in (history.qpos, history.qvel, history.ctrl))
    return History(history.time[:ticks], qpos, qvel, ctrl, {k: v[one, :ticks] for k, v in history.sensors.items()})


def _evaluate(case: Lift, world: History, robot: Robot, model: mujoco.MjModel) -> tuple[dict[str, Any], Recording]:
    """A world's row of the table, and its recording.

    The recording also holds `measures.readings` as sensors, and in its metadata `phases`: begin and end of each phase
    in its own, simulated time [s].
    """
    sensors = {name: reading[0] for name, reading in world.sensors.items()}
    shown = measures.readings(case.limb, model, world.qpos[0], sensors)
    sole = float(model.geom(f"{LIMBS[0]}_sole").size[0])
    measured = measures.measure(case.limb, world.time / case.clock_ratio, sensors, shown, sole)
    row = case.columns() | measured
    ratio = case.clock_ratio
    metadata = {
        "experiment": "balance",
        "case": case.name,
        "setup": dataclasses.asdict(robot.config),
        "metrics": {name: value if isinstance(value, str) else float(value) for name, value in row.items()},
        "phases": {name: [phase.begin * ratio, phase.end * ratio] for name, phase in PHASES.items()},
    }
    shown = {name: reading[None] for name, reading in shown.items()}
    full = dataclasses.replace(world, sensors=world.sensors | shown)
    return row, recording_of(full, robot.model, metadata=metadata)
