"""NoMaD: from observed images, and optionally a goal image, to waypoints and a distance.

Sridhar et al. 2023 (arXiv 2310.07896). One EfficientNet encodes each earlier image and the present
one, another encodes the present image together with the goal's. A transformer mixes their tokens;
the goal's token can be masked, and then nothing depends on it. The mean of the tokens conditions a
denoiser of waypoints and a head that predicts how many steps away the goal is. Dropout and dropped
blocks, which the original has in training, are left out.

The denoiser is ``ConditionalUnet1D`` of Diffusion Policy (Chi et al. 2023, arXiv 2303.04137), a
U-Net over a short sequence of points: residual blocks of two convolutions, between which an
embedding of noise level and condition is added (FiLM without scales). Each resolution but the last
halves the number of points.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.nomad import efficientnet
from pewm_jax.models.nomad.config import PLANE, NomadConfig
from pewm_jax.nn.layers import group_norm, layer_norm, linear, merge_heads, split_heads
from pewm_jax.nn.parameters import draw
from pewm_jax.types import Array, Params

WIDER = 4
"""Hidden width of the feed-forward layers, as a multiple of the tokens'."""
COLOURS = 3
LAST_GROUPS = 8
"""Groups of the denoiser's last norm, independent of ``groups``, as in the reference."""
SEQUENCE = ("NWC", "WIO", "NWC")


def shapes(config: NomadConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by path."""
    dim = config.dim
    made: dict[str, tuple[int, ...]] = {}

    def add(name: str, *kernel: int) -> None:
        made[f"{name}/kernel"], made[f"{name}/bias"] = kernel, kernel[-1:]

    for name, colours in (("observed", COLOURS), ("goal", 2 * COLOURS)):
        trunk = efficientnet.shapes(colours, *_size(config))
        made |= {f"{name}/{path}": shape for path, shape in trunk.items()}
        add(f"{name}_token", efficientnet.features(config.trunk_width), dim)
    for number in range(config.layers):
        layer = f"layer_{number}"
        for norm in ("norm_1", "norm_2"):
            made[f"{layer}/{norm}/scale"] = made[f"{layer}/{norm}/bias"] = (dim,)
        add(f"{layer}/to_qkv", dim, 3 * dim)
        add(f"{layer}/to_out", dim, dim)
        add(f"{layer}/up", dim, WIDER * dim)
        add(f"{layer}/down", WIDER * dim, dim)
    made |= {f"denoiser/{path}": shape for path, shape in denoiser_shapes(config).items()}
    for number, (inward, outward) in enumerate(((dim, dim // 4), (dim // 4, dim // 16))):
        add(f"distance_{number}", inward, outward)
    add("distance_2", dim // 16, 1)
    return made


def denoiser_shapes(config: NomadConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter of the denoiser by path."""
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


def init(config: NomadConfig, key: Array) -> Params:
    """Return random parameters, float32."""
    return draw(shapes(config), key)


def preprocess(config: NomadConfig, rgb_BHWC: Array) -> Array:
    """Turn colours in [−1, 1] into the input of ``encode``: resized, normalised as ImageNet's."""
    return dinov2.preprocess(rgb_BHWC, (config.height, config.width), 1)


def encode(
    config: NomadConfig,
    params: Params,
    observations_BTHWC: Array,
    goal_BHWC: Array,
    goal_masked_B: Array,
) -> Array:
    """Return the condition (B, dim) of a history and a goal.

    The pictures are from ``preprocess``: context + 1 observations, the present last, whose dtype is
    the computation's, and the goal, of any values where ``goal_masked_B`` hides it.

    Raises:
        UserError: another number of pictures.
    """
    batch, count, *size = observations_BTHWC.shape
    if count != config.context + 1:
        raise UserError(
            f"encode() got {count} pictures: this policy takes {config.context} earlier ones and "
            f"the present one, give {config.context + 1}."
        )
    seen = efficientnet.apply(
        *_size(config), params["observed"], observations_BTHWC.reshape(-1, *size)
    )
    seen = linear(params["observed_token"], seen).reshape(batch, count, -1)
    both = jnp.concatenate([observations_BTHWC[:, -1], goal_BHWC.astype(seen.dtype)], -1)
    goal = efficientnet.apply(*_size(config), params["goal"], both)
    goal = linear(params["goal_token"], goal)[:, None]
    tokens = jnp.concatenate([seen, goal], 1) + _positions(count + 1, config.dim, seen.dtype)
    hidden = jnp.asarray(goal_masked_B, bool)[:, None] & (jnp.arange(count + 1) == count)
    for number in range(config.layers):
        tokens = _layer(config, params[f"layer_{number}"], tokens, ~hidden)
    shown = (~hidden)[..., None]
    return jnp.where(shown, tokens, 0).sum(1) / shown.sum(1).astype(tokens.dtype)


def denoise(
    config: NomadConfig, params: Params, noisy_BN2: Array, time_B: Array, condition_BD: Array
) -> Array:
    """Predict the noise in normalised steps between waypoints.

    N is a multiple of 2 to the number of halvings; a noise level of 0 is the least.
    """
    params = params["denoiser"]
    wave = _wave(time_B, config.time_dim).astype(noisy_BN2.dtype)
    time = linear(params["time_2"], mish(linear(params["time_1"], wave)))
    condition = mish(jnp.concatenate([time, condition_BD.astype(time.dtype)], -1))

    def both(part: Params, x: Array) -> Array:
        return _block(config, part["b"], _block(config, part["a"], x, condition), condition)

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


def distance(config: NomadConfig, params: Params, condition_BD: Array) -> Array:
    """Return the number of steps to the goal, (B,)."""
    del config
    x = condition_BD
    for number in range(2):
        x = jax.nn.relu(linear(params[f"distance_{number}"], x))
    return linear(params["distance_2"], x)[..., 0]


def normalise(config: NomadConfig, waypoints_BN2: Array) -> Array:
    """Turn waypoints in metres into the steps between them, [−1, 1] from lowest to highest."""
    scaled = jnp.asarray(waypoints_BN2) / config.spacing_m
    steps = jnp.diff(scaled, axis=-2, prepend=jnp.zeros_like(scaled[..., :1, :]))
    low, high = (np.asarray(end, np.float32) for end in (config.lowest, config.highest))
    return 2 * (steps - low) / (high - low) - 1


def waypoints(config: NomadConfig, steps_BN2: Array) -> Array:
    """Turn normalised steps into waypoints in metres; the inverse of ``normalise``."""
    low, high = (np.asarray(end, np.float32) for end in (config.lowest, config.highest))
    steps = (jnp.asarray(steps_BN2) + 1) / 2 * (high - low) + low
    return jnp.cumsum(steps, -2) * config.spacing_m


def _size(config: NomadConfig) -> tuple[float, float, int]:
    return config.trunk_width, config.trunk_depth, config.trunk_stages


def _layer(config: NomadConfig, part: Params, x_BND: Array, shown_BN: Array) -> Array:
    """Attend to the unmasked tokens, then feed forward; both after a norm."""
    qkv = linear(part["to_qkv"], layer_norm(part["norm_1"], x_BND))
    q, k, v = (split_heads(each, config.heads) for each in jnp.split(qkv, 3, -1))
    logits = jnp.einsum("bknd,bkmd->bknm", q, k, preferred_element_type=jnp.float32)
    logits = jnp.where(shown_BN[:, None, None], logits / np.sqrt(q.shape[-1]), -jnp.inf)
    mixed = jnp.einsum("bknm,bkmd->bknd", jax.nn.softmax(logits, -1).astype(v.dtype), v)
    x = x_BND + linear(part["to_out"], merge_heads(mixed))
    inner = jax.nn.gelu(linear(part["up"], layer_norm(part["norm_2"], x)), approximate=False)
    return x + linear(part["down"], inner)


def _positions(count: int, dim: int, dtype: jnp.dtype) -> Array:
    """Return (count, dim): sines and cosines in turn (Vaswani et al. 2017)."""
    rate = np.exp(np.arange(0, dim, 2) * (-np.log(1e4) / dim))
    angle = np.arange(count)[:, None] * rate
    return jnp.asarray(np.stack([np.sin(angle), np.cos(angle)], -1).reshape(count, dim), dtype)


def mish(x: Array) -> Array:
    """Return x · tanh(softplus(x)) (Misra 2019)."""
    return x * jnp.tanh(jax.nn.softplus(x))


def _wave(time_B: Array, channels: int) -> Array:
    """Return sines, then cosines, of levels at frequencies from 1 down to 1/10000."""
    half = channels // 2
    rate = np.exp(-np.log(1e4) / (half - 1) * np.arange(half)).astype(np.float32)
    angle = time_B.astype(jnp.float32)[:, None] * rate
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def _block(config: NomadConfig, part: Params, x: Array, condition_BD: Array) -> Array:
    inner = _filtered(part, "one", x, config.groups) + linear(part["told"], condition_BD)[:, None]
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
    """Convolve; ``spread`` dilates the input: so many points per point, with zeros between."""
    x = jax.lax.conv_general_dilated(
        x, part["kernel"].astype(x.dtype), (stride,), (pad,), (spread,), None, SEQUENCE
    )
    return x + part["bias"].astype(x.dtype)
