"""Tasks and worlds: their settings, stages and capabilities, and the shape of a clip.

A ``Task`` is trained by ``pewm-jax train``: it has parameters, stages and a ``batch_spec`` that
names the recorded arrays its loss needs. A ``World`` is a task that also imagines frames; its
``capabilities`` say what else it can do. Code outside a world's own package (loader, training,
evaluation, planning, viewer, export) uses the capabilities and the batch specification, never the
class.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pewm_jax.config.training import TrainSettings
from pewm_jax.errors import require
from pewm_jax.registry import Settings

if TYPE_CHECKING:
    from pewm_jax.types import Array, Frames, Params, WorldState

PLANAR = 3
"""Numbers of a planar action: metres forward, metres left, radians to the left."""
SMALLEST = 12
"""Smallest side of a clip in pixels: the evaluation's SSIM uses a window of 11 pixels."""


@dataclasses.dataclass(frozen=True)
class ClipConfig:
    """The shape of a clip: the frames that are imagined at once."""

    frames: int = 9
    """Frames of a clip: the first is observed, the rest are generated. The codec folds them in
    time: with `codec.temporal` 4, use 4k + 1 frames."""
    height: int = 64
    """Image height in pixels."""
    width: int = 64
    """Image width in pixels."""
    near_m: float = 0.1
    """Depth that maps to −1, metres; nearer depths are clipped."""
    far_m: float = 12.0
    """Depth that maps to +1, metres; farther depths are clipped."""
    depth_scale: Literal["linear", "log"] = "log"
    """How metres map to [−1, 1] between near and far."""
    depth: bool = True
    """Whether the denoiser generates depth; without it only observed frames can be remembered."""

    def __post_init__(self):
        """Validate."""
        require(
            self.frames >= 2,
            f"clip.frames is {self.frames}: a clip has an observed frame and at least one to be "
            "imagined; use 9.",
        )
        require(
            0 < self.near_m < self.far_m,
            f"clip.near_m {self.near_m} and clip.far_m {self.far_m}: near must be above 0 and "
            "below far.",
        )
        require(
            min(self.height, self.width) >= SMALLEST,
            f"clip.height {self.height} and clip.width {self.width} must be at least {SMALLEST} "
            "pixels: the structural similarity of the evaluation uses a window of 11; "
            "use 16 or more.",
        )


@dataclasses.dataclass(frozen=True)
class ActionConfig:
    """The effect of one discrete action on the agent."""

    step_m: float = 0.25
    """Length of one forward step, metres."""
    turn_deg: float = 30.0
    """Angle of one turn, degrees."""

    def __post_init__(self):
        """Validate."""
        require(self.step_m > 0, f"actions.step_m is {self.step_m}: it must be above 0 metres.")
        require(
            0 < self.turn_deg <= 180,
            f"actions.turn_deg is {self.turn_deg}: use an angle above 0 and up to 180 degrees.",
        )


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
        extras: further recorded arrays by their names in ``types.Clip.extras``. The loader supports
            ``classes_TXYZ`` and ``origin_T3``, which are absent if the data do not have them, and
            ``state_A``, without which data are refused.
        features: cached image features of one context frame, where ``data.features`` names a cache;
            None if the loss uses none.
        depth: whether recorded depth is needed.
        poses: whether the recorded poses of the camera are needed.
    """

    context: bool = True
    actions: int = 0
    extras: tuple[tuple[str, ArraySpec], ...] = ()
    features: ArraySpec | None = None
    depth: bool = True
    poses: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the extras."""
        return tuple(name for name, _ in self.extras)


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """The capabilities of a world.

    A command that needs a missing capability reports and omits that part, or refuses the world if
    nothing would remain.

    Attributes:
        memory: whether a state holds more than the present frame, so that ``imagine`` with
            ``memory=False`` differs.
        memory_parameters: the top-level name of the parameters that read the memory; a checkpoint
            without them was trained without a memory. Empty if the memory needs none.
        depth: whether imagined frames have depth.
        actions: whether planar actions (dx, dy, dyaw) steer it.
        cameras: whether cameras without actions steer it.
        points: whether ``memory_points`` lists the memory as coloured points.
        edits: whether ``erase`` and ``move`` change the content of a box of the memory.
        coverage: whether ``coverage`` counts the pixels that the memory covers.
        stage_without_memory: whether a stage trains without the memory, so that a run without a
            memory can be compared.
        silent_actions: whether actions act through the parameters ``control``, so that a model
            whose ``control`` is zero ignores actions.
        voxels: whether its state is a grid of class ids (``memory.class_grid``), which is compared
            with recorded grids.
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
    voxels: bool = False


METHODS = {"edits": ("erase", "move"), "points": ("memory_points",), "coverage": ("coverage",)}
"""Capability → the methods of ``World`` that a world with it must override."""


def require_capabilities(world: World) -> None:
    """Refuse a world whose capabilities are of another type, or name methods that it lacks."""
    found, name = world.capabilities, type(world).__name__
    require(
        isinstance(found, Capabilities),
        f"{name}.capabilities is a {type(found).__name__}: set it to "
        "pewm_jax.config.Capabilities(…), or make it a property that returns one.",
    )
    for capability, methods in METHODS.items():
        declared = getattr(found, capability)
        missing = [m for m in methods if declared and getattr(type(world), m) is getattr(World, m)]
        require(
            not missing,
            f"{name}.capabilities has {capability}=True, and {name} has no method "
            f"{' and '.join(missing)}: add it, or set {capability}=False.",
        )


@dataclasses.dataclass(frozen=True)
class Facts:
    """Properties of a task for reports and model cards; empty text is left out.

    Attributes:
        memory: the kind of the memory.
        encoder: the kind of its image features.
        reader: how the network reads it.
        positions: the encoding of its points' positions.
        capacity: the size of the memory, in words.
        room: the number of points the memory can hold; 0 if there is no such number.
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
    """Base class of trained models: their settings and methods.

    Attributes:
        TRAIN: the class of its training settings: ``TrainSettings`` with a ``StageConfig`` field
            for each of the task's stages, named as the stage.
        TRAINS: parts that other tasks take from ``train.start`` and this one trains itself.
        INSTEAD: for error messages about a task that imagines nothing: the purpose of its run, and
            how to use it: "trained a codec alone, which imagines nothing: …".
        EXPORTED: whether ``export inference`` writes it with 16-bit weights.
        CARD: description and use in the model card of a task that is not a world; ``{version}`` and
            ``{name}`` are filled in.
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
        """The recorded arrays that the losses need."""
        return BatchSpec()

    @property
    def facts(self) -> Facts:
        """Properties for reports and model cards."""
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

    A world overrides ``observe`` and ``imagine`` and the methods of its capabilities (``METHODS``).
    The methods are pure functions of arrays. ``pewm_jax.worlds`` has a function for each, which
    checks the arguments and compiles ``start``, ``observe``, ``imagine`` and ``imagine_many`` by
    ``jax.jit`` with the settings static.

    Attributes:
        actions: the effect of one discrete action on the agent.
        sample_steps: steps of the sampler, 0 without one.
    """

    actions: ActionConfig = ActionConfig()

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of the world."""
        return Capabilities()

    @property
    def sample_steps(self) -> int:
        """Steps of the sampler, 0 without one."""
        return 0

    def with_sample_steps(self, steps: int) -> World:
        """Return the same world with another number of the sampler's steps.

        Raises:
            ConfigError: the sampler does not support that number.
        """
        del steps
        return self

    def start(self, params: Params, frames: Frames) -> WorldState:
        """Begin a world from S ≥ 1 frames; by default, ``observe`` them without a memory."""
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
        """Imagine n ≥ 1 frames; ``pewm_jax.worlds.imagine`` documents arguments and result.

        ``worlds.control.control_of`` turns every form of control into cameras and actions. If
        ``remember`` is False, ``state.map`` is returned as it is. Depth is zero where
        ``capabilities.depth`` is False.
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
        returns a function also takes ``views``, the result of that function.
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
        """Return the memory as points, for the capability ``points``.

        Returns:
            ``(points_V3, features_VF, valid_V, observed_V)``: positions in metres; features, which
            ``point_colours`` turns into colours; which of the V slots are used; and which points
            were observed, not imagined, or None if the memory does not distinguish them.
        """
        raise NotImplementedError(f"{type(self).__name__} lists no points.")

    def point_colours(self, features_VF: Array) -> Array:
        """Return the (V, 3) colours in [−1, 1] of points; by default their first three features."""
        return features_VF[..., :3]

    def erase(self, params: Params, state: WorldState, box_23: Array) -> WorldState:
        """Erase the content of a box, for the capability ``edits``.

        ``box_23`` is the lower and upper corner in the world, metres. The memory changes, and so
        does the present frame.
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
        """Move the content of a box by a rigid 4×4 transform; ``leave`` copies it."""
        raise NotImplementedError(f"{type(self).__name__} cannot be edited.")

    def coverage(
        self, params: Params, state: WorldState, frames: Frames, seen_THW: Array
    ) -> dict[str, Array]:
        """Count the pixels that the memory covers, for the capability ``coverage``.

        Args:
            params: the parameters.
            state: the world so far.
            frames: (T,) true frames of the next clip, the present one first.
            seen_THW: bool, the pixels that were seen before.

        Returns:
            Name → () number of pixels, among them ``seen``.
        """
        raise NotImplementedError(f"{type(self).__name__} counts no coverage.")
