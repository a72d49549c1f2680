"""CogVideoX folders: read a checkpoint, import it, load the import, export it again.

A pipeline's folder has ``transformer/``, ``vae/`` and ``scheduler/``, each with its JSON settings
and safetensors (one file or shards). An imported folder has the same parts in our layout::

    DST/transformer/config.json   weights.safetensors
        vae/config.json           weights.safetensors
        scheduler/config.json
        text/weights.safetensors  the encoded prompts (if there is a text encoder)
        base.json                 the three original settings, licence, prompts

``base.json`` describes the origin of the converted weights, so that ``export`` can write them in
the format of diffusers' ``from_pretrained``. Three kinds of folder can be exported: an import, an
import widened to a world model, and a training run that started from one. For a world model only
the video model inside is written, without the memory blocks and the channels of depth and camera.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import ClipConfig, Config, Encoder, UserError
from pewm_jax.convert import pipeline, schedulers, widen
from pewm_jax.convert.pipeline import CONFIG, WEIGHTS
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import hub, sources, tensor_files, tree, weights
from pewm_jax.io.published import Network
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.convert import TRANSFORMER, VAE
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.types import Params
from pewm_jax.worlds import lora
from pewm_jax.worlds.egowm import paper as egowm_paper
from pewm_jax.worlds.pewm import paper

PIPELINES = (
    "CogVideoXPipeline",
    "CogVideoXImageToVideoPipeline",
    "CogVideoXVideoToVideoPipeline",
)
BASE = "base.json"
"""File with the origin of converted weights, beside ``config.json`` or the networks' folders."""
PARTS = ("transformer", "vae", "scheduler")
UNSTATED = "not stated in the original folder; ask its source before you redistribute it"
_CARD = re.compile(r"^(license|license_name|license_link):\s*(\S.*)$", re.MULTILINE)
_TEXT = ("text_encoder", "tokenizer")
"""Parts that are copied without conversion."""


read_transformer = functools.partial(pipeline.read, TRANSFORMER)
"""Read the transformer for ``pewm_jax.models.cogvideox.model.apply``; see ``pipeline.read``."""
read_vae = functools.partial(pipeline.read, VAE)
"""Read the VAE for ``pewm_jax.models.cogvideox.vae``; see ``pipeline.read``."""
read_scheduler = functools.partial(schedulers.read, schedulers.COGVIDEOX)
"""Read the scheduler of a checkpoint, a ``DDPMConfig``; see ``schedulers.read``."""


def require_pipeline(src: Path) -> None:
    """Check that a folder contains a CogVideoX pipeline, and no weights that would be ignored.

    Raises:
        UserError: it is another pipeline, or contains further weights (such as a LoRA).
    """
    if not src.is_dir():
        raise UserError(f"{src} is not a folder; give a diffusers pipeline's folder.")
    if (src / "model_index.json").is_file():
        sources.read_config(src / "model_index.json", PIPELINES)
    known = (TRANSFORMER.folder, VAE.folder, "text_encoder")
    found = [*src.glob("*.safetensors"), *src.glob("*/*.safetensors")]
    unused = [str(path.relative_to(src)) for path in found if path.parent.name not in known]
    if unused:
        raise UserError(
            f"{src} contains weights that cannot be used: {tree.listing(unused)}; merge a LoRA "
            "into the transformer first, and move the other files away."
        )


def load(network: Network, folder: str | Path) -> tuple[Any, Params]:
    """Load a network of an imported folder: its configuration and NumPy parameters.

    Raises:
        UserError: it is missing or damaged.
    """
    inside = Path(folder) / network.folder
    config = configuration.load(inside / CONFIG, network.config_class)
    params = weights.load(inside / WEIGHTS)
    weights.check(params, network.like(config), str(inside / WEIGHTS))
    return config, params


load_transformer, load_vae = (functools.partial(load, part) for part in (TRANSFORMER, VAE))


def load_scheduler(folder: str | Path) -> DDPMConfig:
    """Load the scheduler of an imported folder."""
    return configuration.load(Path(folder) / "scheduler" / CONFIG, DDPMConfig)


def write_network(network: Network, src: Path, dtype: str | None, folder: Path) -> None:
    """Write one published network in our layout, tensor by tensor as it is read."""
    folder.mkdir(parents=True)
    configuration.save(pipeline.read_config(network, src), folder / CONFIG)
    specs, blocks = pipeline.part(network, src, dtype)
    with pipeline.megabytes(f"write {folder.name}", tensor_files.size(specs)) as progress:
        header = tensor_files.header({})
        tensor_files.write(folder / WEIGHTS, specs, blocks(), header, progress)


def import_pipeline(
    src: Path, dst: Path, dtype: str | None, prompts: dict[str, np.ndarray], record: dict[str, Any]
) -> None:
    """Write an imported folder, one tensor at a time.

    Args:
        dtype: dtype of the weights; by default the stored one.
        prompts: prompt → tokens (L, text_dim); empty without a text encoder.
        record: the content of ``base.json``.
    """
    with pipeline.new_folder(dst) as folder:
        for network in (TRANSFORMER, VAE):
            write_network(network, src, dtype, folder / network.folder)
        (folder / "scheduler").mkdir()
        configuration.save(read_scheduler(src), folder / "scheduler" / CONFIG)
        if prompts:
            stacked = np.stack(list(prompts.values()))
            kind = np.dtype(jax.numpy.dtype(dtype or "float32"))
            weights.save(folder / "text" / WEIGHTS, {"prompts_PLC": stacked.astype(kind)})
        pipeline.write_json(folder / BASE, record)


def describe_base(
    src: Path,
    settings: dict[str, dict[str, Any]],
    prompts: Sequence[str],
    dtype: str | None,
) -> dict[str, Any]:
    """Return the content of ``base.json``.

    ``settings`` are the original ones of ``PARTS``; prompts are in the order in which they are
    stored.
    """
    index = src / "model_index.json"
    return {
        **{part: settings[part] for part in PARTS},
        "model_index": sources.read_json(index) if index.is_file() else None,
        "name": hub.title(src),
        "licence": licence(src),
        "prompts": list(prompts),
        "dtype": dtype or "as stored",
    }


def licence(src: Path) -> str:
    """Return the licence that the folder's card or licence file states, in one line."""
    card = src / "README.md"
    if card.is_file():
        head = card.read_text(encoding="utf-8", errors="replace").split("\n---", 1)[0]
        stated = dict(_CARD.findall(head))
        names = [stated[key].strip("'\" ") for key in ("license_name", "license") if key in stated]
        link = stated.get("license_link")
        if names:
            return names[0] + (f" ({link})" if link else "")
    for name in ("LICENSE", "LICENSE.txt", "LICENSE.md"):
        if (src / name).is_file():
            text = (src / name).read_text(encoding="utf-8", errors="replace")
            lines = [line.strip(" #") for line in text.splitlines() if line.strip(" #")]
            if lines:
                return f"{lines[0]} (see the file {name} of the original)"
    return UNSTATED


def load_base(folder: Path) -> dict[str, Any]:
    """Read ``base.json``.

    Raises:
        UserError: it is missing or incomplete.
    """
    path = folder / BASE
    if not path.is_file():
        raise UserError(
            f"{path} does not exist, so the origin of these weights is unknown; give the "
            "imported folder with --base."
        )
    values = sources.read_json(path)
    lacking = [part for part in PARTS if not isinstance(values.get(part), dict)]
    if lacking:
        raise UserError(f"{path} lacks {', '.join(lacking)}; copy it again from the import.")
    return values


def config_of(
    dit: DiTBackbone,
    vae: VAECodec,
    noise: DDPMConfig,
    size: tuple[int | None, int | None, int | None],
    dtype: str | None,
    *,
    run: str = "world",
    encoder: Encoder | None = None,
) -> Config:
    """Return the settings of the world model around a video model.

    Training and memory are those of the presets ``pewm_2b`` and ``pewm_5b``; clip, codec, backbone
    and noise are the checkpoint's. Memory blocks are not wider than the transformer.

    Args:
        size: frames, height and width of a clip; None for the paper's 9 × 512 × 512, or for the
            size of the learned positions if they allow no other.
        dtype: dtype of the weights; 16-bit weights are computed in bfloat16.
        run: name of the experiment, for the folder of its runs.
        encoder: the image features stored in the map, by default the colours of patches.

    Raises:
        ConfigError: the network does not support the size.
    """
    frames, height, width = _size(dit, vae, size, dataclasses.astuple(paper.CLIP)[:3])
    return paper.experiment(
        dit,
        vae,
        noise,
        run=run,
        clip=ClipConfig(frames=frames, height=height, width=width),
        encoder=encoder,
        dtype=_computed(dtype),
    )


def actions_config_of(
    dit: DiTBackbone,
    vae: VAECodec,
    noise: DDPMConfig,
    size: tuple[int | None, int | None, int | None],
    dtype: str | None,
    *,
    run: str = "world",
) -> Config:
    """Return the settings of the world model controlled by actions; see ``config_of``.

    They are those of the preset ``egowm_cogvideox``, whose clip has 17 × 480 × 720.

    Raises:
        UserError: the network does not take an image.
        ConfigError: the network does not support the size.
    """
    latents = vae.latent_channels
    if (dit.in_channels, dit.out_channels) != (2 * latents, latents):
        raise UserError(
            f"The transformer has {dit.in_channels} input and {dit.out_channels} output channels; "
            f"one for --actions takes the {latents} of the autoencoder's latents twice, the second "
            "time those of the observed image: import an image-to-video checkpoint."
        )
    clip = _size(dit, vae, size, egowm_paper.COGVIDEOX_CLIP)
    return egowm_paper.cogvideox_experiment(
        dit, vae, noise, run=run, clip=clip, dtype=_computed(dtype)
    )


def _size(
    dit: DiTBackbone,
    vae: VAECodec,
    asked: tuple[int | None, int | None, int | None],
    usual: tuple[int, int, int],
) -> tuple[int, int, int]:
    """Return frames, height and width: what was asked, or what learned positions allow."""
    if dit.positions == "rope_learned" and dit.learned in ("exact", "reference"):
        scale = vae.spatial
        usual = (dit.sample_frames, dit.sample_height * scale, dit.sample_width * scale)
    frames, height, width = (
        value if given is None else given for given, value in zip(asked, usual, strict=True)
    )
    return frames, height, width


def _computed(dtype: str | None) -> Literal["float32", "bfloat16"]:
    return "float32" if dtype in (None, "float32") else "bfloat16"


def require_size(config: Config) -> None:
    """Check that the transformer's positions cover a clip.

    Raises:
        UserError: they are learned for another size, or are too few.
    """
    frames, height, width = config.model.latent_shape
    frames += -frames % config.model.backbone.patch_t
    clip = config.model.clip
    try:
        positions.token_grid(config.model.backbone, (1, frames, height, width, 1))
    except UserError as error:
        raise UserError(f"A clip of {clip.frames}×{clip.height}×{clip.width}: {error}") from None


def import_world(
    src: Path,
    dst: Path,
    config: Config,
    prompt_LC: np.ndarray | None,
    record: dict[str, Any],
    *,
    memory: bool,
    encoder: Params | None = None,
    dtype: str | None = None,
    seed: int = 0,
) -> None:
    """Write a world model's folder: ``config.json``, ``weights.safetensors``, ``base.json``.

    It is written while it is read, so one tensor is in memory at a time.

    Args:
        config: the world model, from ``config_of``.
        prompt_LC: (L, text_dim) tokens of the prompt, None without a text encoder.
        record: the content of ``base.json``.
        memory: whether to add memory blocks, drawn from ``seed``.
        encoder: parameters of the map's image encoder, if it has any.
        dtype: dtype of the weights; by default the stored one, and float32 for memory blocks.
    """
    old = TRANSFORMER.config(record["transformer"], BASE)
    channels = config.model.control.channels(config.model)
    plan = widen.plan(old, config.model.codec.latent_channels, channels)

    def is_end(path: str) -> bool:
        return path.startswith(widen.ENDS)

    def backbone() -> pipeline.Blocks:
        ends: dict[str, list[np.ndarray]] = {}
        for path, block in pipeline.stream(TRANSFORMER, src, dtype, is_end):
            ends.setdefault(path, []).append(block)
        narrow = {path: np.concatenate(blocks) for path, blocks in ends.items()}
        yield from tree.flatten(widen.widen(plan, tree.unflatten(narrow))).items()
        yield from pipeline.stream(TRANSFORMER, src, dtype, lambda path: not is_end(path))

    def blocks() -> Params:
        return jax.jit(lambda k: config.model.memory.reader.init(config.model, k))(
            jax.random.key(seed)
        )

    wide = tree.flatten(TRANSFORMER.like(plan.new))
    stored = pipeline.specs(TRANSFORMER, src, dtype)
    specs = {p: jax.ShapeDtypeStruct(wide[p].shape, spec.dtype) for p, spec in stored.items()}
    parts: dict[str, pipeline.Part] = {"backbone": (specs, backbone)}
    if memory:
        parts["memory"] = pipeline.made(jax.eval_shape(blocks), blocks, dtype)
    parts["codec"] = pipeline.part(VAE, src, dtype)
    given: dict[str, Params] = {}
    if encoder is not None:
        given["encoder"] = encoder
    if prompt_LC is not None:
        given["text"] = {"prompt_LC": prompt_LC}
    for name, params in given.items():
        parts[name] = pipeline.made(params, functools.partial(dict, params), dtype)
    pipeline.write_world(dst, config, parts, {BASE: record})


def import_actions(
    src: Path,
    dst: Path,
    config: Config,
    prompt_LC: np.ndarray | None,
    record: dict[str, Any],
    *,
    dtype: str | None = None,
) -> None:
    """Write the folder of a world model controlled by actions; arguments as ``import_world``.

    ``config`` is that of ``actions_config_of``. The actions' layers are new and in float32.
    """
    parts: dict[str, pipeline.Part] = {
        "backbone": pipeline.part(TRANSFORMER, src, dtype),
        "codec": pipeline.part(VAE, src, dtype),
        "control": pipeline.fresh_actions(config, dtype),
    }
    if prompt_LC is not None:
        tokens: Params = {"prompt_LC": prompt_LC}
        parts["text"] = pipeline.made(tokens, lambda: tokens, dtype)
    pipeline.write_world(dst, config, parts, {BASE: record})


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
        base_folder: the folder with ``base.json``; by default ``src`` or, for a training run, the
            folder it started from.
        dtype: dtype of the tensors; by default that of our weights.
        original: the original pipeline's folder, to copy text encoder and tokenizer from.

    Raises:
        UserError: ``dst`` exists, ``base.json`` is missing, or the weights do not fit it.
    """
    if not src.is_dir():
        raise UserError(f"{src} is not a folder; give an imported folder or a training run.")
    pipeline.refuse_existing(dst)
    record = load_base(base_folder or _origin(src))
    absent = [name for name in _TEXT if original and not (original / name).is_dir()]
    if absent:
        raise UserError(f"{original} has no folder {absent[0]}/; give the original pipeline's.")
    imported = (src / "transformer").is_dir()
    with pipeline.new_folder(dst) as folder:
        for network in (TRANSFORMER, VAE):
            params = load(network, src)[1] if imported else _run(src, network, record)
            values = record[network.folder]
            pipeline.write_published(network, values, params, folder / network.folder, dtype)
            del params
        (folder / "scheduler").mkdir()
        pipeline.write_json(folder / "scheduler" / "scheduler_config.json", record["scheduler"])
        pipeline.write_json(folder / "model_index.json", _index(record, text=original is not None))
        if original:
            for name in _TEXT:
                shutil.copytree(original / name, folder / name)


def _origin(src: Path) -> Path:
    """Return the folder with ``base.json``; for a training run, the folder it started from."""
    seen: list[Path] = []
    here = src
    while not (here / BASE).is_file() and (here / CONFIG).is_file() and here not in seen:
        seen.append(here)
        start = configuration.load(here / CONFIG, Config).train.start
        if not start:
            return src
        here = Path(start)
    return here


def _run(src: Path, network: Network, record: dict[str, Any]) -> Params:
    """Return the video model's part of a world model."""
    config = configuration.load(src / CONFIG, Config)
    path = src / WEIGHTS
    lora.require_whole(src)
    if network is VAE:
        params = weights.load(path, "codec")
    else:
        params = weights.load(path, "backbone")
        if config.model.codec.depth_channels:
            old = network.config(record[network.folder], BASE)
            vae = VAE.config(record[VAE.folder], BASE)
            plan = widen.plan(old, vae.latent_channels, config.model.control.channels(config.model))
            weights.check(params, network.like(plan.new), f"the backbone in {path}")
            params = widen.narrow(plan, params)
    like = network.like(network.config(record[network.folder], BASE))
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
        "transformer": ["diffusers", TRANSFORMER.class_name],
        "vae": ["diffusers", VAE.class_name],
    }
