"""Proposal of the next experiment: the chirp, step sequence or walk that would narrow the posterior most."""

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

#: Duration of a proposed experiment [s], and the rate of its commands [Hz].
EXPERIMENT_SECONDS: Final = 6.0
PROPOSAL_RATE_HZ: Final = 50.0
#: Times of the commands of a proposed experiment [s].
COMMAND_TIMES: Final = np.arange(round(EXPERIMENT_SECONDS * PROPOSAL_RATE_HZ)) / PROPOSAL_RATE_HZ
#: An experiment is proposed if at most this share of the deviation of the least determined direction remains.
MAX_REMAINING_SHARE: Final = 0.9
#: Amplitude of a chirp [rad], and its lowest and highest frequency [Hz].
CHIRP_AMPLITUDE_RAD: Final = 0.2
CHIRP_FREQUENCIES_HZ: Final = (0.2, 4.0)


def _make_excitations(identification: Identification) -> dict[str, dict[str, np.ndarray]]:
    """The candidates: name of an experiment -> servo -> commands at `COMMAND_TIMES`."""
    body, log = identification.body, identification.after.twin.logs[0]
    names = [channel.of for channel in log.channels if channel.quantity == "command"]
    still_commands = {name: np.asarray(log.channel("command", name).values) for name in names}  # type: ignore[union-attr]
    envelope = np.clip(COMMAND_TIMES / 0.5, 0.0, 1.0) * np.clip(
        (EXPERIMENT_SECONDS - COMMAND_TIMES) / 0.5, 0.0, 1.0
    )
    middle = {name: float(np.median(values)) for name, values in still_commands.items()}

    def chirp(
        servos: Sequence[str], factor: float = 1.0, wave: Any = np.sin
    ) -> dict[str, np.ndarray]:
        """Commands of a chirp of some servos with different phases; the other servos keep their positions."""
        turned = (
            2
            * np.pi
            * factor
            * (
                CHIRP_FREQUENCIES_HZ[0] * COMMAND_TIMES
                + (CHIRP_FREQUENCIES_HZ[1] - CHIRP_FREQUENCIES_HZ[0])
                * COMMAND_TIMES**2
                / (2 * EXPERIMENT_SECONDS)
            )
        )
        commands = {name: np.full(len(COMMAND_TIMES), middle[name]) for name in names}
        for i, name in enumerate(servos):
            limits = body.model.actuator_ctrlrange[body.actuator(name)]
            swing = middle[name] + CHIRP_AMPLITUDE_RAD * envelope * wave(turned + 2.4 * i)
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
        name: np.interp(COMMAND_TIMES, log.channel("command", name).times, values)  # type: ignore[union-attr]
        for name, values in still_commands.items()
    }
    if isinstance(body, NermoBody):  # a walk at 1 Hz, as in the table of `servos`
        table = servo_table(
            Setup(robot=body.robot),
            {"frequency": 1.0},
            rate=PROPOSAL_RATE_HZ,
            cycles=round(EXPERIMENT_SECONDS),
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


def propose_experiment(identification: Identification) -> tuple[str, float, dict[str, np.ndarray]]:
    """Find the experiment that reduces the deviation along the least determined direction most.

    Returns:
        Name of the experiment, the remaining share of the deviation, and the commands at `COMMAND_TIMES`.
    """
    fit, best = identification.fit, ("", 1.0, dict[str, np.ndarray]())
    log = identification.after.twin.logs[0]
    for name, commands in _make_excitations(identification).items():
        channels = [
            Channel(n, "command", n, COMMAND_TIMES, values) for n, values in commands.items()
        ]
        for channel in log.channels:
            if channel.name in identification.fitted.twin.labels:
                sample_times = np.arange(0.0, EXPERIMENT_SECONDS, max(channel.interval, 1e-3))
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
        contributions = determinacy.compute_remaining_share(
            tried.jacobian(fit.x, fit.sigma[order]), fit
        )
        if contributions < best[1]:
            best = (name, contributions, commands)
    return best
