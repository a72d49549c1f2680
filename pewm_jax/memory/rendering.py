"""Rendering of points by splatting them into a z-buffer.

Shapes are static and the result is deterministic (``average`` adds in the order of the points on a
CPU). ``splat`` lets each point cover the one pixel that it projects to; of several points at a
pixel the nearest is seen, and ties go to the lowest index. Far surfaces show through between such
points; ``splat_surfels`` gives points a size, so that they do not.

Everywhere points are (V, 3) in the world, metres, features (V, F); points whose ``valid_V`` is
False are ignored; the intrinsics of the (T,) cameras are for images of ``height`` × ``width``
pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry import depth_images, zbuffer
from pewm_jax.geometry.cameras import dot, project, unproject
from pewm_jax.geometry.zbuffer import NEAREST_M, ProjectedPoints
from pewm_jax.types import Array, Camera, Frames, View

TOLERANCE_M, TOLERANCE_RELATIVE = 0.05, 0.1
"""Points on one surface lie within the larger of 5 cm and 10 % behind its front (a floor seen at a
grazing angle is that deep from pixel to pixel)."""
LEAST = 1e-4
"""The least share of a point at which it is visible."""
RASTER, REACH, PILE = 64, 8, 8
"""Limits of the images of cells, see ``splat_cells``."""
MIDDLE = 1e-3
"""Pixels before the middle of a pixel from which a point counts as at the middle."""
BLOCK = 16
"""Slots that are drawn or left out together."""
SHARE = 3 / 8
"""Of all blocks, how many are drawn in the branch where a camera sees only some of them."""
WORTH_A_BRANCH = 4096
"""Number of points from which that branch is faster."""


def splat(
    points_V3: Array, features_VF: Array, valid_V: Array, camera: Camera, height: int, width: int
) -> View:
    """Render points for cameras."""
    count, pixels = len(points_V3), height * width

    def render(camera: Camera) -> tuple[Array, Array, Array]:
        uv, z = project(points_V3, camera)
        column, row = (jnp.floor(uv[:, i]).astype(jnp.int32) for i in (0, 1))
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        visible = inside & valid_V & (z > NEAREST_M)
        pixel = jnp.where(visible, row * width + column, pixels)
        depth = jnp.full((pixels,), jnp.inf).at[pixel].min(z, mode="drop")
        first = visible & (z <= depth[jnp.minimum(pixel, pixels - 1)])
        index = (
            jnp.full((pixels,), count)
            .at[jnp.where(first, pixel, pixels)]
            .min(jnp.arange(count), mode="drop")
        )
        seen = index < count
        features = jnp.where(seen[:, None], features_VF[jnp.minimum(index, count - 1)], 0)
        return features, jnp.where(seen, depth, 0), seen

    return _as_images(jax.vmap(render)(camera), height, width)


def _as_images(pixels: tuple[Array, Array, Array], height: int, width: int) -> View:
    """Return (T, H·W, …) features, depth and whether something is seen as images."""
    features, depth, seen = pixels
    shape = (len(depth), height, width)
    return View(features.reshape(*shape, -1), depth.reshape(shape), seen.reshape(shape))


def splat_surfels(
    points_V3: Array,
    features_VF: Array,
    size_V: Array,
    valid_V: Array,
    camera: Camera,
    height: int,
    width: int,
    *,
    most: int = 3,
    average: bool = True,
    normals_V3: Array | None = None,
) -> View:
    """Render points that have a size, so that near surfaces hide far ones.

    A point covers the pixels whose centres lie in a square of its size (metres) at its depth around
    it, at most ``most`` across and down, and always the pixel that it falls on. The nearest point
    that covers a pixel is its front; points behind the front by more than a tolerance are hidden.
    Where no point in front falls on or beside a covered pixel, the covering point is shown.

    ``average`` shows the mean of all points that are not hidden, each shared bilinearly by the four
    pixels around it; else the nearest point that falls on the pixel is shown. ``normals_V3`` are
    the directions that points face, 0 for both sides. A point that faces away hides what is behind
    it and is not shown: nothing is seen there, at its depth.

    Points in neighbouring slots are taken to be neighbours in the world, as in a memory: if the
    blocks of ``BLOCK`` slots that reach into a camera's view are at most ``SHARE`` of all, only
    they are drawn. That changes no result. It is a branch, both sides of which ``jax.vmap``
    computes: render a batch with ``jax.lax.map``.
    """
    sides = () if normals_V3 is None else (normals_V3,)
    points_V3, features_VF, size_V, valid_V, *sides = _whole_blocks(
        points_V3, features_VF, size_V, valid_V, *sides
    )
    blocks = len(points_V3) // BLOCK
    few = int(blocks * SHARE)

    def one(camera: Camera) -> tuple[Array, Array, Array]:
        projected = zbuffer.project_points(points_V3, size_V, size_V, valid_V, camera)
        away_V = None
        if sides:
            ahead = points_V3 - camera.world_from_camera[:3, 3]
            away_V = dot(ahead, sides[0]) > 0

        def drawn(
            projected: ProjectedPoints, features_VF: Array, away_V: Array | None
        ) -> tuple[Array, Array, Array]:
            return _draw(projected, features_VF, away_V, height, width, most, average)

        everything = projected, features_VF, away_V
        if few * BLOCK < WORTH_A_BRANCH:
            return drawn(*everything)
        listed, count = _blocks_in_view(projected, height, width, most, few)

        def chosen(x: Array) -> Array:
            rows = x.reshape(blocks, BLOCK, *x.shape[1:])
            rows = rows.at[listed].get(mode="fill", fill_value=0)
            return rows.reshape(few * BLOCK, *x.shape[1:])

        return jax.lax.cond(
            count <= few,
            lambda: drawn(*jax.tree.map(chosen, everything)),
            lambda: drawn(*everything),
        )

    # Frame after frame: the data of one fit a processor's cache, those of nine do not.
    return _as_images(jax.lax.map(one, jax.tree.map(jnp.asarray, camera)), height, width)


def splat_frames(
    frames: Frames,
    camera: Camera,
    height: int,
    width: int,
    *,
    most: int = 3,
    pixels: float = 1.0,
    average: bool = True,
    backs: bool = False,
) -> View:
    """Render the pixels of S frames for other cameras: every pixel with depth becomes a point.

    Args:
        frames: (S, H, W, C) floats as colours, and (S, H, W) depth, metres; pixels with a depth of
            0 are ignored.
        camera: (T,) cameras of images of ``height`` × ``width`` pixels.
        height: see ``camera``.
        width: see ``camera``.
        most: largest size of a point, pixels in each direction; see ``splat_surfels``.
        pixels: width of a point, in pixels of the frame that observed it.
        average: blend the points at the front; otherwise show the nearest. Points of one pixel that
            are neither blended nor hidden by their side are drawn by ``splat``.
        backs: show surfaces from behind too; otherwise a back face hides what lies behind it.

    Returns:
        Views with the frames' colours as features; holes are not filled.
    """
    depth_SHW = jnp.asarray(frames.depth_THW)
    points = unproject(depth_SHW, frames.camera).reshape(-1, 3)
    colours = jnp.asarray(frames.rgb_THWC)
    colours = colours.reshape(-1, colours.shape[-1])
    there = (depth_SHW > 0).reshape(-1)
    if backs and most == 1 and not average:
        return splat(points, colours, there, camera, height, width)
    focal = jnp.asarray(frames.camera.intrinsics_4)[:, 0, None, None]
    sizes = pixels * (depth_SHW / focal).reshape(-1)
    facing = None if backs else depth_images.normals(depth_SHW, frames.camera).reshape(-1, 3)
    how = {"most": most, "average": average, "normals_V3": facing}
    return splat_surfels(points, colours, sizes, there, camera, height, width, **how)


def splat_cells(
    points_V3: Array,
    features_VF: Array,
    cell_m: tuple[float, float, float],
    valid_V: Array,
    camera: Camera,
    height: int,
    width: int,
) -> View:
    """Render cells: each pixel shows one cell, and near cells hide far ones.

    A cell that is taller than wide is drawn as a pile of at most ``PILE`` square ones. Images are
    drawn at most ``RASTER`` pixels long, where a cell covers at most ``REACH`` across and down, and
    their pixels repeated: cells are coarse, and covered pixels are costly. ``cell_m`` is width,
    depth and height of a cell, metres.
    """
    wide, tall = max(cell_m[:2]), cell_m[2]
    pile = min(max(round(tall / wide), 1), PILE)
    rise = np.zeros((pile, 3), np.float32)
    rise[:, 2] = (np.arange(pile) - (pile - 1) / 2) * min(wide, tall / pile)
    points = (points_V3[:, None] + rise).reshape(-1, 3)
    features, valid = jnp.repeat(features_VF, pile, 0), jnp.repeat(valid_V, pile, 0)
    size = jnp.full(len(points), wide, jnp.float32)

    step = -(-max(height, width) // RASTER)
    rows, columns = -(-height // step), -(-width // step)
    small = Camera(jnp.asarray(camera.intrinsics_4) / step, camera.world_from_camera)
    view = splat_surfels(
        points, features, size, valid, small, rows, columns, most=REACH, average=False
    )

    def whole(image: Array) -> Array:
        return jnp.repeat(jnp.repeat(image, step, 1), step, 2)[:, :height, :width]

    return jax.tree.map(whole, view) if step > 1 else view


def _whole_blocks(*arrays_V: Array) -> tuple[Array, ...]:
    """Pad the slots of arrays with zeros to a multiple of ``BLOCK``."""
    missing = -len(arrays_V[0]) % BLOCK
    return tuple(jnp.pad(x, [(0, missing)] + [(0, 0)] * (jnp.ndim(x) - 1)) for x in arrays_V)


def _blocks_in_view(
    projected: ProjectedPoints, height: int, width: int, most: int, few: int
) -> tuple[Array, Array]:
    """Return (few,) blocks that reach into the image, padded with their number; how many do."""
    # A point reaches half of `most` beyond where it is, and its bilinear share one pixel.
    reach = most / 2 + 1
    across = (projected.u_V > -reach) & (projected.u_V < width + reach)
    down = (projected.v_V > -reach) & (projected.v_V < height + reach)
    used = (across & down & projected.valid_V).reshape(-1, BLOCK).any(-1)
    number = jnp.arange(len(used), dtype=jnp.int32)
    place = jnp.where(used, jnp.cumsum(used) - 1, few)
    listed = jnp.full((few,), len(used), jnp.int32).at[place].set(number, mode="drop")
    return listed, used.sum()


def _draw(
    projected: ProjectedPoints,
    features_VF: Array,
    away_V: Array | None,
    height: int,
    width: int,
    most: int,
    average: bool,
) -> tuple[Array, Array, Array]:
    """Return (H·W, F) features, (H·W,) depth and seen; points in ``away_V`` hide others, unseen."""
    count, pixels = len(features_VF), height * width
    front_P, covering = zbuffer.nearest_per_pixel(projected, height, width, most)

    def visible(column: Array, row: Array) -> tuple[Array, Array]:
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = jnp.where(inside, row * width + column, 0)
        front = front_P[pixel]
        shown = projected.valid_V & inside & (projected.z_V <= front + tolerance(front))
        return jnp.where(shown, pixel, pixels), shown

    behind = jnp.zeros(pixels, bool)
    if average:
        total = _shares(projected, features_VF, away_V, visible, pixels)
        direct = total[:, -1] > LEAST
        mean = total / jnp.where(direct, total[:, -1], 1)[:, None]
        if away_V is not None:
            behind = ~direct & (total[:, -2] > LEAST)
            mean = jnp.concatenate([mean[:, :-2], mean[:, -1:]], -1)
        features, depth = mean[:, :-2], mean[:, -2]
    else:
        column, row = (jnp.floor(x).astype(jnp.int32) for x in (projected.u_V, projected.v_V))
        pixel, shown = visible(column, row)
        depth, index = zbuffer.nearest_per_bin(pixel, projected.z_V, shown, pixels)
        direct = index < count
        features = features_VF[jnp.minimum(index, count - 1)]
        if away_V is not None:
            behind = direct & away_V[jnp.minimum(index, count - 1)]
            direct = direct & ~behind
    covered = (covering < count) & ~behind
    if away_V is not None:
        covered = covered & ~away_V[covering.clip(0, count - 1)]
    seen = direct | covered
    features = jnp.where(direct[:, None], features, features_VF[covering.clip(0, count - 1)])
    depth = jnp.where(direct, depth, front_P)
    there = seen if away_V is None else (seen | (covering < count))
    return jnp.where(seen[:, None], features, 0), jnp.where(there, depth, 0), seen


def _shares(
    projected: ProjectedPoints,
    features_VF: Array,
    away_V: Array | None,
    visible: Callable[[Array, Array], tuple[Array, Array]],
    pixels: int,
) -> Array:
    """Return (H·W, F + 2) sums of features, depth, if any the points facing away, and 1."""
    # XLA may recompute positions for each use. A point that is observed again lies at the middle of
    # a pixel, where rounding would be ambiguous: the border between two pixels is shifted.
    u, v = projected.u_V - 0.5, projected.v_V - 0.5
    column, row = (jnp.floor(x + MIDDLE).astype(jnp.int32) for x in (u, v))
    right, below = jnp.maximum(u - column, 0), jnp.maximum(v - row, 0)
    one_V1 = jnp.ones((len(features_VF), 1))
    values_VC = jnp.concatenate([features_VF, projected.z_V[:, None], one_V1], -1)
    if away_V is not None:
        values_VC = jnp.where(away_V[:, None], 0, values_VC)
        away_V1 = away_V[:, None].astype(values_VC.dtype)
        values_VC = jnp.concatenate([values_VC[:, :-1], away_V1, values_VC[:, -1:]], -1)
    places = []
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        pixel, _ = visible(column + i, row + j)
        places.append((pixel, (right if i else 1 - right) * (below if j else 1 - below)))
    # The barrier keeps XLA from recomputing these for every channel.
    places, values_VC = jax.lax.optimization_barrier((places, values_VC))
    total = jnp.zeros((pixels, values_VC.shape[-1]))
    for pixel, weight in places:
        total = total.at[pixel].add(values_VC * weight[:, None], mode="drop")
    return total


def tolerance(depth: Array) -> Array:
    """Return how far behind the front a point may lie and still belong to it, metres."""
    return jnp.maximum(TOLERANCE_M, TOLERANCE_RELATIVE * depth)


def over(front: View, back: View) -> View:
    """Return the first of two views of the same cameras where it shows anything, else the other."""
    seen = front.seen_THW
    return View(
        jnp.where(seen[..., None], front.features_THWF, back.features_THWF),
        jnp.where(seen | (~back.seen_THW & (front.depth_THW > 0)), front.depth_THW, back.depth_THW),
        seen | back.seen_THW,
    )


def fill_nearest(view: View) -> View:
    """Fill unseen pixels from the nearest seen pixel of their image; ``seen_THW`` is unchanged.

    Jump flooding with steps of …, 4, 2, 1 and 1 pixels takes a static number of passes; seldom the
    pixel found is a little farther than the nearest. Images without seen pixels stay empty.
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
