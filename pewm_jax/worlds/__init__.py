"""Chapter 6, worlds: what is imagined next.

Every world is driven by the same three functions, whatever networks it has. They are pure: jit them
with the model static, vmap them over states, controls and keys. ::

    state = start(model, params, frames)                        # a few posed RGB-D frames
    state = observe(model, params, state, frames)               # more real frames, later
    state, frames = imagine(model, params, state, control, key) # what will be seen
    state, frames = imagine_many(model, params, state, controls, keys)  # many candidates

A world is a ``WorldSettings`` and a module (or object) with these three functions and

    init(model, key) -> params               all parameters
    stages(model) -> (Stage, …)              how it is trained, see ``worlds.stages``
    sharding(model) -> rules                 path of a parameter → the mesh axes of its last axes
    split_heads(model, stage) -> {name: n}   numbers that ``train.mesh.tensor`` must divide
    costs(config, stage, share) -> {part: Costs}   see ``models.costs``

and, if it can share work among candidates, an ``imagine_many``, a ``to_compare`` and ``views`` of
its own.
``worlds.pewm`` is an example.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

from pewm_jax.config import Config, WorldSettings, functions
from pewm_jax.types import Array, Frames, Params, WorldState
from pewm_jax.worlds.stages import Stage


def model_of(config: Config | WorldSettings) -> Any:
    """Return the model's settings, from a whole experiment's if those are given."""
    return config.model if isinstance(config, Config) else config


def start(model: Config | WorldSettings, params: Params, frames: Frames) -> WorldState:
    """Begin a world from a few posed RGB-D frames.

    Args:
        model: the model's settings, or an experiment's, which contain them.
        params: the world model's parameters; those of the image encoder are used, if it has any.
        frames: S ≥ 1 frames (S, H, W, …), uint8 or float colours; all are remembered, the last one
            is the present.

    Returns:
        The state to imagine from.

    Raises:
        UserError: the frames' shapes do not agree with each other or with the model.
    """
    model = model_of(model)
    return functions(model).start(model, params, frames)


def observe(
    model: Config | WorldSettings, params: Params, state: WorldState, frames: Frames
) -> WorldState:
    """Remember real frames; the last one becomes the present.

    Args:
        model: as for ``start``.
        params: the world model's parameters.
        state: the world so far.
        frames: S ≥ 1 frames, as for ``start``.

    Raises:
        UserError: as for ``start``.
    """
    model = model_of(model)
    return functions(model).observe(model, params, state, frames)


def imagine(
    model: Config | WorldSettings,
    params: Params,
    state: WorldState,
    control: Any,
    key: Array,
    *,
    remember: bool = True,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine what will be seen.

    Args:
        model: as for ``start``; static under jit.
        params: the world model's parameters.
        state: from ``start``, ``observe`` or an earlier ``imagine``.
        control: n ≥ 1 steps, any number: (n,) discrete actions (0 forward, 1 turn left, 2 turn
            right); (n, 3) continuous ones (dx, dy, dyaw: metres forward, metres left, radians
            counter-clockwise); a ``Camera`` (n,) for the frames to imagine (six degrees of
            freedom); or a ``Control`` with (n,) cameras and (n, A) actions.
        key: randomness of the sampling noise.
        remember: whether the imagined frames are remembered. If not, the state keeps the memory
            that it had; ``imagine_many`` uses this to compare many controls.
        memory: False ignores what is remembered (the empty-memory baseline).

    Returns:
        ``(state, frames)``: the world after the last frame, and the n imagined frames, colours
        float32 in [−1, 1], depth in metres. Whole clips are imagined; surplus frames of the last
        one are dropped.

    Raises:
        UserError: the control is empty or has none of these forms.
    """
    model = model_of(model)
    return functions(model).imagine(
        model, params, state, control, key, remember=remember, memory=memory
    )


def imagine_many(
    model: Config | WorldSettings,
    params: Params,
    state: WorldState,
    controls: Any,
    keys: Array,
    *,
    memory: bool = True,
    last: bool = False,
    views: Any = None,
) -> tuple[WorldState, Frames]:
    """Imagine K candidate controls from one state, without remembering any.

    Args:
        model: as for ``start``.
        params: the world model's parameters.
        state: the world so far; all candidates share its memory.
        controls: as for ``imagine``, with a leading axis K.
        keys: (K,) randomness of each candidate; equal keys give equal noise.
        memory: see ``imagine``.
        last: give only the last frame of each, (K, 1); a world may then leave the others undecoded.
        views: what ``views(…)(controls)`` gave for these controls, if it was asked.

    Returns:
        ``(state, frames)``: K present frames with the shared memory, which is not copied, and
        (K, n) imagined frames.
    """
    model = model_of(model)
    own = getattr(functions(model), "imagine_many", None)
    if own is not None:
        given = {} if views is None else {"views": views}
        return own(model, params, state, controls, keys, memory=memory, last=last, **given)
    candidate = functools.partial(imagine, model, remember=False, memory=memory)
    shared = WorldState(0, None)  # type: ignore[arg-type]
    many = jax.vmap(candidate, (None, None, 0, 0), (shared, 0))
    after, frames = many(params, state, controls, keys)
    return after, jax.tree.map(lambda x: x[:, -1:], frames) if last else frames


def to_compare(model: Config | WorldSettings, state: WorldState) -> WorldState:
    """Return a state for ``imagine_many`` alone, whose memory may be smaller and looks the same.

    On the host, not under jit; a world that can do no such thing gives the state as it is.
    """
    model = model_of(model)
    own = getattr(functions(model), "to_compare", None)
    return state if own is None else own(model, state)


def views(
    model: Config | WorldSettings, params: Params, state: WorldState
) -> Callable[[Any], Any] | None:
    """Return what makes ``views`` for ``imagine_many``, and keeps what candidates have in common.

    On the host, not under jit; None where a world has nothing of the kind. The state is the one
    that candidates are compared from.
    """
    model = model_of(model)
    own = getattr(functions(model), "views", None)
    return None if own is None else own(model, params, state)


def init(model: Config | WorldSettings, key: Array) -> Params:
    """Return random parameters for all networks of a world."""
    model = model_of(model)
    return functions(model).init(model, key)


def stages(model: Config | WorldSettings) -> tuple[Stage, ...]:
    """Return the stages of a world's training, in order."""
    model = model_of(model)
    return functions(model).stages(model)


def sharding(model: Config | WorldSettings) -> tuple[tuple[str, Any], ...]:
    """Return the rules from paths of parameters to the mesh axes of their last axes."""
    model = model_of(model)
    return functions(model).sharding(model)
