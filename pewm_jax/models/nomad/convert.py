"""NoMaD's published weights (``nomad.pth`` of ``visualnav-transformer``): names and layouts.

The file is a table of tensors that torch wrote; it is read as data, torch is not needed. Every
tensor is used, except those that the original never uses: the classifiers of its EfficientNets,
the layer from which its transformer's layers were copied, and the table of positions, which is
computed.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tree, weights
from pewm_jax.io.published import CONV, LINEAR, Entry, Transform, affine, norm
from pewm_jax.models.nomad import efficientnet
from pewm_jax.models.nomad import model as nomad
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.types import Params

UNUSED = (
    r"vision_encoder\.(obs|goal)_encoder\._fc\.(weight|bias)",
    r"vision_encoder\.sa_layer\..*",
    r"vision_encoder\.positional_encoding\.pos_enc",
)
POSITIONS = "vision_encoder.positional_encoding.pos_enc"
DEPTHWISE = Transform(
    lambda x: np.moveaxis(x, (0, 1), (3, 2)),
    lambda x: np.moveaxis(x, (3, 2), (0, 1)),
)
"""torch (channels, 1, k, k) ↔ (k, k, 1, channels)."""
TRANSPOSED = Transform(
    lambda x: np.flip(np.moveaxis(x, (0, 1), (1, 2)), 0),
    lambda x: np.moveaxis(np.flip(x, 0), (1, 2), (0, 1)),
)
"""A transposed convolution of torch (in, out, k) ↔ a convolution (k, in, out) of spread points."""


def read(path: str | Path, config: NomadConfig | None = None) -> tuple[NomadConfig, Params]:
    """Read a file of ``torch.save``, or safetensors with the same names.

    Returns:
        ``(config, params)`` as ``models.nomad`` takes them, float32. The sizes are the given ones,
        by default the published; the number of earlier pictures is taken from the file.

    Raises:
        UserError: the file is absent or damaged, or holds other tensors or sizes.
    """
    path, config = Path(path), config or NomadConfig()
    found = {
        name.removeprefix("module."): x for name, x in weights.read_others(path, "NoMaD").items()
    }
    table = found.get(POSITIONS)
    if table is not None and table.ndim == 3 and table.shape[1] > 2:
        config = dataclasses.replace(config, context=table.shape[1] - 2)
    listed = list(entries(config))
    absent = [entry.name for entry in listed if entry.name not in found]
    known = {entry.name for entry in listed}
    unknown = [
        name
        for name in found
        if name not in known and not any(re.fullmatch(pattern, name) for pattern in UNUSED)
    ]
    for names, what in ((absent, "lacks"), (unknown, "has, beside those of NoMaD,")):
        if names:
            raise UserError(
                f"{path}, weights of NoMaD, {what} {tree.listing(names)}: give all tensors of its "
                "state_dict and no others, and the sizes it was trained with."
            )
    turned = {entry.path: _turned(entry, found[entry.name]) for entry in listed}
    params = weights.require_shapes(turned, nomad.shapes(config), f"{path}, weights of NoMaD,")
    return config, params


def _turned(entry: Entry, x: np.ndarray) -> np.ndarray:
    """Turn a tensor; one with another number of axes is left alone, to be refused by its shape."""
    try:
        return entry.transform.read(x)
    except (ValueError, np.exceptions.AxisError):
        return x


def entries(config: NomadConfig) -> Iterator[Entry]:
    """List all tensors that are used: their names, ours, and the change of layout."""
    for ours, theirs in (("observed", "obs"), ("goal", "goal")):
        yield from _trunk(config, ours, f"vision_encoder.{theirs}_encoder")
        yield from affine(f"vision_encoder.compress_{theirs}_enc", f"{ours}_token")
    for number in range(config.layers):
        ours, theirs = f"layer_{number}", f"vision_encoder.sa_encoder.layers.{number}"
        yield Entry(f"{theirs}.self_attn.in_proj_weight", f"{ours}/to_qkv/kernel", LINEAR)
        yield Entry(f"{theirs}.self_attn.in_proj_bias", f"{ours}/to_qkv/bias")
        yield from affine(f"{theirs}.self_attn.out_proj", f"{ours}/to_out")
        yield from affine(f"{theirs}.linear1", f"{ours}/up")
        yield from affine(f"{theirs}.linear2", f"{ours}/down")
        yield from norm(f"{theirs}.norm1", f"{ours}/norm_1")
        yield from norm(f"{theirs}.norm2", f"{ours}/norm_2")
    yield from _denoiser(config)
    for number in range(3):
        yield from affine(f"dist_pred_net.network.{2 * number}", f"distance_{number}")


def _trunk(config: NomadConfig, ours: str, theirs: str) -> Iterator[Entry]:
    yield Entry(f"{theirs}._conv_stem.weight", f"{ours}/stem/kernel", CONV)
    yield from norm(f"{theirs}._bn0", f"{ours}/stem_norm")
    size = config.trunk_width, config.trunk_depth, config.trunk_stages
    for number, block in enumerate(efficientnet.blocks(*size)):
        here, there = f"{ours}/block_{number}", f"{theirs}._blocks.{number}"
        if block.hidden != block.inward:
            yield Entry(f"{there}._expand_conv.weight", f"{here}/expand/kernel", CONV)
            yield from norm(f"{there}._bn0", f"{here}/expand_norm")
        yield Entry(f"{there}._depthwise_conv.weight", f"{here}/filter/kernel", DEPTHWISE)
        yield from norm(f"{there}._bn1", f"{here}/filter_norm")
        yield from affine(f"{there}._se_reduce", f"{here}/squeeze", transform=CONV)
        yield from affine(f"{there}._se_expand", f"{here}/excite", transform=CONV)
        yield Entry(f"{there}._project_conv.weight", f"{here}/project/kernel", CONV)
        yield from norm(f"{there}._bn2", f"{here}/project_norm")
    yield Entry(f"{theirs}._conv_head.weight", f"{ours}/head/kernel", CONV)
    yield from norm(f"{theirs}._bn1", f"{ours}/head_norm")


def _denoiser(config: NomadConfig) -> Iterator[Entry]:
    net, steps = "noise_pred_net", len(config.channels)
    yield from affine(f"{net}.diffusion_step_encoder.1", "denoiser/time_1")
    yield from affine(f"{net}.diffusion_step_encoder.3", "denoiser/time_2")
    places = [(f"down_{n}", f"{net}.down_modules.{n}") for n in range(steps)]
    places.append(("middle", f"{net}.mid_modules"))
    places += [(f"up_{n}", f"{net}.up_modules.{steps - 1 - n}") for n in range(1, steps)]
    there = nomad.denoiser_shapes(config)
    for ours, theirs in places:
        for letter, number in (("a", 0), ("b", 1)):
            here, module = f"denoiser/{ours}/{letter}", f"{theirs}.{number}"
            for part, at in (("one", 0), ("two", 1)):
                yield from affine(f"{module}.blocks.{at}.block.0", f"{here}/{part}", transform=CONV)
                yield from norm(f"{module}.blocks.{at}.block.1", f"{here}/{part}_norm")
            yield from affine(f"{module}.cond_encoder.1", f"{here}/told")
            if f"{ours}/{letter}/past/kernel" in there:
                yield from affine(f"{module}.residual_conv", f"{here}/past", transform=CONV)
        for name, turn in (("half", CONV), ("twice", TRANSPOSED)):
            if f"{ours}/{name}/kernel" in there:
                yield from affine(f"{theirs}.2.conv", f"denoiser/{ours}/{name}", transform=turn)
    yield from affine(f"{net}.final_conv.0.block.0", "denoiser/last", transform=CONV)
    yield from norm(f"{net}.final_conv.0.block.1", "denoiser/last_norm")
    yield from affine(f"{net}.final_conv.1", "denoiser/out", transform=CONV)
