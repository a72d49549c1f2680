"""Every setting of the library: frozen dataclasses, validated when built, to and from JSON.

A field's docstring is its ``--help`` text. Values that cannot work are refused when a configuration
is built, in a sentence that names the fix; other code does not check them again.
"""

from pewm_jax.config.backbone import BackboneSettings, Places
from pewm_jax.config.clip import SMALLEST, ActionConfig, ClipConfig
from pewm_jax.config.clip_vision import CLIPVisionConfig
from pewm_jax.config.codec import CodecSettings, PixelConfig
from pewm_jax.config.codec_world import CodecTrainConfig, CodecWorldConfig
from pewm_jax.config.control import CameraConfig, ControlSettings, ModulationConfig
from pewm_jax.config.cosmos import COSMOS_2B, COSMOS_14B, CosmosConfig
from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.dit import PUBLISHED, DiTConfig, published
from pewm_jax.config.egowm import EgoWMConfig, EgoWMTrainConfig
from pewm_jax.config.encoder import (
    DINOv2EncoderConfig,
    EncoderSettings,
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
    MemorySettings,
    NoMemoryConfig,
    PointsConfig,
    SurfelConfig,
    VoxelConfig,
)
from pewm_jax.config.mesh import AXES, MeshConfig
from pewm_jax.config.migrations import upgrade
from pewm_jax.config.model import ModelConfig, WorldSettings
from pewm_jax.config.noise import DDPMConfig, EDMConfig, FlowConfig, NoiseSettings
from pewm_jax.config.nomad import NomadConfig, NomadTrainConfig, NomadWorldConfig
from pewm_jax.config.persist import (
    POINT_WAVES,
    GridConfig,
    PersistConfig,
    PersistNetsConfig,
    PersistTrainConfig,
)
from pewm_jax.config.reader import AttentionConfig, BothConfig, ReaderSettings, RenderConfig
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

register("world", "pewm", ModelConfig, "pewm_jax.worlds.pewm.world")
register("world", "codec", CodecWorldConfig, "pewm_jax.worlds.codec")
register("world", "egowm", EgoWMConfig, "pewm_jax.worlds.egowm.world")
register("world", "persist", PersistConfig, "pewm_jax.worlds.persist.world")
register("world", "nomad", NomadWorldConfig, "pewm_jax.worlds.nomad")
register("backbone", "dit", DiTConfig, "pewm_jax.models.cogvideox.backbone")
register("backbone", "svd_unet", SVDUNetConfig, "pewm_jax.models.svd.backbone")
register("backbone", "cosmos", CosmosConfig, "pewm_jax.models.cosmos.backbone")
register("backbone", "persist", PersistNetsConfig, "pewm_jax.models.persist.nets")
register("codec", "pixel", PixelConfig, "pewm_jax.codecs.pixel")
register("codec", "vae", VAEConfig, "pewm_jax.models.cogvideox.vae_codec")
register("codec", "svd_vae", SVDVAEConfig, "pewm_jax.models.svd.vae_codec")
register("codec", "wan_vae", WanVAEConfig, "pewm_jax.models.wan.codec")
register("codec", "learned", LearnedCodecConfig, "pewm_jax.codecs.learned")
register("control", "camera", CameraConfig, "pewm_jax.controls.camera")
register("control", "actions", ModulationConfig, "pewm_jax.controls.actions")
register("encoder", "patch_colours", PatchColoursConfig, "pewm_jax.encoders.patch_colours")
register("encoder", "latents", LatentsConfig, "pewm_jax.encoders.latents")
register("encoder", "dinov2", DINOv2EncoderConfig, "pewm_jax.models.dinov2.encoder")
register("reader", "attend", AttentionConfig, "pewm_jax.readers.attention")
register("reader", "render", RenderConfig, "pewm_jax.readers.render")
register("reader", "both", BothConfig, "pewm_jax.readers.both")
register("memory", "voxel", VoxelConfig, "pewm_jax.memory.voxel_memory")
register("memory", "map2d", Map2DConfig, "pewm_jax.memory.map2d")
register("memory", "points", PointsConfig, "pewm_jax.memory.points")
register("memory", "surfels", SurfelConfig, "pewm_jax.memory.surfels")
register("memory", "grid", GridConfig, "pewm_jax.memory.class_grid")
register("memory", "images", ImagesConfig, "pewm_jax.memory.images")
register("memory", "none", NoMemoryConfig, "pewm_jax.memory.nothing")
register("noise", "ddpm", DDPMConfig, "pewm_jax.diffusion.ddpm")
register("noise", "edm", EDMConfig, "pewm_jax.diffusion.edm")
register("noise", "flow", FlowConfig, "pewm_jax.diffusion.flow")
register("noise", "frame_flow", FrameFlowConfig, "pewm_jax.diffusion.frame_flow")

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
    "BackboneSettings",
    "BlocksConfig",
    "BothConfig",
    "CLIPVisionConfig",
    "CameraConfig",
    "CameraModelConfig",
    "ClipConfig",
    "CodecSettings",
    "CodecTrainConfig",
    "CodecWorldConfig",
    "Config",
    "ConfigError",
    "ControlSettings",
    "CosmosConfig",
    "DDPMConfig",
    "DINOv2Config",
    "DINOv2EncoderConfig",
    "DataConfig",
    "DiTConfig",
    "EDMConfig",
    "EgoWMConfig",
    "EgoWMTrainConfig",
    "EncoderSettings",
    "EvalConfig",
    "FlowConfig",
    "FrameFlowConfig",
    "GridConfig",
    "ImagesConfig",
    "Join",
    "LatentsConfig",
    "Launch",
    "LearnedCodecConfig",
    "Map2DConfig",
    "MemorySettings",
    "MeshConfig",
    "ModelConfig",
    "ModulationConfig",
    "NoMemoryConfig",
    "NoiseSettings",
    "NomadConfig",
    "NomadTrainConfig",
    "NomadWorldConfig",
    "PatchColoursConfig",
    "PersistConfig",
    "PersistNetsConfig",
    "PersistTrainConfig",
    "PixelConfig",
    "Places",
    "PointsConfig",
    "ReaderSettings",
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
    "WorldSettings",
    "from_dict",
    "functions",
    "load",
    "published",
    "register",
    "save",
    "to_dict",
    "upgrade",
]
