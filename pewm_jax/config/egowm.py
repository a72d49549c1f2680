"""EgoWM: a video model that imagines chunk after chunk, steered by actions, without a map."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from pewm_jax.config.model import ModelConfig
from pewm_jax.config.parts import Conditioner, Memory
from pewm_jax.config.training import StageConfig, TrainSettings
from pewm_jax.config.world import BatchSpec, Capabilities
from pewm_jax.errors import require
from pewm_jax.registry import part


@dataclasses.dataclass(frozen=True)
class EgoWMTrainConfig(TrainSettings):
    """How a video model becomes a world model: all of it is trained, with actions."""

    run: str = "runs/egowm"
    """Folder of this run: checkpoints, logs, images, report."""
    video: StageConfig = StageConfig(steps=0)
    """Where there is no pre-trained video model, the backbone first becomes one, without actions;
    by default left out. Begun at once with actions at random weights, it would not learn to follow
    them: both the control and what it modulates begin with zeros, and neither moves the other."""
    adapt: StageConfig = StageConfig()
    """The backbone goes on learning as it did before, now with actions; the control's learning rate
    is `model.control.rate` times this one's."""
    blind: float = 0.1
    """Share of clips from which is hidden what guidance is on, the observed image or the text;
    needed for `model.noise.guidance` above 1."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(0 <= self.blind < 1, f"train.blind is {self.blind}: use 0 up to, not with, 1.")
        require(
            self.hidden == 0 and self.chained == 0,
            f"train.hidden is {self.hidden} and train.chained {self.chained}: this world has no "
            "memory to hide, and its clips cannot be run backwards; use 0 for both.",
        )


@dataclasses.dataclass(frozen=True)
class EgoWMConfig(ModelConfig):
    """A video diffusion model steered by actions (EgoWM, arXiv 2601.15284)."""

    TRAIN: ClassVar[type[TrainSettings]] = EgoWMTrainConfig

    control: Conditioner = part("control", "actions")
    """Control: what steers a clip."""
    memory: Memory = part("memory", "none", reader=part("reader", "render"))
    """There is none: leave it at `none`."""
    history: int = 1
    """Frames that every clip begins with and that are observed, or were imagined before: 1 in
    Stable Video Diffusion and CogVideoX; more where a backbone learns with more. They fill latent
    frames: with `codec.temporal` 4, use 4k + 1."""
    image_noise: float = 0.0
    """Deviation of the noise on these frames while imagining; the paper's is 0.1, with Stable Video
    Diffusion. In training it is drawn as `train` says."""

    @property
    def batch_spec(self) -> BatchSpec:
        """The clip's frames and actions alone."""
        return dataclasses.replace(super().batch_spec, context=False, features=None)

    @property
    def capabilities(self) -> Capabilities:
        """What a world without a memory can do."""
        return dataclasses.replace(super().capabilities, memory_parameters="")

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            not self.memory.REMEMBERS,
            "model.memory is of a kind that remembers, and the world egowm has no map: use "
            "memory.kind none, or the world pewm with control.kind actions.",
        )
        q = self.codec.temporal
        require(
            1 <= self.history < self.clip.frames and (self.history - 1) % q == 0,
            f"model.history is {self.history}: use {q}k + 1 frames (they fill latent frames), and "
            f"fewer than clip.frames ({self.clip.frames}).",
        )
        require(
            self.noise.guidance == 1
            or not self.backbone.GUIDED_BY_TEXT
            or self.backbone.stores_prompt,
            f"noise.guidance is {self.noise.guidance}, which this backbone has on its text, and no "
            "text is stored: use backbone.prompt stored and weights that were imported with a text "
            "encoder, or noise.guidance 1.",
        )
        require(self.image_noise >= 0, f"model.image_noise is {self.image_noise}: use 0 or more.")
