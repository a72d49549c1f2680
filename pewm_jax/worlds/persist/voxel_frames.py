"""Voxel frames of the world ``persist``: sampling of the next one (arXiv 2603.03482).

The present voxels are encoded and enter the transformer's cache. The next ones are sampled from
noise; ``model.kept_logits`` favour the previous class of a cell, by whether it was observed. With
``world_frames.map_embed`` the cells of the map and their mask are an input of the transformer.

A real image is further evidence, without a network: its depth shows which cells are empty and which
hold a surface; these count as observed. In a world of blocks (``memory.pictures cells``) a surface
has the image's colour without the light on it. ``model.observation_logit`` is the advantage, in
nats, that such evidence gives a class when voxels are sampled for a real frame. Imagined frames are
rendered from the voxels, so they are no evidence. Not as published.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.data.voxels import PALETTE
from pewm_jax.geometry import march
from pewm_jax.geometry.actions import camera_numbers
from pewm_jax.geometry.cameras import invert_rigid, transform_points, unproject
from pewm_jax.memory import class_grid
from pewm_jax.memory.class_grid import EMPTY, GUESSED, OBSERVED, UNKNOWN, ClassGrid
from pewm_jax.models.persist import voxel_dit, voxel_vae
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.nn.layers import linear
from pewm_jax.types import Array, Camera, Params
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist.config import PersistModel
from pewm_jax.worlds.persist.state import History, noisy_context


def sample(
    model: PersistModel,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    before_XYZ: Array,
    key: Array,
    evidence: ObservedCells | None = None,
    mask_XYZ: Array | None = None,
) -> Array:
    """Sample a voxel frame: (X, Y, Z) class ids.

    ``history`` gives the action that leads to the frame and the image that conditions it, ``cache``
    those of the frames before. ``middle_3`` is the middle of the window, metres, ``before_XYZ`` are
    its previous cells, and ``mask_XYZ`` states where these come from (``memory.class_grid``).
    ``evidence`` is that of a real image of this frame. With it, cells that are mere guesses are
    unknown if the map is an input: all of them are completed anew from what was observed.
    """
    config, noise = model.backbone.world_frames, model.voxel_noise
    if config.map_embed and evidence is not None and mask_XYZ is not None:
        before_XYZ = jnp.where(mask_XYZ == GUESSED, UNKNOWN, before_XYZ)
    asked = _condition(model, history, middle_3)
    if config.map_embed:
        ids, states = map_input(model, before_XYZ, mask_XYZ, evidence)
        asked["map_BTXYZ"] = ids[None, None], states[None, None]
    shape = (1, 1, *(config.latent_side,) * 3, config.latent_channels)

    def denoise(x: Array, time_B: Array, weight: Array) -> Array:
        del weight
        times = time_B[:, None]
        inputs, network_times = noise.precondition(x, times)
        inputs = inputs.astype(jnp.dtype(model.dtype))
        made, _ = voxel_dit.apply(
            config, params["voxel_dit"], inputs, network_times, **asked, cache=cache
        )
        return noise.to_x0(made.astype(jnp.float32), x, times)

    latents = noise.sample(denoise, jax.random.normal(key, shape))[:, 0]
    return decode_classes(model, params, latents, before_XYZ, evidence, mask_XYZ)


def map_input(
    model: PersistModel,
    before_XYZ: Array,
    mask_XYZ: Array | None,
    evidence: ObservedCells | None,
) -> tuple[Array, Array]:
    """Return the ids and states (X, Y, Z) of a map's cells as the transformer's input.

    Cells of which a real image gives ``evidence`` are observed. Of the kind of a surface it says
    nothing: such a cell has the id of a surface of its colour, unless the map knows its class.
    """
    before = before_XYZ.astype(jnp.int32)
    seen = jnp.zeros(before.shape, bool) if mask_XYZ is None else mask_XYZ == OBSERVED
    states = jnp.where(seen, voxel_dit.SEEN, voxel_dit.GUESS)
    states = jnp.where(before == UNKNOWN, voxel_dit.ABSENT, states)
    if evidence is None:
        return before, states
    surface = evidence.colour_XYZ >= 0
    alike = surface & seen & (before > EMPTY)
    if model.memory.pictures == "cells":
        alike = alike & ((before - 1) % model.memory.colours == evidence.colour_XYZ)
    ids = jnp.where(surface & ~alike, coloured_surface(model, evidence.colour_XYZ), before)
    ids = jnp.where(evidence.air_XYZ, EMPTY, ids)
    return ids, jnp.where(surface | evidence.air_XYZ, voxel_dit.SEEN, states)


def coloured_surface(model: PersistModel, colour: Array) -> Array:
    """Return the id, in the map's input, of a surface of a colour whose kind is not known.

    Images of surfaces do not show the colours of classes: there all colours have the same id.
    """
    colours = model.memory.colours
    known = colour if model.memory.pictures == "cells" else jnp.full_like(colour, colours)
    return model.backbone.voxel_vae.classes + known


def decode_classes(
    model: PersistModel,
    params: Params,
    latents_BxyzC: Array,
    before_XYZ: Array,
    evidence: ObservedCells | None = None,
    mask_XYZ: Array | None = None,
) -> Array:
    """Return the class ids (X, Y, Z) of latents (1, …).

    A cell whose class was known changes only if another class is likelier by the nats of
    ``model.kept_logits``; without ``mask_XYZ`` all known cells count as observed. An unknown cell
    is empty unless a class is likelier by ``model.empty_prior``, or if it lies on a level that is
    not predicted. ``model.observation_logit`` is added to the class that a real image shows.
    """
    config = model.backbone.voxel_vae
    weights, dtype = params["voxel_vae"], jnp.dtype(model.dtype)
    looked = evidence is not None and model.observation_logit > 0
    changed = any(model.kept_logits) or model.empty_prior or looked or model.colour_reach_m
    if not changed:
        made = voxel_vae.decode(config, weights, latents_BxyzC, dtype)[0]
        return _within_storey(model, made, before_XYZ)
    features = voxel_vae.features(config, weights, latents_BxyzC, dtype)[0]
    mask = jnp.full(before_XYZ.shape, OBSERVED, jnp.uint8) if mask_XYZ is None else mask_XYZ
    kept = jnp.asarray(model.kept_logits, jnp.float32)

    def likeliest(slab: tuple[Array, Array, Array, ObservedCells | None]) -> tuple[Array, Any]:
        features, before, mask, evidence = slab
        scores = linear(weights["decoder"]["scores"], features).astype(jnp.float32)
        number, before = jnp.arange(config.classes), before[..., None]
        scores = scores + kept[mask][..., None] * (number == before)
        scores = scores + model.empty_prior * ((before == UNKNOWN) & (number == EMPTY))
        if evidence is not None:
            scores = scores + evidence_logits(model, evidence, config.classes)
        made = scores.argmax(-1).astype(jnp.int32)
        return made, _colour_nats(model, made, scores) if model.colour_reach_m else None

    slab = config.slab or config.side
    whole = features, before_XYZ.astype(jnp.int32), mask, evidence if looked else None
    cut = jax.tree.map(lambda x: x.reshape(-1, slab, *x.shape[1:]), whole)
    made, colours = jax.tree.map(
        lambda x: x.reshape(*before_XYZ.shape, *x.shape[4:]), jax.lax.map(likeliest, cut)
    )
    made = _within_storey(model, made, before_XYZ)
    if colours is None:
        return made
    free = made != before_XYZ
    if evidence is not None:
        free = free & (evidence.colour_XYZ < 0)
    return _agreeing_colours(model, made, colours, free)


MOST_NATS = 4.0
"""Most nats by which one cell makes a colour less likely for its neighbours."""


def _colour_nats(model: PersistModel, made_XYZ: Array, scores: Array) -> Array:
    """Return the nats (X, Y, Z, colours) by which a cell's kind is less likely in other colours."""
    kinds = scores[..., 1:].reshape(*made_XYZ.shape, -1, model.memory.colours)
    kind = jnp.maximum(made_XYZ - 1, 0) // model.memory.colours
    own = jnp.take_along_axis(kinds, kind[..., None, None], -2)[..., 0, :]
    return jnp.maximum(own - own.max(-1, keepdims=True), -MOST_NATS)


def _agreeing_colours(
    model: PersistModel, made_XYZ: Array, nats_XYZC: Array, free_XYZ: Array
) -> Array:
    """Return classes of which the free ones have the colour that is likeliest around them.

    Nats are added over the cells of the same kind within ``model.colour_reach_m``.
    """
    colours, reach = model.memory.colours, round(model.colour_reach_m / model.cell)
    kind_XYZ = jnp.where(made_XYZ > EMPTY, (made_XYZ - 1) // colours, UNKNOWN)

    def of_kind(colour_XYZ: Array, kind: Array) -> tuple[Array, None]:
        same = kind_XYZ == kind
        near = jnp.where(same[..., None], nats_XYZC, 0.0)
        for axis in range(3):
            box = [1, 1, 1, 1]
            box[axis] = 2 * reach + 1
            near = jax.lax.reduce_window(near, 0.0, jax.lax.add, box, (1,) * 4, "SAME")
        return jnp.where(same, near.argmax(-1), colour_XYZ), None

    number = jnp.arange((len(class_grid.names(model.memory)) - 1) // colours)
    colour_XYZ, _ = jax.lax.scan(of_kind, jnp.zeros(made_XYZ.shape, jnp.int32), number)
    agreed = 1 + kind_XYZ * colours + colour_XYZ
    return jnp.where(free_XYZ & (made_XYZ > EMPTY), agreed, made_XYZ).astype(made_XYZ.dtype)


def _within_storey(model: PersistModel, made_XYZ: Array, before_XYZ: Array) -> Array:
    """Return cells of which those on levels that are not predicted are as before, or empty."""
    if model.backbone.world_frames.storey == (0, 0):
        return made_XYZ
    before = jnp.maximum(before_XYZ, EMPTY).astype(made_XYZ.dtype)
    return jnp.where(grid_state.predicted_levels(model), made_XYZ, before)


def add_present(
    model: PersistModel,
    params: Params,
    history: History,
    cache: FrameCache,
    middle_3: Array,
    classes_XYZ: Array,
    key: Array,
    mask_XYZ: Array | None = None,
) -> FrameCache:
    """Encode the present voxels and add them to the cache; unknown ones are noise.

    If the map is an input, later frames read observed tokens only: guesses are in the map.
    """
    config, noise = model.backbone.world_frames, model.voxel_noise
    vae, dtype = model.backbone.voxel_vae, jnp.dtype(model.dtype)
    known = grid_state.known_latents(model, classes_XYZ)
    condition, read = _condition(model, history, middle_3), known
    if config.map_embed:
        ids, states = map_input(model, classes_XYZ, mask_XYZ, None)
        condition["map_BTXYZ"] = ids[None, None], states[None, None]
        read = known & grid_state.any_in_token(model, states == voxel_dit.SEEN)
    ids = jnp.maximum(classes_XYZ, 0).astype(jnp.int32)
    latents = voxel_vae.encode(vae, params["voxel_vae"], ids[None], dtype)[:, None]
    noise_key, unknown_key = jax.random.split(key)
    x, times = noisy_context(noise, latents, noise_key)
    x = jnp.where(known[..., None], x, jax.random.normal(unknown_key, x.shape))
    inputs, network_times = noise.precondition(x, times)
    _, cache = voxel_dit.apply(
        config,
        params["voxel_dit"],
        inputs.astype(dtype),
        network_times,
        **condition,
        known_BTxyz=read[None, None],
        cache=cache,
    )  # type: ignore[assignment]
    return cache


def _condition(model: PersistModel, history: History, middle_3: Array) -> dict[str, Any]:
    """Return the transformer's condition of one voxel frame."""
    config, shown = model.backbone.world_frames, history.shown
    channels = grid_state.picture_channels(model, shown, middle_3)
    camera = camera_numbers(shown.camera, model.clip.width, middle_3)
    return {
        "actions_BTA": history.action_A[None, None],
        "pixels_BThwC": channels[None, None],
        "camera_BTN": camera[None, None] if config.camera_numbers else None,
    }


MOVED_M = 2.5
"""Reach of what has moved, metres, from the cell that is seen to be empty: a door's height."""


def forget_moved(
    model: PersistModel, grid: ClassGrid, start_3: Array, evidence: ObservedCells
) -> ClassGrid:
    """Return a grid without what a real image shows to have moved; see ``model.moving``.

    Surfaces that the image shows stay. ``evidence`` is that of the window at ``start_3``.
    """
    if not model.moving or grid.mask_XYZ is None:
        return grid
    kinds = [name.partition("/")[0] in model.moving for name in class_grid.names(model.memory)]
    classes = grid_state.window(model, grid.classes_XYZ, start_3)
    mask = grid_state.window(model, grid.mask_XYZ, start_3)
    movable = jnp.asarray(kinds)[jnp.maximum(classes, 0)] & (classes > EMPTY) & (mask == OBSERVED)

    def spread(_: int, found: Array) -> Array:
        near = jax.lax.reduce_window(found, False, jax.lax.bitwise_or, (3,) * 3, (1,) * 3, "SAME")
        return near & movable

    steps = math.ceil(MOVED_M / model.cell)
    gone = jax.lax.fori_loop(0, steps, spread, movable & evidence.air_XYZ)
    gone = gone & (evidence.colour_XYZ < 0)
    classes = jnp.where(gone, jnp.asarray(UNKNOWN, classes.dtype), classes)
    mask = jnp.where(gone, jnp.uint8(GUESSED), mask)
    return dataclasses.replace(
        grid,
        classes_XYZ=grid_state.write_window(grid.classes_XYZ, classes, start_3),
        mask_XYZ=grid_state.write_window(grid.mask_XYZ, mask, start_3),
    )


INTO_M = 0.005
"""A measured point belongs to the cell this far behind it, metres; depth has millimetres."""
VOTES = 2
"""Pixels that must show a surface in a cell: a single one may be a ray that clips an edge."""
NEAREST_M = 0.05
"""Cells nearer to the camera than this are not judged, metres."""
SAMPLES = 4
"""Points of a ray in a cell's width, by which the cells that it crosses are found."""
SHIN_M = 0.35
"""Height over the floor at which the agent's body begins, metres: rugs and sills lie below."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ObservedCells:
    """What an image shows of the cells of a window.

    Attributes:
        air_XYZ: bool, whether the cell is empty.
        colour_XYZ: int32 number of the palette's colour of the surface in it, −1 without one.
    """

    air_XYZ: Array
    colour_XYZ: Array


def evidence_logits(model: PersistModel, evidence: ObservedCells, classes: int) -> Array:
    """Return the nats (X, Y, Z, classes) that evidence adds to the scores of classes."""
    number = jnp.arange(classes)
    colours = model.memory.colours
    air = evidence.air_XYZ[..., None] & (number == 0)
    surface = (number > 0) & ((number - 1) % colours == evidence.colour_XYZ[..., None])
    return model.observation_logit * (air | surface)


def observe_cells(
    model: PersistModel, corner_3: Array, rgb_HWC: Array, depth_HW: Array, camera: Camera
) -> ObservedCells:
    """Return what an image shows of a window's cells.

    ``corner_3`` is the window's lowest corner, metres; colours are in [−1, 1]; depth is in metres,
    0 without measurement.
    """
    size, side = model.cell, model.side
    eye = camera.world_from_camera[:3, 3]
    cell, way_HW3 = _cells_met(model, corner_3, depth_HW, camera)
    air, surface = _air_and_surface(model, corner_3, depth_HW, camera, cell)

    # The light on visible cells is known, and so are their own colours.
    borders = march.side_of((way_HW3 + (eye - corner_3)) / size)
    ones = jnp.ones(depth_HW.shape)
    lit = march.light(surface, corner_3, size, eye, way_HW3, ones, borders)
    colour_HW = _nearest_colour(model, (rgb_HWC + 1) / 2 / lit[..., None])
    colours = model.memory.colours
    votes = jnp.zeros((side**3 + 1, colours), jnp.int32)
    votes = votes.at[cell, colour_HW.reshape(-1)].add(1)[:-1]
    colour = votes.argmax(-1).reshape((side,) * 3).astype(jnp.int32)
    return ObservedCells(air, jnp.where(surface, colour, -1))


def visible_cells(
    model: PersistModel, corner_3: Array, depth_HW: Array, camera: Camera, votes: int = VOTES
) -> tuple[Array, Array]:
    """Return which cells of a window depth shows to be empty and which to hold a surface, bool.

    Arguments as for ``observe_cells``; depth may also be that of a rendered grid. ``votes`` is the
    number of pixels that must show a surface.
    """
    cell, _ = _cells_met(model, corner_3, depth_HW, camera)
    return _air_and_surface(model, corner_3, depth_HW, camera, cell, votes)


def _cells_met(
    model: PersistModel, corner_3: Array, depth_HW: Array, camera: Camera
) -> tuple[Array, Array]:
    """Return the flat index of the cell that each pixel shows, side³ if none, and the rays."""
    size, side = model.cell, model.side
    eye = camera.world_from_camera[:3, 3]
    way_HW3 = unproject(depth_HW, camera) - eye
    metres_HW1 = jnp.linalg.norm(way_HW3, axis=-1, keepdims=True)
    behind_HW3 = way_HW3 * (1 + INTO_M / jnp.maximum(metres_HW1, INTO_M)) + (eye - corner_3)
    at = jnp.floor(behind_HW3 / size).astype(jnp.int32)
    met = (depth_HW > 0) & ((at >= 0) & (at < side)).all(-1)
    cell = jnp.where(met, (at[..., 0] * side + at[..., 1]) * side + at[..., 2], side**3)
    return cell.reshape(-1), way_HW3


def _air_and_surface(
    model: PersistModel,
    corner_3: Array,
    depth_HW: Array,
    camera: Camera,
    cell_P: Array,
    votes: int = VOTES,
) -> tuple[Array, Array]:
    side = model.side
    hits = jnp.zeros(side**3 + 1, jnp.int32).at[cell_P].add(1)[:-1]
    surface = (hits >= votes).reshape((side,) * 3)
    empty = _cells_crossed if model.memory.pictures == "cells" else _cells_in_front
    return empty(model, corner_3, depth_HW, camera) & ~surface, surface


def _cells_crossed(model: PersistModel, corner_3: Array, depth_HW: Array, camera: Camera) -> Array:
    """Return the cells (X, Y, Z) that a pixel's ray crosses before its surface: a block is whole.

    Rays are sampled four times in a cell's width, so that a clipped corner may be missed.
    """
    size, side = model.cell, model.side
    eye = camera.world_from_camera[:3, 3]
    way_HW3 = unproject(depth_HW, camera) - eye
    metres_HW = jnp.linalg.norm(way_HW3, axis=-1)
    farthest = side * size * math.sqrt(3)
    steps = (np.arange(math.ceil(farthest / size * SAMPLES)) + 0.5) * size / SAMPLES

    def cross(crossed: Array, metres: Array) -> tuple[Array, None]:
        share_HW = metres / jnp.maximum(metres_HW, INTO_M)
        at = jnp.floor((way_HW3 * share_HW[..., None] + (eye - corner_3)) / size).astype(jnp.int32)
        before = (depth_HW > 0) & (metres > NEAREST_M) & (metres + INTO_M < metres_HW)
        inside = before & ((at >= 0) & (at < side)).all(-1)
        cell = jnp.where(inside, (at[..., 0] * side + at[..., 1]) * side + at[..., 2], side**3)
        return crossed.at[cell.reshape(-1)].set(True), None

    crossed, _ = jax.lax.scan(cross, jnp.zeros(side**3 + 1, bool), steps.astype(np.float32))
    return crossed[:-1].reshape((side,) * 3)


def body_cells(model: PersistModel, corner_3: Array, eye_3: Array) -> Array:
    """Return (X, Y, Z) bool: the cells of a window that an agent with this camera stands in.

    The body is a cylinder of radius ``model.body_m`` from ``SHIN_M`` above the floor to the eyes.
    """
    size, side = model.cell, model.side
    low_S3 = corner_3 + np.arange(side)[:, None] * size
    gap_S3 = jnp.abs(jnp.clip(eye_3, low_S3, low_S3 + size) - eye_3)
    wide_XY = jnp.square(gap_S3[:, None, 0]) + jnp.square(gap_S3[None, :, 1]) <= model.body_m**2
    floor = eye_3[2] - model.memory.eye_m
    tall_Z = (low_S3[:, 2] + size > floor + SHIN_M) & (low_S3[:, 2] <= eye_3[2])
    return wide_XY[..., None] & tall_Z


def _cells_in_front(model: PersistModel, corner_3: Array, depth_HW: Array, camera: Camera) -> Array:
    """Return the cells (X, Y, Z) in front of the measured depth in their direction."""
    size, side = model.cell, model.side
    steps = (np.arange(side) + 0.5) * size
    middle = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).astype(np.float32)
    place = transform_points(invert_rigid(camera.world_from_camera), middle + corner_3)
    far = jnp.maximum(place[..., 2], NEAREST_M)
    fx, fy, cx, cy = camera.intrinsics_4
    column = jnp.floor(place[..., 0] / far * fx + cx).astype(jnp.int32)
    row = jnp.floor(place[..., 1] / far * fy + cy).astype(jnp.int32)
    height, width = depth_HW.shape
    within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    measured = depth_HW[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    return within & (place[..., 2] > NEAREST_M) & (place[..., 2] + size / 2 < measured)


def _nearest_colour(model: PersistModel, rgb_HW3: Array) -> Array:
    """Return the number of the nearest colour of the palette, (H, W)."""
    count = model.memory.colours
    palette = np.array(list(PALETTE.values())[:count], np.float32) / 255
    return jnp.square(rgb_HW3[..., None, :] - palette).sum(-1).argmin(-1)
