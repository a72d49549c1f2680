"""Long rollouts of several worlds: hundreds of frames from one start by the recorded actions.

``write_report`` writes the scores as JSON and as a page, with a strip of images and a video.

PERSIST's protocol (arXiv 2603.03482): windows of 16 frames that end at 200, 400 and 600 imagined
frames of held-out walks are compared with the ground truth as sets (FVD, KVD). In addition, PSNR
per segment of the walk measures stability over time; for ``persist`` worlds also the PSNR of the
renderer given the true voxels (an upper bound), and the score without its voxels.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.metrics.videos import VideoDistance
from pewm_jax.geometry.actions import PLANAR
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter
from pewm_jax.report.page import Facts, Figure, Section, Text, render
from pewm_jax.report.pictures import as_bytes, grid, save_png
from pewm_jax.report.table import Cell, row
from pewm_jax.report.video import encode_h264, small_frames
from pewm_jax.types import Camera, Control, Params
from pewm_jax.worlds.persist import world as persist
from pewm_jax.worlds.persist.world import PERSIST

WINDOW = 16
"""Frames per window."""
CHUNK = 40
"""Frames imagined per call."""
SHOWN = 8
"""Number of frames of a walk in the strip."""
FRAMES_PER_SECOND = 12
NAMES = {
    "truth": "truth",
    "bound": "its renderer, true voxels",
    "known": "started from a known grid",
    "world": "the world itself",
    "without": "without its voxels",
}
"""Labels of the methods; other worlds are labelled with their run's name."""


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
    if known:
        state = _start_from_grids(config, params, walks)
    else:
        state = start_walks(config, params, walks)
    actions = np.stack([walk.actions_T3 for walk in walks])
    return imagine_actions(config, params, state, actions, memory=memory, label=label)[0]


def start_walks(config: Config, params: Params, walks: Sequence[RecordedWalk]) -> Any:
    """Return the states of worlds that have observed the frames before each walk."""
    start = jax.jit(jax.vmap(functools.partial(worlds.start, config.model), (None, 0)))
    return start(params, _stack([walk.context for walk in walks]))


def imagine_actions(
    config: Config,
    params: Params,
    state: Any,
    actions_BT3: np.ndarray,
    *,
    memory: bool = True,
    label: str = "imagining",
) -> tuple[np.ndarray, Any]:
    """Imagine worlds from their states; return (B, T, H, W, 3) uint8 colours and the states."""
    model = config.model
    each = CHUNK if memory else model.clip.frames - 1
    imagine = functools.partial(worlds.imagine, model, memory=memory)
    # A batch would sample the voxels of every frame, whether cells are new in it or not.
    one_by_one = getattr(model, "sampled", "always") == "new"
    imagine = jax.jit(_mapped(imagine) if one_by_one else jax.vmap(imagine, (None, 0, 0, 0)))
    keys = jax.random.split(jax.random.key(0), len(actions_BT3))
    return _in_chunks(
        actions_BT3.shape[1],
        each,
        label,
        state,
        lambda state, at: imagine(
            params, state, actions_BT3[:, at : at + each], _fold_keys(keys, at)
        ),
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
    return _in_chunks(count, CHUNK, "rendering true voxels", state, made)[0]


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
    kinds = i3d.kinds()
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


def _mapped(imagine: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the same arguments with a leading B, which maps one after the other."""

    def mapped(params: Params, *batch: Any) -> Any:
        return jax.lax.map(lambda one: imagine(params, *one), batch)

    return mapped


def _in_chunks(
    count: int, each: int, label: str, state: Any, make: Callable[[Any, int], Any]
) -> tuple[np.ndarray, Any]:
    parts = []
    with Meter(label, count, "frames") as meter:
        for at in range(0, count, each):
            state, frames = make(state, at)
            parts.append(as_bytes(np.asarray(frames.rgb_THWC)))
            meter.advance(min(each, count - at))
    return np.concatenate(parts, 1), state


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def _fold_keys(keys: Any, at: int) -> Any:
    return jax.vmap(jax.random.fold_in, (0, None))(keys, jnp.uint32(at))


def write_report(
    folder: Path, facts: Mapping[str, Any], videos: Mapping[str, np.ndarray], ends: Sequence[int]
) -> Path:
    """Write the report and return the page's path.

    ``facts`` are plain values: ``psnr`` and optionally ``distances`` by method, ``edits``,
    ``protocol``; ``videos`` are (B, T, H, W, 3) uint8 colours by method, ``truth`` first; ``ends``
    the last frames of the segments.
    """
    folder.mkdir(parents=True, exist_ok=True)
    atomic.write_text(folder / "horizon.json", json.dumps(facts, indent=1) + "\n")
    count = next(iter(videos.values())).shape[1]
    frames = np.linspace(0, count - 1, SHOWN).round().astype(int)
    rows = [(_name(name), [video[0, t] for t in frames]) for name, video in videos.items()]
    save_png(folder / "horizon.png", grid(rows, [str(t + 1) for t in frames], cell=112))
    columns = [(_name(name), video[0]) for name, video in videos.items()]
    pictures = [x[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2] for x in small_frames(columns)]
    with atomic.replacing(folder / "horizon.mp4") as partial:
        partial.write_bytes(encode_h264(pictures, FRAMES_PER_SECOND))
    page = folder / "horizon.html"
    atomic.write_text(page, _page(facts, ends))
    return page


def lines(facts: Mapping[str, Any], ends: Sequence[int]) -> list[str]:
    """Return the lines for the terminal: one per method."""
    said = [f"PSNR in dB of frames {', '.join(_spans(ends))}:"]
    for name, values in facts["psnr"].items():
        said.append(f"  {_name(name):<26}" + "  ".join(f"{value:6.2f}" for value in values))
    for name, found in facts.get("distances", {}).items():
        scores = ", ".join(
            f"{end}: FVD {one['fvd']['value']:.0f}, KVD {one['kvd']['value']:.2f} "
            f"({one['fvd']['clips']} clips)"
            for end, one in found.items()
        )
        said.append(f"  {_name(name)}: {scores}")
    return [*said, *sentences(facts)]


def sentences(facts: Mapping[str, Any]) -> list[str]:
    """Return sentences about a voxel world: its autoencoder, and blocks placed in it."""
    said = []
    if "autoencoder" in facts:
        back = facts["autoencoder"]
        said.append(
            f"The 3D VAE reconstructs {100 * back['occupied']:.1f} % of the occupied cells with "
            f"their class ({100 * back['filled']:.1f} % as occupied) and {100 * back['empty']:.1f} "
            f"% of the empty ones, of {back['grids']} recorded grids."
        )
    if "edits" in facts:
        edits = facts["edits"]
        said.append(
            f"Placed blocks that persisted: {edits['stayed']} of {edits['trials']} "
            f"({100 * edits['share_of_cells']:.0f} % of their cells; {edits['without_room']} more "
            f"walks had no room); in {edits['frames_in_window']} of {edits['frames']} frames a "
            "part was in the window that may change, where a known cell changes if another class "
            f"is likelier by {edits['persistence_logit']:g} nats. The image changed at the block "
            f"in {edits['changed_in_sight']} of {edits['frames_in_sight']} frames in which it was "
            "visible."
        )
    return said


def _spans(ends: Sequence[int]) -> list[str]:
    """Return the names of the segments between ends, such as 1–200 and 201–400."""
    return [f"{low + 1}–{high}" for low, high in zip((0, *ends[:-1]), ends, strict=True)]


def _name(name: str) -> str:
    return NAMES.get(name, name)


def _page(facts: Mapping[str, Any], ends: Sequence[int]) -> str:
    rows = [row(_name(name), *map(Cell, values)) for name, values in facts["psnr"].items()]
    sections = [Section.of_table("PSNR in dB, by frames", ["", *_spans(ends)], rows)]
    if "bound" in facts["psnr"]:
        note = "The renderer with the true voxels and cameras is an upper bound of the world."
        sections.append(Section.of_note(note))
    if facts.get("distances"):
        heads = ["", "frames before", "FVD", "KVD", "clips"]
        rows = []
        for name, found in facts["distances"].items():
            for end, one in found.items():
                values = Cell(one["fvd"]["value"], 0), Cell(one["kvd"]["value"])
                rows.append(row(_name(name), end, *values, str(one["fvd"]["clips"])))
        sections.append(Section.of_table("Windows of 16 frames, as sets", heads, rows))
    strip = Figure("horizon.png", alt="Frames of a walk.")
    film = Figure("horizon.mp4", media="video/mp4")
    sections.append(Section("", [*map(Text, sentences(facts)), strip, film]))
    protocol = [(str(name), str(value)) for name, value in facts["protocol"].items()]
    sections.append(Section("How it was measured", [Facts(protocol)]))
    opening = (
        "Each walk starts with a few observed frames and continues with the recorded actions only."
    )
    return render("Long horizons", [Text(opening, "lead")], sections)
