"""Settings of NoMaD, a policy that proposes waypoints."""

from __future__ import annotations

import dataclasses

from pewm_jax.errors import require, require_positive

PLANE = 2
"""Numbers of a waypoint: metres forward and metres left of the present place."""


@dataclasses.dataclass(frozen=True)
class NomadConfig:
    """The network; by default as published (Sridhar et al. 2023, arXiv 2310.07896)."""

    height: int = 96
    """Height of the pictures it sees, pixels; others are resized."""
    width: int = 96
    """Width of the pictures it sees, pixels."""
    context: int = 3
    """Earlier pictures that it sees beside the present one."""
    trunk_width: float = 1.0
    """Channels of the two EfficientNets, as a multiple of B0's."""
    trunk_depth: float = 1.0
    """Blocks of the two EfficientNets, as a multiple of B0's."""
    trunk_stages: int = 7
    """Stages of blocks of the two EfficientNets; B0 has seven."""
    dim: int = 256
    """Width of the tokens and of the condition."""
    layers: int = 4
    """Transformer layers over the pictures' tokens."""
    heads: int = 4
    """Attention heads."""
    waypoints: int = 8
    """Waypoints of a proposal."""
    channels: tuple[int, ...] = (64, 128, 256)
    """Channels of the denoiser at each resolution; each has half as many points as the one
    before."""
    time_dim: int = 256
    """Width of the embedding of the noise level."""
    kernel: int = 3
    """Waypoints under a kernel of the denoiser."""
    groups: int = 8
    """Groups of the denoiser's norms."""
    noise_steps: int = 10
    """Noise levels, in training and in sampling."""
    spacing_m: float = 0.25
    """Metres that count as 1 in a step between waypoints."""
    lowest: tuple[float, float] = (-2.5, -4.0)
    """Step forward and left, in spacings, that maps to −1."""
    highest: tuple[float, float] = (5.0, 4.0)
    """Step forward and left, in spacings, that maps to +1; no longer ones are proposed."""

    def __post_init__(self):
        """Validate."""
        sizes = ("height", "width", "context", "trunk_stages", "dim", "layers", "heads")
        more = ("waypoints", "time_dim", "kernel", "groups", "noise_steps")
        require_positive(self, "policy", *sizes, *more)
        for name in ("trunk_width", "trunk_depth", "spacing_m"):
            value = getattr(self, name)
            require(value > 0, f"policy.{name} is {value}: use more than 0.")
        require(
            self.trunk_stages <= 7,
            f"policy.trunk_stages is {self.trunk_stages}: an EfficientNet has 7 stages.",
        )
        require(
            self.dim % (2 * self.heads) == 0 and self.dim >= 16,
            f"policy.dim is {self.dim}: use a multiple of twice policy.heads ({self.heads}), from "
            "16 on.",
        )
        require(
            self.time_dim % 2 == 0 and self.time_dim >= 4,
            f"policy.time_dim is {self.time_dim}: use an even number from 4 on.",
        )
        require(self.kernel % 2 == 1, f"policy.kernel is {self.kernel}: use an odd number.")
        require(
            len(self.channels) >= 1
            and all(n > 0 and n % self.groups == 0 for n in self.channels)
            and self.waypoints % 2 ** (len(self.channels) - 1) == 0,
            f"policy.channels is {self.channels}: use multiples of policy.groups ({self.groups}), "
            f"and so few that policy.waypoints ({self.waypoints}) can be halved for each but one.",
        )
        require(
            all(low < high for low, high in zip(self.lowest, self.highest, strict=True)),
            f"policy.lowest {self.lowest} and policy.highest {self.highest}: the first must be "
            "below the second.",
        )
