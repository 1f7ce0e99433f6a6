"""The controller of one world, tick by tick, under commands that come while it runs.

A command is a `Switch` that begins when it comes. Commands whose blends overlap are added, each with its own length, so
feet and servos are continuous as in a schedule. The loop is the compiled one of engine `c`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from nermo_mjx.control.head_and_tail import GAZE, TAIL_MOTIONS
from nermo_mjx.control.protocol import ChecksParameters
from nermo_mjx.control.schedule import GAINS, MODES, MOST, Schedule, Switch, check_schedule, scheduled
from nermo_mjx.control.spine_modes import LATERAL_MODES, NO_MODE, SAGITTAL_MODES
from nermo_mjx.physics.c_engine import LANES, CEngine
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import choice, quantities, replace_quantities, values_of
from nermo_mjx.rollout import Run, Setup, Simulator
from nermo_mjx.rollout.loop import LoopParameters, LoopState
from nermo_mjx.rollout.setup import Window
from nermo_mjx.rollout.simulator import default_precision


class Running:
    """A controller that runs.

    >>> from nermo_mjx import Setup
    >>> running = Running(Setup(pilot="open_loop"), {"frequency": 0.8})
    >>> running.dt, running.steps_per_tick
    (0.01, 5)

    Attributes:
        setup: as given.
        simulator: its program, with every mode that a command can turn on.
        batch: start of the world, from which `body` is made, too.
        dt: between ticks [s].
        steps_per_tick: readings of the sensors between two ticks.
        known: parameters that a command can change, with their ranges.
        ticks: since the start.
        commands: since the start, each with the tick before which it came; with the same readings they make the run
            again bit for bit.
    """

    def __init__(self, setup: Setup, values: Mapping[str, Any] | None = None, *, all_modes: bool = True) -> None:
        """
        Args:
            setup: any. The switches of its schedule are commands that come at their times.
            values: parameter name -> number, as for `Simulator.run`.
            all_modes: whether commands can turn on every mode of the robot, or only those that the setup names. With
                more modes in the program its last digits may be others than those of a walk.

        Raises:
            ParameterError: see `Setup`, `Simulator`.
        """
        self.setup = setup
        own = dataclasses.replace(setup, schedule=())
        self.simulator = Simulator(_with_all_modes(own) if all_modes and setup.controller is None else own, "c")
        self.batch = self.simulator.prepare(values or {}, Run(duration=1.0))
        assert isinstance(self.simulator.engine, CEngine)
        self._engine, controller = self.simulator.engine, self.simulator.controller
        self.dt, self.steps_per_tick = float(controller.dt), self.simulator.loop.steps_per_tick
        self.known = dict(quantities(controller.parameters))
        whole = Window(begin=0.0, end=1e6, distance=1e6)
        endless = jax.tree.map(np.full_like, self.batch.params.window, whole)
        self._params = dataclasses.replace(self.batch.params, window=endless, schedule=None)
        self._scheduled = jax.jit(scheduled)
        self._loop: Any = None
        # That have not ended: tick at which each began, how long it takes [s], and by how much values change.
        self._blends: list[tuple[int, float, dict[str, float]]] = []
        self.ticks, self.commands = 0, list[tuple[int, Switch]]()
        self._control: Any = self._params.control

    def reset(self, sensordata: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n_servos"]:
        """Start anew, with the parameters of the setup.

        Args:
            sensordata: of the body at rest.

        Returns:
            Servo angles of the start pose [rad].
        """
        rest = np.asarray(sensordata, float)
        if self._loop is None:
            # All programs are compiled now: by a command that changes nothing, and the tick after it.
            self._loop = self._engine.packed(self._lanes(), np.tile(rest, (LANES, 1)))
            self._start(rest)
            for name, value in itertools.islice(values_of(self._control), 1):
                self.command(Switch(0.0, values={name: np.asarray(value).item()}))
            self.tick(np.tile(rest, (self.steps_per_tick, 1)))
        self._start(rest)
        self._due = sorted(self.setup.schedule, key=lambda switch: switch.at)
        return np.asarray(self.state.ctrl)

    def _start(self, rest: np.ndarray) -> None:
        start = Switch(0.0, spine=self.setup.spine, head=self.setup.head, tail_motion=self.setup.tail_motion)
        # Parameters as commanded, those of modes that do not act among them, and the modes that do.
        self._commanded = self._params.control, {field: set(names) for field, names in start.modes.items()}
        self._control = self._aim = self._acting(*self._commanded)
        self._base, self._blends, self._due = dict(_numbers(self._aim)), [], []
        self.ticks, self.commands = 0, []
        self._row = self._loop.pack(self._lanes())
        self._state = self._loop.init(self._row, np.tile(rest, (LANES, 1)))

    def command(self, switch: Switch) -> None:
        """Begin to change what a switch names; its `at` does not count.

        It takes `blend` gait cycles of this moment's frequency, and is added to what earlier commands still change.

        Raises:
            ParameterError: an unknown parameter, a value out of range, a mode that is not there, a stride outside the
                legs' workspace, or a limb that would go backward; nothing has changed then.
        """
        values, (commanded, modes) = switch.absolute(), self._commanded
        for name, value in values.items():
            self.known[choice("parameter", name, self.known)].check(name, value)
        dict(quantities(Schedule))["blend.1"].check("blend", switch.blend)
        for field, names in switch.modes.items():
            for mode in names:
                choice(field, mode, self.simulator.setup.modes[field] or (NO_MODE,))
        commanded = replace_quantities(commanded, {name: np.array([value]) for name, value in values.items()})
        modes = modes | {field: set(names) for field, names in switch.modes.items()}
        aim = default_precision(self._acting(commanded, modes))
        if isinstance(self.simulator.controller, ChecksParameters):
            self.simulator.controller.check(aim)
        old, new = (dict(_numbers(tree)) for tree in (self._aim, aim))
        moves = {name: new[name] - old[name] for name in new if new[name] != old[name]}
        moves |= {name: move - round(move) for name, move in moves.items() if name.startswith("offset.")}
        self._check_blend(switch.blend, moves)
        self._commanded, self._aim = (commanded, modes), aim
        self._blends.append((self.ticks, switch.blend / self.cycle_rate, moves))
        self._prepare()
        self.commands.append((self.ticks, switch))

    def tick(self, sensordata: Float[np.ndarray, "steps n"]) -> Float[np.ndarray, " n_servos"]:
        """Servo angles for the next tick [rad], from the readings of the last; at the start, of the body at rest."""
        while self._due and self._due[0].at <= self.ticks * self.dt + 1e-9:
            self.command(self._due.pop(0))
        if self._blends:
            for blend in [each for each in self._blends if (self.ticks - each[0]) * self.dt >= each[1]]:
                self._blends.remove(blend)
                self._base |= {name: self._base[name] + move for name, move in blend[2].items()}
                self._prepare()
            self._control = self._aim
            if self._blends:
                at = np.zeros(MOST)
                at[: len(self._blends)] = [(began - self.ticks) * self.dt for began, _, _ in self._blends]
                schedule = default_precision(dataclasses.replace(self._schedule, at=at))
                self._control = self._scheduled(self._aim, schedule, 0.0, np.ones(1))
            else:
                self._base = dict(_numbers(self._aim))
            self._row = self._loop.pack(self._lanes())
        lanes = np.tile(np.asarray(sensordata, float), (LANES, 1, 1))
        self._state, ctrl = self._loop.step(self._loop.once, self._row, self._state, lanes)
        self.ticks += 1
        return np.asarray(ctrl)[0]

    def _prepare(self) -> None:
        """The blends as a schedule, whose times are seconds since they began."""
        unused = MOST - len(self._blends)
        value = {}
        for name, first in self._base.items():
            steps = [moves.get(name, 0.0) for _, _, moves in self._blends] + [0.0] * unused
            value[name] = np.add(first, [[0.0, *np.cumsum(steps)]])
        seconds = np.array([seconds for _, seconds, _ in self._blends] + [1.0] * unused)
        self._schedule = Schedule(blend=seconds, share={name: np.zeros((1, MOST + 1)) for name in value}, value=value)

    def _check_blend(self, blend: float, moves: dict[str, float]) -> None:
        """Reject a blend [cycles] by which a limb would go backward, alone or beside those that have not ended."""
        if len(self._blends) == MOST:
            raise ParameterError(f"{MOST} commands are still being blended: wait until one has ended.")
        now, rate = dict(_numbers(self._control)), self.cycle_rate
        beside = dict(moves)
        for _, seconds, others in self._blends:
            for name, move in others.items():
                if name != "frequency":
                    beside[name] = beside.get(name, 0.0) + move * blend / rate / seconds
        for alone, each in ((True, moves), (False, beside)):
            value = {name: np.array([[now[name]] + [now[name] + move] * MOST]) for name, move in each.items()}
            still = {name: np.zeros((1, MOST + 1)) for name in value}
            try:
                check_schedule(
                    self._control, Schedule(at=np.zeros(MOST), blend=np.full(MOST, blend), share=still, value=value), 1,
                    np.array([rate]),
                )  # fmt: skip
            except ParameterError as error:
                why = str(error).replace("schedule.blend.1", "blend")
                raise ParameterError(
                    why if alone else "beside the change before, a limb would go backward: wait until that has ended."
                ) from None

    @property
    def state(self) -> LoopState:
        """Of the controller and the metrics, leaves without a world axis."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], self._loop.unpack(self._state))

    @property
    def control(self) -> Any:
        """The controller's parameters of this moment, leaves (1, ...)."""
        return self._control

    @property
    def cycle_rate(self) -> float:
        """Gait cycles per second of this moment [1/s]."""
        return float(np.ravel(self.simulator.controller.cycle_rate(self._control))[0])

    @property
    def modes(self) -> dict[str, set[str]]:
        """Those that act, by the choice that makes them."""
        return self._commanded[1]

    def value(self, name: str) -> float | None:
        """A parameter as commanded; None for one that the controller does not have."""
        found = dict(values_of(self._commanded[0])).get(name)
        return None if found is None else float(np.asarray(found).item())

    def _acting(self, control: Any, modes: Mapping[str, set[str]]) -> Any:
        """The parameters with gains of 0 for the modes that do not act."""
        there = self.simulator.setup.modes
        off = {gain for field in MODES for name in set(there[field]) - modes[field] for gain in GAINS[name]}
        return replace_quantities(control, dict.fromkeys(off, np.zeros(1)))

    def _lanes(self) -> LoopParameters:
        params = dataclasses.replace(self._params, control=self._control)
        return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf), LANES, 0), params)


def _numbers(tree: Any) -> Iterator[tuple[str, float]]:
    """The parameters of one world by name; leaves (1, ...)."""
    return ((name, float(np.asarray(value)[0])) for name, value in values_of(tree))


def _with_all_modes(setup: Setup) -> Setup:
    """The setup with every mode of the robot, those that do not act turned on after its end."""
    spine = LATERAL_MODES + (SAGITTAL_MODES if setup.robot == "nermo_41" else ())
    on: list[dict[str, Any]] = [{"spine": "+".join(spine), "head": GAZE}]
    on += [{"tail_motion": name} for name in TAIL_MOTIONS if setup.tail != "rigid" and name != NO_MODE]
    later = tuple(Switch(1e5 * (k + 1), **one) for k, one in enumerate(on))
    return dataclasses.replace(setup, schedule=later)
