"""Controls: what steers a clip."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.config.kinds import Settings


class ControlSettings(Settings):
    """Settings that every control has; see ``pewm_jax.models.controls`` for its functions.

    Attributes:
        MODULATES: whether it adds to the time embedding of each latent frame.
        actions: A, the numbers of an action that it needs; 0 where cameras are enough.
    """

    SECTION: ClassVar[str] = "control"
    MODULATES: ClassVar[bool] = False
    actions: Any = 0

    def channels(self, model: Any) -> int:
        """Return the number of channels, at the latent rate, that it adds to the denoiser's input.

        Args:
            model: the ``ModelConfig`` that these settings are part of.
        """
        del model
        return 0


@dataclasses.dataclass(frozen=True)
class CameraConfig(ControlSettings):
    """Control by cameras (the paper): their Plücker rays are concatenated to the input."""

    def channels(self, model: Any) -> int:
        """Return six Plücker coordinates for each frame of a latent frame."""
        return 6 * model.codec.temporal
