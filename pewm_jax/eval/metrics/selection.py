"""Select the metrics of a report from the settings, with a reason for each one that is skipped."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pewm_jax.config import Config, UserError
from pewm_jax.eval.metrics import sam2, videos
from pewm_jax.eval.metrics.images import PLAIN, WINDOW
from pewm_jax.eval.metrics.perceptual import LPIPS, PACKAGED, select_lpips
from pewm_jax.eval.metrics.revisits import Revisit, Similarity, read_encoder
from pewm_jax.eval.metrics.structure import Consistency, follow_by_flow
from pewm_jax.eval.metrics.videos import VideoDistance
from pewm_jax.io.store import file_hash
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips.model import LEAST

FLOW = "flow"
"""The setting that selects optical flow as the segmenter of SCS."""
OFF, ON = "off", "on"
"""The settings that disable a metric, and that select the weights in the installed package."""


@dataclasses.dataclass(frozen=True)
class ReportMetrics:
    """The optional metrics of a report, None if not measured; KVD is measured with ``i3d``.

    ``visits`` has the metrics of the mirror test; ``about`` for ``lpips``, ``fvd``, ``src`` and
    ``scs`` the description, or the reason why it is skipped.
    """

    lpips: LPIPS | None
    i3d: VideoDistance | None
    visits: dict[str, Revisit]
    structure: Consistency | None
    about: dict[str, str]

    @property
    def lpips_name(self) -> str | None:
        """Return the name of LPIPS with its network, for headings."""
        return f"LPIPS[{self.lpips.encoder}]" if self.lpips else None

    @property
    def hashes(self) -> dict[str, Any]:
        """Return the hashes of the weights, for the protocol."""
        encoders = {name: one.compare for name, one in self.visits.items()}
        return {
            "lpips_weights_sha256": self.lpips.sha256 if self.lpips else None,
            "i3d_weights_sha256": self.i3d.sha256 if self.i3d else None,
            "src_weights_sha256": {
                name: one.sha256 for name, one in encoders.items() if isinstance(one, Similarity)
            },
            "scs_segmenter": self.structure.encoder if self.structure else None,
            "scs_weights_sha256": (self.structure.sha256 or None) if self.structure else None,
        }


def select_metrics(config: Config, *, accelerator: bool, ids: bool = False) -> ReportMetrics:
    """Return the optional metrics that an experiment's settings select.

    ``accelerator`` says whether the machine has one; otherwise I3D must be requested explicitly.
    ``ids`` says whether the episodes have instance ids, which SCS needs.

    Raises:
        UserError: explicitly requested weights are missing, damaged, or unsuitable for such images.
    """
    clip, settings = config.model.clip, config.evaluate
    lpips, about_lpips = select_lpips(settings.lpips, clip.height, clip.width)
    frames = settings.chain * (clip.frames - 1) + 1
    distance, about_fvd = select_fvd(settings.fvd, frames, accelerator=accelerator)
    visits, about_src = select_revisits(settings.src, lpips, clip.height, clip.width)
    consistency, about_scs = select_scs(settings.scs, ids=ids)
    about = {"lpips": about_lpips, "fvd": about_fvd, "src": about_src, "scs": about_scs}
    return ReportMetrics(lpips, distance, visits, consistency, about)


def select_scs(setting: str, *, ids: bool) -> tuple[Consistency | None, str]:
    """Return SCS with the segmenter of ``evaluate.scs``, and a description or the reason for None.

    Raises:
        UserError: a segmenter is selected and the episodes have no ids, or it cannot be loaded.
    """
    if setting == OFF:
        return None, "SCS is not measured (evaluate.scs)."
    if not ids:
        missing = "the episodes have no instance ids: collect them with --ids"
        if setting:
            raise UserError(f"evaluate.scs is {setting}, but {missing}, or omit it.")
        return None, f"SCS is not measured, because {missing}."
    exact = (
        "objects of the present frame, with exact masks of the true clip; frames count until no "
        "point of the present frame is visible any more (from true depth and poses)"
    )
    if setting in ("", FLOW):
        return Consistency(follow_by_flow, FLOW), (
            f"SCS[{FLOW}]: {exact}; optical flow propagates the masks through imagined clips, so a "
            "score is comparable with its ceiling, the true clip with the same segmenter, and not "
            "with scores of SAM 2."
        )
    measure = Consistency(sam2.read(setting), "sam2", file_hash(Path(setting, "model.safetensors")))
    return measure, f"{measure.name}: {exact}; SAM 2 of {setting} propagates the masks."


def select_fvd(setting: str, frames: int, *, accelerator: bool) -> tuple[VideoDistance | None, str]:
    """Return the I3D that ``evaluate.fvd`` selects, and a description or the reason for None.

    ``frames`` are those of a clip, including the observed one.

    Raises:
        UserError: explicitly requested weights are missing, damaged, or unsuitable for such clips.
    """
    if setting == OFF:
        return None, "FVD and KVD are not measured (evaluate.fvd)."
    short = (
        f"I3D needs {i3d.LEAST} frames, but a clip has {frames} including the observed one; "
        "--chain makes longer ones."
    )
    if setting:
        if frames < i3d.LEAST:
            raise UserError(f"--fvd is {setting}, and clips are too short for I3D: {short}")
        metric = videos.read_i3d(i3d_weights.find(None if setting == ON else setting), "fvd")
        return metric, metric.about
    path = i3d_weights.installed()
    if path is None:
        return None, (
            f"FVD and KVD are not measured, because no weights of I3D are installed: "
            f"{i3d_weights.INSTALL}, or give a weights file by --fvd."
        )
    if frames < i3d.LEAST:
        return None, f"FVD and KVD are not measured: {short}"
    if not accelerator:
        return None, (
            "FVD and KVD are not measured: without an accelerator I3D takes longer than imagining "
            "the clips; --fvd on enables them."
        )
    metric = videos.read_i3d(path, "fvd")
    return metric, metric.about


def select_revisits(
    settings: Sequence[str], lpips: LPIPS | None, height: int, width: int
) -> tuple[dict[str, Revisit], str]:
    """Return the metrics of the mirror test, and a description of SRC or why it is skipped.

    PSNR is always included, SSIM if images are large enough, LPIPS if it is measured. ``settings``
    is ``evaluate.src``.

    Raises:
        UserError: explicitly requested weights are missing, damaged, or unsuitable for such images.
    """
    compares = {"psnr": PLAIN["psnr"]}
    if min(height, width) >= WINDOW:
        compares["ssim"] = PLAIN["ssim"]
    if lpips is not None:
        compares[f"lpips_{lpips.encoder}"] = lpips
    found = {f"mirror[{name}]": Revisit(f"mirror[{name}]", one) for name, one in compares.items()}
    if OFF in settings:
        return found, "SRC is not measured (evaluate.src)."
    encoders = [_encoder(setting, height, width) for setting in settings]
    if not settings and lpips is not None:
        encoders = [Similarity(lpips.encoder, lpips.net, lpips.params, lpips.sha256)]
    for encoder in encoders:
        if f"src[{encoder.encoder}]" in found:
            raise UserError(
                f"evaluate.src names two encoders called src[{encoder.encoder}]: use one at a "
                "time, each in its own report (--out)."
            )
        found[f"src[{encoder.encoder}]"] = Revisit(f"src[{encoder.encoder}]", encoder)
    if not encoders:
        return found, (
            f"SRC is not measured, because there is no encoder: {lpips_weights.INSTALL}, or give a "
            "folder with DINOv2 by --src."
        )
    return found, "; ".join(f"src[{encoder.encoder}]: {encoder.about}" for encoder in encoders)


def _encoder(setting: str, height: int, width: int) -> Similarity:
    """Load an explicitly requested encoder."""
    net = PACKAGED.get(setting)
    if net is None:
        return read_encoder("dinov2", Path(setting))
    if min(height, width) < LEAST[net]:
        raise UserError(
            f"evaluate.src: {setting} needs images of at least {LEAST[net]} pixels per side and "
            f"these have {width} × {height}; use another encoder."
        )
    return read_encoder(setting)
