"""One step of training: a pure function, and the one place where it is compiled.

Only the trained subtree is differentiated and updated: frozen leaves pass through bit-identical,
and no gradient of frozen weights is ever computed; the optimizer's mask (``stages``, ``optimizer``)
gets zeros in their place.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from pewm_jax.config import Config
from pewm_jax.io import tree
from pewm_jax.train import optimizer, sharding
from pewm_jax.train.stages import Stage
from pewm_jax.train.state import TrainState, create, require_start, update_ema
from pewm_jax.types import Array, Clip, Params

Metrics = dict[str, Array]


def train_step(
    config: Config,
    stage: Stage,
    state: TrainState,
    clip: Clip,
    key: Array,
    given: Params | None = None,
) -> tuple[TrainState, Metrics]:
    """Do one optimizer step.

    Args:
        config: the experiment (static).
        stage: what is trained (static).
        state: the state before.
        clip: a batch with leading B, uint8 colours and metric depth.
        key: from ``noise_key``, the same for all steps; the step's number is folded in.
        given: weights that only the loss needs, see ``Stage.given``.

    Returns:
        The state after, and scalars: ``loss``, ``grad_norm`` (before clipping),
        ``learning_rate``, and what the objective measures. Where ``train.on_nonfinite`` is
        ``skip`` also ``skipped``: 1 where loss or gradient is not finite, and the state after is
        the state before but for its ``step``.
    """
    trained, frozen = tree.split(state.params, stage.trained)
    step_key = jax.random.fold_in(key, state.step)

    def loss_of(trained: Params) -> tuple[Array, Metrics]:
        params = tree.merge(trained, frozen, given or {})
        return stage.loss(config.model, config.train, params, clip, step_key)

    (loss, measured), gradients = jax.value_and_grad(loss_of, has_aux=True)(trained)
    gradients = sharding.constrain(config.model, gradients)
    still = jax.tree.map(jnp.zeros_like, frozen)
    updates, opt_state = optimizer.make(config, stage).update(
        tree.merge(gradients, still), state.opt_state, state.params
    )
    moved = tree.select(cast("Params", updates), stage.trained)
    trained = cast("Params", optax.apply_updates(trained, moved))
    metrics = {
        **measured,
        "loss": loss,
        "grad_norm": _norm(gradients),
        "learning_rate": optimizer.rate(stage.settings(config), state.opt_state),
    }
    after = TrainState(
        params=tree.merge(trained, frozen),
        ema=update_ema(state.ema, trained, state.step, config.train.ema),
        opt_state=opt_state,
        step=state.step + 1,
    )
    if config.train.on_nonfinite == "skip":
        good = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["grad_norm"])
        unmoved = dataclasses.replace(state, step=after.step)
        after = jax.tree.map(functools.partial(_unless, good), after, unmoved)
        metrics["skipped"] = ~good
    return after, jax.tree.map(jnp.asarray, metrics)


def weights_key(config: Config, stage: Stage) -> Array:
    """Return the PRNG key that a stage's initial weights are drawn from."""
    return _keys(config, stage)[0]


def noise_key(config: Config, stage: Stage) -> Array:
    """Return the PRNG key that the noise of a stage's steps is drawn from."""
    return _keys(config, stage)[1]


def _keys(config: Config, stage: Stage) -> tuple[Array, Array]:
    """Return the keys of weights and noise; both are one key in runs of versions up to 3."""
    key = jax.random.fold_in(jax.random.key(config.train.seed), stage.number)
    if config.train.noise_key == "weights":
        return key, key
    weights, noise = jax.random.split(key)
    return weights, noise


def abstract_state(config: Config, stage: Stage, mesh: Mesh) -> Any:
    """Return the state's shapes, types and placements without computing anything."""
    shapes = jax.eval_shape(functools.partial(create, config, stage), weights_key(config, stage))
    return sharding.abstract(shapes, sharding.of_state(config.model, mesh, shapes))


def initial_state(
    config: Config, stage: Stage, mesh: Mesh, start: Params | None = None
) -> TrainState:
    """Create the state in its place on the devices; see ``state.create``.

    Nothing is whole anywhere in between: fresh weights are drawn where they belong, and of those
    to start from each device is given its part.
    """
    like = abstract_state(config, stage, mesh)
    shardings = jax.tree.map(lambda leaf: leaf.sharding, like)
    if start is not None:
        require_start(config, stage, start, like.params)
        start = sharding.place(start, like.params)
    make = jax.jit(functools.partial(create, config, stage), out_shardings=shardings)
    return make(weights_key(config, stage), start)


def given_weights(config: Config, stage: Stage, mesh: Mesh) -> Params | None:
    """Read what only the stage's loss needs, onto every device; None for most stages.

    Raises:
        UserError: it is absent or damaged.
    """
    given = stage.given(config.model, config.train) if stage.given else None
    if given is None:
        return None
    everywhere = sharding.replicated(mesh)
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=everywhere), given
    )
    return sharding.place(given, like)


def trace_step(
    config: Config, stage: Stage, mesh: Mesh, clip: Any, given: Params | None = None
) -> jax.stages.Traced:
    """Trace ``train_step`` for one batch shape; it can be lowered and its jaxpr read.

    Args:
        config: the experiment.
        stage: what is trained.
        mesh: the devices.
        clip: a batch, or the shapes of one.
        given: from ``given_weights``.
    """
    state = abstract_state(config, stage, mesh)
    everywhere = sharding.replicated(mesh)
    placed = jax.tree.map(lambda leaf: leaf.sharding, state)
    split = sharding.of_batch(mesh)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=split), clip)
    key = noise_key(config, stage)
    extra = () if given is None else (given,)
    step = jax.jit(
        functools.partial(train_step, config, stage),
        in_shardings=(placed, split, everywhere, *(everywhere for _ in extra)),
        out_shardings=(placed, everywhere),
        donate_argnums=0,
    )
    abstract_key = jax.ShapeDtypeStruct(key.shape, key.dtype, sharding=everywhere)
    with jax.set_mesh(mesh):  # which ``models.placement`` asks for
        return step.trace(state, batch, abstract_key, *extra)


def compile_step(
    config: Config, stage: Stage, mesh: Mesh, clip: Any, given: Params | None = None
) -> Callable[[TrainState, Clip, Array], tuple[TrainState, Metrics]]:
    """Compile ``train_step`` ahead of time for one batch shape.

    Args:
        config: the experiment.
        stage: what is trained.
        mesh: the devices.
        clip: a batch, or the shapes of one.
        given: from ``given_weights``, which is called here if this is None.

    Returns:
        The compiled ``(state, clip, key) -> (state, metrics)``; it consumes the state it is given
        (its buffers are donated) and wants clip and key placed as ``sharding`` says.
    """
    given = given_weights(config, stage, mesh) if given is None else given
    compiled = trace_step(config, stage, mesh, clip, given).lower().compile()
    if given is None:
        return compiled
    return lambda state, clip, key: compiled(state, clip, key, given)


def _norm(gradients: Params) -> Array:
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(gradients)))


def _unless(good: Array, new: Array, old: Array) -> Array:
    """Choose the new leaf or the old; what was passed through is left alone."""
    return new if new is old else jnp.where(good, new, old)
