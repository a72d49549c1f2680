"""LoRA: low-rank adapters that are trained in place of the weights (Hu et al. 2021).

``adapt`` turns the stages of a world into stages that train adapters. The parameters of such a
stage have the branch ``lora``, with two arrays for each adapted kernel::

    backbone/blocks/to_q/kernel            W (layers, in, out), frozen
    lora/backbone/blocks/to_q/kernel/a     A (layers, in, rank), normal
    lora/backbone/blocks/to_q/kernel/b     B (layers, rank, out), zero

The loss gets W + alpha/rank · A @ B in their place. Networks of this package take it as a
``Deferred`` weight, so that only one layer's sum exists at a time; for other networks the sums are
computed before the network is called. A convolution's kernel (…, in, out) is adapted as the matrix
from all its inputs to its outputs, in peft's form: A is a convolution to ``rank`` channels, B is
pointwise.

Checkpoints and ``weights.safetensors`` hold the adapters, and the parameters that are trained
themselves, with a hash of the start weights: ``merge`` adds them to these.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import shipped
from pewm_jax.config import Config, LoRAConfig, Task, TrainSettings, UserError
from pewm_jax.io import tensor_files, tree, weights
from pewm_jax.io.store import file_hash
from pewm_jax.nn.deferred import LowRank, is_matrix, is_stacked
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage, is_of_this_package

ROOT = "lora"
"""The branch of the parameters that holds the adapters."""
PATHS = rf"{ROOT}/.*"
OF_DRAFT = "draft/"
"""Start of the paths of the parameters of the network that makes drafts."""
BASE, BASE_HASH = "base", "base_sha256"
"""Metadata of a file of adapters: the folder of the start weights, and their hash."""
_WEIGHTS = "weights.safetensors"


def adapt(config: Config, stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Return stages that train adapters, if ``train.lora.rank`` is set, else the same stages."""
    if not config.train.lora.rank:
        return tuple(stages)
    return tuple(
        _adapted(config.model, config.train, tuple(stages[: number + 1]))
        for number in range(len(stages))
    )


@functools.lru_cache(maxsize=64)
def _adapted(model: Task, train: TrainSettings, stages: tuple[Stage, ...]) -> Stage:
    """Return the last of these stages with adapters on what it, or an earlier one, trains."""
    stage, lora = stages[-1], train.lora
    begun = [one for one in stages if one is stage or getattr(train, one.name).steps > 0]
    shapes = shapes_of(model, stage)

    def trained_by(path: str, some: Sequence[Stage]) -> bool:
        return any(re.fullmatch(rule, path) for one in some for rule in one.trained)

    # A discriminator is not part of the model, so there are no weights of it to adapt.
    whole = (*lora.full, *stage.training_only)
    full = [path for path in shapes if matches(whole, path) and trained_by(path, begun)]
    adapted = {
        path: shape
        for path, shape in shapes.items()
        if is_matrix(path, shape) and re.fullmatch(lora.target, path)
        if path not in full and trained_by(path, begun)
    }
    rules = [(rf"{ROOT}/(?:{rule})/[ab]", label) for rule, label in stage.rules]
    if full:
        either = "|".join(f"(?:{pattern})" for pattern in whole)
        rules += [(rf"(?=(?:{either})\Z)(?:{rule})", label) for rule, label in stage.rules]
    leaves = [*(f"{ROOT}/{path}/{name}" for path in adapted for name in "ab"), *full]
    rules = [
        (rule, label)
        for rule, label in rules
        if label == FREEZE or any(re.fullmatch(rule, path) for path in leaves)
    ]
    trains = any(label == TRAIN for _, label in rules)
    candidates = [
        p for p, shape in shapes.items() if is_matrix(p, shape) and trained_by(p, [stage])
    ]

    def init(model: Task, key: Array) -> Params:
        return {**stage.init(model, key), **_init(adapted, lora.rank, key)}

    def loss(model: Task, train: Any, params: Params, clip: Clip, key: Array) -> Any:
        return stage.loss(model, train, bind(model, lora, params), clip, key)

    def prepare(model: Task, params: Params, clip: Clip) -> Clip:
        assert stage.prepare is not None
        return stage.prepare(model, bind(model, lora, params), clip)

    def require(model: Any) -> None:
        if stage.require is not None:
            stage.require(model)
        if not trains:
            raise UserError(
                f"train.lora.target {lora.target!r} matches no path of what {stage.title} trains "
                f"({tree.listing(candidates)}): it must match a whole path; change it, or set "
                f"train.{stage.name}.steps 0."
            )

    return dataclasses.replace(
        stage,
        init=init,
        loss=loss,
        prepare=prepare if stage.prepare is not None else None,
        require=require,
        rules=(*rules, (r".*", FREEZE)),
        rates=(
            *((rf"{ROOT}/(?:{rule})/[ab]", factor) for rule, factor in stage.rates),
            *stage.rates,
        ),
        stored=tuple(leaves),
    )


def shapes_of(model: Task, stage: Stage) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a stage's parameters by path."""
    # No key is made: that would start JAX's devices, of which a plan sets the number.
    key = jax.eval_shape(jax.random.key, jax.ShapeDtypeStruct((), "uint32"))
    found = jax.eval_shape(functools.partial(stage.init, model), key)
    return {path: tuple(leaf.shape) for path, leaf in tree.flatten(found).items()}


def matches(patterns: Sequence[str], path: str) -> bool:
    """Tell whether one of the patterns matches a whole path."""
    return any(re.fullmatch(pattern, path) for pattern in patterns)


def _init(shapes: dict[str, tuple[int, ...]], rank: int, key: Array) -> Params:
    """Return adapters: A normal with variance 1 / inputs, B zero."""
    leaves: dict[str, Array] = {}
    for path, shape in shapes.items():
        stacked = is_stacked(path)
        inputs = int(np.prod(shape[stacked:-1]))
        own = jax.random.fold_in(key, zlib.crc32(path.encode()))
        a = jax.random.normal(own, (*shape[:-1], rank)) / np.sqrt(inputs)
        leaves[f"{ROOT}/{path}/a"] = a
        leaves[f"{ROOT}/{path}/b"] = jnp.zeros((*shape[:stacked], rank, shape[-1]))
    return tree.unflatten(leaves)


def stored(stage: Stage, params: Params) -> Params:
    """Return the parameters that checkpoints of a stage hold."""
    if not stage.stored:
        return params
    kept = set(stage.stored)
    return tree.unflatten({path: x for path, x in tree.flatten(params).items() if path in kept})


def overlay(base: Params, params: Params) -> Params:
    """Return start weights with the adapters and parameters that an earlier stage trained."""
    return tree.unflatten(tree.flatten(base) | tree.flatten(params))


def complete(stage: Stage, params: Params, start: Params) -> Params:
    """Return all parameters of a stage: those in a checkpoint, and the others of the start."""
    if not stage.stored:
        return params
    kept = set(stage.stored)
    rest = {path: x for path, x in tree.flatten(start).items() if path not in kept}
    return tree.merge(tree.unflatten(rest), params)


def bind(model: Task, lora: LoRAConfig, params: Params) -> Params:
    """Return a model's parameters with adapters in their places, to be passed to its functions.

    Those without adapters are returned unchanged.
    """
    if ROOT not in params:
        return params
    leaves = tree.flatten({name: part for name, part in params.items() if name != ROOT})
    for path, a, b in adapters_of(params):
        weight = LowRank(leaves[path], a, b, lora.scale)
        leaves[path] = weight if takes_deferred(model, path) else weight.unbox()
    return tree.unflatten(leaves)


def adapters_of(params: Params) -> Iterator[tuple[str, Array, Array]]:
    """Yield (path, A, B) of each adapter."""
    flat = tree.flatten(params.get(ROOT, {}))
    for name, b in flat.items():
        if name.endswith("/b"):
            path = name.removesuffix("/b")
            yield path, flat[f"{path}/a"], b


def takes_deferred(model: Any, path: str) -> bool:
    """Tell whether the network that uses a parameter takes a ``Deferred`` weight there."""
    if path.startswith(OF_DRAFT):
        model, path = model.draft.of(model), path.removeprefix(OF_DRAFT)
    part, parts = path.split("/", maxsplit=1)[0], [model]
    owners = {
        "backbone": ("backbone",),
        "image": ("backbone",),
        "control": ("control",),
        "codec": ("codec",),
        "memory": ("memory", "reader"),
        "encoder": ("memory", "encoder"),
    }
    for name in owners.get(part, ()):
        if hasattr(parts[-1], name):
            parts.append(getattr(parts[-1], name))
    return path.endswith("/kernel") and all(map(is_of_this_package, parts))


def merge(base: Params, params: Params, lora: LoRAConfig, dtype: Any = None) -> Params:
    """Return start weights with adapters, and parameters trained themselves, in NumPy arrays.

    A sum is in the precision of its start weight, or in ``dtype``, the model's, if that is wider.

    Raises:
        TreeError: an adapter fits no start weight.
    """
    leaves = tree.flatten(base)
    own = {name: part for name, part in params.items() if name != ROOT}
    leaves |= tree.flatten(own)
    for path, a, b in adapters_of(params):
        if path not in leaves or leaves[path].shape[:-1] != a.shape[:-1]:
            raise tree.TreeError(f"The adapter of {path} does not fit the start weights.")
        stored = leaves[path].dtype
        wide = np.dtype(jnp.promote_types(stored, dtype or stored))
        leaves[path] = _sum(leaves[path], np.asarray(a), np.asarray(b), lora.scale, wide)
    return tree.unflatten(leaves)


def _sum(base: Any, a: np.ndarray, b: np.ndarray, scale: float, dtype: np.dtype) -> np.ndarray:
    """Return ``LowRank`` on the host, layer by layer if they are stacked."""
    if b.ndim == 3:
        layers = zip(base, a, b, strict=True)
        return np.stack([_sum(*layer, scale, dtype) for layer in layers])
    delta = a.astype(np.float32) @ b.astype(np.float32)
    whole = np.asarray(base)
    return (whole.astype(np.float32) + np.float32(scale) * delta).astype(dtype)


def base_hash(folder: Path) -> str:
    """Return the hash of start weights: of their file's header, which has one for each tensor.

    Raises:
        UserError: the folder has no finished weights.
    """
    path = folder / _WEIGHTS
    if not path.is_file():
        raise UserError(
            f"{folder} has no {_WEIGHTS}, to which adapters could refer: finish its training, or "
            "name the folder of a finished run or of converted weights."
        )
    return tensor_files.metadata(path).get("header_sha256") or file_hash(path)


def reference(config: Config) -> dict[str, str]:
    """Return the metadata by which a file of adapters names its start weights; {} without LoRA."""
    if not config.train.lora.rank:
        return {}
    return {BASE: config.train.start, BASE_HASH: base_hash(shipped.find(config.train.start))}


def require_base(config: Config) -> None:
    """Refuse to train adapters of weights that are absent.

    Raises:
        UserError: ``train.start`` is empty, or has no finished weights.
    """
    if not config.train.lora.rank:
        return
    if not config.train.start:
        raise UserError(
            "train.lora.rank is set and train.start is empty: adapters need trained weights; name "
            "their folder by --train.start, or set train.lora.rank 0."
        )
    base_hash(shipped.find(config.train.start))


def with_new_parameters(
    config: Config, stages: Sequence[Stage], start: Params, log: Callable[[str], None]
) -> Config:
    """Return the settings with the parameters that the start weights lack in ``lora.full``.

    ``stages`` are those with steps, without adapters. Only parameters that ``train.fresh`` allows
    to be absent are added, as whole branches (``memory/.*``) if all of a branch is absent.
    """
    lora, there = config.train.lora, tree.flatten(start).keys()
    more: set[str] = set()
    for stage in stages:
        paths = shapes_of(config.model, stage)
        for name in paths:
            if name in there or not matches(stage.trained, name):
                continue
            if matches(lora.full, name) or not matches(config.train.fresh, name):
                continue
            top = name.split("/")[0]
            whole = not any(other.startswith(f"{top}/") for other in there)
            more.add(rf"{top}/.*" if whole else re.escape(name))
    if not more:
        return config
    log(f"{config.train.start} lacks {tree.listing(more)}: trained in full, besides the adapters")
    full = dataclasses.replace(lora, full=(*lora.full, *sorted(more)))
    return dataclasses.replace(config, train=dataclasses.replace(config.train, lora=full))


def require_whole(folder: Path) -> None:
    """Refuse a folder of adapters where whole weights are read.

    Raises:
        UserError: it holds adapters alone.
    """
    path = folder / _WEIGHTS
    if path.is_file() and BASE_HASH in weights.metadata(path):
        raise UserError(
            f"{folder} holds adapters alone: merge them by `pewm-jax convert merge {folder} DST` "
            "first."
        )


def find_base(folder: Path, facts: dict[str, str]) -> Path:
    """Return the folder of the start weights of the adapters in a folder.

    It is the one that the metadata name, or one of the same name beside the folder.

    Raises:
        UserError: there is none, or its weights are others.
    """
    named = facts.get(BASE, "")
    places = [shipped.find(named), folder.resolve().parent / Path(named).name]
    found = [place for place in places if (place / _WEIGHTS).is_file()]
    for place in found:
        if base_hash(place) == facts.get(BASE_HASH):
            return place
    if found:
        raise UserError(
            f"{folder} holds adapters of other weights than those in {found[0]}: restore the "
            "weights that they were trained on."
        )
    raise UserError(
        f"{folder} holds adapters alone, and the weights that they adapt, {named}, are not there: "
        f"restore that folder, or put it beside {folder}."
    )
