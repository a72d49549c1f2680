"""Adam or Muon with warm-up, clipping and decoupled weight decay, masked to the trained parameters.

``optax.partition`` routes every leaf by the stage's labels: to the optimizer, including the
clipping, or to zero. So frozen leaves have no moments and their gradients do not enter the clipped
norm. (``optax.masked`` alone would pass raw gradients through to them.)
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array
from optax.contrib import MuonDimensionNumbers, scale_by_muon

from pewm_jax.config import Config, StageConfig
from pewm_jax.io import tree
from pewm_jax.nn import placement, target
from pewm_jax.nn.deferred import STACKED
from pewm_jax.types import Params
from pewm_jax.worlds.stages import ADVERSARY, FREEZE, TRAIN, Stage

DECAYED = (
    (r"(.*/)?kernel(/[ab])?", True),
    (r".*", False),
)
"""Leaves with weight decay: matrices and their adapters, but not biases, scales, gates or
embeddings."""


def schedule(settings: StageConfig) -> optax.Schedule:
    """Return the learning rate as a function of the number of steps done (0 at the first).

    The warm-up is linear: already above zero at the first step, at the peak after ``warmup`` steps.
    Then the rate is constant, or a half cosine that would reach zero one step after the last.
    """
    warmup = optax.linear_schedule(
        settings.learning_rate / (settings.warmup + 1), settings.learning_rate, settings.warmup
    )
    if settings.decay == "constant":
        rest = optax.constant_schedule(settings.learning_rate)
    else:
        rest = optax.cosine_decay_schedule(
            settings.learning_rate, max(settings.steps - settings.warmup, 1)
        )
    return optax.join_schedules([warmup, rest], [settings.warmup])


def rate(settings: StageConfig, opt_state: optax.OptState) -> Array:
    """Return the learning rate of the next update; skipped updates are not counted."""
    chains = getattr(opt_state, "inner_states", {TRAIN: opt_state})
    counted = optax.tree_utils.tree_get(chains[TRAIN], "ScaleByScheduleState")
    return jnp.asarray(schedule(settings)(counted.count))


def make(config: Config, stage: Stage) -> optax.GradientTransformation:
    """Build the optimizer of a stage.

    ``init`` and ``update`` take all of the stage's parameters; the updates of frozen leaves are 0.
    """

    def decayed(trained: Params) -> Params:
        return tree.assign(DECAYED, trained, "weight-decay mask")

    settings = stage.settings(config)
    chosen = settings.optimizer or config.train.optimizer
    adam = optax.scale_by_adam(config.train.beta1, config.train.beta2, config.train.epsilon)
    trains = optax.chain(
        optax.clip_by_global_norm(config.train.clip_norm),
        muon(adam) if chosen == "muon" else adam,
        optax.add_decayed_weights(config.train.weight_decay, mask=decayed),
        optax.scale_by_learning_rate(schedule(settings)),
        *([_rates(stage)] if stage.rates else []),
    )
    chains: dict[Any, Any] = {TRAIN: trains, FREEZE: optax.set_to_zero()}
    if stage.training_only:
        chains[ADVERSARY] = adversary(config, settings)
    return optax.partition(chains, stage.labels)


ADVERSARY_BETAS = (0.5, 0.9)
"""Adam's decays for a discriminator, as in latent diffusion."""


def adversary(config: Config, settings: StageConfig) -> optax.GradientTransformation:
    """Return the optimizer of a discriminator: Adam with the stage's schedule, but no warm-up.

    Its gradients are clipped apart from those of the other parameters, so that neither of the two
    scales the other's steps.
    """
    at_once = schedule(dataclasses.replace(settings, warmup=0))
    return optax.chain(
        optax.clip_by_global_norm(config.train.clip_norm),
        optax.scale_by_adam(*ADVERSARY_BETAS),
        optax.scale_by_learning_rate(at_once),
    )


MATRICES = (
    (
        r"(.*/)?(embed|patch_embed|text_embed|proj_out|modulate_out|into|out|direct)[^/]*/kernel",
        False,
    ),
    (r"memory/(tokens|camera)/kernel", False),
    (r"(.*/)?kernel", True),
    (r".*", False),
)
"""Leaves that Muon updates: matrices of hidden layers, but not the first and last layers."""
MUON_RMS = 0.2
"""Root mean square of Muon's updates, matched to Adam's typical value, so that both can use one
learning rate (Liu et al. 2025, "Muon is scalable for LLM training", Eq. 4)."""


QUINTIC = (3.4445, -4.7750, 2.0315)
"""Coefficients of a Newton–Schulz step (Jordan 2024), as in ``optax``."""
STEPS = 5
GROUPS = (3, 2)
"""How the steps are grouped in ``orthogonalize`` for matrices at least twice as long as wide."""


def muon(adam: optax.GradientTransformation) -> optax.GradientTransformation:
    """Return Muon for the matrices of hidden layers, and ``adam`` for all other leaves.

    Muon steps along the nearest orthogonal matrix to the momentum (Jordan 2024; ``optax.contrib``).
    A convolution is treated as a matrix from all its inputs to its outputs; stacked layers are
    orthogonalized separately. On one CPU ``orthogonalize`` does so, with fewer products.
    """

    def names(trained: Params) -> Params:
        matrices = tree.assign(MATRICES, trained, "Muon's matrices")
        return jax.tree.map(lambda is_matrix: "muon" if is_matrix else "adam", matrices)

    grouped = target.current().platform == "cpu" and not placement.is_split()

    def sized(updates: Any, params: Any = None) -> Any:
        del params
        if grouped:  # so far divided by their norms only
            updates = jax.tree_util.tree_map_with_path(_orthogonal, updates)
        return jax.tree_util.tree_map_with_path(_scale_update, updates)

    momentum = scale_by_muon(
        ns_coeffs=QUINTIC, ns_steps=0 if grouped else STEPS, weight_dimension_numbers=_axes
    )
    hidden = optax.chain(momentum, optax.stateless(sized))
    return optax.partition({"muon": hidden, "adam": adam}, names)


def orthogonalize(x_LMN: Array, groups: tuple[int, ...]) -> Array:
    """Orthogonalize matrices, M ≤ N, of norm 1 by Newton–Schulz steps in groups.

    A step is X ← P(A) X with A = X Xᵀ and P(A) = a + b·A + c·A². The polynomials of a group of
    steps commute, and A ← P(A) A P(A) is known without X. So X is multiplied once in a group,
    instead of in every step, and the other products are of M × M matrices. Groups of more than
    three steps would lose accuracy in small singular values.
    """
    first, second, third = QUINTIC
    for steps in groups:
        gram_LMM = x_LMN @ x_LMN.mT
        factor_LMM = None
        for step in range(steps):
            rest_LMM = second * gram_LMM + third * (gram_LMM @ gram_LMM)
            if steps == 1:
                x_LMN = first * x_LMN + rest_LMM @ x_LMN
                break
            whole_LMM = rest_LMM + first * jnp.eye(x_LMN.shape[-2], dtype=x_LMN.dtype)
            factor_LMM = whole_LMM if factor_LMM is None else whole_LMM @ factor_LMM
            if step + 1 < steps:
                half_LMM = first * gram_LMM + rest_LMM @ gram_LMM
                gram_LMM = first * half_LMM + half_LMM @ rest_LMM
        if factor_LMM is not None:
            x_LMN = factor_LMM @ x_LMN
    return x_LMN


def _orthogonal(path: Any, x: Array) -> Array:
    """Orthogonalize one leaf, whose matrices have norm 1."""
    inputs = math.prod(x.shape[_first_matrix_axis(path) : -1])
    matrices = x.reshape(-1, inputs, x.shape[-1])
    few, many = sorted(matrices.shape[1:])
    groups = GROUPS if many >= 2 * few else (1,) * STEPS
    wide = matrices if inputs == few else matrices.mT
    found = orthogonalize(wide, groups)
    return (found if inputs == few else found.mT).reshape(x.shape)


def _axes(updates: Any) -> Any:
    """Return which axes of each matrix are inputs and which outputs."""

    def of(path: Any, leaf: Array) -> MuonDimensionNumbers:
        return MuonDimensionNumbers(
            tuple(range(_first_matrix_axis(path), leaf.ndim - 1)), leaf.ndim - 1
        )

    return jax.tree_util.tree_map_with_path(of, updates)


def _scale_update(path: Any, update: Array) -> Array:
    """Scale an orthogonal update to the RMS of Adam's."""
    inputs = math.prod(update.shape[_first_matrix_axis(path) : -1])
    return MUON_RMS * math.sqrt(max(inputs, update.shape[-1])) * update


def _first_matrix_axis(path: Any) -> int:
    """Return the first matrix axis of the leaf at this path: 1 if layers are stacked."""
    return int(any(getattr(key, "key", None) == STACKED for key in path))


def _rates(stage: Stage) -> optax.GradientTransformation:
    """Multiply updates by the stage's learning-rate factors."""
    rules = (*stage.rates, (r".*", 1.0))

    def scaled(updates: Any, params: Any = None) -> Any:
        del params
        factors = tree.assign(rules, updates, f"learning rates of {stage.name}")
        return jax.tree.map(lambda update, factor: update * factor, updates, factors)

    return optax.stateless(scaled)
