"""The device mesh: how devices are arranged."""

from __future__ import annotations

import dataclasses
import math

from pewm_jax.errors import ConfigError, require

AXES = ("data", "fsdp", "tensor", "context")
"""The mesh axes, outermost first; devices along the last ones communicate most."""


@dataclasses.dataclass(frozen=True)
class MeshConfig:
    """The number of devices along each mesh axis; their product is the number of devices."""

    data: int = 0
    """Copies of the weights, each with its part of the batch (data parallelism); 0 uses all devices
    that the other axes leave."""
    fsdp: int = 1
    """Parts that the weights and the batch are split into (fully sharded data parallelism)."""
    tensor: int = 1
    """Parts that heads and feed-forward channels are split into."""
    context: int = 1
    """Parts that a clip's video tokens are split into."""

    def __post_init__(self):
        """Validate."""
        for name in AXES:
            least = 0 if name == "data" else 1
            value = getattr(self, name)
            require(value >= least, f"train.mesh.{name} is {value}: use {least} or more.")

    def shape(self, devices: int) -> tuple[int, int, int, int]:
        """Return the sizes along ``AXES`` for a number of devices.

        Raises:
            ConfigError: the sizes do not multiply to the number of devices.
        """
        rest = math.prod((self.fsdp, self.tensor, self.context))
        data = self.data or max(devices // rest, 1)
        if data * rest != devices:
            raise ConfigError(
                f"train.mesh asks for data {self.data or 'the rest'} × fsdp {self.fsdp} × tensor "
                f"{self.tensor} × context {self.context} and there are {devices} devices: choose "
                "axes whose product is that number."
            )
        return data, self.fsdp, self.tensor, self.context
