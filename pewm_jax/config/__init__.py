"""Every setting of the library: frozen dataclasses, validated when built, to and from JSON.

A field's docstring is its ``--help`` text. Values that cannot work are refused when a configuration
is built, in a sentence that names the fix; other code does not check them again.
"""

import warnings
from typing import Any

from pewm_jax.config.clip import SMALLEST, ActionConfig, ClipConfig
from pewm_jax.config.clip_vision import CLIPVisionConfig
from pewm_jax.config.codec import PixelConfig
from pewm_jax.config.codec_world import CodecTrainConfig, CodecWorldConfig
from pewm_jax.config.control import CameraConfig, ModulationConfig
from pewm_jax.config.cosmos import COSMOS_2B, COSMOS_14B, CosmosConfig
from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.dit import PUBLISHED, DiTConfig, published
from pewm_jax.config.egowm import EgoWMConfig, EgoWMTrainConfig
from pewm_jax.config.encoder import (
    DINOv2EncoderConfig,
    LatentsConfig,
    PatchColoursConfig,
)
from pewm_jax.config.experiment import VERSION, Config
from pewm_jax.config.frame_blocks import BlocksConfig
from pewm_jax.config.frame_flow import PERSIST_PIXELS, PERSIST_VOXELS, FrameFlowConfig
from pewm_jax.config.launch import Join, Launch
from pewm_jax.config.learned_codec import LearnedCodecConfig
from pewm_jax.config.memory import (
    ImagesConfig,
    Map2DConfig,
    NoMemoryConfig,
    PointsConfig,
    SurfelConfig,
    VoxelConfig,
)
from pewm_jax.config.mesh import AXES, MeshConfig
from pewm_jax.config.migrations import upgrade
from pewm_jax.config.model import ModelConfig
from pewm_jax.config.noise import DDPMConfig, EDMConfig, FlowConfig
from pewm_jax.config.nomad import NomadConfig, NomadTrainConfig, NomadWorldConfig
from pewm_jax.config.parts import (
    Backbone,
    Codec,
    Conditioner,
    Encoder,
    InjectionPoints,
    Memory,
    Noise,
    Reader,
    World,
)
from pewm_jax.config.persist import (
    POINT_WAVES,
    GridConfig,
    PersistConfig,
    PersistNetsConfig,
    PersistTrainConfig,
)
from pewm_jax.config.reader import AttentionConfig, BothConfig, RenderConfig
from pewm_jax.config.serialize import from_dict, load, save, to_dict
from pewm_jax.config.svd_unet import SVDUNetConfig
from pewm_jax.config.svd_vae import SVDVAEConfig
from pewm_jax.config.training import DataConfig, EvalConfig, StageConfig, TrainConfig, TrainSettings
from pewm_jax.config.vae import VAEConfig
from pewm_jax.config.voxel_nets import CameraModelConfig, VoxelDiTConfig, VoxelRendererConfig
from pewm_jax.config.voxel_vae import VoxelVAEConfig
from pewm_jax.config.wan_vae import WanVAEConfig
from pewm_jax.errors import ConfigError, UserError
from pewm_jax.registry import Settings, functions, register

__all__ = [
    "AXES",
    "COSMOS_2B",
    "COSMOS_14B",
    "PERSIST_PIXELS",
    "PERSIST_VOXELS",
    "POINT_WAVES",
    "PUBLISHED",
    "SMALLEST",
    "VERSION",
    "ActionConfig",
    "AttentionConfig",
    "Backbone",
    "BlocksConfig",
    "BothConfig",
    "CLIPVisionConfig",
    "CameraConfig",
    "CameraModelConfig",
    "ClipConfig",
    "Codec",
    "CodecTrainConfig",
    "CodecWorldConfig",
    "Conditioner",
    "Config",
    "ConfigError",
    "CosmosConfig",
    "DDPMConfig",
    "DINOv2Config",
    "DINOv2EncoderConfig",
    "DataConfig",
    "DiTConfig",
    "EDMConfig",
    "EgoWMConfig",
    "EgoWMTrainConfig",
    "Encoder",
    "EvalConfig",
    "FlowConfig",
    "FrameFlowConfig",
    "GridConfig",
    "ImagesConfig",
    "InjectionPoints",
    "Join",
    "LatentsConfig",
    "Launch",
    "LearnedCodecConfig",
    "Map2DConfig",
    "Memory",
    "MeshConfig",
    "ModelConfig",
    "ModulationConfig",
    "NoMemoryConfig",
    "Noise",
    "NomadConfig",
    "NomadTrainConfig",
    "NomadWorldConfig",
    "PatchColoursConfig",
    "PersistConfig",
    "PersistNetsConfig",
    "PersistTrainConfig",
    "PixelConfig",
    "PointsConfig",
    "Reader",
    "RenderConfig",
    "SVDUNetConfig",
    "SVDVAEConfig",
    "Settings",
    "StageConfig",
    "SurfelConfig",
    "TrainConfig",
    "TrainSettings",
    "UserError",
    "VAEConfig",
    "VoxelConfig",
    "VoxelDiTConfig",
    "VoxelRendererConfig",
    "VoxelVAEConfig",
    "WanVAEConfig",
    "World",
    "from_dict",
    "functions",
    "load",
    "published",
    "register",
    "save",
    "to_dict",
    "upgrade",
]

_RENAMED = {
    "BackboneSettings": "Backbone",
    "CodecSettings": "Codec",
    "ControlSettings": "Conditioner",
    "EncoderSettings": "Encoder",
    "MemorySettings": "Memory",
    "NoiseSettings": "Noise",
    "Places": "InjectionPoints",
    "ReaderSettings": "Reader",
    "WorldSettings": "World",
}
"""Names of version 0.1 → their names now."""


def __getattr__(name: str) -> Any:
    """Return a class by the name that version 0.1 had for it, with a warning."""
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now = _RENAMED[name]
    warnings.warn(
        f"pewm_jax.config.{name} is now pewm_jax.config.{now}; the old name will go in the next "
        "version.",
        DeprecationWarning,
        stacklevel=2,
    )
    return globals()[now]
