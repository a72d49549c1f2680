"""Imagine batches of clips by every method: a compiled model and the baselines.

============= ====================================================================================
memory        the model with its map
empty         the same weights with an empty map
model         instead of both, a model that was trained without a memory
none          another model, trained for as many steps without a memory (optional)
reproject     no network: observed pixels, rendered from the present camera
copy          no network: the last observed frame, repeated
============= ====================================================================================

``ModelRunner`` compiles ahead of time and uses one device or several.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from pewm_jax.config import Config, UserError
from pewm_jax.data import abstract
from pewm_jax.eval.clips import later_control
from pewm_jax.eval.reproject import ReprojectSettings, reproject_batch
from pewm_jax.io.store import Workers
from pewm_jax.report.labels import OWN_METHODS
from pewm_jax.train import processes
from pewm_jax.types import Array, Camera, Control, Frames, Params, WorldState
from pewm_jax.worlds import start
from pewm_jax.worlds.rollouts import rollout


def workers() -> Workers:
    """Return the processes of this job, among which an evaluation's work is divided."""
    return Workers(
        jax.process_count(),
        jax.process_index(),
        lambda what: processes.barrier(f"evaluate: {what}"),
    )


def print_now(line: str) -> None:
    """Print a line without buffering, even if the output is not a terminal."""
    print(line, flush=True)


class ModelRunner:
    """Imagines batches of clips of one size with a model; functions are compiled on first use.

    Args:
        config: the experiment (static).
        params: weights.
        batch: number of clips sampled at once.
        context: number of observed frames from which a state is started.
        cameras: whether clips are driven by cameras (six degrees of freedom) instead of planar
            actions; a world whose actions are not planar is driven by both, as recorded.
        devices: devices of this process, over which a batch is split, as many of them as divide it;
            by default one.
        log: prints what is being compiled, and how long it took.
    """

    def __init__(
        self,
        config: Config,
        params: Params,
        batch: int,
        context: int,
        log: Callable[[str], Any] = print_now,
        *,
        cameras: bool = False,
        devices: Sequence[Any] = (),
    ):
        self.cameras = cameras
        self.config, self.batch, self.context = config, batch, context
        self.mesh = mesh_of(devices, batch)
        self.params = self._replicate(params)
        self._log = log
        self._begin: Callable[..., WorldState] | None = None
        self._clip: dict[bool, Callable[..., tuple[WorldState, Frames]]] = {}

    def prepare(self, memories: Iterable[bool]) -> None:
        """Compile ``start``, and the sampler with (True) or without (False) its map.

        Nothing is compiled twice, and nothing if ``memories`` is empty.
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
        control = abstract.control(self.config.model, self.batch, length)
        if self.cameras and not isinstance(control, Control):
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
                (self.params, *self._with_shardings((states, control, keys))),
                self._log,
            )

    def begin(self, context: Frames) -> WorldState:
        """Return the states after (B, S) observed frames."""
        return self._prepare_start()(self.params, self._put(context))

    def run(
        self,
        context: Frames,
        control: Array | Camera | Control,
        seeds_B2: np.ndarray,
        *,
        memory: bool,
        params: Params | None = None,
        watch: Callable[[WorldState], Any] | None = None,
    ) -> tuple[WorldState, WorldState, Frames]:
        """Imagine N = chain · (T − 1) frames for every clip of a batch.

        Args:
            context: (B, S) observed frames, the present last, colours uint8.
            control: from the present frame through the N frames: (B, N, 3) actions, (B, N)
                cameras, or both with actions of another kind; see ``clips.load_clip``.
            seeds_B2: sampling seed and clip number; equal values give equal noise, in any batch,
                with or without the map.
            memory: whether to use the map or an empty one.
            params: other weights of the same shapes.
            watch: called with the states at the start and after every clip.

        Returns:
            ``(first, last, frames)``: the state before, the state after, (B, N) NumPy frames.
        """
        self.prepare([memory])
        assert self._begin is not None
        params = self.params if params is None else self._replicate(params)
        first = state = self._begin(params, self._put(context))
        if watch is not None:
            watch(state)
        keys = clip_keys(jnp.asarray(seeds_B2, jnp.uint32))
        per_clip = self.config.model.clip.frames - 1
        made = []
        control = jax.tree.map(jnp.asarray, control)
        count = jax.tree.leaves(control)[0].shape[1]
        for first_frame in range(0, count, per_clip):
            if isinstance(control, Control):
                part = later_control(control, first_frame, per_clip)
            else:
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
                (self.params, self._with_shardings(self._abstract_context())),
                self._log,
            )
        return begin

    def _split(self, function: Callable, batched: int) -> Callable:
        """Return a function of weights and batches that is sharded over the devices."""
        if self.mesh is None:
            return function
        parts = (P(), *[P("clips")] * batched)
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=parts, out_specs=P("clips"), check_vma=False
        )

    def _with_shardings(self, tree: Any) -> Any:
        """Return abstract batches with their shardings."""
        if self.mesh is None:
            return tree
        where = NamedSharding(self.mesh, P("clips"))
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), tree
        )

    def _put(self, tree: Any) -> Any:
        """Put batches on the devices."""
        return jax.device_put(tree, NamedSharding(self.mesh, P("clips"))) if self.mesh else tree

    def _replicate(self, params: Params) -> Params:
        """Replicate weights on every device."""
        if self.mesh is None:
            return jax.tree.map(jnp.asarray, params)
        return jax.device_put(params, NamedSharding(self.mesh, P()))

    def _start_batch(self, params: Params, context: Frames) -> WorldState:
        return jax.vmap(functools.partial(start, self.config), (None, 0))(params, context)

    def _abstract_context(self) -> Frames:
        clip = self.config.model.clip
        return abstract.frames(self.batch, self.context, height=clip.height, width=clip.width)


def mesh_of(devices: Sequence[Any], batch: int) -> Mesh | None:
    """Return the mesh over which a batch is split, or None for JAX's default device.

    The batch is split equally, so some devices may be unused.
    """
    count = max((n for n in range(1, len(devices) + 1) if batch % n == 0), default=1)
    if count < 2:
        return None
    return jax.make_mesh((count,), ("clips",), (AxisType.Auto,), devices=devices[:count])


def clip_keys(seeds_B2: Array) -> Array:
    """Return one PRNG key per clip from (B, 2) integers: sampling seed, clip number."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed[0]), seed[1]))(seeds_B2)


def copy_last(context: Frames, count: int) -> Frames:
    """Repeat the present frame of every clip: the baseline in which nothing changes."""
    return jax.tree.map(lambda array: np.repeat(np.asarray(array)[:, -1:], count, 1), context)


def _compile(name: str, function: Callable, arguments: tuple, log: Callable[[str], Any]) -> Any:
    log(f"compiling {name} …")
    began = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    log(f"compiled {name} in {time.perf_counter() - began:.1f} s")
    return compiled


METHODS = ("memory", "empty", "model", "none", "reproject", "copy")
"""All methods, in the order of the tables."""
SAMPLED = ("memory", "empty", "model", "none")
"""Methods that sample noise, and so are scored with every seed."""


@dataclasses.dataclass(frozen=True)
class Methods:
    """The methods of one evaluation; ``none`` is a model trained without a memory.

    ``reproject`` is None if the data have no depth or no poses.
    """

    model: ModelRunner
    reproject: ReprojectSettings | None
    none: ModelRunner | None = None
    none_weights: str = ""
    remembers: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """Return the available methods."""
        left_out = {"model"} if self.remembers else {"memory", "empty"}
        left_out |= {"none"} if self.none is None else set()
        left_out |= {"reproject"} if self.reproject is None else set()
        return tuple(name for name in METHODS if name not in left_out)

    def piece(self, method: str) -> str:
        """Return the method's name in partial results, which includes what its scores depend on."""
        extra = {"none": self.none_weights[:16]}
        extra |= {"reproject": self.reproject.name} if self.reproject else {}
        return "-".join(filter(None, (method, extra.get(method))))

    def seeds(self, method: str, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Return the sampling seeds that a method is scored with."""
        return seeds if method in SAMPLED else (0,)

    def prepare(self, methods: Iterable[str]) -> None:
        """Compile the functions of some methods."""
        methods = set(methods)
        known = ("empty", "memory", "model")
        self.model.prepare([name in OWN_METHODS for name in known if name in methods])
        if self.none is not None and "none" in methods:
            self.none.prepare([False])

    def imagine(
        self,
        method: str,
        context: Frames,
        control: Array | Camera | Control,
        camera: Camera,
        seeds_B2: np.ndarray,
        watch: Callable[[Any], Any] | None = None,
    ) -> tuple[Any, Any, Frames]:
        """Imagine N frames for every clip of a batch by one of ``names``; see ``ModelRunner.run``.

        ``camera`` are the (B, N) cameras of the frames, according to the control. Methods without a
        network have no states before and after: None.

        Raises:
            UserError: the model's output is not finite.
        """
        if method == "copy":
            return None, None, copy_last(context, camera.intrinsics_4.shape[1])
        if method == "reproject" and self.reproject is not None:
            return None, None, reproject_batch(self.reproject, context, camera)
        given: dict[str, Any] = {} if watch is None else {"watch": watch}
        model = self.none if method == "none" and self.none is not None else self.model
        first, last, frames = model.run(
            context, control, seeds_B2, memory=method in OWN_METHODS, **given
        )
        if not all(np.isfinite(leaf).all() for leaf in (frames.rgb_THWC, frames.depth_THW)):
            raise UserError(
                "the model imagines values that are not finite: its weights are damaged or its "
                "training diverged; train it again."
            )
        return first, last, frames
