"""Control by actions, added to the time embedding of each latent frame (EgoWM, arXiv 2601.15284).

Wherever the noise level modulates a network, frame i gets proj(e_t + e_a[i]), or, with the agent's
state, proj(e_t + e_s + e_a[i]) (Eqs. 5 and 6): no layer of the network changes. e_a[i] is made of
the actions that lead to the frames of latent frame i, and with convolutions of earlier ones, never
of later ones. Observed frames have none. The last layers are zero at first, so that a model that
was trained without actions gives what it gave.

The paper does not say which frequencies its sinusoids have: here they are geometric (``SLOWEST`` to
``FASTEST``) for numbers from −1 to 1.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from pewm_jax.config import ModelConfig, ModulationConfig, UserError
from pewm_jax.controls import camera as camera_control
from pewm_jax.models.interface import Conditioning
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.nn.layers import linear
from pewm_jax.types import Array, Control, Frames, Params

SHARDING = (
    (r"control/.*/kernel", P(None, "fsdp")),
    (r"control/.*/bias", P()),
)
SLOWEST, FASTEST = math.pi / 4, 8 * math.pi
"""Radians of the slowest and the fastest sinusoid for a number of 1."""
TAPS = 3
"""Actions that a convolution sees at least."""


def strides(temporal: int) -> tuple[int, int]:
    """Return the steps of the two convolutions, whose product is the codec's temporal factor."""
    second = max(k for k in range(1, math.isqrt(temporal) + 1) if temporal % k == 0)
    return temporal // second, second


def layout(model: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the kernels by path; each has a bias."""
    config, width = _settings(model), model.backbone.time_dim
    kernels: dict[str, tuple[int, ...]]
    if config.projection == "sinusoid":
        inputs = config.actions * config.features
        kernels = {"linear_1": (model.codec.temporal * inputs, width), "linear_2": (width, width)}
        state = {"state_1": (inputs, width)}
    else:
        kernels = {"linear_1": (config.actions, width), "linear_2": (width, width)}
        for number, step in enumerate(strides(model.codec.temporal), 1):
            kernels[f"conv_{number}"] = (max(TAPS, step), width, width)
        state = {"state_1": (config.actions, width)}
    return {**kernels, **({**state, "state_2": (width, width)} if config.state else {})}


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters; the last layers are zero."""
    config = _settings(model)
    last = {"linear_2" if config.projection == "sinusoid" else "conv_2", "state_2"}
    params: Params = {}
    for number, (name, shape) in enumerate(layout(model).items()):
        spread = 0.0 if name in last else 1 / math.sqrt(math.prod(shape[:-1]))
        kernel = spread * jax.random.normal(jax.random.fold_in(key, number), shape)
        params[name] = {"kernel": kernel, "bias": jnp.zeros(shape[-1:])}
    return params


def normalise(config: ModulationConfig, actions_A: Array) -> Array:
    """Bring actions (..., A) to about −1 … 1: angles wrapped, units divided out, min and max."""
    x = jnp.asarray(actions_A, jnp.float32)
    angle = np.isin(np.arange(config.actions), config.angles)
    x = jnp.where(angle, math.pi - (math.pi - x) % (2 * math.pi), x)
    low, high, unit = (np.asarray(v, np.float32) for v in (config.low, config.high, config.units))
    return 2 * (x / unit - low) / (high - low) - 1


def embed(model: ModelConfig, params: Params, actions_BTA: Array) -> Array:
    """Return (B, t − 1, E): the embeddings of the latent frames that (B, T − 1) actions lead to."""
    config, q = _settings(model), model.codec.temporal
    x = normalise(config, actions_BTA)
    if config.projection == "sinusoid":
        waves = _waves(config, x)
        waves = waves.reshape(len(waves), -1, q * waves.shape[-1])
        return linear(params["linear_2"], jax.nn.silu(linear(params["linear_1"], waves)))
    x = linear(params["linear_2"], jax.nn.silu(linear(params["linear_1"], x)))
    for number, step in enumerate(strides(q), 1):
        x = _convolve(params[f"conv_{number}"], jax.nn.silu(x), step)
    return x


def condition(
    model: ModelConfig, params: Params, observed: Frames, control: Control
) -> Conditioning:
    """Return the actions as modulation, and rays if asked for; see ``controls.condition``.

    Raises:
        UserError: there are no actions, or no state and the settings ask for it.
    """
    config = _settings(model)
    if control.actions_TA is None:
        raise UserError(
            "this model's control (actions) is steered by actions, and got cameras alone: give "
            "actions, or a Control with both."
        )
    led = jnp.pad(embed(model, params, control.actions_TA), ((0, 0), (1, 0), (0, 0)))
    held = model.codec.frames(observed.depth_THW.shape[1])
    led = jnp.where((np.arange(led.shape[1]) >= held)[:, None], led, 0)
    if config.state:
        if control.state_A is None:
            raise UserError(
                f"control.state is {config.state}, and no state of the agent was given: give a "
                "Control with state_A, or use control.state 0."
            )
        state = normalise(config, control.state_A)
        if config.projection == "sinusoid":
            state = _waves(config, state)
        state = linear(params["state_2"], jax.nn.silu(linear(params["state_1"], state)))
        led = led + state[:, None]
    rays = camera_control.rays(model, control.camera) if config.rays else None
    return Conditioning(joined_BthwC=rays, modulation_BtE=led)


def costs(model: ModelConfig, share: Share, *, trained: bool) -> Costs:
    """Return the costs: each kernel, times what it is applied to."""
    del share
    config, clip = _settings(model), model.clip
    actions, latents = clip.frames - 1, model.latent_shape[0] - 1
    first, _ = strides(model.codec.temporal)
    times = {"conv_1": actions // first, "conv_2": latents, "state_1": 1, "state_2": 1}
    whole = latents if config.projection == "sinusoid" else actions
    work = {False: 0.0, True: 0.0}  # of layers whose input is data, and of the others
    for name, shape in layout(model).items():
        work[name not in ("linear_1", "state_1")] += math.prod(shape) * times.get(name, whole)
    return Costs(
        tuple(
            Product("control", "linear", macs, (1.0 + inside) * trained)
            for inside, macs in work.items()
        )
    )


def _waves(config: ModulationConfig, x_A: Array) -> Array:
    """Return (..., A · features) cosines and sines of numbers."""
    rates = np.geomspace(SLOWEST, FASTEST, config.features // 2).astype(np.float32)
    angle = x_A[..., None] * rates
    return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1).reshape(*x_A.shape[:-1], -1)


def _convolve(params: Params, x_BTE: Array, step: int) -> Array:
    """Convolve over time in steps, each output seeing its own actions and earlier ones."""
    kernel = params["kernel"].astype(x_BTE.dtype)
    out = jax.lax.conv_general_dilated(
        x_BTE,
        kernel,
        (step,),
        ((len(kernel) - step, 0),),
        dimension_numbers=("NWC", "WIO", "NWC"),
    )
    return out + params["bias"].astype(x_BTE.dtype)


def _settings(model: ModelConfig) -> ModulationConfig:
    assert isinstance(model.control, ModulationConfig)
    return model.control
