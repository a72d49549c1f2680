"""SRC and the mirror test: does a place look the same when the agent comes back?

The agent goes a path and comes back the same way (``actions.there_and_back``): frame k and frame
T − 1 − k of a clip are taken from one camera. The way back, turned round, is compared with the way
out.

- **SRC**, scene revisit consistency (Hong et al. 2024, SlowFast-VGen; PEWM, Sec. 4): by the cosine
  between features of an image encoder, times 100. PEWM's encoder is DINOv2; which features, and how
  they are averaged, it does not say. Here it is the class token, and the mean over places.
- **The mirror test** (MIND 2026): by any measure of pictures, ``mirror[psnr]``.

Consistency says nothing of truth: a model that always shows one picture is perfectly consistent.
So the truth's own number, the ceiling, and what two different places get, the floor, stand beside.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.pictures import Metric, colours
from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class RevisitScore:
    """How alike first and later visits are.

    Attributes:
        value_B: of every imagined clip.
        ceiling_B: of its truth.
        floor_B: of the truth's way out and the way back of another clip's truth, another place.
    """

    value_B: Array
    ceiling_B: Array
    floor_B: Array

    def facts(self) -> dict[str, float]:
        """Return the means over clips, for a report."""
        return {
            field.name.removesuffix("_B"): float(jnp.mean(getattr(self, field.name)))
            for field in dataclasses.fields(self)
        }


@dataclasses.dataclass(frozen=True)
class Revisit:
    """Compares the way back with the way out; a ``Metric``.

    Attributes:
        name: of the measure, with the encoder's or the measure's that pictures are compared by.
        compare: the measure.
    """

    name: str
    compare: Metric

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return the number of every imagined clip, (B,).

        The truth must be of its shape, and no more: what is compared are two visits of one clip.
        A clip that does not come back is therefore not best even against itself.

        Raises:
            UserError: the clips are not alike, or are no way out and back.
        """
        colours(imagined_BTHWC, truth_BTHWC)
        out, back = ways(imagined_BTHWC)
        return self.compare(back, out)

    def score(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> RevisitScore:
        """Return the numbers of imagined clips between a floor and a ceiling.

        Args:
            imagined_BTHWC: (B, T, H, W, 3), B ≥ 2 clips of different places, frame k and T − 1 − k
                from one camera; see ``Metric``.
            truth_BTHWC: the same shape.

        Raises:
            UserError: the clips are not alike, are no way out and back, or there is only one.
        """
        if len(truth_BTHWC) < 2:
            raise UserError(
                "a floor needs another place: give at least 2 clips, of different ones."
            )
        value_B = self(imagined_BTHWC, truth_BTHWC)
        out, back = ways(truth_BTHWC)
        floor_B = self.compare(jnp.roll(back, 1, 0), out)
        return RevisitScore(value_B, self.compare(back, out), floor_B)


def ways(clips_BTHWC: Array) -> tuple[Array, Array]:
    """Return the way out and, turned round, the way back, each (B, T // 2, H, W, 3).

    The frame in the middle of an odd number belongs to neither.

    Args:
        clips_BTHWC: (B, T, H, W, 3), frame k and frame T − 1 − k from one camera.

    Raises:
        UserError: there are fewer than 2 frames.
    """
    clips = jnp.asarray(clips_BTHWC)
    half = clips.shape[1] // 2
    if half < 1:
        raise UserError("a clip of one frame comes back to nothing: give at least 2 frames.")
    return clips[:, :half], clips[:, ::-1][:, :half]
