"""Worlds: start from frames, observe frames, imagine frames.

Every world has the same pure functions. Called eagerly, they check the values they are given and
run a program that is compiled once for each model and each set of shapes. They can also be called
under jit (with the model static), vmap and grad. ::

    state = start(model, params, frames)                        # a few posed RGB-D frames
    state = observe(model, params, state, frames)               # more real frames, later
    state, frames = imagine(model, params, state, control, key) # the frames that will be seen
    state, frames = imagine_many(model, params, state, controls, keys)  # many candidates

``imagine_many`` compares candidates without copying the memory. ``jax.vmap`` of ``imagine`` over
controls copies it unless the state is declared as not batched in both directions::

    one = functools.partial(imagine, model, params, remember=False)
    shared = WorldState(0, None)  # the frame has the axis, the memory has none
    many = jax.vmap(one, in_axes=(None, 0, 0), out_axes=(shared, 0))

``jax.vmap`` over *states* is for different worlds and needs one memory for each.

A world is a class derived from ``pewm_jax.config.World``; a training task that imagines nothing (a
codec, a policy) is derived from ``pewm_jax.config.Task``. ``examples/world.py`` is a whole world in
one file.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import PartitionSpec

from pewm_jax.config import Config, Task, UserError, World
from pewm_jax.config.world import require_capabilities
from pewm_jax.types import Array, Frames, Params, WorldState
from pewm_jax.worlds import checks
from pewm_jax.worlds.stages import Stage, in_world_form, with_dictionaries


def model_of(config: Any) -> Any:
    """Return the settings of a model, also from those of a whole experiment."""
    return config.model if isinstance(config, Config) else config


def require_world(model: Task, who: str) -> World:
    """Return the settings of a world; ``who`` needs it, for the message: ``"start()"``.

    Raises:
        UserError: it is a training task that imagines nothing, or its capabilities are invalid.
    """
    if not isinstance(model, World):
        raise UserError(f"{who} got a run that {model.INSTEAD}.")
    require_capabilities(model)
    return model


def start(
    model: Config | Task,
    params: Params,
    frames: Frames,
    *,
    depth_scale: float | None = None,
) -> WorldState:
    """Begin a world from a few posed RGB-D frames.

    Args:
        model: the model's settings, or an experiment's, which contain them.
        params: the world model's parameters.
        frames: S ≥ 1 frames (S, H, W, …); all are remembered, the last one is the present. Colours
            are uint8, or floats in [−1, 1]; depth is float metres along z, 0 where nothing was
            measured; intrinsics are in pixels of these images; poses are rigid.
        depth_scale: metres per unit of depth, required where depth is integers: 0.001 for
            millimetres. Values of 65535 in uint16 then count as not measured.

    Raises:
        UserError: the frames' shapes do not agree with each other or with the model, or their
            values cannot be used: other colours, depth that is negative, not finite or of an
            unknown unit, poses that are not finite or not rigid, intrinsics of another image size.
            Values are not checked under jit, vmap and grad.
    """
    model = _world_of(model, params, "start")
    frames = checks.check_frames(frames, "start", depth_scale)
    return _start(model, params, frames, depth_scale)


def observe(
    model: Config | Task,
    params: Params,
    state: WorldState,
    frames: Frames,
    *,
    depth_scale: float | None = None,
) -> WorldState:
    """Remember S ≥ 1 real frames; the last one becomes the present. Arguments as for ``start``.

    A state that an invalid control has turned into NaN (see ``imagine``) stays NaN: observe from
    the state before.

    Raises:
        UserError: as for ``start``.
    """
    model = _world_of(model, params, "observe")
    checks.check_state(state, model, "observe")
    frames = checks.check_frames(frames, "observe", depth_scale)
    return _observe(model, params, state, frames, depth_scale)


def imagine(
    model: Config | Task,
    params: Params,
    state: WorldState,
    control: Any,
    key: Array,
    *,
    remember: bool = True,
    memory: bool = True,
) -> tuple[WorldState, Frames]:
    """Imagine the frames that a control leads to.

    Args:
        model: as for ``start``; static under jit.
        params: the world model's parameters.
        state: from ``start``, ``observe`` or an earlier ``imagine``.
        control: n ≥ 1 steps, any number: (n,) discrete actions (0 forward, 1 turn left, 2 turn
            right); (n, 3) continuous ones (dx, dy, dyaw: metres forward, metres left, radians
            counter-clockwise); a ``Camera`` (n,) for the frames to imagine (six degrees of
            freedom); or a ``Control`` with (n,) cameras and (n, A) actions and, for a model whose
            control has a state, the (A,) state of the agent in the present frame.
        key: randomness of the sampling noise.
        remember: whether the imagined frames enter the memory.
        memory: False ignores the memory (the empty-memory baseline).

    Returns:
        ``(state, frames)``: the world after the last frame, and the n imagined frames, colours
        float32 in [−1, 1], depth in metres. Whole clips are imagined; surplus frames of the last
        one are dropped.

        Under jit, vmap and grad the values of a control cannot be refused. If any of its actions is
        unknown, or any number is not finite, then colours, depth and poses of all n frames and of
        the state's present frame are NaN, and the memory is the one before the call. Frames that
        are imagined from that state are NaN, too.

    Raises:
        UserError: the control is empty or has none of these forms; model, params, state or key
            have another type, or the state's frame another size than the model's; or, outside of
            jit, vmap and grad, the control has an unknown discrete action, a number that is not
            finite, or a camera that is not rigid.
    """
    model = _world_of(model, params, "imagine")
    checks.check_state(state, model, "imagine")
    control = checks.check_control(control, "imagine")
    checks.check_key(key, "imagine")
    after, frames = _imagine(model, params, state, control, key, remember=remember, memory=memory)
    return (after if remember else WorldState(after.frame, state.map)), frames


def imagine_many(
    model: Config | Task,
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
        last: return only the last frame of each, (K, 1). A world may then leave the others
            undecoded or, with ``model.asked_alone``, not imagine them; the frame then differs from
            that of ``last=False``.
        views: the result of ``views(…)(controls)`` for these controls, if it was computed.

    Returns:
        ``(state, frames)``: K present frames with the shared memory, which is not copied, and
        (K, n) imagined frames. Under tracing an unknown action affects only its candidate.

    Raises:
        UserError: as for ``imagine``, or the number of keys is not that of the candidates.
    """
    model = _world_of(model, params, "imagine_many")
    checks.check_state(state, model, "imagine_many")
    controls = checks.check_control(controls, "imagine_many")
    checks.check_key(keys, "imagine_many", checks.candidates_of(controls, "imagine_many"))
    frame, frames = _imagine_many(
        model, params, state, controls, keys, views, memory=memory, last=last
    )
    return WorldState(frame, state.map), frames


def _world_of(model: Any, params: Params, who: str) -> World:
    """Return the settings of a world, after checking that these are settings and parameters."""
    model = model_of(model)
    checks.check_model(model, who)
    world = require_world(model, f"{who}()")
    checks.check_params(params, who)
    return world


# One program for each model and set of shapes. They are inlined under a caller's own jit, so
# that its program is the same as if the world were called directly.
@functools.partial(jax.jit, static_argnums=0, inline=True)
def _start(
    model: World,
    params: Params,
    frames: Frames,
    depth_scale: Array | None,
) -> WorldState:
    state = model.start(in_world_form(model, params), checks.in_metres(frames, depth_scale))
    name = "observe" if type(model).start is World.start else "start"
    return checks.returned_state(model, name, state, (1, *frames.depth_THW.shape[1:]))


@functools.partial(jax.jit, static_argnums=0, inline=True)
def _observe(
    model: World,
    params: Params,
    state: WorldState,
    frames: Frames,
    depth_scale: Array | None,
) -> WorldState:
    own, frames = in_world_form(model, params), checks.in_metres(frames, depth_scale)
    after = model.observe(own, state, frames)
    after = checks.returned_state(model, "observe", after, (1, *frames.depth_THW.shape[1:]))
    ok = checks.valid((), state.frame.camera)
    return WorldState(
        checks.nan_unless(ok, after.frame), checks.memory_if(ok, after.map, state.map)
    )


@functools.partial(jax.jit, static_argnums=0, static_argnames=("remember", "memory"), inline=True)
def _imagine(
    model: World,
    params: Params,
    state: WorldState,
    control: Any,
    key: Array,
    *,
    remember: bool,
    memory: bool,
) -> tuple[WorldState, Frames]:
    """Imagine; without ``remember`` the state has no memory: the caller's is not copied."""
    own = in_world_form(model, params)
    found = model.imagine(own, state, control, key, remember=remember, memory=memory)
    present, count = state.frame.depth_THW.shape, checks.steps_of(control)
    after, frames = checks.returned_frames(model, "imagine", found, present, count)
    ok = checks.valid(control, state.frame.camera)
    kept = checks.memory_if(ok, after.map, state.map) if remember else None
    return WorldState(checks.nan_unless(ok, after.frame), kept), checks.nan_unless(ok, frames)


@functools.partial(jax.jit, static_argnums=0, static_argnames=("memory", "last"), inline=True)
def _imagine_many(
    model: World,
    params: Params,
    state: WorldState,
    controls: Any,
    keys: Array,
    views: Any,
    *,
    memory: bool,
    last: bool,
) -> tuple[Frames, Frames]:
    """Return (K, 1) present frames, and (K, n) imagined ones or the last of them."""
    shown = {} if views is None else {"views": views}
    own = in_world_form(model, params)
    size, count = state.frame.depth_THW.shape, checks.steps_of(controls, 1)
    if type(model).imagine_many is World.imagine_many:  # refuse a wrong ``imagine`` by its name
        imagine_one = functools.partial(model.imagine, remember=False, memory=memory)
        control, key = jax.tree.map(lambda x: x[0], (controls, keys))
        found = jax.eval_shape(imagine_one, own, state, control, key)
        checks.returned_frames(model, "imagine", found, size, count)
    found = model.imagine_many(own, state, controls, keys, memory=memory, last=last, **shown)
    present, count = (keys.shape[0], *size), 1 if last else count
    after, frames = checks.returned_frames(model, "imagine_many", found, present, count)
    ok = checks.valid(controls, state.frame.camera, leading=1)
    return checks.nan_unless(ok, after.frame), checks.nan_unless(ok, frames)


def to_compare(model: Config | Task, state: WorldState) -> WorldState:
    """Return a state for ``imagine_many`` alone, whose memory may be smaller; not under jit."""
    return require_world(model_of(model), "to_compare()").to_compare(state)


def views(model: Config | Task, params: Params, state: WorldState) -> Callable[[Any], Any] | None:
    """Return a function from controls to ``imagine_many``'s ``views``, with a cache of renderings.

    It runs on the host, not under jit, for candidates of this state; None if they share no views.
    """
    model = require_world(model_of(model), "views()")
    return model.views(in_world_form(model, params), state)


def init(model: Any, key: Array) -> Params:
    """Return random parameters for all networks of a world."""
    return model_of(model).init(key)


def stages(model: Any) -> tuple[Stage, ...]:
    """Return the stages of a world's training, in order."""
    model = model_of(model)
    return tuple(with_dictionaries(model, stage) for stage in model.stages())


def sharding(model: Any) -> tuple[tuple[str, Any], ...]:
    """Return the rules from paths of parameters to the mesh axes of their last axes."""
    rules = model_of(model).sharding()
    adapters = (r"lora/.*", PartitionSpec())
    return (adapters, *((pattern, PartitionSpec(*spec)) for pattern, spec in rules))


def split_heads(model: Any, stage: Stage) -> dict[str, int]:
    """Return the numbers that ``train.mesh.tensor`` must divide, by the setting's name."""
    return model_of(model).split_heads(stage)


def memory_points(
    model: Config | Task, state: WorldState
) -> tuple[Array, Array, Array, Array | None]:
    """Return the memory as points; see ``World.memory_points``."""
    return require_world(model_of(model), "memory_points()").memory_points(state.map)


def erase(model: Config | Task, params: Params, state: WorldState, box_23: Array) -> WorldState:
    """Return a world without the content of a box; see ``World.erase``."""
    model = require_world(model_of(model), "erase()")
    return model.erase(in_world_form(model, params), state, box_23)


def move(
    model: Config | Task,
    params: Params,
    state: WorldState,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> WorldState:
    """Return a world whose content of a box is moved; see ``World.move``."""
    model = require_world(model_of(model), "move()")
    return model.move(in_world_form(model, params), state, box_23, transform, leave=leave)


def coverage(
    model: Config | Task, params: Params, state: WorldState, frames: Frames, seen_THW: Array
) -> dict[str, Array]:
    """Return how many pixels seen before the memory holds; see ``World.coverage``."""
    model = require_world(model_of(model), "coverage()")
    return model.coverage(in_world_form(model, params), state, frames, seen_THW)
