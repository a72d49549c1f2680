"""What a training step costs, by the sum on paper (derived in ``docs/scaling.md``): FLOPs.

Every matrix product of the network is a line: its multiply-adds for one clip, and whether training
goes back through it. A product whose input depends on something trained is done again, backwards,
for the gradient of that input; one whose weights are trained once more for theirs; and what the
backward pass recomputes (``dit.remat``) is done once more forwards.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

from pewm_jax.config import Config
from pewm_jax.models import codec, world_model
from pewm_jax.models.vae_shapes import layout
from pewm_jax.training.stages import Stage

SPLIT = ("tensor", "context")
"""The axes of the mesh that split a block."""
PARTS = ("backbone", "memory", "codec", "encoder")
"""The networks of a step, as their parameters are named."""


@dataclasses.dataclass(frozen=True)
class Product:
    """One matrix product or convolution of the step.

    Attributes:
        part: one of ``PARTS``.
        kind: ``linear``, ``attention`` or ``convolution``: what hardware runs at different speed.
        macs: multiply-adds of one clip, forward, all layers together.
        backward: forward passes' worth of the gradients.
        again: forward passes' worth of what the backward pass computes again.
        axes: the axes of the mesh, beside the batch's, over which it is split; devices along
            others do the same work.
    """

    part: str
    kind: str
    macs: float
    backward: float = 0.0
    again: float = 0.0
    axes: tuple[str, ...] = ()

    @property
    def model(self) -> float:
        """FLOPs of one clip that the mathematics needs: forward and gradients."""
        return 2 * self.macs * (1 + self.backward)

    @property
    def hardware(self) -> float:
        """FLOPs of one clip that are done."""
        return 2 * self.macs * (1 + self.backward + self.again)


@dataclasses.dataclass(frozen=True)
class Sizes:
    """The numbers that a step's costs are made of, for one clip.

    Attributes:
        video: N, video tokens.
        text: L, text tokens.
        width: D.
        layers: blocks.
        frames: tokens in time.
        map: M, map tokens.
        seen: map tokens that a query looks at.
        inner: width of the memory attention.
        context: frames that the memory is built from.
        image: tokens of an image in DINOv2.
    """

    video: int
    text: int
    width: int
    layers: int
    frames: int
    map: int
    seen: int
    inner: int
    context: int
    image: int

    @property
    def joint(self) -> int:
        """Text and video tokens."""
        return self.text + self.video


def sizes(config: Config) -> Sizes:
    """Return the sizes of one clip."""
    t, h, w = codec.latent_shape(config)
    dit, memory = config.dit, config.memory
    frames = -(-t // dit.patch_t)
    projective = memory.positions == "projective"
    grid = memory.encoder_size // memory.dinov2.patch
    return Sizes(
        video=frames * (h // dit.patch) * (w // dit.patch),
        text=dit.text_length,
        width=dit.width,
        layers=dit.layers,
        frames=frames,
        map=memory.tokens,
        seen=min(memory.looks, memory.tokens) if projective else memory.tokens,
        inner=memory.heads * memory.head_dim,
        context=config.data.context,
        image=1 + memory.dinov2.registers + grid**2,
    )


def products(config: Config, stage: Stage) -> list[Product]:
    """List the matrix products of one stage's step; costs are of one clip."""
    found = [*_backbone(config, stage)]
    if stage.memory:
        found += _memory(config)
    if config.codec.kind == "vae":
        found += _codec(config)
    if stage.memory and encodes(config):
        found += _encoder(config)
    return found


def encodes(config: Config) -> bool:
    """Whether a stage with memory runs DINOv2: where features are neither kept nor unread."""
    memory = config.memory
    reads = memory.kind in ("voxel", "map2d", "images")
    return memory.encoder == "dinov2" and reads and not config.data.features


def flops_per_clip(config: Config, stage: Stage) -> float:
    """Return the FLOPs of one clip in one step that the mathematics needs.

    Forward through everything, frozen encoders included, and the gradients that are needed; what
    is recomputed is a cost of the implementation and not counted.
    """
    return math.fsum(product.model for product in products(config, stage))


def flops_of_device(product: Product, mesh: Mapping[str, int], clips: float) -> float:
    """Return the FLOPs that one device does for a product.

    Args:
        product: the product.
        mesh: devices along each axis.
        clips: clips of a step, of all devices.
    """
    ways = math.prod(mesh[axis] for axis in ("data", "fsdp", *product.axes))
    return clips * product.hardware / ways


def _backbone(config: Config, stage: Stage) -> Iterator[Product]:
    """Yield the transformer's products.

    In stage 1 it is trained. In stage 2 the gradients of the memory blocks pass through it, down to
    the first block, but not into its weights or the time embedding.
    """
    dit, s = config.dit, sizes(config)
    depth, width, time = dit.layers, dit.width, dit.time_dim
    cell = dit.patch**2 * dit.patch_t
    trained = not stage.memory
    again = float(dit.remat)
    both, one = 1.0 + trained, float(trained)

    per_token = (4 + 2 * dit.mlp_ratio) * width * width
    yield Product("backbone", "linear", depth * s.joint * per_token, both, again, SPLIT)
    modulation = depth * 12 * width * time
    yield Product("backbone", "linear", modulation, 2 * one, again, ("tensor",))
    recomputed = again + 0.5  # the logits, from their normaliser
    attention = depth * 2 * s.joint**2 * width
    yield Product("backbone", "attention", attention, 2.0, recomputed, SPLIT)

    ends_in = s.video * cell * world_model.in_channels(config) * width
    ends_in += s.text * dit.text_dim * width + (width + dit.ofs_dim) * time
    yield Product("backbone", "linear", ends_in, one)
    yield Product("backbone", "linear", time * time * (2 if dit.ofs_dim else 1), 2 * one)
    yield Product("backbone", "linear", 2 * width * time, 2 * one, 0.0, ("tensor",))
    out = s.video * cell * codec.latent_channels(config) * width
    yield Product("backbone", "linear", out, both, 0.0, ("context",))


def _memory(config: Config) -> Iterator[Product]:
    """Yield the memory blocks' products; all are trained."""
    dit, memory, s = config.dit, config.memory, sizes(config)
    depth, width, inner = dit.layers, dit.width, s.inner
    again = float(dit.remat)
    projective = memory.positions == "projective"
    place = 3 * memory.heads if projective else 0

    camera = depth * s.video * width * (width + width // 2)
    yield Product("memory", "linear", camera, 2.0, again, ("context",))
    video = depth * s.video * width * (2 * inner + place + 2 * memory.mlp_ratio * width)
    yield Product("memory", "linear", video, 2.0, again, SPLIT)
    keys = depth * 2 * s.map * inner * inner
    yield Product("memory", "linear", keys, 2.0, again, ("tensor",))
    modulation = depth * dit.time_dim * (4 * width + 2 * inner)
    yield Product("memory", "linear", modulation, 1.0, again, ("tensor",))
    attention = depth * s.video * s.seen * (2 * inner + place)
    yield Product("memory", "attention", attention, 2.0, again, SPLIT)
    rays = world_model.camera_channels(config) * dit.patch**2 * dit.patch_t
    ends = s.video * rays * (width // 2) + s.map * world_model.token_channels(config) * inner
    yield Product("memory", "linear", ends, 1.0)


def _codec(config: Config) -> Iterator[Product]:
    """Yield the VAE's encoding of colour and depth, of the clip and of its first frame."""
    clip = config.clip
    macs = sum(_encode(config, frames) for frames in (clip.frames, 1))
    yield Product("codec", "convolution", 2 * macs)


def _encode(config: Config, frames: int) -> float:
    """Return the multiply-adds of encoding one video."""
    vae, clip = config.codec.vae, config.clip
    halvings = vae.temporal.bit_length() - 1
    total = 0.0
    for path, shape in layout(vae).items():
        if not (path.startswith("encoder/") and path.endswith("kernel")):
            continue
        level = _level(path, len(vae.widths))
        spatial, temporal = level, min(level, halvings)
        if "resample" in path:
            spatial, temporal = level + 1, min(level + 1, halvings)
        cells = (clip.height >> spatial) * (clip.width >> spatial)
        total += -(-frames // 2**temporal) * cells * math.prod(shape)
    return total


def _level(path: str, levels: int) -> int:
    """Return how often the frame was halved where a layer of the encoder works."""
    name = path.split("/")[1]
    if name == "conv_in":
        return 0
    return int(name.removeprefix("down_")) if name.startswith("down_") else levels - 1


def _encoder(config: Config) -> Iterator[Product]:
    """Yield DINOv2's products over all context frames, with the resizing of the pictures."""
    memory, clip, s = config.memory, config.clip, sizes(config)
    dino, count = memory.dinov2, s.context * s.image
    width, side = dino.width, memory.encoder_size
    forward = (3 if dino.swiglu else 2) * dino.hidden * width
    yield Product("encoder", "linear", dino.layers * count * (4 * width * width + forward))
    yield Product("encoder", "attention", dino.layers * count * 2 * s.image * width)
    patches = s.context * (side // dino.patch) ** 2 * 3 * dino.patch**2 * width
    resized = s.context * 3 * side * clip.width * (clip.height + side)
    yield Product("encoder", "linear", patches + resized)
