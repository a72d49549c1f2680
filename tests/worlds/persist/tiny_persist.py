"""The smallest worlds of PERSIST."""

import dataclasses

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.flow import FrameFlowConfig
from pewm_jax.memory.class_grid import GridConfig
from pewm_jax.models.persist.config import (
    BlocksConfig,
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.models.persist.nets import PersistNetsConfig
from pewm_jax.worlds.persist.world import PERSIST

BLOCKS = BlocksConfig(layers=1, heads=1, head_dim=8, mlp_ratio=2, context=3)
NOISE = FrameFlowConfig(per_frame=True, sample_steps=1)
MODEL = PERSIST(
    clip=ClipConfig(frames=3, height=16, width=16),
    codec=PixelConfig(spatial=4, temporal=1),
    backbone=PersistNetsConfig(
        voxel_vae=VoxelVAEConfig(
            side=8, classes=13, patch=2, embed=4, widths=(8,), blocks=1, middle=0, kernel=1,
            latent_channels=3,
        ),
        world_frames=VoxelDiTConfig(
            latent_side=4, latent_channels=3, patch=1, actions=3, pixel_channels=88,
            pixel_patch=4, blocks=BLOCKS,
        ),
        camera_model=CameraModelConfig(classes=13, inner=2, embed=2, actions=3, blocks=BLOCKS),
        renderer=VoxelRendererConfig(
            classes=13, height=4, width=4, latent_channels=64, rays=2, layers=2, embed=4,
            kernel=2, stride=2, fold=2, drawn=64, actions=3, blocks=BLOCKS,
        ),
    ),
    control=ModulationConfig(),
    memory=GridConfig(
        cell_m=(0.5, 0.5, 0.5), cells=(24, 24, 8), recorded=12, kinds="groups", colours=1,
        pictures="cells", eye_m=1.25,
    ),
    noise=NOISE,
    voxel_noise=NOISE,
    persistence_logit=1e6,
    observation_logit=1e3,
    points=True,
    dead_reckoning=True,
)  # fmt: skip
"""As published, with the settings of small networks."""


def _masked() -> PERSIST:
    nets = MODEL.backbone
    blocks = dataclasses.replace(BLOCKS, modulation="shared", gates="open", rotary=True)
    frames = dataclasses.replace(
        nets.world_frames,
        patch_z=3,
        map_embed=2,
        map_ids=15,
        map_cells=2,
        storey=(0, 3),
        blocks=blocks,
    )
    view = dataclasses.replace(nets.renderer, corrupted=0.4, imagined=0.4)
    return dataclasses.replace(
        MODEL,
        backbone=dataclasses.replace(nets, world_frames=frames, renderer=view),
        voxel_noise=FrameFlowConfig(per_frame=True, sample_steps=2, predicts="x0"),
        guess_logit=0.0,
        sampled="new",
    )


MASKED = _masked()
"""With a mask of observed cells as an input, columns as tokens, and guesses that can be revised."""
