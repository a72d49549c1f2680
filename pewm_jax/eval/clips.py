"""The clips of an evaluation: which are scored, with which context and which actions.

The choice is deterministic. Clips start on the return path of every held-out episode, where the
agent revisits places. Their context is subsampled in the same way for every method, and the
recorded motion drives the model. Equal ``fingerprint`` of protocol and weights implies equal
scores.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from typing import TypeVar

import jax
import numpy as np

from pewm_jax.config import Config, UserError, World, to_dict
from pewm_jax.data.clips import choose_context, join_actions, state_at
from pewm_jax.data.episodes import Episode
from pewm_jax.geometry.actions import PLANAR, actions_between, continuous, integrate
from pewm_jax.types import Array, Camera, Control, Frames

VERSION = 2
"""Increase it whenever the same settings would give different scores."""
POSE_TOLERANCE = 2e-3
"""Largest difference between integrated and recorded poses (metres, matrix entries)."""
ROLLOUTS = 16
"""Largest number of long rollouts, one per episode."""
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class ClipChoice:
    """One clip to imagine.

    Attributes:
        episode: index of the episode.
        start: the present frame; all earlier ones may be context.
        context_S: (S,) frames passed to ``worlds.start``, oldest first, the present last. If an
            episode has fewer, the oldest is repeated as padding; ``load_clip`` sets the depth of
            padding to 0, so that no frame is inserted twice.
        targets_N: (N,) frames to imagine.
    """

    episode: int
    name: str
    scene: str
    start: int
    context_S: tuple[int, ...]
    targets_N: tuple[int, ...]


def context_frames(start: int, count: int) -> tuple[int, ...]:
    """Return ``count`` frames spread over the past as in training, with ``start`` last."""
    spread = choose_context(start, count)
    padded = np.concatenate([np.repeat(spread[:1], count - len(spread)), spread])
    return tuple(int(index) for index in padded)


def return_start(episode: Episode) -> int:
    """Return the frame where the return path begins: the recorded one, or else the middle."""
    frame = episode.info.get("return_frame")
    return episode.length // 2 if frame is None else int(frame)


def choose(config: Config, episodes: Sequence[Episode], clips: int, chain: int) -> list[ClipChoice]:
    """Choose the clips to imagine: starts spread evenly over every episode's return path.

    ``clips`` is the largest number of clips, ``chain`` the number of consecutive ones from each
    start. The first start of every episode comes first, then every second start, and so on, so that
    any prefix of the list covers as many episodes as possible.

    Raises:
        UserError: no episode is long enough.
    """
    length = chain * (config.model.clip.frames - 1) * config.evaluate.stride
    per_episode = -(-clips // max(len(episodes), 1))
    ranked: list[tuple[int, ClipChoice]] = []
    longest = 0
    for index in range(len(episodes)):
        episode = episodes[index]
        longest = max(longest, episode.length)
        last = episode.length - 1 - length
        if last < 0:
            continue
        first = min(return_start(episode), last)
        starts = np.unique(np.round(np.linspace(first, last, per_episode)).astype(int))
        for rank, start in enumerate(starts):
            count = length // config.evaluate.stride
            ranked.append((rank, choice_of(config, episode, index, int(start), count)))
    if not ranked:
        raise UserError(
            f"no episode of {config.data.path}/{config.evaluate.split} is long enough: "
            f"{chain} clips need {length + 1} frames and the longest has {longest}; collect "
            "longer episodes or lower evaluate.chain, video_clips or stride."
        )
    ranked.sort(key=lambda item: item[0])
    return [choice for _, choice in ranked[:clips]]


def choice_of(config: Config, episode: Episode, index: int, start: int, count: int) -> ClipChoice:
    """Return the clip of an episode that starts at a frame."""
    targets = start + config.evaluate.stride * np.arange(1, count + 1)
    return ClipChoice(
        episode=index,
        name=episode.name,
        scene=episode.scene,
        start=start,
        context_S=context_frames(start, config.data.context),
        targets_N=tuple(int(target) for target in targets),
    )


def long_choices(config: Config, episodes: Sequence[Episode]) -> list[ClipChoice]:
    """Choose one long rollout per episode, from the start of its return path.

    There are at most ``ROLLOUTS``, of ``evaluate.video_clips`` clips, or of fewer clips if the
    episodes are too short.

    Raises:
        UserError: no episode is long enough for one clip.
    """
    count = min(ROLLOUTS, len(episodes))
    for chain in range(config.evaluate.video_clips, 1, -1):
        try:
            return choose(config, episodes, count, chain)
        except UserError:
            continue
    return choose(config, episodes, count, 1)


def needs_cameras(episodes: Sequence[Episode], choices: Sequence[ClipChoice]) -> bool:
    """Return whether clips must be driven by cameras, because some motion is not planar."""
    for choice in choices:
        episode = episodes[choice.episode]
        poses = episode.world_from_camera[[choice.start, *choice.targets_N]]
        replayed = np.asarray(integrate(poses[0], np.asarray(actions_between(poses))))
        if np.abs(replayed - poses).max() > POSE_TOLERANCE:
            return True
    return False


def steered_by_record(model: World) -> bool:
    """Return whether only recorded actions can drive a world, because they are not planar."""
    return model.batch_spec.actions not in (0, PLANAR)


def recorded_control(model: World, episode: Episode, frames: Sequence[int]) -> Control:
    """Return the recorded control that leads from the first frame through the N others.

    It has (N,) cameras, (N, A) actions, composed as in training, and the state at the first frame
    if the model needs it; frames are evenly spaced.

    Raises:
        UserError: the episode has no actions or no states, or of another number than the model's.
    """
    wanted = model.batch_spec.actions
    if episode.actions is None:
        raise UserError(
            f"episode {episode.name} has no actions, and this model is steered by actions of "
            f"{wanted} numbers: import the data with their actions."
        )
    actions = join_actions(episode.actions, np.asarray(frames))
    if actions.shape[1] != wanted:
        stride = int(frames[1] - frames[0])
        over = f" over {stride} frames" if stride > 1 else ""
        raise UserError(
            f"episode {episode.name} has actions of {actions.shape[1]} numbers{over}, and this "
            f"model is steered by {wanted}: use the data and the stride (evaluate.stride) that it "
            "was trained with."
        )
    needs_state = "state_A" in model.batch_spec.names
    state = state_at(episode, int(frames[0])) if needs_state else None
    return Control(episode.camera(np.asarray(frames[1:])), actions, state)


def later_control(control: Control, at: int, count: int) -> Control:
    """Return ``count`` frames of the control of a batch of clips, from frame ``at`` on.

    The state of the agent there is the action that leads to the frame before (Eq. 6 of EgoWM).
    """
    actions, state = control.actions_TA, control.state_A
    if state is not None and actions is not None and at:
        state = actions[:, at - 1]
    camera = jax.tree.map(lambda x: x[:, at : at + count], control.camera)
    return Control(camera, None if actions is None else actions[:, at : at + count], state)


def has_geometry(episode: Episode) -> bool:
    """Return whether points of an episode can be located: it has depth and camera poses."""
    return episode.has_depth and has_poses(episode)


def has_poses(episode: Episode) -> bool:
    """Return whether the camera poses of an episode are known."""
    return episode.info.get("poses") != "unknown"


def lacking_geometry(episodes: Sequence[Episode]) -> str:
    """Return a sentence if some episodes lack depth or poses, with what is not measured; or ""."""
    if all(has_geometry(episodes[index]) for index in range(len(episodes))):
        return ""
    return (
        "The data lack depth or camera poses, so there is no reprojection, and no scores over "
        "pixels seen before and never seen."
    )


def load_clip(
    config: Config, episodes: Sequence[Episode], choice: ClipChoice, *, cameras: bool = False
) -> tuple[Frames, Frames, Array | Camera | Control]:
    """Read one chosen clip: S context frames, N ground-truth frames, and the control.

    The control leads from the present through the N frames: (N, 3) actions composed from the
    recorded poses, or with ``cameras`` (``needs_cameras``) the (N,) recorded cameras. If the
    world's actions are not planar, it is ``recorded_control``; if they are and the poses are
    unknown, the (N, 3) recorded actions. Padding frames of the context have depth 0 (not measured)
    everywhere.

    Raises:
        UserError: the recorded actions or the planar motion of the poses do not lead to the
            recorded poses, the frames have another size than the model's, or the episode lacks the
            actions that steer the model.
    """
    episode = episodes[choice.episode]
    context = episode.frames(list(choice.context_S))
    repeated = np.append(np.diff(choice.context_S) == 0, False)  # all but the last copy
    depth = np.where(repeated[:, None, None], 0, context.depth_THW).astype(np.float32)
    context = dataclasses.replace(context, depth_THW=depth)
    targets = episode.frames(list(choice.targets_N))
    size = (config.model.clip.height, config.model.clip.width)
    if targets.rgb_THWC.shape[1:3] != size:
        height, width = targets.rgb_THWC.shape[1:3]
        raise UserError(
            f"episode {choice.name} has frames of {height}×{width} and this model was trained on "
            f"{size[0]}×{size[1]}: collect or import the data at the model's size."
        )
    frames = (choice.start, *choice.targets_N)
    if steered_by_record(config.model):
        return context, targets, recorded_control(config.model, episode, frames)
    if config.model.batch_spec.actions and not has_poses(episode):
        return context, targets, recorded_control(config.model, episode, frames).actions_TA
    if cameras:
        return context, targets, targets.camera
    poses = np.concatenate(
        [context.camera.world_from_camera[-1:], targets.camera.world_from_camera]
    )
    actions_N3 = np.asarray(actions_between(poses))
    _check_motion(np.asarray(_integrate(poses[0], actions_N3)), poses, choice, "planar motion")
    if episode.actions is not None and episode.actions.shape[1] == PLANAR:
        recorded = np.asarray(continuous(config.model.actions, episode.actions))
        steps = recorded[choice.start : choice.targets_N[-1]]
        every = np.asarray(_integrate(poses[0], steps))
        taken = every[[index - choice.start for index in (choice.start, *choice.targets_N)]]
        _check_motion(taken, poses, choice, "recorded actions")
    return context, targets, actions_N3


_integrate = jax.jit(integrate)
"""``integrate``, compiled once per length instead of once per clip."""


def _check_motion(integrated: np.ndarray, poses: np.ndarray, choice: ClipChoice, what: str) -> None:
    error = np.abs(integrated - poses).max((1, 2))
    if error.max() > POSE_TOLERANCE:
        worst = int(error.argmax())
        frame = (choice.start, *choice.targets_N)[worst]
        raise UserError(
            f"episode {choice.name}: at frame {frame} the {what} and the recorded pose disagree "
            f"by {error[worst]:.3g}; run `pewm-jax data validate` on the data."
        )


def stack(trees: list[T], size: int) -> T:
    """Stack pytrees along a new leading axis, repeating the last one up to ``size``."""
    padded = trees + [trees[-1]] * (size - len(trees))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *padded)


def fingerprint(
    config: Config,
    weights: str,
    dataset: str,
    lpips: str = "",
    protocol: str = "",
    baseline: str = "",
) -> str:
    """Return a hash of all that scores depend on, except seeds, reference model and metrics.

    ``weights``, ``dataset`` (the data set's index), ``lpips`` (its weights, "" if it is not
    measured) and, with a protocol, ``baseline`` (the index of the split that chooses the
    reprojection's settings) are sha256; ``protocol`` is the hash of the choices in a protocol file,
    except for seeds.
    """
    settings = to_dict(config)
    for key in ("seeds", "videos", "none", "lpips", "protocol", "fvd", "mirror", "src", "scs"):
        settings["evaluate"].pop(key)
    for key in ("long", "long_frames", "beside", "mechanisms"):
        settings["evaluate"].pop(key)
    for key in ("train", "data"):
        settings.pop(key)
    if not settings["evaluate"]["quantize"]:
        del settings["evaluate"]["quantize"]  # so that earlier hashes stay valid
    settings["context"] = config.data.context
    content = {"version": VERSION, "settings": settings, "weights": weights, "data": dataset}
    content["lpips"] = lpips
    if protocol:
        content |= {"protocol": protocol, "data": baseline}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
