"""Tasks and worlds: what training needs to know of a model, and what a world can do.

A ``Task`` is what ``pewm-jax train`` trains: it has parameters, stages and a ``batch_spec`` that
names the recorded arrays its loss needs. A ``World`` is a task that also imagines frames. What
a world can do beyond that stands in its ``capabilities``. Everything outside a world's own package
(loader, training, evaluation, planning, viewer, export) asks the capabilities and the batch
specification, never the class.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from pewm_jax.config.clip import ActionConfig, ClipConfig
from pewm_jax.config.training import TrainSettings
from pewm_jax.registry import Settings

if TYPE_CHECKING:
    from pewm_jax.types import Array, Frames, Params, WorldState

PLANAR = 3
"""Numbers of a planar action: metres forward, metres left, radians to the left."""


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """The shape of one array of one clip, without the batch axis, and its dtype."""

    shape: tuple[int, ...]
    dtype: str = "float32"


@dataclasses.dataclass(frozen=True)
class BatchSpec:
    """The recorded arrays that a loss needs beside the clip's frames.

    Attributes:
        context: whether earlier frames of the episode are read, from which a memory is built.
        actions: numbers of an action that the loss needs; 0 if it needs none. Recorded actions are
            in the batch either way.
        extras: further recorded arrays by their names in ``types.Clip.extras``. The loader knows
            ``classes_TXYZ`` and ``origin_T3``; data without them give batches without them.
        features: cached image features of one context frame, where ``data.features`` names a cache;
            None if the loss uses none.
    """

    context: bool = True
    actions: int = 0
    extras: tuple[tuple[str, ArraySpec], ...] = ()
    features: ArraySpec | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the extras."""
        return tuple(name for name, _ in self.extras)


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """What a world can do.

    A command that needs a capability which a world lacks leaves that part out and says so, or
    refuses if nothing would remain.

    Attributes:
        memory: whether a state holds more than the present frame, so that ``imagine`` with
            ``memory=False`` differs.
        memory_parameters: the top-level name of the parameters that read the memory; a checkpoint
            without them was trained without a memory. Empty if the memory needs none.
        depth: whether imagined frames have depth.
        actions: whether planar actions (dx, dy, dyaw) steer it.
        cameras: whether cameras without actions steer it.
        points: whether ``memory_points`` lists the memory as coloured points.
        edits: whether ``erase`` and ``move`` change what is in a box of the memory.
        coverage: whether ``coverage`` tells which pixels the memory shows.
        stage_without_memory: whether a stage trains without the memory, so that a run without a
            memory can be compared.
        silent_actions: whether actions act through the parameters ``control``, which set to zero
            give a model that no action steers.
    """

    memory: bool = False
    memory_parameters: str = ""
    depth: bool = True
    actions: bool = True
    cameras: bool = True
    points: bool = False
    edits: bool = False
    coverage: bool = False
    stage_without_memory: bool = False
    silent_actions: bool = False


@dataclasses.dataclass(frozen=True)
class Facts:
    """What reports and model cards say of a task; empty text is left out.

    Attributes:
        memory: the kind of the memory.
        encoder: the kind of the image features that it keeps.
        reader: how the network reads it.
        positions: how the reader knows where its points are.
        capacity: the size of the memory, in words.
        room: how many points the memory can hold; 0 if there is no such number.
        cell_m: size of the memory's cells in metres, to draw it; empty if it has none.
        codec: the kind of the codec.
        control: the kind of the control.
        noise: the kind of the noise.
        sampler: the name of the sampler.
        guidance: its strength of guidance.
    """

    memory: str = ""
    encoder: str = ""
    reader: str = ""
    positions: str = ""
    capacity: str = ""
    room: int = 0
    cell_m: tuple[float, ...] = ()
    codec: str = ""
    control: str = ""
    noise: str = ""
    sampler: str = ""
    guidance: float = 1.0


class Task(Settings):
    """Base class of what is trained: its settings and its methods.

    Attributes:
        TRAIN: the class of its training settings: ``TrainSettings`` with a ``StageConfig`` field
            for each of the task's stages, named as the stage.
        TRAINS: parts that other tasks take from ``train.start`` and this one trains itself.
        INSTEAD: what a run of a task that imagines nothing did, and what to do with it, for error
            messages: "trained a codec alone, which imagines nothing: …".
        EXPORTED: whether ``export inference`` writes it with 16-bit weights.
        CARD: what its model card says of what it is and of its use, for tasks that are no world;
            ``{version}`` and ``{name}`` are filled in.
        clip: the shape of the clips that the loader reads.
        dtype: precision of computation and of frozen weights.
    """

    SECTION: ClassVar[str] = "world"
    TRAIN: ClassVar[type[TrainSettings]] = TrainSettings
    TRAINS: ClassVar[tuple[str, ...]] = ()
    INSTEAD: ClassVar[str] = "imagines nothing: use a run of a world model"
    EXPORTED: ClassVar[bool] = True
    CARD: ClassVar[tuple[str, str]] = ("", "")
    clip: ClipConfig = ClipConfig()
    dtype: Any = "float32"

    @property
    def batch_spec(self) -> BatchSpec:
        """Which recorded arrays the losses need."""
        return BatchSpec()

    @property
    def facts(self) -> Facts:
        """What reports and model cards say of it."""
        return Facts()

    @abc.abstractmethod
    def init(self, key: Array) -> Params:
        """Return random parameters of all networks: a pytree of arrays."""

    @abc.abstractmethod
    def stages(self) -> tuple[Any, ...]:
        """Return the stages of training in order (``pewm_jax.worlds.stages.Stage``).

        The settings of each are the field of its name in ``TRAIN``.
        """

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return (pattern, ``PartitionSpec``) over parameter paths, the first match wins.

        A spec, which may be a plain tuple, is aligned to a leaf's last axes. By default every
        device holds all parameters.
        """
        return ((r".*", ()),)

    def split_heads(self, stage: Any) -> dict[str, int]:
        """Return the numbers that ``train.mesh.tensor`` must divide, by the setting's name."""
        del stage
        return {}


class World(Task):
    """Base class of a world.

    A world overrides ``observe`` and ``imagine`` and the methods that its capabilities name. The
    methods are pure functions of arrays. ``pewm_jax.worlds`` has a function for each, which checks
    the arguments and compiles ``start``, ``observe``, ``imagine`` and ``imagine_many`` by
    ``jax.jit`` with the settings static.

    Attributes:
        actions: what one discrete action does to the agent.
        sample_steps: steps of the sampler, 0 without one.
    """

    actions: ActionConfig = ActionConfig()

    @property
    def capabilities(self) -> Capabilities:
        """What it can do."""
        return Capabilities()

    @property
    def sample_steps(self) -> int:
        """Steps of the sampler, 0 without one."""
        return 0

    def with_sample_steps(self, steps: int) -> World:
        """Return the same world with another number of the sampler's steps.

        Raises:
            ConfigError: the sampler cannot take so many.
        """
        del steps
        return self

    def start(self, params: Params, frames: Frames) -> WorldState:
        """Begin a world; by default, observe from a state whose memory is None.

        Args:
            params: the parameters.
            frames: S ≥ 1 frames (S, H, W, …), as for ``observe``; the last one is the present.
        """
        from pewm_jax.types import WorldState  # noqa: PLC0415 - reading settings needs no JAX

        return self.observe(params, WorldState(frames, None), frames)

    @abc.abstractmethod
    def observe(self, params: Params, state: WorldState, frames: Frames) -> WorldState:
        """Return the state after S ≥ 1 more observed frames (S, H, W, …); the last is the present.

        Args:
            params: the parameters.
            state: the state before; its memory is None where a world begins.
            frames: colours uint8, or float32 in [−1, 1] (``codecs.signals.as_signal`` converts
                them); depth in metres.

        Returns:
            The present frame (1, H, W, …), colours float32, with any pytree as its memory.
        """

    @abc.abstractmethod
    def imagine(
        self,
        params: Params,
        state: WorldState,
        control: Any,
        key: Array,
        *,
        remember: bool = True,
        memory: bool = True,
    ) -> tuple[WorldState, Frames]:
        """Imagine n ≥ 1 frames.

        Args:
            params: the parameters.
            state: the world so far.
            control: discrete actions (n,), planar ones (n, 3), a ``Camera`` (n,) or a ``Control``;
                ``worlds.control.control_of`` turns all of them into cameras and actions.
            key: randomness.
            remember: whether imagined frames enter the memory; if not, ``state.map`` is returned as
                it is.
            memory: False ignores the memory.

        Returns:
            The state whose present frame is the last one, and the n frames, colours float32 in
            [−1, 1]; depth is zero where ``capabilities.depth`` is False.
        """

    def imagine_many(
        self,
        params: Params,
        state: WorldState,
        controls: Any,
        keys: Array,
        *,
        memory: bool = True,
        last: bool = False,
    ) -> tuple[WorldState, Frames]:
        """Imagine K candidates from one state; by default, vmap ``imagine``.

        ``pewm_jax.worlds.imagine_many`` documents arguments and result. A world whose ``views``
        returns a function takes its result as the further argument ``views``.
        """
        import jax  # noqa: PLC0415 - reading settings does not need it

        from pewm_jax.types import WorldState  # noqa: PLC0415

        def candidate(control: Any, key: Array) -> tuple[Frames, Frames]:
            after, frames = self.imagine(params, state, control, key, remember=False, memory=memory)
            return after.frame, frames

        present, frames = jax.vmap(candidate)(controls, keys)
        frames = jax.tree.map(lambda x: x[:, -1:], frames) if last else frames
        return WorldState(present, state.map), frames

    def to_compare(self, state: WorldState) -> WorldState:
        """Return a state for ``imagine_many`` alone, whose memory may be smaller; not under jit."""
        return state

    def views(self, params: Params, state: WorldState) -> Callable[[Any], Any] | None:
        """Return a function from K controls to ``imagine_many``'s ``views``; not under jit.

        None where candidates have no views to share.
        """
        del params, state

    def memory_points(self, memory: Any) -> tuple[Array, Array, Array, Array | None]:
        """Return the memory as points, where ``capabilities.points`` says so.

        Returns:
            ``(points_V3, features_VF, valid_V, observed_V)``: positions in metres; features, which
            ``point_colours`` turns into colours; which of the V slots are used; and which points
            were observed, not imagined, or None if the memory does not tell.
        """
        raise NotImplementedError(f"{type(self).__name__} lists no points.")

    def point_colours(self, features_VF: Array) -> Array:
        """Return the (V, 3) colours in [−1, 1] of points; by default their first three features."""
        return features_VF[..., :3]

    def erase(self, params: Params, state: WorldState, box_23: Array) -> WorldState:
        """Forget what is in a box, where ``capabilities.edits`` says so.

        Args:
            params: the parameters.
            state: the world so far.
            box_23: lower and upper corner in the world, metres.

        Returns:
            The changed memory, and a present frame that shows the change.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be edited.")

    def move(
        self,
        params: Params,
        state: WorldState,
        box_23: Array,
        transform: Array,
        *,
        leave: bool = False,
    ) -> WorldState:
        """Move what is in a box by a rigid 4×4 transform; ``leave`` copies it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be edited.")

    def coverage(
        self, params: Params, state: WorldState, frames: Frames, seen_THW: Array
    ) -> dict[str, Array]:
        """Count the pixels that the memory covers, where ``capabilities.coverage`` says so.

        Args:
            params: the parameters.
            state: the world so far.
            frames: (T,) true frames of the next clip, the present one first.
            seen_THW: bool, the pixels that were seen before.

        Returns:
            Name → () number of pixels, among them ``seen``.
        """
        raise NotImplementedError(f"{type(self).__name__} counts no coverage.")
