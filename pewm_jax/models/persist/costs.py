"""What transformer blocks over frames cost, for the networks that are made of them."""

from __future__ import annotations

import dataclasses
import math

from pewm_jax.models.persist.blocks import Parts
from pewm_jax.models.persist.config import BlocksConfig, VoxelVAEConfig
from pewm_jax.models.persist.voxel_vae import kernels
from pewm_jax.nn.costs import SPLIT, Costs, Product, Share


def macs(config: BlocksConfig, parts: Parts, frames: int, tokens: int, given: int = 0) -> dict:
    """Return the multiply-adds of T frames by kind: ``linear``, ``modulation``, ``attention``.

    Args:
        config: the blocks.
        parts: of each block.
        frames: T.
        tokens: N, of a frame.
        given: M, of a frame, that ``cross`` attends to.
    """
    width, found = config.width, {"linear": 0.0, "modulation": 0.0, "attention": 0.0}
    for part in parts:
        others = {"space": tokens, "time": min(frames, config.context), "cross": given}[part]
        from_given = 2 * (given - tokens) if part == "cross" else 0
        per_frame = tokens * (4 + 2 * config.mlp_ratio) + from_given
        found["linear"] += config.layers * frames * per_frame * width**2
        found["modulation"] += config.layers * frames * 6 * width**2
        found["attention"] += config.layers * frames * 2 * tokens * others * width
    return found


def costs(
    config: BlocksConfig,
    parts: Parts,
    share: Share,
    name: str,
    frames: int,
    tokens: int,
    *,
    given: int = 0,
    ends: float = 0.0,
    trained: bool,
) -> Costs:
    """Return the costs of a network of such blocks.

    Args:
        config: the blocks.
        parts: of each block.
        share: one device's share of the step.
        name: the network's, as its parameters are named.
        frames: T, of a clip.
        tokens: N, of a frame.
        given: M, of a frame, that ``cross`` attends to.
        ends: multiply-adds of one frame in the layers around the blocks.
        trained: whether it learns; else it runs forward only.
    """
    work, again = macs(config, parts, frames, tokens, given), float(config.remat)
    backward = 2.0 * trained
    whole = share.clips * frames * tokens * config.width * share.activation_bytes / share.context
    part = whole / share.tensor
    depth = config.layers * len(parts)
    kept = depth / len(parts) if config.remat else depth * (6 + config.mlp_ratio / share.tensor)
    passes = 1 + 2 * trained + again
    return Costs(
        (
            Product(name, "linear", work["linear"], backward, again, SPLIT),
            Product(name, "linear", work["modulation"], backward, again, ("tensor",)),
            Product(name, "attention", work["attention"], backward, again, SPLIT),
            Product(name, "linear", frames * ends, backward),
        ),
        kept=kept * whole * trained,
        block=(12 + 2 * config.mlp_ratio) * part,
        streamed=depth * whole * 20 * passes,
        summed=2 * depth * passes * whole,
        gathered=2 * config.layers * part * (share.context > 1),
        scattered=2 * config.layers * part * (share.context > 1) * trained,
    )


def voxel_vae_costs(config: VoxelVAEConfig, share: Share, grids: int, *, trained: bool) -> Costs:
    """Return the costs of encoding ``grids`` grids of a clip, and in training of decoding them.

    Args:
        config: the network.
        share: one device's share of the step.
        grids: of a clip.
        trained: whether it learns; else it is frozen, and only encodes.
    """
    if trained and config.cube:
        grids *= config.cubes
        config = dataclasses.replace(config, side=config.cube, cube=0)
    macs, kept, largest = 0.0, 0.0, 0.0
    for path, shape in kernels(config).items():
        if not trained and path.startswith("decoder"):
            continue
        places = _places(config, path) ** 3
        look_up = path == "encoder/embed"
        if path == "decoder/scores" and config.compared:
            places = config.compared
        macs += 0 if look_up else places * math.prod(shape)
        values = places * (shape[-1] if path != "decoder/scores" or not config.slab else 0)
        kept, largest = kept + values, max(largest, values)
    bytes_of = share.clips * grids * share.activation_bytes
    return Costs(
        (Product("voxel_vae", "convolution", macs * grids, 2.0 * trained),),
        kept=3 * kept * bytes_of * trained,  # a norm's, an activation's and a kernel's input
        held=0.0 if trained else 3 * largest * bytes_of,
        streamed=(9 if trained else 3) * kept * bytes_of,
    )


def _places(config: VoxelVAEConfig, path: str) -> int:
    """Return the places along an axis at which a layer computes."""
    if path in ("encoder/embed", "decoder/scores"):
        return config.side
    finest = config.side // config.patch
    if path in ("encoder/into", "decoder/out"):
        return finest
    if "level_" not in path:
        return config.latent_side
    level = int(path.split("level_")[1].partition("/")[0])
    level += {"down": 1, "up": -1}.get(path.rpartition("/")[2], 0)
    return finest // 2**level
