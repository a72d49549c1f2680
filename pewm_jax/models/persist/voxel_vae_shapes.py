"""The autoencoder of voxels: shapes of its parameters, how they are sharded, what it costs."""

from __future__ import annotations

import dataclasses
import math

from jax.sharding import PartitionSpec as P

from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.nn.costs import Costs, Product, Share

SHARDING = (
    (r"voxel_vae/.*/kernel", P(None, "fsdp")),
    (r"voxel_vae/.*/(bias|scale)", P()),
    (r"voxel_vae/latent_(mean|scale)_C", P()),
)
"""Gathered when it computes, each device its own grids."""


Kernels = dict[str, tuple[int, ...]]


def kernels(config: VoxelVAEConfig) -> Kernels:
    """Return the shape of each kernel by path; those of convolutions have five axes."""
    return {**_encoder(config), **_decoder(config)}


def _encoder(config: VoxelVAEConfig) -> Kernels:
    inside, last, around = config.widths[0], config.widths[-1], config.middle_kernel
    made: Kernels = {"encoder/embed": (config.classes, config.embed)}
    if config.patch > 1:
        made["encoder/into"] = (config.embed * config.patch**3, inside)
    for level, width in enumerate(config.widths):
        for number in range(config.blocks):
            made |= _block(f"encoder/level_{level}/block_{number}", inside, width, config.kernel)
            inside = width
        if follows(config, level):
            made[f"encoder/level_{level}/down"] = (3, 3, 3, width, width)
    for number in range(config.middle):
        made |= _block(f"encoder/middle_{number}", last, last, around)
    made["encoder/out"] = (around, around, around, last, 2 * config.latent_channels)
    return made


def _decoder(config: VoxelVAEConfig) -> Kernels:
    inside, around = config.widths[-1], config.middle_kernel
    made: Kernels = {"decoder/into": (around, around, around, config.latent_channels, inside)}
    for number in range(config.middle):
        made |= _block(f"decoder/middle_{number}", inside, inside, around)
    for level, width in reversed(list(enumerate(config.widths))):
        for number in range(config.blocks + 1):
            made |= _block(f"decoder/level_{level}/block_{number}", inside, width, config.kernel)
            inside = width
        if level:
            made[f"decoder/level_{level}/up"] = (3, 3, 3, width, width)
    if config.patch > 1:
        made["decoder/out"] = (inside, config.embed * config.patch**3)
    made["decoder/scores"] = (config.embed, config.classes)
    return made


def _block(where: str, inward: int, outward: int, side: int) -> Kernels:
    """Return the kernels of a residual block; the last one leads past it where widths differ."""
    made: Kernels = {
        f"{where}/one": (side, side, side, inward, outward),
        f"{where}/two": (side, side, side, outward, outward),
    }
    return made if inward == outward else {**made, f"{where}/past": (inward, outward)}


def follows(config: VoxelVAEConfig, level: int) -> bool:
    """Tell whether a coarser level comes after this one."""
    return level + 1 < len(config.widths)


def shapes(config: VoxelVAEConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by path."""
    made: dict[str, tuple[int, ...]] = {}
    for path, shape in kernels(config).items():
        made[f"{path}/kernel"] = shape
        if path != "encoder/embed":
            made[f"{path}/bias"] = shape[-1:]
        where, _, name = path.rpartition("/")
        if name in ("one", "two"):  # a norm over what goes in
            made[f"{where}/norm_{name}/scale"] = made[f"{where}/norm_{name}/bias"] = shape[-2:-1]
    for name, width in (("encoder", config.widths[-1]), ("decoder", config.widths[0])):
        made[f"{name}/norm/scale"] = made[f"{name}/norm/bias"] = (width,)
    return made


def costs(config: VoxelVAEConfig, share: Share, grids: int, *, trained: bool) -> Costs:
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
