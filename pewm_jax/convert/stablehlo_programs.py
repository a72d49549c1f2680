"""The programs of a StableHLO export: functions of flat named arrays, and their lowering."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from pewm_jax import registry as kinds
from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.data import abstract
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tree
from pewm_jax.memory import interface as memories
from pewm_jax.types import Array, Camera, Control, MemoryReadout, Params
from pewm_jax.worlds import world_model

Arrays: TypeAlias = dict[str, Array]
"""Name → array, or anything with a shape and a dtype."""


@dataclasses.dataclass(frozen=True)
class Program:
    """One function to be exported.

    Attributes:
        meaning: a one-line description.
        function: ``(weights, inputs) -> outputs``, all flat named arrays.
        inputs: the inputs' shapes and dtypes.
    """

    meaning: str
    function: Callable[[Arrays, Arrays], Arrays]
    inputs: Arrays


def rollout_programs(config: Config, params: Params, frames: int, clips: int) -> dict[str, Program]:
    """Return ``start`` and ``rollout`` (see ``pewm_jax.worlds``) on flat arrays.

    Args:
        config: the experiment.
        params: its weights; only their paths and shapes are used.
        frames: number of observed frames from which a world starts.
        clips: number of clips imagined per call.
    """
    clip = config.model.clip
    observed = abstract.frames(frames, height=clip.height, width=clip.width)
    state = jax.eval_shape(lambda p, f: worlds.start(config, p, f), params, observed)

    def start(weights: Arrays, inputs: Arrays) -> Arrays:
        (packed,) = _pack({"frames": observed}, inputs)
        return _name(state=worlds.start(config, tree.unflatten(weights), packed))

    def rollout(weights: Arrays, inputs: Arrays) -> Arrays:
        (packed,) = _pack({"state": state}, inputs)
        key = jax.random.wrap_key_data(inputs["key"], impl="threefry2x32")
        world = tree.unflatten(weights)
        after, imagined = worlds.imagine(config, world, packed, inputs["actions"], key)
        return _name(state=after, imagined=imagined)

    moves = jax.ShapeDtypeStruct((clips * (clip.frames - 1), 3), jnp.float32)
    key = jax.ShapeDtypeStruct((2,), jnp.uint32)
    return {
        "start": Program(
            "starts a world from posed RGB-D frames, the last of which is the present one",
            start,
            _name(frames=observed),
        ),
        "rollout": Program(
            "imagines what follows: actions are (dx, dy, dyaw) in metres forward, metres left "
            "and radians to the left; colours come out in [-1, 1], depth in metres",
            rollout,
            {**_name(state=state), "actions": moves, "key": key},
        ),
    }


def denoise_program(config: Config, params: Params, batch: int = 1) -> Program:
    """Return one evaluation of the denoiser (``world_model.apply``) on flat arrays.

    Args:
        config: the experiment.
        params: its weights; only their paths and shapes are used.
        batch: number of clips.
    """
    model = config.model
    clip = model.clip

    def like(shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    camera = abstract.camera(batch, clip.frames)
    observed = abstract.frames(batch, 1, height=clip.height, width=clip.width, colours=jnp.float32)
    conditioning = jax.eval_shape(
        lambda p, observed, camera: world_model.condition(model, p, observed, Control(camera)),
        params,
        observed,
        camera,
    )
    parts = {"conditioning": conditioning}
    if "memory" in params:

        def read(p: Params, c: Camera) -> Any:
            return memories.readout(model, model.memory.empty(model, jnp.zeros(3)), c, params=p)

        readout = jax.eval_shape(jax.vmap(read, (None, 0)), params, camera)
        shown = {"tokens": readout.tokens, "view": readout.view, "encoded": readout.encoded}
        parts |= {name: part for name, part in shown.items() if part is not None}
    noisy = like((*model.latent_shape, model.codec.channels))

    def denoise(weights: Arrays, inputs: Arrays) -> Arrays:
        packed = dict(zip(parts, _pack(parts, inputs), strict=True))
        conditioning = packed.pop("conditioning")
        readout = MemoryReadout(**packed) if packed else None
        noisy, times = inputs["noisy_BthwC"], inputs["timesteps_B"]
        world = tree.unflatten(weights)
        out = world_model.apply(model, world, noisy, conditioning, times, readout)
        return {"prediction_BthwC": out}

    noise, time = model.noise, like(())
    meaning = f"noise {kinds.of(noise).name}, see `pewm_jax.diffusion`"
    if isinstance(noise, DDPMConfig):
        time = like((), jnp.int32)
        meaning = f"the prediction is {noise.target} at levels 0 to {noise.train_steps - 1}"
    return Program(
        f"one evaluation of the denoiser: {meaning}",
        denoise,
        {"noisy_BthwC": noisy, "timesteps_B": time, **_name(**parts)},
    )


def lower(program: Program, weights: Arrays, platforms: Sequence[str]) -> jax.export.Exported:
    """Lower a program for every platform that supports it.

    Args:
        program: what to lower.
        weights: its weights, flat.
        platforms: the requested platforms.

    Raises:
        UserError: it cannot be lowered for any platform.
    """
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), x.dtype), weights)
    function = jax.jit(program.function)

    def attempt(names: Sequence[str]) -> jax.export.Exported:
        return jax.export.export(function, platforms=names)(like, program.inputs)

    def possible(name: str) -> bool:
        try:
            attempt([name])
        except (NotImplementedError, ValueError):
            return False
        return True

    try:
        return attempt(platforms)
    except (NotImplementedError, ValueError) as error:
        names = [name for name in platforms if possible(name)]
        if not names:
            raise UserError(
                f"This model cannot be lowered for {', '.join(platforms)} "
                f"({str(error).splitlines()[0]}); choose other platforms."
            ) from None
        return attempt(names)


def _name(**parts: Any) -> Arrays:
    """Flatten pytrees into named arrays: ``frames/camera/intrinsics_4``."""
    return tree.flatten(parts)


def _pack(parts: dict[str, Any], arrays: Arrays) -> list[Any]:
    """Build pytrees like the given ones from named arrays, the inverse of ``_name``."""
    return [
        jax.tree.unflatten(jax.tree.structure(like), [arrays[n] for n in _name(**{part: like})])
        for part, like in parts.items()
    ]
