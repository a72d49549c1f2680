"""The paper's settings around a video model: what presets and imported checkpoints share.

PEWM, arXiv 2505.05495.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.experiment import Config
from pewm_jax.config.parts import Codec, Encoder, Noise
from pewm_jax.config.training import DataConfig, EvalConfig, MeshConfig, StageConfig, TrainConfig
from pewm_jax.config.world import ClipConfig
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.worlds.pewm.world import PEWM

CLIP = ClipConfig(frames=9, height=512, width=512)
"""The paper's clip."""
READER = AttentionConfig(positions="sinusoid", heads=16, head_dim=64, mlp_ratio=2)
"""The paper's positions; 0.94 billion parameters of memory blocks on 2b ("nearly 1 B"), 2.8 on
5b."""
STAGE = StageConfig(steps=20_000, batch=256, learning_rate=1e-4, warmup=500, decay="constant")
"""Adam, learning rate 1e-4 after a linear warm-up; 256 clips, so that 8, 64 and 256 devices share
them evenly."""


def experiment(
    backbone: DiTBackbone,
    codec: Codec,
    noise: Noise,
    *,
    run: str,
    clip: ClipConfig = CLIP,
    encoder: Encoder | None = None,
    dtype: Literal["float32", "bfloat16"] = "bfloat16",
) -> Config:
    """Return the settings with which a video model becomes the paper's world model.

    As in the paper, stage 1 fine-tunes the backbone to RGB-D and cameras, stage 2 trains the memory
    blocks alone; Adam, learning rate 1e-4 after a linear warm-up, gradients clipped at norm 1,
    bfloat16. The map has 256 × 256 × 32 cells of 0.25 × 0.25 × 1 m, read through positions relative
    to the clip's first camera. Not in the paper, and chosen here: 512 cells per clip, 16 frames of
    context, the size of a memory block (see ``READER``), 256 clips per step; weights split over 8
    devices, a node of GPUs, and copied beyond. Adam's decays are those of CogVideoX's own
    fine-tuning (0.9 and 0.95, ε 1e-8; CogVideo's ``sat/configs/sft.yaml``). The map keeps the
    features of ``encoder``, by default the colours of patches; runs are in ``runs/`` + ``run``.
    """
    return Config(
        model=PEWM(
            clip=clip,
            codec=codec,
            # Channels are left to follow codec and control: 88 in, 32 out with CogVideoX's VAE.
            backbone=dataclasses.replace(backbone, in_channels=0, out_channels=0, remat=True),
            memory=VoxelConfig(
                cell_m=(0.25, 0.25, 1.0),
                cells=(256, 256, 32),
                capacity=8192,
                tokens=512,
                encoder=encoder or PatchColoursConfig(),
                reader=reader_for(backbone),
            ),
            noise=noise,
            dtype=dtype,
        ),
        data=DataConfig(path="data/pewm", context=16),
        train=TrainConfig(
            run=f"runs/{run}",
            stage1=STAGE,
            stage2=STAGE,
            beta2=0.95,
            ema=0.9995,
            save_every=250,
            keep_every=5000,
            preview_every=1000,
            mesh=MeshConfig(fsdp=8),
        ),
        evaluate=EvalConfig(clips=256, batch=8),
    )


def reader_for(backbone: DiTBackbone) -> AttentionConfig:
    """Return the settings of memory blocks: the paper's, but no wider than a small transformer."""
    head_dim = min(READER.head_dim, max(8, backbone.head_dim // 8 * 8))
    return dataclasses.replace(READER, heads=min(READER.heads, backbone.heads), head_dim=head_dim)
