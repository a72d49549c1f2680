"""Clips cut from episodes: the frames to generate, and earlier frames as context."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.geometry.actions import PLANAR, compose
from pewm_jax.types import Clip

ReadFeatures: TypeAlias = Callable[[Episode, np.ndarray], np.ndarray]
"""``read(episode, frames_S) -> features_ShwF``: cached features of an episode's frames."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Frame numbers of one clip inside its episode.

    Attributes:
        frames_T: (T,) increasing, evenly spaced.
        context_S: (≤ S,) increasing; the last one is ``frames_T[0]``.
    """

    frames_T: np.ndarray
    context_S: np.ndarray


def choose(config: Config, length: int, rng: np.random.Generator, where: str = "episode") -> Choice:
    """Draw a clip from an episode of ``length`` frames: stride, start and context frames.

    Every stride of ``data.stride_min … stride_max`` that fits is equally likely, and so is every
    start. The context has the clip's first frame and one frame from each of S − 1 equal parts of
    the past, the last of which is the frame just before the clip.

    Raises:
        UserError: the episode, named ``where``, is too short for one clip.
    """
    steps = config.model.clip.frames - 1
    largest = min(config.data.stride_max, (length - 1) // steps)
    if largest < config.data.stride_min:
        need = steps * config.data.stride_min + 1
        raise UserError(
            f"{where} has {length} frames, a clip of {config.model.clip.frames} frames at stride "
            f"{config.data.stride_min} needs {need}; collect longer episodes, or lower "
            "data.stride_min or clip.frames."
        )
    stride = int(rng.integers(config.data.stride_min, largest + 1))
    start = int(rng.integers(0, length - steps * stride))
    return Choice(
        start + stride * np.arange(steps + 1), choose_context(start, config.data.context, rng)
    )


def choose_context(start: int, slots: int, rng: np.random.Generator | None = None) -> np.ndarray:
    """Return the context frames of a clip: at most ``slots``, increasing, the last is ``start``.

    ``rng`` draws the frame of each part of the past; None takes the middle one.
    """
    past = slots - 1
    if start <= past:
        earlier = np.arange(start)
    else:
        edges = np.linspace(0, start, past + 1) if past else np.zeros(1)
        at = np.full(past, 0.5) if rng is None else rng.random(past)
        earlier = np.floor(edges[:-1] + at * np.diff(edges)).astype(int)
        earlier = np.minimum(earlier, start - 1)
        if past:
            earlier[-1] = start - 1
        earlier = np.unique(earlier)
    return np.append(earlier, start)


def cut(
    episode: Episode,
    choice: Choice,
    slots: int,
    features: ReadFeatures | None = None,
    *,
    voxels: bool = True,
    state: bool = False,
) -> Clip:
    """Decode the frames of a clip, each once, and compose its actions.

    Args:
        episode: the episode.
        choice: the frames of the clip.
        slots: S; slots without a frame are black, have no depth and the camera of the clip's
            first frame, and are marked invalid.
        features: reads the context's features, if they are cached; slots without a frame have the
            features of the clip's first frame.
        voxels: whether the grids around the agent are read, if the episode has them.
        state: whether the agent's state at the clip's first frame is read, ``state_A``.

    Returns:
        A NumPy clip without batch axis: rgb uint8, depth float32 metres, and the actions and the
        grids around the agent that the episode has.

    Raises:
        UserError: the episode has no states, and one is to be read.
    """
    wanted, place = np.unique([*choice.frames_T, *choice.context_S], return_inverse=True)
    frames = episode.frames(wanted)
    count = len(choice.frames_T)
    valid = np.arange(slots) < len(choice.context_S)
    fill = np.full(slots, place[0])
    fill[: len(choice.context_S)] = place[count:]
    context = jax.tree.map(lambda x: x[fill], frames)
    context.rgb_THWC[~valid] = 0
    context.depth_THW[~valid] = 0
    extras = {}
    if features is not None:
        extras["context_features_ShwF"] = features(episode, wanted[fill])
    if voxels and episode.voxel_grid is not None:
        found = episode.voxels(choice.frames_T)
        extras |= {"classes_TXYZ": found.classes_TXYZ, "origin_T3": found.origin_T3}
    if state:
        extras["state_A"] = state_at(episode, int(choice.frames_T[0]))
    return Clip(
        jax.tree.map(lambda x: x[place[:count]], frames),
        context,
        valid,
        None if episode.actions is None else join_actions(episode.actions, choice.frames_T),
        extras,
    )


def state_at(episode: Episode, frame: int) -> np.ndarray:
    """Return the (A,) float32 state of the agent at a frame.

    Raises:
        UserError: the episode has no states.
    """
    if episode.states is None:
        raise UserError(
            f"episode {episode.name} has no states of the agent, which this model needs: collect "
            "with --body, import data that have them, or use control.state 0."
        )
    return episode.states[frame].astype(np.float32)


def join_actions(actions_TA: np.ndarray, frames_T: np.ndarray) -> np.ndarray:
    """Return the (T − 1, A) float32 actions that lead from each frame of a clip to the next.

    Action k leads from frame k to frame k + 1 of the episode; the clip's frames are evenly spaced.
    The actions between two of them become one: the motions of planar actions (A = 3) are composed;
    actions of other kinds are concatenated, (T − 1, stride · A).
    """
    stride = int(frames_T[1] - frames_T[0]) if len(frames_T) > 1 else 1
    steps_TSA = actions_TA[frames_T[:-1, None] + np.arange(stride)]
    if actions_TA.shape[1] == PLANAR:
        return compose(steps_TSA)
    return steps_TSA.reshape(len(steps_TSA), stride * actions_TA.shape[1]).astype(np.float32)


def stack(clips: Sequence[Clip]) -> Clip:
    """Stack clips to a batch: every array gets a leading B.

    Raises:
        UserError: some clips have actions or voxels and others have none, or have another size.
    """

    def optional(field: str, parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
        shapes = {None if part is None else np.shape(part) for part in parts}
        if len(shapes) > 1:
            sizes = " and ".join(sorted("none" if s is None else str(s) for s in shapes))
            raise UserError(
                f"clips of one batch have {field} of different shapes ({sizes}): use episodes that "
                "record the same, and one stride where actions are not planar (dx, dy, dyaw)."
            )
        return None if None in shapes else np.stack(list(parts))  # type: ignore[arg-type]

    names = dict.fromkeys(name for clip in clips for name in clip.extras)
    found = {name: optional(name, [clip.extras.get(name) for clip in clips]) for name in names}
    required = [(clip.frames, clip.context, clip.context_valid_S) for clip in clips]
    stacked, context, valid = jax.tree.map(lambda *parts: np.stack(parts), *required)
    return Clip(
        stacked,
        context,
        valid,
        optional("actions_TA", [clip.actions_TA for clip in clips]),
        {k: v for k, v in found.items() if v is not None},
    )
