"""One step of training: the state, a pure function, and the one place where it is compiled.

Only the trained subtree is differentiated and updated. Frozen leaves stay bit-identical, and no
gradient of frozen weights is computed: the optimizer's mask gets zeros in their place.

The state has no random part. The randomness of a step is folded from the seed and the step's
number, which is also the position in the data: a restored state continues exactly as it would have.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from pewm_jax.config import Config
from pewm_jax.io import tree
from pewm_jax.nn import target
from pewm_jax.train import optimizer, sharding
from pewm_jax.train.stages import Stage
from pewm_jax.types import Array, Clip, Params

Metrics = dict[str, Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """The state of one stage.

    Attributes:
        params: all parameters of the stage: trained ones in float32, frozen ones in the model's
            ``dtype``, which is all that computing with them takes.
        ema: exponential moving average of the trained parameters only.
        opt_state: optimizer state; moments of the trained parameters only.
        step: () int32, steps done; also the position in the data.
    """

    params: Params
    ema: Params
    opt_state: Any
    step: Array


def create(config: Config, stage: Stage, key: Array, start: Params | None = None) -> TrainState:
    """Make the state before the first step. Pure and jittable (``config``, ``stage`` static).

    Args:
        config: the experiment.
        stage: the stage to begin.
        key: PRNG key of the fresh weights.
        start: weights to begin with, in place of fresh ones; see ``require_start``.

    Raises:
        TreeError: ``start`` has other paths or shapes.
    """
    params = stage.init(config.model, key)
    if start is not None:
        require_start(config, stage, start, params)
        given = tree.flatten(start)
        params = tree.unflatten(
            {
                path: jnp.asarray(given[path], leaf.dtype) if path in given else leaf
                for path, leaf in tree.flatten(params).items()
            }
        )
    trained, frozen = tree.split(params, stage.trained)
    params = tree.merge(trained, jax.tree.map(lambda x: x.astype(config.model.dtype), frozen))
    return TrainState(
        params=params,
        ema=jax.tree.map(jnp.copy, trained),
        opt_state=optimizer.make(config, stage).init(params),
        step=jnp.zeros((), jnp.int32),
    )


def require_start(config: Config, stage: Stage, start: Any, like: Params) -> None:
    """Insist that weights are those that a stage can start from.

    Leaves may be absent where ``train.fresh`` says so, and begin at random then: the memory blocks
    of stage 2, which the weights of stage 1 do not hold.

    Args:
        config: the experiment.
        stage: the stage to begin.
        start: the weights, or anything of their paths and shapes.
        like: all parameters of the stage, or their shapes.

    Raises:
        TreeError: another leaf is absent, one is unexpected, or one has another shape; with the
            list.
    """
    given = tree.flatten(start)
    wanted = {
        path: leaf
        for path, leaf in tree.flatten(like).items()
        if path in given or not any(re.fullmatch(rule, path) for rule in config.train.fresh)
    }
    allowed = ", ".join(config.train.fresh) or "none"
    what = f"What {stage.title} starts from (train.fresh, what it may lack: {allowed})"
    tree.require_like(given, wanted, what)


def update_ema(ema: Params, trained: Params, step: Array, decay: float) -> Params:
    """Move the average towards the trained parameters.

    The decay grows from 2/11 at the first step to ``decay`` (min(decay, (1 + n) / (10 + n)) after
    n steps), so that short runs are not weighed down by their random start.
    """
    done = step.astype(jnp.float32) + 1.0
    decay_now = jnp.minimum(decay, (1.0 + done) / (10.0 + done))
    return jax.tree.map(lambda old, new: old + (1.0 - decay_now) * (new - old), ema, trained)


def inference_params(stage: Stage, state: TrainState) -> Params:
    """Return what inference uses: the average where trained, the frozen weights elsewhere."""
    frozen = tree.exclude(state.params, stage.trained)
    return tree.merge(state.ema, frozen)


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
        given: weights that only the loss needs, see ``Stage.extra_weights``.

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
    given = stage.extra_weights(config.model, config.train) if stage.extra_weights else None
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
        mesh: the devices; those of a described topology need not exist.
        clip: a batch, or the shapes of one.
        given: from ``given_weights``, or its shapes.
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
    kind = target.of_devices(mesh.devices.ravel().tolist())
    with jax.set_mesh(mesh), target.use(kind):  # ``nn.placement`` and the kernels ask for them
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
