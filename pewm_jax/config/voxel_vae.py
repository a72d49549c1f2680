"""The settings of the autoencoder of voxels: class ids to latents and back."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class VoxelVAEConfig:
    """A 3D autoencoder over class ids; by default as published for PERSIST (arXiv 2603.03482)."""

    side: int = 48
    """Cells along each side of the grid."""
    classes: int = 2138
    """Class ids, 0 … classes − 1, of which 0 is an empty cell."""
    patch: int = 1
    """Cells, along each axis, that are folded into the channels before the first level. Small
    networks fold 4, which leaves them few places to compute at."""
    embed: int = 32
    """Channels of the learned vector of a class. With patch 1 it is the first level's width."""
    widths: tuple[int, ...] = (32, 128, 512)
    """Channels of the levels; each has half as many places along an axis as the one before."""
    blocks: int = 2
    """Residual blocks of a level of the encoder; the decoder's have one more."""
    middle: int = 2
    """Residual blocks between the levels and the latents, in the encoder and in the decoder."""
    kernel: int = 3
    """Places along an axis under a kernel of the levels' residual blocks: 3, or 1 for blocks that
    see one place each."""
    middle_kernel: int = 3
    """Places along an axis under a kernel next to the latents: of the blocks in the middle, of the
    encoder's last convolution and of the decoder's first. With 1 here and in ``kernel``, and one
    level, a latent tells of its own patch alone."""
    latent_channels: int = 48
    """Channels of a latent."""
    kl: float = 1e-6
    """Weight of the Kullback-Leibler divergence from a standard normal distribution, per latent
    number."""
    occupied_weight: float = 1.0
    """Weight of the error at an occupied cell, where an empty one weighs 1."""
    convolution: Literal["auto", "xla", "products"] = "auto"
    """How 3D convolutions are computed. `xla`: by XLA. `products`: as matrix products of shifted
    copies. `auto`: products on a CPU, else XLA."""
    cube: int = 0
    """Cells along an axis of the cubes, cut out around occupied cells, from which training learns;
    0 for whole grids, most of which is air."""
    cubes: int = 16
    """Cubes cut out of each grid at every step, where ``cube`` is not 0."""
    compared: int = 0
    """Cells of each grid or cube, drawn at random at every step, at which training compares the
    class with the true one; 0 for all. With many classes and few processors the scores are most of
    the work. Occupied cells are drawn more often, by their weight, and then weigh as much as
    others."""
    slab: int = 0
    """Layers of cells at a time whose scores are held when class ids are compared or decoded; 0
    for all at once. At published sizes the scores of one grid take almost a gigabyte."""

    @property
    def factor(self) -> int:
        """Cells along an axis of the grid for one latent."""
        return self.patch * 2 ** (len(self.widths) - 1)

    @property
    def latent_side(self) -> int:
        """Latents along each side of the grid."""
        return self.side // self.factor

    def __post_init__(self):
        """Validate."""
        sizes = ("side", "patch", "embed", "blocks", "latent_channels")
        require_positive(self, "voxel_vae", *sizes)
        require(
            self.classes >= 2,
            f"voxel_vae.classes is {self.classes}: use at least 2, of which one is empty.",
        )
        for name in ("middle", "compared", "cube"):
            value = getattr(self, name)
            require(value >= 0, f"voxel_vae.{name} is {value}: use 0 or more.")
        widths = list(self.widths)
        require(
            len(widths) >= 1 and min(widths) >= 1,
            f"voxel_vae.widths is {self.widths}: name at least one number of channels.",
        )
        require(
            self.side % self.factor == 0,
            f"voxel_vae.side is {self.side}: use a multiple of {self.factor}, which is voxel_vae."
            "patch doubled for each level after the first.",
        )
        require(
            self.patch > 1 or self.embed == widths[0],
            f"voxel_vae.embed is {self.embed}: with voxel_vae.patch 1 use the first of voxel_vae."
            f"widths ({widths[0]}).",
        )
        require(
            self.cube <= self.side and self.cube % self.factor == 0 and self.cubes >= 1,
            f"voxel_vae.cube is {self.cube} and voxel_vae.cubes {self.cubes}: use a multiple of "
            f"{self.factor} up to voxel_vae.side ({self.side}), and 1 cube or more.",
        )
        require(
            not (self.cube and self.slab),
            f"voxel_vae.slab is {self.slab}: it is of whole grids, and with voxel_vae.cube cubes "
            "are compared; use 0 for one of them.",
        )
        for name in ("kernel", "middle_kernel"):
            value = getattr(self, name)
            require(value in (1, 3), f"voxel_vae.{name} is {value}: use 1 or 3.")
        require(
            self.kl >= 0 and self.occupied_weight > 0,
            "voxel_vae.kl must be 0 or more, and voxel_vae.occupied_weight above 0.",
        )
        require(
            self.slab >= 0 and (self.slab == 0 or self._slabs_fit),
            f"voxel_vae.slab is {self.slab}: use 0, or a multiple of voxel_vae.patch "
            f"({self.patch}) that divides voxel_vae.side ({self.side}).",
        )

    @property
    def _slabs_fit(self) -> bool:
        return self.slab % self.patch == 0 and self.side % self.slab == 0
