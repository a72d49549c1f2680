"""Measure whether actions steer a world: imagine clips with true, shuffled and no actions.

A world that follows its actions is closest to the ground truth with the true ones. *Shuffled*
actions are those of a clip in another house. *None* are zero embeddings, as observed frames have;
*unembedded* the same for models that the cameras reach in other ways, too: by warping the observed
frame, by rays or by drawings, which stay as they are.
*Copy* is a baseline without a network that repeats the observed frame; *warp*, for worlds that get
it warped, shows it by its depth from the camera to which the actions lead, holes filled from the
nearest pixel; *paint*, for worlds that draw the agent's arms, does so without the agent's body and
paints its bones in one colour. ``walks`` chooses the clips.

Every kind of actions is scored by the squared error of colours and, where they can be measured, by
LPIPS, by SCS with exact masks of the true clip, and by the IoU of the agent's arms with the truth.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.bodies.humanoid import BODIES, arm_ids
from pewm_jax.bodies.kinematics import Body
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import AssembledModel, Config, UserError
from pewm_jax.controls.skeleton import draw_bones
from pewm_jax.data.clips import state_at
from pewm_jax.data.episodes import Episode
from pewm_jax.eval import statistics
from pewm_jax.eval.clips import ClipChoice, load_clip, stack
from pewm_jax.eval.metrics.arms import arms_by_colour, arms_iou
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.metrics.perceptual import LPIPS
from pewm_jax.eval.metrics.selection import select_lpips, select_scs
from pewm_jax.eval.metrics.structure import Consistency, average
from pewm_jax.eval.runner import workers
from pewm_jax.eval.scoring import Tracked, tracked_of
from pewm_jax.eval.walks import Walks, choose_walks
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ResultCache, map_resumable
from pewm_jax.memory import rendering
from pewm_jax.report.labels import steering_table
from pewm_jax.types import Array, Camera, Control, Frames, Params
from pewm_jax.worlds import world_model
from pewm_jax.worlds.control import control_of

TRUE, SHUFFLED, NONE, UNEMBEDDED, TRUTH = "true", "shuffled", "none", "unembedded", "truth"
COPY, WARP, PAINT = "copy", "warp", "paint"
"""Kinds of actions; ``truth`` is the true clip, the ceiling of scores that need a segmentation."""
ARMS_RGB = (163, 4, 162)
"""Mean colour of arms in 180 frames of 15 training episodes of ``egowm_humanoid``."""
PAINTED = float(np.exp(-1))
"""Values of the drawn bones above this are painted: within their radius, which gave the best IoU
with the arms of the same frames."""
SMALLER = ("lpips",)
"""Scores of which smaller values are better."""
SCORES = ("lpips", "scs", "arms")
"""The scores beside PSNR, in the order of reports."""


@dataclasses.dataclass(frozen=True)
class Measures:
    """What is measured beside the error of colours; None and False for what is not."""

    lpips: LPIPS | None = None
    structure: Consistency | None = None
    arms: bool = False

    @classmethod
    def chosen(cls, config: Config, episodes: Sequence[Episode]) -> Measures:
        """Return what ``config.evaluate`` asks for and the episodes allow."""
        clip, settings = config.model.clip, config.evaluate
        ids = all(episodes[k].has_ids for k in range(len(episodes)))
        return cls(
            select_lpips(settings.lpips, clip.height, clip.width)[0],
            select_scs(settings.scs, ids=ids)[0],
            shows_arms(episodes),
        )

    @property
    def names(self) -> dict[str, str]:
        """Return the headings of the scores that are measured."""
        found = {}
        if self.lpips is not None:
            found["lpips"] = f"LPIPS[{self.lpips.encoder}]"
        if self.structure is not None:
            found["scs"] = self.structure.name
        if self.arms:
            found["arms"] = "IoU of the arms"
        return found

    @property
    def key(self) -> str:
        """Return a text of all that the scores depend on beside the clips, for file names."""
        parts = ["arms"] * self.arms
        if self.lpips is not None:
            parts.append(f"lpips-{self.lpips.sha256[:16]}")
        if self.structure is not None:
            parts += ["scs", self.structure.encoder, self.structure.sha256[:16]]
        return "-".join(filter(None, parts)) or "colours"


def shows_arms(episodes: Sequence[Episode]) -> bool:
    """Return whether all episodes have the instance ids of an agent's arms."""
    found = [episodes[k] for k in range(len(episodes))]
    return bool(found) and all(one.has_ids and arm_ids(one.info) for one in found)


@dataclasses.dataclass(frozen=True)
class Steered:
    """The results.

    Attributes:
        errors: kind of actions → (C, N) mean squared colour errors of each imagined frame.
        walks: the clips.
        scores: name in ``SCORES`` → kind → (C, 1 + N): of the whole clip, then of each frame; NaN
            where there is none.
        names: name in ``SCORES`` → heading.
    """

    errors: Mapping[str, np.ndarray]
    walks: Walks
    scores: Mapping[str, Mapping[str, np.ndarray]] = dataclasses.field(default_factory=dict)
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def psnr(self) -> dict[str, np.ndarray]:
        """Return the PSNR of each clip in dB, by kind of actions."""
        return {name: np.asarray(psnr(each.mean(1))) for name, each in self.errors.items()}

    def table(self) -> dict[str, dict[str, Any]]:
        """Return means over houses with intervals, and the margins of the true actions."""
        return self._entries(self.psnr)

    def per_frame(self) -> dict[str, dict[str, Any]]:
        """Return ``table`` with a list over imagined frames in place of each number."""
        return self._entries({name: np.asarray(psnr(x)) for name, x in self.errors.items()})

    def facts(self) -> dict[str, Any]:
        """Return the results for ``metrics.json``; ``docs/evaluation.md`` describes them."""
        return {
            "clips": len(self.walks.choices),
            "forward": float(self.walks.forward_C.mean()),
            "different": float(self.walks.different_C.mean()),
            "recorded": self.walks.recorded,
            "all": self.table(),
            "per_frame": self.per_frame(),
            "scores": {
                name: {
                    "name": self.names[name],
                    "all": self._entries({kind: x[:, 0] for kind, x in kinds.items()}),
                    "per_frame": self._entries({kind: x[:, 1:] for kind, x in kinds.items()}),
                }
                for name, kinds in self.scores.items()
            },
        }

    def _entries(self, values: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        others = {n: x for n, x in values.items() if n not in (TRUE, TRUTH)}
        gains = {f"{TRUE} - {n}": values[TRUE] - x for n, x in others.items()}
        return statistics.entries({**values, **gains}, self.walks.houses)

    def lines(self) -> list[str]:
        """Return a description of the clips, and the table as text."""
        return [self.walks.about, *steering_table(self.facts()).text()]


def measure(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    clips: int,
    *,
    seed: int = 0,
    measures: Measures | None = None,
) -> Steered:
    """Imagine at most ``clips`` clips with true, shuffled and no actions, all with the same noise.

    The clips have ``evaluate.chain`` times the frames that the model imagines at once.

    Raises:
        UserError: the episodes are too short, have no walks, or are all from one house.
    """
    walks = choose_walks(config, episodes, clips, config.evaluate.chain)
    pieces = _Pieces(config, params, episodes, walks, seed, measures or Measures())
    with Meter("steering", len(pieces.keys) * pieces.size, "clips") as meter:
        found = {}
        for key in pieces.keys:
            found[key] = pieces.scores(*key)
            meter.advance(pieces.size)
    return pieces.joined(found)


def score(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    cache: ResultCache,
    log: Callable[[str], Any],
    measures: Measures | None = None,
) -> tuple[Steered | None, str | None]:
    """Measure steering for a report; resumable, and shared among processes.

    As many clips as the report has are chosen from the same episodes. Returns the results and a
    description of the clips. If the episodes have no such clips in two houses, the results are None
    and the description gives the reason; both are None if the model is not controlled by actions.
    """
    if not config.model.capabilities.silent_actions:
        return None, None
    among = {choice.episode for choice in choices}
    try:
        walks = choose_walks(config, episodes, len(choices), config.evaluate.chain, among)
        if walks.recorded and _sees_cameras(config):
            for choice in walks.choices:
                _body_of(episodes[choice.episode])
    except UserError as error:
        return None, f"Steering is not measured: {error}"
    measures = measures or Measures()
    pieces = _Pieces(config, params, episodes, walks, config.evaluate.seeds[0], measures)

    def work(todo: list[tuple[str, int]]) -> Iterator[tuple[tuple[str, int], Any]]:
        log(f"imagining with {', '.join(dict.fromkeys(kind for kind, _ in todo))} actions …")
        for key in todo:
            yield key, pieces.scores(*key)

    found = map_resumable(
        pieces.keys,
        lambda key: f"steering-walks2-{measures.key}-seed{pieces.seed}-{key[0]}-clip{key[1]:04d}",
        work,
        cache=cache,
        what="steering",
        workers=workers(),
    )
    return pieces.joined(found), walks.about


class _Pieces:
    """The units of work: a kind of actions and a batch of clips, identified by its first clip."""

    def __init__(
        self,
        config: Config,
        params: Params,
        episodes: Sequence[Episode],
        walks: Walks,
        seed: int,
        measures: Measures,
    ):
        self.config, self.params, self.seed = config, params, seed
        self.episodes, self.walks, self.measures = episodes, walks, measures
        self.size = min(config.evaluate.batch, len(walks.choices))
        self._silent = _with_zero_actions(config, params)
        self._imagine = jax.jit(_imagined, static_argnums=0)
        silent = NONE if _only_embeds(config) else UNEMBEDDED
        kinds = (TRUE, SHUFFLED, *([silent] if self._silent is not None else []), COPY)
        kinds += (WARP,) if _warps(config) else ()
        kinds += (PAINT,) if _warps(config) and _draws_arms(config) else ()
        kinds += (TRUTH,) if measures.structure is not None or measures.arms else ()
        starts = range(0, len(walks.choices), self.size)
        self.keys = [(kind, first) for first in starts for kind in kinds]
        self._batch = functools.lru_cache(1)(self._load_batch)

    def scores(self, kind: str, first: int) -> dict[str, np.ndarray]:
        """Return the ``errors`` (clips, N) of a batch, and its scores (clips, 1 + N) by name."""
        context, truth, controls = self._batch(first)
        count = len(controls)
        if kind == TRUTH:
            rgb = truth.rgb_THWC
        elif kind == COPY:
            rgb = np.repeat(context.rgb_THWC[:, -1:], truth.rgb_THWC.shape[1], 1)
        else:
            given = controls
            if kind == SHUFFLED:
                given = self._others(first, controls)
            numbers, padded = np.arange(first, first + self.size), stack(given, self.size)
            if kind in (WARP, PAINT):
                rgb = _warped(self.config, context, padded, painted=kind == PAINT)
            else:
                weights = self._silent if kind in (NONE, UNEMBEDDED) else self.params
                rgb = self._imagine(self.config, weights, context, padded, self.seed, numbers)
        off = jnp.square(unit_colours(rgb) - unit_colours(truth.rgb_THWC))
        found = {"errors": np.asarray(off.mean((2, 3, 4)))[:count]}
        if self.measures.lpips is not None and kind != TRUTH:
            each = np.asarray(self.measures.lpips.frames(rgb, truth.rgb_THWC))[:count]
            found["lpips"] = np.concatenate([each.mean(1, keepdims=True), each], 1)
        return found | self._by_masks(context, rgb, first, count)

    def _others(self, first: int, controls: Sequence[Any]) -> list[Any]:
        """Return the controls of a batch's clips with the actions of clips in other houses."""
        found = []
        for k, own in enumerate(controls):
            choice, other = (x[first + k] for x in (self.walks.choices, self.walks.others))
            others = self._load(other)[2]
            if isinstance(own, Control):
                episode, actions = self.episodes[choice.episode], np.asarray(others.actions_TA)
                others = with_actions(self.config, episode, choice.start, own, actions)
            found.append(_arrays(others))
        return found

    def _by_masks(
        self, context: Frames, rgb: Array, first: int, count: int
    ) -> dict[str, np.ndarray]:
        """Return the scores that compare masks: SCS, and the IoU of the arms."""
        if self.measures.structure is None and not self.measures.arms:
            return {}
        whole = jnp.concatenate([unit_colours(context.rgb_THWC[:, -1:]), unit_colours(rgb)], 1)
        videos = np.rint(255 * np.clip(np.asarray(whole), 0, 1)).astype(np.uint8)
        found: dict[str, list[np.ndarray]] = {name: [] for name in ("scs", "arms")}
        for video, choice in zip(videos, self.walks.choices[first : first + count], strict=False):
            episode = self.episodes[choice.episode]
            tracked: Tracked = tracked_of(episode, choice)
            if self.measures.structure is not None:
                found["scs"].append(tracked.score(self.measures.structure, video))
            if self.measures.arms:
                true = np.isin(tracked.ids_THW, arm_ids(episode.info))
                each = arms_iou(arms_by_colour(video[1:]), true[1:])
                found["arms"].append(np.append(average(each), each))
        return {name: np.stack(values) for name, values in found.items() if values}

    def _load_batch(self, first: int) -> tuple[Frames, Frames, list[Any]]:
        parts = [self._load(choice) for choice in self.walks.choices[first : first + self.size]]
        context = stack([part[0] for part in parts], self.size)
        truth = stack([part[1] for part in parts], self.size)
        return context, truth, [_arrays(part[2]) for part in parts]

    def _load(self, choice: ClipChoice) -> Any:
        return load_clip(self.config, self.episodes, choice)

    def joined(self, found: Mapping[tuple[str, int], Mapping[str, np.ndarray]]) -> Steered:
        """Combine the results of all pieces."""
        kinds = dict.fromkeys(kind for kind, _ in self.keys)

        def together(name: str) -> dict[str, np.ndarray]:
            parts = {k: [found[key] for key in self.keys if key[0] == k] for k in kinds}
            known = {k: each for k, each in parts.items() if name in each[0]}
            return {k: np.concatenate([one[name] for one in each]) for k, each in known.items()}

        errors = {kind: each for kind, each in together("errors").items() if kind != TRUTH}
        names = self.measures.names
        return Steered(errors, self.walks, {name: together(name) for name in names}, names)


def _arrays(control: Any) -> Any:
    return jax.tree.map(np.asarray, control)


def with_actions(
    config: Config, episode: Episode, start: int, own: Control, actions_TA: np.ndarray
) -> Control:
    """Return the control of a clip with other actions; its state stays.

    Its cameras stay, too, if the model does not see them; a model that gets the warped observed
    frame, or rays, gets the cameras to which the actions lead.

    Args:
        config: the settings.
        episode: the clip's.
        start: the present frame.
        own: the clip's control.
        actions_TA: the other actions.

    Raises:
        UserError: the cameras to which the actions lead are unknown.
    """
    if not _sees_cameras(config):
        return dataclasses.replace(own, actions_TA=actions_TA)
    body, scale = _body_of(episode)
    present = episode.world_from_camera[start]
    poses = body.cameras_along(present, state_at(episode, start), actions_TA, scale)
    camera = dataclasses.replace(own.camera, world_from_camera=poses)
    return Control(camera, actions_TA, own.state_A)


def _body_of(episode: Episode) -> tuple[Body, float]:
    """Return the body of an episode's agent, and its size.

    Raises:
        UserError: it is unknown.
    """
    about = episode.info.get("body") or {}
    if about.get("name") not in BODIES or episode.states is None:
        raise UserError(
            "this world sees the cameras to which actions lead, and those of recorded actions are "
            "known for a known body alone: use data collected with --body, or train with "
            "model.observed every and without control.rays."
        )
    return BODIES[about["name"]], float(about["scale"])


def _imagined(
    config: Config, params: Params, context: Frames, control: Any, seed: int, numbers_B: Array
) -> Array:
    """Return (B, N, H, W, 3) imagined colours."""

    def one(context: Frames, control: Any, number: Array) -> Array:
        state = worlds.start(config, params, context)
        key = jax.random.fold_in(jax.random.key(seed), number)
        return worlds.imagine(config, params, state, control, key)[1].rgb_THWC

    return jax.vmap(one)(context, control, numbers_B)


def _sees_cameras(config: Config) -> bool:
    """Return whether the cameras to which actions lead reach the model."""
    control = getattr(config.model, "control", None)
    return _warps(config) or getattr(control, "sees_cameras", False)


def _warps(config: Config) -> bool:
    return isinstance(config.model, AssembledModel) and config.model.observed == "warped"


def _draws_arms(config: Config) -> bool:
    return getattr(getattr(config.model, "control", None), "drawn", False)


@functools.partial(jax.jit, static_argnums=(0, 3))
def _warped(config: Config, context: Frames, control: Any, painted: bool) -> Array:
    """Return (B, N, H, W, 3) colours in [−1, 1] of the observed frame, warped without a network.

    With ``painted`` pixels of the agent's own body are not warped, and the bones of its arms are
    painted where its actions put them.
    """
    model, clip = config.model, config.model.clip
    if model.own_m and not painted:
        model = dataclasses.replace(model, own_m=0.0)
    present = jax.tree.map(lambda x: x[:, -1:], as_signal(context))

    def camera_of(given: tuple[Camera, Any]) -> Camera:
        return control_of(model, *given).camera

    camera = jax.lax.map(camera_of, (present.camera, control))
    view = world_model.splatted(model, present, camera)
    rgb = jax.lax.map(rendering.fill_nearest, view).features_THWF[..., :3]
    if not painted:
        return rgb
    bones = draw_bones(
        BODIES[model.control.body],
        control.actions_TA,
        control.camera.intrinsics_4,
        clip.height,
        clip.width,
    )
    arms = bones.max(-1, keepdims=True) > PAINTED
    return jnp.where(arms, jnp.asarray(ARMS_RGB) / 127.5 - 1, rgb)


def _only_embeds(config: Config) -> bool:
    """Return whether actions reach the model by their embedding alone."""
    control = getattr(config.model, "control", None)
    return getattr(control, "only_embeds", True) and not _sees_cameras(config)


def _with_zero_actions(config: Config, params: Params) -> Params | None:
    """Return weights whose control embeds every action as zero, or None if there are none."""
    if not config.model.capabilities.silent_actions or "control" not in params:
        return None
    return {**params, "control": jax.tree.map(jnp.zeros_like, params["control"])}
