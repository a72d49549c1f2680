"""Select the metrics of a report by its settings, with a sentence on each that is left out."""

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
"""The setting that takes optical flow as the segmenter of SCS."""
OFF, ON = "off", "on"
"""The settings that leave a measure out, and that take the weights of the installed package."""


@dataclasses.dataclass(frozen=True)
class ReportMetrics:
    """The measures of a report that can be left out.

    Attributes:
        lpips: LPIPS, or None.
        i3d: FVD, or None; KVD goes with it.
        visits: name → measure of the mirror test.
        structure: SCS, or None.
        about: ``lpips``, ``fvd``, ``src`` and ``scs``: what is measured, or why it is not.
    """

    lpips: LPIPS | None
    i3d: VideoDistance | None
    visits: dict[str, Revisit]
    structure: Consistency | None
    about: dict[str, str]

    @property
    def lpips_name(self) -> str | None:
        """The name of LPIPS with that of its network, as a heading has it."""
        return f"LPIPS[{self.lpips.encoder}]" if self.lpips else None

    @property
    def hashes(self) -> dict[str, Any]:
        """The weights that were used, for the protocol."""
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
    """Return the measures that an experiment's settings ask for.

    Args:
        config: gives the clip and ``evaluate``.
        accelerator: whether the machine has one; without, I3D must be asked for.
        ids: whether the episodes have instance ids, without which there is no SCS.

    Raises:
        UserError: what is asked for by name is not there, is damaged, or cannot take such pictures.
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
    """Return SCS with the segmenter that a setting names, and a sentence on it or on why not.

    Args:
        setting: ``evaluate.scs``.
        ids: whether the episodes have instance ids.

    Raises:
        UserError: a segmenter is named and the episodes have no ids, or it cannot be read.
    """
    if setting == OFF:
        return None, "SCS is left out, as evaluate.scs says."
    if not ids:
        lacking = "the episodes have no instance ids: collect them with --ids"
        if setting:
            raise UserError(f"evaluate.scs is {setting}, and {lacking}, or leave it out.")
        return None, f"SCS is left out, since {lacking}."
    exact = (
        "things of the present frame, with exact masks of the true clip; frames count until no "
        "point of the present frame is visible any more (from true depth and poses)"
    )
    if setting in ("", FLOW):
        return Consistency(follow_by_flow, FLOW), (
            f"SCS[{FLOW}]: {exact}; optical flow follows the masks through imagined clips, so a "
            "score is comparable with its ceiling, the true clip with the same segmenter, and not "
            "with scores by SAM 2."
        )
    measure = Consistency(sam2.read(setting), "sam2", file_hash(Path(setting, "model.safetensors")))
    return measure, f"{measure.name}: {exact}; SAM 2 of {setting} follows the masks."


def select_fvd(setting: str, frames: int, *, accelerator: bool) -> tuple[VideoDistance | None, str]:
    """Return the I3D that a setting asks for, and a sentence on it or on why there is none.

    Args:
        setting: ``evaluate.fvd``.
        frames: of a clip, the observed one with it.
        accelerator: whether the machine has one; without, I3D must be asked for.

    Raises:
        UserError: what is asked for by name is not there, is damaged, or cannot take such clips.
    """
    if setting == OFF:
        return None, "FVD and KVD are left out, as evaluate.fvd says."
    short = (
        f"I3D needs {i3d.LEAST} frames and a clip has {frames} with the observed one; --chain "
        "makes longer ones."
    )
    if setting:
        if frames < i3d.LEAST:
            raise UserError(f"--fvd is {setting}, and clips are too short for I3D: {short}")
        metric = videos.read_i3d(i3d_weights.find(None if setting == ON else setting), "fvd")
        return metric, metric.about
    path = i3d_weights.installed()
    if path is None:
        return None, (
            f"FVD and KVD are left out, since no weights of I3D are installed: "
            f"{i3d_weights.INSTALL}, or name a file of them by --fvd."
        )
    if frames < i3d.LEAST:
        return None, f"FVD and KVD are left out: {short}"
    if not accelerator:
        return None, (
            "FVD and KVD are left out: without an accelerator I3D takes longer than imagining the "
            "clips; --fvd on asks for them."
        )
    metric = videos.read_i3d(path, "fvd")
    return metric, metric.about


def select_revisits(
    settings: Sequence[str], lpips: LPIPS | None, height: int, width: int
) -> tuple[dict[str, Revisit], str]:
    """Return the measures of the mirror test, and a sentence on SRC.

    PSNR is always there, SSIM where pictures are large enough, LPIPS where it is measured.

    Args:
        settings: ``evaluate.src``.
        lpips: LPIPS, where it is measured.
        height: of the pictures, pixels.
        width: the same.

    Raises:
        UserError: what is asked for by name is not there, is damaged, or cannot take such pictures.
    """
    compares = {"psnr": PLAIN["psnr"]}
    if min(height, width) >= WINDOW:
        compares["ssim"] = PLAIN["ssim"]
    if lpips is not None:
        compares[f"lpips_{lpips.encoder}"] = lpips
    found = {f"mirror[{name}]": Revisit(f"mirror[{name}]", one) for name, one in compares.items()}
    if OFF in settings:
        return found, "SRC is left out, as evaluate.src says."
    encoders = [_encoder(setting, height, width) for setting in settings]
    if not settings and lpips is not None:
        encoders = [Similarity(lpips.encoder, lpips.net, lpips.params, lpips.sha256)]
    for encoder in encoders:
        if f"src[{encoder.encoder}]" in found:
            raise UserError(
                f"evaluate.src names two encoders of one name, src[{encoder.encoder}]: measure by "
                "one of them at a time, each in a report of its own (--out)."
            )
        found[f"src[{encoder.encoder}]"] = Revisit(f"src[{encoder.encoder}]", encoder)
    if not encoders:
        return found, (
            f"SRC is left out, since there is no encoder: {lpips_weights.INSTALL}, or name a "
            "folder with DINOv2 by --src."
        )
    return found, "; ".join(f"src[{encoder.encoder}]: {encoder.about}" for encoder in encoders)


def _encoder(setting: str, height: int, width: int) -> Similarity:
    """Read an encoder that was asked for by name."""
    net = PACKAGED.get(setting)
    if net is None:
        return read_encoder("dinov2", Path(setting))
    if min(height, width) < LEAST[net]:
        raise UserError(
            f"evaluate.src: {setting} needs pictures of {LEAST[net]} pixels each way and these "
            f"have {width} × {height}; take another encoder."
        )
    return read_encoder(setting)
