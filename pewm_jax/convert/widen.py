"""Widen a video model to a world model: more channels at both ends of the transformer, and back.

The paper extends the patch embedding to accept depth, the observed frame and the camera, and the
output layer to predict depth. Old weights are copied and the weights of new inputs are zero, so the
network predicts the original's colours for any value of the new inputs. New outputs are initialized
to zero, too. Channels of the world model, in order: noisy colour, noisy depth, observed colour,
observed depth, camera; an image-to-video model's image channels become the observed colour.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.nn import tokens
from pewm_jax.types import Array, Params

ENDS = ("patch_embed/", "proj_out/")
"""Beginnings of the paths of the leaves that ``widen`` changes."""


@dataclasses.dataclass(frozen=True)
class Widening:
    """The positions of a video model's channels in its world model.

    Attributes:
        old: the video model's transformer.
        new: the world model's.
        inputs: for each old input channel, the new one.
        outputs: for each old output channel, the new one.
    """

    old: DiTBackbone
    new: DiTBackbone
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]


def plan(old: DiTBackbone, latents: int, camera: int) -> Widening:
    """Map each channel of the video model to one of the world model.

    Args:
        latents: latent channels of the VAE.
        camera: camera channels at the latent rate.

    Raises:
        UserError: the transformer has another number of input or output channels.
    """
    if old.out_channels != latents or old.in_channels not in (latents, 2 * latents):
        raise UserError(
            f"The transformer has {old.in_channels} input and {old.out_channels} output channels; "
            f"with a VAE of {latents} it must have {latents} (text to video) or {2 * latents} "
            f"(image to video) inputs and {latents} outputs."
        )
    noisy = tuple(range(latents))
    image = tuple(range(2 * latents, 3 * latents))[: old.in_channels - latents]
    new = dataclasses.replace(old, in_channels=4 * latents + camera, out_channels=2 * latents)
    return Widening(old, new, noisy + image, noisy)


def widen(plan: Widening, params: Params) -> Params:
    """Return the world model's backbone; unchanged leaves are the same arrays and may be absent."""
    old, new = plan.old, plan.new
    rows = _rows(new, new.in_channels, old.in_channels, plan.inputs)
    columns = _rows(new, new.out_channels, old.out_channels, plan.outputs)
    embed, project = params["patch_embed"], params["proj_out"]
    cells = new.patch_t * new.patch**2
    return {
        **params,
        "patch_embed": {**embed, "kernel": _spread(embed["kernel"], rows, new.in_channels * cells)},
        "proj_out": {
            "kernel": _spread(project["kernel"].T, columns, new.out_channels * cells).T,
            "bias": _spread(project["bias"], columns, new.out_channels * cells),
        },
    }


def narrow(plan: Widening, params: Params) -> Params:
    """Return the video model inside a world model's backbone; the inverse of ``widen``.

    After training, what the network has learned about depth and camera is lost.
    """
    old, new = plan.old, plan.new
    rows = _rows(new, new.in_channels, old.in_channels, plan.inputs)
    columns = _rows(new, new.out_channels, old.out_channels, plan.outputs)
    embed, project = params["patch_embed"], params["proj_out"]
    return {
        **params,
        "patch_embed": {**embed, "kernel": np.asarray(embed["kernel"])[rows]},
        "proj_out": {
            "kernel": np.asarray(project["kernel"])[:, columns],
            "bias": np.asarray(project["bias"])[columns],
        },
    }


def _rows(config: DiTBackbone, wide: int, narrow: int, channels: tuple[int, ...]) -> np.ndarray:
    """Return, for each value of a narrow patch, its index in the wide one."""
    of_narrow, of_wide = _places(config, narrow), _places(config, wide)
    return np.array([of_wide[cell, channels[channel]] for cell, channel in of_narrow])


def _places(config: DiTBackbone, channels: int) -> Mapping[tuple[int, int], int]:
    """Return (cell of a patch, channel) → index in the row of ``tokens.patchify``."""
    p, p_t = config.patch, config.patch_t
    ids = np.arange(p_t * p * p * channels).reshape(1, p_t, p, p, channels)
    order = np.asarray(tokens.patchify(ids, p, p_t))[0, 0]
    return {(int(i) // channels, int(i) % channels): place for place, i in enumerate(order)}


def _spread(old: Array, rows: np.ndarray, count: int) -> np.ndarray:
    """Scatter rows of an array to their new indices; the other rows are zero."""
    old = np.asarray(old)
    out = np.zeros((count, *old.shape[1:]), old.dtype)
    out[rows] = old
    return out
