"""GPUs that XLA can compile for on machines without one: XLA's description, and a device to compile for."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

from jax.experimental import topologies


@dataclasses.dataclass(frozen=True)
class GpuTarget:
    """Properties of a GPU for the compiler and the estimates; from NVIDIA's data sheets and device queries.

    Attributes:
        name: as the driver reports it.
        capability: compute capability, major and minor.
        cores, units, clock: multiprocessors, float32 units of each, and their clock [GHz].
        threads: maximum number of threads per multiprocessor.
        shared, shared_block: shared memory of a multiprocessor, and the maximum per block [bytes].
        cache, memory: second-level cache and memory of the device [bytes].
        bandwidth: memory bandwidth [bytes/s].
    """

    name: str
    capability: tuple[int, int]
    cores: int
    units: int
    clock: float
    threads: int
    shared: int
    shared_block: int
    cache: int
    memory: int
    bandwidth: float

    def describe(self) -> str:
        """The device as XLA reads it, a `GpuTargetConfigProto` in text form."""
        major, minor = self.capability
        return f"""
gpu_device_info {{
  threads_per_block_limit: 1024  threads_per_warp: 32  threads_per_core_limit: {self.threads}
  shared_memory_per_block: 49152  shared_memory_per_core: {self.shared}
  shared_memory_per_block_optin: {self.shared_block}
  core_count: {self.cores}  fpus_per_core: {self.units}  clock_rate_ghz: {self.clock}
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  memory_bandwidth: {self.bandwidth:.0f}  l2_cache_size: {self.cache}  device_memory_size: {self.memory}
  cuda_compute_capability {{ major: {major} minor: {minor} }}
  registers_per_core_limit: 65536  registers_per_block_limit: 65536
}}
platform_name: "CUDA"
dnn_version_info {{ major: 9 minor: 8 }}
device_description_str: "{self.name}"
"""

    def device(self) -> Any:
        """The GPU as a device that programs are compiled for, and never run on; needs the extra `gpu-plan`."""
        described = topologies.get_topology_desc(
            platform="cuda", topology_name=self.name, target_config=self.describe(), topology="1x1x1"
        )
        return described.devices[0]


TARGETS: Final[dict[str, GpuTarget]] = {
    "h100": GpuTarget(
        "NVIDIA H100 80GB HBM3", (9, 0), cores=132, units=128, clock=1.98, threads=2048, shared=233_472,
        shared_block=232_448, cache=52_428_800, memory=84_942_979_072, bandwidth=3.352e12,
    ),
    "a100": GpuTarget(
        "NVIDIA A100-SXM4-80GB", (8, 0), cores=108, units=64, clock=1.41, threads=2048, shared=167_936,
        shared_block=166_912, cache=41_943_040, memory=85_100_068_864, bandwidth=2.039e12,
    ),
    "l4": GpuTarget(
        "NVIDIA L4", (8, 9), cores=58, units=128, clock=2.04, threads=1536, shared=102_400,
        shared_block=101_376, cache=50_331_648, memory=23_580_639_232, bandwidth=3.0e11,
    ),
    "t4": GpuTarget(
        "Tesla T4", (7, 5), cores=40, units=64, clock=1.59, threads=1024, shared=65_536,
        shared_block=65_536, cache=4_194_304, memory=15_642_329_088, bandwidth=3.2e11,
    ),
}  # fmt: skip
