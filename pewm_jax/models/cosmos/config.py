"""Settings of Cosmos' transformer; the defaults are the published ones of Cosmos-Predict2-2B."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class CosmosConfig:
    """A diffusion transformer in Cosmos' form (arXiv 2501.03575); defaults: Predict2-2B for video.

    ``CosmosBackbone`` makes a denoiser of it.
    """

    in_channels: int = 17
    """Channels of the input without the padding mask: noisy latents, and 1 for the mask that marks
    given frames. A world model takes its own number."""
    out_channels: int = 16
    """Channels of the prediction. A world model takes its own number."""
    layers: int = 28
    """Transformer blocks."""
    heads: int = 16
    """Attention heads."""
    head_dim: int = 128
    """Width of a head; even. The rotary embedding splits it in about three: time, height, width."""
    mlp_ratio: float = 4.0
    """Feed-forward width over model width."""
    text_dim: int = 1024
    """Channels of a text token, in the blocks."""
    raw_text_dim: int = 0
    """Channels of a text token that is given, if a linear layer and GELU turn it into `text_dim`
    channels (Predict2.5); 0 if there is no such layer."""
    text_length: int = 512
    """Number of text tokens that a world model gives."""
    prompt: Literal["zeros", "stored"] = "zeros"
    """Which text tokens: `zeros`, or the embeddings of a prompt, and of another one for guidance,
    that are `stored` with the weights."""
    fps: float = 16.0
    """Frames per second in the network's conditioning."""
    lora_dim: int = 256
    """Channels of the bottleneck in each block's modulation by the time."""
    patch: int = 2
    """Latent cells per token, along height and along width."""
    patch_t: int = 1
    """Latent frames per token."""
    max_size: tuple[int, int, int] = (128, 240, 240)
    """Latent frames, rows and columns that positions reach."""
    rope_scale: tuple[float, float, float] = (1.0, 3.0, 3.0)
    """Stretch of the rotary embedding's longest waves along time, height and width."""
    learned_positions: bool = False
    """Whether a learned embedding of positions is added before every block (Predict1)."""
    padding_mask: bool = True
    """Whether a mask of padded pixels is joined to the input."""
    attention: Literal["auto", "xla", "cudnn", "splash", "ring"] = "auto"
    """The attention kernel: `cudnn` is flash attention on NVIDIA GPUs in 16 bits, `splash` is flash
    attention on TPUs, `xla` runs anywhere, `auto` uses the best kernel of the hardware. `ring`
    splits keys and values over `train.mesh.context`, too, for very long clips."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    @property
    def hidden(self) -> int:
        """Channels inside the feed-forward layers."""
        return int(self.width * self.mlp_ratio)

    @property
    def max_grid(self) -> tuple[int, int, int]:
        """Tokens along time, height and width that positions reach."""
        frames, rows, columns = self.max_size
        return frames // self.patch_t, rows // self.patch, columns // self.patch

    def __post_init__(self):
        """Validate."""
        require_positive(self, "backbone", "in_channels", "out_channels", "layers", "heads")
        require_positive(self, "backbone", "text_dim", "lora_dim", "patch", "patch_t")
        require_positive(self, "backbone", "text_length", "fps")
        require(
            self.head_dim >= 12 and self.head_dim % 2 == 0,
            f"backbone.head_dim is {self.head_dim}: use an even number of at least 12, which the "
            "rotary embedding splits into time, height and width.",
        )
        require(
            self.raw_text_dim >= 0,
            f"backbone.raw_text_dim is {self.raw_text_dim}: use 0 for text tokens as they are.",
        )
        require(
            self.hidden >= 1,
            f"backbone.mlp_ratio is {self.mlp_ratio}: use a number that leaves at least a channel.",
        )
        for name, least in (("max_size", 1), ("rope_scale", 0)):
            values = getattr(self, name)
            require(
                len(values) == 3 and min(values) >= least and min(values) > 0,
                f"backbone.{name} is {values}: name three numbers above 0, for time, height and "
                "width.",
            )
        require(
            min(self.max_grid) >= 1,
            f"backbone.max_size {self.max_size} is smaller than one token.",
        )
