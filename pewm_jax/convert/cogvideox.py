"""CogVideoX checkpoints in the layout of diffusers: read, import, and load what was imported.

A pipeline's folder has ``transformer/``, ``vae/`` and ``scheduler/``, each with its JSON settings
and safetensors, one file or shards. An imported folder has the same parts in our layout::

    DST/transformer/config.json   weights.safetensors
        vae/config.json           weights.safetensors
        scheduler/config.json
        text/weights.safetensors  the prompts, encoded (where there is a text encoder)
        base.json                 the three original settings, licence, prompts
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import DiTConfig, UserError, VAEConfig
from pewm_jax.convert import assemble, base, output, scheduler, sources, transformer, vae
from pewm_jax.convert.mapping import Entry
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tensor_files, tree, weights
from pewm_jax.models.cogvideox import model as dit_model
from pewm_jax.models.cogvideox import vae as vae_model
from pewm_jax.types import Array, Params

PIPELINES = (
    "CogVideoXPipeline",
    "CogVideoXImageToVideoPipeline",
    "CogVideoXVideoToVideoPipeline",
)
WEIGHTS = "weights.safetensors"
CONFIG = "config.json"


@dataclasses.dataclass(frozen=True)
class Network:
    """A network that can be converted.

    Attributes:
        folder: its folder in a pipeline, theirs and ours.
        theirs: its class in diffusers.
        ours: our configuration's class.
        converter: ``config_from_diffusers``, ``config_to_diffusers`` and ``entries``.
        init: ``(config, key) -> params``.
    """

    folder: str
    theirs: str
    ours: type
    converter: ModuleType
    init: Callable[[Any, Array], Params]

    def entries(self, config: Any) -> Sequence[Entry]:
        """Return the converter's table."""
        return self.converter.entries(config)

    def like(self, config: Any) -> Params:
        """Return the abstract parameters, nothing allocated."""
        return jax.eval_shape(lambda key: self.init(config, key), jax.random.key(0))

    def config(self, values: dict[str, Any], where: str) -> Any:
        """Read the settings of diffusers.

        Raises:
            UserError: a setting is unknown or unsupported.
        """
        try:
            return self.converter.config_from_diffusers(values)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None


TRANSFORMER = Network(
    "transformer", "CogVideoXTransformer3DModel", DiTConfig, transformer, dit_model.init
)
VAE = Network("vae", "AutoencoderKLCogVideoX", VAEConfig, vae, vae_model.init)


def read_transformer(folder: str | Path, dtype: str | None = None) -> tuple[DiTConfig, Params]:
    """Read the diffusion transformer of a CogVideoX checkpoint.

    Args:
        folder: a diffusers pipeline's folder, or the transformer's folder in it.
        dtype: of the parameters, ``float32``, ``bfloat16`` or ``float16``; by default the
            stored one.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.cogvideox.model.apply``, NumPy arrays.

    Raises:
        UserError: a tensor that is missing, left over or of another shape, a damaged file, a
            class or setting that is not known.
    """
    return read_network(TRANSFORMER, Path(folder), dtype)


def read_vae(folder: str | Path, dtype: str | None = None) -> tuple[VAEConfig, Params]:
    """Read the VAE of a CogVideoX checkpoint; see ``read_transformer``.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.cogvideox.vae.encode`` and ``decode``.
    """
    return read_network(VAE, Path(folder), dtype)


def read_scheduler(folder: str | Path) -> DDPMConfig:
    """Read the scheduler of a CogVideoX checkpoint: settings only, it has no weights.

    Args:
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting that is not known.
    """
    return scheduler.config_from_diffusers(scheduler_settings(Path(folder)))


def require_pipeline(src: Path) -> None:
    """Insist that a folder holds a CogVideoX pipeline, and no weights that would not be read.

    Raises:
        UserError: another pipeline, or weights beside those of its parts (such as a LoRA).
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
            f"{src} holds weights that are of no use here: {tree.listing(unused)}; merge a LoRA "
            "into the transformer first, and move away the rest."
        )


def settings(network: Network, folder: Path) -> dict[str, Any]:
    """Read a network's settings as diffusers wrote them."""
    return sources.read_config(sources.component(folder, network.folder) / CONFIG, [network.theirs])


def scheduler_settings(folder: Path) -> dict[str, Any]:
    """Read the scheduler's settings as diffusers wrote them."""
    path = sources.component(folder, "scheduler") / "scheduler_config.json"
    return sources.read_config(path, sorted(scheduler.CLASSES))


def read_network(network: Network, folder: Path, dtype: str | None) -> tuple[Any, Params]:
    """Read the settings and weights of a network from a pipeline's folder or its own.

    Raises:
        UserError: see ``read_transformer``.
    """
    inside = sources.component(folder, network.folder)
    config = network.config(settings(network, folder), str(inside / CONFIG))
    entries, source = network.entries(config), sources.open_folder(inside)
    total = sum(place.size for _, place in source.places.values())
    with output.megabytes(f"read {network.folder}", total) as progress:
        return config, assemble.read(entries, source, network.like(config), dtype, progress)


def stored_specs(
    network: Network, folder: Path, dtype: str | None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return shape and dtype of every leaf that reading a network will give, by path."""
    config = network.config(settings(network, folder), network.folder)
    source = sources.open_folder(sources.component(folder, network.folder))
    entries, like = network.entries(config), network.like(config)
    assemble.require(entries, source, like)
    return assemble.leaf_specs(entries, source, like, dtype)


def load_transformer(folder: str | Path) -> tuple[DiTConfig, Params]:
    """Load the transformer of an imported folder.

    Raises:
        UserError: it is absent or damaged.
    """
    return _load(TRANSFORMER, Path(folder))


def load_vae(folder: str | Path) -> tuple[VAEConfig, Params]:
    """Load the VAE of an imported folder; see ``load_transformer``."""
    return _load(VAE, Path(folder))


def load_scheduler(folder: str | Path) -> DDPMConfig:
    """Load the scheduler of an imported folder."""
    return configuration.load(Path(folder) / "scheduler" / CONFIG, DDPMConfig)


def _load(network: Network, folder: Path) -> tuple[Any, Params]:
    inside = folder / network.folder
    config = configuration.load(inside / CONFIG, network.ours)
    params = weights.load(inside / WEIGHTS)
    weights.check(params, network.like(config), str(inside / WEIGHTS))
    return config, params


def write_network(config: Any, params: Params, folder: Path) -> None:
    """Write one network in our layout."""
    folder.mkdir(parents=True)
    configuration.save(config, folder / CONFIG)
    size = tensor_files.size(tree.flatten(params))
    with output.megabytes(f"write {folder.name}", size) as progress:
        weights.save(folder / WEIGHTS, params, progress=progress)


def write_diffusers(
    network: Network,
    values: dict[str, Any],
    params: Params,
    folder: Path,
    dtype: str | None = None,
) -> None:
    """Write one network as diffusers' ``from_pretrained`` reads it.

    Args:
        network: which.
        values: its settings as diffusers names them.
        params: our parameters.
        folder: to make, or an empty one.
        dtype: of the tensors; by default that of the parameters.
    """
    folder.mkdir(parents=True, exist_ok=True)
    output.write_json(folder / CONFIG, values)
    entries = network.entries(network.config(values, "base.json"))
    specs = assemble.specs(entries, params, dtype)
    path = folder / "diffusion_pytorch_model.safetensors"
    tensors = assemble.write(entries, params, dtype)
    with output.megabytes(f"write {network.folder}", tensor_files.size(specs)) as progress:
        tensor_files.write(path, specs, tensors, {"format": "pt"}, progress)


def import_pipeline(
    src: Path, dst: Path, dtype: str | None, prompts: dict[str, np.ndarray], record: dict[str, Any]
) -> None:
    """Write an imported folder, one network at a time.

    Args:
        src: a diffusers pipeline's folder.
        dst: the folder to make, not there yet.
        dtype: of the weights; by default the stored one.
        prompts: their tokens (L, text_dim) by prompt; empty without a text encoder.
        record: what ``base.json`` shall hold.
    """
    with output.new_folder(dst) as folder:
        for network in (TRANSFORMER, VAE):
            write_network(*read_network(network, src, dtype), folder / network.folder)
        (folder / "scheduler").mkdir()
        configuration.save(read_scheduler(src), folder / "scheduler" / CONFIG)
        if prompts:
            stacked = np.stack(list(prompts.values()))
            kind = np.dtype(jax.numpy.dtype(dtype or "float32"))
            weights.save(folder / "text" / WEIGHTS, {"prompts_PLC": stacked.astype(kind)})
        base.save(folder, record)
