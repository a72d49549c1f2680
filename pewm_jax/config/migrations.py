"""Upgrades of settings that earlier versions of this library wrote.

``config.json`` states its version; files without one are version 1. For each version, one function
turns its values into those of the next.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

from pewm_jax.config.experiment import VERSION
from pewm_jax.errors import ConfigError, require

Values = dict[str, Any]
Kinds = Mapping[str, Any]
"""The kind of each section by its path in the model: ``{"memory.encoder": "dinov2"}``."""


def upgrade(values: Values, where: str, under: Kinds | None = None) -> Values:
    """Upgrade the plain values of a configuration to the current version.

    Args:
        values: nested plain values, as read from JSON; they are not changed.
        where: name of the file, for error messages.
        under: kinds of the settings that the values are laid over, for sections that do not state
            their kind; by default the default kinds of the values' version.

    Raises:
        ConfigError: the version is not a number, or newer than this library supports.
    """
    version = values.get("version", VERSION if "model" in values else 1)
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ConfigError(f"{where} says version {version!r}: it must be a whole number from 1.")
    if version > VERSION:
        raise ConfigError(
            f"{where} is of version {version}, and this pewm_jax reads versions up to {VERSION}: "
            "install a newer pewm_jax."
        )
    values = copy.deepcopy(values)
    for number in range(version, VERSION):
        values = MIGRATIONS[number](values, where, under or {})
        values["version"] = number + 1
    _rename_settings(values)
    return values


def from_1(values: Values, where: str, under: Kinds) -> Values:
    """Move the model's sections under ``model`` and split them into parts with kinds.

    Version 1 held the settings of all kinds side by side and used those of one; the others are
    dropped. A part that does not state its kind has that of ``under``, or the default kind.
    """
    sections = ("clip", "actions", "codec", "dit", "memory", "diffusion", "train")
    _require_tables(values, where, *sections)
    _require_tables(values.get("codec", {}), f"{where}.codec", "vae")
    _require_tables(values.get("memory", {}), f"{where}.memory", "dinov2")
    old = dict(values)
    model: Values = {}
    for name in ("clip", "actions"):
        if name in old:
            model[name] = old.pop(name)
    train = old.get("train", {})
    _move(train, "dtype", model, "dtype")
    diffusion = old.pop("diffusion", {})
    for name in ("image_noise_mean", "image_noise_std"):
        _move(diffusion, name, train, name)
    if diffusion:
        model["noise"] = diffusion
    if train:
        old["train"] = train
    if "codec" in old:
        model["codec"] = _codec(old.pop("codec"), under)
    if "dit" in old:
        model["backbone"] = _backbone(old.pop("dit"))
    if "memory" in old:
        memory = old.pop("memory")
        if "depth" in memory:
            _move(memory, "depth", model.setdefault("clip", {}), "depth")
        model["memory"] = _memory(memory, under)
    return {"version": 2, "model": model, **old}


def from_2(values: Values, where: str, under: Kinds) -> Values:
    """Rename the reader that attends to points to `attend`."""
    del where, under
    section: Any = values
    for name in ("model", "memory", "reader"):
        section = section.get(name, {}) if isinstance(section, dict) else {}
    if isinstance(section, dict) and "kind" in section:
        section["kind"] = kind_now("reader", section["kind"])
    return values


def from_3(values: Values, where: str, under: Kinds) -> Values:
    """Let whole experiments draw noise from the key of their initial weights, as they did.

    A file that is laid over other settings, and does not hold all of ``train``, changes no key.
    """
    del where, under
    train = values.get("train")
    if isinstance(train, dict) and {"run", "seed", "ema"} <= train.keys():
        train.setdefault("noise_key", "weights")
    return values


def from_4(values: Values, where: str, under: Kinds) -> Values:
    """Turn the project of Weights & Biases, ``train.wandb``, into one of ``train.log``."""
    del where, under
    train = values.get("train")
    if isinstance(train, dict) and (project := train.pop("wandb", "")):
        train["log"] = logs_with(project)
    return values


def logs_with(project: str) -> list[str]:
    """Return the logs that ``train.wandb`` set to a project meant up to version 4."""
    return ["jsonl", "tensorboard", f"wandb:{project}"]


def _rename_settings(values: Values) -> None:
    """Rename settings that had other names in earlier files of the current version, in place."""
    model = values.get("model")
    if isinstance(model, dict):
        for old, new in RENAMED_SETTINGS.get(str(model.get("kind")), {}).items():
            _move(model, old, model, new)


def kind_now(section: str, name: Any) -> Any:
    """Return the present name of a kind that may have had another name in earlier versions."""
    return RENAMED_KINDS.get((section, name), name) if isinstance(name, str) else name


def _require_tables(values: Values, where: str, *names: str) -> None:
    """Refuse sections whose settings move and that are not tables."""
    for name in names:
        found = values.get(name, {})
        require(
            isinstance(found, dict),
            f"{where}.{name} must be a table of settings, got {type(found).__name__}.",
        )


def _backbone(old: Values) -> Values:
    """State the behaviour of a table of learned positions for other numbers of frames."""
    table = {"learned": "reference"} if old.get("positions") == "rope_learned" else {}
    return table | old


def _codec(old: Values, under: Kinds) -> Values:
    vae = old.pop("vae", {})
    if old.get("kind", under.get("codec", "pixel")) != "vae":
        return old
    unused = ("spatial", "temporal")
    return {name: value for name, value in old.items() if name not in unused} | vae


def _memory(old: Values, under: Kinds) -> Values:
    """Split memory settings into memory, ``encoder`` and ``reader``."""
    new, encoder, reader = {}, {}, {}
    kind = old.get("kind", under.get("memory", "voxel"))
    _move(old, "kind", new, "kind")
    _move(old, "encoder", encoder, "kind")
    _move(old, "encoder_patch", encoder, "patch")
    _move(old, "encoder_size", encoder, "size")
    _move(old, "dinov2", encoder, "network")
    features = encoder.get("kind", under.get("memory.encoder", "patch_colours"))
    unused = {"dinov2": ("patch",), "patch_colours": ("size", "network")}.get(str(features), ())
    encoder = {name: value for name, value in encoder.items() if name not in unused}
    for name in ("positions", "frame", "looks", "heads", "head_dim", "mlp_ratio"):
        _move(old, name, reader, name)
    if kind in ("voxel", "map2d", "points", "none"):
        old.pop("snapshots", None)
    if reader:
        reader = {"kind": "attend", **reader}  # there was no other
    parts = {"encoder": encoder, "reader": reader}
    return new | old | {name: part for name, part in parts.items() if part}


def _move(old: Values, name: str, new: Values, to: str) -> None:
    if name in old:
        new[to] = old.pop(name)


MIGRATIONS: dict[int, Callable[[Values, str, Kinds], Values]] = {
    1: from_1,
    2: from_2,
    3: from_3,
    4: from_4,
}
"""Version → the function that upgrades its values to the next version."""

RENAMED_KINDS = {("reader", "attention"): "attend"}
"""Section and name of kinds in earlier versions → their names now."""

RENAMED_SETTINGS = {
    "pewm": {"last_alone": "asked_alone"},
    "persist": {
        "hold": "persistence_logit",
        "doubt": "empty_prior",
        "sight": "observation_logit",
    },
}
"""Kind of world → earlier names of its settings → their names now."""

RENAMED_FLAGS = (
    ("dit.", "model.backbone."),
    ("diffusion.image_noise_", "train.image_noise_"),
    ("diffusion.", "model.noise."),
    ("codec.vae.", "model.codec."),
    ("train.dtype", "model.dtype"),
    ("log", "train.log"),
    ("memory.depth", "model.clip.depth"),
    ("memory.no_depth", "model.clip.no_depth"),
    ("memory.encoder", "model.memory.encoder.kind"),
    ("memory.read", "model.memory.reader.kind"),
    ("model.memory.read", "model.memory.reader.kind"),
    ("memory.dinov2.", "model.memory.encoder.network."),
    ("memory.encoder_patch", "model.memory.encoder.patch"),
    ("memory.encoder_size", "model.memory.encoder.size"),
    *(
        (f"memory.{name}", f"model.memory.reader.{name}")
        for name in ("positions", "frame", "looks", "heads", "head_dim", "mlp_ratio")
    ),
)
"""Short and earlier names of flags → their names now; the first match counts. An entry that ends in
a dot or an underscore is a prefix."""
