"""A U-Net over a short sequence of points, told the noise level and a condition.

``ConditionalUnet1D`` of Diffusion Policy (Chi et al. 2023, arXiv 2303.04137): residual blocks of
two convolutions, between which an embedding of noise level and condition is added (FiLM without
scales). Each resolution but the last halves the number of points.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.nomad import PLANE, NomadConfig
from pewm_jax.nn.layers import group_norm, linear
from pewm_jax.types import Array, Params

LAST_GROUPS = 8
"""Groups of the last norm, whatever ``groups`` says, as in the reference."""
LETTERS = ("NWC", "WIO", "NWC")


def shapes(config: NomadConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by path."""
    time, condition, side = config.time_dim, config.time_dim + config.dim, config.kernel
    made: dict[str, tuple[int, ...]] = {}

    def add(name: str, *kernel: int, norm: bool = False) -> None:
        made[f"{name}/kernel"], made[f"{name}/bias"] = kernel, kernel[-1:]
        if norm:
            made[f"{name}_norm/scale"] = made[f"{name}_norm/bias"] = kernel[-1:]

    def block(name: str, inward: int, outward: int) -> None:
        add(f"{name}/one", side, inward, outward, norm=True)
        add(f"{name}/two", side, outward, outward, norm=True)
        add(f"{name}/told", condition, outward)
        if inward != outward:
            add(f"{name}/past", 1, inward, outward)

    add("time_1", time, 4 * time)
    add("time_2", 4 * time, time)
    widths = (PLANE, *config.channels)
    for level, (inward, outward) in enumerate(itertools.pairwise(widths)):
        block(f"down_{level}/a", inward, outward)
        block(f"down_{level}/b", outward, outward)
        if level < len(config.channels) - 1:
            add(f"down_{level}/half", 3, outward, outward)
    block("middle/a", widths[-1], widths[-1])
    block("middle/b", widths[-1], widths[-1])
    for level in reversed(range(1, len(config.channels))):
        inward, outward = config.channels[level], config.channels[level - 1]
        block(f"up_{level}/a", 2 * inward, outward)
        block(f"up_{level}/b", outward, outward)
        add(f"up_{level}/twice", 4, outward, outward)
    add("last", side, widths[1], widths[1], norm=True)
    add("out", 1, widths[1], PLANE)
    return made


def apply(
    config: NomadConfig, params: Params, noisy_BN2: Array, time_B: Array, condition_BD: Array
) -> Array:
    """Predict the noise in noisy points.

    Args:
        config: its sizes.
        params: of ``shapes``.
        noisy_BN2: (B, N, 2) floats; N is a multiple of 2 to the number of halvings.
        time_B: (B,) noise levels, 0 for the least.
        condition_BD: (B, dim).

    Returns:
        (B, N, 2).
    """
    wave = _wave(time_B, config.time_dim).astype(noisy_BN2.dtype)
    time = linear(params["time_2"], mish(linear(params["time_1"], wave)))
    told = mish(jnp.concatenate([time, condition_BD.astype(time.dtype)], -1))

    def both(part: Params, x: Array) -> Array:
        return _block(config, part["b"], _block(config, part["a"], x, told), told)

    x, kept = noisy_BN2, []
    for level in range(len(config.channels)):
        part = params[f"down_{level}"]
        x = both(part, x)
        kept.append(x)
        if "half" in part:
            x = _convolved(part["half"], x, (1, 1), stride=2)
    x = both(params["middle"], x)
    for level in reversed(range(1, len(config.channels))):
        part = params[f"up_{level}"]
        x = both(part, jnp.concatenate([x, kept[level]], -1))
        x = _convolved(part["twice"], x, (2, 2), spread=2)
    x = _filtered(params, "last", x, LAST_GROUPS)
    return _convolved(params["out"], x, (0, 0))


def mish(x: Array) -> Array:
    """Return x · tanh(softplus(x)) (Misra 2019)."""
    return x * jnp.tanh(jax.nn.softplus(x))


def macs(config: NomadConfig) -> float:
    """Return the multiply-adds for one sequence."""
    total, points = 0.0, config.waypoints
    for path, shape in shapes(config).items():
        if path.endswith("/kernel"):
            level = path.removeprefix("down_").removeprefix("up_").split("/")[0]
            halved = int(level) if level.isdigit() else len(config.channels) - 1
            halved = 0 if path.startswith(("last", "out")) else halved
            total += float(np.prod(shape)) * (points >> halved if len(shape) == 3 else 1)
    return total


def _wave(time_B: Array, channels: int) -> Array:
    """Return sines, then cosines, of levels at frequencies from 1 down to 1/10000."""
    half = channels // 2
    rate = np.exp(-np.log(1e4) / (half - 1) * np.arange(half)).astype(np.float32)
    angle = time_B.astype(jnp.float32)[:, None] * rate
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def _block(config: NomadConfig, part: Params, x: Array, told_BD: Array) -> Array:
    inner = _filtered(part, "one", x, config.groups) + linear(part["told"], told_BD)[:, None]
    inner = _filtered(part, "two", inner, config.groups)
    return inner + (_convolved(part["past"], x, (0, 0)) if "past" in part else x)


def _filtered(part: Params, name: str, x: Array, groups: int) -> Array:
    """Convolve, normalise, apply mish."""
    around = part[name]["kernel"].shape[0] // 2
    x = _convolved(part[name], x, (around, around))
    return mish(group_norm(part[f"{name}_norm"], x, groups))


def _convolved(
    part: Params, x: Array, pad: tuple[int, int], *, stride: int = 1, spread: int = 1
) -> Array:
    """Convolve; ``spread`` puts so many points in the place of one, with zeros between."""
    x = jax.lax.conv_general_dilated(
        x, part["kernel"].astype(x.dtype), (stride,), (pad,), (spread,), None, LETTERS
    )
    return x + part["bias"].astype(x.dtype)
