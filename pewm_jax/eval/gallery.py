"""Draw the images and videos of a report from stored long rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from pewm_jax.config import Config
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import ClipChoice, has_geometry, load_clip
from pewm_jax.eval.long_rollouts import LongRollouts
from pewm_jax.eval.metrics.images import TOLERANCE_M, TOLERANCE_RELATIVE, seen_masks
from pewm_jax.geometry.actions import heading
from pewm_jax.report.evaluation_page import Gallery
from pewm_jax.report.pictures import (
    after_present,
    as_bytes,
    dim,
    enlarge,
    farthest,
    from_above,
    grid,
    map_bounds,
    picture_steps,
)
from pewm_jax.report.video import encode_gif, encode_h264, side_by_side, small_frames
from pewm_jax.types import Frames

ABOVE_CAMERA_M = 0.4
"""Height above the camera from which map cells are omitted in the top view, metres."""
DOT_M = 0.1
"""Size at which points of a memory without cells are drawn, metres."""
CAPTIONS = {
    "truth": "truth",
    "memory": "with its map",
    "empty": "empty map",
    "model": "no memory",
    "reproject": "reprojected",
}
"""The ground truth and the methods in images, in order, with their labels."""
HOLD = 4
"""Number of video frames for which the observed image is shown."""
MASKS_NOTE = (
    "Pixels that count as seen before are in colour, the others grey. A pixel counts as seen if "
    "its true 3D point projects into an observed frame whose true depth agrees within the larger "
    f"of {100 * TOLERANCE_M:.0f} cm and {100 * TOLERANCE_RELATIVE:.0f} %. No network is involved."
)
ABOVE_NOTE = (
    "Each square is one cell of the model's 3D map in its stored colour, drawn from bottom to top. "
    f"Cells more than {ABOVE_CAMERA_M:g} m above the camera (the ceiling) are omitted. The red "
    "line is the agent's path through the frames from which the map was built, the arrow its view "
    "direction. On the right: the same map after the rollout of the stills above, including its "
    "imagined frames."
)


@dataclasses.dataclass(frozen=True)
class _Rollout:
    """A long rollout; by method its colours and depth from the present frame on, T + 1 frames."""

    choice: ClipChoice
    context: Frames
    truth: Frames
    seen_THW: np.ndarray
    frames: dict[str, tuple[np.ndarray, np.ndarray]]


def make_gallery(config: Config, episodes: Sequence[Episode], long: LongRollouts) -> Gallery:
    """Draw the images and encode the videos.

    The images show the rollout with the most pixels seen before. This choice depends only on
    geometry, never on a method's scores.
    """
    shown = [_gather(config, episodes, long, index) for index in range(long.shown)]
    best = max(range(len(shown)), key=lambda index: float(shown[index].seen_THW.mean()))
    rollout = shown[best]
    count = len(rollout.truth.depth_THW)
    steps = picture_steps(count)
    names = ["observed" if step == 0 else f"step {step}" for step in steps]
    rows = [(CAPTIONS[name], list(rgb[steps])) for name, (rgb, _) in rollout.frames.items()]
    truth, seen = rows[0][1], np.concatenate([rollout.seen_THW[:1] | True, rollout.seen_THW])
    masked = [
        dim(enlarge(picture, 128), _enlarge_mask(mask, 128))
        for picture, mask in zip(truth, seen[steps], strict=True)
    ]
    return Gallery(
        videos=[_video(config, long, item) for item in shown],
        strip=grid(rows, names),
        strip_note=(
            f"Episode {rollout.choice.name} from frame {rollout.choice.start}; steps "
            f"{', '.join(str(step) for step in steps[1:])} of {count}. Of the {long.shown} "
            "rollouts shown above it is the one with the most pixels seen before."
        ),
        moving=_moving(rollout),
        masks=grid([rows[0], ("seen before", masked)], names)
        if has_geometry(episodes[rollout.choice.episode])
        else None,
        masks_note=MASKS_NOTE,
        above=_above(config, long, best, rollout)
        if "first_points" in long.kept.get("memory", {})
        else None,
        above_note=ABOVE_NOTE,
        rows=[
            {name: np.concatenate(list(rgb[steps]), 1) for name, (rgb, _) in item.frames.items()}
            for item in shown
        ],
    )


def _gather(
    config: Config, episodes: Sequence[Episode], long: LongRollouts, index: int
) -> _Rollout:
    choice = long.scored.choices[index]
    context, truth, _ = load_clip(config, episodes, choice, cameras=True)
    seen = np.zeros(truth.depth_THW.shape, bool)
    if has_geometry(episodes[choice.episode]):
        seen = np.asarray(seen_masks(truth, context)[0])
    made = {"truth": (truth.rgb_THWC, truth.depth_THW)}
    made |= {name: (kept["rgb"][index], kept["depth"][index]) for name, kept in long.kept.items()}
    frames = {name: after_present(context, *made[name]) for name in CAPTIONS if name in made}
    return _Rollout(choice, context, truth, seen, frames)


def _enlarge_mask(mask_HW: np.ndarray, width: int) -> np.ndarray:
    factor = max(1, width // mask_HW.shape[1])
    big = np.repeat(np.repeat(mask_HW, factor, 0), factor, 1)
    rows = np.linspace(0, big.shape[0] - 1, round(mask_HW.shape[0] * width / mask_HW.shape[1]))
    columns = np.linspace(0, big.shape[1] - 1, width)
    return big[np.round(rows).astype(int)][:, np.round(columns).astype(int)]


def _video(config: Config, long: LongRollouts, item: _Rollout) -> tuple[str, bytes]:
    columns = [(CAPTIONS[name], rgb, depth) for name, (rgb, depth) in item.frames.items()]
    count = len(item.truth.depth_THW)
    share = item.seen_THW.mean((1, 2))
    footers = ["the present frame, observed by all"] + [
        f"imagined frame {t + 1} of {count}: {100 * share[t]:.0f} % of its pixels were seen before"
        for t in range(count)
    ]
    pictures = side_by_side(columns, footers, far_m=farthest(item.truth))
    per_clip = config.model.clip.frames - 1
    caption = (
        f"{item.choice.name}, from frame {item.choice.start}: {count} frames imagined in "
        f"{long.chain} clips of {per_clip}, stride {config.evaluate.stride}, sampling seed "
        f"{config.evaluate.seeds[0]}."
    )
    return caption, encode_h264([pictures[0]] * (HOLD - 1) + pictures)


def _moving(item: _Rollout) -> bytes:
    frames = small_frames([(CAPTIONS[name], rgb) for name, (rgb, _) in item.frames.items()])
    return encode_gif([frames[0]] * (HOLD - 1) + frames)


def _above(config: Config, long: LongRollouts, index: int, item: _Rollout) -> np.ndarray:
    """Draw the map before and after a rollout side by side, at the same scale."""
    kept = long.kept["memory"]
    poses = np.asarray(item.context.camera.world_from_camera)
    later = np.asarray(item.truth.camera.world_from_camera)
    ceiling = poses[-1, 2, 3] + ABOVE_CAMERA_M
    clouds = []
    for when in ("first", "last"):
        valid = kept[f"{when}_valid"][index] & (kept[f"{when}_points"][index][:, 2] < ceiling)
        points = kept[f"{when}_points"][index][valid]
        shades = config.model.point_colours(kept[f"{when}_features"][index][valid])
        clouds.append((points, as_bytes(np.asarray(shades))))
    bounds = map_bounds(*[points for points, _ in clouds], poses[:, :3, 3])
    panels = []
    tracks = [("after the observed frames", poses), ("after the imagined frames", later)]
    for (title, track), (points, shades) in zip(tracks, clouds, strict=True):
        path = track if track is poses else np.concatenate([poses[-1:], track])
        yaw = float(heading(track[-1]))
        cell_m: Any = config.model.facts.cell_m or (DOT_M,) * 3
        panels.append(
            from_above(points, shades, cell_m, path[:, :3, 3], yaw, title=title, bounds=bounds)
        )
    return np.concatenate(panels, 1)
