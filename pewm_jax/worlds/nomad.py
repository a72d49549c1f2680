"""The task that trains the policy NoMaD, by imitation of recorded walks.

A clip has the earlier pictures, the present one and those of as many later steps as a goal may be
away. From it are taken the waypoints, the places after the next steps, and the goal: the picture
some steps on, or, once in as many times, one from another clip of the batch, which counts as
farthest away and whose way is not learned (Sridhar et al. 2023, as in ``visualnav-transformer``).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import (
    NomadTrainConfig,
    NomadWorldConfig,
    TrainSettings,
)
from pewm_jax.diffusion import squared_cosine
from pewm_jax.geometry import actions, cameras
from pewm_jax.models.nomad import model as nomad
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.stages import TRAIN, Stage

SMALL = 1e-2
"""Added to the shares by which losses are divided, as in the reference."""


def init(model: NomadWorldConfig, key: Array) -> Params:
    """Return random parameters, under ``policy``."""
    return {"policy": nomad.init(model.policy, key)}


def waypoints(model: NomadWorldConfig, clip: Clip) -> Array:
    """Return (B, N, 2): the places after the next N steps, metres forward and left of here."""
    now, count = model.policy.context, model.policy.waypoints
    pose = jnp.asarray(clip.frames.camera.world_from_camera)
    here = pose[:, now]
    away = pose[:, now + 1 : now + 1 + count, :3, 3] - here[:, None, :3, 3]
    turned = cameras.einsum("bji,bnj->bni", actions.rotation_z(actions.heading(here)), away)
    return turned[..., :2]


def imitate(
    model: NomadWorldConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the loss: the squared error of the noise, and, weighing little, of the distance.

    The noise counts where the goal is of the same walk, farther than ``train.nearest`` and nearer
    than the farthest; the distance where the goal is not hidden. (The reference averages the error
    of the distance over hidden goals too.)

    Returns:
        ``(loss, measured)``: ``noise``, the mean squared error, and ``steps_off``, the root mean
        square error of the distance.
    """
    assert isinstance(train, NomadTrainConfig)
    policy, weights = model.policy, params["policy"]
    rgb = as_signal(clip.frames).rgb_THWC
    batch, now, farthest = len(rgb), model.policy.context, model.farthest
    keys = jax.random.split(key, 5)
    far = jax.random.randint(keys[0], (batch,), 0, farthest + 1)  # 0: of another clip
    any_frame = jax.random.randint(keys[1], (batch,), 0, rgb.shape[1])
    other = far == 0
    picked = _frame(rgb, jnp.where(other, any_frame, now + far))
    negative_goal = jnp.roll(_frame(rgb, any_frame), 1, 0)
    goal = jnp.where(other[:, None, None, None], negative_goal, picked)
    steps = jnp.where(other, farthest, far).astype(jnp.float32)
    hidden = jax.random.bernoulli(keys[2], train.goal_hidden, (batch,))

    seen = rgb[:, : now + 1]
    seen = nomad.preprocess(policy, seen.reshape(-1, *seen.shape[2:])).astype(model.dtype)
    seen = seen.reshape(batch, now + 1, *seen.shape[1:])
    goal = nomad.preprocess(policy, goal).astype(model.dtype)
    condition = nomad.encode(policy, weights, seen, goal, hidden)

    clean = nomad.normalise(policy, waypoints(model, clip))
    noise = jax.random.normal(keys[3], clean.shape)
    time = jax.random.randint(keys[4], (batch,), 0, policy.noise_steps)
    noisy = squared_cosine.corrupt(policy.noise_steps, clean, noise, time)
    made = nomad.denoise(policy, weights, noisy.astype(model.dtype), time, condition)
    follows = (~other & (far > train.nearest) & (far < farthest)).astype(jnp.float32)
    error = jnp.square(made.astype(jnp.float32) - noise).mean((1, 2))
    error = (error * follows).mean() / (follows.mean() + SMALL)

    shown = 1 - hidden.astype(jnp.float32)
    off = nomad.distance(policy, weights, condition).astype(jnp.float32) - steps
    off = (jnp.square(off) * shown).mean() / (shown.mean() + SMALL)
    share = train.distance_weight
    return (1 - share) * error + share * off, {"noise": error, "steps_off": jnp.sqrt(off)}


def _frame(rgb_BTHWC: Array, number_B: Array) -> Array:
    """Return one frame of each clip."""
    return jnp.take_along_axis(rgb_BTHWC, number_B[:, None, None, None, None], 1)[:, 0]


STAGES = (Stage("policy", 1, ((r"policy/.*", TRAIN),), init, imitate),)


def stages(model: NomadWorldConfig) -> tuple[Stage, ...]:
    """Return the one stage."""
    del model
    return STAGES
