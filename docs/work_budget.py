"""Where the work of a trot's servos goes, and how long they stand at their torque limit.

    python docs/work_budget.py DIR

Writes DIR/work_budget.png and prints the numbers of docs/model.md as JSON, in half a minute on two cores. The
trot has the profile `exact`, no pilot and one start; of its 6 cycles 4 are measured. Contact, tendons and compliant
joints take what a step's force times its mean speed says, in steps of plain MuJoCo that follow the recording exactly.
"""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from nermo_mjx import Recording, Run, Setup, Simulator
from nermo_mjx.plotting.charts import FigurePage, draw_horizontal_grid
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.style import SERIES

ROOT = Path(__file__).parents[1]
FREQUENCIES, AMPLITUDES, DAMPINGS = (0.5, 0.67, 0.8), (0.0, 0.2, 0.4), (0.01, 0.003)
CYCLES, WARMUP = 6.0, 2.0
ELECTRICAL = "electrical_cost_of_transport"
GROUPS = ("front_hips", "rear_hips", "front_knees", "rear_knees", "spine")
PARTS = (
    "dampers of hips and pulleys",
    "dampers of compliant joints",
    "contact",
    "tendons",
    "stored",
)


def budget(recording: Recording, model: mujoco.MjModel, begin: float) -> np.ndarray:
    """Work [J] of the servos after `begin` [s], then each of `PARTS`, (6,)."""
    model = copy.copy(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, work, step = mujoco.MjData(model), np.zeros(1 + len(PARTS)), model.opt.timestep
    of_servo = np.isin(np.arange(model.nv), model.jnt_dofadr[model.actuator_trnid[:, 0]])
    stored = []
    for tick in range(int(np.searchsorted(recording.time, begin - 1e-9)), len(recording.time) - 1):
        data.qpos[:], data.qvel[:] = recording.qpos[tick], recording.qvel[tick]
        mujoco.mj_forward(model, data)
        stored.append(data.energy.sum())
        data.ctrl[:] = recording.ctrl[tick + 1]
        for _ in range(round((recording.time[1] - recording.time[0]) / step)):
            before = data.qvel.copy()
            mujoco.mj_step(model, data)  # the forces in `data` are those of the state before
            mean, pushed = 0.5 * (before + data.qvel), np.zeros(data.nefc)
            mujoco.mj_mulJacVec(model, data, pushed, mean)
            lost, damped = (
                -step * data.efc_force * pushed,
                step * model.dof_damping * data.qvel * mean,
            )
            tendon = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
            taken = (
                damped[of_servo].sum(),
                damped[~of_servo].sum(),
                lost[~tendon].sum(),
                lost[tendon].sum(),
            )
            work[:5] += step * data.qfrc_actuator @ mean, *taken
        assert np.allclose(data.qpos, recording.qpos[tick + 1], atol=1e-9)
    mujoco.mj_forward(model, data)
    work[5] = data.energy.sum() - stored[0]
    return work


def drawn(work: np.ndarray, limited: np.ndarray) -> Figure:
    """Where the work (amplitudes, 6) at 0.8 Hz goes, and the share of time at the limit (amplitudes, groups)."""
    page = FigurePage("Trot at 0.8 Hz: work and limits of the servos", (7.6, 3.3), 1, 2)
    left, right = page.axes[0]
    places, width = np.arange(len(AMPLITUDES)), 0.27
    bottom = np.zeros(len(AMPLITUDES))
    for part, colour in zip(work.T[1:5], SERIES, strict=False):  # what is stored could not be seen
        left.bar(places, part, 0.6, bottom=bottom, color=colour)
        bottom += part
    left.set_xticks(places, [f"{amplitude:g} rad" for amplitude in AMPLITUDES])
    left.set(
        xlabel="amplitude of the spine",
        ylabel="work in 4 cycles [J]",
        title="Where the net work goes",
    )
    shades = ("#c6c6c6", "#8c8c8c", "#3c3c3c")
    for place, (shares, shade) in enumerate(zip(limited, shades, strict=True)):
        right.bar(np.arange(len(GROUPS)) + (place - 1) * width, 100 * shares, width, color=shade)
    right.set_xticks(range(len(GROUPS)), [name.replace("_", "\n") for name in GROUPS])
    right.set(ylabel="share of time [%]", title="At the torque limit")
    for ax in (left, right):
        draw_horizontal_grid(ax)
    handles = [
        Patch(color=colour, label=name) for name, colour in zip(PARTS[:4], SERIES, strict=False)
    ]
    handles += [
        Patch(color=shade, label=f"spine {each:g} rad")
        for each, shade in zip(AMPLITUDES, shades, strict=True)
    ]
    return page.finish(handles, "profile exact; stride extension in phase, no pilot, one start")


def told(found: dict[str, np.ndarray]) -> dict[str, str]:
    """The dampers' share at 0.8 Hz, and what smaller ones change, of metrics (frequencies, amplitudes, dampings)."""
    cost, speed = found["cost_of_transport"], found["speed"]
    changes = np.array(
        [found[name] / found[name][:, :1] - 1 for name in ("cost_of_transport", ELECTRICAL)]
    )
    share = 100 * (found["servo_damper_work"] / found["servo_net_work"])[2, :, 0]
    less = 100 * (1 - cost[..., 1] / cost[..., 0])
    return {
        "work.dampers": f"{share.min():.0f} to {share.max():.0f} %",
        "work.level": f"{less.min():.0f} to {less.max():.0f} %",
        "work.cost": f"{100 * np.abs(np.diff(changes)).max():.1f} points",
        "work.speed": f"{100 * np.abs(speed[..., 1] / speed[..., 0] - 1).max():.1f} %",
        "work.signs": "no sign turns"
        if (changes[..., 0] * changes[..., 1] >= 0).all()
        else "a sign turns",
    }


if __name__ == "__main__":
    grid = np.meshgrid(FREQUENCIES, AMPLITUDES, DAMPINGS, indexing="ij")
    frequency, amplitude, damping = (each.ravel() for each in grid)
    values = {
        "frequency": frequency,
        "spine.amplitude": amplitude,
        "damping.hip": damping,
        "damping.pulley": damping,
    }
    simulator = Simulator(
        Setup(gait="trot", spine="stride_extension", pilot="open_loop"), engine="c"
    )
    result = simulator.run(values, Run(cycles=CYCLES, warmup_cycles=WARMUP), record=True)
    found = {name: np.asarray(each).reshape(grid[0].shape) for name, each in result.metrics.items()}
    fast = [int(np.ravel_multi_index((2, j, 0), grid[0].shape)) for j in range(len(AMPLITUDES))]
    works = [budget(result.recording(i), simulator.robot.physical, WARMUP / 0.8) for i in fast]
    limited = np.array([[result.metrics[f"limited_{name}"][i] for name in GROUPS] for i in fast])
    figures = (
        ("work_budget", drawn(np.array(works), limited)) for _ in range(1)
    )  # in the style that holds then
    write_figures(figures, Path(sys.argv[1]), formats=("png",))
    print(json.dumps(told(found), indent=1, ensure_ascii=False))
