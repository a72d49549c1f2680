"""The paper's size: CogVideoX-2b, 9 frames of 512×512, 0.94 billion parameters of memory."""

import dataclasses

from pewm_jax.config import (
    AttentionConfig,
    ClipConfig,
    Config,
    DataConfig,
    DDPMConfig,
    DINOv2EncoderConfig,
    EvalConfig,
    MeshConfig,
    ModelConfig,
    StageConfig,
    TrainConfig,
    VAEConfig,
    VoxelConfig,
    published,
)


def config(variant: str = "2b") -> Config:
    """Return the settings of a model on a published CogVideoX.

    As the paper trains: stage 1 fine-tunes the backbone to colour with depth and to cameras, stage
    2 trains the memory blocks alone; Adam, learning rate 1e-4 after a linear warm-up, gradients
    clipped at norm 1, bfloat16. The map has 256 × 256 × 32 cells of 0.25 × 0.25 × 1 m with DINOv2's
    features (ViT-S/14 at 518²), read through positions relative to the clip's first camera. What
    the paper does not say is chosen: 512 cells per clip, 16 frames of context, and a memory block
    with 16 heads of 64 and a feed-forward network of twice the width, which makes 0.94 billion
    parameters on 2b ("nearly 1 B") and 2.8 on 5b; 256 clips per step, so that 8 devices, 64 and 256
    share them evenly; weights split over 8 devices, a node of GPUs, and copied beyond.

    Training needs ``train.start``: converted weights of CogVideoX, widened to depth and cameras,
    with those of DINOv2 (``python -m pewm_jax.convert import cogvideox SRC DST --rgbd --camera
    --encoder DINOV2``). ``--plan`` needs nothing.

    Args:
        variant: one of ``pewm_jax.config.PUBLISHED``.
    """
    # Left to follow codec and conditioning: 88 channels in, 32 out.
    dit = dataclasses.replace(published(variant), in_channels=0, out_channels=0)
    stage = StageConfig(steps=20_000, batch=256, learning_rate=1e-4, warmup=500, decay="constant")
    return Config(
        model=ModelConfig(
            clip=ClipConfig(frames=9, height=512, width=512),
            codec=VAEConfig.published(variant),
            backbone=dataclasses.replace(dit, prompt="stored", remat=True),
            memory=VoxelConfig(
                cell_m=(0.25, 0.25, 1.0),
                cells=(256, 256, 32),
                capacity=8192,
                tokens=512,
                encoder=DINOv2EncoderConfig(),
                reader=AttentionConfig(positions="sinusoid", heads=16, head_dim=64, mlp_ratio=2),
            ),
            noise=DDPMConfig(
                target="v", snr_shift=3.0 if variant == "2b" else 1.0, sample_steps=50
            ),
            dtype="bfloat16",
        ),
        data=DataConfig(path="data/pewm", context=16),
        train=TrainConfig(
            run=f"runs/pewm_{variant}",
            stage1=stage,
            stage2=stage,
            ema=0.9995,
            save_every=250,
            keep_every=5000,
            preview_every=1000,
            mesh=MeshConfig(fsdp=8),
        ),
        evaluate=EvalConfig(clips=256, batch=8),
    )
