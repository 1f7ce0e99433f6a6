"""The experiment to measure next: the one, among chirps, steps and a walk, that would narrow the posterior most."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from nermo_mjx.hardware.log import Channel, Log
from nermo_mjx.hardware.table import servo_table
from nermo_mjx.identify import determinacy
from nermo_mjx.identify.body import NermoBody
from nermo_mjx.identify.estimation import Estimation
from nermo_mjx.identify.identification import Identification
from nermo_mjx.identify.twin import LoggedTwin
from nermo_mjx.rollout import Setup

#: Duration of an experiment that is proposed, and its rate of commands [s, Hz].
LASTS: Final = 6.0
PROPOSAL_RATE_HZ: Final = 50.0
#: Times of its commands [s].
TIMES: Final = np.arange(round(LASTS * PROPOSAL_RATE_HZ)) / PROPOSAL_RATE_HZ
#: An experiment that leaves more of the least known direction is not worth its time.
USEFUL: Final = 0.9
#: Amplitude and range of frequencies of a chirp [rad, Hz].
SWING: Final = 0.2
SWEPT: Final = (0.2, 4.0)


def _excitations(identification: Identification) -> dict[str, dict[str, np.ndarray]]:
    """Experiments by name: commands of each servo at `RATE`."""
    body, log = identification.body, identification.after.twin.logs[0]
    names = [channel.of for channel in log.channels if channel.quantity == "command"]
    still_commands = {name: np.asarray(log.channel("command", name).values) for name in names}  # type: ignore[union-attr]
    envelope = np.clip(TIMES / 0.5, 0.0, 1.0) * np.clip((LASTS - TIMES) / 0.5, 0.0, 1.0)
    middle = {name: float(np.median(values)) for name, values in still_commands.items()}

    def chirp(
        servos: Sequence[str], factor: float = 1.0, wave: Any = np.sin
    ) -> dict[str, np.ndarray]:
        """Of these servos, one after the other in phase; the others stand."""
        turned = (
            2 * np.pi * factor * (SWEPT[0] * TIMES + (SWEPT[1] - SWEPT[0]) * TIMES**2 / (2 * LASTS))
        )
        commands = {name: np.full(len(TIMES), middle[name]) for name in names}
        for i, name in enumerate(servos):
            limits = body.model.actuator_ctrlrange[body.actuator(name)]
            swing = middle[name] + SWING * envelope * wave(turned + 2.4 * i)
            commands[name] = np.clip(swing, *limits) if limits[1] > limits[0] else swing
        return commands

    worst = np.abs(identification.fit.directions[:, int(np.argmax(identification.fit.share))])
    parts = [
        identification.fit.space.parameters[int(i)].name.split(".")[-1]
        for i in np.argsort(-worst)[:3]
    ]
    near = [
        name for name in names if any(part in (name, f"{name}_servo") for part in parts)
    ] or names[:2]
    excitations = {f"chirp of {name}": chirp([name]) for name in near[:3]}
    repeated_log = {
        name: np.interp(TIMES, log.channel("command", name).times, values)  # type: ignore[union-attr]
        for name, values in still_commands.items()
    }
    if isinstance(body, NermoBody):  # a walk at 1 Hz, as `servos` plays it
        table = servo_table(
            Setup(robot=body.robot), {"frequency": 1.0}, rate=PROPOSAL_RATE_HZ, cycles=round(LASTS)
        )
        angles = dict(zip(table.names, np.radians(table.angles.T), strict=True))
        excitations["a walk"] = {
            name: middle[name] + envelope * (angles[name] - middle[name]) for name in names
        }
    return excitations | {
        "slow chirp of all servos": chirp(names, 0.25),
        "steps of all servos, which push the robot": chirp(
            names, 0.25, lambda phase: np.sign(np.sin(phase))
        ),
        "chirp of all servos": chirp(names),
        "the same commands again": repeated_log,
    }


def next_experiment(identification: Identification) -> tuple[str, float, dict[str, np.ndarray]]:
    """The experiment that shrinks the least known direction most.

    Returns:
        Its name, the share of the direction's deviation that is left after it, and its commands at `RATE`.
    """
    fit, best = identification.fit, ("", 1.0, dict[str, np.ndarray]())
    log = identification.after.twin.logs[0]
    for name, commands in _excitations(identification).items():
        channels = [Channel(n, "command", n, TIMES, values) for n, values in commands.items()]
        for channel in log.channels:
            if channel.name in identification.fitted.twin.labels:
                sample_times = np.arange(0.0, LASTS, max(channel.interval, 1e-3))
                channels.append(
                    dataclasses.replace(
                        channel,
                        times=sample_times,
                        values=np.zeros((len(sample_times), *channel.values.shape[1:])),
                    )
                )
        names = [channel.name for channel in fit.space.parameters]
        twin = LoggedTwin(identification.body, [Log(tuple(channels), name)], names)
        tried = Estimation(fit.space, twin)
        order = [identification.fitted.twin.labels.index(label) for label in twin.labels]
        contributions = determinacy.contribution(tried.jacobian(fit.x, fit.sigma[order]), fit)
        if contributions < best[1]:
            best = (name, contributions, commands)
    return best
