"""Published checkpoints: tables of tensor names, and strict reading of settings.

Each network that can be converted has a ``Network`` in ``models/<family>/convert.py``. Its table is
a list of ``Entry``: one per published tensor, with the path of our leaf and the transform between
the two layouts. The same table is used to read (published → ours), to write (ours → published), and
to check names and shapes before any weight is read. ``convert.pipeline`` does the work.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class Transform:
    """A layout transform and its inverse; both are views or permutations.

    Attributes:
        read: published tensor → our layout.
        write: our layout → published tensor.
    """

    read: Callable[[Array], Array]
    write: Callable[[Array], Array]


SAME = Transform(lambda x: x, lambda x: x)
"""Biases, scales, embeddings: no change."""
LINEAR = Transform(lambda x: x.T, lambda x: x.T)
"""torch (out, in) ↔ ours (in, out)."""
CONV = Transform(
    lambda x: np.moveaxis(x, (0, 1), (-1, -2)),
    lambda x: np.moveaxis(x, (-1, -2), (0, 1)),
)
"""torch (out, in, k…) ↔ ours (k…, in, out), any number of spatial axes."""
TIME_CONV = Transform(
    lambda x: np.moveaxis(x[:, :, :, 0, 0], (0, 1), (2, 1)),
    lambda x: np.moveaxis(x, (2, 1), (0, 1))[:, :, :, None, None],
)
"""torch (out, in, 3, 1, 1) ↔ ours (3, in, out)."""
POINTWISE = Transform(lambda x: x[:, :, 0, 0].T, lambda x: x.T[:, :, None, None])
"""torch (out, in, 1, 1) ↔ ours (in, out)."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """One published tensor.

    Attributes:
        name: its name in the published file.
        path: path of our leaf, keys joined by slashes (see ``pewm_jax.io.tree``).
        transform: the layout transform.
        layer: index on the leading axis of our leaf if layers are stacked, else None.
    """

    name: str
    path: str
    transform: Transform = SAME
    layer: int | None = None


@dataclasses.dataclass(frozen=True)
class Network:
    """A network's format in published checkpoints.

    Attributes:
        folder: its folder in a pipeline, published and ours.
        class_name: its class in the library that published it.
        config_class: our configuration class.
        read_config: ``(values of config.json) -> config``.
        write_config: the inverse of ``read_config``.
        entries: ``(config) -> table``.
        init: ``(config, key) -> params``.
        unused: published tensors that no network uses; ignored silently.
        class_key: the setting of config.json that names the class.
        weights_file: name of the weights file that is written.
    """

    folder: str
    class_name: str
    config_class: type
    read_config: Callable[[dict[str, Any]], Any]
    write_config: Callable[[Any], dict[str, Any]]
    entries: Callable[[Any], Sequence[Entry]]
    init: Callable[[Any, Array], Params]
    unused: Collection[str] = ()
    class_key: str = "_class_name"
    weights_file: str = "diffusion_pytorch_model.safetensors"

    def like(self, config: Any) -> Params:
        """Return the abstract parameters, without allocating memory."""
        return jax.eval_shape(lambda key: self.init(config, key), jax.random.key(0))

    def config(self, values: dict[str, Any], where: str) -> Any:
        """Read the published settings; UserError, which names ``where``, for unsupported ones."""
        try:
            return self.read_config(values)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None


def patches(patch: int) -> Transform:
    """Return torch (D, 3, p, p), a convolution of a picture's patches ↔ ours (p·p·3, D)."""
    return Transform(
        lambda x: np.moveaxis(x, (1, 0), (2, 3)).reshape(patch * patch * 3, -1),
        lambda x: np.moveaxis(x.reshape(patch, patch, 3, -1), (2, 3), (1, 0)),
    )


def affine(
    theirs: str, ours: str, layer: int | None = None, transform: Transform = LINEAR
) -> Iterator[Entry]:
    """Yield the entries of a linear layer, or of another one with a kernel and a bias."""
    yield Entry(f"{theirs}.weight", f"{ours}/kernel", transform, layer)
    yield Entry(f"{theirs}.bias", f"{ours}/bias", SAME, layer)


def norm(theirs: str, ours: str, layer: int | None = None) -> Iterator[Entry]:
    """Yield the entries of a norm."""
    yield Entry(f"{theirs}.weight", f"{ours}/scale", SAME, layer)
    yield Entry(f"{theirs}.bias", f"{ours}/bias", SAME, layer)


Fields = Mapping[str, tuple[str, Any]]
"""Published setting → our field, and the default of the class that published it."""


def defaults(fields: Fields) -> dict[str, Any]:
    """Return the defaults by the settings' published names."""
    return {theirs: default for theirs, (_, default) in fields.items()}


def read_fields(fields: Fields, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return our fields: lists become tuples, and whole numbers floats where the default is one."""
    return {name: _ours(given[key], default) for key, (name, default) in fields.items()}


def write_fields(fields: Fields, config: Any) -> dict[str, Any]:
    """Return the published settings of our configuration; the inverse of ``read_fields``."""
    values = {key: getattr(config, name) for key, (name, _) in fields.items()}
    return {key: _plain(value) for key, value in values.items()}


TRANSFORMERS_METADATA = (
    "architectures",
    "model_type",
    "torch_dtype",
    "dtype",
    "transformers_version",
    "_name_or_path",
    "id2label",
    "label2id",
    "problem_type",
    "return_dict",
    "output_hidden_states",
    "output_attentions",
    "is_encoder_decoder",
    "chunk_size_feed_forward",
    "torchscript",
    "use_bfloat16",
    "initializer_range",
)
"""Settings in every ``config.json`` of transformers that do not change what a network computes."""


def rename(path: str, rules: Sequence[tuple[str, Any]]) -> str:
    """Return the published name of a path: apply regular expressions, then torch's conventions."""
    for pattern, name in (*rules, (r"/(kernel|scale)$", "/weight"), (r"[/.]+", ".")):
        path = re.sub(pattern, name, path)
    return path


def require_known(values: Mapping[str, Any], what: str, known: Collection[str]) -> None:
    """Raise UserError for unknown settings.

    Those that begin with ``_`` are metadata and ignored.
    """
    unknown = sorted(key for key in values if not key.startswith("_") and key not in known)
    if unknown:
        raise UserError(
            f"{what} has settings that are not known: {', '.join(unknown)}; known are "
            f"{', '.join(sorted(known))}."
        )


def read_settings(
    values: Mapping[str, Any],
    what: str,
    name: str,
    defaults: Mapping[str, Any],
    without_effect: Collection[str] = (),
) -> dict[str, Any]:
    """Return the settings of a network of class ``name``, with the class's defaults.

    Args:
        values: the JSON object.
        what: what they describe, for messages: ``The U-Net``.
        defaults: the settings that matter, with the class's defaults.
        without_effect: settings that are allowed and ignored.

    Raises:
        UserError: another class, or an unknown setting. Naming no class is allowed.
    """
    if (kind := values.get("_class_name", name)) != name:
        raise UserError(f"{what} is a {kind}; only {name} can be read.")
    require_known(values, what, {*defaults, *without_effect})
    return {key: values.get(key, default) for key, default in defaults.items()}


def require_only(given: Mapping[str, Any], what: str, only: Mapping[str, Any]) -> None:
    """Raise UserError for settings with another value than the only supported one."""
    for key, value in only.items():
        if _plain(given.get(key, value)) != _plain(value):
            raise UserError(f"{what}'s {key} is {given[key]!r}; only {value!r} is supported.")


def require_choice(given: Mapping[str, Any], what: str, key: str, choices: Sequence[Any]) -> None:
    """Raise an error for a setting that is none of the supported values.

    Raises:
        UserError: it has another value.
    """
    if given[key] not in choices:
        names = ", ".join(map(str, choices))
        raise UserError(f"{what}'s {key} is {given[key]!r}; supported are {names}.")


def require_kinds(given: Mapping[str, Any], what: str, examples: Mapping[str, Any]) -> None:
    """Raise UserError for settings whose types differ from those of examples.

    An integer is accepted for a float. A list must have the length of a tuple in the examples; for
    a list in the examples it may have any length.
    """
    for key, example in examples.items():
        if not _same_type(given[key], example):
            raise UserError(f"{what}'s {key} is {given[key]!r}; give a value like {example!r}.")


def _ours(value: Any, example: Any) -> Any:
    if isinstance(value, list | tuple):
        return tuple(_ours(item, example[0]) for item in value)
    return float(value) if isinstance(example, float) else value


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _same_type(value: Any, example: Any) -> bool:
    if isinstance(example, tuple | list):
        fits = isinstance(value, tuple | list)
        fits = fits and (isinstance(example, list) or len(value) == len(example))
        return fits and all(_same_type(item, example[0]) for item in value)
    if isinstance(example, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is type(example)
