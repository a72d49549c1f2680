"""Settings of PERSIST; ``world.py`` has its methods."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config import (
    ArraySpec,
    AssembledModel,
    BatchSpec,
    Capabilities,
    ClipConfig,
    Codec,
    Conditioner,
    Noise,
    StageConfig,
    TrainSettings,
)
from pewm_jax.errors import require, require_fields
from pewm_jax.memory import class_grid
from pewm_jax.memory.class_grid import GridConfig
from pewm_jax.models.persist.nets import PersistNetsConfig
from pewm_jax.registry import part

POINT_WAVES = 4
"""Wavelengths of the sinusoids of a position, with ``model.points``."""


@dataclasses.dataclass(frozen=True)
class PersistTrainConfig(TrainSettings):
    """Training of the networks, one after the other; the codec of images is frozen."""

    ZERO: ClassVar[dict[str, str]] = dict.fromkeys(
        ("hidden", "memory_errors", "chained", "denoised_lpips"),
        "it is for worlds with memory blocks",
    )

    run: str = "runs/persist"
    """Folder of this run: checkpoints, logs, images, report."""
    fresh: tuple[str, ...] = (r"(voxel_vae|voxel_dit|camera_model|renderer)/.*",)
    """Parameter paths (regular expressions) that may be missing from the weights a stage starts
    from; these parameters start at random."""
    preview_every: int = 0
    """Steps between sample images; 0 for none: an image needs all the networks."""
    voxel_vae: StageConfig = StageConfig()
    """The autoencoder of voxels."""
    voxel_statistics: StageConfig = StageConfig(steps=60, learning_rate=0.03, warmup=0)
    """Mean and scale of the voxels' latents are fitted."""
    world_frames: StageConfig = StageConfig()
    """The transformer that predicts the next voxel frame."""
    camera: StageConfig = StageConfig()
    """The transformer that predicts the camera."""
    renderer: StageConfig = StageConfig()
    """The transformer that renders voxels."""
    frames_per_clip: int = 0
    """Frames of each clip, drawn at random, that stage `world_frames` predicts; 0 for all. Where
    frames do not attend to earlier ones (`world_frames.blocks.context` 1), fewer frames of more
    clips are more diverse at the same cost."""
    blind: float = 0.3
    """Share of frames after the first that are not conditioned on an image."""

    occupied: float = 1.0
    """Weight of the error of latents with occupied cells; 1 as published. Most cells are air."""
    new: float = 1.0
    """Weight of the error of latents with cells that the map does not hold yet, or of which its
    guess is wrong, where `world_frames.map_embed` is not 0: those are what the network has to
    complete."""
    guessed: float = 0.5
    """Share of the clips whose map also holds guesses of the cells that were not observed: the true
    cells, parts of which are missing, moved or there twice. In the others these are unknown."""
    elsewhere: float = 0.0
    """Share of the clips with guesses in which these are the cells of another clip of the batch, as
    wrong as a world's own guesses often are."""
    entering: float = 0.7
    """Share of the clips with guesses in which the cells at one side of the window are unknown, as
    where the agent walks on."""
    classes: float = 0.0
    """Weight of the cross-entropy of a world frame's classes, through the frozen decoder, relative
    to the error of its latents; 0 as published. It needs a decoder that decodes one latent at a
    time (`voxel_vae.kernel` and `middle_kernel` 1, one number of `widths`)."""
    compared: int = 256
    """Latents per frame in the cross-entropy of `classes`, drawn by the weights of their errors."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(self.occupied > 0, f"train.occupied is {self.occupied}: use a number above 0.")
        require(self.classes >= 0, f"train.classes is {self.classes}: use 0 or more.")
        require(self.compared >= 1, f"train.compared is {self.compared}: use 1 or more.")
        require(self.new > 0, f"train.new is {self.new}: use a number above 0.")
        for name in ("guessed", "elsewhere", "entering"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"train.{name} is {value}: use a share, 0 to 1.")
        require(
            self.frames_per_clip >= 0,
            f"train.frames_per_clip is {self.frames_per_clip}: use 0 for all, or 1 or more.",
        )
        require(0 <= self.blind < 1, f"train.blind is {self.blind}: use 0 up to, not with, 1.")

    def require_fit(self, model: Any) -> None:
        """Refuse classes through a decoder that cannot decode a latent alone, and single clips."""
        super().require_fit(model)
        frames = self.world_frames
        require(
            not (self.elsewhere and frames.steps) or frames.batch // frames.micro_batches >= 2,
            f"train.elsewhere is {self.elsewhere}, which takes cells of another clip of the batch, "
            f"and train.world_frames.batch is {frames.batch} in {frames.micro_batches} parts: use "
            "parts of at least 2 clips, or train.elsewhere 0.",
        )
        context = model.backbone.world_frames.blocks.context
        require(
            not self.frames_per_clip or context == 1,
            f"train.frames_per_clip is {self.frames_per_clip} and world_frames.blocks.context "
            f"{context}: frames that attend to earlier ones need all of these; use 0, or context "
            "1.",
        )
        vae = model.backbone.voxel_vae
        seen = (vae.kernel, vae.middle_kernel, len(vae.widths))
        require(
            not self.classes or seen == (1, 1, 1),
            f"train.classes is {self.classes}, voxel_vae.kernel {seen[0]}, middle_kernel "
            f"{seen[1]}, and widths has {seen[2]} numbers: use 1, 1 and one number, so that a "
            "latent can be decoded alone, or train.classes 0.",
        )


ACTIONS = 23
"""Numbers of an action, as published."""
PUBLISHED_CLIP = ClipConfig(frames=16, height=288, width=512, depth=False)
"""36×64 latents, as published, with a codec whose cells have 8 pixels."""


@dataclasses.dataclass(frozen=True)
class PersistModel(AssembledModel):
    """Base class of ``PERSIST``: a world that is three-dimensional itself (arXiv 2603.03482)."""

    TRAIN: ClassVar[type[TrainSettings]] = PersistTrainConfig

    clip: ClipConfig = PUBLISHED_CLIP
    """Shape of a clip."""
    codec: Codec = part("codec", "learned")
    """Codec: images to latents and back."""
    backbone: PersistNetsConfig = part("backbone", "persist")
    """The four networks."""
    control: Conditioner = part(
        "control",
        "actions",
        actions=ACTIONS,
        units=(1.0,) * ACTIONS,
        low=(-1.0,) * ACTIONS,
        high=(1.0,) * ACTIONS,
        angles=(),
    )
    """The numbers of an action; its other settings are not used."""
    memory: GridConfig = part("memory", "grid")
    """The state of the world."""
    noise: Noise = part("noise", "frame_flow", per_frame=True, context_noise=0.1)
    """Noise of images, sampler."""
    voxel_noise: Noise = part("noise", "frame_flow", per_frame=True)
    """Noise of voxel frames, sampler."""
    persistence_logit: float = 0.0
    """Nats by which another class must be likelier than a cell's previous class to replace it; 0 as
    published. Small networks forget without it."""
    shown_logit: float = -1.0
    """The same for a cell that was never observed, but shown by an imagined frame; -1 for that of
    `persistence_logit`."""
    guess_logit: float = -1.0
    """The same for a guess that was neither observed nor shown, so that it can be revised; -1 for
    that of `shown_logit`."""
    empty_prior: float = 0.0
    """Nats by which a class must be likelier than air in an unknown cell; 0 as published. Small
    networks fill unknown cells with clutter without it."""
    observation_logit: float = 0.0
    """Nats that a real image of blocks (`memory.pictures cells`) adds to the class that it shows in
    a cell: air before the measured depth, a surface at it; 0 as published."""
    body_m: float = 0.0
    """Radius of the agent's body, metres: the cells that it stands in, from shin to eyes, are empty
    and count as observed, unless an image has shown a surface in them. So an agent that walks
    through a guess corrects it. 0 for no body, as published."""
    colour_reach_m: float = 0.0
    """Distance, metres, within which cells of the same kind agree on the colour of a cell that is
    guessed: the colour that is likeliest for all of them. 0 for the likeliest colour of the cell
    alone, as published."""
    moving: tuple[str, ...] = ()
    """Kinds of things that move, such as `door` and `robot`: if a real image shows an observed cell
    of theirs empty, the cells of these kinds that are connected with it are unknown again. Not as
    published."""
    sampled: Literal["always", "new"] = "always"
    """Imagined frames of which the voxels are sampled: `always`, as published, or those with `new`
    cells in the window; in the others nothing has changed that a guess could be revised by."""
    points: bool = False
    """Whether the image that conditions a voxel frame has the positions of its surfaces, from
    depth, as further channels; not as published."""
    dead_reckoning: bool = False
    """Whether the camera model predicts how a step differs from the planar action, instead of the
    step; not as published."""

    @property
    def batch_spec(self) -> BatchSpec:
        """Actions, and the recorded voxels around the agent."""
        side = self.memory.recorded
        voxels = (
            ("classes_TXYZ", ArraySpec((self.clip.frames, side, side, side), "uint16")),
            ("origin_T3", ArraySpec((self.clip.frames, 3))),
        )
        return BatchSpec(context=False, actions=self.control.actions, extras=voxels)

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of a world of voxels, all of whose stages train with voxels."""
        return dataclasses.replace(super().capabilities, stage_without_memory=False, voxels=True)

    @property
    def side(self) -> int:
        """Cells along an axis of a window."""
        return self.backbone.voxel_vae.side

    @property
    def cell(self) -> float:
        """Side of a cell, metres."""
        return self.memory.cell_m[0]

    @property
    def picture_channels(self) -> int:
        """Channels of an image's latents, including those of depth if depth is imagined."""
        return self.codec.channels if self.clip.depth else self.codec.rgb_channels

    @property
    def kept_logits(self) -> tuple[float, float, float]:
        """Nats in favour of the previous class of a guessed, of a shown and of an observed cell."""
        shown = self.persistence_logit if self.shown_logit < 0 else self.shown_logit
        guess = shown if self.guess_logit < 0 else self.guess_logit
        return guess, shown, self.persistence_logit

    @property
    def shown_channels(self) -> int:
        """Channels of the image that conditions a voxel frame."""
        return self.picture_channels + (6 * POINT_WAVES if self.points else 0)

    def __post_init__(self):
        """Validate."""
        for name, kind in (("backbone", PersistNetsConfig), ("memory", GridConfig)):
            found = getattr(self, name)
            require(
                isinstance(found, kind),
                f"model.{name} is a {type(found).__name__}, and the world persist is made of a "
                f"{kind.__name__}: use that.",
            )
        super().__post_init__()
        for name in ("noise", "voxel_noise"):
            require(
                getattr(self, name).per_frame,
                f"model.{name}.per_frame is false, and every frame of this world has its own time: "
                "use true.",
            )
        logits = ("persistence_logit", "empty_prior", "observation_logit")
        require_fields(self, "model", lambda value: value >= 0, "0 or more nats", *logits)
        require(self.body_m >= 0, f"model.body_m is {self.body_m}: use 0 or more metres.")
        reach = self.colour_reach_m
        require(
            reach == 0 or reach >= self.cell,
            f"model.colour_reach_m is {reach}: use 0, or {self.cell} metres (a cell) or more.",
        )
        known = sorted({name.partition("/")[0] for name in class_grid.names(self.memory)[1:]})
        for kind in self.moving:
            require(
                kind in known,
                f"model.moving names {kind!r}, and the kinds of this world are {', '.join(known)}.",
            )
        optional = ("shown_logit", "guess_logit")
        hint = "0 or more nats, or -1"
        require_fields(self, "model", lambda value: value >= 0 or value == -1, hint, *optional)
        for name in ("points", "observation_logit", "moving"):
            require(
                self.clip.depth or not getattr(self, name),
                f"model.{name} needs depth: use clip.depth true, or leave {name} out.",
            )
        pictures = self.memory.pictures
        require(
            not self.observation_logit or pictures == "cells",
            f"model.observation_logit is {self.observation_logit} and memory.pictures {pictures}: "
            "it reads colours of blocks; use 0, or data of --voxels.pictures cells.",
        )
        require(
            not self.dead_reckoning or self.control.actions == 3,
            "model.dead_reckoning is of planar actions (dx, dy, dyaw): use control.actions 3.",
        )
