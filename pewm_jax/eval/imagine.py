"""Run the model on batches of chosen clips, compiled ahead of time, on one device or several."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax.config import Config
from pewm_jax.data import abstract
from pewm_jax.types import Array, Camera, Frames, Params, WorldState
from pewm_jax.worlds import start
from pewm_jax.worlds.rollouts import rollout


def print_now(line: str) -> None:
    """Print a line without buffering, even if the output is not a terminal."""
    print(line, flush=True)


class Imagination:
    """A model that imagines batches of clips of one size; functions are compiled when first needed.

    Args:
        config: static.
        params: weights.
        batch: clips sampled at once.
        context: number of observed frames that a state starts from.
        cameras: whether clips are driven by cameras (six degrees of freedom) instead of actions.
        devices: of this process, which each imagine an equal part of a batch, as many of them as
            divide it; by default one.
        say: shows a line: what is being compiled, and how long it took.
    """

    def __init__(
        self,
        config: Config,
        params: Params,
        batch: int,
        context: int,
        say: Callable[[str], Any] = print_now,
        *,
        cameras: bool = False,
        devices: Sequence[Any] = (),
    ):
        self.cameras = cameras
        self.config, self.batch, self.context = config, batch, context
        self.mesh = mesh_of(devices, batch)
        self.params = self._everywhere(params)
        self._say = say
        self._begin: Callable[..., WorldState] | None = None
        self._clip: dict[bool, Callable[..., tuple[WorldState, Frames]]] = {}

    def prepare(self, memories: Iterable[bool]) -> None:
        """Compile ``start``, and the sampler with (True) or without (False) its map.

        Nothing is compiled twice, and nothing if no variant is given.
        """
        memories = [memory for memory in memories if memory not in self._clip]
        if not memories:
            return
        states = jax.eval_shape(self._start_batch, self.params, self._abstract_context())
        self._prepare_start()
        many = f" on {self.mesh.size} devices" if self.mesh else ""
        length = self.config.model.clip.frames - 1
        steps = self.config.model.sample_steps
        steps = f"{steps} steps, " if steps else ""
        control = abstract.array(self.batch, length, 3)
        if self.cameras:
            control = abstract.camera(self.batch, length)
        keys = jax.eval_shape(clip_keys, jax.ShapeDtypeStruct((self.batch, 2), jnp.uint32))
        for memory in memories:
            self._clip[memory] = _compile(
                f"the sampler {'with its map' if memory else 'without a map'} "
                f"({steps}{self.batch} clips at once{many})",
                self._split(
                    jax.vmap(
                        functools.partial(rollout, self.config, memory=memory), (None, 0, 0, 0)
                    ),
                    3,
                ),
                (self.params, *self._placed((states, control, keys))),
                self._say,
            )

    def begin(self, context: Frames) -> WorldState:
        """Return the states that (B, S) observed frames lead to."""
        return self._prepare_start()(self.params, self._put(context))

    def run(
        self,
        context: Frames,
        control: Array | Camera,
        seeds_B2: np.ndarray,
        *,
        memory: bool,
        params: Params | None = None,
        watch: Callable[[WorldState], Any] | None = None,
    ) -> tuple[WorldState, WorldState, Frames]:
        """Imagine N = chain · (T − 1) frames for every clip of a batch.

        Args:
            context: (B, S) observed frames, the present last, colours uint8.
            control: the way from the present frame through the N frames: (B, N, 3) actions, or
                (B, N) cameras.
            seeds_B2: sampling seed and clip number; equal numbers give equal noise, in any batch,
                with or without the map.
            memory: whether to use the map or an empty one.
            params: other weights of the same shapes.
            watch: is given the states at the start and after every clip.

        Returns:
            ``(first, last, frames)``: the state before, the state after, (B, N) NumPy frames.
        """
        self.prepare([memory])
        assert self._begin is not None
        params = self.params if params is None else self._everywhere(params)
        first = state = self._begin(params, self._put(context))
        if watch is not None:
            watch(state)
        keys = clip_keys(jnp.asarray(seeds_B2, jnp.uint32))
        per_clip = self.config.model.clip.frames - 1
        made = []
        control = jax.tree.map(jnp.asarray, control)
        count = jax.tree.leaves(control)[0].shape[1]
        for first_frame in range(0, count, per_clip):
            part = jax.tree.map(lambda x, at=first_frame: x[:, at : at + per_clip], control)
            now = jax.vmap(jax.random.fold_in, (0, None))(keys, first_frame // per_clip)
            state, frames = self._clip[memory](params, state, self._put(part), self._put(now))
            if watch is not None:
                watch(state)
            made.append(jax.device_get(frames))
        return first, state, jax.tree.map(lambda *parts: np.concatenate(parts, 1), *made)

    def _prepare_start(self) -> Callable[..., WorldState]:
        begin = self._begin
        if begin is None:
            begin = self._begin = _compile(
                f"the start from {self.context} frames",
                self._split(self._start_batch, 1),
                (self.params, self._placed(self._abstract_context())),
                self._say,
            )
        return begin

    def _split(self, function: Callable, batched: int) -> Callable:
        """Return a function of weights and batches that each device calls with a part of them."""
        if self.mesh is None:
            return function
        parts = (P(), *[P("clips")] * batched)
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=parts, out_specs=P("clips"), check_vma=False
        )

    def _placed(self, tree: Any) -> Any:
        """Return shapes of batches with the devices that they are on."""
        if self.mesh is None:
            return tree
        where = NamedSharding(self.mesh, P("clips"))
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), tree
        )

    def _put(self, tree: Any) -> Any:
        """Put batches on the devices."""
        return jax.device_put(tree, NamedSharding(self.mesh, P("clips"))) if self.mesh else tree

    def _everywhere(self, params: Params) -> Params:
        """Put weights on every device."""
        if self.mesh is None:
            return jax.tree.map(jnp.asarray, params)
        return jax.device_put(params, NamedSharding(self.mesh, P()))

    def _start_batch(self, params: Params, context: Frames) -> WorldState:
        return jax.vmap(functools.partial(start, self.config), (None, 0))(params, context)

    def _abstract_context(self) -> Frames:
        clip = self.config.model.clip
        return abstract.frames(self.batch, self.context, height=clip.height, width=clip.width)


def mesh_of(devices: Sequence[Any], batch: int) -> Mesh | None:
    """Return the devices that a batch is split over, or None for the one that JAX takes.

    Args:
        devices: of this process.
        batch: clips; each device gets as many, so some may be left out.
    """
    count = max((n for n in range(1, len(devices) + 1) if batch % n == 0), default=1)
    if count < 2:
        return None
    return jax.make_mesh((count,), ("clips",), (AxisType.Auto,), devices=devices[:count])


def clip_keys(seeds_B2: Array) -> Array:
    """Return one random key per clip from (B, 2) integers: sampling seed, clip number."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed[0]), seed[1]))(seeds_B2)


def copy_last(context: Frames, count: int) -> Frames:
    """Repeat the present frame of every clip: the baseline that nothing changes."""
    return jax.tree.map(lambda array: np.repeat(np.asarray(array)[:, -1:], count, 1), context)


def _compile(name: str, function: Callable, arguments: tuple, say: Callable[[str], Any]) -> Any:
    say(f"compiling {name} …")
    began = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    say(f"compiled {name} in {time.perf_counter() - began:.1f} s")
    return compiled
