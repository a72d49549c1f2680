"""DINOv2: patch features of images, equal to ``transformers``' reference.

The reference is ``Dinov2Model`` and ``Dinov2WithRegistersModel``. (The original repository shifts
the interpolation of position embeddings by a tenth of a patch in its models without registers;
``transformers`` does not, nor does this module. At the pretrained size all three agree.)
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from pewm_jax import config as configuration
from pewm_jax.config import serialize
from pewm_jax.config.parts import Encoder, Rules
from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.io import weights
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, modules
from pewm_jax.nn.tokens import patchify_images
from pewm_jax.types import Array, Params

MEAN_3 = (0.485, 0.456, 0.406)
"""ImageNet's mean colour in [0, 1], which DINOv2 subtracts."""
STD_3 = (0.229, 0.224, 0.225)
"""ImageNet's standard deviation of colours, by which DINOv2 divides."""


@dataclasses.dataclass(frozen=True)
class DINOv2EncoderConfig(Encoder):
    """Patch tokens of a frozen DINOv2 (the paper); the weights come from a converted checkpoint."""

    SHARDING: ClassVar[Rules] = (
        (r"encoder/.*/kernel", P(None, "fsdp")),
        (r"encoder/position_embed", P(None, "fsdp")),
        (r"encoder/register_tokens", P(None, "fsdp")),
        (r"encoder/blocks/scale[12]", P()),
        (r"encoder/cls_token", P()),
        (r"encoder/.*/(scale|bias)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own frames."""
    CONVERTED: ClassVar[bool] = True

    size: int = 518
    """Side in pixels of the square that images are resized to; a multiple of the patch. 518 gives
    37 × 37 patches."""
    network: DINOv2Config = DINOv2Config()
    """The network."""

    @property
    def channels(self) -> int:
        """Number of features of a patch: the network's width."""
        return self.network.width

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches, equal for all frames, which are resized."""
        del clip
        return self.size // self.network.patch, self.size // self.network.patch

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.encoder", "size")
        require(
            self.size % self.network.patch == 0,
            f"memory.encoder.size is {self.size}: use a multiple of memory.encoder.network.patch "
            f"{self.network.patch}, 518 for the paper's 37 × 37 features.",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return init(self.network, key)

    def encode(self, params: Params, rgb_THWC: Array) -> Array:
        """Return (T, size/p, size/p, D) patch tokens."""
        images = preprocess(rgb_THWC, self.size, self.network.patch)
        return apply(self.network, params, images)

    def preprocessing(self) -> dict[str, Any]:
        """Return what the features depend on besides the weights."""
        return {
            "network": serialize.to_dict(self.network),
            "preprocessing": {
                "size": self.size,
                "resize": "bicubic, antialiased",
                "mean": list(MEAN_3),
                "std": list(STD_3),
            },
        }


class Block(nn.Module):
    """Pre-norm attention and feed-forward, each with a learned scale per channel (LayerScale)."""

    config: DINOv2Config

    @nn.compact
    def __call__(self, x_BND: Array) -> Array:
        """(B, N, D) → (B, N, D)."""
        config, dtype = self.config, x_BND.dtype
        width = config.width
        normed = _norm(config, "norm1")(x_BND).astype(dtype)
        q, k, v = (
            layers.split_heads(modules.dense(width, dtype, f"to_{n}")(normed), config.heads)
            for n in "qkv"
        )
        mixed = layers.merge_heads(blocked_attention.attention(q, k, v))
        mixed = modules.dense(width, dtype, "to_out")(mixed)
        x_BND += mixed * self._scale("scale1", dtype)
        normed = _norm(config, "norm2")(x_BND).astype(dtype)
        if config.swiglu:
            gate, value = jnp.split(modules.dense(2 * config.hidden, dtype, "up")(normed), 2, -1)
            hidden = nn.silu(gate) * value
        else:
            hidden = modules.dense(config.hidden, dtype, "up")(normed)
            hidden = nn.gelu(hidden, approximate=False)
        return x_BND + modules.dense(width, dtype, "down")(hidden) * self._scale("scale2", dtype)

    def _scale(self, name: str, dtype: jnp.dtype) -> Array:
        return self.param(name, nn.initializers.ones_init(), (self.config.width,)).astype(dtype)


def _norm(config: DINOv2Config, name: str | None = None) -> nn.LayerNorm:
    """Layer norm in float32, with the exact variance because some channels of DINOv2 are large."""
    return nn.LayerNorm(
        epsilon=config.epsilon, dtype=jnp.float32, use_fast_variance=False, name=name
    )


def init(config: DINOv2Config, key: Array) -> Params:
    """Initialise: float32, blocks stacked over layers.

    The tree: ``patch_embed`` (a linear layer on p·p·3 pixels), ``cls_token`` (D,),
    ``register_tokens`` (R, D) if there are any, ``position_embed`` (1 + g², D) with the class
    token's first, ``blocks``, ``norm``.
    """
    patch_key, cls_key, register_key, position_key, blocks_key = jax.random.split(key, 5)
    width = config.width
    token = jnp.zeros((1, 1, width))
    draw = nn.initializers.truncated_normal(0.02)
    patches = nn.Dense(width).init(patch_key, jnp.zeros((1, config.patch**2 * 3)))["params"]
    blocks = jax.vmap(lambda k: Block(config).init(k, token)["params"])(
        jax.random.split(blocks_key, config.layers)
    )
    params = {
        "patch_embed": patches,
        "cls_token": draw(cls_key, (width,)),
        "position_embed": draw(position_key, (1 + config.grid**2, width)),
        "blocks": blocks,
        "norm": {"scale": jnp.ones(width), "bias": jnp.zeros(width)},
    }
    if config.registers:
        params["register_tokens"] = draw(register_key, (config.registers, width))
    return params


def apply(config: DINOv2Config, params: Params, images_BHWC: Array) -> Array:
    """Return the patch tokens after the final layer norm, (B, H/p, W/p, D) in the images' dtype.

    Images are independent, so a batch that is sharded over devices stays sharded. The images are
    floats from ``preprocess``; H and W are multiples of the patch. Their dtype is the dtype of the
    computation; norms and softmax are in float32.

    Raises:
        UserError: a size is not a multiple of the patch, or the array is not of RGB floats.
    """
    images = jnp.asarray(images_BHWC)
    height, width = _grid(config, images.shape, images.dtype)
    tokens = _tokens(config, params, images)[:, 1 + config.registers :]
    normed: Array = _norm(config).apply({"params": params["norm"]}, tokens)
    return normed.reshape(-1, height, width, config.width).astype(tokens.dtype)


def summary(config: DINOv2Config, params: Params, images_BHWC: Array) -> Array:
    """Return the class token after the final layer norm, (B, D): one vector for a whole image.

    Arguments and errors are those of ``apply``; this is ``transformers``' ``pooler_output``.
    """
    tokens = _tokens(config, params, jnp.asarray(images_BHWC))[:, 0]
    normed: Array = _norm(config).apply({"params": params["norm"]}, tokens)
    return normed.astype(tokens.dtype)


def _tokens(config: DINOv2Config, params: Params, images: Array) -> Array:
    """Return all tokens before the final norm: the class token, registers, patches row by row."""
    height, width = _grid(config, images.shape, images.dtype)
    dtype = images.dtype
    patches = nn.Dense(config.width, dtype=dtype).apply(
        {"params": params["patch_embed"]}, patchify_images(images, config.patch)
    )
    positions = interpolate_positions(config, params["position_embed"], height, width)
    tokens = patches + positions[1:].astype(dtype)
    first = (params["cls_token"] + positions[0]).astype(dtype)[None]
    if config.registers:  # registers have no position
        first = jnp.concatenate([first, params["register_tokens"].astype(dtype)])
    first = jnp.broadcast_to(first, (images.shape[0], *first.shape))
    return _blocks(config, params["blocks"], jnp.concatenate([first, tokens], 1))


def _blocks(config: DINOv2Config, blocks: Params, tokens_BND: Array) -> Array:
    """Run all layers; on a single CPU device, image by image.

    The activations of one image fit into the processor's cache: four images of 518² take a seventh
    less time one by one. With several devices the batch may be sharded and is not cut.
    """

    def body(x_BND: Array, layer: Params) -> tuple[Any, None]:
        return Block(config).apply({"params": layer}, x_BND), None

    def together(tokens_BND: Array) -> Array:
        return jax.lax.scan(body, tokens_BND, blocks)[0]

    def one_by_one(tokens_BND: Array) -> Array:
        return jax.lax.map(lambda x_ND: together(x_ND[None])[0], tokens_BND)

    if jax.device_count() > 1 or len(tokens_BND) == 1:
        return together(tokens_BND)
    return jax.lax.platform_dependent(tokens_BND, cpu=one_by_one, default=together)


def load(folder: Path) -> tuple[DINOv2Config, Params]:
    """Read a folder made by ``pewm-jax convert import dinov2``: configuration and NumPy parameters.

    Raises:
        UserError: a file is absent or damaged, or the weights do not fit the configuration.
    """
    if not (folder / "config.json").is_file():
        raise UserError(
            f"{folder} holds no DINOv2; make it with `pewm-jax convert import dinov2 SRC {folder}`."
        )
    config = configuration.load(folder / "config.json", DINOv2Config)
    path = folder / "weights.safetensors"
    params = weights.load(path)
    like = jax.eval_shape(lambda: init(config, jax.random.key(0)))
    weights.check(params, like, str(path))
    return config, params


def preprocess(rgb_BHWC: Array, size: int | tuple[int, int], patch: int = 14) -> Array:
    """Turn colours in [−1, 1] into the encoder's input: resized, then normalised as ImageNet.

    ``size`` in pixels is one number or (height, width), multiples of the patch; 518 gives 37×37
    patches. Resizing is bicubic with antialiasing, as in the published models' image processor.
    Nothing is cropped, so every pixel of the camera has features.

    Raises:
        UserError: a size that is not a multiple of the patch.
    """
    height, width = (size, size) if isinstance(size, int) else size
    _require_multiples(height, width, patch)
    # Channels before pixels: XLA's CUDA compiler refuses these products in the other order.
    planes = jnp.asarray(rgb_BHWC).transpose(0, 3, 1, 2)
    planes = jax.image.resize(planes, (*planes.shape[:2], height, width), "cubic", antialias=True)
    rgb = planes.transpose(0, 2, 3, 1)
    mean, std = (np.asarray(x, np.float32) for x in (MEAN_3, STD_3))
    share = (jnp.clip(rgb, -1, 1) + 1) / 2
    return ((share - mean) / std).astype(rgb.dtype)


def interpolate_positions(
    config: DINOv2Config, position_embed: Array, height: int, width: int
) -> Array:
    """Return the position embeddings of a grid of another size, (1 + h·w, D), class token first.

    Bicubic in float32 with pixels at half-integers, as ``torch.nn.functional.interpolate``: at the
    edges pixels are repeated without antialiasing, and the filter is truncated with it.
    """
    if (height, width) == (config.grid, config.grid):
        return position_embed
    grid = position_embed[1:].astype(jnp.float32).reshape(config.grid, config.grid, -1)
    rows, columns = (
        resize_matrix(config.grid, count, config.antialias) for count in (height, width)
    )
    precision = jax.lax.Precision.HIGHEST
    grid = jnp.einsum("hr,wc,rcd->hwd", rows, columns, grid, precision=precision)
    grid = grid.reshape(height * width, -1).astype(position_embed.dtype)
    return jnp.concatenate([position_embed[:1], grid])


def resize_matrix(old: int, new: int, antialias: bool, *, corners: bool = False) -> np.ndarray:
    """Return the (new, old) float32 weights of torch's bicubic interpolation along one axis.

    With ``corners`` (without antialiasing only) the first and last pixels fall onto each other, as
    with torch's ``align_corners``.

    Without antialiasing the kernel is Keys' with a = −0.75 on four samples; with it a = −0.5, and
    the kernel is widened by the factor of reduction.
    """
    scale = old / new
    matrix = np.zeros((new, old))
    for row in range(new):
        if antialias:
            stretch = max(scale, 1.0)
            centre = scale * (row + 0.5)
            low = max(int(centre - 2 * stretch + 0.5), 0)
            taps = np.arange(low, min(int(centre + 2 * stretch + 0.5), old))
            weights = _keys((taps - centre + 0.5) / stretch, -0.5)
            weights /= weights.sum()
        else:
            last = max(new - 1, 1)
            centre = row * (old - 1) / last if corners else scale * (row + 0.5) - 0.5
            taps = math.floor(centre) + np.arange(-1, 3)
            weights = _keys(taps - centre, -0.75)
            taps = np.clip(taps, 0, old - 1)
        np.add.at(matrix[row], taps, weights)
    return matrix.astype(np.float32)


def _keys(x: np.ndarray, a: float) -> np.ndarray:
    """Return Keys' cubic convolution kernel at distances x."""
    x = np.abs(x)
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


def _grid(config: DINOv2Config, shape: tuple[int, ...], dtype: jnp.dtype) -> tuple[int, int]:
    """Return the (rows, columns) of patches, or refuse images that do not fit."""
    if len(shape) != 4 or shape[3] != 3 or not jnp.issubdtype(dtype, jnp.floating):
        raise UserError(
            f"DINOv2 got images of shape {shape} and dtype {dtype}: give it floats of shape "
            "(batch, height, width, 3), from dinov2.preprocess."
        )
    _require_multiples(shape[1], shape[2], config.patch)
    return shape[1] // config.patch, shape[2] // config.patch


def _require_multiples(height: int, width: int, patch: int) -> None:
    if height % patch or width % patch or min(height, width) < patch:
        near = " × ".join(str(max(1, round(side / patch)) * patch) for side in (height, width))
        raise UserError(
            f"DINOv2 got a size of {height} × {width} pixels: both sides must be multiples of its "
            f"patch of {patch}; the nearest such size is {near}."
        )
