"""The hardware that a program is traced for: a platform, and a GPU's compute capability.

Some kernels exist on one platform only and must be chosen while a program is traced, because JAX
asks for their libraries then. ``current`` returns the target of the trace: the one that ``use``
names, or that of the devices of this process. A program can therefore be traced, lowered and
compiled for hardware that this process does not have. The target is part of the key of JAX's
caches: one function traced for two targets is traced twice.

Where both forms of a computation can be traced everywhere, ``jax.lax.platform_dependent`` chooses
between them when the program is lowered.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import jax


@dataclasses.dataclass(frozen=True)
class Target:
    """A kind of device.

    Attributes:
        platform: ``cpu``, ``cuda`` or ``tpu``, or another platform of JAX.
        capability: an NVIDIA GPU's compute capability (major, minor); (0, 0) elsewhere.
    """

    platform: str
    capability: tuple[int, int] = (0, 0)

    @property
    def has_cudnn_attention(self) -> bool:
        """Whether cuDNN has flash attention for it: Ampere or newer."""
        return self.platform == "cuda" and self.capability >= (8, 0)


_CURRENT: Any = jax.make_user_context(None)


def of_devices(devices: Sequence[Any] | None = None) -> Target:
    """Return the target of devices of one kind, by default those of this process.

    They may be the devices of a described topology.
    """
    first = jax.local_devices()[0] if devices is None else devices[0]
    major, dot, minor = str(getattr(first, "compute_capability", "")).partition(".")
    if first.platform == "gpu" and dot:  # AMD's GPUs have other names
        return Target("cuda", (int(major), int(minor)))
    return Target(first.platform)


def use(target: Target) -> AbstractContextManager[None]:
    """Return a context in which programs are traced for a target."""
    return _CURRENT(target)


def current() -> Target:
    """Return the target of the trace: that of ``use``, or of the devices of this process."""
    return _CURRENT.value or of_devices()
