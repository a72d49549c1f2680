"""SAM 2 as the segmenter of SCS: propagates the first frame's masks through a video.

The paper (EgoWM, arXiv 2601.15284) clicks on objects in the first frame and lets SAM 2 track them.
Here SAM 2 gets the first frame's exact masks. The network is that of transformers, on torch (``pip
install 'pewm-jax[sam2]'``), with weights in a folder of the user, such as a copy of
``facebook/sam2.1-hiera-tiny``. SAM 2 is a measuring instrument, not a model of the library, so it
is not ported to JAX.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.structure import Segmenter

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's colours, with which SAM 2 normalises its input."""
KIND = "sam2_video"
"""``model_type`` in ``config.json`` of the video network (``sam2_hiera_*`` is for single
images)."""


def read(folder: str | Path, device: str = "cpu") -> Segmenter:
    """Return SAM 2 as a ``Segmenter``.

    The folder has ``config.json`` and ``model.safetensors`` of a ``Sam2VideoModel``; ``device`` is
    torch's, such as ``cuda``.

    Raises:
        UserError: torch or transformers are not installed, or the folder contains no such network.
    """
    path = Path(folder)
    again = "give a folder with config.json and model.safetensors of a Sam2VideoModel"
    try:
        settings = json.loads((path / "config.json").read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} contains no SAM 2 ({error}): {again}.") from None
    if not isinstance(settings, dict) or settings.get("model_type") != KIND:
        raise UserError(f"{path / 'config.json'} is not of a {KIND} model: {again}.")
    if not (path / "model.safetensors").is_file():
        raise UserError(f"{path} has no model.safetensors: {again}.")
    torch, transformers = _libraries()
    try:
        network, said = transformers.Sam2VideoModel.from_pretrained(
            path, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # noqa: BLE001 - noqa: BLE001 - the library raises many kinds
        raise UserError(f"{path} cannot be read as SAM 2 ({error}): {again}.") from None
    if said["missing_keys"] or said["mismatched_keys"]:
        lacking = sorted(map(str, [*said["missing_keys"], *said["mismatched_keys"]]))
        raise UserError(
            f"{path / 'model.safetensors'} lacks {len(lacking)} arrays of SAM 2, such as "
            f"{lacking[0]}: copy the folder again."
        )
    network = network.to(device).eval()

    def follow(video_THWC: np.ndarray, first_KHW: np.ndarray) -> np.ndarray:
        first = np.asarray(first_KHW, bool)
        count, (frames, height, width) = len(first), video_THWC.shape[:3]
        masks = np.zeros((count, frames, height, width), bool)
        if not count:
            return masks
        with torch.inference_mode():
            for number, scores in enumerate(_track(network, video_THWC, first)):
                masks[:, number] = scores > 0
        return masks

    return follow


def _track(network: Any, video_THWC: np.ndarray, first_KHW: np.ndarray) -> Iterator[np.ndarray]:
    """Yield (K, H, W) scores per frame, with the pre- and postprocessing of its processors."""
    torch, transformers = _libraries()
    device, side = network.device, network.config.prompt_encoder_config.image_size
    height, width = video_THWC.shape[1:3]

    def sized(x: Any, *size: int) -> Any:
        smooth = {"mode": "bilinear", "align_corners": False}
        return torch.nn.functional.interpolate(x, size=size, **smooth, antialias=size[0] == side)

    mean, std = (torch.tensor(each)[:, None, None] for each in (MEAN, STD))
    video = torch.tensor(np.ascontiguousarray(video_THWC)).permute(0, 3, 1, 2) / 255
    video = (sized(video, side, side) - mean) / std
    session = transformers.Sam2VideoInferenceSession(
        video=video,
        video_height=height,
        video_width=width,
        inference_device=device,
        inference_state_device=device,
        dtype=torch.float32,
    )
    things = list(range(1, len(first_KHW) + 1))
    for thing, mask in zip(things, first_KHW, strict=True):
        exact = sized(torch.tensor(mask[None, None], dtype=torch.float32), side, side)
        session.add_mask_inputs(session.obj_id_to_idx(thing), 0, (exact >= 0.5).float())
    session.obj_with_new_inputs = things
    network(inference_session=session, frame_idx=0)
    for found in network.propagate_in_video_iterator(session):
        yield sized(found.pred_masks.float().cpu(), height, width)[:, 0].numpy()


def _libraries() -> tuple[Any, Any]:
    """Import torch and transformers, or raise a ``UserError`` if they are not installed."""
    try:
        torch = importlib.import_module("torch")
        transformers = importlib.import_module("transformers")
    except ImportError as error:
        raise UserError(
            f"SAM 2 needs torch and transformers ({error}): run pip install 'pewm-jax[sam2]'."
        ) from None
    return torch, transformers
