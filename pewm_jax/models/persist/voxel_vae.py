"""The autoencoder of voxels: a grid of class ids to a small grid of latents, and back.

PERSIST (arXiv 2603.03482): residual blocks of 3D convolutions at three widths, each level with half
the resolution of the one before; layer norms over channels, SiLU; trained by cross-entropy and a
small KL divergence from a normal distribution. A linear layer on one-hot ids is an embedding table,
which is how ids are read here.

Latents have mean 0 and variance 1 per channel once ``latent_mean_C`` and ``latent_scale_C``
are set (``with_statistics``).

Parameters: ``encoder/embed, into (patch > 1), level_i/block_k, level_i/down, middle_k, norm, out``;
the decoder's are the mirror image, and end in ``scores``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.errors import UserError
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.nn import placement
from pewm_jax.nn.convolution import convolve_grid, halve_grid
from pewm_jax.nn.layers import layer_norm, linear
from pewm_jax.nn.parameters import draw
from pewm_jax.nn.tokens import patchify, unpatchify
from pewm_jax.types import Array, Params

SHARDING = (
    (r"voxel_vae/.*/kernel", P(None, "fsdp")),
    (r"voxel_vae/.*/(bias|scale)", P()),
    (r"voxel_vae/latent_(mean|scale)_C", P()),
)
"""Sharding rules: weights are gathered when they are used, each device has its own grids."""
Kernels = dict[str, tuple[int, ...]]
FIRST_DEVIATION = 0.05
"""Standard deviation of the latents around their means at initialization."""


def kernels(config: VoxelVAEConfig) -> Kernels:
    """Return the shape of each kernel by path; those of convolutions have five axes."""
    return {**_encoder_kernels(config), **_decoder_kernels(config)}


def _encoder_kernels(config: VoxelVAEConfig) -> Kernels:
    inside, last, around = config.widths[0], config.widths[-1], config.middle_kernel
    made: Kernels = {"encoder/embed": (config.classes, config.embed)}
    if config.patch > 1:
        made["encoder/into"] = (config.embed * config.patch**3, inside)
    for level, width in enumerate(config.widths):
        for number in range(config.blocks):
            made |= _block_kernels(
                f"encoder/level_{level}/block_{number}", inside, width, config.kernel
            )
            inside = width
        if is_followed(config, level):
            made[f"encoder/level_{level}/down"] = (3, 3, 3, width, width)
    for number in range(config.middle):
        made |= _block_kernels(f"encoder/middle_{number}", last, last, around)
    made["encoder/out"] = (around, around, around, last, 2 * config.latent_channels)
    return made


def _decoder_kernels(config: VoxelVAEConfig) -> Kernels:
    inside, around = config.widths[-1], config.middle_kernel
    made: Kernels = {"decoder/into": (around, around, around, config.latent_channels, inside)}
    for number in range(config.middle):
        made |= _block_kernels(f"decoder/middle_{number}", inside, inside, around)
    for level, width in reversed(list(enumerate(config.widths))):
        for number in range(config.blocks + 1):
            made |= _block_kernels(
                f"decoder/level_{level}/block_{number}", inside, width, config.kernel
            )
            inside = width
        if level:
            made[f"decoder/level_{level}/up"] = (3, 3, 3, width, width)
    if config.patch > 1:
        made["decoder/out"] = (inside, config.embed * config.patch**3)
    made["decoder/scores"] = (config.embed, config.classes)
    return made


def _block_kernels(where: str, inward: int, outward: int, side: int) -> Kernels:
    """Return the kernels of a residual block; the last one is the shortcut where widths differ."""
    made: Kernels = {
        f"{where}/one": (side, side, side, inward, outward),
        f"{where}/two": (side, side, side, outward, outward),
    }
    return made if inward == outward else {**made, f"{where}/past": (inward, outward)}


def is_followed(config: VoxelVAEConfig, level: int) -> bool:
    """Tell whether a coarser level follows."""
    return level + 1 < len(config.widths)


def shapes(config: VoxelVAEConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by path."""
    made: dict[str, tuple[int, ...]] = {}
    for path, shape in kernels(config).items():
        made[f"{path}/kernel"] = shape
        if path != "encoder/embed":
            made[f"{path}/bias"] = shape[-1:]
        where, _, name = path.rpartition("/")
        if name in ("one", "two"):  # a norm over the input
            made[f"{where}/norm_{name}/scale"] = made[f"{where}/norm_{name}/bias"] = shape[-2:-1]
    for name, width in (("encoder", config.widths[-1]), ("decoder", config.widths[0])):
        made[f"{name}/norm/scale"] = made[f"{name}/norm/bias"] = (width,)
    return made


def init(config: VoxelVAEConfig, key: Array) -> Params:
    """Return random parameters, float32.

    Residual blocks are the identity, and the latents' deviation is ``FIRST_DEVIATION``: from
    latents that were mostly noise the decoder would learn nothing.
    """
    params = draw(shapes(config), key)
    for part in ("encoder", "decoder"):
        for where in (params[part], *params[part].values()):
            for name, leaf in where.items():
                if name.startswith(("block_", "middle_")):
                    leaf["two"]["kernel"] = jnp.zeros_like(leaf["two"]["kernel"])
    embed = params["encoder"]["embed"]
    embed["kernel"] = embed["kernel"] * jnp.sqrt(float(config.classes))  # only one row is looked up
    out = params["encoder"]["out"]
    out["bias"] = out["bias"].at[config.latent_channels :].set(2 * math.log(FIRST_DEVIATION))
    params["latent_mean_C"] = jnp.zeros((config.latent_channels,))
    params["latent_scale_C"] = jnp.ones((config.latent_channels,))
    return params


def with_statistics(params: Params, mean_C: Array, scale_C: Array) -> Params:
    """Return parameters that normalise latents to mean 0 and variance 1.

    ``mean_C`` and ``scale_C`` are the mean and the standard deviation of the latents' channels that
    ``params`` give.
    """
    before = params["latent_scale_C"]
    mean = params["latent_mean_C"] + before * mean_C
    return {**params, "latent_mean_C": mean, "latent_scale_C": before * scale_C}


def moments(
    config: VoxelVAEConfig, params: Params, classes_BXYZ: Array, dtype: jnp.dtype = jnp.float32
) -> tuple[Array, Array]:
    """Return mean and log variance of the latents before they are normalised, float32.

    Both are (B, side/f, side/f, side/f, C), where f is ``config.factor``; the grids are of integer
    class ids.

    Raises:
        UserError: grids of another size.
    """
    require_grids(config, classes_BXYZ)
    part = params["encoder"]
    x = part["embed"]["kernel"].astype(dtype)[jnp.asarray(classes_BXYZ)]
    if config.patch > 1:
        places = config.side // config.patch
        folded = patchify(x, config.patch, config.patch)
        x = linear(part["into"], folded.reshape(len(x), *(places,) * 3, -1))
    for level in range(len(config.widths)):
        inside = part[f"level_{level}"]
        for number in range(config.blocks):
            x = _block(config, inside[f"block_{number}"], x)
        if is_followed(config, level):
            kernel = inside["down"]["kernel"].astype(x.dtype)
            x = halve_grid(x, kernel, config.convolution) + inside["down"]["bias"].astype(x.dtype)
    for number in range(config.middle):
        x = _block(config, part[f"middle_{number}"], x)
    x = jax.nn.silu(layer_norm(part["norm"], x))
    mean, log_variance = jnp.split(_convolved(config, part["out"], x).astype(jnp.float32), 2, -1)
    return mean, jnp.clip(log_variance, -30, 20)


def encode(
    config: VoxelVAEConfig, params: Params, classes_BXYZ: Array, dtype: jnp.dtype = jnp.float32
) -> Array:
    """Return the latents of grids, (B, x, y, z, C) float32, normalised; see ``moments``."""
    mean, _ = moments(config, params, classes_BXYZ, dtype)
    return (mean - params["latent_mean_C"]) / params["latent_scale_C"]


def features(
    config: VoxelVAEConfig, params: Params, latents_BxyzC: Array, dtype: jnp.dtype = jnp.float32
) -> Array:
    """Return the input of the layer that scores classes, (B, X, Y, Z, embed), from ``encode``'s."""
    x = latents_BxyzC * params["latent_scale_C"] + params["latent_mean_C"]
    return _features(config, params["decoder"], x.astype(dtype))


def logits(config: VoxelVAEConfig, params: Params, latents_BxyzC: Array) -> Array:
    """Return the scores of all classes at every cell, (B, X, Y, Z, classes), of small grids."""
    return linear(params["decoder"]["scores"], features(config, params, latents_BxyzC))


def decode(
    config: VoxelVAEConfig, params: Params, latents_BxyzC: Array, dtype: jnp.dtype = jnp.float32
) -> Array:
    """Return the most likely class id of every cell, (B, X, Y, Z) int32.

    The scores of ``config.slab`` layers of cells are in memory at a time.
    """
    part = params["decoder"]["scores"]
    seen = features(config, params, latents_BxyzC, dtype)
    return _by_slab(config, lambda slab: linear(part, slab).argmax(-1).astype(jnp.int32), seen)


def loss(
    config: VoxelVAEConfig,
    params: Params,
    classes_BXYZ: Array,
    key: Array,
    dtype: jnp.dtype = jnp.float32,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of a batch of grids: cross-entropy of every cell, and the divergence.

    Returns:
        ``(loss, measured)``: ``cross_entropy`` per compared cell (occupied ones weigh
        ``occupied_weight``), ``divergence`` summed over a grid's latents and divided by its cells,
        ``occupied_right`` and ``empty_right``, the shares of such cells whose class is the
        most likely one.
    """
    if config.cube:
        require_grids(config, classes_BXYZ)
        cubes_key, key = jax.random.split(key)
        classes_BXYZ = cubes(config, classes_BXYZ, cubes_key)
        config = dataclasses.replace(config, side=config.cube, cube=0)
    mean, log_variance = moments(config, params, classes_BXYZ, dtype)
    noise_key, cells_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, mean.shape)
    sampled = mean + jnp.exp(log_variance / 2) * noise
    part = params["decoder"]
    seen = _features(config, part, sampled.astype(dtype))
    ids = jnp.asarray(classes_BXYZ).astype(jnp.int32)

    def compare(slab: Array, wanted: Array) -> tuple[Array, Array]:
        scores = linear(part["scores"], slab).astype(jnp.float32)
        chosen = jnp.take_along_axis(scores, wanted[..., None], -1)[..., 0]
        return jax.nn.logsumexp(scores, -1) - chosen, chosen >= scores.max(-1)

    full = (ids != 0).astype(jnp.float32)
    weight = 1 + (config.occupied_weight - 1) * full
    if config.compared:
        cells = sample_cells(weight.reshape(len(ids), -1), config.compared, cells_key)
        ids, full = (jnp.take_along_axis(x.reshape(len(x), -1), cells, 1) for x in (ids, full))
        flat = seen.reshape(len(seen), -1, config.embed)
        missed, right = compare(jnp.take_along_axis(flat, cells[..., None], 1), ids)
        entropy = missed.mean()
    else:
        missed, right = _by_slab(config, jax.checkpoint(compare), seen, ids)
        entropy = (missed * weight).sum() / weight.sum()
    divergence = (jnp.square(mean) + jnp.exp(log_variance) - 1 - log_variance) / 2
    divergence = divergence.sum() / jnp.size(classes_BXYZ)
    measured = {
        "cross_entropy": entropy,
        "divergence": divergence,
        "occupied_right": (right * full).sum() / jnp.maximum(full.sum(), 1),
        "empty_right": (right * (1 - full)).sum() / jnp.maximum((1 - full).sum(), 1),
    }
    return entropy + config.kl * divergence, measured


def cubes(config: VoxelVAEConfig, classes_BXYZ: Array, key: Array) -> Array:
    """Return ``config.cubes`` cubes of each grid, (B · cubes, cube, cube, cube).

    Each holds an occupied cell, drawn at random, if its grid has one, and starts at a whole latent.
    """
    ids = jnp.asarray(classes_BXYZ)
    full = (ids != 0).astype(jnp.float32).reshape(len(ids), -1)
    cells_key, off_key = jax.random.split(key)
    cells = sample_cells(full, config.cubes, cells_key)
    place = jnp.stack(jnp.unravel_index(cells, ids.shape[1:]), -1)
    low = place - jax.random.randint(off_key, place.shape, 0, config.cube)
    low = jnp.clip(low // config.factor * config.factor, 0, config.side - config.cube)
    # Rounded down, a cube could end before its cell.
    low = jnp.where(low + config.cube <= place, low + config.factor, low)

    def cut(grid: Array, low_3: Array) -> Array:
        return jax.lax.dynamic_slice(grid, tuple(low_3), (config.cube,) * 3)

    made = jax.vmap(lambda grid, lows: jax.vmap(lambda low: cut(grid, low))(lows))(ids, low)
    return made.reshape(-1, *made.shape[2:])


def sample_cells(weight_BN: Array, count: int, key: Array) -> Array:
    """Draw (B, count) positions of each row with probabilities proportional to their weights."""
    share_BN = jnp.cumsum(weight_BN, 1)
    at = jax.random.uniform(key, (len(share_BN), count)) * share_BN[:, -1:]
    places = jax.vmap(lambda share, at: jnp.searchsorted(share, at, side="right"))(share_BN, at)
    return jnp.minimum(places, share_BN.shape[1] - 1)


def require_grids(config: VoxelVAEConfig, classes_BXYZ: Array) -> None:
    """Refuse grids that are not the network's.

    Raises:
        UserError: another size, or not integers.
    """
    shape, side = jnp.shape(classes_BXYZ), config.side
    if len(shape) != 4 or shape[1:] != (side,) * 3:
        raise UserError(
            f"The voxels have shape {shape}: this network takes (batch, {side}, {side}, {side}) "
            "(voxel_vae.side)."
        )
    if not jnp.issubdtype(jnp.asarray(classes_BXYZ).dtype, jnp.integer):
        raise UserError("The voxels are not integers: give class ids, 0 for an empty cell.")


def _features(config: VoxelVAEConfig, part: Params, latents_BxyzC: Array) -> Array:
    """Run the decoder up to the scores, from latents that are not normalised."""
    x = _convolved(config, part["into"], latents_BxyzC)
    for number in range(config.middle):
        x = _block(config, part[f"middle_{number}"], x)
    for level in reversed(range(len(config.widths))):
        inside = part[f"level_{level}"]
        for number in range(config.blocks + 1):
            x = _block(config, inside[f"block_{number}"], x)
        if level:
            for axis in (1, 2, 3):
                x = jnp.repeat(x, 2, axis)
            x = _convolved(config, inside["up"], x)
    x = jax.nn.silu(layer_norm(part["norm"], x))
    if config.patch == 1:
        return x
    cells = linear(part["out"], x).reshape(len(x), -1, config.embed * config.patch**3)
    side, patch = config.side, config.patch
    return jax.nn.silu(unpatchify(cells, side, side, side, patch, patch))


def _block(config: VoxelVAEConfig, part: Params, x: Array) -> Array:
    """Residual block: norm, SiLU and convolution, twice."""
    inner = jax.nn.silu(layer_norm(part["norm_one"], x))
    inner = _convolved(config, part["one"], inner)
    inner = jax.nn.silu(layer_norm(part["norm_two"], inner))
    inner = _convolved(config, part["two"], inner)
    past = linear(part["past"], x) if "past" in part else x
    return placement.constrain(past + inner, "batch")


def _convolved(config: VoxelVAEConfig, part: Params, x: Array) -> Array:
    return convolve_grid(x, part["kernel"].astype(x.dtype), config.convolution) + part[
        "bias"
    ].astype(x.dtype)


def _by_slab(config: VoxelVAEConfig, function: Callable[..., Any], *grids_BXYZ: Array) -> Any:
    """Run a function on a few layers of cells at a time, along the first axis of the grid."""
    if not config.slab or config.slab == config.side:
        return function(*grids_BXYZ)

    def cut(x: Array) -> Array:
        batch, side, *rest = x.shape
        return x.reshape(batch, side // config.slab, config.slab, *rest).swapaxes(0, 1)

    def join(x: Array) -> Array:
        _, batch, _, *rest = x.shape
        return x.swapaxes(0, 1).reshape(batch, config.side, *rest)

    made = jax.lax.map(lambda slabs: function(*slabs), tuple(cut(x) for x in grids_BXYZ))
    return jax.tree.map(join, made)
