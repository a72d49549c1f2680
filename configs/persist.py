"""PERSIST for hours of two CPU cores: houses of blocks at 64×64 pixels, with observed cells.

Other than in ``persist_tiny`` the world frames have columns as tokens, a mask of observed cells,
eight sampling steps and a map whose guesses can be revised. Batches are small: many steps learn
faster.
"""

import dataclasses

from pewm_jax.config import ClipConfig, Config, EvalConfig, StageConfig
from pewm_jax.models.persist.config import BlocksConfig, VoxelDiTConfig
from pewm_jax.presets import persist_tiny


def config() -> Config:
    """Return the settings of ``persist``.

    Its data: ``pewm-jax data collect data/persist_houses --moving --voxels --voxels.kinds groups
    --voxels.colours 8 --voxels.pictures cells --voxels.cell 0.25 --voxels.side 40 --train 1024
    --validation 8 --test 16 --frames 64``. The codec of images is the one that comes with the
    library. Prepared clips are kept on disk, so that training can be spread over as many sittings
    as it takes.
    """
    base = persist_tiny.config()
    model, nets = base.model, base.model.backbone
    vae = dataclasses.replace(nets.voxel_vae, widths=(192,), cubes=24)
    small = {"mlp_ratio": 2, "gates": "open", "modulation": "shared"}
    frames = VoxelDiTConfig(
        latent_side=vae.latent_side,
        latent_channels=vae.latent_channels,
        patch=1,
        patch_z=8,  # columns
        actions=3,
        pixel_channels=nets.world_frames.pixel_channels,
        pixel_patch=1,
        map_embed=8,
        map_ids=vae.classes + model.memory.colours + 1,
        map_cells=vae.factor,
        storey=(4, 12),  # 8 to 24 cells: 4 m that contain floor and ceiling
        # No attention to earlier frames: their cells are true in training, and guesses in a
        # rollout. What is known of them is in the map.
        blocks=BlocksConfig(layers=5, heads=4, head_dim=32, context=1, rotary=True, **small),
    )
    renderer = dataclasses.replace(
        nets.renderer,
        corrupted=0.35,
        imagined=0.15,
        blocks=BlocksConfig(layers=4, heads=6, head_dim=32, context=3, **small),
    )
    camera = dataclasses.replace(
        nets.camera_model,
        blocks=dataclasses.replace(nets.camera_model.blocks, modulation="shared"),
    )
    voxels = dataclasses.replace(
        model.voxel_noise,
        times="uniform",
        shifted_times=True,
        sample_steps=8,
        shift=3.0,
        temperature=0.1,
    )
    backbone = dataclasses.replace(
        nets, voxel_vae=vae, world_frames=frames, renderer=renderer, camera_model=camera
    )
    return dataclasses.replace(
        base,
        model=dataclasses.replace(
            model,
            clip=ClipConfig(frames=4, height=64, width=64),
            backbone=backbone,
            voxel_noise=voxels,
            # An observed cell changes only if a real image shows another class.
            persistence_logit=100.0,
            observation_logit=200.0,
            shown_logit=8.0,
            guess_logit=2.0,
            body_m=0.2,
            moving=("door", "robot"),
            colour_reach_m=0.75,
            sampled="new",
        ),
        data=dataclasses.replace(
            base.data,
            path="data/persist_houses",
            stride_max=2,
            prepared=2880,
            prepared_path="data/persist_prepared",
            refresh=8,
        ),
        train=dataclasses.replace(
            base.train,
            run="runs/persist",
            voxel_vae=StageConfig(
                steps=2000, batch=3, learning_rate=4e-3, warmup=50, optimizer="adam"
            ),
            voxel_statistics=StageConfig(steps=60, batch=8, learning_rate=0.05, warmup=0),
            world_frames=StageConfig(steps=5800, batch=8, learning_rate=1.5e-3, warmup=50),
            camera=StageConfig(steps=200, batch=16, learning_rate=1e-3, warmup=20),
            renderer=StageConfig(steps=8000, batch=4, learning_rate=1.5e-3, warmup=50),
            frames_per_clip=2,
            new=10.0,
            elsewhere=0.3,
            occupied=3.0,
            classes=1.0,
            ema=0.995,
        ),
        evaluate=EvalConfig(clips=24, chain=5, seeds=(0,), videos=4, video_clips=11, batch=8),
    )
