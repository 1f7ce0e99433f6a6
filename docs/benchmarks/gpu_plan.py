"""Estimates for the programs on a GPU, from XLA's compiler on a machine without one; a line of gpu_plan.jsonl each.

    python docs/benchmarks/gpu_plan.py --target t4 --program walk --worlds 1024

The program is compiled to machine code for the target and never run. Launches, loops and bytes are read from the
optimized HLO (hlo.py), memory from the compiler's plan of it. The two bounds on throughput are estimates: of a device
that launches as slowly as `LAUNCH_S` and `WAIT_S` say and computes in no time, and of one that only moves bytes.
Needs the extra gpu-plan.

`bytes_per_world` has arguments, results and temporaries; `fits` compares all with the device's memory.
`launches_per_step` counts kernels, library calls and copies of a physics step, every loop iteration counted, or of a
gradient all launches over its steps; `launches_per_tick` those of a control tick. `unknown_loops` are loops in a tick
whose length only the device knows, so that the host waits for each iteration. `moved_bytes_per_step` is what kernels
read and write per world, without caches: small batches, which stay there, may exceed `estimated_bandwidth_bound`.
"""

import inspect
import json
from pathlib import Path

import click
import jax
import jax.numpy as jnp
import numpy as np
from hlo import Module, Work
from jax.experimental import topologies
from jax.sharding import SingleDeviceSharding
from measuring import (
    FREQUENCY,
    NAMES,
    append,
    compile_cold,
    differentiable_walk,
    run_of,
    with_gradient,
)

from nermo_mjx.bench import peak_bytes
from nermo_mjx.rollout import Setup, Simulator

#: Assumed number of iterations of a loop of unknown length (2.3 on average for 64 walks, 7 at most), time from the
#: launch of a small kernel to the next [s], and how long the host waits to learn whether a loop continues [s].
ROUNDS, LAUNCH_S, WAIT_S = 5, 2.5e-6, 15e-6
#: From NVIDIA's data sheets and device queries: name, compute capability, multiprocessors, float32 units of each, clock
#: [GHz], threads and shared memory of a multiprocessor, shared memory of a block, cache, memory [B], bandwidth [B/s].
TARGETS = {
    "h100": (
        "NVIDIA H100 80GB HBM3",
        9,
        0,
        132,
        128,
        1.98,
        2048,
        233472,
        232448,
        52428800,
        84942979072,
        3.352e12,
    ),
    "a100": (
        "NVIDIA A100-SXM4-80GB",
        8,
        0,
        108,
        64,
        1.41,
        2048,
        167936,
        166912,
        41943040,
        85100068864,
        2.039e12,
    ),
    "l4": ("NVIDIA L4", 8, 9, 58, 128, 2.04, 1536, 102400, 101376, 50331648, 23580639232, 3.0e11),
    "t4": ("Tesla T4", 7, 5, 40, 64, 1.59, 1024, 65536, 65536, 4194304, 15642329088, 3.2e11),
}


def device(
    name, major, minor, cores, units, clock, threads, shared, block, cache, memory, bandwidth
):
    """The GPU as a device that programs are compiled for, from XLA's description of it."""
    described = f"""gpu_device_info {{
  threads_per_block_limit: 1024  threads_per_warp: 32  threads_per_core_limit: {threads}
  shared_memory_per_block: 49152  shared_memory_per_core: {shared}  shared_memory_per_block_optin: {block}
  core_count: {cores}  fpus_per_core: {units}  clock_rate_ghz: {clock}
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  memory_bandwidth: {bandwidth:.0f}  l2_cache_size: {cache}  device_memory_size: {memory}
  cuda_compute_capability {{ major: {major} minor: {minor} }}
  registers_per_core_limit: 65536  registers_per_block_limit: 65536 }}
platform_name: "CUDA"  dnn_version_info {{ major: 9 minor: 8 }}  device_description_str: "{name}" """
    return topologies.get_topology_desc(
        platform="cuda", topology_name=name, target_config=described, topology="1x1x1"
    ).devices[0]


def program_of(name, worlds):
    """(function, shapes of its arguments, donated ones, control ticks or None, physics steps a tick)."""
    if name != "walk":  # mean speed and its gradient over one gait cycle
        rollout, speed = differentiable_walk(1.0)
        ticks = round(rollout.seconds({"frequency": FREQUENCY}) / rollout.controller.dt) + 1
        points = jax.ShapeDtypeStruct((worlds, len(NAMES)), jnp.zeros(()).dtype)
        return (
            jax.vmap(with_gradient(speed, name)),
            (points,),
            (),
            ticks,
            rollout.engine.loop.steps_per_tick,
        )
    simulator = Simulator(Setup(spine="stride_extension"), "mjx", devices=1)
    engine, batch = simulator.engine, simulator.prepare({"frequency": np.full(1, FREQUENCY)})
    sizes = (engine.model.nq, engine.model.nv, engine.model.nsensordata)
    state = [jax.ShapeDtypeStruct((1, size), engine.data.qpos.dtype) for size in sizes]
    shapes = (batch.params, batch.fields, jax.eval_shape(engine.open_worlds, batch.params, *state))
    among = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(
            (worlds, *x.shape[1:]), jax.dtypes.canonicalize_dtype(x.dtype)
        ),
        shapes,
    )
    function = inspect.unwrap(engine.advance, stop=inspect.ismethod)
    return (
        function,
        (*among, jax.ShapeDtypeStruct((), jnp.int32)),
        (2,),
        None,
        simulator.loop.steps_per_tick,
    )


def figures(text, ticks, steps, worlds, bandwidth):
    """Launches, loops, bytes and bounds of a compiled program; `_per_step` is without the rest of a control tick."""
    module, count = Module(text, ROUNDS), ticks or 1
    if ticks is not None:
        tick, loops = module.work(module.entry), list(module.loops(module.entry))
    else:  # the caller says how many: an iteration of the outermost loop
        outer = max(
            (loop for loop, _ in module.loops(module.entry)),
            key=lambda loop: module.round(loop).launches,
        )
        tick, loops = module.round(outer), list(module.loops(outer.body))
    over_steps = [(loop, times) for loop, times in loops if loop.rounds == steps]
    within = {inner.body for loop, _ in over_steps for inner, _ in module.loops(loop.body)}
    chosen = (
        module.round(loop) * (steps * times)
        for loop, times in over_steps
        if loop.body not in within
    )
    step, tick = sum(chosen, Work()) * (1.0 / (count * steps)), tick * (1.0 / count)
    return {
        "kernels_per_step": round(step.kernels, 1),
        "library_calls_per_step": round(step.libraries, 1),
        "copies_per_step": round(step.copies, 1),
        "launches_per_step": round(step.launches, 1),
        "launches_per_tick": round(tick.launches, 1),
        "unknown_loops": sum(loop.rounds is None for loop, _ in loops),
        "moved_bytes_per_step": round(step.bytes / worlds),
        "estimated_launch_bound": worlds * steps / (tick.launches * LAUNCH_S + tick.waits * WAIT_S),
        "estimated_bandwidth_bound": worlds * steps * bandwidth / tick.bytes,
        "estimated_with": {"rounds": ROUNDS, "launch_s": LAUNCH_S, "wait_s": WAIT_S},
    }


@click.command(help=__doc__)
@click.option("--target", type=click.Choice(list(TARGETS)), default="h100")
@click.option("--program", type=click.Choice(["walk", "forward", "reverse"]), default="walk")
@click.option("--worlds", type=click.IntRange(1), default=1024)
@click.option(
    "--into", type=click.Path(path_type=Path), default=Path(__file__).with_suffix(".jsonl")
)
def main(target, program, worlds, into):
    jax.config.update("jax_platforms", "cpu")  # an accelerator in this machine is not used
    where = SingleDeviceSharding(device(*TARGETS[target]))
    function, arguments, donated, ticks, steps = program_of(program, worlds)
    jitted = jax.jit(function, donate_argnums=donated, in_shardings=where, out_shardings=where)
    compiled = compile_cold(jitted, *arguments)
    memory = compiled.program.memory_analysis()
    kept = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    needed = kept + memory.temp_size_in_bytes
    line = {
        "case": "gpu-plan",
        "target": target,
        "program": program,
        "worlds": worlds,
        "trace_s": compiled.trace_s,
        "compile_s": compiled.compile_s,
        "bytes_per_world": needed // worlds,
        "temporary_bytes_per_world": memory.temp_size_in_bytes // worlds,
        "fits": "yes" if needed <= TARGETS[target][10] else "no",
        **figures(compiled.program.as_text(), ticks, steps, worlds, TARGETS[target][11]),
        "peak_bytes": peak_bytes(),
    }
    append(into, run_of([line]))
    print(json.dumps(line, indent=2))


if __name__ == "__main__":
    main()
