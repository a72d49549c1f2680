"""The settings of PERSIST's other networks: world frames, camera, renderer (arXiv 2603.03482)."""

from __future__ import annotations

import dataclasses

from pewm_jax.config.frame_blocks import BlocksConfig
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class VoxelDiTConfig:
    """The diffusion transformer that makes the next voxel frame; by default as published."""

    latent_side: int = 12
    """Latents along each side of a voxel frame."""
    latent_channels: int = 48
    """Channels of a latent."""
    patch: int = 2
    """Latents along each axis for one token: 2 (216 tokens of a published frame) or 1 (1,728)."""
    actions: int = 23
    """Numbers of an action."""
    camera_numbers: int = 10
    """Numbers of the camera by which a frame was seen; 0 if cameras are not given."""
    pixel_channels: int = 16
    """Channels of the picture's latents, to which frames attend."""
    pixel_patch: int = 2
    """Latents of the picture along each axis for one token."""
    blocks: BlocksConfig = BlocksConfig()
    """The transformer blocks."""

    def __post_init__(self):
        """Validate."""
        names = ("latent_side", "latent_channels", "patch", "actions", "pixel_channels")
        require_positive(self, "voxel_dit", *names, "pixel_patch")
        require(
            self.camera_numbers >= 0,
            f"voxel_dit.camera_numbers is {self.camera_numbers}: use 0 for none, or 10.",
        )
        require(
            self.latent_side % self.patch == 0,
            f"voxel_dit.latent_side is {self.latent_side}: use a multiple of voxel_dit.patch "
            f"({self.patch}).",
        )

    @property
    def tokens(self) -> int:
        """Tokens of a frame."""
        return (self.latent_side // self.patch) ** 3


@dataclasses.dataclass(frozen=True)
class CameraModelConfig:
    """The transformer that says where the camera goes; by default as published."""

    classes: int = 2138
    """Class ids of the voxels."""
    inner: int = 4
    """Voxels along each axis, around the middle of the grid, that it sees."""
    embed: int = 32
    """Channels of the learned vector of a class."""
    actions: int = 23
    """Numbers of an action."""
    units: tuple[float, float, float, float, float, float] = (
        1.0,
        1.0,
        1.0,
        1.0,
        1.0,
        1.0,
    )
    """What counts as 1 in each number of a step: forward, left and up in metres; pitch, yaw and
    field of view in radians."""
    blocks: BlocksConfig = BlocksConfig()
    """The transformer blocks; a frame is one token."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "camera_model", "inner", "embed", "actions")
        require(
            self.classes >= 2,
            f"camera_model.classes is {self.classes}: use at least 2, of which one is empty.",
        )
        require(
            len(self.units) == 6 and min(self.units) > 0,
            f"camera_model.units is {self.units}: name six numbers above 0.",
        )


@dataclasses.dataclass(frozen=True)
class VoxelRendererConfig:
    """The diffusion transformer that makes pictures of voxels; by default as published."""

    classes: int = 2138
    """Class ids of the voxels."""
    height: int = 36
    """Rows of the picture's latents; a ray goes through the middle of each."""
    width: int = 64
    """Columns of the picture's latents."""
    latent_channels: int = 16
    """Channels of the picture's latents."""
    rays: int = 1
    """Rays through each latent, along its rows and along its columns; 1 as published, more where a
    latent stands for many pixels."""
    layers: int = 192
    """Occupied voxels along a ray that are seen, nearest first."""
    embed: int = 32
    """Channels of the learned vector of a class, and of the sinusoids of its depth."""
    shortest_m: float = 0.5
    """Wavelength of the fastest sinusoid of depth, metres."""
    longest_m: float = 100.0
    """Wavelength of the slowest sinusoid of depth, metres."""
    sides: bool = False
    """Whether it also sees by which of a voxel's faces the ray enters."""
    kernel: int = 6
    """Layers under the convolution that folds them."""
    stride: int = 4
    """Layers from one place of that convolution to the next."""
    fold: int = 16
    """Channels of that convolution; published networks have 47 places of 16, which are 752."""
    drawn: int = 0
    """Channels of the latents of the voxels drawn in the colours of their classes, which join what
    rays meet; 0 for none, as published. Small networks learn colours slowly without."""
    patch: int = 2
    """Latents along each axis for one token."""
    actions: int = 0
    """Numbers of an action, which voxels and camera have in them already; 0 for none."""
    blocks: BlocksConfig = BlocksConfig(context=16)
    """The transformer blocks."""

    def __post_init__(self):
        """Validate."""
        names = ("height", "width", "latent_channels", "rays", "layers", "kernel", "stride", "fold")
        require_positive(self, "renderer", *names, "patch")
        require(
            self.classes >= 2,
            f"renderer.classes is {self.classes}: use at least 2, of which one is empty.",
        )
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
        """Channels that the renderer is told of the voxels."""
        return self.folded + self.drawn

    @property
    def tokens(self) -> int:
        """Tokens of a frame."""
        return self.height // self.patch * (self.width // self.patch)
