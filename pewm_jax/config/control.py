"""What steers a clip."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.config.kinds import Settings


class ControlSettings(Settings):
    """What the settings of every control say; ``pewm_jax.models.controls`` says what it does.

    Attributes:
        MODULATES: whether it adds to the time embedding of each latent frame.
        actions: A, the numbers of an action that it needs; 0 where cameras are enough.
    """

    SECTION: ClassVar[str] = "control"
    MODULATES: ClassVar[bool] = False
    actions: Any = 0

    def channels(self, model: Any) -> int:
        """Return the channels, at the latent rate, that it joins to the denoiser's input.

        Args:
            model: the ``ModelConfig`` that it is part of.
        """
        del model
        return 0


@dataclasses.dataclass(frozen=True)
class CameraConfig(ControlSettings):
    """Cameras steer: their Plücker rays are joined to the denoiser's input (the paper)."""

    def channels(self, model: Any) -> int:
        """Six Plücker coordinates for each of the frames of a latent frame."""
        return 6 * model.codec.temporal
