"""The programs of inference that a plan compiles for one device, from shapes alone.

They are the calls of ``pewm_jax.worlds`` with weights in bfloat16, as ``pewm-jax convert export
inference`` writes them. No weights are read or created.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import SingleDeviceSharding

from pewm_jax import worlds
from pewm_jax.config import Config, ConfigError, World
from pewm_jax.data import abstract
from pewm_jax.nn import target
from pewm_jax.train import flops
from pewm_jax.train.flops import Work
from pewm_jax.worlds import quantized

START, CLIP, UPDATE, MANY = "start", "clip", "update", "imagine_many"
"""The programs: a world from the frames of ``data.context``; one clip, remembered; real frames, as
many as a clip imagines, into the memory; candidates from one state."""
STEPS = (50, 4)
"""Numbers of sampling steps of the clip."""
CANDIDATES = 16
"""Number of candidates of ``imagine_many``."""
CARDS_GB = (16, 24, 80)
"""Sizes of cards in GB (10⁹ bytes) that a plan compares with."""
ALL_WEIGHTS = (
    "All weights of the model are on the device, also those that the program does not use."
)
"""What the arguments of these programs contain."""


@dataclasses.dataclass(frozen=True)
class Program:
    """A function and the shapes of its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    @property
    def argument_bytes(self) -> float:
        """Return the bytes of all arguments."""
        leaves = jax.tree.leaves(jax.eval_shape(lambda *a: jax.tree.map(_data, a), *self.arguments))
        return float(math.fsum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves))


def names(config: Config) -> tuple[str, ...]:
    """Return the names of a model's programs; the number of sampling steps is part of a name.

    Raises:
        UserError: the model is not a world.
    """
    world = worlds.require_world(config.model, "a plan of inference")
    clips = [CLIP]
    if world.sample_steps:
        clips = [f"{CLIP}-{steps}" for steps in STEPS if _can_sample(world, steps)]
    update = [UPDATE] if world.capabilities.memory else []
    return (START, *clips, *update, MANY)


def title(config: Config, name: str, quantize: str = "") -> str:
    """Return the description of a program."""
    kind, _, steps = name.partition("-")
    count, drawn = config.model.clip.frames - 1, f", {config.model.sample_steps} sampling steps"
    clip = f"a clip of {count} actions"
    sampled = drawn if config.model.sample_steps else ""
    found = {
        START: f"start from {config.data.context} frames",
        CLIP: f"{clip}, {steps} sampling steps" if steps else clip,
        UPDATE: f"update of the memory by {count} frames",
        MANY: f"imagine_many: {CANDIDATES} candidates of {count} actions{sampled}",
    }[kind]
    return f"{found}, weights in {quantize}" if quantize else found


def _can_sample(world: World, steps: int) -> bool:
    try:
        return world.with_sample_steps(steps).sample_steps == steps
    except ConfigError:
        return False


def program(config: Config, name: str, quantize: str = "") -> Program:
    """Return the program of a name from ``names``; ``quantize`` is as for ``pewm_jax.load``."""
    kind, _, steps = name.partition("-")
    world = worlds.require_world(config.model, "a plan of inference")
    if kind == CLIP and steps:
        world = world.with_sample_steps(int(steps))
    params = quantized.quantize(world, abstract_weights(world), quantize)
    observed = _frames(config, config.data.context)
    if kind == START:
        return Program(functools.partial(worlds.start, world), (params, observed))
    state = jax.eval_shape(functools.partial(worlds.start, world), params, observed)
    count = world.clip.frames - 1
    key = jax.eval_shape(lambda: jax.random.key(0))
    if kind == UPDATE:
        seen = _frames(config, count)
        return Program(functools.partial(worlds.observe, world), (params, state, seen))
    if kind == CLIP:
        moves = abstract.control(world, count)
        return Program(functools.partial(worlds.imagine, world), (params, state, moves, key))
    assert kind == MANY
    moves = abstract.control(world, CANDIDATES, count)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), CANDIDATES))
    return Program(functools.partial(worlds.imagine_many, world), (params, state, moves, keys))


def abstract_weights(world: World) -> Any:
    """Return the shapes of a world's weights as exported: floats in bfloat16."""
    shapes = jax.eval_shape(functools.partial(worlds.init, world), jax.random.key(0))

    def exported(leaf: Any) -> jax.ShapeDtypeStruct:
        wide = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jax.ShapeDtypeStruct(leaf.shape, jnp.bfloat16 if wide else leaf.dtype)

    return jax.tree.map(exported, shapes)


def _frames(config: Config, count: int) -> Any:
    clip = config.model.clip
    return abstract.frames(count, height=clip.height, width=clip.width)


def trace(program: Program, device: Any) -> jax.stages.Traced:
    """Trace a program for one device, which may be that of a described topology."""
    where = SingleDeviceSharding(device)
    placed = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where),
        program.arguments,
    )
    with target.use(target.of_devices([device])):
        return jax.jit(program.function, keep_unused=True).trace(*placed)


def needed(program: Program) -> Work:
    """Return the products of a program without the padding of a chip's kernels."""
    with target.use(target.Target("cpu")):
        traced = jax.make_jaxpr(program.function)(*program.arguments)
    return flops.needed(traced, [False] * len(traced.jaxpr.invars))


def fits_gb(peak_bytes: float | None) -> dict[str, bool]:
    """Return for each of ``CARDS_GB`` whether a program of this peak fits it."""
    peak = math.inf if peak_bytes is None else peak_bytes
    return {str(size): peak <= size * 1e9 for size in CARDS_GB}


def _data(leaf: Any) -> Any:
    """Return a key's data, and any other array as it is."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf
