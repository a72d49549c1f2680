"""Run ``pewm-jax pull`` and ``pewm-jax push``: models by name on a hub."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pewm_jax import shipped
from pewm_jax.errors import ConfigError, UserError
from pewm_jax.io import hub


@dataclasses.dataclass(frozen=True)
class PullSettings:
    """Download a world model by its name into the cache of huggingface_hub.

    Every file is compared with the hash that the hub states. Other commands accept the name, too,
    and download what the cache lacks.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """org/name, org/name@revision, or a folder."""
    revision: str | None = None
    """A branch, a tag or a commit; by default the newest."""
    out: Path | None = None
    """Also copy the files into this new folder."""


@dataclasses.dataclass(frozen=True)
class PushSettings:
    """Upload a world model: its settings, inference weights and card.

    Log in first with `hf auth login` or HF_TOKEN.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run's folder, an import or an export for inference."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """org/name on the hub, which is created if it is new; or a path such as ./released, for the
    same files in a new folder."""
    dtype: Literal["bfloat16", "float16"] | None = None
    """Round the weights to 16 bits; by default they are unchanged."""
    private: bool = False
    """Create a private model."""


def pull(settings: PullSettings) -> None:
    """Run ``pull``: print the revision and the folder."""
    folder = shipped.find(settings.name, settings.revision)
    if not (folder / "config.json").is_file() or not (folder / "weights.safetensors").is_file():
        raise UserError(
            f"{settings.name} has no config.json with weights.safetensors, so it is no world model "
            "of pewm_jax; for checkpoints of other libraries use `pewm-jax convert import`."
        )
    if settings.out is not None:
        from pewm_jax.convert import pipeline

        with pipeline.new_folder(settings.out) as partial:
            _copy(folder, partial)
    else:
        from pewm_jax.io import weights

        weights.verify(folder / "weights.safetensors")
    print(f"{hub.title(folder)}: {settings.out or folder}")


def push(settings: PushSettings) -> None:
    """Run ``push``: print the name with its commit."""
    named = hub.parse(settings.name)
    if named is None and not _is_path(settings.name):
        raise ConfigError(
            f"NAME is {settings.name}: give org/name on the hub, or a path such as ./released."
        )
    if named is not None and named[1]:
        raise ConfigError(
            f"NAME is {settings.name}: a push makes a new revision; omit @{named[1]}."
        )
    if named is None:
        _write(settings, Path(settings.name))
        print(f"{settings.name}: pewm_jax.load({settings.name!r})")
        return
    hub.require(named[0])
    with tempfile.TemporaryDirectory(prefix="pewm-push-") as place:
        _write(settings, Path(place) / "model", named[0])
        commit = hub.push(Path(place) / "model", named[0], private=settings.private)
    pinned = f"{named[0]}@{commit}"
    print(f"{pinned}: pewm_jax.load({pinned!r})")


def _is_path(name: str) -> bool:
    return name.startswith(("/", "./", "../", "~")) or Path(name).parent.is_dir()


def _write(settings: PushSettings, dst: Path, name: str = "") -> None:
    """Write the files to push into a new folder.

    A world gets a card; of a policy, which has none, the files are copied.
    """
    from pewm_jax import config as configuration
    from pewm_jax.convert import inference, pipeline

    run = shipped.find(settings.run)
    if not run.is_dir():
        raise UserError(f"{settings.run} does not exist; give the folder of a run.")
    if configuration.load(run / "config.json").model.EXPORTED:
        inference.export(run, dst, settings.dtype, name=name, log=lambda _: None)
        if settings.dtype is None and (run / inference.CARD).is_file():
            shutil.copyfile(run / inference.CARD, dst / inference.CARD)
    else:
        with pipeline.new_folder(dst) as partial:
            _copy(run, partial)


def _copy(src: Path, dst: Path) -> None:
    """Copy the files of a model from a folder to another one, and verify its weights."""
    from pewm_jax.io import weights

    weights.verify(src / "weights.safetensors")
    for name in hub.WORLD:
        if (src / name).is_file():
            shutil.copyfile(src / name, dst / name)
