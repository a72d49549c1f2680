"""Peak compute, memory and network rates of accelerators, from their makers' data sheets.

Model FLOPs utilization (MFU) is relative to the peak listed here, and cost plans use all rates.
Rates are per device and in one direction; peaks are dense bfloat16 products with float32
accumulation, without NVIDIA's doubling for sparse matrices.
"""

from __future__ import annotations

import dataclasses
import re

from pewm_jax.config import ConfigError


@dataclasses.dataclass(frozen=True)
class Chip:
    """One kind of device.

    Attributes:
        name: value of ``--chip``.
        device_kind: regular expression that matches JAX's ``device_kind`` and common spellings.
        flops: peak FLOP/s in bfloat16, dense.
        memory: bytes of device memory.
        bandwidth: memory bandwidth in bytes/s.
        island: number of devices joined by fast links: a GPU node or a TPU pod.
        link: bytes/s that a device sends within the island in a collective along one mesh axis.
        network: bytes/s that a device sends to other islands.
        source: the data sheet of the figures.
    """

    name: str
    device_kind: str
    flops: float
    memory: float
    bandwidth: float
    island: int
    link: float
    network: float
    source: str

    @property
    def platform(self) -> str:
        """Return JAX's name of the platform."""
        return "tpu" if "TPU" in self.device_kind else "cuda"


CHIPS = (
    Chip(
        name="a100",
        device_kind=r"A100|(NVIDIA )?A100( SXM4)? 80GB",
        flops=312e12,
        memory=80e9,
        bandwidth=2039e9,
        island=8,
        link=300e9,
        network=25e9,
        source="NVIDIA A100 data sheet (SXM, 80 GB); DGX A100: 8 × 200 Gb/s",
    ),
    Chip(
        name="rtx4090",
        device_kind=r"(NVIDIA )?(GeForce )?RTX ?4090",
        flops=165.2e12,
        memory=24e9,
        bandwidth=1008e9,
        island=1,
        link=32e9,
        network=12.5e9,
        source="NVIDIA Ada GPU architecture (GeForce RTX 4090); PCIe 4.0 × 16; 100 Gb/s Ethernet",
    ),
    Chip(
        name="h100",
        device_kind=r"(NVIDIA )?H100( 80GB HBM3| SXM5?)?",
        flops=989.4e12,
        memory=80e9,
        bandwidth=3.35e12,
        island=8,
        link=450e9,
        network=50e9,
        source="NVIDIA H100 data sheet (SXM); DGX H100: 8 × 400 Gb/s",
    ),
    Chip(
        name="h200",
        device_kind=r"(NVIDIA )?H200( SXM5?)?",
        flops=989.4e12,
        memory=141e9,
        bandwidth=4.8e12,
        island=8,
        link=450e9,
        network=50e9,
        source="NVIDIA H200 data sheet (SXM); DGX H200: 8 × 400 Gb/s",
    ),
    Chip(
        name="b200",
        device_kind=r"(NVIDIA )?B200",
        flops=2250e12,
        memory=180e9,
        bandwidth=8e12,
        island=8,
        link=900e9,
        network=50e9,
        source="NVIDIA DGX B200 data sheet: an eighth of the system; 8 × 400 Gb/s",
    ),
    # A collective along one mesh axis uses one axis of the torus in both directions: two of the
    # 6 (v4, v5p, tpu7x) or 4 (v5e, v6e) links. The links share the bandwidth stated per chip, which
    # counts both directions.
    Chip(
        name="v4",
        device_kind=r"TPU v4|v4",
        flops=275e12,
        memory=32 * 2**30,
        bandwidth=1228e9,
        island=4096,
        link=600e9 / 2 / 3,
        network=50e9 / 8,
        source="Google Cloud, TPU v4: 2400 Gb/s each way over 6 links; network taken from v5p",
    ),
    Chip(
        name="v5e",
        device_kind=r"TPU v5( lite|e)|v5e",
        flops=197e12,
        memory=16 * 2**30,
        bandwidth=819e9,
        island=256,
        link=400e9 / 2 / 2,
        network=6.4e12 / 256 / 8,
        source="Google Cloud, TPU v5e: 400 GB/s over 4 links both ways, network 6.4 Tb/s a pod",
    ),
    Chip(
        name="v5p",
        device_kind=r"TPU v5p?|v5p",
        flops=459e12,
        memory=95 * 2**30,
        bandwidth=2765e9,
        island=8960,
        link=1200e9 / 2 / 3,
        network=50e9 / 8,
        source="Google Cloud, TPU v5p: 1200 GB/s over 6 links both ways, network 50 Gb/s per chip",
    ),
    Chip(
        name="v6e",
        device_kind=r"TPU v6( lite|e)|v6e|trillium",
        flops=918e12,
        memory=32 * 2**30,
        bandwidth=1638e9,
        island=256,
        link=800e9 / 2 / 2,
        network=100e9 / 8,
        source="Google Cloud, TPU v6e: 800 GB/s over 4 links both ways, network 100 Gb/s per chip",
    ),
    # JAX has two devices for each chip.
    Chip(
        name="tpu7x",
        device_kind=r"TPU ?7x|TPU v7x?|tpu7x|ironwood",
        flops=2307e12 / 2,
        memory=192 * 2**30 / 2,
        bandwidth=7380e9 / 2,
        island=2 * 9216,
        link=1200e9 / 2 / 3 / 2,
        network=100e9 / 8 / 2,
        source="Google Cloud, TPU7x: 1200 GB/s over 6 links both ways, network 100 Gb/s a chip",
    ),
)
"""All known chips."""


def find(device_kind: str) -> Chip | None:
    """Return the chip of a device kind, or None if it is unknown.

    The kind is ``jax.devices()[0].device_kind``, such as "NVIDIA H200" or "TPU v6 lite", or a
    common spelling, such as "h200" or "tpu-v5p".
    """
    plain = " ".join(re.split(r"[\s_-]+", device_kind.strip()))
    for chip in CHIPS:
        if re.fullmatch(chip.device_kind, plain, re.IGNORECASE):
            return chip
    return None


def named(name: str) -> Chip:
    """Return the chip with the name given by ``--chip``; raise ConfigError if it is unknown."""
    chip = find(name)
    if chip is None:
        known = ", ".join(chip.name for chip in CHIPS)
        raise ConfigError(f"--chip {name!r} is unknown: choose one of {known}.")
    return chip
