"""PERSIST's four networks together, as the backbone of its world.

A model names their settings in the place of a backbone; the world calls each by its own functions
(``voxel_vae``, ``voxel_dit``, ``camera_model``, ``voxel_renderer``).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax

from pewm_jax.config.parts import Backbone, Rules
from pewm_jax.errors import require
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer, voxel_vae
from pewm_jax.models.persist.config import (
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.types import Array, Params

NETWORKS = ("voxel_vae", "voxel_dit", "camera_model", "renderer")
"""The networks, as their parameters are named, in the order of their training."""


@dataclasses.dataclass(frozen=True)
class PersistNetsConfig(Backbone):
    """The four networks of PERSIST; by default as published."""

    SHARDING: ClassVar[Rules] = (
        *voxel_dit.SHARDING,
        *camera_model.SHARDING,
        *voxel_renderer.SHARDING,
        *voxel_vae.SHARDING,
    )
    """Rules over the paths of all their parameters."""

    voxel_vae: VoxelVAEConfig = VoxelVAEConfig()
    """The autoencoder of voxels."""
    world_frames: VoxelDiTConfig = VoxelDiTConfig()
    """The transformer that predicts the next voxel frame."""
    camera_model: CameraModelConfig = CameraModelConfig()
    """The transformer that predicts the camera."""
    renderer: VoxelRendererConfig = VoxelRendererConfig()
    """The transformer that renders images of voxels."""

    @property
    def places(self) -> None:  # type: ignore[override]
        """No memory reader runs in them: the voxels are the memory."""
        return None

    @property
    def time_dim(self) -> int:
        """Width of the world frames' condition."""
        return self.world_frames.blocks.width

    @property
    def split_heads(self) -> int:  # type: ignore[override]
        """Heads of the world frames' transformer."""
        return self.world_frames.blocks.heads

    @property
    def remat(self) -> bool:  # type: ignore[override]
        """Whether the backward pass recomputes activations."""
        return self.world_frames.blocks.remat

    @property
    def token_cells(self) -> int:
        """Cells along x or y for one token of a world frame; windows move by whole tokens."""
        return self.voxel_vae.factor * self.world_frames.patch

    def check(self, model: Any) -> None:
        """Refuse networks that do not fit together."""
        require(
            hasattr(model, "picture_channels"),
            "backbone.kind persist is of the world persist alone: use model.kind persist.",
        )
        vae, frames, view = self.voxel_vae, self.world_frames, self.renderer
        for name, found, wanted in (
            ("world_frames.latent_side", frames.latent_side, vae.latent_side),
            ("world_frames.latent_channels", frames.latent_channels, vae.latent_channels),
            ("world_frames.pixel_channels", frames.pixel_channels, model.shown_channels),
            ("world_frames.actions", frames.actions, model.control.actions),
            ("camera_model.actions", self.camera_model.actions, model.control.actions),
            ("camera_model.classes", self.camera_model.classes, vae.classes),
            ("renderer.classes", view.classes, vae.classes),
            ("renderer.latent_channels", view.latent_channels, model.picture_channels),
            ("renderer.height", view.height, model.clip.height // model.codec.spatial),
            ("renderer.width", view.width, model.clip.width // model.codec.spatial),
        ):
            require(
                found == wanted,
                f"backbone.{name} is {found}, and the other parts of the model ask for {wanted}: "
                "use that.",
            )
        known = frames.map_ids, frames.map_cells
        wanted = vae.classes + model.memory.colours + 1, vae.factor
        require(
            not frames.map_embed or known == wanted,
            f"backbone.world_frames.map_ids and map_cells are {known}, and the other parts of the "
            f"model ask for {wanted} (classes, colours and one; cells of a latent): use those.",
        )
        require(
            view.actions in (0, model.control.actions),
            f"backbone.renderer.actions is {view.actions}: use 0, or control.actions "
            f"({model.control.actions}).",
        )
        require(
            view.drawn in (0, model.picture_channels),
            f"backbone.renderer.drawn is {view.drawn}: use 0, or the {model.picture_channels} "
            "channels of a picture's latents.",
        )
        require(
            model.codec.temporal == 1,
            f"codec.temporal is {model.codec.temporal}: this world makes frame after frame; use a "
            "codec that encodes frames one by one, such as codec.kind learned.",
        )

    def init(  # type: ignore[override]
        self, key: Array, networks: tuple[str, ...] = NETWORKS
    ) -> Params:
        """Return random parameters of some of the networks, under their names."""
        makers: dict[str, Any] = {
            "voxel_vae": (voxel_vae, self.voxel_vae),
            "voxel_dit": (voxel_dit, self.world_frames),
            "camera_model": (camera_model, self.camera_model),
            "renderer": (voxel_renderer, self.renderer),
        }
        keys: dict[str, Array] = dict(
            zip(NETWORKS, jax.random.split(key, len(NETWORKS)), strict=True)
        )
        return {name: makers[name][0].init(makers[name][1], keys[name]) for name in networks}
