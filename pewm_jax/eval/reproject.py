"""The baseline without a network: what was observed, moved to where the camera looks now.

Every observed pixel becomes a coloured point in the world, a z-buffer draws the points for each
frame to imagine, and holes are filled with the nearest pixel that was hit. Nothing is learnt,
nothing forgotten and nothing imagined. A memory that is worth its name must beat it.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from pewm_jax.errors import require
from pewm_jax.eval.images import unit_colours
from pewm_jax.geometry.cameras import unproject
from pewm_jax.geometry.depth_images import normals
from pewm_jax.memory import rendering, views
from pewm_jax.types import Array, Camera, Frames, View


@dataclasses.dataclass(frozen=True)
class ReprojectSettings:
    """How observed pixels are drawn."""

    footprint: int = 1
    """Pixels that a point covers at most, across and down."""
    width: float = 1.0
    """Width of a point, in pixels of the frame that observed it."""
    average: bool = True
    """Show the mean of all that is at the front, shared bilinearly; else the nearest point."""
    backs: bool = True
    """Show surfaces from behind too; else a back hides what lies behind it and is filled over."""

    def __post_init__(self):
        """Validate."""
        require(self.footprint >= 1, f"footprint is {self.footprint}: use at least 1 pixel.")
        require(self.width > 0, f"width is {self.width}: use more than 0 pixels.")

    @property
    def name(self) -> str:
        """The settings in a word, for names of files."""
        how = "mean" if self.average else "nearest"
        return f"{how}-{self.footprint}px-{self.width:g}{'' if self.backs else '-fronts'}"

    def __str__(self) -> str:
        """Say the settings for people."""
        size = "1 pixel each" if self.footprint == 1 else f"up to {self.footprint} pixels each"
        if self.footprint > 1 and self.width != 1:
            size += f", {self.width:g} observed pixels wide"
        shown = "the mean of those at the front" if self.average else "the nearest is shown"
        return f"points of {size}, {shown}{'' if self.backs else ', backs are not'}"


CANDIDATES = (
    ReprojectSettings(average=False),
    ReprojectSettings(),
    ReprojectSettings(footprint=3, average=False),
    ReprojectSettings(footprint=2),
    ReprojectSettings(footprint=3),
    ReprojectSettings(footprint=3, width=1.5),
    ReprojectSettings(footprint=2, backs=False),
    ReprojectSettings(footprint=3, backs=False),
)
"""The settings that are tried on the validation split; the first is a plain z-buffer."""


def reproject(settings: ReprojectSettings, context: Frames, camera: Camera) -> Frames:
    """Draw what was observed for other cameras.

    Args:
        settings: how (static under jit).
        context: S observed frames, colours uint8 or float in [−1, 1]; pixels without depth do not
            count, as those of frames that pad a context.
        camera: (N,) cameras of images of the context's size.

    Returns:
        N frames, colours float32 in [−1, 1], depth in metres. Where nothing was observed anywhere
        in an image, it is black and has no depth.
    """
    view = views.fill_nearest(draw(settings, context, camera))
    return Frames(2 * view.features_THWF - 1, view.depth_THW, camera)


def draw(settings: ReprojectSettings, context: Frames, camera: Camera) -> View:
    """Return the same with its holes, colours in [0, 1]."""
    depth_SHW = jnp.asarray(context.depth_THW)
    height, width = depth_SHW.shape[1:]
    points = unproject(depth_SHW, context.camera).reshape(-1, 3)
    colours = unit_colours(context.rgb_THWC).reshape(-1, 3)
    there = (depth_SHW > 0).reshape(-1)
    if settings.average or settings.footprint > 1 or not settings.backs:
        focal = jnp.asarray(context.camera.intrinsics_4)[:, 0, None, None]
        return rendering.splat_surfels(
            points,
            colours,
            settings.width * (depth_SHW / focal).reshape(-1),
            there,
            camera,
            height,
            width,
            most=settings.footprint,
            average=settings.average,
            normals_V3=None
            if settings.backs
            else normals(depth_SHW, context.camera).reshape(-1, 3),
        )
    return rendering.splat(points, colours, there, camera, height, width)


@functools.partial(jax.jit, static_argnums=0)
def reproject_batch(settings: ReprojectSettings, context: Frames, camera: Camera) -> Frames:
    """Do the same for B clips, one after the other: what one needs fits a processor's cache.

    Args:
        settings: as for ``reproject``.
        context: (B, S) observed frames.
        camera: (B, N) cameras.
    """

    def one(clip: tuple[Frames, Camera]) -> tuple[Array, Array]:
        frames = reproject(settings, *clip)
        return frames.rgb_THWC, frames.depth_THW

    rgb, depth = jax.lax.map(one, jax.tree.map(jnp.asarray, (context, camera)))
    return Frames(rgb, depth, camera)
