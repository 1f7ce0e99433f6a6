"""Each engine against plain physics, and gradients against the walk alone: a line of results.jsonl each, and its page.

    python docs/benchmarks/engines.py throughput --engine c --engine mjx --worlds 64 --worlds 1024
    python docs/benchmarks/engines.py gradient --mode reverse --cycles 1 --cycles 4
    python docs/benchmarks/engines.py startup

`results.md` and its plots show the newest line of each machine, case and option. Without a case, only they are drawn.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import click
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from measuring import (
    FREQUENCY,
    Compiled,
    append,
    compare,
    compile_cold,
    compiling,
    differentiable_walk,
    run_of,
    with_gradient,
)
from mujoco import rollout

from nermo_mjx.bench import apart, peak_bytes, startup
from nermo_mjx.dynamics.mjx_import import mjx
from nermo_mjx.physics.c_engine import CEngine
from nermo_mjx.physics.mjx_engine import MjxEngine
from nermo_mjx.plotting.charts import blank_page, draw_horizontal_grid
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.style import BEST_COLOUR, INK, LINE_COLOUR, MUTED_INK
from nermo_mjx.rollout.setup import Setup
from nermo_mjx.rollout.simulator import Batch, Simulator
from nermo_mjx.runs.files import table
from nermo_mjx.runtime import compiler_options, cpu_count

HERE: Final = Path(__file__).parent
RESULTS: Final = HERE / "results.jsonl"
#: Control ticks in a timed round, and rounds.
TICKS, ROUNDS = {"c": 100, "scan": 20}, {"c": 15, "scan": 5}


def throughput_case(engine: str, worlds: int) -> dict[str, Any]:
    """Steps per second of a walk, and of a plain MuJoCo program for the same model."""
    return c_case(worlds) if engine == "c" else scan_case(engine, worlds)


def _walk(engine: str, worlds: int) -> tuple[Simulator, Batch]:
    """A batch like that of a sweep: every world has its own spine amplitude and phase."""
    simulator = Simulator(Setup(spine="stride_extension"), engine)
    values = {
        "frequency": np.full(worlds, 0.8),
        "spine.amplitude": np.linspace(0.0, 0.4, worlds),
        "spine.phase": np.linspace(-1.0, 0.0, worlds),
    }
    return simulator, simulator.prepare(values)


def c_case(worlds: int) -> dict[str, Any]:
    """C engine against one call of `mujoco.rollout`, with the same states and servo targets.

    Both have all cores, and the same model but for sparse Jacobians: plain MuJoCo chooses dense ones for so few joints.
    """
    simulator, batch = _walk("c", worlds)
    engine = simulator.engine
    assert isinstance(engine, CEngine)
    ticks, steps = TICKS["c"], simulator.loop.steps_per_tick
    session = engine.open(batch.params, batch.qpos, batch.fields)
    # Neither `loop.step` itself nor the function in it: JAX has cached both since the session was opened.
    tick = inspect.unwrap(session.loop.step)
    ours = compile_cold(
        jax.jit(lambda *given: tick(*given), compiler_options=compiler_options()),
        *session.arguments,
    )
    session.advance(ticks)  # past the start-up phase

    size = mujoco.mj_stateSize(simulator.robot.physical, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
    state = np.zeros((worlds, size))
    state[:, 1 : 1 + session.qpos.shape[1]] = session.qpos
    state[:, 1 + session.qpos.shape[1] :][:, : session.qvel.shape[1]] = session.qvel
    trace = engine.open(batch.params, batch.qpos, batch.fields).record(2 * ticks)
    control = np.repeat(trace.ctrl[:, ticks:], steps, axis=1)
    cores = cpu_count()
    data = [mujoco.MjData(simulator.robot.physical) for _ in range(cores)]

    with rollout.Rollout(nthread=cores) as pool:

        def plain() -> None:
            pool.rollout(simulator.robot.physical, data, state, control)

        plain()
        ours_s, plain_s, ratio = compare(lambda: session.advance(ticks), plain, ROUNDS["c"])
    nothing = Compiled(0.0, 0.0, None)  # plain C compiles nothing
    return (
        _case(simulator, worlds, ticks * steps, ours_s, plain_s)
        | compiling(ours, nothing)
        | {"ratio": ratio}
    )


def scan_case(name: str, worlds: int) -> dict[str, Any]:
    """An engine of MJX against the scan a user would write: `mjx.step` carrying `mjx.Data`, same batch and targets.

    `loop_cost` is the time of controller and metrics, relative to the same engine playing back the targets.

    Args:
        name: `mjx` or `warp`, also of the plain scan's implementation.
        worlds: size of the batch.
    """
    simulator, batch = _walk(name, worlds)
    engine = simulator.engine
    assert isinstance(engine, MjxEngine)
    ticks, steps = TICKS["scan"], simulator.loop.steps_per_tick
    session = engine.open(batch.params, batch.qpos, batch.fields)
    count = jnp.int32(ticks)
    ours = compile_cold(engine.advance, session.params, session.fields, session.carry, count)

    walking = jax.block_until_ready(
        ours.program(session.params, session.fields, session.carry, count)
    )
    states, ctrl = walking.physics, _targets(simulator, batch, ticks)
    model, blank = engine.model, engine.data_among(worlds)
    if name == "mjx":
        model = mjx.put_model(simulator.robot.physical)
        blank = mjx.make_data(model)
    data = jax.jit(jax.vmap(lambda one: one.into(blank)))(states)

    def scan(data: mjx.Data, ctrl: jax.Array) -> mjx.Data:
        def tick(data: mjx.Data, target: jax.Array) -> tuple[mjx.Data, None]:
            return jax.vmap(lambda one, goal: mjx.step(model, one.replace(ctrl=goal)))(
                data, target
            ), None

        return jax.lax.scan(tick, data, ctrl)[0]

    plain = compile_cold(jax.jit(scan), data, ctrl)
    puppets = type(engine)(simulator.robot, Puppet(steps), engine.devices.count)
    strings = jnp.moveaxis(ctrl[::steps], 0, 1)
    hung = walking._replace(loop=jnp.zeros(worlds, jnp.int32))

    # Each round all walk the same steps. The carry is donated, so each program gets a copy.
    def run_ours() -> None:
        jax.block_until_ready(
            ours.program(session.params, session.fields, jax.tree.map(jnp.copy, walking), count)
        )

    def run_plain() -> None:
        jax.block_until_ready(plain.program(data, ctrl))

    def run_puppets() -> None:
        jax.block_until_ready(
            puppets.advance(strings, session.fields, jax.tree.map(jnp.copy, hung), count)
        )

    run_ours()
    run_plain()
    run_puppets()
    ours_s, plain_s, ratio = compare(run_ours, run_plain, ROUNDS["scan"])
    loop_cost = 1.0 / compare(run_ours, run_puppets, ROUNDS["scan"])[2] - 1.0
    carry = sum(leaf.nbytes for leaf in jax.tree.leaves(walking)) // worlds
    own = {"ratio": ratio, "loop_cost": loop_cost, "carry_bytes_per_world": carry}
    return _case(simulator, worlds, ticks * steps, ours_s, plain_s) | compiling(ours, plain) | own


@dataclasses.dataclass(frozen=True)
class Puppet:
    """A loop that plays back given targets, (ticks, n_servos) for each world, repeatedly: physics alone."""

    steps_per_tick: int

    def init(self, params: jax.Array, sensordata: jax.Array) -> jax.Array:
        """The tick, 0."""
        return jnp.int32(0)

    def step(
        self, params: jax.Array, state: jax.Array, sensordata: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The next tick, and this one's targets."""
        return state + 1, params[state % len(params)]


def _targets(simulator: Simulator, batch: Batch, ticks: int) -> jax.Array:
    """Servo targets of a walk, one row per physics step (ticks * steps, worlds, servos), from the C engine."""
    engine = CEngine(simulator.robot, simulator.loop)
    trace = engine.open(batch.params, batch.qpos, batch.fields).record(2 * ticks)
    steps = np.repeat(
        np.moveaxis(trace.ctrl[:, ticks:], 0, 1), simulator.loop.steps_per_tick, axis=0
    )
    return jnp.asarray(steps)


def _case(
    simulator: Simulator, worlds: int, steps: int, ours_s: float, plain_s: float
) -> dict[str, Any]:
    rate = worlds * steps / ours_s
    return {
        "steps_per_second": rate,
        "plain_steps_per_second": worlds * steps / plain_s,
        "seconds_simulated_per_second": rate * simulator.robot.config.timestep,
        "peak_bytes": peak_bytes(),
    }


GRADIENT_ROUNDS: Final = 3


def gradient_case(mode: str, worlds: int, cycles: float) -> dict[str, Any]:
    """Value and gradient in one mode against the value alone: same walk, same batch, alternating.

    Args:
        mode: `forward` or `reverse`.
        worlds: size of the batch.
        cycles: length of the walk in gait cycles.
    """
    rollout, walk = differentiable_walk(cycles)
    points = np.stack([np.linspace(0.05, 0.35, worlds), np.linspace(-1.0, 0.0, worlds)], axis=1)
    batch = jnp.asarray(points, float)
    plain = compile_cold(jax.jit(jax.vmap(walk)), batch)
    ours = compile_cold(jax.jit(jax.vmap(with_gradient(walk, mode))), batch)

    def run(program: Any) -> None:
        jax.block_until_ready(program(batch))

    run(plain.program)
    run(ours.program)
    ours_s, plain_s, ratio = compare(
        lambda: run(ours.program), lambda: run(plain.program), GRADIENT_ROUNDS
    )
    steps = round(rollout.seconds({"frequency": FREQUENCY}) / rollout.robot.config.timestep)
    figures = {"engine": "mjx", "forward_s": plain_s, "gradient_s": ours_s, "ratio": 1.0 / ratio}
    figures |= {
        "steps_per_second": worlds * steps / ours_s,
        "plain_steps_per_second": worlds * steps / plain_s,
    }
    for name, program in (
        ("temporary_bytes_per_world", ours),
        ("plain_temporary_bytes_per_world", plain),
    ):
        # In addition to arguments and results, as planned by the compiler.
        figures[name] = int(program.program.memory_analysis().temp_size_in_bytes) // worlds
    return figures | compiling(ours, plain) | {"peak_bytes": peak_bytes()}


#: Case -> what it measures, its function, and its options with their default values.
CASES: Final[dict[str, tuple[str, Any, dict[str, tuple[Any, ...]]]]] = {
    "throughput": (
        "a walk with its controller and metrics against plain physics",
        throughput_case,
        {"engine": ("c", "mjx"), "worlds": (64,)},
    ),
    "gradient": (
        "value and gradient of a walk against the walk alone",
        gradient_case,
        {"mode": ("forward", "reverse"), "worlds": (16,), "cycles": (1.0,)},
    ),
    "startup": (
        "from a new process to the first control tick, stage by stage, with a cold and a warm cache",
        startup,
        {"engine": ("c", "mjx"), "worlds": (64,)},
    ),
}

_COLOURS: Final = {"c": MUTED_INK, "mjx": LINE_COLOUR, "warp": BEST_COLOUR}
#: Where logarithmic axes may begin and end.
_STEPS: Final = [step * 10.0**power for power in range(-4, 12) for step in (1, 2, 5)]
#: Figure -> heading of its column, its format, and the factor to the heading's unit.
_COLUMNS: Final[dict[str, tuple[str, str, float]]] = {
    "engine": ("engine", "{}", 1.0),
    "mode": ("mode", "{}", 1.0),
    "worlds": ("worlds", "{:,}", 1.0),
    "cache": ("cache", "{}", 1.0),
    "cycles": ("cycles", "{:g}", 1.0),
    "steps_per_second": ("steps/s", "{:,.0f}", 1.0),
    "plain_steps_per_second": ("plain steps/s", "{:,.0f}", 1.0),
    "gradient_s": ("gradient [s]", "{:.2f}", 1.0),
    "forward_s": ("walk [s]", "{:.2f}", 1.0),
    "ratio": ("ratio", "{:.2f}", 1.0),
    "trace_s": ("trace [s]", "{:.1f}", 1.0),
    "compile_s": ("compile [s]", "{:.1f}", 1.0),
    "temporary_bytes_per_world": ("kB/world", "{:,.0f}", 1e-3),
    "peak_bytes": ("peak [MB]", "{:,.0f}", 1e-6),
    "total_s": ("to the first tick [s]", "{:.1f}", 1.0),
    **{
        f"{stage}_s": (f"{stage.replace('_', ' ')} [s]", "{:.1f}", 1.0)
        for stage in ("import", "model", "parameters", "open", "first_tick")
    },
    "training_s": ("then a training [s]", "{:.1f}", 1.0),
}
_COMPILING: Final = ("trace_s", "compile_s")
#: Case -> figures of its table.
COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "throughput": (
        *("engine", "worlds", "steps_per_second", "plain_steps_per_second", "ratio", *_COMPILING),
        "peak_bytes",
    ),
    "gradient": (
        *("mode", "worlds", "cycles", "gradient_s", "forward_s", "ratio", *_COMPILING),
        *("temporary_bytes_per_world", "peak_bytes"),
    ),
    "startup": (
        *(
            "engine",
            "worlds",
            "cache",
            "total_s",
            "import_s",
            "model_s",
            "parameters_s",
            "open_s",
            "first_tick_s",
        ),
        "training_s",
    ),
}


def table_of(case: str, lines: Sequence[Mapping[str, Any]]) -> str:
    """The Markdown table of a case's lines: the columns for which there is a figure."""
    rows = [row for line in lines for row in _rows(line)]
    columns = {
        key: _COLUMNS[key] for key in COLUMNS[case] if any(row.get(key) is not None for row in rows)
    }

    def cell(value: Any, shape: str, factor: float) -> str:
        if value is None:
            return "-"
        return shape.format(value if isinstance(value, str) or factor == 1.0 else value * factor)

    cells = [
        [cell(row.get(key), shape, factor) for key, (_, shape, factor) in columns.items()]
        for row in rows
    ]
    return table([heading for heading, _, _ in columns.values()], cells)


def _rows(line: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The table's rows for a measurement: one, or of a start one for each state of the cache."""
    if line["case"] != "startup":
        yield line
        return
    for cache in ("cold", "warm"):
        yield {**line, "cache": cache, "total_s": line[f"{cache}_s"], **line[cache]}


def newest(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Machine -> its newest line of each case and its options, ordered as `CASES`; `made` says when and with what."""
    found: dict[str, dict[tuple[Any, ...], dict[str, Any]]] = {}
    for run in map(json.loads, path.read_text().splitlines()):
        about = run["hardware"]
        machine = f"{about['device']}; {about['cores']} x {about['cpu']}"
        versions = [f"{name} {about[name]}" for name in ("mujoco", "jax", "python")]
        made = ", ".join([run["date"][:10], f"commit {run['commit']}", *versions])
        for line in run["cases"]:
            # A line from before an option existed was made with the option's first default.
            options = [
                line.get(name, default[0]) for name, default in CASES[line["case"]][2].items()
            ]
            key = (list(CASES).index(line["case"]), *options)
            found.setdefault(machine, {})[key] = {**line, "made": made}

    def order(key: tuple[Any, ...]) -> list[Any]:
        return [(0, part) if isinstance(part, (int, float)) else (1, str(part)) for part in key]

    return {
        machine: [lines[key] for key in sorted(lines, key=order)]
        for machine, lines in found.items()
    }


def draw_page(path: Path, folder: Path) -> None:
    """Make results.md and its plots in a folder from the lines of a file."""
    text = [
        "# Results",
        "",
        "What each engine costs on each machine ([how to read it](README.md)), by `engines.py`; the newest run counts.",
        "",
    ]
    for number, (machine, lines) in enumerate(newest(path).items(), 1):
        text += [f"## {machine}", ""]
        for case in dict.fromkeys(line["case"] for line in lines):
            own = [line for line in lines if line["case"] == case]
            text += [f"### {case.capitalize()}: {CASES[case][0]}", "", table_of(case, own)]
        text += [f"Measured {'; '.join(dict.fromkeys(line['made'] for line in lines))}.", ""]
        for drawn in write_figures(
            _figures(machine, lines, number), folder / "plots", formats=("svg",)
        ):
            text += [f"![{drawn.stem.removesuffix(f'_{number}')}](plots/{drawn.name})", ""]
    (folder / "results.md").write_text("\n".join(text).rstrip() + "\n")


def _figures(
    machine: str, measured: Sequence[Mapping[str, Any]], number: int
) -> Iterator[tuple[str, Figure]]:
    """Throughput and memory over the batch, compile times, and the cost of gradients over the length of a walk."""

    def lines_with(case: str, *keys: str) -> list[Mapping[str, Any]]:
        """The lines of a case that have all these figures, and all its options."""
        lines = [line for line in measured if line["case"] == case]
        return [
            line
            for line in lines
            if all(line.get(name) is not None for name in (*CASES[case][2], *keys))
        ]

    if walks := lines_with(
        "throughput", "steps_per_second", "plain_steps_per_second", "peak_bytes"
    ):
        yield f"throughput_{number}", _throughput(machine, walks)
    compiled = lines_with("throughput", "trace_s", "compile_s", "plain_trace_s", "plain_compile_s")
    if compiled := [line for line in compiled if line["compile_s"]]:
        yield f"compile_{number}", _compile(machine, compiled)
    gradients = lines_with("gradient", "ratio", "temporary_bytes_per_world")
    if len({line["cycles"] for line in gradients}) > 1:  # a curve needs more than one length
        yield f"gradient_{number}", _gradient(machine, gradients)


def _throughput(machine: str, walks: Sequence[Mapping[str, Any]]) -> Figure:
    figure = blank_page(
        "Throughput and memory over the batch",
        7.0,
        3.2,
        f"{machine}. Dashed: plain physics of the same model.",
    )
    speed, memory = figure.subplots(1, 2)
    for engine in dict.fromkeys(line["engine"] for line in walks):
        lines, colour = (
            [line for line in walks if line["engine"] == engine],
            _COLOURS.get(engine, INK),
        )
        _curve(speed, lines, "worlds", "steps_per_second", color=colour, label=engine)
        _curve(
            speed, lines, "worlds", "plain_steps_per_second", color=colour, marker="", ls="--", lw=1
        )
        _curve(memory, lines, "worlds", "peak_bytes", 1e-9, color=colour)
    sizes = sorted({line["worlds"] for line in walks})
    for ax, label in ((speed, "throughput [physics steps/s]"), (memory, "peak memory [GB]")):
        ax.set(xscale="log", yscale="log", xlabel="batch [worlds]", ylabel=label)
        ax.set_xticks(sizes, [f"{size:,}" for size in sizes])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        ax.yaxis.set_minor_locator(NullLocator())
        low, high = ax.get_ylim()
        ax.set_ylim(
            max(step for step in _STEPS if step <= low),
            min(step for step in _STEPS if step >= high),
        )
        draw_horizontal_grid(ax)
    speed.legend()
    return figure


def _curve(
    ax: Axes, lines: Sequence[Mapping[str, Any]], x: str, y: str, scale: float = 1.0, **look: Any
) -> None:
    """A figure of the lines over one of their options."""
    lines = sorted(lines, key=lambda line: line[x])
    look.setdefault("marker", "o")
    ax.plot([line[x] for line in lines], [line[y] * scale for line in lines], ms=3, **look)


def _compile(machine: str, walks: Sequence[Mapping[str, Any]]) -> Figure:
    figure = blank_page(
        "From Python to a program", 7.0, 1.8 + 0.45 * len(walks), f"{machine}. Cold cache."
    )
    ax = figure.subplots()
    names = [f"{line['engine']}, {line['worlds']:,} worlds" for line in walks]
    trace, compiled = ([line[key] for line in walks] for key in ("trace_s", "compile_s"))
    ax.barh(names, trace, color=MUTED_INK, label="trace")
    ax.barh(names, compiled, left=trace, color=LINE_COLOUR, label="compile")
    plain = [line["plain_trace_s"] + line["plain_compile_s"] for line in walks]
    ax.plot(plain, names, "|", ms=14, color=BEST_COLOUR, label="plain physics, both")
    ax.set(xlabel="time [s]")
    ax.margins(y=0.3)
    ax.invert_yaxis()
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return figure


def _gradient(machine: str, lines: Sequence[Mapping[str, Any]]) -> Figure:
    figure = blank_page("What a gradient costs over the length of a walk", 7.0, 3.2, f"{machine}.")
    ratio, memory = figure.subplots(1, 2)
    for mode, colour in (("forward", LINE_COLOUR), ("reverse", BEST_COLOUR)):
        of_mode = [line for line in lines if line["mode"] == mode]
        _curve(ratio, of_mode, "cycles", "ratio", color=colour, label=mode)
        _curve(memory, of_mode, "cycles", "temporary_bytes_per_world", 1e-6, color=colour)
    ratio.set(
        xlabel="length of the walk [gait cycles]",
        ylabel="time over the walk's alone [1]",
        ylim=(0, None),
    )
    memory.set(
        xlabel="length of the walk [gait cycles]", ylabel="memory of a world [MB]", ylim=(0, None)
    )
    for ax in (ratio, memory):
        draw_horizontal_grid(ax)
    ratio.legend()
    return figure


@click.command()
@click.argument("cases", nargs=-1, type=click.Choice(CASES), metavar="[CASE]...")
@click.option("--engine", type=click.Choice(["c", "mjx", "warp"]), multiple=True)
@click.option("--worlds", type=click.IntRange(1), multiple=True)
@click.option("--mode", type=click.Choice(["forward", "reverse"]), multiple=True)
@click.option("--cycles", type=float, multiple=True)
def main(cases, **given):
    for case in cases:
        _, measure, options = CASES[case]
        for chosen in itertools.product(
            *(given[name] or default for name, default in options.items())
        ):
            figures = apart(measure, *chosen)
            print(case, *chosen, figures)
            if "error" not in figures:
                append(
                    RESULTS,
                    run_of([{"case": case, **dict(zip(options, chosen, strict=True)), **figures}]),
                )
    draw_page(RESULTS, HERE)


if __name__ == "__main__":
    main()
