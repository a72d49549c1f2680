"""Batches of clips by Grain: batch k is a function of (seed, k), so a position is one integer.

Every epoch visits every episode once, in an order drawn from the seed, and draws one clip from
each. An interrupted training resumes from k alone. An episode that does not decode is replaced by
another, drawn from the same seed and position, so the replacement depends only on the files.
``BadRecords`` counts these episodes and reports each once.
"""

from __future__ import annotations

import dataclasses
import itertools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import grain
import numpy as np

from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.config.world import Task, World
from pewm_jax.data.clips import Choice, ReadFeatures, choose, cut, stack
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.data.record_format import DamagedError
from pewm_jax.data.voxels import PALETTE, VoxelGrid, VoxelsConfig, require_alike
from pewm_jax.geometry.actions import PLANAR
from pewm_jax.types import Clip


class BadRecords:
    """The records that failed to decode; may be shared by threads and by several loaders.

    Args:
        budget: largest number of distinct records to skip, ``data.bad_records``; None = no limit.
        log: called once per skipped record with a line that names it.
    """

    def __init__(self, budget: int | None = None, log: Callable[[str], Any] | None = None):
        self.log = log
        self._budget = budget
        self._reasons: dict[str, str] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._reasons)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the records, in the order in which they were found."""
        return tuple(self._reasons)

    def add(self, record: str, reason: str) -> None:
        """Count a record that does not decode, with the error message.

        Raises:
            UserError: the limit is exceeded; the message names all these records.
        """
        with self._lock:
            known = record in self._reasons
            self._reasons.setdefault(record, reason)
            if self._budget is not None and len(self) > self._budget:
                raise UserError(self._too_many(reason))
            if not known and self.log is not None:
                allowed = "" if self._budget is None else f" of {self._budget} allowed"
                self.log(f"bad record {len(self)}{allowed}, skipped: {record}: {reason}")

    def _too_many(self, reason: str) -> str:
        count = len(self)
        if count == 1:
            return f"{reason.rstrip('.')}, or skip it with --data.bad_records 1."
        return (
            f"{count} records do not decode and data.bad_records allows {self._budget}: "
            f"{'; '.join(self._reasons)}. `pewm-jax data validate` lists all of them; make their "
            "shards again, or allow more with --data.bad_records."
        )


BATCHES_AHEAD = 2
"""Batches prefetched; the loader holds these and the one in use."""
EPOCHS = 2**31
"""Epochs of the dataset: practically endless, while its length still fits an integer."""


RECORDED = ("classes_TXYZ", "origin_T3", "state_A")
"""The optional arrays of a clip that episodes may contain."""


@dataclasses.dataclass(frozen=True)
class _Drawn:
    """A clip with the number of its record, the name of its episode and its frames."""

    record: int
    name: str
    choice: Choice
    clip: Clip


@dataclasses.dataclass(frozen=True)
class _DrawClip(grain.transforms.RandomMap):
    """Map the number of a record to a clip; an episode that does not decode is replaced.

    Batches have actions if all episodes do (``actions``), and voxels if all have the same ``grid``.
    """

    config: Config
    source: EpisodeSource
    features: ReadFeatures | None
    bad: BadRecords
    actions: bool = True
    grid: VoxelGrid | None = None

    def random_map(self, element: int, rng: np.random.Generator) -> _Drawn:
        """Draw a clip from the record, or from another one if it does not decode."""
        record, refused = element, set()
        while True:
            try:
                return self._draw(record, rng)
            except DamagedError as error:
                self.bad.add(_name(self.source, record), str(error))
                refused.add(record)
                if len(refused) == len(self.source):
                    raise UserError(
                        f"{self.source.path}: none of its {len(self.source)} records decodes; "
                        "make the split again."
                    ) from None
                while record in refused:
                    record = int(rng.integers(len(self.source)))

    def _draw(self, record: int, rng: np.random.Generator) -> _Drawn:
        episode = self.source[record]
        _check_size(self.config, episode)
        if self.grid is not None and episode.voxel_grid is not None:
            require_alike(self.grid, episode.voxel_grid, f"episode {episode.name}")
        choice = choose(self.config, episode.length, rng, f"episode {episode.name}")
        asked, slots = self.config.model.batch_spec, self.config.data.context
        if not asked.context:
            slots, choice = 0, dataclasses.replace(choice, context_S=choice.context_S[:0])
        voxels = self.grid is not None and "classes_TXYZ" in asked.names
        state = "state_A" in asked.names
        clip = cut(episode, choice, slots, self.features, voxels=voxels, state=state)
        if not self.actions:
            clip = dataclasses.replace(clip, actions_TA=None)
        return _Drawn(record, episode.name, choice, clip)


def dataset(
    config: Config,
    split: str,
    seed: int,
    batch: int,
    features: ReadFeatures | None = None,
    bad: BadRecords | None = None,
    rows: slice | None = None,
) -> grain.MapDataset:
    """Return the endless dataset whose element k is batch k, or some rows of it.

    All batches have the same arrays: those that the model's ``batch_spec`` names and that all
    episodes have. ``import`` lists which episodes have actions and voxels; of other splits the
    first episode decides.

    Raises:
        UserError: the split is absent, unfinished or damaged, or its episodes do not fit the
            configuration.
        ConfigError: the episodes were collected with other steps or turns than ``actions`` says.
    """
    source = EpisodeSource(Path(config.data.path) / split)
    bad = BadRecords(config.data.bad_records) if bad is None else bad
    first = _check_first(config, source, bad)
    _require_known(config)
    actions, voxels = _in_all(source, first)
    grid = first.voxel_grid if voxels else None
    draw = _DrawClip(config, source, features, bad, actions, grid)
    drawn = _order(source, seed).random_map(draw)
    wanted = range(batch)[rows or slice(None)]

    def read(number: int) -> Clip:
        return stack([cast("_Drawn", drawn[number * batch + row]).clip for row in wanted])

    return grain.MapDataset.range(len(drawn) // batch).map(read)


def records(config: Config, split: str = "train", *, seed: int, batch: int, step: int) -> list[str]:
    """Name the clips of batch ``step``, recomputed from its number; arguments as for ``clips``.

    Batches count from 0; training uses batch k in step k + 1.

    Returns:
        B names such as ``train/shard-00000-of-00004.array_record record 12 (episode house-3/follow)
        frames 3–11``; records that do not decode are replaced as in ``clips``.
    """
    source = EpisodeSource(Path(config.data.path) / split)
    drawn = _order(source, seed).random_map(_DrawClip(config, source, None, BadRecords()))
    numbers = range(step * batch, (step + 1) * batch)
    return [_describe(source, cast("_Drawn", drawn[number])) for number in numbers]


def _order(source: EpisodeSource, seed: int) -> grain.MapDataset:
    """Return the endless list of records in the order in which they are read."""
    return grain.MapDataset.range(len(source)).seed(seed).shuffle().repeat(EPOCHS)


def clips(
    config: Config,
    split: str = "train",
    *,
    seed: int,
    batch: int,
    start_step: int = 0,
    features: ReadFeatures | None = None,
    bad: BadRecords | None = None,
    rows: slice | None = None,
) -> Iterator[Clip]:
    """Return an endless iterator over batches of clips.

    Args:
        config: ``clip`` and ``data`` define the clips; ``data.workers`` is the number of threads
            (decoding releases Python's lock). The batches do not depend on that number.
        split: folder inside ``data.path``.
        seed: order of the episodes and choice of the clips.
        batch: clips per batch.
        start_step: number of the first batch; resuming from step k continues an iterator that
            started at 0.
        features: reads the context's features, if they are cached.
        bad: counts and names the records that do not decode; by default ``data.bad_records`` are
            skipped silently.
        rows: the clips of a batch that are read and returned, by default all; with several
            processes each reads its own. The clips do not depend on which process reads them.

    Returns:
        NumPy clips with a leading B (the number of rows): rgb uint8, depth float32 in metres,
            actions if
        all episodes have them, and the extras that the model's ``batch_spec`` names if all episodes
        have those.

    Raises:
        UserError: the split is absent, unfinished or damaged, or its episodes do not fit, or (where
            the batch would have been) too many records do not decode.
    """
    batches = dataset(config, split, seed, batch, features, bad, rows)[start_step:]
    threads = max(1, config.data.workers)
    return iter(batches.to_iter_dataset(grain.ReadOptions(threads, BATCHES_AHEAD + threads - 1)))


def _check_first(config: Config, source: EpisodeSource, bad: BadRecords) -> Episode:
    """Return the first episode that decodes, after comparing it with the configuration."""
    for record in range(len(source)):
        try:
            first = source[record]
        except DamagedError as error:
            bad.add(_name(source, record), str(error))
            continue
        _check_size(config, first)
        require_recorded(config.model, source, first)
        _check_actions(config, first)
        require_same_cells(config.model, first)
        choose(config, first.length, np.random.default_rng(0), f"episode {first.name}")
        return first
    raise UserError(f"{source.path}: none of its records can be read; make the split again.")


def _require_known(config: Config) -> None:
    """Raise ConfigError if a world's loss needs recorded arrays that no episode has."""
    unknown = sorted(set(config.model.batch_spec.names) - set(RECORDED))
    if unknown:
        raise ConfigError(
            f"{type(config.model).__name__}.batch_spec asks for {', '.join(unknown)}, which no "
            f"episode records; it may ask for {', '.join(RECORDED)}."
        )


def _in_all(source: EpisodeSource, first: Episode) -> tuple[bool, bool]:
    """Return whether all episodes of a split have actions, and whether all have voxels."""
    actions, voxels = first.actions is not None, first.voxel_grid is not None
    settings = source.manifest.settings
    if settings.get("made_by") == "import":  # hand-held cameras among others
        listed = settings.get("actions")
        if listed is None:  # an older import did not list actions: open its few recordings
            listed = {k: source[k].actions is not None for k in range(len(source))}
        actions = all(listed.values())
        voxels = voxels and all(settings.get("voxels", {None: False}).values())
    return actions, voxels


def _name(source: EpisodeSource, record: int) -> str:
    """Return the split, the shard's file and the record's number in it."""
    return f"{source.path.name}/" + source.where(record, " record ").rpartition("/")[2]


def _describe(source: EpisodeSource, drawn: _Drawn) -> str:
    frames = drawn.choice.frames_T
    stride = int(frames[1] - frames[0])
    every = f" by {stride}" if stride > 1 else ""
    span = f"frames {frames[0]}–{frames[-1]}{every}"
    return f"{_name(source, drawn.record)} (episode {drawn.name}) {span}"


def _check_size(config: Config, episode: Episode) -> None:
    clip = config.model.clip
    if (episode.height, episode.width) != (clip.height, clip.width):
        raise UserError(
            f"episode {episode.name} has images of {episode.width}×{episode.height} pixels, the "
            f"configuration needs {clip.width}×{clip.height}: collect or import with that size, or "
            f"set clip.width {episode.width} and clip.height {episode.height}."
        )


def _check_actions(config: Config, episode: Episode) -> None:
    """Compare the settings of the actions with those of an episode."""
    data, actions = config.data, episode.actions
    table = getattr(config.model, "actions", None)  # a world without control has none
    if actions is not None and actions.shape[1] != PLANAR and data.stride_min < data.stride_max:
        raise ConfigError(
            f"episode {episode.name} has actions of width {actions.shape[1]}, which can only be "
            "joined if all clips have the same stride: set data.stride_min and data.stride_max to "
            f"the same number, for instance --data.stride_max {data.stride_min}."
        )
    for name in ("step_m", "turn_deg"):
        made, wanted = episode.info.get(name), getattr(table, name, None)
        if made is not None and wanted is not None and not np.isclose(made, wanted, rtol=1e-6):
            raise ConfigError(
                f"episode {episode.name} was collected with {name} {made:g}, the configuration has "
                f"actions.{name} {wanted:g}: set --actions.{name} {made:g}."
            )


def require_recorded(task: Task, source: EpisodeSource, first: Episode | None = None) -> None:
    """Raise ConfigError if a world or a policy needs depth, poses or states that episodes lack.

    ``import`` lists which have depth; of other splits the first episode decides, or ``first``.
    """
    spec, name = task.batch_spec, type(task).__name__
    control: Any = getattr(task, "control", None)
    listed = source.manifest.settings.get("depth", {None: True})
    state = dict(spec.extras).get("state_A")
    if not (spec.depth or spec.poses or state):
        return
    first = source[0] if first is None else first
    assert first is not None
    if spec.depth and not (first.has_depth and all(listed.values())):
        raise ConfigError(
            f"{source.path} has episodes without depth, and {name} needs it, for its memory or "
            "to generate it: import depth too, or use a world that needs none, such as egowm_tiny "
            "or nomad."
        )
    found = None if first.states is None else first.states.shape[1:]
    if state and found != state.shape:
        has = "no states of the agent" if found is None else f"states of {found[0]} numbers"
        raise ConfigError(
            f"{source.path} has episodes with {has}, and control.state is {state.shape[0]}: "
            "collect with --body, import data that have them, or use control.state 0."
        )
    body = (first.info.get("body") or {}).get("name", "")
    if getattr(control, "drawn", False) and body != control.body:
        recorder = f"the body {body}" if body else "an unknown body"
        raise ConfigError(
            f"{source.path} was recorded by {recorder}, and control.drawn draws the arms of "
            f"{control.body}: use control.drawn false (--model.control.no_drawn)."
        )
    if spec.poses and first.info.get("poses") == "unknown":
        raise ConfigError(
            f"{source.path} has episodes whose camera poses are unknown, and {name} needs them: "
            "import them with --pose, or use a world steered by actions alone, such as egowm_tiny."
        )


def require_same_cells(world: World, episode: Episode) -> None:
    """Raise ConfigError if an episode's voxels or images are not those that a world expects.

    That is the side of its cells and of its grids, the classes, and what the images show. Worlds
    without a memory of kind ``grid`` accept any. Class tables that ``collect`` did not make
    are not compared.
    """
    memory: Any = getattr(world, "memory", None)
    if not getattr(memory, "CLASSES", False) or episode.voxel_grid is None:
        return
    grid, cell_m = episode.voxel_grid, memory.cell_m[0]
    if not np.isclose(grid.cell_m, cell_m, rtol=1e-6) or grid.side != memory.recorded:
        raise ConfigError(
            f"episode {episode.name} has grids of {grid.side} cells of {grid.cell_m:g} m along "
            f"each axis, and this world needs {memory.recorded} of {cell_m:g} m (memory.recorded, "
            f"memory.cell_m): collect with --voxels.side {memory.recorded} --voxels.cell "
            f"{cell_m:g}."
        )
    for made in itertools.product(("all", "groups"), range(1, len(PALETTE) + 1)):
        kinds, colours = made
        names = VoxelsConfig(kinds=kinds, colours=colours).names
        if made != (memory.kinds, memory.colours) and names == episode.voxel_grid.names:
            raise ConfigError(
                f"episode {episode.name} was collected with --voxels.kinds {kinds} "
                f"--voxels.colours {colours}, and memory.kinds is {memory.kinds}, memory."
                f"colours {memory.colours}: use the same."
            )
    pictures = episode.info.get("pictures", "surfaces")
    if pictures != memory.pictures:
        raise ConfigError(
            f"episode {episode.name} has pictures of {pictures}, and memory.pictures is "
            f"{memory.pictures}: use that, or collect with --voxels.pictures {memory.pictures}."
        )
