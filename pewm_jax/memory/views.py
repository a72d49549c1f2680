"""Rendered views put together: one over another, holes filled."""

from __future__ import annotations

import jax.numpy as jnp

from pewm_jax.geometry import depth_images
from pewm_jax.types import View


def over(front: View, back: View) -> View:
    """Return the first of two views of the same cameras where it shows anything, else the second.

    Args:
        front: of T cameras.
        back: of the same.
    """
    seen = front.seen_THW
    return View(
        jnp.where(seen[..., None], front.features_THWF, back.features_THWF),
        jnp.where(seen | (~back.seen_THW & (front.depth_THW > 0)), front.depth_THW, back.depth_THW),
        seen | back.seen_THW,
    )


def fill_nearest(view: View) -> View:
    """Fill pixels that show nothing from the nearest pixel of their image that shows something.

    By jump flooding (steps of …, 4, 2, 1 and once more 1 pixels): a static number of passes, and
    seldom a pixel that is a little farther than the nearest. Images that show nothing stay empty.

    Args:
        view: what was seen.

    Returns:
        The view with features and depth everywhere; ``seen_THW`` still tells what was seen.
    """
    frames, height, width = view.seen_THW.shape
    index, found = depth_images.nearest_known(view.seen_THW)
    features = jnp.asarray(view.features_THWF).reshape(frames, height * width, -1)
    features = jnp.take_along_axis(features, index[:, :, None], 1)
    depth = jnp.take_along_axis(jnp.asarray(view.depth_THW).reshape(frames, -1), index, 1)
    return View(
        jnp.where(found[:, :, None], features, 0).reshape(view.features_THWF.shape),
        jnp.where(found, depth, 0).reshape(view.depth_THW.shape),
        view.seen_THW,
    )
