"""The settings of an experiment: frozen dataclasses, validated when built, to and from JSON.

A field's docstring is its ``--help`` text. Values that cannot work are refused when a configuration
is built, in a sentence that names the fix; other code does not check them again.
"""

import importlib
import warnings
from typing import Any

from pewm_jax.config.assembled import AssembledModel
from pewm_jax.config.experiment import VERSION, Config
from pewm_jax.config.launch import Join, Launch
from pewm_jax.config.migrations import upgrade
from pewm_jax.config.parts import (
    Backbone,
    Codec,
    Conditioner,
    Encoder,
    InjectionPoints,
    Memory,
    Noise,
    Reader,
)
from pewm_jax.config.serialize import from_dict, load, save, to_dict
from pewm_jax.config.training import (
    AXES,
    DataConfig,
    EvalConfig,
    LoRAConfig,
    MeshConfig,
    StageConfig,
    TrainConfig,
    TrainSettings,
)
from pewm_jax.config.world import (
    SMALLEST,
    ActionConfig,
    ArraySpec,
    BatchSpec,
    Capabilities,
    ClipConfig,
    Facts,
    Task,
    World,
)
from pewm_jax.errors import ConfigError, UserError
from pewm_jax.registry import Settings, register

__all__ = [
    "AXES",
    "SMALLEST",
    "VERSION",
    "ActionConfig",
    "ArraySpec",
    "AssembledModel",
    "Backbone",
    "BatchSpec",
    "Capabilities",
    "ClipConfig",
    "Codec",
    "Conditioner",
    "Config",
    "ConfigError",
    "DataConfig",
    "Encoder",
    "EvalConfig",
    "Facts",
    "InjectionPoints",
    "Join",
    "Launch",
    "LoRAConfig",
    "Memory",
    "MeshConfig",
    "Noise",
    "Reader",
    "Settings",
    "StageConfig",
    "Task",
    "TrainConfig",
    "TrainSettings",
    "UserError",
    "World",
    "from_dict",
    "load",
    "register",
    "save",
    "to_dict",
    "upgrade",
]

_MOVED = {
    "VoxelConfig": "pewm_jax.memory.voxel_map",
    "Map2DConfig": "pewm_jax.memory.voxel_map",
    "PointsConfig": "pewm_jax.memory.points",
    "SurfelConfig": "pewm_jax.memory.surfels",
    "GridConfig": "pewm_jax.memory.class_grid",
    "ImagesConfig": "pewm_jax.memory.images",
    "NoMemoryConfig": "pewm_jax.memory.none",
    "AttentionConfig": "pewm_jax.readers.attention",
    "RenderConfig": "pewm_jax.readers.render",
    "BothConfig": "pewm_jax.readers.render",
    "WanVAEConfig": "pewm_jax.models.wan.vae:WanVAECodec",
    "CosmosConfig": "pewm_jax.models.cosmos.backbone:CosmosBackbone",
    "SVDVAEConfig": "pewm_jax.models.svd.vae:SVDVAECodec",
    "SVDUNetConfig": "pewm_jax.models.svd.unet:SVDUNetBackbone",
    "VAEConfig": "pewm_jax.models.cogvideox.vae:VAECodec",
    "DiTConfig": "pewm_jax.models.cogvideox.backbone:DiTBackbone",
    "COSMOS_14B": "pewm_jax.models.cosmos.backbone",
    "COSMOS_2B": "pewm_jax.models.cosmos.backbone",
    "PUBLISHED": "pewm_jax.models.cogvideox.config",
    "PersistNetsConfig": "pewm_jax.models.persist.nets",
    "VoxelRendererConfig": "pewm_jax.models.persist.config",
    "CameraModelConfig": "pewm_jax.models.persist.config",
    "VoxelDiTConfig": "pewm_jax.models.persist.config",
    "VoxelVAEConfig": "pewm_jax.models.persist.config",
    "BlocksConfig": "pewm_jax.models.persist.config",
    "DINOv2Config": "pewm_jax.models.dinov2.config",
    "CLIPVisionConfig": "pewm_jax.models.clip.model",
    "ModulationConfig": "pewm_jax.controls.actions",
    "CameraConfig": "pewm_jax.controls.camera",
    "DINOv2EncoderConfig": "pewm_jax.models.dinov2.model",
    "LatentsConfig": "pewm_jax.encoders.simple",
    "PatchColoursConfig": "pewm_jax.encoders.simple",
    "LearnedCodecConfig": "pewm_jax.codecs.learned",
    "PixelConfig": "pewm_jax.codecs.pixel",
    "DDPMConfig": "pewm_jax.diffusion.ddpm",
    "EDMConfig": "pewm_jax.diffusion.edm",
    "FlowConfig": "pewm_jax.diffusion.flow",
    "FrameFlowConfig": "pewm_jax.diffusion.flow",
    "PERSIST_PIXELS": "pewm_jax.diffusion.flow",
    "PERSIST_VOXELS": "pewm_jax.diffusion.flow",
    "BackboneSettings": "pewm_jax.config.parts:Backbone",
    "CodecSettings": "pewm_jax.config.parts:Codec",
    "ControlSettings": "pewm_jax.config.parts:Conditioner",
    "EncoderSettings": "pewm_jax.config.parts:Encoder",
    "MemorySettings": "pewm_jax.config.parts:Memory",
    "NoiseSettings": "pewm_jax.config.parts:Noise",
    "Places": "pewm_jax.config.parts:InjectionPoints",
    "ReaderSettings": "pewm_jax.config.parts:Reader",
    "WorldSettings": "pewm_jax.config.world:World",
    "ModelConfig": "pewm_jax.worlds.pewm.world:PEWM",
    "EgoWMConfig": "pewm_jax.worlds.egowm.world:EgoWM",
    "EgoWMTrainConfig": "pewm_jax.worlds.egowm.world",
    "PersistConfig": "pewm_jax.worlds.persist.world:PERSIST",
    "PersistTrainConfig": "pewm_jax.worlds.persist.config",
    "POINT_WAVES": "pewm_jax.worlds.persist.config",
    "CodecWorldConfig": "pewm_jax.worlds.codec:CodecTask",
    "CodecTrainConfig": "pewm_jax.worlds.codec",
    "NomadConfig": "pewm_jax.models.nomad.config",
    "NomadTrainConfig": "pewm_jax.worlds.nomad",
    "NomadWorldConfig": "pewm_jax.worlds.nomad:NomadTask",
}
"""Names that version 0.1 had here → the module that has them now, and the name if it is another."""


def __getattr__(name: str) -> Any:
    """Return a class that version 0.1 had here, with a warning."""
    if name not in _MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, now = _MOVED[name].partition(":")
    warnings.warn(
        f"pewm_jax.config.{name} is deprecated: import {now or name} from {module}.",
        DeprecationWarning,
        stacklevel=2,
    )
    return getattr(importlib.import_module(module), now or name)
