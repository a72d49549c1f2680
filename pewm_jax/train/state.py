"""All that changes during training, as one pytree.

There is no random state: the randomness of a step is folded from the seed and the step's number,
and the data position is that number too, so a restored state goes on exactly as it would have.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import Config
from pewm_jax.io import tree
from pewm_jax.train import optimizer
from pewm_jax.train.stages import Stage
from pewm_jax.types import Array, Params


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
