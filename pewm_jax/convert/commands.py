"""The commands of ``pewm-jax convert``; their settings are in ``options``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.config.overlay import overlay
from pewm_jax.convert import (
    adapters,
    cogvideox,
    cosmos,
    dinov2,
    inference,
    pipeline,
    schedulers,
    stablehlo,
    svd,
    text,
)
from pewm_jax.convert.options import (
    ExportDiffusers,
    ExportInference,
    ExportStableHLO,
    ImportCogVideoX,
    ImportCosmos2,
    ImportDINOv2,
    ImportLoRA,
    ImportSVD,
    Merge,
)
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import hub
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.config import Learned
from pewm_jax.models.cogvideox.convert import TRANSFORMER, VAE
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2 import model as dinov2_model
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.types import Params

Options = TypeVar("Options", ImportCogVideoX, ImportCosmos2, ImportDINOv2, ImportSVD)


FOLDERS = {
    ImportCogVideoX: ("transformer", "vae", "scheduler", "text_encoder", "tokenizer"),
    ImportCosmos2: ("transformer", "vae", "scheduler", "text_encoder", "tokenizer"),
    ImportSVD: ("unet", "vae", "image_encoder", "scheduler"),
    ImportDINOv2: (".",),
}
"""The folders of a pipeline that each command reads."""
SETTINGS = ("*config.json", "tokenizer*", "spiece.model", "*map.json")
PLAIN = ("diffusion_pytorch_model", "model")
"""Names of weights without a precision (``*.fp16.safetensors``), which are preferred."""


def _patterns(folders: Sequence[str], *, plain: bool) -> list[str]:
    """Return the patterns of the files of a pipeline; ``plain``: without those of a precision."""
    tensors = ["*.safetensors", "*.safetensors.index*.json"]
    if plain:
        ends = (".safetensors", "-*.safetensors", ".safetensors.index.json")
        tensors = [name + end for name in PLAIN for end in ends]
    files = (*SETTINGS, *tensors)
    inside = [file if name == "." else f"{name}/{file}" for name in folders for file in files]
    return [*inside, "model_index.json", "README.md", "LICENSE*"]


def _found(options: Options) -> Options:
    """Return options with the folder of a source that is given by its name on a hub.

    Raises:
        UserError: ``dst`` exists, or the source cannot be had from the hub.
    """
    pipeline.refuse_existing(options.dst)
    if options.src.exists():
        return options
    folders = FOLDERS[type(options)]
    folder = hub.find(options.src, _patterns(folders, plain=True))
    if folder is None:
        return options
    if not any((folder / folders[0]).glob("*.safetensors")):
        hub.find(options.src, _patterns(folders, plain=False))
    return dataclasses.replace(options, src=folder)


def import_cogvideox(options: ImportCogVideoX) -> None:
    """Run ``import cogvideox``."""
    options = _found(options)
    src, dst = options.src, options.dst
    cogvideox.require_pipeline(src)
    settings = {part.folder: pipeline.published_config(part, src) for part in (TRANSFORMER, VAE)}
    settings["scheduler"] = schedulers.published_config(schedulers.COGVIDEOX, src)
    dit = TRANSFORMER.config(settings["transformer"], str(src / "transformer/config.json"))
    vae = VAE.config(settings["vae"], str(src / "vae/config.json"))
    noise = cogvideox.read_scheduler(src)
    for network in (TRANSFORMER, VAE):  # check all files before hours of work
        pipeline.specs(network, src, options.dtype)
    config, encoder = _world(options, dit, vae, noise) if options.world else (None, None)
    prompts = text.encode(src, options.prompt, dit.text_length, dit.text_dim)
    record = cogvideox.describe_base(src, settings, list(prompts), options.dtype)
    if config is None:
        cogvideox.import_pipeline(src, dst, options.dtype, prompts, record)
    else:
        prompt = next(iter(prompts.values()), None)
        tokens: Literal["zeros", "stored"] = "zeros" if prompt is None else "stored"
        backbone = dataclasses.replace(config.model.backbone, prompt=tokens)
        config = config.with_model(backbone=backbone)
        write = cogvideox.import_actions
        if options.rgbd:
            write = functools.partial(
                cogvideox.import_world, memory=options.memory, encoder=encoder, seed=options.seed
            )
        write(src, dst, config, prompt, record, dtype=options.dtype)
    print(f"{dst}: {_summary(options, prompts)}; licence of the original: {record['licence']}")


def _world(
    options: ImportCogVideoX, dit: DiTBackbone, vae: VAECodec, noise: DDPMConfig
) -> tuple[Config, Params | None]:
    """Return the settings of the world model, and its image encoder if it has one.

    Raises:
        UserError: invalid settings, or a required encoder is not given.
    """
    size = (options.frames, options.height, options.width)
    dit = _with_positions(dit, options.positions)
    dtype, run = _stored_dtype(options), options.dst.name
    if options.actions:
        config = cogvideox.actions_config_of(dit, vae, noise, size, dtype, run=run)
        config = overlay(config, options.config) if options.config else config
        cogvideox.require_size(config)
        return config, None
    network, params = dinov2_model.load(options.encoder) if options.encoder else (None, None)
    config = cogvideox.config_of(
        dit,
        vae,
        noise,
        size,
        dtype,
        run=run,
        encoder=DINOv2EncoderConfig(network=network) if network else None,
    )
    config = overlay(config, options.config) if options.config else config
    cogvideox.require_size(config)
    kept = config.model.memory.encoder
    if network and not (isinstance(kept, DINOv2EncoderConfig) and kept.network == network):
        raise UserError(
            f"{options.config} sets another memory.encoder than {options.encoder} of --encoder; "
            "omit one of the two."
        )
    if kept.CONVERTED and params is None:
        raise UserError(
            "memory.encoder of kind dinov2 needs its weights; give the folder of `import dinov2` "
            "with --encoder."
        )
    return config, params


def _with_positions(dit: DiTBackbone, learned: Learned | None) -> DiTBackbone:
    """Return a transformer with the setting for its learned positions.

    Raises:
        UserError: it has no learned positions.
    """
    if learned is None:
        return dit
    if dit.positions != "rope_learned":
        raise UserError(
            "--positions applies to learned positions, but this transformer has none (only 5b-I2V "
            "has them); omit it."
        )
    return dataclasses.replace(dit, learned=learned)


def _stored_dtype(options: ImportCogVideoX) -> str:
    """Return the dtype of the transformer's weights."""
    specs = pipeline.specs(TRANSFORMER, options.src, options.dtype)
    return specs["proj_out/kernel"].dtype.name


def _summary(options: ImportCogVideoX, prompts: dict[str, np.ndarray]) -> str:
    what = "CogVideoX in our layout"
    if options.actions:
        what = "a world model controlled by actions"
    elif options.rgbd:
        what = "a world model" + " with memory blocks" * options.memory
    if not prompts:
        return f"{what}, no prompt (there is no text_encoder/)"
    return f"{what}, {len(prompts)} prompt{'s' * (len(prompts) > 1)} encoded"


def import_dinov2(options: ImportDINOv2) -> None:
    """Run ``import dinov2``."""
    options = _found(options)
    dinov2.convert(options.src, options.dst, options.dtype)


def import_svd(options: ImportSVD) -> None:
    """Run ``import svd``."""
    options = _found(options)
    size = options.height, options.width
    svd.import_world(options.src, options.dst, options.dtype, size)
    print(
        f"{options.dst}: a world model; licence of the original: {cogvideox.licence(options.src)}"
    )


def import_cosmos2(options: ImportCosmos2) -> None:
    """Run ``import cosmos2``."""
    options = _found(options)
    size = options.frames, options.height, options.width
    texts = options.prompt, options.negative
    encoded = cosmos.import_world(options.src, options.dst, options.dtype, size, texts)
    prompts = "prompts encoded" if encoded else "no prompt (there is no text_encoder/)"
    licence = cogvideox.licence(options.src)
    print(f"{options.dst}: a world model, {prompts}; licence of the original: {licence}")


def import_lora(options: ImportLoRA) -> None:
    """Run ``import lora``."""
    print(f"{options.dst}: {adapters.import_adapters(options.src, options.dst, options.base)}")


def merge(options: Merge) -> None:
    """Run ``merge``."""
    adapters.merge(options.src, options.dst)
    print(f"{options.dst} is ready: pewm_jax.load({str(options.dst)!r})")


def export_diffusers(options: ExportDiffusers) -> None:
    """Run ``export diffusers``."""
    cogvideox.export(options.src, options.dst, options.base, options.dtype, options.original)
    print(f"{options.dst}: transformer/, vae/, scheduler/ for diffusers' from_pretrained")


def export_inference(options: ExportInference) -> None:
    """Run ``export inference``."""
    inference.export(options.src, options.dst, options.dtype)


def export_stablehlo(options: ExportStableHLO) -> None:
    """Run ``export stablehlo``."""
    stablehlo.export(
        options.src,
        options.dst,
        what=options.what,
        clips=options.clips,
        frames=options.frames,
        platforms=options.platforms,
        check=options.check,
    )
