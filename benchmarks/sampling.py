"""Choose how an EDM model is sampled: by scores over never-seen pixels of validation houses.

    python benchmarks/sampling.py runs/small --steps 3 4 5 8 --highest 5 20 --rendered 0 1

Every combination is evaluated on ``validation`` with one seed. PSNR prefers averages, so LPIPS and
KVD over never-seen pixels decide, and PSNR is printed beside them.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Annotated, Any

import record
import tyro

from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.errors import UserError
from pewm_jax.eval import evaluate, loaded_run
from pewm_jax.io.progress import Meter

NAME = "sampling"


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is compared."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of a run with the noise `edm`."""
    data: str = ""
    """Data set; that of the run if empty."""
    steps: tuple[int, ...] = (3, 4, 5, 8)
    """Sampling steps."""
    highest: tuple[float, ...] = (20.0,)
    """Highest noise levels."""
    lowest: tuple[float, ...] = (0.002,)
    """Lowest noise levels."""
    rendered: tuple[float, ...] = (0.0,)
    """Noise levels down to which rendered latents are kept."""
    clips: int = 48
    """Clips."""
    out: Path = Path("runs/sampling")
    """Folder of the reports."""
    record: bool = False
    """Write the table into RESULTS.md."""


def main(settings: Settings) -> None:
    """Evaluate all combinations and print the table."""
    loaded = loaded_run.open_run(settings.run)
    noise = loaded.config.model.noise
    if not isinstance(noise, EDMConfig):
        raise UserError(f"{settings.run} has noise.kind {noise.kind}: a run with edm is needed.")
    combinations = list(
        itertools.product(settings.steps, settings.highest, settings.lowest, settings.rendered)
    )
    rows = []
    with Meter("sampling", len(combinations), "evaluations") as meter:
        for steps, highest, lowest, rendered in combinations:
            changed = dataclasses.replace(
                noise,
                sample_steps=steps,
                sigma_max=highest,
                sigma_min=lowest,
                rendered_until=rendered,
            )
            out = settings.out / f"{steps}-{highest:g}-{lowest:g}-{rendered:g}"
            metrics = scored(
                settings.run,
                out,
                config=loaded.config.with_model(noise=changed),
                data=settings.data or None,
                split="validation",
                clips=settings.clips,
                fvd="on",
            )
            rows.append(_row((steps, highest, lowest, rendered), metrics))
            print(" | ".join(rows[-1]), flush=True)
            meter.advance(1)
    head = ("steps", "σ_max", "σ_min", "kept until", "PSNR seen", "PSNR never seen", "PSNR all")
    head = (*head, "LPIPS seen", "LPIPS never seen", "LPIPS all", "FVD", "KVD", "KVD never seen")
    table = record.table(head, rows)
    print(table)
    if settings.record:
        about = f"`{settings.run}`, {settings.clips} clips of validation houses, one seed; "
        record.record(NAME, f"## Sampling\n\n{about}{record.machine('jax')}\n\n{table}")


def _silent(line: str) -> None:
    del line


def scored(run: str, out: Path, **changes: Any) -> dict[str, Any]:
    """Evaluate a run with one seed and the shortest rollouts; return its report's numbers.

    Args:
        run: folder of a run, or the name of a model that ships.
        out: folder of the report.
        changes: other arguments of ``evaluate``.
    """
    short = {"seeds": (0,), "videos": 1, "video_clips": 1, "mirror": 0}
    page = evaluate.evaluate(run, out=out, log=_silent, **short, **changes)
    metrics: dict[str, Any] = json.loads(page.with_name("metrics.json").read_text("utf-8"))
    return metrics


def _row(combination: tuple[float, ...], metrics: dict[str, Any]) -> list[str]:
    """Return the cells of one combination, from its report's numbers."""
    found = metrics["results"]["memory"]
    psnr = [f"{found[mask]['psnr']['mean']:.2f}" for mask in ("seen", "unseen", "all")]
    lpips = [f"{found[mask]['lpips']['mean']:.3f}" for mask in ("seen", "unseen", "all")]
    videos = metrics["videos"]
    distances = [videos["results"]["memory"], videos["masks"]["unseen"]["memory"]]
    sets = distances[0]["fvd"]["value"], distances[0]["kvd"]["value"], distances[1]["kvd"]["value"]
    names = [f"{value:g}" for value in combination]
    return [*names, *psnr, *lpips, *(f"{value:.3g}" for value in sets)]


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
