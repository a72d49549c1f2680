"""What a model imagines where most was never seen: pictures by index, and how seeds differ.

    python benchmarks/unseen.py small --data data/small --out docs

Views are the last frames of held-out clips of which at least half was never seen. ``views.png``
shows 16 of them, every k-th in the order of the data, in columns: the truth, the rendered memory
(grey where it shows nothing) and what the model imagines with its first seed. Printed are LPIPS of
imagined views to the truth over never-seen pixels, and LPIPS between seeds over never-seen and over
seen pixels: a model that generates differs between seeds where nothing was seen, and agrees where
something was.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import record
import tyro

from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.errors import UserError
from pewm_jax.eval import loaded_run
from pewm_jax.eval.clips import choose, needs_cameras
from pewm_jax.eval.metrics.perceptual import LPIPS, select_lpips
from pewm_jax.eval.runner import ModelRunner
from pewm_jax.eval.scoring import Batch, load_batch
from pewm_jax.io.progress import Meter
from pewm_jax.report.pictures import as_bytes, grid, save_png
from pewm_jax.types import Camera

NAME = "unseen"
GREY = 0.5
PIXELS = 96
MAP_CHANNELS = 3


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is shown."""

    run: Annotated[str, tyro.conf.Positional] = "small"
    """Folder of a run, or the name of a model that ships."""
    data: Path = Path("data/small")
    """Data set."""
    split: str = "revisit"
    """Folder inside it."""
    clips: int = 192
    """Clips that are looked through."""
    views: int = 16
    """Views that are shown."""
    share: float = 0.5
    """Least share of a view's pixels that were never seen."""
    seeds: int = 4
    """Seeds that are compared."""
    lpips: str = "alex"
    """Network of LPIPS."""
    out: Path = Path("docs")
    """Folder of the picture."""
    record: bool = False
    """Write the numbers into RESULTS.md."""


@dataclasses.dataclass(frozen=True)
class View:
    """The last frame of a clip; images are (H, W, 3) in [0, 1], masks (H, W)."""

    truth: np.ndarray
    rendered: np.ndarray
    seen: np.ndarray
    unseen: np.ndarray
    imagined: tuple[np.ndarray, ...]


def views(settings: Settings) -> tuple[list[View], int]:
    """Return the views that are shown, and from how many they were taken.

    Raises:
        UserError: no view has as many never-seen pixels, there is nothing to compare or to show, or
            the world has no memory of surfels.
    """
    if settings.seeds < 2:
        raise UserError(f"--seeds is {settings.seeds}: imagined views are compared, use 2 or more.")
    if settings.views < 1:
        raise UserError(f"--views is {settings.views}: show at least 1.")
    loaded = loaded_run.open_run(settings.run)
    if not hasattr(getattr(loaded.config.model, "memory", None), "render_colours"):
        raise UserError(
            f"{settings.run} has no memory of surfels, which is drawn beside its views."
        )
    data = dataclasses.replace(loaded.config.data, path=str(settings.data))
    how = dataclasses.replace(loaded.config.evaluate, split=settings.split)
    config = dataclasses.replace(loaded.config, data=data, evaluate=how)
    episodes = EpisodeSource(settings.data / settings.split)
    choices = choose(config, episodes, settings.clips, 1)
    cameras, size = needs_cameras(episodes, choices), how.batch
    fits = []
    for choice in choices:
        one = _loaded(config, episodes, [choice], cameras)
        if float(np.asarray(one.unseen)[0, -1].mean()) >= settings.share:
            fits.append(choice)
    if not fits:
        raise UserError(
            f"no clip of {settings.data}/{settings.split} ends in a view of which "
            f"{settings.share:.0%} was never seen: collect with --test_policy follow, or lower "
            "--share."
        )
    step = max(len(fits) // settings.views, 1)
    chosen = fits[::step][: settings.views]
    runner = ModelRunner(config, loaded.params, size, config.data.context, cameras=cameras)
    made: list[View] = []
    with Meter("imagining", len(chosen) * settings.seeds, "views") as meter:
        for first in range(0, len(chosen), size):
            part = chosen[first : first + size]
            batch = _loaded(config, episodes, part, cameras, first, size)
            rendered = _rendered(config, runner, batch)
            imagined = []
            for seed in range(settings.seeds):
                memory = loaded_run.has_memory(loaded)
                frames = runner.run(batch.context, batch.control, batch.seeds(seed), memory=memory)
                imagined.append((np.asarray(frames[2].rgb_THWC)[:, -1] + 1) / 2)
                meter.advance(len(part))
            made += [_view(batch, rendered, imagined, row) for row in range(len(part))]
    return made, len(fits)


def _loaded(
    config: Any, episodes: Any, choices: Any, cameras: bool, first: int = 0, size: int = 1
) -> Batch:
    how = dataclasses.replace(config.evaluate, batch=size)
    return load_batch(
        dataclasses.replace(config, evaluate=how), episodes, choices, first, cameras=cameras
    )


def _rendered(config: Any, runner: ModelRunner, batch: Batch) -> np.ndarray:
    """Return (B, H, W, 3) the memory rendered for the last camera, grey where it shows nothing."""
    model = config.model
    state: Any = runner.begin(batch.context)
    last: Camera = jax.tree.map(lambda x: jnp.asarray(x)[:, -1:], batch.targets.camera)

    def one(memory: Any, camera: Camera) -> Any:
        view = model.memory.render_colours(memory, camera, model.clip.height, model.clip.width)
        colours = (view.features_THWF[0, ..., :MAP_CHANNELS] + 1) / 2
        return jnp.where(view.seen_THW[0, ..., None], colours, GREY)

    return np.asarray(jax.jit(jax.vmap(one))(state.map, last))


def _view(batch: Batch, rendered: np.ndarray, imagined: list[np.ndarray], row: int) -> View:
    return View(
        np.asarray(batch.targets.rgb_THWC)[row, -1].astype(np.float32) / 255,
        rendered[row],
        np.asarray(batch.seen)[row, -1],
        np.asarray(batch.unseen)[row, -1],
        tuple(one[row] for one in imagined),
    )


def distance(lpips: LPIPS, pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    """Return LPIPS over the pixels of masks; pairs are image, image, mask."""
    one, two, masks = (np.stack(part)[None] for part in zip(*pairs, strict=True))
    sums = np.asarray(lpips.in_masks(one, two, masks[:, :, None]))
    return float(sums.sum() / masks.sum())


def main(settings: Settings) -> None:
    """Draw the picture and print the distances."""
    shown, found = views(settings)
    rows = [
        [as_bytes(2 * image - 1) for image in (view.truth, view.rendered, view.imagined[0])]
        for view in shown
    ]
    half = -(-len(rows) // 2)
    names = ("truth", "memory", "imagined")
    lines = []
    for at in range(half):
        right = rows[at + half] if at + half < len(rows) else [np.full_like(rows[0][0], 255)] * 3
        lines.append((f"{at + 1}, {at + half + 1}", rows[at] + right))
    file = save_png(settings.out / "views.png", grid(lines, names * 2, cell=PIXELS))
    print(f"{file}: {len(shown)} of {found} views, every {max(found // settings.views, 1)}.")

    height, width = shown[0].truth.shape[:2]
    lpips, why = select_lpips(settings.lpips, height, width)
    if lpips is None:
        raise UserError(why)
    couples = list(itertools.combinations(range(settings.seeds), 2))
    to_truth = [(x.imagined[0], x.truth, x.unseen) for x in shown]
    unseen = [(x.imagined[a], x.imagined[b], x.unseen) for x in shown for a, b in couples]
    seen = [(x.imagined[a], x.imagined[b], x.seen) for x in shown for a, b in couples]
    table = record.table(
        ["LPIPS", settings.lpips],
        [
            ["imagined to truth, never seen", f"{distance(lpips, to_truth):.3f}"],
            ["between seeds, never seen", f"{distance(lpips, unseen):.3f}"],
            ["between seeds, seen before", f"{distance(lpips, seen):.3f}"],
        ],
    )
    print(table)
    if settings.record:
        head = f"## Views never seen\n\n`{settings.run}`, {len(shown)} views; "
        record.record(NAME, head + record.machine("jax") + "\n\n" + table)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
