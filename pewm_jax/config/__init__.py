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

_FORMER = {
    "pewm_jax.codecs.learned": ("LearnedCodecConfig",),
    "pewm_jax.codecs.pixel": ("PixelConfig",),
    "pewm_jax.controls.actions": ("ModulationConfig",),
    "pewm_jax.controls.camera": ("CameraConfig",),
    "pewm_jax.diffusion.ddpm": ("DDPMConfig",),
    "pewm_jax.diffusion.edm": ("EDMConfig",),
    "pewm_jax.diffusion.flow": (
        "FlowConfig",
        "FrameFlowConfig",
        "PERSIST_PIXELS",
        "PERSIST_VOXELS",
    ),
    "pewm_jax.encoders.simple": ("LatentsConfig", "PatchColoursConfig"),
    "pewm_jax.memory.class_grid": ("GridConfig",),
    "pewm_jax.memory.images": ("ImagesConfig",),
    "pewm_jax.memory.none": ("NoMemoryConfig",),
    "pewm_jax.memory.points": ("PointsConfig",),
    "pewm_jax.memory.surfels": ("SurfelConfig",),
    "pewm_jax.memory.voxel_map": ("VoxelConfig", "Map2DConfig"),
    "pewm_jax.models.clip.config": ("CLIPVisionConfig",),
    "pewm_jax.models.cogvideox.config": ("PUBLISHED",),
    "pewm_jax.models.cosmos.backbone": ("COSMOS_14B", "COSMOS_2B"),
    "pewm_jax.models.dinov2.config": ("DINOv2Config",),
    "pewm_jax.models.dinov2.encoder": ("DINOv2EncoderConfig",),
    "pewm_jax.models.nomad.config": ("NomadConfig",),
    "pewm_jax.models.persist.config": (
        "VoxelRendererConfig",
        "CameraModelConfig",
        "VoxelDiTConfig",
        "VoxelVAEConfig",
        "BlocksConfig",
    ),
    "pewm_jax.models.persist.nets": ("PersistNetsConfig",),
    "pewm_jax.readers.attention": ("AttentionConfig",),
    "pewm_jax.readers.render": ("RenderConfig", "BothConfig"),
    "pewm_jax.worlds.codec": ("CodecTrainConfig",),
    "pewm_jax.worlds.egowm.world": ("EgoWMTrainConfig",),
    "pewm_jax.worlds.nomad": ("NomadTrainConfig",),
    "pewm_jax.worlds.persist.config": ("PersistTrainConfig", "POINT_WAVES"),
}
"""Module → names that version 0.1 had here."""
_MOVED = {name: module for module, names in _FORMER.items() for name in names} | {
    "WanVAEConfig": "pewm_jax.models.wan.codec:WanVAECodec",
    "CosmosConfig": "pewm_jax.models.cosmos.backbone:CosmosBackbone",
    "SVDVAEConfig": "pewm_jax.models.svd.vae_codec:SVDVAECodec",
    "SVDUNetConfig": "pewm_jax.models.svd.backbone:SVDUNetBackbone",
    "VAEConfig": "pewm_jax.models.cogvideox.vae_codec:VAECodec",
    "DiTConfig": "pewm_jax.models.cogvideox.backbone:DiTBackbone",
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
    "PersistConfig": "pewm_jax.worlds.persist.world:PERSIST",
    "CodecWorldConfig": "pewm_jax.worlds.codec:CodecTask",
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
