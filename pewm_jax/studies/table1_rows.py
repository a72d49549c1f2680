"""The rows of Table 1: memories, each with the applicable readers, and the paper's ablations.

A row is a memory's settings; everything else is the same for all rows. Each row states its name in
the paper. If a reader has a size, it is chosen to match the number of parameters of
``AttentionConfig`` in the base settings.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import Config, Memory, Reader, UserError
from pewm_jax.encoders.simple import LatentsConfig
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import Map2DConfig, VoxelConfig
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.worlds import world_model

POINTS, SURFELS = (0.4, 4), (0.12, 24)
"""Size of a cell relative to the shortest side of a voxel, and capacity relative to that of
voxels."""
PATCHES = 64
"""Smallest number of tokens per snapshot in the image memory."""
PAPER_FORM, CONTROL = "voxel-attend-sinusoid", "none-attend"
"""The row of the paper's own form, and the row of a reader without input."""
MOST_CELLS = 2**22
"""Largest number of cells of a map in ablations."""
NETWORK = "dinov2="
"""Prefix of values of the ablation of features that name a folder of DINOv2."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        name: name of its folders.
        memory: the memory and its reader.
        depth: whether the model imagines depth.
        paper: its name in the paper's Table 1, or "".
        times: its training time relative to that of other rows.
        control: whether its reader is trained without input, to measure the effect of the reader's
            parameters and training without a memory.
        encoder: folder of the weights of its image encoder, if that is a network.
    """

    name: str
    memory: Memory
    depth: bool = True
    paper: str = ""
    times: float = 1.0
    control: bool = False
    encoder: str = ""

    @property
    def reads(self) -> bool:
        """Return whether a reader is trained (stage 2); else the backbone is trained further."""
        return self.memory.REMEMBERS or self.control

    @property
    def label(self) -> str:
        """Return the row's display name: memory, reader, deviations."""
        kind, *rest = self.name.split("-")
        return f"{kind} · {', '.join(rest)}" if rest else kind


def main_rows(base: Config) -> tuple[Row, ...]:
    """Return the rows of the table; the memory of the settings that all share is the paper's."""
    memory, attend = base.model.memory, _attend(base)
    sinusoid = dataclasses.replace(attend, positions="sinusoid", frame="world")
    voxel = _voxels(base)
    points, surfels = (
        _finer(memory, kind, attend, *scale)
        for kind, scale in ((PointsConfig, POINTS), (SurfelConfig, SURFELS))
    )
    snapshots = max(1, memory.tokens // PATCHES)
    nothing = as_kind(memory, NoMemoryConfig, reader=attend)
    return (
        Row("none", nothing, paper="NWM"),
        Row(CONTROL, nothing, control=True),
        Row(
            "images-attend",
            as_kind(memory, ImagesConfig, reader=attend, snapshots=snapshots),
            paper="Image Memory",
        ),
        Row("voxel-attend-without_depth", voxel, depth=False, paper="Ours (w/o depth)"),
        Row("map2d-attend", as_kind(memory, Map2DConfig, reader=attend), paper="Ours (2D map)"),
        Row(PAPER_FORM, dataclasses.replace(voxel, reader=sinusoid), paper="Ours"),
        Row("voxel-attend", voxel),
        Row("voxel-render", _rendered(base, voxel)),
        Row("points-attend", points),
        Row("points-render", _rendered(base, points)),
        Row("surfels-attend", surfels),
        Row("surfels-render", _rendered(base, surfels)),
    )


def as_kind(memory: Memory, kind: type[Memory], **changes: Any) -> Memory:
    """Return a memory of another kind with the settings that all kinds share."""
    shared = {field.name: getattr(memory, field.name) for field in dataclasses.fields(Memory)}
    return kind(**shared | changes)


def _finer(memory: Memory, kind: type[Memory], reader: Reader, scale: float, more: int) -> Memory:
    """Return a memory of coloured points with cubic cells and the same extent."""
    side = round(scale * min(memory.cell_m), 4)
    sizes = zip(memory.cell_m, memory.cells, strict=True)
    cells = tuple(math.ceil(size * count / side) for size, count in sizes)
    sizes = {"cell_m": (side, side, side), "cells": cells, "capacity": more * memory.capacity}
    return as_kind(memory, kind, reader=reader, **sizes)


def _attend(base: Config) -> AttentionConfig:
    reader = base.model.memory.reader
    if not isinstance(reader, AttentionConfig) or isinstance(reader, RenderConfig):
        raise UserError("the settings of Table 1 need memory.reader.kind attend to start from.")
    return reader


def _voxels(base: Config) -> Memory:
    """Return the paper's map, read by attention."""
    return as_kind(base.model.memory, VoxelConfig, reader=_attend(base))


def _rendered(base: Config, memory: Memory) -> Memory:
    """Return the memory read by rendering, with about as many parameters as attention has."""
    width = base.model.backbone.width

    def with_ratio(ratio: int) -> Memory:
        reader = RenderConfig(picture_width=width, mlp_ratio=ratio)
        return dataclasses.replace(memory, reader=reader)

    first, second = (parameters(base, with_ratio(ratio)) for ratio in (1, 2))
    missing = (parameters(base, memory) - first) / (second - first)  # it is linear in the ratio
    return with_ratio(max(1, 1 + round(missing)))


def parameters(base: Config, memory: Memory) -> int:
    """Return the number of parameters of a memory's reader, which stage 2 trains."""
    model = base.with_model(memory=memory).model
    shapes = jax.eval_shape(functools.partial(world_model.init, model), jax.random.key(0))
    return sum(leaf.size for leaf in jax.tree.leaves(shapes.get("memory", {})))


def _cell(base: Config, side: str) -> Memory:
    """Return the memory with another cell size on the ground and the same extent and height."""
    memory = _voxels(base)
    x, y, z = memory.cell_m
    scale = float(side) / x
    cells = (*(math.ceil(n / scale) for n in memory.cells[:2]), memory.cells[2])
    room = math.ceil(memory.capacity / min(1.0, scale) ** 2)
    if room > MOST_CELLS:
        raise UserError(
            f"cells of {side} m on the ground need a map of {room:,} cells, more than the limit of "
            f"{MOST_CELLS:,}: use a longer side."
        )
    return dataclasses.replace(memory, cell_m=(x * scale, y * scale, z), cells=cells, capacity=room)


def _extent(base: Config, side: str) -> Memory:
    """Return the memory with another extent on the ground, metres."""
    if not 0 < float(side) < math.inf:
        raise ValueError(side)
    memory = _voxels(base)
    x, y, _ = memory.cell_m
    cells = (math.ceil(float(side) / x), math.ceil(float(side) / y), memory.cells[2])
    return dataclasses.replace(memory, cells=cells)


def _tokens(base: Config, count: str) -> Memory:
    """Return the memory with another number of tokens that condition a clip."""
    memory = _voxels(base)
    if int(count) > MOST_CELLS:
        raise UserError(
            f"{count} tokens need a map of as many cells, more than the limit of {MOST_CELLS:,}: "
            "use fewer."
        )
    most = max(memory.capacity, int(count))
    return dataclasses.replace(memory, tokens=int(count), capacity=most)


def _features(base: Config, kind: str) -> Memory:
    """Return the memory with other features: patch colours, codec latents, DINOv2, or points."""
    memory = _voxels(base)
    if kind.startswith(NETWORK):
        network = dinov2.load(Path(kind.removeprefix(NETWORK)))[0]
        side = memory.encoder.grid(base.model.clip)[0] * network.patch  # as many patches as colours
        return dataclasses.replace(memory, encoder=DINOv2EncoderConfig(size=side, network=network))
    if kind == "points":
        return as_kind(memory, PointsConfig)
    if kind == "latents":
        codec = base.model.codec
        latents = LatentsConfig(channels=codec.rgb_channels, spatial=codec.spatial)
        return dataclasses.replace(memory, encoder=latents)
    if kind == "colours":
        return memory
    raise UserError(
        f"there are no features {kind!r}; choose colours, latents, points or {NETWORK}FOLDER."
    )


@dataclasses.dataclass(frozen=True)
class Ablation:
    """An ablation of a setting of the paper's map; ``about`` describes it, with its unit."""

    make: Callable[[Config, str], Memory]
    values: tuple[str, ...]
    about: str


ABLATIONS: Mapping[str, Ablation] = {
    "cell": Ablation(_cell, ("0.125", "0.25", "0.5", "1.0"), "side of a cell on the ground, m"),
    "extent": Ablation(_extent, ("4", "8", "16", "32"), "side of the map, m"),
    "tokens": Ablation(_tokens, ("96", "192", "384", "768"), "tokens that condition a clip"),
    "features": Ablation(_features, ("colours", "latents", "points"), "what a cell holds"),
    "time": Ablation(
        lambda base, _: next(row.memory for row in main_rows(base) if row.name == PAPER_FORM),
        ("1", "4"),
        "times the others' time",
    ),
}
"""The paper's ablations of the voxel map read by attention; ``time`` trains the paper's own form
(``PAPER_FORM``) longer, and a reader without input equally long."""


def ablated(base: Config, name: str, values: tuple[str, ...] = ()) -> tuple[Row, ...]:
    """Return the rows of an ablation; a row that is also in the table has the same name.

    Raises:
        UserError: there is no such ablation, or a value cannot be used.
    """
    if name not in ABLATIONS:
        raise UserError(f"there is no ablation {name!r}; choose from {', '.join(ABLATIONS)}.")
    ablation = ABLATIONS[name]
    plain = _voxels(base)
    found: list[Row] = []
    for value in values or ablation.values:
        try:
            memory = ablation.make(base, value)
            times = float(value) if name == "time" else 1.0
        except UserError:
            raise
        except (ValueError, ArithmeticError):
            times, memory = math.nan, plain
        if not (math.isfinite(times) and times > 0):
            raise UserError(f"the ablation {name} cannot take {value!r}: give {ablation.about}.")
        start = PAPER_FORM if name == "time" else "voxel-attend"
        own = times == 1 if name == "time" else memory == plain
        folder = value.removeprefix(NETWORK) if name == "features" and NETWORK in value else ""
        words = f"{NETWORK[:-1]}_{Path(folder).name}" if folder else value
        row_name = start if own else f"{start}-{name}_{words}"
        found.append(Row(row_name, memory, times=times, encoder=folder))
        if name == "time":  # the control: a reader without input, trained equally long
            row_name = CONTROL if own else f"{CONTROL}-{name}_{words}"
            nothing = as_kind(base.model.memory, NoMemoryConfig, reader=_attend(base))
            found.append(Row(row_name, nothing, times=times, control=True))
    return tuple(found)
