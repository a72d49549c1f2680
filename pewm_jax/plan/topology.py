"""Devices that are described and not present, for which XLA's own compilers compile.

The compiler of TPUs is in the package libtpu, that of NVIDIA GPUs in JAX's CUDA plugin. Neither
needs a device or a driver. A TPU is described by its name, a GPU by the numbers in ``GPUS``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import itertools
import math
from collections.abc import Sequence
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.train.chips import Chip

EXTRAS = {"tpu": "plan-tpu", "cuda": "plan-cuda"}
"""Platform → the extra that installs its compiler."""
PACKAGES = {
    "tpu": ("libtpu",),
    "cuda": (
        "jax-cuda12-pjrt",
        "jax-cuda12-plugin",
        "nvidia-cuda-nvcc-cu12",
        "nvidia-cudnn-cu12",
    ),
}
"""Platform → the packages that its compiler needs, the compiler itself first."""
ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "TPU_SKIP_MDS_QUERY": "1",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "TPU_ACCELERATOR_TYPE": "v5p-8",
    "ALLOW_MULTIPLE_LIBTPU_LOAD": "1",
}
"""Environment variables of the process that compiles: no devices, no search for them, and no lock
that only one process may hold."""


@dataclasses.dataclass(frozen=True)
class GPU:
    """What XLA's CUDA compiler asks of a GPU.

    Origin: openxla/xla, ``xla/backends/gpu/target_config/specs``. Attributes are named as there.
    """

    core_count: int
    fpus_per_core: int
    shared_memory_per_core: int
    shared_memory_per_block_optin: int
    memory_bandwidth: int
    l2_cache_size: int
    clock_rate_ghz: float
    device_memory_size: int
    capability: int
    description: str
    minor: int = 0


_H100 = GPU(
    core_count=132,
    fpus_per_core=128,
    shared_memory_per_core=233472,
    shared_memory_per_block_optin=232448,
    memory_bandwidth=3352320000000,
    l2_cache_size=52428800,
    clock_rate_ghz=1.98,
    device_memory_size=84942979072,
    capability=9,
    description="NVIDIA H100 80GB HBM3",
)
GPUS = {
    "a100": GPU(
        core_count=108,
        fpus_per_core=64,
        shared_memory_per_core=167936,
        shared_memory_per_block_optin=166912,
        memory_bandwidth=2039040000000,
        l2_cache_size=41943040,
        clock_rate_ghz=1.41,
        device_memory_size=85100068864,
        capability=8,
        description="NVIDIA A100-SXM4-80GB",
    ),
    "rtx4090": GPU(
        core_count=128,
        fpus_per_core=128,
        shared_memory_per_core=102400,
        shared_memory_per_block_optin=101376,
        memory_bandwidth=1008096000000,
        l2_cache_size=75497472,
        clock_rate_ghz=2.52,
        device_memory_size=25757220864,
        capability=8,
        minor=9,
        description="NVIDIA GeForce RTX 4090",
    ),
    "h100": _H100,
    "h200": dataclasses.replace(
        _H100,
        memory_bandwidth=4800000000000,
        device_memory_size=151397597184,
        description="NVIDIA H200",
    ),
    "b200": dataclasses.replace(
        _H100,
        core_count=148,
        memory_bandwidth=7672320000000,
        l2_cache_size=132644864,
        clock_rate_ghz=1.965,
        device_memory_size=191514411008,
        capability=10,
        description="NVIDIA B200",
    ),
}
"""GPUs by the name of their ``Chip``."""
GIB = 2**30
USABLE = {
    "v4": 30.5 * GIB,
    "v5e": 15.75 * GIB,
    "v5p": 95.73 * GIB,
    "v6e": 31.24 * GIB,
    "tpu7x": 94.74 * GIB,
}
"""Bytes that libtpu 0.0.51 lets a program use on a device; it names them when it refuses one. The
number of v4 is twice that of one of its two cores."""
GPUS_OF_A_HOST = 8


def require_compiler(chip: Chip) -> None:
    """Check that a chip's compiler is installed; the error names the extra that installs it."""
    versions = _versions(chip)
    missing = [name for name in PACKAGES[chip.platform] if name not in versions]
    if missing:
        raise UserError(
            f"--compiler target for {chip.name} needs {', '.join(missing)}: run `pip install "
            f"'pewm-jax[{EXTRAS[chip.platform]}]'`, in an environment of its own if this one "
            "trains, or use --compiler cpu."
        )


def _versions(chip: Chip) -> dict[str, str]:
    """Return the versions of those of a compiler's packages that are installed."""
    found = {}
    for name in PACKAGES[chip.platform]:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def compiler(chip: Chip) -> dict[str, str]:
    """Return the name and version of a chip's compiler, with those of its libraries."""
    versions = _versions(chip)
    first, *others = versions
    beside = "".join(f", {name} {versions[name]}" for name in others)
    return {"name": first, "version": versions[first] + beside}


def capacity(chip: Chip) -> float:
    """Return the bytes of memory that a program may use on one device."""
    if chip.name in GPUS:
        return float(GPUS[chip.name].device_memory_size)
    return USABLE[chip.name]


def devices(chip: Chip, count: int, slices: int = 1) -> Sequence[Any]:
    """Return described devices; the process needs the variables of ``ENVIRONMENT``.

    Raises:
        UserError: the chip has no topology of this many devices.
    """
    require_slices(chip, slices)
    from jax.errors import JaxRuntimeError  # noqa: PLC0415
    from jax.experimental import topologies  # noqa: PLC0415 - loads the compiler's library

    if chip.platform == "cuda":
        hosts, beside = divmod(count, GPUS_OF_A_HOST)
        if hosts and beside:
            raise UserError(f"--devices is {count}: use a multiple of {GPUS_OF_A_HOST} GPUs.")
        shape = f"1x{hosts}x{GPUS_OF_A_HOST}" if hosts else f"1x1x{count}"
        described = topologies.get_topology_desc(
            chip.name,
            platform="cuda",
            target_config=target_config(GPUS[chip.name]),
            topology=shape,
        )
        return described.devices
    options = {"chip_config_name": "megacore"} if chip.name == "v4" else {}
    try:
        described = topologies.get_topology_desc(
            platform="tpu",
            topology_name=tpu_topology(chip, count // slices),
            **({"num_slices": slices} if slices > 1 else {}),
            **options,
        )
    except JaxRuntimeError as error:
        if "INVALID_ARGUMENT" not in str(error):
            raise
        raise _no_topology(chip, count) from error
    if len(described.devices) != count:
        raise _no_topology(chip, count)
    return described.devices


def one_device(chip: Chip) -> Any:
    """Return one described device, of the smallest topology that a chip has."""
    return devices(chip, 2 if chip.name == "tpu7x" else 1)[0]


def _no_topology(chip: Chip, count: int) -> UserError:
    return UserError(
        f"--devices is {count}: {chip.name} has no topology of that many; use a power of 2"
        f"{', at least 2' if chip.name == 'tpu7x' else ''}."
    )


def require_slices(chip: Chip, slices: int) -> None:
    """Raise an error if a chip has no slices."""
    if slices > 1 and chip.platform != "tpu":
        raise UserError(
            f"--slices is {slices}: {chip.name} has none; only TPUs are made up of slices."
        )


def of_slices(chip: Chip, count: int, slices: int) -> Chip:
    """Return a chip whose islands of fast links are the slices that ``count`` devices make up."""
    return dataclasses.replace(chip, island=count // slices) if slices > 1 else chip


def tpu_topology(chip: Chip, count: int) -> str:
    """Return the name of the topology of this many devices closest to a square or cube.

    Raises:
        UserError: there is none.
    """
    chips, odd = divmod(count, 2) if chip.name == "tpu7x" else (count, 0)
    axes = 2 if chip.name in ("v5e", "v6e") else 3
    divisors = [n for n in range(1, chips + 1) if chips % n == 0]
    shapes = [
        shape
        for shape in itertools.combinations_with_replacement(divisors, axes)
        if math.prod(shape) == chips and (chips < 4 or sum(side % 2 == 0 for side in shape) >= 2)
    ]
    if odd or not shapes:
        raise _no_topology(chip, count)
    shape = min(shapes, key=lambda sides: max(sides) - min(sides))
    if axes == 3:
        shape = sorted(shape, reverse=chips <= 4)  # a host is 2 × 2 × 1
    return f"{chip.name}:{'x'.join(map(str, shape))}"


def target_config(gpu: GPU) -> str:
    """Return XLA's ``GpuTargetConfigProto`` of a GPU in text form."""
    own = dataclasses.asdict(gpu)
    capability, description = own.pop("capability"), own.pop("description")
    minor = own.pop("minor")
    minor = f" minor: {minor}" if minor else ""
    common = {
        "threads_per_block_limit": 1024,
        "threads_per_warp": 32,
        "shared_memory_per_block": 49152,
        "threads_per_core_limit": 2048,
        "block_dim_limit_x": 2147483647,
        "block_dim_limit_y": 65535,
        "block_dim_limit_z": 65535,
        "registers_per_core_limit": 65536,
        "registers_per_block_limit": 65536,
    }
    fields = " ".join(f"{name}: {value}" for name, value in {**own, **common}.items())
    return (
        f"gpu_device_info {{ {fields} cuda_compute_capability {{ major: {capability}{minor} }} }} "
        'runtime_version { major: 12 minor: 8 patch: 0 } platform_name: "CUDA" '
        f'dnn_version_info {{ major: 9 minor: 7 }} device_description_str: "{description}"'
    )
