"""One training step: the state, a pure function, and the single place where it is compiled.

Only the trained subtree is differentiated and updated. Frozen leaves stay bit-identical, and no
gradient of frozen weights is computed: the optimizer's mask gets zeros in their place.

The state contains no random key. The randomness of a step is folded from the seed and the step
number, which is also the position in the data, so a restored state continues exactly.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from pewm_jax.config import Config, UserError
from pewm_jax.io import tree
from pewm_jax.nn import placement, target
from pewm_jax.train import optimizer, sharding
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds import lora
from pewm_jax.worlds.stages import Stage

Metrics = dict[str, Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """The state of one stage.

    Attributes:
        params: all parameters of the stage: trained ones, and adapters, in float32, frozen ones in
            the model's compute ``dtype``.
        ema: exponential moving average of the trained parameters only, without those that serve
            training alone (``Stage.training_only``).
        opt_state: optimizer state; moments of the trained parameters only.
        step: () int32, steps done; also the position in the data.
    """

    params: Params
    ema: Params
    opt_state: Any
    step: Array


def create(config: Config, stage: Stage, key: Array, start: Params | None = None) -> TrainState:
    """Return the initial state. Pure and jittable (``config``, ``stage`` static).

    ``start`` are weights to begin with instead of random ones; see ``require_start``.

    Raises:
        TreeError: ``start`` has other paths or shapes.
    """
    params = stage.init(config.model, key)
    if start is not None:
        leaves = tree.flatten(require_start(config, stage, start, params))
        params = tree.unflatten(
            {
                path: jnp.asarray(leaves[path], leaf.dtype) if path in leaves else leaf
                for path, leaf in tree.flatten(params).items()
            }
        )
    trained, frozen = tree.split(params, stage.trained)
    kept, dtype = set(stage.stored), config.model.dtype
    frozen = {
        path: leaf if path in kept else leaf.astype(dtype)
        for path, leaf in tree.flatten(frozen).items()
    }
    params = tree.merge(trained, tree.unflatten(frozen))
    return TrainState(
        params=params,
        ema=jax.tree.map(jnp.copy, stage.published(trained)),
        opt_state=optimizer.make(config, stage).init(params),
        step=jnp.zeros((), jnp.int32),
    )


def require_start(config: Config, stage: Stage, start: Any, like: Params) -> Params:
    """Return the weights that a stage starts from, or raise an error if it cannot.

    Leaves that match ``train.fresh`` may be missing and are initialized randomly: the memory blocks
    of stage 2, which the weights of stage 1 do not contain. Those of another shape are left out,
    such as the control of other actions, and those that the model does not have. Kernels that match
    ``train.wider`` may have fewer inputs: the further ones are zero. Leaves that serve training
    alone may be missing, too; no weights contain them. ``start`` and ``like``, all parameters of
    the stage, may be their shapes.

    Raises:
        TreeError: another leaf is missing, a leaf is unexpected or has another shape; lists them.
    """
    parameters = tree.flatten(like)
    leaves = {
        path: _wider(leaf, parameters[path])
        if path in parameters and lora.matches(config.train.wider, path)
        else leaf
        for path, leaf in tree.flatten(start).items()
        if not lora.matches(config.train.fresh, path)
        or (path in parameters and np.shape(leaf) == np.shape(parameters[path]))
    }
    lacking = (*config.train.fresh, *stage.training_only)
    wanted = {
        path: leaf
        for path, leaf in parameters.items()
        if path in leaves or not lora.matches((*lacking, lora.PATHS), path)
    }
    allowed = ", ".join(config.train.fresh) or "none"
    what = f"Initial weights of {stage.title} (may lack, by train.fresh: {allowed})"
    tree.require_like(leaves, wanted, what)
    return tree.unflatten(leaves)


def _wider(leaf: Any, like: Any) -> Any:
    """Return a kernel with as many inputs as another one's, the further ones zero, if it has fewer.

    Shapes give shapes.
    """
    have, want = np.shape(leaf), np.shape(like)
    if len(have) < 2 or (*have[:-2], have[-1]) != (*want[:-2], want[-1]) or have[-2] >= want[-2]:
        return leaf
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.ShapeDtypeStruct(want, leaf.dtype)
    more = [(0, 0)] * len(have)
    more[-2] = (0, want[-2] - have[-2])
    return jnp.pad(leaf, more) if isinstance(leaf, jax.Array) else np.pad(leaf, more)


def update_ema(ema: Params, trained: Params, step: Array, decay: float) -> Params:
    """Update the exponential moving average of the trained parameters.

    The decay grows from 2/11 at the first step to ``decay`` (min(decay, (1 + n) / (10 + n)) after n
    steps), so that the random initialization does not dominate short runs.
    """
    done = step.astype(jnp.float32) + 1.0
    decay_now = jnp.minimum(decay, (1.0 + done) / (10.0 + done))
    return jax.tree.map(lambda old, new: old + (1.0 - decay_now) * (new - old), ema, trained)


def inference_params(stage: Stage, state: TrainState) -> Params:
    """Return the inference weights: the EMA of trained parameters, and the frozen ones."""
    frozen = tree.exclude(state.params, stage.trained)
    return tree.merge(state.ema, frozen)


def start_params(config: Config, stage: Stage, like: TrainState, start: Params) -> Params:
    """Return the start weights on the devices: the parameters that checkpoints do not hold.

    ``like`` is the abstract state; see ``require_start`` for errors.
    """
    start = require_start(config, stage, start, like.params)
    kept = set(stage.stored)
    rest = {path: x for path, x in tree.flatten(start).items() if path not in kept}
    return sharding.place(tree.unflatten(rest), like.params)


def train_step(
    config: Config,
    stage: Stage,
    state: TrainState,
    clip: Clip,
    key: Array,
    extra: Params | None = None,
) -> tuple[TrainState, Metrics]:
    """Do one optimizer step on a batch with leading B, uint8 colours and metric depth.

    ``key`` is from ``noise_key``, the same for all steps; the step number is folded in. ``config``
    and ``stage`` are static. ``extra`` are weights needed only by the loss
    (``Stage.extra_weights``).

    Returns:
        The new state, and scalars: ``loss``, ``grad_norm`` (before clipping), ``learning_rate``,
        and the metrics of the objective. If ``train.on_nonfinite`` is ``skip``, also ``skipped``: 1
        if loss or gradient is not finite; then only ``step`` of the state changes.
    """
    trained, frozen = tree.split(state.params, stage.trained)
    step_key = jax.random.fold_in(key, state.step)

    def loss_of(trained: Params, clip: Clip, key: Array) -> tuple[Array, Metrics]:
        params = tree.merge(trained, frozen, extra or {})
        found = stage.loss(config.model, config.train, params, clip, key)
        return _require_loss(found, f"The loss of {stage.title}")

    def differentiate(clip: Clip, key: Array) -> tuple[tuple[Array, Metrics], Params]:
        found, gradients = jax.value_and_grad(loss_of, has_aux=True)(trained, clip, key)
        return found, sharding.constrain(config.model, gradients)

    parts = stage.settings(config).micro_batches
    found = differentiate(clip, step_key) if parts == 1 else None
    (loss, measured), gradients = found or _accumulate(differentiate, clip, step_key, parts)
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
        ema=update_ema(state.ema, stage.published(trained), state.step, config.train.ema),
        opt_state=opt_state,
        step=state.step + 1,
    )
    if config.train.on_nonfinite == "skip":
        good = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["grad_norm"])
        unmoved = dataclasses.replace(state, step=after.step)
        after = jax.tree.map(functools.partial(_select, good), after, unmoved)
        metrics["skipped"] = ~good
    return after, jax.tree.map(jnp.asarray, metrics)


def _accumulate(differentiate: Callable[..., Any], clip: Clip, key: Array, parts: int) -> Any:
    """Return the mean of ``differentiate(clip, key)`` over micro-batches of the clips.

    Each micro-batch draws noise of its own. It has clips of every device: no clip is sent.
    """

    def split(x: Array) -> Array:
        rows = x.reshape(len(x) // parts, parts, *x.shape[1:]).swapaxes(0, 1)
        return placement.constrain(rows, None, "batch")

    def add(total: Any, inputs: tuple[Array, Clip]) -> tuple[Any, None]:
        number, part = inputs
        found = _wide(differentiate(part, jax.random.fold_in(key, number)))
        return jax.tree.map(jnp.add, total, found), None

    micro = jax.tree.map(split, clip)
    first = jax.tree.map(lambda x: x[0], micro)
    shapes = jax.eval_shape(lambda: _wide(differentiate(first, key)))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    total, _ = jax.lax.scan(add, zeros, (jnp.arange(parts), micro))
    return jax.tree.map(lambda x: x / parts, total)


def _wide(found: Any) -> Any:
    """Return losses, metrics and gradients in float32, as sums need it."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), found)


def weights_key(config: Config, stage: Stage) -> Array:
    """Return the PRNG key of a stage's initial weights."""
    return _keys(config, stage)[0]


def noise_key(config: Config, stage: Stage) -> Array:
    """Return the PRNG key of the noise in a stage's steps."""
    return _keys(config, stage)[1]


def _keys(config: Config, stage: Stage) -> tuple[Array, Array]:
    """Return the keys of weights and noise; the same key in runs of versions up to 3."""
    key = jax.random.fold_in(jax.random.key(config.train.seed), stage.number)
    if config.train.noise_key == "weights":
        return key, key
    weights, noise = jax.random.split(key)
    return weights, noise


def abstract_state(config: Config, stage: Stage, mesh: Mesh) -> Any:
    """Return the state's shapes, dtypes and shardings without computing anything."""
    shapes = jax.eval_shape(functools.partial(create, config, stage), weights_key(config, stage))
    return sharding.abstract(shapes, sharding.of_state(config.model, mesh, shapes))


def initial_state(
    config: Config, stage: Stage, mesh: Mesh, start: Params | None = None
) -> TrainState:
    """Create the state, sharded on the devices; see ``create``.

    No array is ever materialized whole: random weights are drawn in place, and each device gets
    only its shard of the start weights.
    """
    like = abstract_state(config, stage, mesh)
    shardings = jax.tree.map(lambda leaf: leaf.sharding, like)
    if start is not None:
        start = require_start(config, stage, start, like.params)
        start = sharding.place(start, like.params)
    make = jax.jit(functools.partial(create, config, stage), out_shardings=shardings)
    return make(weights_key(config, stage), start)


def load_extra_weights(config: Config, stage: Stage, mesh: Mesh) -> Params | None:
    """Load the weights needed only by the stage's loss, onto every device; None for most stages.

    Raises:
        UserError: they are missing or damaged.
    """
    extra = stage.extra_weights(config.model, config.train) if stage.extra_weights else None
    if extra is None:
        return None
    everywhere = sharding.replicated(mesh)
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=everywhere), extra
    )
    return sharding.place(extra, like)


def trace_step(
    config: Config, stage: Stage, mesh: Mesh, clip: Any, extra: Params | None = None
) -> jax.stages.Traced:
    """Trace ``train_step`` for one batch shape, for lowering or reading its jaxpr.

    The devices of ``mesh`` need not exist: they may be those of a described topology. ``clip`` is a
    batch and ``extra`` is from ``load_extra_weights``; their shapes suffice.
    """
    state = abstract_state(config, stage, mesh)
    everywhere = sharding.replicated(mesh)
    placed = jax.tree.map(lambda leaf: leaf.sharding, state)
    split = sharding.of_batch(mesh)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=split), clip)
    key = noise_key(config, stage)
    further = () if extra is None else (extra,)
    step = jax.jit(
        functools.partial(train_step, config, stage),
        in_shardings=(placed, split, everywhere, *(everywhere for _ in further)),
        out_shardings=(placed, everywhere),
        donate_argnums=0,
    )
    abstract_key = jax.ShapeDtypeStruct(key.shape, key.dtype, sharding=everywhere)
    kind = target.of_devices(mesh.devices.ravel().tolist())
    with jax.set_mesh(mesh), target.use(kind):  # read by ``nn.placement`` and the kernels
        return step.trace(state, batch, abstract_key, *further)


def compile_step(
    config: Config, stage: Stage, mesh: Mesh, clip: Any, extra: Params | None = None
) -> Callable[[TrainState, Clip, Array], tuple[TrainState, Metrics]]:
    """Compile ``train_step`` ahead of time for the shapes of one batch.

    ``extra`` is from ``load_extra_weights``; loaded here if None.

    Returns:
        The compiled ``(state, clip, key) -> (state, metrics)``; it consumes the state (its buffers
        are donated) and expects clip and key placed as ``sharding`` defines.
    """
    extra = load_extra_weights(config, stage, mesh) if extra is None else extra
    compiled = trace_step(config, stage, mesh, clip, extra).lower().compile()
    if extra is None:
        return compiled
    return lambda state, clip, key: compiled(state, clip, key, extra)


def _require_loss(found: Any, what: str) -> tuple[Array, Metrics]:
    """Return what a loss returned, or refuse anything but one number and numbers by name."""
    if not isinstance(found, tuple) or len(found) != 2 or not isinstance(found[1], dict):
        raise UserError(
            f"{what} must return (loss, measured), a number and a dictionary of numbers; it "
            f"returned a {type(found).__name__}."
        )
    for name, value in {"loss": found[0], **found[1]}.items():
        if jnp.shape(value) != ():
            raise UserError(
                f"{what} returned {name} of shape {jnp.shape(value)}: it must be one number; take "
                "the mean over the batch."
            )
    return found


def _norm(gradients: Params) -> Array:
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(gradients)))


def _select(good: Array, new: Array, old: Array) -> Array:
    """Select the new leaf or the old one; leaves that were passed through are unchanged."""
    return new if new is old else jnp.where(good, new, old)
