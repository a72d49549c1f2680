"""Long rollouts of several worlds: hundreds of frames from one start by the recorded actions.

PERSIST's protocol (arXiv 2603.03482): windows of 16 frames that end at 200, 400 and 600 imagined
frames of held-out walks are compared with the ground truth as sets (FVD, KVD). In addition, PSNR
per segment of the walk measures stability over time; for ``persist`` worlds also the PSNR of the
renderer given the true voxels (an upper bound), and the score without its voxels.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.metrics.videos import DISTANCES, VideoDistance
from pewm_jax.geometry.actions import PLANAR
from pewm_jax.io.progress import Meter
from pewm_jax.report.pictures import as_bytes
from pewm_jax.types import Camera, Control, Params
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.world import PERSIST

WINDOW = 16
"""Frames per window."""
CHUNK = 40
"""Frames imagined per call."""


@dataclasses.dataclass(frozen=True)
class RecordedWalk:
    """A held-out walk.

    Attributes:
        context: (S,) observed frames, the present last.
        actions_T3: (T, 3) recorded actions after the present frame.
        truth_THWC: (T, H, W, 3) uint8 colours of the frames after these actions.
        camera: (T,) cameras of these frames.
        classes_TXYZ: recorded voxels of these frames, or None.
        origin_T3: their lowest corners, or None.
        first: voxels and corner of the present frame, or None.
    """

    name: str
    context: Any
    actions_T3: np.ndarray
    truth_THWC: np.ndarray
    camera: Camera
    classes_TXYZ: np.ndarray | None
    origin_T3: np.ndarray | None
    first: tuple[np.ndarray, np.ndarray] | None


def read_walk(episode: Episode, start: int, frames: int, context: int) -> RecordedWalk:
    """Read a walk of ``frames`` frames after frame ``start`` of an episode.

    Raises:
        UserError: it is too short, or has no planar actions.
    """
    if start + frames >= episode.length or start + 1 < context:
        raise UserError(
            f"episode {episode.name} has {episode.length} frames, too few for {context} observed "
            f"ones and {frames} more from frame {start} on: collect longer episodes (pewm-jax "
            "data collect DATA --frames …)."
        )
    if episode.actions is None or episode.actions.shape[1] != PLANAR:
        raise UserError(f"episode {episode.name} has no planar actions to drive worlds.")
    after = np.arange(start + 1, start + frames + 1)
    seen = episode.frames(range(start + 1 - context, start + 1))
    true = episode.frames(after)
    found = first = None
    if episode.voxel_grid is not None:
        found, here = episode.voxels(after), episode.voxels([start])
        first = here.classes_TXYZ[0], here.origin_T3[0]
    return RecordedWalk(
        episode.name,
        seen,
        np.asarray(episode.actions[start : start + frames], np.float32),
        true.rgb_THWC,
        true.camera,
        None if found is None else found.classes_TXYZ,
        None if found is None else found.origin_T3,
        first,
    )


def imagine_walks(
    config: Config,
    params: Params,
    walks: Sequence[RecordedWalk],
    *,
    memory: bool = True,
    known: bool = False,
    label: str = "imagining",
) -> np.ndarray:
    """Imagine walks of equal length in one batch; return (B, T, H, W, 3) uint8 colours.

    Without ``memory`` each clip is imagined only from the last frame of the previous one. With
    ``known`` a ``persist`` world starts from the recorded grid of the present frame.
    """
    model = config.model
    each = CHUNK if memory else model.clip.frames - 1
    imagine = functools.partial(worlds.imagine, model, memory=memory)
    imagine = jax.jit(jax.vmap(imagine, (None, 0, 0, 0)))
    if known:
        state = _start_from_grids(config, params, walks)
    else:
        start = jax.jit(jax.vmap(functools.partial(worlds.start, model), (None, 0)))
        state = start(params, _stack([walk.context for walk in walks]))
    actions = np.stack([walk.actions_T3 for walk in walks])
    keys = jax.random.split(jax.random.key(0), len(walks))
    return _in_chunks(
        actions.shape[1],
        each,
        label,
        state,
        lambda state, at: imagine(params, state, actions[:, at : at + each], _fold_keys(keys, at)),
    )


def render_bound(config: Config, params: Params, walks: Sequence[RecordedWalk]) -> np.ndarray:
    """Return the frames that a ``persist`` world renders from the true voxels and cameras."""
    model: PERSIST = config.model
    render = functools.partial(persist.render_true, model)
    render = jax.jit(jax.vmap(render, (None, 0, 0, 0, 0, 0)))
    state = _start_from_grids(config, params, walks)
    whole: Any = _stack(
        [
            (Control(walk.camera, walk.actions_T3), walk.classes_TXYZ, walk.origin_T3)
            for walk in walks
        ]
    )
    keys = jax.random.split(jax.random.key(0), len(walks))

    def made(state: Any, at: int) -> Any:
        part = jax.tree.map(lambda x: x[:, at : at + CHUNK], whole)
        return render(params, state, *part, _fold_keys(keys, at))

    count = walks[0].actions_T3.shape[0]
    return _in_chunks(count, CHUNK, "rendering true voxels", state, made)


def _start_from_grids(config: Config, params: Params, walks: Sequence[RecordedWalk]) -> Any:
    """Return the worlds that start from the recorded grids of the present frames."""
    context = _stack([jax.tree.map(lambda x: x[-1:], walk.context) for walk in walks])
    firsts = [walk.first for walk in walks if walk.first is not None]
    cells, corners = (np.stack(part) for part in zip(*firsts, strict=True))
    start = functools.partial(persist.start_in, config.model)
    return jax.jit(jax.vmap(start, (None, 0, 0, 0)))(params, context, cells, corners)


def stretches(made: np.ndarray, truth: np.ndarray, ends: Sequence[int]) -> list[float]:
    """Return the mean frame PSNR in dB of each segment between consecutive ends."""
    error = np.square(np.asarray(unit_colours(made)) - np.asarray(unit_colours(truth)))
    each = np.asarray(psnr(error.mean((0, 2, 3, 4))))
    return [float(each[low:high].mean()) for low, high in zip((0, *ends[:-1]), ends, strict=True)]


def windows(video_BTHWC: np.ndarray, end: int, count: int) -> np.ndarray:
    """Return the last ``count`` windows of 16 frames before frame ``end`` of every walk."""
    first = max(0, end - count * WINDOW)
    cut = video_BTHWC[:, first:end]
    cut = cut[:, len(cut[0]) % WINDOW :]
    return cut.reshape(-1, WINDOW, *cut.shape[2:])


def distances(
    made: dict[str, np.ndarray],
    truth: np.ndarray,
    ends: Sequence[int],
    count: int,
    i3d: VideoDistance,
) -> dict[str, Any]:
    """Return FVD and KVD of all methods at each end, with their floors."""
    kinds = {kind: dataclasses.replace(i3d, kind=kind) for kind in DISTANCES}
    found: dict[str, Any] = {name: {} for name in made}
    with Meter("I3D", len(ends) * (len(made) + 1), "sets") as meter:
        for end in ends:
            true = i3d.features(windows(truth, end, count))
            meter.advance(1)
            for name, video in made.items():
                seen = i3d.features(windows(video, end, count))
                meter.advance(1)
                found[name][str(end)] = {
                    kind: metric.score(seen, true).facts() for kind, metric in kinds.items()
                }
    return found


def _in_chunks(
    count: int, each: int, label: str, state: Any, make: Callable[[Any, int], Any]
) -> np.ndarray:
    parts = []
    with Meter(label, count, "frames") as meter:
        for at in range(0, count, each):
            state, frames = make(state, at)
            parts.append(as_bytes(np.asarray(frames.rgb_THWC)))
            meter.advance(min(each, count - at))
    return np.concatenate(parts, 1)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def _fold_keys(keys: Any, at: int) -> Any:
    return jax.vmap(jax.random.fold_in, (0, None))(keys, jnp.uint32(at))
