"""NoMaD: from pictures seen, and perhaps one of the goal, to waypoints and a distance.

Sridhar et al. 2023 (arXiv 2310.07896). One EfficientNet sees each picture of the past and the
present one, another sees the present one and the goal's together. A transformer mixes their tokens;
the goal's can be hidden, and then nothing depends on it. The mean of the tokens is the condition of
a denoiser of waypoints (``unet1d``) and of a head that says how many steps the goal is away.
Dropout and dropped blocks, which the original has in training, are left out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.config.nomad import NomadConfig
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.nomad import efficientnet, unet1d
from pewm_jax.nn.layers import layer_norm, linear, merge_heads, split_heads
from pewm_jax.nn.parameters import draw
from pewm_jax.types import Array, Params

WIDER = 4
"""Hidden width of the feed-forward layers, as a multiple of the tokens'."""
COLOURS = 3


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
    made |= {f"denoiser/{path}": shape for path, shape in unet1d.shapes(config).items()}
    for number, (inward, outward) in enumerate(((dim, dim // 4), (dim // 4, dim // 16))):
        add(f"distance_{number}", inward, outward)
    add("distance_2", dim // 16, 1)
    return made


def init(config: NomadConfig, key: Array) -> Params:
    """Return random parameters, float32."""
    return draw(shapes(config), key)


def preprocess(config: NomadConfig, rgb_BHWC: Array) -> Array:
    """Turn colours in [−1, 1] into what ``encode`` takes: resized, normalised as ImageNet's."""
    return dinov2.preprocess(rgb_BHWC, (config.height, config.width), 1)


def encode(
    config: NomadConfig,
    params: Params,
    observations_BTHWC: Array,
    goal_BHWC: Array,
    goal_masked_B: Array,
) -> Array:
    """Return the condition of a history and a goal.

    Args:
        config: the network.
        params: its parameters.
        observations_BTHWC: (B, context + 1, H, W, 3) floats from ``preprocess``, the present last;
            their dtype is the computation's.
        goal_BHWC: (B, H, W, 3) what is seen at the goal, anything where it is hidden.
        goal_masked_B: (B,) bool, True hides the goal.

    Returns:
        (B, dim).

    Raises:
        UserError: another number of pictures.
    """
    batch, count, *size = observations_BTHWC.shape
    if count != config.context + 1:
        raise UserError(
            f"encode() got {count} pictures: this policy sees {config.context} earlier ones and "
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
    """Predict the noise in normalised steps between waypoints, (B, N, 2); see ``unet1d.apply``."""
    return unet1d.apply(config, params["denoiser"], noisy_BN2, time_B, condition_BD)


def distance(config: NomadConfig, params: Params, condition_BD: Array) -> Array:
    """Return how many steps the goal is away, (B,)."""
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


def macs(config: NomadConfig) -> float:
    """Return the multiply-adds for one history, one goal and one denoising step."""
    size, tokens = (config.height, config.width), config.context + 2
    trunks = sum(
        count * efficientnet.macs(colours, *_size(config), *size)
        for count, colours in ((config.context + 1, COLOURS), (1, 2 * COLOURS))
    )
    mixing = config.layers * tokens * config.dim**2 * (4 + 2 * WIDER)
    return trunks + mixing + unet1d.macs(config)


def _size(config: NomadConfig) -> tuple[float, float, int]:
    return config.trunk_width, config.trunk_depth, config.trunk_stages


def _layer(config: NomadConfig, part: Params, x_BND: Array, shown_BN: Array) -> Array:
    """Attend to what is shown, then feed forward; both after a norm."""
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
