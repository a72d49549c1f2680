"""Control by actions, by default through the time embedding (EgoWM, arXiv 2601.15284).

Wherever the noise level modulates a network, frame i gets proj(e_t + e_a[i]), or, with the agent's
state, proj(e_t + e_s + e_a[i]) (Eqs. 5 and 6): no layer of the network changes. e_a[i] depends on
the actions that lead to the frames of latent frame i, and with convolutions on earlier actions,
never on later ones. Observed frames have none: actions before the last one count as 0. The last
layers are zero at first, so that a model trained without actions is unchanged.

Two other ways are there to compare with: further tokens that the network attends to, and further
input channels (``inject``). They use the same embedding, followed by one more layer.

The paper does not state the frequencies of its sinusoids: here they are geometric (``SLOWEST`` to
``FASTEST``) for numbers from −1 to 1.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from pewm_jax.bodies.humanoid import BODIES
from pewm_jax.bodies.kinematics import WALKING
from pewm_jax.codecs.pixel import fold
from pewm_jax.config.parts import Conditioner, Rules
from pewm_jax.controls import camera, skeleton
from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.models.interface import Conditioning
from pewm_jax.nn.layers import linear, sinusoid
from pewm_jax.types import Array, Control, Frames, Params

SLOWEST, FASTEST = math.pi / 4, 8 * math.pi
"""Radians of the slowest and the fastest sinusoid for a number of 1."""
TAPS = 3
"""Smallest kernel of a convolution, in actions."""
CHANNELS = 16
"""Input channels of the actions, with ``inject`` `channels`."""


@dataclasses.dataclass(frozen=True)
class ModulationConfig(Conditioner):
    """Control by actions, by default added to the time embedding of each latent frame (EgoWM).

    The defaults are the paper's for three numbers: metres forward and left in units of the data's
    waypoint spacing, and radians counter-clockwise (arXiv 2601.15284, Eqs. 5 and 6).
    """

    SHARDING: ClassVar[Rules] = (
        (r"control/.*/kernel", P(None, "fsdp")),
        (r"control/.*/bias", P()),
    )
    MODULATES: ClassVar[bool] = True

    actions: int = 3  # type: ignore[assignment]
    """Numbers of an action."""
    units: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Divisor of each number: the data's waypoint spacing in metres, twice, and 1."""
    low: tuple[float, ...] = (-2.5, -4.0, -1.0)
    """The value of each number, in its unit, that is mapped to −1."""
    high: tuple[float, ...] = (5.0, 4.0, 1.0)
    """The value of each number, in its unit, that is mapped to 1."""
    angles: tuple[int, ...] = (2,)
    """Indices of angles in radians, which are first wrapped into (−π, π]."""
    projection: Literal["sinusoid", "convolution"] = "sinusoid"
    """`sinusoid`: cosines and sines of each number, then two layers (the paper's on Stable Video
    Diffusion). `convolution`: two layers, then two convolutions over time, down to the latent rate
    (the paper's on Cosmos)."""
    features: int = 32
    """Cosines and sines of each number, with `sinusoid`; even."""
    state: int = 0  # type: ignore[assignment]
    """Numbers of the agent's state at the last observed frame, which is added to every frame (Eq.
    6): as many as those of an action, which is then the next state; 0 for none."""
    inject: Literal["timestep", "attention", "channels"] = "timestep"
    """How the embeddings reach the network. `timestep`: added to the time embedding of each latent
    frame, which modulates the layers (the paper). `attention`: as further tokens after those of the
    text, one per latent frame, where the backbone attends to any number of tokens. `channels`:
    repeated over height and width, as further input channels."""
    body: Literal["", "humanoid"] = ""  # type: ignore[assignment]
    """The body whose degrees of freedom the actions are (`data collect --body`): the viewer then
    has a slider for each of them. Empty: the actions are of no known body."""
    drawn: bool = False
    """Also concatenate drawings of the body's arms to the input, as its camera sees them at each
    frame (``controls.skeleton``); it needs `body` and `state`. Not part of the paper."""
    rays: bool = False
    """Also concatenate the cameras' Plücker rays to the input, as the control `camera` does."""
    rate: float = 10.0  # type: ignore[assignment]
    """Factor of the learning rate of these layers, which are new in a pre-trained model."""

    @property
    def sees_cameras(self) -> bool:
        """Whether rays are joined."""
        return self.rays

    @property
    def only_embeds(self) -> bool:
        """Whether neither rays nor drawings tell how the agent moves."""
        return not (self.rays or self.drawn)

    def channels(self, model: Any) -> int:
        """Return the channels of rays, actions and drawings, if they are joined."""
        codec = model.codec
        rays = 6 * codec.temporal if self.rays else 0
        groups = len(BODIES[self.body].bones) if self.drawn else 0
        drawings = groups * codec.temporal * codec.spatial**2
        return rays + CHANNELS * (self.inject == "channels") + drawings

    def check(self, model: Any) -> None:
        """Refuse a backbone that attends to no further tokens, if the actions are tokens."""
        super().check(model)
        require(
            self.inject != "attention" or bool(model.backbone.extra_tokens),
            "control.inject is attention, and this backbone attends to no further tokens: use "
            "control.inject timestep or channels, or another backbone.",
        )

    def __post_init__(self):
        """Validate."""
        require_positive(self, "control", "actions", "features", "rate")
        for name in ("units", "low", "high"):
            require(
                len(getattr(self, name)) == self.actions,
                f"control.{name} has {len(getattr(self, name))} values and control.actions is "
                f"{self.actions}: give one for each number of an action.",
            )
        require(
            all(a < b for a, b in zip(self.low, self.high, strict=True)),
            f"control.low {self.low} and control.high {self.high}: each low must be below its "
            "high.",
        )
        require(
            all(unit > 0 and math.isfinite(unit) for unit in self.units),
            f"control.units is {self.units}: use positive numbers, 1 where nothing is divided.",
        )
        require(
            all(0 <= index < self.actions for index in self.angles),
            f"control.angles is {self.angles}: name numbers of an action, from 0 to "
            f"{self.actions - 1}.",
        )
        require(
            self.features % 2 == 0,
            f"control.features is {self.features}: use an even number, cosines and sines.",
        )
        require(
            self.state in (0, self.actions),
            f"control.state is {self.state}: use 0 for none, or control.actions ({self.actions}).",
        )
        require(
            self.inject in ("timestep", "attention", "channels"),
            f"control.inject is {self.inject!r}: use timestep, attention or channels.",
        )
        require(
            self.body in ("", *BODIES),
            f"control.body is {self.body!r}: use {' or '.join(BODIES)}, or leave it empty.",
        )
        require(
            not self.drawn or bool(self.body and self.state),
            "control.drawn draws the arms of a known body from its states: set control.body and "
            "control.state, or control.drawn false.",
        )
        size = BODIES[self.body].size if self.body else self.actions
        require(
            self.actions == size,
            f"control.actions is {self.actions}, and the body {self.body} has {size} degrees of "
            "freedom: use that number.",
        )

    def still(self, action_A: Array) -> Array:
        """Return the action (..., A) of an agent that stands still after another action.

        Where actions are states, the joints stay, and a known body neither walks nor turns; other
        actions are zero.
        """
        if not (self.state or self.body):
            return super().still(action_A)
        walking = np.arange(self.actions) >= self.actions - len(WALKING) * bool(self.body)
        return jnp.where(walking, 0, action_A)

    def init(self, model: Any, key: Array) -> Params:
        """Return random parameters; the last layers are zero."""
        last = {"linear_2" if self.projection == "sinusoid" else "conv_2", "state_2"}
        last = last if self.inject == "timestep" else {"inject"}
        params: Params = {}
        for number, (name, shape) in enumerate(self.layout(model).items()):
            spread = 0.0 if name in last else 1 / math.sqrt(math.prod(shape[:-1]))
            kernel = spread * jax.random.normal(jax.random.fold_in(key, number), shape)
            params[name] = {"kernel": kernel, "bias": jnp.zeros(shape[-1:])}
        return params

    def condition(
        self, model: Any, params: Params, observed: Frames, control: Control
    ) -> Conditioning:
        """Return the actions in the form of ``inject``, and rays if ``rays`` is set.

        Raises:
            UserError: there are no actions, or no state although the settings need it.
        """
        if control.actions_TA is None:
            raise UserError(
                "this model's control (actions) is steered by actions, and got cameras alone: give "
                "actions, or a Control with both."
            )
        observed_frames = observed.depth_THW.shape[1]
        later = np.arange(control.actions_TA.shape[1]) >= observed_frames - 1
        actions = jnp.where(later[:, None], control.actions_TA, 0)
        led = jnp.pad(self.embed(model, params, actions), ((0, 0), (1, 0), (0, 0)))
        held = model.codec.frames(observed_frames)
        led = jnp.where((np.arange(led.shape[1]) >= held)[:, None], led, 0)
        if self.state:
            if control.state_A is None:
                raise UserError(
                    f"control.state is {self.state}, and no state of the agent was given: give a "
                    "Control with state_A, or use control.state 0."
                )
            state = self.normalise(control.state_A)
            if self.projection == "sinusoid":
                state = self._waves(state)
            state = linear(params["state_2"], jax.nn.silu(linear(params["state_1"], state)))
            led = led + state[:, None]
        parts = [camera.rays(model, control.camera)] if self.rays else []
        if self.inject == "channels":
            made = linear(params["inject"], jax.nn.silu(led))[:, :, None, None]
            parts.append(jnp.broadcast_to(made, (len(made), *model.latent_shape, made.shape[-1])))
        if self.drawn:
            parts.append(self._drawings(model, control, observed_frames))
        joined = jnp.concatenate(parts, -1) if parts else None
        if self.inject == "timestep":
            return Conditioning(joined_BthwC=joined, modulation_BtE=led)
        if self.inject == "attention":
            return Conditioning(joined_BthwC=joined, tokens_BLC=self._tokens(params, led))
        return Conditioning(joined_BthwC=joined)

    def _drawings(self, model: Any, control: Control, observed: int) -> Array:
        """Return the drawings of the arms at the latent rate.

        All observed frames have that of the last one, whose state is known.
        """
        state, actions = control.state_A, control.actions_TA
        assert state is not None
        assert actions is not None
        states = jnp.concatenate([state[:, None], actions], 1)
        states = jnp.where(
            (np.arange(states.shape[1]) >= observed)[:, None], states, state[:, None]
        )
        size, codec = model.clip, model.codec
        made = skeleton.draw_bones(
            BODIES[self.body], states, control.camera.intrinsics_4, size.height, size.width
        )
        return fold(made, codec.spatial, codec.temporal)

    def _tokens(self, params: Params, led_BtE: Array) -> Array:
        """Return a token for each latent frame, which contains the number of the frame."""
        number = sinusoid(jnp.arange(led_BtE.shape[1]), led_BtE.shape[2])
        return linear(params["inject"], jax.nn.silu(led_BtE + number))

    def embed(self, model: Any, params: Params, actions_BTA: Array) -> Array:
        """Return (B, t − 1, E) embeddings of the latent frames that (B, T − 1) actions lead to."""
        q = model.codec.temporal
        x = self.normalise(actions_BTA)
        if self.projection == "sinusoid":
            waves = self._waves(x)
            waves = waves.reshape(len(waves), -1, q * waves.shape[-1])
            return linear(params["linear_2"], jax.nn.silu(linear(params["linear_1"], waves)))
        x = linear(params["linear_2"], jax.nn.silu(linear(params["linear_1"], x)))
        for number, step in enumerate(strides(q), 1):
            x = _convolve(params[f"conv_{number}"], jax.nn.silu(x), step)
        return x

    def normalise(self, actions_A: Array) -> Array:
        """Scale actions (..., A) to about −1 … 1 by units, minimum and maximum; wrap angles."""
        x = jnp.asarray(actions_A, jnp.float32)
        angle = np.isin(np.arange(self.actions), self.angles)
        x = jnp.where(angle, math.pi - (math.pi - x) % (2 * math.pi), x)
        low, high, unit = (np.asarray(v, np.float32) for v in (self.low, self.high, self.units))
        return 2 * (x / unit - low) / (high - low) - 1

    def layout(self, model: Any) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the kernels by path; each has a bias."""
        width = model.backbone.time_dim
        kernels: dict[str, tuple[int, ...]]
        if self.projection == "sinusoid":
            inputs = self.actions * self.features
            kernels = {
                "linear_1": (model.codec.temporal * inputs, width),
                "linear_2": (width, width),
            }
            state = {"state_1": (inputs, width)}
        else:
            kernels = {"linear_1": (self.actions, width), "linear_2": (width, width)}
            for number, step in enumerate(strides(model.codec.temporal), 1):
                kernels[f"conv_{number}"] = (max(TAPS, step), width, width)
            state = {"state_1": (self.actions, width)}
        kernels |= {**state, "state_2": (width, width)} if self.state else {}
        if self.inject != "timestep":
            tokens = self.inject == "attention"
            kernels["inject"] = (width, model.backbone.text_shape[1] if tokens else CHANNELS)
        return kernels

    def _waves(self, x_A: Array) -> Array:
        """Return (..., A · features) cosines and sines of numbers."""
        rates = np.geomspace(SLOWEST, FASTEST, self.features // 2).astype(np.float32)
        angle = x_A[..., None] * rates
        return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1).reshape(*x_A.shape[:-1], -1)


def strides(temporal: int) -> tuple[int, int]:
    """Return the steps of the two convolutions, whose product is the codec's temporal factor."""
    second = max(k for k in range(1, math.isqrt(temporal) + 1) if temporal % k == 0)
    return temporal // second, second


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
