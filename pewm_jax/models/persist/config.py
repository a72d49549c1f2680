"""Settings of PERSIST's networks; by default as published."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive


def _require_classes(classes: int, where: str) -> None:
    require(classes >= 2, f"{where}.classes is {classes}: use at least 2, of which one is empty.")


@dataclasses.dataclass(frozen=True)
class BlocksConfig:
    """The blocks shared by PERSIST's networks; by default as published."""

    layers: int = 12
    """Transformer blocks."""
    heads: int = 16
    """Attention heads."""
    head_dim: int = 64
    """Width of a head; even, the rotary embedding of time rotates pairs of channels."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""
    context: int = 8
    """Frames that a frame attends to over time: itself and those before it."""
    gates: Literal["zero", "open"] = "zero"
    """Initial values of the modulation's gates. `zero`: every block is the identity, as
    published. `open`: 1, with which small networks learn faster."""
    modulation: Literal["own", "shared"] = "own"
    """`own`: every block computes its modulation from the condition, as published. `shared`: the
    blocks share that linear layer and add a learned vector each (adaLN-single, arXiv 2310.00426),
    which takes less than a third of the parameters of a block."""
    rotary: bool = False
    """Rotary position embedding (arXiv 2104.09864) in the attention inside of a frame, so that it
    depends on distances along each axis, besides the added sinusoids; not as published."""
    attention: Literal["auto", "xla", "cudnn", "splash"] = "auto"
    """The kernel of attention inside of a frame and to pixels: `cudnn` is flash attention on NVIDIA
    GPUs in 16 bits, `splash` is flash attention on TPUs, `xla` runs anywhere, `auto` uses the best
    kernel of the hardware."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    def __post_init__(self):
        """Validate."""
        require_positive(self, "blocks", "layers", "heads", "head_dim", "mlp_ratio", "context")
        require(
            self.head_dim % 2 == 0,
            f"blocks.head_dim is {self.head_dim}: use an even number, the rotary embedding of time "
            "rotates pairs of channels.",
        )
        require(
            not self.rotary or self.head_dim >= 6,
            f"blocks.head_dim is {self.head_dim}: use 6 or more with blocks.rotary, a pair of "
            "channels for each of three axes.",
        )
        require(
            self.width % 4 == 0,
            f"blocks.heads × blocks.head_dim is {self.width}: use a multiple of 4.",
        )


@dataclasses.dataclass(frozen=True)
class VoxelVAEConfig:
    """A 3D autoencoder over class ids; by default as published for PERSIST (arXiv 2603.03482)."""

    side: int = 48
    """Cells along each side of the grid."""
    classes: int = 2138
    """Class ids, 0 … classes − 1, of which 0 is an empty cell."""
    patch: int = 1
    """Cells, along each axis, that are folded into the channels before the first level. Small
    networks fold 4, which leaves fewer positions to compute at."""
    embed: int = 32
    """Channels of the learned vector of a class. With patch 1 it is the first level's width."""
    widths: tuple[int, ...] = (32, 128, 512)
    """Channels of the levels; each has half as many places along an axis as the one before."""
    blocks: int = 2
    """Residual blocks of a level of the encoder; the decoder's have one more."""
    middle: int = 2
    """Residual blocks between the levels and the latents, in the encoder and in the decoder."""
    kernel: int = 3
    """Places along an axis under a kernel of the levels' residual blocks: 3, or 1 for blocks of
    linear layers."""
    middle_kernel: int = 3
    """Places along an axis under a kernel next to the latents: of the blocks in the middle, of the
    encoder's last convolution and of the decoder's first. With 1 here and in ``kernel``, and one
    level, a latent depends on its own patch alone."""
    latent_channels: int = 48
    """Channels of a latent."""
    kl: float = 1e-6
    """Weight of the Kullback-Leibler divergence from a standard normal distribution, per latent
    number."""
    occupied_weight: float = 1.0
    """Weight of the error at an occupied cell, where that of an empty cell is 1."""
    convolution: Literal["auto", "xla", "products"] = "auto"
    """How 3D convolutions are computed. `xla`: by XLA. `products`: as matrix products of shifted
    copies. `auto`: products on a CPU, else XLA."""
    cube: int = 0
    """Cells along an axis of the cubes, cut out around occupied cells, on which it is trained;
    0 for whole grids, most of which is empty."""
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
        _require_classes(self.classes, "voxel_vae")
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


@dataclasses.dataclass(frozen=True)
class VoxelDiTConfig:
    """The diffusion transformer that makes the next voxel frame; by default as published."""

    latent_side: int = 12
    """Latents along each side of a voxel frame."""
    latent_channels: int = 48
    """Channels of a latent."""
    patch: int = 2
    """Latents along each axis for one token: 2 (216 tokens of a published frame) or 1 (1,728)."""
    patch_z: int = 0
    """Latents along z for one token; 0 for `patch`. A token of all levels is a column: walls are
    upright, so columns have fewer possible contents than cubes of as many cells."""
    actions: int = 23
    """Numbers of an action."""
    camera_numbers: int = 10
    """Numbers of the camera by which a frame was seen; 0 if cameras are not given."""
    pixel_channels: int = 16
    """Channels of the picture's latents, to which frames attend."""
    pixel_patch: int = 2
    """Latents of the picture along each axis for one token."""
    map_embed: int = 0
    """Channels of the learned vectors of the cells that the map holds, and of the mask beside them
    (unknown, guessed, observed), in its input; 0 for none, as published."""
    map_ids: int = 0
    """Ids of such cells, where `map_embed` is not 0: the classes, a colour each for surfaces whose
    kind is not known yet, and one for surfaces of unknown colour."""
    map_cells: int = 1
    """Cells along an axis of the grid for one latent, where `map_embed` is not 0."""
    storey: tuple[int, int] = (0, 0)
    """The first latent along z that it predicts, and the one after the last; (0, 0) for all, as
    published. Cells above and below are empty unless they are known."""
    blocks: BlocksConfig = BlocksConfig()
    """The transformer blocks."""

    def __post_init__(self):
        """Validate."""
        names = ("latent_side", "latent_channels", "patch", "actions", "pixel_channels")
        require_positive(self, "voxel_dit", *names, "pixel_patch", "map_cells")
        require(
            self.map_embed >= 0 and (self.map_ids >= 2 or not self.map_embed),
            f"voxel_dit.map_embed is {self.map_embed} and voxel_dit.map_ids {self.map_ids}: use 0 "
            "channels for no map, or 1 or more and at least 2 ids.",
        )
        require(
            self.camera_numbers >= 0,
            f"voxel_dit.camera_numbers is {self.camera_numbers}: use 0 for none, or 10.",
        )
        require(
            self.latent_side % self.patch == 0,
            f"voxel_dit.latent_side is {self.latent_side}: use a multiple of voxel_dit.patch "
            f"({self.patch}).",
        )
        low, high = self.storey
        require(
            (low, high) == (0, 0) or 0 <= low < high <= self.latent_side,
            f"voxel_dit.storey is {self.storey}: name the first latent along z and the one after "
            f"the last, from 0 to {self.latent_side}, or 0 0 for all.",
        )
        low, high = self.levels
        require(
            self.patch_z >= 0 and (high - low) % self.patches[2] == 0,
            f"voxel_dit.patch_z is {self.patch_z}, voxel_dit.patch {self.patch} and voxel_dit."
            f"storey {self.storey}: {high - low} latents along z are predicted; use a patch_z that "
            "divides them, or 0 for voxel_dit.patch.",
        )

    @property
    def patches(self) -> tuple[int, int, int]:
        """Latents of a token along x, y and z."""
        return self.patch, self.patch, self.patch_z or self.patch

    @property
    def token_sides(self) -> tuple[int, int, int]:
        """Tokens of a frame along x, y and z."""
        low, high = self.levels
        x, y, z = self.patches
        return self.latent_side // x, self.latent_side // y, (high - low) // z

    @property
    def levels(self) -> tuple[int, int]:
        """The first latent along z that is predicted, and the one after the last."""
        return (0, self.latent_side) if self.storey == (0, 0) else self.storey

    @property
    def tokens(self) -> int:
        """Tokens of a frame."""
        x, y, z = self.token_sides
        return x * y * z


@dataclasses.dataclass(frozen=True)
class CameraModelConfig:
    """The transformer that predicts the camera; by default as published."""

    classes: int = 2138
    """Class ids of the voxels."""
    inner: int = 4
    """Voxels along each axis, around the middle of the grid, in its input."""
    embed: int = 32
    """Channels of the learned vector of a class."""
    actions: int = 23
    """Numbers of an action."""
    units: tuple[float, float, float, float, float, float] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """The unit of each number of a step: forward, left and up in metres; pitch, yaw and
    field of view in radians."""
    blocks: BlocksConfig = BlocksConfig()
    """The transformer blocks; a frame is one token."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "camera_model", "inner", "embed", "actions")
        _require_classes(self.classes, "camera_model")
        require(
            len(self.units) == 6 and min(self.units) > 0,
            f"camera_model.units is {self.units}: name six numbers above 0.",
        )


@dataclasses.dataclass(frozen=True)
class VoxelRendererConfig:
    """The diffusion transformer that renders images of voxels; by default as published."""

    classes: int = 2138
    """Class ids of the voxels."""
    height: int = 36
    """Rows of the picture's latents; a ray is cast through the centre of each."""
    width: int = 64
    """Columns of the picture's latents."""
    latent_channels: int = 16
    """Channels of the picture's latents."""
    rays: int = 1
    """Rays through each latent, along its rows and along its columns; 1 as published, more where a
    latent covers many pixels."""
    layers: int = 192
    """Occupied voxels along a ray that are used, nearest first."""
    embed: int = 32
    """Channels of the learned vector of a class, and of the sinusoids of its depth."""
    shortest_m: float = 0.5
    """Wavelength of the fastest sinusoid of depth, metres."""
    longest_m: float = 100.0
    """Wavelength of the slowest sinusoid of depth, metres."""
    sides: bool = False
    """Whether its input includes the face of a voxel through which the ray enters."""
    kernel: int = 6
    """Layers under the convolution that folds them."""
    stride: int = 4
    """Layers from one place of that convolution to the next."""
    fold: int = 16
    """Channels of that convolution; published networks have 47 places of 16, which are 752."""
    drawn: int = 0
    """Channels of the latents of the voxels drawn in the colours of their classes, appended to the
    rays' hits; 0 for none, as published. Small networks learn colours slowly without."""
    patch: int = 2
    """Latents along each axis for one token."""
    actions: int = 0
    """Numbers of an action, whose effect voxels and camera contain already; 0 for none."""
    corrupted: float = 0.0
    """Share of the clips in training whose voxels are corrupted: parts are missing, moved or there
    twice. The image to render stays the true one."""
    imagined: float = 0.0
    """Share of the clips in training whose voxels the world frames' transformer has imagined from
    the clip's first image."""
    blocks: BlocksConfig = BlocksConfig(context=16)
    """The transformer blocks."""

    def __post_init__(self):
        """Validate."""
        names = ("height", "width", "latent_channels", "rays", "layers", "kernel", "stride", "fold")
        require_positive(self, "renderer", *names, "patch")
        _require_classes(self.classes, "renderer")
        require(
            self.embed >= 2 and self.embed % 2 == 0,
            f"renderer.embed is {self.embed}: use an even number.",
        )
        require(
            self.layers >= self.kernel,
            f"renderer.layers is {self.layers}: use at least renderer.kernel ({self.kernel}).",
        )
        require(
            0 < self.shortest_m < self.longest_m,
            f"renderer.shortest_m {self.shortest_m} and renderer.longest_m {self.longest_m} need "
            "0 < shortest < longest.",
        )
        require(
            self.height % self.patch == 0 and self.width % self.patch == 0,
            f"renderer.height × width {self.height}×{self.width}: use multiples of renderer.patch "
            f"({self.patch}).",
        )
        require(self.actions >= 0, f"renderer.actions is {self.actions}: use 0 for none, or more.")
        require(self.drawn >= 0, f"renderer.drawn is {self.drawn}: use 0 for none, or more.")
        require(
            min(self.corrupted, self.imagined) >= 0 and self.corrupted + self.imagined <= 1,
            f"renderer.corrupted is {self.corrupted} and renderer.imagined {self.imagined}: use "
            "shares of the clips, 0 or more and together at most 1.",
        )

    @property
    def places(self) -> int:
        """Places of the convolution over the layers."""
        return (self.layers - self.kernel) // self.stride + 1

    @property
    def folded(self) -> int:
        """Channels that the layers of the rays of a latent become."""
        return self.places * self.fold * self.rays**2

    @property
    def features(self) -> int:
        """Channels of the voxels in the renderer's input."""
        return self.folded + self.drawn

    @property
    def tokens(self) -> int:
        """Tokens of a frame."""
        return self.height // self.patch * (self.width // self.patch)
