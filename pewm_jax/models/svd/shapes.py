"""The parameters of Stable Video Diffusion's U-Net: path and shape of every leaf.

Initialisation and the import of published weights both use this list. A 2D convolution is
``kernel (3, 3, in, out)`` and ``bias``, a convolution in time ``kernel (3, in, out)`` and ``bias``,
a linear layer ``kernel (in, out)`` and mostly ``bias``, a norm ``scale`` and ``bias``; ``mix`` is
one number, the logit of how much of the spatial branch is kept.
"""

from __future__ import annotations

from collections.abc import Iterator

from pewm_jax.config import SVDUNetConfig

Leaf = tuple[str, tuple[int, ...]]


def unet(config: SVDUNetConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the U-Net's parameters."""
    return dict(_unet(config))


def conv(where: str, kernel: tuple[int, ...], inside: int, outside: int) -> Iterator[Leaf]:
    """Yield a convolution, or with an empty kernel a linear layer."""
    yield f"{where}/kernel", (*kernel, inside, outside)
    yield f"{where}/bias", (outside,)


def norm(where: str, width: int) -> Iterator[Leaf]:
    """Yield the scale and bias of a norm."""
    yield f"{where}/scale", (width,)
    yield f"{where}/bias", (width,)


def resnet_2d(where: str, inside: int, outside: int, time: int = 0) -> Iterator[Leaf]:
    """Yield a residual block of single frames; ``time`` channels of the time embedding."""
    yield from norm(f"{where}/norm1", inside)
    yield from conv(f"{where}/conv1", (3, 3), inside, outside)
    if time:
        yield from conv(f"{where}/time", (), time, outside)
    yield from norm(f"{where}/norm2", outside)
    yield from conv(f"{where}/conv2", (3, 3), outside, outside)
    if inside != outside:
        yield from conv(f"{where}/shortcut", (), inside, outside)


def resnet(where: str, inside: int, outside: int, time: int = 0) -> Iterator[Leaf]:
    """Yield a residual block over space, one over time, and how they are mixed."""
    yield from resnet_2d(f"{where}/spatial", inside, outside, time)
    there = f"{where}/temporal"
    for k in "12":
        yield from norm(f"{there}/norm{k}", outside)
        yield from conv(f"{there}/conv{k}", (3,), outside, outside)
    if time:
        yield from conv(f"{there}/time", (), time, outside)
    yield f"{where}/mix", (1,)


def _unet(config: SVDUNetConfig) -> Iterator[Leaf]:
    widths, time = config.widths, config.time_dim
    last = len(widths) - 1
    yield from conv("conv_in", (3, 3), config.in_channels, widths[0])
    yield from _embedding("time_embed", widths[0], time, time)
    yield from _embedding("added_embed", config.added * config.added_dim, time, time)
    skips = [widths[0]]
    inside = widths[0]
    for level, width in enumerate(widths):
        where = f"down_{level}"
        for k in range(config.resnets[level]):
            yield from resnet(f"{where}/resnet_{k}", inside, width, time)
            if config.attends[level]:
                yield from _attend(config, f"{where}/attend_{k}", level)
            inside = width
            skips.append(width)
        if level < last:
            yield from conv(f"{where}/resample", (3, 3), width, width)
            skips.append(width)
    yield from resnet("mid/resnet_0", inside, inside, time)
    yield from _attend(config, "mid/attend_0", last)
    yield from resnet("mid/resnet_1", inside, inside, time)
    for step, level in enumerate(reversed(range(len(widths)))):
        where, width = f"up_{step}", widths[level]
        for k in range(config.resnets[level] + 1):
            yield from resnet(f"{where}/resnet_{k}", inside + skips.pop(), width, time)
            if config.attends[level]:
                yield from _attend(config, f"{where}/attend_{k}", level)
            inside = width
        if level:
            yield from conv(f"{where}/resample", (3, 3), width, width)
    yield from norm("norm_out", inside)
    yield from conv("conv_out", (3, 3), inside, config.out_channels)


def _embedding(where: str, inside: int, hidden: int, outside: int) -> Iterator[Leaf]:
    yield from conv(f"{where}/linear_1", (), inside, hidden)
    yield from conv(f"{where}/linear_2", (), hidden, outside)


def _attend(config: SVDUNetConfig, where: str, level: int) -> Iterator[Leaf]:
    width = config.widths[level]
    yield from norm(f"{where}/norm", width)
    yield from conv(f"{where}/proj_in", (), width, width)
    yield from _embedding(f"{where}/frame_embed", width, 4 * width, width)
    for k in range(config.layers[level]):
        for branch in ("spatial", "temporal"):
            there = f"{where}/{branch}_{k}"
            if branch == "temporal":
                yield from norm(f"{there}/norm_in", width)
                yield from _feed_forward(f"{there}/ff_in", width)
            for n, dim in ((1, width), (2, config.image_dim)):
                yield from norm(f"{there}/norm{n}", width)
                yield f"{there}/attn{n}/to_q/kernel", (width, width)
                yield f"{there}/attn{n}/to_k/kernel", (dim, width)
                yield f"{there}/attn{n}/to_v/kernel", (dim, width)
                yield from conv(f"{there}/attn{n}/to_out", (), width, width)
            yield from norm(f"{there}/norm3", width)
            yield from _feed_forward(f"{there}/ff", width)
    yield f"{where}/mix", (1,)
    yield from conv(f"{where}/proj_out", (), width, width)


def _feed_forward(where: str, width: int) -> Iterator[Leaf]:
    yield from conv(f"{where}/up", (), width, 8 * width)
    yield from conv(f"{where}/down", (), 4 * width, width)
