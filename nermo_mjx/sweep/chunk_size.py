"""The default number of rows per chunk: enough to fill the machine, but no great loss if it is killed."""

from __future__ import annotations

import math
from typing import Final

import jax

from nermo_mjx.physics import resolve_engine
from nermo_mjx.physics.devices import choose_devices
from nermo_mjx.runtime import cpu_count

#: Rows of a chunk for each core with MuJoCo C: with two cores, 64 walks of eight cycles take six seconds.
CORE_ROWS = 32
#: Number of chunks above which chunks grow, and by up to which factor: each is a file, and is checked on resuming.
MANY_CHUNKS, MOST_GROWTH = 10_000, 10
#: Share of a device's memory for a batch.
MEMORY_SHARE: Final = 0.5
#: What a world takes of it, by engine [bytes]. `mjx`: what XLA plans for a walk, arguments and results included, by
#: docs/benchmarks/gpu_plan.py; a test holds it to the latest run there. `warp` allocates memory
#: that the plan does not see: a guess, and a conservative one.
WORLD_BYTES: Final = {"mjx": 36_000, "warp": 1_000_000}
#: Worlds that saturate a device; more of them only take longer, and are lost together.
BUSY_WORLDS = 8192


def chunk_rows(
    engine: str, rows: int, *, memory: int | None = None, devices: int = 1, cores: int = 1, parts: int = 1
) -> int:
    """Rows of a chunk.

    Args:
        engine: name of the engine that runs, `c` or one for devices.
        rows: of the whole sweep.
        memory: of one device [bytes]; None for the CPU, also as a device.
        devices: that share a batch; the result is a multiple of them.
        cores: of this machine.
        parts: processes that share the chunks; each should get one.
    """
    share = math.ceil(rows / parts)
    if engine == "c" or memory is None:
        usual = CORE_ROWS * cores
        return min(max(usual, min(math.ceil(rows / MANY_CHUNKS), usual * MOST_GROWTH)), share)
    worlds = min(int(memory * MEMORY_SHARE / WORLD_BYTES[engine]), BUSY_WORLDS)
    return max(min(worlds, math.ceil(share / devices)), 1) * devices


def chunk_rows_here(engine: str, rows: int, parts: int = 1) -> int:
    """`chunk_rows` for this machine's devices and cores."""
    cores = cpu_count()
    engine = resolve_engine(engine)
    memory, devices = (None, 1) if engine == "c" else (_device_memory(), choose_devices().count)
    return chunk_rows(engine, rows, memory=memory, devices=devices, cores=cores, parts=parts)


def _device_memory() -> int | None:
    """Memory of the smallest local device [bytes]; None if it is not reported, as on a CPU."""
    known = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.local_devices()]
    return None if None in known else min(int(each) for each in known if each is not None)
