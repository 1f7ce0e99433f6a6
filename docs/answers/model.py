"""Numbers and tables of docs/model.md on lengths, servos, cost and soles, as JSON.

    python docs/answers/model.py DIR   # of the directories of `sweeps/geometry.yaml` and `sweeps/spine_gain.yaml`

Walks outside the sweeps are trots in the profile `exact`, without a pilot, of eight cycles after two.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nermo_mjx import Run, Setup, Simulator
from nermo_mjx.rollout.run import START_SPREAD
from nermo_mjx.sweep import read_table

FREQUENCIES, AMPLITUDES, STARTS = (0.5, 0.67, 0.8), (0.0, 0.2, 0.4), 8
#: The servos' fall of torque with speed is in the data sheet's no-load speed, and by default in these dampings.
BACK_EMF = {"servo.back_emf": 0.4, "damping.hip": 0.0, "damping.pulley": 0.0}
SERVOS = {
    "default": {},
    "back-EMF 0.4, dampings 0": BACK_EMF,
    "the same at 4.8 V": {"servo.supply_voltage": 4.8} | BACK_EMF,
    "dead band 0.5°": {"servo.dead_band": np.radians(0.5)},
    "dead band 2°": {"servo.dead_band": np.radians(2.0)},
    "backlash 4°": {"servo.backlash": np.radians(4.0)},
}
STIFF = {
    "geometry.foot.radius": 0.002,
    "contact.time_constant": 0.008,
    "contact.damping_ratio": 2.0,
    "contact.width": 0.0005,
}
COST, ELECTRICAL = "cost_of_transport", "electrical_cost_of_transport"


def trots(values: Mapping[str, Any] | None = None, starts: int = 1) -> dict[str, np.ndarray]:
    """Metrics (frequencies, amplitudes), means over the starts."""
    shape = (len(FREQUENCIES), len(AMPLITUDES), starts)
    frequency, amplitude, start = (
        each.ravel()
        for each in np.meshgrid(FREQUENCIES, AMPLITUDES, np.arange(starts), indexing="ij")
    )
    rng = np.random.default_rng(0)
    drawn = {
        name: rng.uniform(-spread, spread, starts)[start] * (start > 0)
        for name, spread in START_SPREAD.items()
    }
    simulator = Simulator(
        Setup(gait="trot", spine="stride_extension", pilot="open_loop"), engine="c"
    )
    result = simulator.run(
        {"frequency": frequency, "spine.amplitude": amplitude, **drawn, **(values or {})},
        Run(cycles=10, warmup_cycles=2),
    )
    assert set(result.status.tolist()) == {"ok"}, result.status
    return {
        name: np.asarray(each).reshape(shape).mean(axis=2) for name, each in result.metrics.items()
    }


def changed(found: Mapping[str, np.ndarray], metric: str, amplitude: int) -> np.ndarray:
    """By how much the spine changes a metric at each frequency [%]."""
    return 100 * (found[metric][:, amplitude] / found[metric][:, 0] - 1)


def listed(values: np.ndarray, form: str = ".1f") -> str:
    return ", ".join(f"{value:{form}}" for value in values)


def between(values: Any, form: str = "+.0f") -> str:
    """`low to high`, or one number where both are written alike."""
    low, high = f"{np.min(values):{form}}", f"{np.max(values):{form}}"
    return low if low == high else f"{low} to {high}"


def lengths(directory: Path) -> dict[str, str]:
    """Speed by the length of a spine segment, and by that of the rear upper leg."""
    table = read_table(directory).to_pandas()
    assert (table["status"] == "ok").all()
    segment, upper, amplitude = (
        "geometry.spine.segment",
        "geometry.rear_leg.upper",
        "spine.amplitude",
    )
    speed = 1e3 * table.groupby([amplitude, segment])["speed"].mean().unstack()
    titles = {0.0: "spine held", 0.4: "spine at 0.4 rad"}
    rows = [
        [title, *(f"{each:.1f}" for each in speed.loc[value])] for value, title in titles.items()
    ]
    gain = 100 * (speed.loc[0.4] / speed.loc[0.0] - 1)
    roll = np.degrees(table[table[amplitude] == 0.4].groupby(segment)["roll_std"].mean())
    rows += [["gain at 0.4 rad [%]", *(f"{each:.0f}" for each in gain)]]
    rows += [["roll std at 0.4 rad [°]", *(f"{each:.1f}" for each in roll)]]
    heading = ["segment [mm]", *(f"{1e3 * each:.0f}" for each in speed.columns)]
    lines = [f"| {' | '.join(row)} |" for row in (heading, ["---"] * len(heading), *rows)]
    by_leg = table.groupby([amplitude, upper])["speed"].mean().unstack()
    change = 100 * (by_leg.max(axis=1) / by_leg.min(axis=1) - 1)
    return {"lengths": "\n".join(lines), "lengths.leg": f"{change.max():.1f} %"}


def servos() -> dict[str, str]:
    """What the servos' parameters do to speed, gain, current and run time."""
    found = {title: trots(values) for title, values in SERVOS.items()}
    lines = [
        "| servos | speed, spine held [mm/s] | gain at 0.4 rad [%] | current [A] | run time [min] |",
        "|---|---|---|---|---|",
    ]
    for title, each in found.items():
        current, minutes = each["servo_current"][1, 0], each["battery_time"][1, 0] / 60
        gain, speed = listed(changed(each, "speed", 2)), listed(1e3 * each["speed"][:, 0])
        lines.append(f"| {title} | {speed} | {gain} | {current:.2f} | {minutes:.1f} |")
    return {"servos": "\n".join(lines)}


def cost() -> dict[str, str]:
    """Speed and both costs of transport by amplitude, from several starts; what could turn the electrical cost."""
    found = trots(starts=STARTS)
    lines = [
        "| metric | spine held | change at 0.2 rad [%] | change at 0.4 rad [%] |",
        "|---|---|---|---|",
    ]
    for title, metric, scale, form in (
        ("speed [mm/s]", "speed", 1e3, ".1f"),
        (f"`{COST}`, of mechanical work", COST, 1.0, ".2f"),
        (f"`{ELECTRICAL}`", ELECTRICAL, 1.0, ".1f"),
    ):
        cells = [
            listed(scale * found[metric][:, 0], form),
            *(listed(changed(found, metric, i), "+.1f") for i in (1, 2)),
        ]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    numbers = {"cost": "\n".join(lines)}
    for name, values in (
        ("stall", [{"servo.stall_current": each} for each in (0.2, 0.4, 0.8, 1.6)]),
        ("dead", [{"servo.dead_band": np.radians(each)} for each in (0.0, 0.5, 1.0, 2.0)]),
        ("stiffness", [{"servo.kp": each} for each in (6.0, 10.0, 19.1, 35.0, 60.0)]),
    ):
        numbers[f"cost.{name}"] = (
            between([changed(trots(each), ELECTRICAL, 2)[1] for each in values]) + " %"
        )
    # The electrical cost is linear in the idle current: where both amplitudes cost the same?
    base, idle = (
        trots({"servo.idle_current": 0.0})[ELECTRICAL],
        trots({"servo.idle_current": 0.1})[ELECTRICAL],
    )
    slope = (idle - base) / 0.1
    turn = (base[:, 2] - base[:, 0]) / (slope[:, 0] - slope[:, 2])
    return numbers | {"cost.idle": between(turn, ".2f")}


def friction(directory: Path) -> dict[str, str]:
    """What the ground's friction does to the trot's gain, and the gains of each gait over the frequencies."""
    table = read_table(directory).to_pandas()
    found = {}
    for gait in ("trot", "walking_trot", "lateral_walk"):
        of = table[(table["gait"] == gait) & (table["status"] == "ok")]
        held, free = (
            of[of["spine"] == spine].set_index(["frequency", "seed"])
            for spine in ("none", "stride_extension")
        )
        held, free = held.align(free, join="inner", axis=0)
        pairs = pd.DataFrame(
            {
                "gain": 100 * (free["speed"] / held["speed"] - 1),
                "friction": held["contact.friction"],
            }
        )
        slopes = [
            0.6 * np.polyfit(each["friction"], each["gain"], 1)[0]
            for _, each in pairs.groupby("frequency")
        ]
        cost = 100 * (
            free[ELECTRICAL].groupby("frequency").mean()
            / held[ELECTRICAL].groupby("frequency").mean()
            - 1
        )
        found |= {f"friction.{gait}": between(slopes), f"electrical.{gait}": f"{between(cost)} %"}
    return found


def soles() -> dict[str, str]:
    """The default soles beside stiff ones."""
    stiff, soft = trots(STIFF), trots()
    lines = [
        f"| stiff, soft soles | {' | '.join(f'{each:g} Hz' for each in FREQUENCIES)} |",
        "|---|---|---|---|",
    ]
    for title, metric, amplitude, scale, form in (
        ("speed, spine held [mm/s]", "speed", 0, 1e3, ".1f"),
        ("gain at 0.2 rad [%]", "speed", 1, None, ".1f"),
        ("gain at 0.4 rad [%]", "speed", 2, None, ".1f"),
        ("mechanical cost at 0.4 rad [%]", COST, 2, None, "+.1f"),
        ("electrical cost at 0.4 rad [%]", ELECTRICAL, 2, None, "+.1f"),
        ("slip of loaded feet, spine held [mm/s]", "slip", 0, 1e3, ".1f"),
    ):
        pair = [
            changed(each, metric, amplitude) if scale is None else scale * each[metric][:, 0]
            for each in (stiff, soft)
        ]
        cells = [f"{a:{form}}, {b:{form}}" for a, b in zip(*pair, strict=True)]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return {"soles": "\n".join(lines)}


if __name__ == "__main__":
    out = Path(sys.argv[1])
    found = lengths(out / "geometry") | servos() | cost() | friction(out / "spine_gain") | soles()
    print(json.dumps(found, indent=1, ensure_ascii=False))
