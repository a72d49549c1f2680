"""The world model: the diffusion transformer, conditioned on what was seen and what is done.

Input channels, in order: noisy colour and depth latents, clean latents of the observed first
frame (zero for later latent frames), camera (Plücker) channels. After every transformer block a
memory block reads the map.

Parameters: ``backbone`` (the DiT), ``memory`` (camera, tokens, blocks), and where the configuration
asks for them the frozen ``codec`` (the VAE), ``encoder`` (DINOv2) and ``text`` (the prompt's
embedding). Without the ``memory`` entry, or without map tokens, it is the stage-1 model.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config, DiTConfig
from pewm_jax.geometry.plucker import camera_latents
from pewm_jax.models import codec, dinov2, dit, layers
from pewm_jax.models.memory_block import MemoryBlock
from pewm_jax.models.memory_geometry import Sightings, sightings, sinusoid_3d
from pewm_jax.types import Array, Camera, MapTokens, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Conditioning:
    """What the denoiser is told besides the map, leading axis B.

    Attributes:
        first_BthwC: clean latents of the observed frame at t = 0, zero for later latent frames.
        rays_BthwC: camera embedding at the latent rate.
        camera: (B, T) cameras of the clip's frames.
        text_BLC: text tokens; zeros stand for the empty prompt.
    """

    first_BthwC: Array
    rays_BthwC: Array
    camera: Camera
    text_BLC: Array


def feature_channels(config: Config) -> int:
    """Return the number of features F of a map cell."""
    memory = config.memory
    return memory.dinov2.width if memory.encoder == "dinov2" else 6


def camera_channels(config: Config) -> int:
    """Return the camera channels at the latent rate, 24 for a temporal factor of 4."""
    return 6 * config.codec.temporal


def in_channels(config: Config) -> int:
    """Return the input channels of the patch embedding."""
    return 2 * codec.latent_channels(config) + camera_channels(config)


def backbone(config: Config) -> DiTConfig:
    """Return the transformer's settings with its channels filled in."""
    return dataclasses.replace(
        config.dit,
        in_channels=in_channels(config),
        out_channels=codec.latent_channels(config),
    )


def condition(
    config: Config, params: Params, rgb_BHWC: Array, depth_BHW: Array, camera: Camera
) -> Conditioning:
    """Build the conditioning of a batch of clips.

    Args:
        config: the experiment.
        params: the world model's parameters; codec and text are used.
        rgb_BHWC: (B, H, W, 3) the observed first frame, float in [−1, 1].
        depth_BHW: (B, H, W) its depth, metres.
        camera: (B, T) cameras of all frames of the clip, world frame.
    """
    batch = rgb_BHWC.shape[0]
    frames, h, w = codec.latent_shape(config)
    first = codec.encode_rgbd(config, params, rgb_BHWC[:, None], depth_BHW[:, None], condition=True)
    padding = jnp.zeros((batch, frames - 1, h, w, first.shape[-1]), first.dtype)
    clip = config.clip
    rays = jax.vmap(
        lambda c: camera_latents(
            c, clip.height, clip.width, config.codec.spatial, config.codec.temporal
        )
    )(camera)
    prompt = jnp.zeros((config.dit.text_length, config.dit.text_dim))
    prompt = jnp.asarray(params.get("text", {}).get("prompt_LC", prompt), jnp.float32)
    text = jnp.broadcast_to(prompt, (batch, *prompt.shape))
    return Conditioning(jnp.concatenate([first, padding], 1), rays, camera, text)


def _memory_parts(config: Config) -> tuple[layers.nn.Dense, layers.nn.Dense]:
    """Return the embeddings of camera channels (per token) and of map tokens."""
    dtype = jnp.dtype(config.train.dtype)
    memory_width = config.memory.heads * config.memory.head_dim
    camera = layers.dense(config.dit.width // 2, dtype, "camera")
    # The layer norm that follows would forget how large a feature is; next to a constant of
    # size 1 in random directions it keeps it.
    constant = layers.nn.initializers.normal(1.0)
    tokens = layers.nn.Dense(memory_width, dtype=dtype, bias_init=constant, name="tokens")
    return camera, tokens


def token_channels(config: Config) -> int:
    """Return the channels of a map token: features and, with sinusoid positions, its place."""
    positions = 60 if config.memory.positions == "sinusoid" else 0
    return feature_channels(config) + positions


def init(config: Config, key: Array, *, memory: bool = True) -> Params:
    """Initialise the backbone and, with ``memory``, the memory blocks (identity at the start)."""
    backbone_key, memory_key = jax.random.split(key)
    frozen_key = jax.random.fold_in(key, 2)
    params: Params = {"backbone": dit.init(backbone(config), backbone_key)}
    if memory:
        params["memory"] = init_memory(config, memory_key)
    if config.codec.kind == "vae":
        params["codec"] = codec.init(config.codec, frozen_key)
    if config.memory.encoder == "dinov2":
        params["encoder"] = dinov2.init(config.memory.dinov2, jax.random.fold_in(frozen_key, 1))
    if config.dit.prompt == "stored":
        params["text"] = {"prompt_LC": jnp.zeros((config.dit.text_length, config.dit.text_dim))}
    return params


def init_memory(config: Config, key: Array) -> Params:
    """Initialise the memory blocks alone; their gates are zero."""
    camera, tokens = _memory_parts(config)
    camera_key, tokens_key, blocks_key = jax.random.split(key, 3)
    memory, width = config.memory, config.dit.width
    half = memory.head_dim // 2
    q = config.codec.temporal * config.dit.patch_t
    seen = None
    if memory.positions == "projective":
        seen = Sightings(
            jnp.zeros((1, 1, q, 1), jnp.int32),
            jnp.zeros((1, 1, q, 1, half)),
            jnp.zeros((1, 1, q, 1, 3)),
            jnp.ones((1, 1, q, 1), bool),
            jnp.zeros((1, half)),
        )
    example = (
        jnp.zeros((1, 1, width)),
        jnp.zeros((1, config.dit.time_dim)),
        jnp.zeros((1, 1, width // 2)),
        jnp.zeros((1, 1, memory.heads * memory.head_dim)),
        jnp.ones((1, 1), bool),
        seen,
    )
    blocks = jax.vmap(lambda k: MemoryBlock(config).init(k, *example)["params"])(
        jax.random.split(blocks_key, config.dit.layers)
    )
    rays = camera_channels(config) * config.dit.patch**2 * config.dit.patch_t
    return {
        "camera": camera.init(camera_key, jnp.zeros((1, rays)))["params"],
        "tokens": tokens.init(tokens_key, jnp.zeros((1, token_channels(config))))["params"],
        "blocks": blocks,
    }


def apply(
    config: Config,
    params: Params,
    noisy_BthwC: Array,
    conditioning: Conditioning,
    timesteps_B: Array,
    tokens: MapTokens | None = None,
) -> Array:
    """Predict the target (x0, v or ε) from noisy latents.

    Args:
        config: the experiment.
        params: ``{"backbone": …, "memory": …}``.
        noisy_BthwC: (B, t, h, w, C) noisy colour and depth latents.
        conditioning: the observed frame, cameras and text.
        timesteps_B: (B,) diffusion times.
        tokens: map tokens with leading axis B; None is the stage-1 model.

    Returns:
        (B, t, h, w, C) float32 prediction.
    """
    dtype = jnp.dtype(config.train.dtype)
    missing = -noisy_BthwC.shape[1] % config.dit.patch_t

    def whole(x_BthwC: Array) -> Array:
        """Repeat the first latent frame until dit.patch_t divides their number (CogVideoX 1.5)."""
        return jnp.concatenate([x_BthwC[:, :1]] * missing + [x_BthwC], 1).astype(dtype)

    noisy, first = (_seen(config, x) for x in (noisy_BthwC, conditioning.first_BthwC))
    rays_BthwC = whole(conditioning.rays_BthwC)
    latents = jnp.concatenate([whole(noisy), whole(first), rays_BthwC], -1)
    expert, expert_params = None, None
    if tokens is not None and "memory" in params:
        memory = params["memory"]
        camera_layer, token_layer = _memory_parts(config)
        rays = dit.patchify(rays_BthwC, config.dit.patch, config.dit.patch_t)
        layout = dit.layout_of(config.dit, latents.shape, conditioning.text_BLC.shape[1])
        camera = layout.spread(camera_layer.apply({"params": memory["camera"]}, rays))
        valid, seen = tokens.valid_M, None
        points, features = (
            jnp.where(valid[..., None], x, 0) for x in (tokens.points_world_M3, tokens.features_MF)
        )
        if config.memory.positions == "projective":
            seen = sightings(config, conditioning.camera, points, valid)
        else:
            place = sinusoid_3d(config, conditioning.camera, points)
            features = jnp.concatenate([features, place], -1)
        embedded = token_layer.apply({"params": memory["tokens"]}, features.astype(dtype))
        expert_params = memory["blocks"]

        def read_map(layer: Params, video: Array, time: Array) -> Array:
            block = MemoryBlock(config)
            return block.apply({"params": layer}, video, time, camera, embedded, valid, seen)

        expert = read_map

    out = dit.apply(
        config.dit,
        params["backbone"],
        latents,
        conditioning.text_BLC,
        timesteps_B,
        expert=expert,
        expert_params=expert_params,
    )
    return _seen(config, out[:, missing:].astype(jnp.float32))


def _seen(config: Config, latents_C: Array) -> Array:
    """Blank the depth channels of latents where the denoiser works without depth.

    They stay, so that both variants have the same parameters.
    """
    if config.memory.depth:
        return latents_C
    colour = np.arange(latents_C.shape[-1]) < codec.rgb_channels(config)
    return jnp.where(colour, latents_C, 0)
