"""Our weights as a folder that diffusers' ``from_pretrained`` loads, part by part or as a pipeline.

Three kinds of folder can be written back: an import, an import that was widened to a world model,
and a training run that began from one. Of a world model the video model inside is written: the
memory blocks and the channels of depth and camera stay behind.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.convert import base, cogvideox, output, widen
from pewm_jax.convert.cogvideox import CONFIG, TRANSFORMER, VAE, WEIGHTS, Network
from pewm_jax.io import weights
from pewm_jax.types import Params

_TEXT = ("text_encoder", "tokenizer")
"""Parts that are not converted, only copied."""


def export(
    src: Path,
    dst: Path,
    base_folder: Path | None = None,
    dtype: str | None = None,
    original: Path | None = None,
) -> None:
    """Write a diffusers folder: ``transformer/``, ``vae/``, ``scheduler/``, ``model_index.json``.

    Args:
        src: an imported folder, a widened one, or a training run.
        dst: the folder to make.
        base_folder: the folder with ``base.json``, by default ``src`` or, of a training run, the
            folder it started from.
        dtype: of the tensors; by default that of our weights.
        original: the original pipeline's folder, to copy text encoder and tokenizer from.

    Raises:
        UserError: ``dst`` exists, ``base.json`` is absent, or the weights do not fit it.
    """
    if not src.is_dir():
        raise UserError(f"{src} is not a folder; give an imported folder or a training run.")
    output.refuse_existing(dst)
    record = base.load(base_folder or _origin(src))
    absent = [name for name in _TEXT if original and not (original / name).is_dir()]
    if absent:
        raise UserError(f"{original} has no folder {absent[0]}/; give the original pipeline's.")
    imported = (src / "transformer").is_dir()
    with output.new_folder(dst) as folder:
        for network in (TRANSFORMER, VAE):
            params = _imported(src, network) if imported else _run(src, network, record)
            values = record[network.folder]
            cogvideox.write_diffusers(network, values, params, folder / network.folder, dtype)
            del params
        (folder / "scheduler").mkdir()
        output.write_json(folder / "scheduler" / "scheduler_config.json", record["scheduler"])
        output.write_json(folder / "model_index.json", _index(record, text=original is not None))
        if original:
            for name in _TEXT:
                shutil.copytree(original / name, folder / name)


def _origin(src: Path) -> Path:
    """Return the folder with ``base.json``: a training run names where it started from."""
    seen: list[Path] = []
    here = src
    while not (here / base.BASE).is_file() and (here / CONFIG).is_file() and here not in seen:
        seen.append(here)
        start = configuration.load(here / CONFIG, Config).train.start
        if not start:
            return src
        here = Path(start)
    return here


def _imported(src: Path, network: Network) -> Params:
    load = cogvideox.load_transformer if network is TRANSFORMER else cogvideox.load_vae
    return load(src)[1]


def _run(src: Path, network: Network, record: dict[str, Any]) -> Params:
    """Return the video model's part of a world model."""
    config = configuration.load(src / CONFIG, Config)
    path = src / WEIGHTS
    if network is VAE:
        params = weights.load(path, "codec")
    else:
        old = network.config(record[network.folder], base.BASE)
        vae = VAE.config(record[VAE.folder], base.BASE)
        plan = widen.plan(old, vae.latent_channels, config.model.control.channels(config.model))
        backbone = weights.load(path, "backbone")
        weights.check(backbone, network.like(plan.new), f"the backbone in {path}")
        params = widen.narrow(plan, backbone)
    like = network.like(network.config(record[network.folder], base.BASE))
    weights.check(params, like, f"the {network.folder} in {path}")
    return params


def _index(record: dict[str, Any], *, text: bool) -> dict[str, Any]:
    """Return ``model_index.json``, with or without text encoder and tokenizer."""
    image = record["transformer"].get("in_channels", 16) != record["transformer"].get(
        "out_channels", 16
    )
    given = record.get("model_index") or {
        "_class_name": "CogVideoXImageToVideoPipeline" if image else "CogVideoXPipeline",
        "_diffusers_version": record["transformer"].get("_diffusers_version", "0.36.0"),
    }
    return {
        **{name: [None, None] for name in _TEXT},
        **{name: value for name, value in given.items() if text or name not in _TEXT},
        "scheduler": ["diffusers", record["scheduler"]["_class_name"]],
        "transformer": ["diffusers", TRANSFORMER.theirs],
        "vae": ["diffusers", VAE.theirs],
    }
