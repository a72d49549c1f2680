"""The interfaces of a model's parts: backbone, codec, control, encoder, reader, memory, noise.

A part is a frozen dataclass derived from one of these classes. Its fields are its settings, its
methods are its functions: ``model.codec.encode(params, video)``. All methods are pure functions of
their arguments. ``model`` is the ``AssembledModel`` that the part belongs to; ``params`` are the
part's own parameters, plain nested dictionaries, unless a method says otherwise. ``init`` returns
random ones, {} if the part has none. ``SHARDING`` lists rules ``(pattern, PartitionSpec)`` over the
paths of the parameters in the world model, such as ``codec/encoder/kernel``; every parameter needs
a rule. Array axes have the letters of ``pewm_jax.types``.

``pewm_jax.registry.register`` registers a class. This module imports no network and not JAX, so
that reading settings stays fast.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.registry import Settings, part

if TYPE_CHECKING:
    import numpy as np

    from pewm_jax.types import (
        Array,
        Camera,
        Control,
        Frames,
        MapTokens,
        MemoryReadout,
        Params,
        View,
    )

Rules: TypeAlias = tuple[Any, ...]
"""Sharding rules: pairs of a regular expression and a ``PartitionSpec``."""


@dataclasses.dataclass(frozen=True)
class InjectionPoints:
    """Where a memory reader runs in a backbone, and the sizes it needs.

    Attributes:
        count: how often it runs; its parameters are stacked along this axis.
        width: D, channels of the hidden video tokens (B, N, D).
        time: E, channels of the time embedding (B, E).
        patch: latent cells per token, along height and along width.
        patch_t: latent frames per token.
        cell_width: channels of the embedded input at every latent cell, to which a reader may add;
            0 where the input is embedded as tokens alone.
    """

    count: int
    width: int
    time: int
    patch: int = 1
    patch_t: int = 1
    cell_width: int = 0


class Backbone(Settings):
    """A denoiser: predicts the noise's target from noisy latents.

    Attributes:
        places: the ``InjectionPoints`` of memory readers; None without any.
        time_dim: E, channels of the time embedding, to which a control may add.
        text_shape: (length, channels) of its text tokens; None if it takes none.
        stores_prompt: whether a prompt's embedding is stored with the weights.
        extra_tokens: whether further tokens may follow those of the text.
        split_heads: a number that ``train.mesh.tensor`` must divide.
        remat: whether the backward pass recomputes activations.
        SHARDING: rules over ``backbone/…`` paths.
        GUIDED_BY_TEXT: whether guidance of a world without a memory is on the text, against
            another prompt, and not on the observed image.
    """

    SECTION: ClassVar[str] = "backbone"
    SHARDING: ClassVar[Rules] = ()
    GUIDED_BY_TEXT: ClassVar[bool] = False
    places: Any = None
    text_shape: Any = None
    stores_prompt: Any = False
    extra_tokens: Any = False
    split_heads: Any = 1
    remat: Any = False

    @property
    def time_dim(self) -> int:
        """Channels of the time embedding, by default those of the injection points."""
        return self.places.time

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters for these numbers of input and output channels."""
        raise NotImplementedError

    def apply(
        self, params: Params, x_BthwC: Array, time_B: Array, conditioning: Any, readers: Any
    ) -> Array:
        """Predict the noise's target from noisy latents.

        Args:
            params: its parameters.
            x_BthwC: (B, t, h, w, C) noisy latents; their dtype is the dtype of the computation.
            time_B: (B,) noise level in the network's units, or (B, t), one per latent frame.
            conditioning: a ``models.interface.Conditioning``: further inputs.
            readers: a ``models.interface.Readers``: how the memory is read.

        Returns:
            (B, t, h, w, C_out) prediction.
        """
        raise NotImplementedError

    def init_image(self, key: Array) -> Params:
        """Return random parameters of its image encoder, which is frozen; {} if it has none."""
        del key
        return {}

    def observed(self, model: Any, params: Params, seen: Any) -> Any:
        """Return the ``Conditioning`` that holds the observed frames, or None for the default.

        By default their latents are joined to the input, zero for the frames to be imagined.
        ``params`` are the world model's; those under ``image`` are from ``init_image``. ``seen`` is
        a ``models.interface.Observed``.
        """
        del model, params, seen

    def shown_channels(self, model: Any) -> int:
        """Return the number of input channels of the observed frames: those of their latents."""
        return model.codec.channels

    def check(self, model: Any) -> None:
        """Refuse latents that do not split into the backbone's patches."""
        if self.places is None:
            return
        step = model.codec.spatial * self.places.patch
        clip = model.clip
        require(
            clip.height % step == 0 and clip.width % step == 0,
            f"clip {clip.height}×{clip.width}: height and width must be multiples of "
            f"codec.spatial × backbone.patch = {step}; change the clip's size or the patch.",
        )


class Codec(Settings):
    """Pixels to latents and back; q·k + 1 frames become k + 1 latent frames.

    Colour and depth are encoded separately and their channels concatenated.

    Attributes:
        spatial: pixels per latent cell, along height and along width.
        temporal: q, frames per latent frame after the first.
        rgb_channels: latent channels of colour.
        depth_channels: latent channels of depth; 0 where it encodes colour alone.
        framewise: whether every latent frame is decoded by itself.
        SHARDING: rules over ``codec/…`` paths.
        DEPTH_AS_GREY: whether depth is encoded as a grey image of three channels, not as one.
        PIXELWISE: whether each latent channel of depth is one pixel of one frame.
        CONVERTED: whether the weights are frozen and come from ``train.start``.
    """

    SECTION: ClassVar[str] = "codec"
    SHARDING: ClassVar[Rules] = ()
    DEPTH_AS_GREY: ClassVar[bool] = False
    PIXELWISE: ClassVar[bool] = False
    CONVERTED: ClassVar[bool] = False
    spatial: Any
    temporal: Any
    rgb_channels: Any
    depth_channels: Any

    @property
    def channels(self) -> int:
        """Latent channels of colour and depth together."""
        return self.rgb_channels + self.depth_channels

    @property
    def framewise(self) -> bool:
        """Whether every latent frame is one frame, decoded by itself."""
        return self.temporal == 1

    def frames(self, count: int) -> int:
        """Return the number of latent frames for a number of frames."""
        return (count - 1) // self.temporal + 1

    def latent_shape(self, clip: Any) -> tuple[int, int, int]:
        """Return (t, h, w) of the latents of a ``ClipConfig``'s clip."""
        return self.frames(clip.frames), clip.height // self.spatial, clip.width // self.spatial

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        del key
        return {}

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video.

        Args:
            params: its parameters.
            video_BTHWC: (B, q·k + 1, H, W, C) float in [−1, 1]; C is 3 where depth is encoded as
                grey.
            condition: whether the latents condition the denoiser. CogVideoX-1.5's image-to-video
                model divides such latents by the scaling factor; others multiply.

        Returns:
            (B, k + 1, H/s, W/s, C') latents.

        Raises:
            ValueError: the video's size cannot be encoded.
        """
        raise NotImplementedError

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode (B, k + 1, h, w, C') latents to a (B, q·k + 1, h·s, w·s, C) video.

        Raises:
            UserError: the number of latent frames cannot be decoded.
        """
        raise NotImplementedError

    def measured(self, depth_BTHW: Array) -> Array | None:
        """Return the share of measured pixels per depth latent, or None for the default."""
        del depth_BTHW
        return None

    def check(self, model: Any) -> None:
        """Refuse clips whose size cannot be encoded, and depth that is not encoded."""
        clip, q, s = model.clip, self.temporal, self.spatial
        require(
            (clip.frames - 1) % q == 0,
            f"clip.frames is {clip.frames}: the codec folds every {q} frames after the first into "
            f"one (codec.temporal), so use {q}k + 1 frames ({q + 1}, {2 * q + 1}, …).",
        )
        require(
            clip.height % s == 0 and clip.width % s == 0,
            f"clip {clip.height}×{clip.width}: height and width must be multiples of "
            f"codec.spatial = {s}.",
        )
        require(
            self.depth_channels > 0 or not clip.depth,
            "clip.depth is true, and this codec encodes colour alone: use clip.depth false, or a "
            "codec that encodes depth too.",
        )


class Conditioner(Settings):
    """Turns the control of a clip (cameras, actions) into inputs of the denoiser.

    Attributes:
        MODULATES: whether it adds to the time embedding of each latent frame.
        SHARDING: rules over ``control/…`` paths.
        actions: A, the numbers of an action that it needs; 0 where cameras are enough.
        state: numbers of the agent's state at the last observed frame that it needs; 0 for none.
        body: the body whose degrees of freedom the actions are; "" for none that is known.
        rate: factor of the learning rate of its parameters.
    """

    SECTION: ClassVar[str] = "control"
    SHARDING: ClassVar[Rules] = ()
    MODULATES: ClassVar[bool] = False
    actions: Any = 0
    state: Any = 0
    body: Any = ""
    rate: Any = 1.0

    @property
    def sees_cameras(self) -> bool:
        """Whether the poses of a clip's cameras reach the denoiser."""
        return not self.actions

    @property
    def only_embeds(self) -> bool:
        """Whether actions reach the denoiser through the control's parameters alone."""
        return bool(self.actions)

    def channels(self, model: Any) -> int:
        """Return the channels, at the latent rate, that it adds to the denoiser's input."""
        del model
        return 0

    def still(self, action_A: Array) -> Array:
        """Return the action (..., A) of an agent that stands still after another action: zeros."""
        return 0 * action_A

    def init(self, model: Any, key: Array) -> Params:
        """Return random parameters."""
        del model, key
        return {}

    def condition(self, model: Any, params: Params, observed: Frames, control: Control) -> Any:
        """Return the ``models.interface.Conditioning`` of a batch of clips.

        Args:
            model: the model.
            params: its parameters.
            observed: (B, 1) the observed first frames, colours in [−1, 1]; or more of them.
            control: (B, T) cameras, (B, T − 1) actions and (B, A) states if there are any.
        """
        raise NotImplementedError


class Encoder(Settings):
    """An image encoder, whose features a memory keeps.

    Attributes:
        channels: F, number of features of a patch.
        SHARDING: rules over ``encoder/…`` paths.
        CONVERTED: whether the weights are frozen and come from ``train.start``.
        WEIGHTS: the part of the model whose parameters it uses: its own, or the ``codec``'s. An
            encoder of the second kind overrides ``features`` and has no ``encode``.
    """

    SECTION: ClassVar[str] = "encoder"
    SHARDING: ClassVar[Rules] = ()
    CONVERTED: ClassVar[bool] = False
    WEIGHTS: ClassVar[str] = "encoder"
    channels: Any

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches of a ``ClipConfig``'s frame."""
        raise NotImplementedError

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        del key
        return {}

    def encode(self, params: Params, rgb_THWC: Array) -> Array:
        """Return (T, h, w, F) patch features of (T, H, W, 3) colours in [−1, 1]."""
        raise NotImplementedError

    def features(self, model: Any, params: Params, rgb_THWC: Array) -> Array:
        """Return the features (T, h, w, F) that the model's memory keeps of (T, H, W, 3) colours.

        ``params`` are the world model's.
        """
        del model
        return self.encode(params.get("encoder", {}), rgb_THWC)

    def weights(self, params: Params) -> Params:
        """Return those of the world model's parameters that ``features`` uses."""
        return {self.WEIGHTS: params[self.WEIGHTS]} if self.WEIGHTS in params else {}

    def require_own(self, what: str) -> None:
        """Refuse an encoder with another part's parameters, because its features ``what``."""
        if self.WEIGHTS != "encoder":
            raise UserError(
                f"memory.encoder takes the weights of the {self.WEIGHTS}: its features {what}; "
                "use encoder.features(model, params, colours)."
            )

    def preprocessing(self) -> dict[str, Any]:
        """Return plain values that identify a cache of features, besides the weights."""
        raise NotImplementedError

    def colours(self, features_VF: np.ndarray) -> np.ndarray:
        """Return (V, 3) colours in [−1, 1] to draw features in: their principal components."""
        import numpy as np  # noqa: PLC0415 - reading settings does not need it

        values = np.asarray(features_VF, np.float32)
        centred = values - values.mean(0)
        _, _, axes = np.linalg.svd(centred, full_matrices=False)
        found = centred @ axes[:3].T
        return np.tanh(found / np.maximum(found.std(0), 1e-6))


class Reader(Settings):
    """How the denoiser reads the memory.

    Attributes:
        SHARDING: rules over ``memory/…`` paths.
        READS_TOKENS: whether it takes ``tokens`` of a ``MemoryReadout``: the points that a clip's
            cameras see.
        READS_VIEW: whether it takes ``view``: the memory rendered for them.
        READS_LATENTS: whether it takes ``encoded`` instead: the rendering as latents of the codec.
        split_heads: a number that ``train.mesh.tensor`` must divide.
    """

    SECTION: ClassVar[str] = "reader"
    SHARDING: ClassVar[Rules] = ()
    READS_TOKENS: ClassVar[bool] = True
    READS_VIEW: ClassVar[bool] = False
    READS_LATENTS: ClassVar[bool] = False
    split_heads: Any = 1

    def init(self, model: Any, key: Array) -> Params:
        """Return random parameters with which the reader has no effect yet."""
        raise NotImplementedError

    def prepare(
        self, model: Any, params: Params, readout: MemoryReadout, camera: Camera, rays_BthwC: Array
    ) -> Any:
        """Return the ``models.interface.Readers`` that the backbone calls for a batch of clips.

        Args:
            model: the model.
            params: its parameters.
            readout: the memory's readout of each clip, leading axis B, with the parts that the
                class attributes name.
            camera: (B, T) cameras of the clips.
            rays_BthwC: their Plücker rays at the latent rate (``controls.camera.rays``).
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Memory(Settings):
    """The content of a world's memory, its features, and its reader.

    The state of a memory is a pytree of static size, of the type that ``empty`` returns. The
    methods are pure and handle one world: jit and vmap them.

    Attributes:
        KEEPS_FEATURES: whether it keeps features of the image encoder; else the first three
            features of a point are its colour.
        REMEMBERS: whether it can hold anything.
        READ_BY_BLOCKS: whether trained memory blocks read it; else it is the state of its world.
        CLASSES: whether it holds class ids of recorded voxels (``kinds``, ``colours``,
            ``pictures``).
        EDITABLE: whether ``erase`` and ``move`` work.
        GRID_TOLERANCE: the distance, in cells, within which a point counts as held in coverage.
    """

    SECTION: ClassVar[str] = "memory"
    SHARDING: ClassVar[Rules] = ()
    KEEPS_FEATURES: ClassVar[bool] = True
    REMEMBERS: ClassVar[bool] = True
    READ_BY_BLOCKS: ClassVar[bool] = True
    CLASSES: ClassVar[bool] = False
    EDITABLE: ClassVar[bool] = False
    GRID_TOLERANCE: ClassVar[int] = 0

    cell_m: tuple[float, float, float] = (0.25, 0.25, 1.0)
    """Size of a map cell along x, y, z (z is up), metres; the default is the paper's."""
    cells: tuple[int, int, int] = (128, 128, 16)
    """Cells of the grid along x, y, z; the extent in metres is cells × cell size. A larger extent
    needs no more memory."""
    capacity: int = 4096
    """Occupied cells that a map can hold; cells that do not fit are dropped and counted."""
    tokens: int = 512
    """Map tokens that condition one clip."""
    choose: Literal["visible", "nearest"] = "visible"
    """Order of tokens: those visible from the clip's cameras first, each frame and each part of its
    image in turn, occluded ones later; or the nearest in view, occluded or not."""
    imagined_far: float = 0.95
    """Imagined surfaces beyond this share of `clip.far_m` are not inserted."""
    imagined_edge: float = 0.2
    """Imagined pixels whose depth differs by more than this share from that of a neighbouring pixel
    are not inserted: they lie on an edge. 0 inserts them."""
    encoder: Encoder = part("encoder", "patch_colours")
    """The image encoder, whose features are kept."""
    reader: Reader = part("reader", "attend")
    """The reader: how the denoiser reads the memory."""

    @property
    def extent_m(self) -> float:
        """The longest side of the grid in metres."""
        return max(size * count for size, count in zip(self.cell_m, self.cells, strict=True))

    @property
    def room(self) -> int:
        """The number of points it can hold."""
        return self.capacity

    @property
    def rendered_channels(self) -> int:
        """Channels of the rendered memory: the colour, or the features that are kept."""
        return self.encoder.channels if self.KEEPS_FEATURES else 3

    @property
    def grid(self) -> Memory:
        """The settings of the grid of its points."""
        return self

    def empty(self, model: Any, centre_3: Array) -> Any:
        """Return an empty memory centred on a world position (3,), metres."""
        raise NotImplementedError

    def insert(
        self,
        model: Any,
        params: Params,
        memory: Any,
        frames: Frames,
        features_ThwF: Array,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> Any:
        """Return the memory after T more frames.

        Args:
            model: the model.
            params: the world model's parameters, for memories whose update is learned.
            memory: from ``empty`` or from an earlier call.
            frames: T frames, colours float in [−1, 1]; pixels without depth are ignored.
            features_ThwF: (T, h, w, F) their patch features (``Encoder.features``).
            valid_T: (T,) bool; False frames are ignored.
            observed: False where the frames were imagined.
        """
        del model, params, memory, frames, features_ThwF, valid_T, observed
        raise UserError(
            f"the memory {type(self).__name__} takes no frames by itself: use pewm_jax.start and "
            "pewm_jax.observe."
        )

    def read(self, model: Any, memory: Any, camera: Camera) -> MapTokens:
        """Return the M = ``tokens`` tokens that condition one clip of (T,) cameras."""
        del model, memory, camera
        raise UserError(f"the memory {type(self).__name__} has no tokens that could be read.")

    def to_points(self, model: Any, memory: Any) -> tuple[Array, Array, Array]:
        """Return the whole memory as ``(points_world_V3, features_VF, valid_V)``; V is static."""
        raise NotImplementedError

    def render(
        self, model: Any, memory: Any, camera: Camera, height: int, width: int
    ) -> View | None:
        """Render the memory for (T,) cameras whose intrinsics are for height × width pixels.

        None, the default, draws its points as wide as the cells of ``cell_m``.
        """
        del model, memory, camera, height, width
        return None

    def erase(self, model: Any, memory: Any, box_23: Array) -> Any:
        """Erase the content of a box, as if it had never been observed.

        ``box_23`` is the lower and upper corner in the world, metres; upper faces are outside.

        Raises:
            UserError: the box is invalid, or this memory cannot be edited.
        """
        del model, memory, box_23
        raise self._not_editable()

    def move(
        self, model: Any, memory: Any, box_23: Array, transform: Array, *, leave: bool = False
    ) -> Any:
        """Move the content of a box by a rigid (4, 4) transform from old to new positions, metres.

        With ``leave`` the content also stays in place: a copy.

        Raises:
            UserError: as for ``erase``, or the transform is not a rigid 4×4.
        """
        del model, memory, box_23, transform, leave
        raise self._not_editable()

    def _not_editable(self) -> UserError:
        return UserError(
            f"the memory {type(self).__name__} cannot be edited: use a model with surfels or "
            "voxels."
        )

    def trimmed(self, memory: Any) -> Any:
        """Return the memory for reading only, smaller if it can be; not under jit."""
        return memory

    def check(self, model: Any) -> None:
        """Refuse a model that the encoder or the reader does not fit."""
        if model.backbone.places is None:
            require(
                not self.REMEMBERS,
                "this backbone has no injection point for a memory: use memory.kind none, or "
                "another backbone.",
            )
            return
        self.encoder.check(model)
        self.reader.check(model)

    def __post_init__(self):
        """Validate."""
        require(all(size > 0 for size in self.cell_m), "memory.cell_m must be positive.")
        require(all(count > 0 for count in self.cells), "memory.cells must be positive.")
        require(
            math.prod(self.cells) < 2**31,
            f"memory.cells {self.cells} make {math.prod(self.cells)} cells, more than the 2³¹ that "
            "can be numbered; take fewer or larger cells.",
        )
        require_positive(self, "memory", "capacity", "tokens")
        require(
            self.choose in ("visible", "nearest"),
            f"memory.choose is {self.choose!r}; choose visible or nearest.",
        )
        require(
            self.imagined_far > 0,
            f"memory.imagined_far is {self.imagined_far}: nothing imagined would be inserted; "
            "use a share of clip.far_m above 0, such as 0.95.",
        )
        require(
            self.imagined_edge >= 0,
            f"memory.imagined_edge is {self.imagined_edge}: use a share such as 0.2, or 0 to "
            "insert edges.",
        )
        require(
            self.tokens <= self.capacity,
            f"memory.tokens {self.tokens} exceeds memory.capacity {self.capacity}: a clip cannot "
            "attend to more cells than the map holds; raise capacity or lower tokens.",
        )


Denoiser: TypeAlias = Callable[..., Any]
"""``(x_t, time_B, weight) -> x0``; the last argument is the weight of guidance at this step."""


class Noise(Settings):
    """How latents are corrupted, what the network predicts, how samples are drawn.

    ========== ==================== ==================================== ==========================
    kind       time                 x_t                                  target
    ========== ==================== ==================================== ==========================
    ddpm       level, 0 … N − 1     √ᾱ x0 + √(1 − ᾱ) ε                   x0, v or ε
    edm        σ                    x0 + σ ε                             ±(x0 − c_skip x_t) / c_out
    flow       t in [0, 1]          (1 − t) x0 + t ε                     ε − x0
    frame_flow t in [0, 1]          (1 − t) x0 + (s + (1 − s) t) ε       (1 − s) ε − x0
    ========== ==================== ==================================== ==========================

    A time is one number per clip, (B,), or one per latent frame, (B, t), if the kind allows it.

    Attributes:
        guidance: classifier-free guidance on the memory, or in a world without one on the observed
            image, or on the text where the backbone says so; 1 is off.
        per_frame: whether training draws a time for every latent frame.
        rendered_until: the time down to which sampling keeps latents that the rendered memory
            covers; 0 for never. ``sample`` of a kind that has it takes the argument ``held``:
            ``(latents_BthwC, covered_Bthw1)``.
        STARTS: whether ``sample`` takes the argument ``start``, (B, t, …) latents that sampling
            starts from, with the noise of its first level added.
    """

    SECTION: ClassVar[str] = "noise"
    STARTS: ClassVar[bool] = False
    guidance: Any = 1.0
    per_frame: Any = False
    rendered_until: Any = 0.0

    @property
    def velocity_in_unit_time(self) -> bool:
        """Whether the network gets times from 0 to 1 and predicts the velocity ε − x0."""
        return False

    @staticmethod
    def expand(time_B: Array, ndim: int) -> Array:
        """Append axes to times (B,) or (B, t), so that they broadcast with (B, t, …)."""
        return time_B.reshape(*time_B.shape, *(1,) * (ndim - time_B.ndim))

    def draw(self, key: Array, batch: int, frames: int) -> Array:
        """Draw times for training: (B,), or (B, t) for ``frames`` latent frames."""
        raise NotImplementedError

    def corrupt(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return x_t, made from clean latents (B, t, …) and standard normal noise."""
        raise NotImplementedError

    def precondition(self, x_t: Array, time_B: Array) -> tuple[Array, Array]:
        """Return the network's inputs: the preconditioned x_t, and the time in its units."""
        raise NotImplementedError

    def prediction_target(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return the target of the network's prediction."""
        raise NotImplementedError

    def weight(self, time_B: Array) -> Array:
        """Return the loss weight of the squared error, in the shape of the times."""
        raise NotImplementedError

    def to_x0(self, prediction: Array, x_t: Array, time_B: Array) -> Array:
        """Turn the network's prediction into clean latents."""
        raise NotImplementedError

    def levels(self) -> np.ndarray:
        """Return (sample_steps,) the times that a sampler visits, the noisiest first."""
        raise NotImplementedError

    def sample(self, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
        """Draw a sample.

        Args:
            denoise: ``(x_t, time_B, weight) -> x0``.
            noise: (B, t, …) standard normal start.
            key: randomness of the steps, if the sampler draws noise.
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Draft(Settings):
    """No draft: the model imagines everything itself; and the base class of other kinds.

    A draft is what another network predicts of a clip, and the model refines.

    Attributes:
        PREDICTS: whether there is such a network.
    """

    SECTION: ClassVar[str] = "draft"
    PREDICTS: ClassVar[bool] = False

    def of(self, model: Any) -> Any:
        """Return the settings of the network that makes drafts, as a model."""
        raise NotImplementedError

    def init(self, model: Any, key: Array) -> Params:
        """Return random parameters, {} for no draft."""
        del model, key
        return {}
