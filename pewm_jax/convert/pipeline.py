"""Conversion pipeline: read, map names by the family's table, change layouts, check, write.

A family's table of names is a ``Network`` in ``models/<family>/convert.py``. ``read`` converts a
published network to our parameter tree and ``write`` converts it back, tensor by tensor and
strictly: every tensor must exist, have the right shape and be used. Names and shapes are checked
from the table and the abstract tree before any weight is read, so errors are found early.
``write_world`` writes a world model's folder tensor by tensor while they are read, so that one
tensor is in memory at a time. Folders are written atomically (``new_folder``).
"""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.io import atomic, sources, tensor_files, tree
from pewm_jax.io.progress import Meter
from pewm_jax.io.published import Entry, Network
from pewm_jax.io.sources import Source, renamed
from pewm_jax.types import Array, Params

WEIGHTS = "weights.safetensors"
CONFIG = "config.json"
FLOATS = ("float32", "bfloat16", "float16")
"""Target dtypes of weights, by name."""
STORED = (*FLOATS, "float64")
"""Supported dtypes of stored weights; a table computed by a network can be float64."""
_MEGABYTE = 1 << 20
_CAST = _MEGABYTE
"""Bytes of a tensor that are converted to another dtype at once."""
Specs = dict[str, jax.ShapeDtypeStruct]
"""Shape and dtype of every leaf, by path."""
Blocks = Iterable[tuple[str, Array]]
"""Leaves by path, each whole or in consecutive blocks (``tensor_files.write``)."""
Part = tuple[Specs, Callable[[], Blocks]]
"""The abstract parameters of a part, and the function that reads or creates them."""

_LISTED = 200
"""Largest number of names listed in a message; it is large, because the author of a file needs all
of them."""


def refuse_existing(dst: Path) -> None:
    """Raise an error if a path exists.

    Raises:
        UserError: ``dst`` exists.
    """
    if dst.exists() or dst.is_symlink():
        raise UserError(f"{dst} exists already; choose a new folder or remove that one.")


@contextlib.contextmanager
def new_folder(dst: Path) -> Iterator[Path]:
    """Write a folder under a temporary name and rename it when it is complete.

    If writing fails, no folder is left.

    Raises:
        UserError: ``dst`` exists.
    """
    refuse_existing(dst)
    with atomic.replacing(dst) as partial:
        partial.mkdir(parents=True)
        yield partial


@contextlib.contextmanager
def megabytes(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show progress in megabytes of ``total`` bytes; yields a function that adds finished bytes."""
    done = 0
    with Meter(label, -(-total // _MEGABYTE), "MiB") as meter:

        def advance(count: int) -> None:
            nonlocal done
            before, done = done, done + count
            if whole := done // _MEGABYTE - before // _MEGABYTE:
                meter.advance(whole)

        yield advance


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON table as diffusers does: sorted keys."""
    path.write_text(json.dumps(values, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def read(network: Network, folder: str | Path, dtype: str | None = None) -> tuple[Any, Params]:
    """Read a published network from a pipeline's folder, or from the network's folder in it.

    Args:
        dtype: dtype of the parameters, ``float32``, ``bfloat16`` or ``float16``; by default the
            stored one.

    Returns:
        ``(config, params)``, NumPy arrays.

    Raises:
        UserError: a tensor is missing, unexpected or of another shape, a file is damaged, or a
            class or setting is unknown.
    """
    config, source, total = _open(network, Path(folder))
    with megabytes(f"read {network.folder}", total) as progress:
        like = network.like(config)
        return config, read_tensors(network.entries(config), source, like, dtype, progress)


def read_config(network: Network, folder: str | Path) -> Any:
    """Read the settings of a published network; see ``read``."""
    path = sources.component(Path(folder), network.folder) / CONFIG
    return network.config(published_config(network, Path(folder)), str(path))


def published_config(network: Network, folder: Path) -> dict[str, Any]:
    """Read the settings of a network in their published form, and check its class."""
    path = sources.component(folder, network.folder) / CONFIG
    return sources.read_config(path, [network.class_name], network.class_key)


def specs(network: Network, folder: Path, dtype: str | None = None) -> Specs:
    """Return shape and dtype of every leaf that ``read`` will return, by path; check the files."""
    config, source, _ = _open(network, folder)
    entries, like = network.entries(config), network.like(config)
    require(entries, source, like)
    return leaf_specs(entries, source, like, dtype)


def part(network: Network, folder: Path, dtype: str | None = None) -> Part:
    """Return a published network as a part of a world model, read while it is written."""
    return specs(network, folder, dtype), lambda: stream(network, folder, dtype)


def made(like: Params, make: Callable[[], Params], dtype: str | None = None) -> Part:
    """Return parameters that are created when they are written as a part; ``like`` are shapes."""
    return cast_specs(like, dtype), lambda: tree.flatten(make()).items()


def stream(
    network: Network,
    folder: Path,
    dtype: str | None = None,
    wanted: Callable[[str], bool] = lambda _: True,
) -> Blocks:
    """Yield the leaves of a published network in blocks, read one published tensor at a time.

    Args:
        dtype: as for ``read``.
        wanted: returns, by path, whether to read a leaf.

    Raises:
        UserError: as ``read``.
    """
    config, source, _ = _open(network, folder)
    entries, like = network.entries(config), network.like(config)
    require(entries, source, like)
    announced = leaf_specs(entries, source, like, dtype)
    for entry in sorted(entries, key=lambda entry: (entry.path, entry.layer or 0)):
        if wanted(entry.path):
            where, leaf = f"{source.where}: {entry.name}", announced[entry.path]
            tensor = entry.transform.read(source.read(entry.name))
            tensor = tensor if entry.layer is None or leaf.shape[0] > 1 else tensor[None]
            for block in _cast_blocks(tensor, leaf.dtype, where):
                yield entry.path, block
            del tensor  # free memory before the next one is read


def _cast_blocks(tensor: np.ndarray, dtype: np.dtype, where: str) -> Iterator[np.ndarray]:
    """Yield a tensor in another dtype: unchanged if it has it, else in blocks of rows."""
    if tensor.dtype == dtype:
        yield tensor
        return
    tensor = np.atleast_1d(tensor)
    rows = max(1, len(tensor) * _CAST // max(tensor.nbytes, 1))
    for row in range(0, len(tensor), rows):
        block = np.empty(tensor[row : row + rows].shape, dtype)
        _cast(tensor[row : row + rows], block, where)
        yield block


def write(
    network: Network, config: Any, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write a network in the format of the library that published it; the inverse of ``read``.

    Settings that only change how the network is computed are not written. By default tensors have
    the dtype of the parameters.

    Raises:
        UserError: the folder exists.
    """
    values = network.write_config(config)
    with new_folder(Path(folder)) as whole:
        write_published(network, values, params, whole, dtype)


def write_published(
    network: Network,
    values: dict[str, Any],
    params: Params,
    folder: Path,
    dtype: str | None = None,
) -> None:
    """Write settings in their published form, ``values``, and weights into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / CONFIG, values)
    entries = network.entries(network.config(values, "base.json"))
    announced = published_specs(entries, params, dtype)
    tensors = write_tensors(entries, params, dtype)
    path = folder / network.weights_file
    with megabytes(f"write {network.folder}", tensor_files.size(announced)) as progress:
        tensor_files.write(path, announced, tensors, {"format": "pt"}, progress)


def _open(network: Network, folder: Path) -> tuple[Any, Source, int]:
    """Return a network's settings, the tensors that it uses, and their bytes; reads no weights."""
    config = read_config(network, folder)
    files = sources.open_folder(sources.component(folder, network.folder))
    used = {name: (name, 0, 1) for name in files.names() if name not in network.unused}
    return config, renamed(files, used), tensor_files.size(files.tensors)


def expected(entries: Sequence[Entry], like: Params) -> dict[str, tuple[int, ...]]:
    """Return the published names and shapes of the entries, without allocating memory.

    ``like`` is our tree, abstract (``jax.eval_shape``) or not.

    Raises:
        ValueError: the table and the tree do not fit: a leaf (or a layer of one) without an
            entry, or an entry without a leaf.
    """
    leaves = tree.flatten(like)
    layers: dict[str, list[int | None]] = defaultdict(list)
    shapes: dict[str, tuple[int, ...]] = {}
    for entry in entries:
        if entry.path not in leaves or entry.name in shapes:
            raise ValueError(f"the entry of {entry.name} leads to {entry.path}: missing or twice")
        layers[entry.path].append(entry.layer)
        shape = tuple(leaves[entry.path].shape)
        inner = shape if entry.layer is None else shape[1:]
        shapes[entry.name] = np.shape(entry.transform.write(np.broadcast_to(np.int8(0), inner)))
    for path, leaf in leaves.items():
        filled = layers[path]
        whole = filled == [None] or sorted(x for x in filled if x is not None) == list(
            range(leaf.shape[0] if leaf.ndim else 0)
        )
        if not filled or not whole:
            raise ValueError(f"{path} is not covered by the entries (layers {filled})")
    return shapes


def require(entries: Sequence[Entry], source: Source, like: Params) -> None:
    """Check that a source contains exactly the tensors of the entries, with the right shapes.

    Raises:
        UserError: tensors are missing, unexpected or of another shape; lists them.
    """
    want = expected(entries, like)
    have = set(source.names())
    missing, unused = want.keys() - have, have - want.keys()
    if missing or unused:
        parts = [f"lacks {len(missing)} tensors ({tree.listing(missing, _LISTED)})"] * bool(missing)
        parts += [f"has {len(unused)} unexpected tensors ({tree.listing(unused, _LISTED)})"] * bool(
            unused
        )
        raise UserError(
            f"{source.where} does not fit its config.json: it {' and '.join(parts)}; are both from "
            "the same network?"
        )
    wrong = [
        f"{name} {source.shape(name)} instead of {shape}"
        for name, shape in want.items()
        if source.shape(name) != shape
    ]
    if wrong:
        raise UserError(
            f"{source.where} contains tensors of other shapes than its config.json says: "
            f"{tree.listing(wrong)}; are both from the same network?"
        )
    other = [f"{n} {source.dtype(n)}" for n in want if source.dtype(n).name not in STORED]
    if other:
        raise UserError(
            f"{source.where} contains {tree.listing(other)}: weights of {', '.join(STORED)} are "
            "supported; save it in one of these."
        )


def read_tensors(
    entries: Sequence[Entry],
    source: Source,
    like: Params,
    dtype: str | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> Params:
    """Read published tensors into our tree, one by one into leaves allocated beforehand.

    Memory: the tree, and one tensor.

    Args:
        like: our tree, abstract (``jax.eval_shape``) or not: paths and shapes.
        dtype: dtype of the result, one of ``FLOATS``; by default the stored one (for several in one
            leaf, their common dtype).
        progress: called after every tensor with the number of bytes read.

    Raises:
        UserError: names or shapes do not fit, a damaged file, or a value too large for float16.
    """
    require(entries, source, like)
    announced = leaf_specs(entries, source, like, dtype)
    leaves = {path: np.empty(spec.shape, spec.dtype) for path, spec in announced.items()}
    for entry in entries:
        tensor = source.read(entry.name)
        place = leaves[entry.path] if entry.layer is None else leaves[entry.path][entry.layer]
        _cast(entry.transform.read(tensor), place, f"{source.where}: {entry.name}")
        progress(tensor.nbytes)
        del tensor  # free memory before the next one is read
    return tree.unflatten(leaves)


def leaf_specs(
    entries: Sequence[Entry], source: Source, like: Params, dtype: str | None = None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shape and dtype of every leaf that ``read_tensors`` will return, by path."""
    stored: dict[str, set[np.dtype]] = defaultdict(set)
    for entry in entries:
        stored[entry.path].add(source.dtype(entry.name))
    target = None if dtype is None else _dtype(dtype)
    return {
        path: jax.ShapeDtypeStruct(leaf.shape, target or _common(stored[path]))
        for path, leaf in tree.flatten(like).items()
    }


def write_tensors(
    entries: Sequence[Entry], params: Params, dtype: str | None = None
) -> Iterator[tuple[str, Array]]:
    """Yield the published tensors of our tree, one by one: the inverse of ``read_tensors``.

    By default tensors have the dtype of the leaves.

    Raises:
        UserError: a value too large for float16.
        ValueError: the tree and the table do not fit.
    """
    expected(entries, params)
    leaves = tree.flatten(params)
    for entry in entries:
        leaf = leaves[entry.path]
        tensor = np.asarray(jax.device_get(leaf if entry.layer is None else leaf[entry.layer]))
        if dtype is not None and tensor.dtype != _dtype(dtype):
            out = np.empty(tensor.shape, _dtype(dtype))
            _cast(tensor, out, entry.path)
            tensor = out
        yield entry.name, np.ascontiguousarray(entry.transform.write(tensor))


def published_specs(
    entries: Sequence[Entry], params: Params, dtype: str | None = None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the names, shapes and dtypes of what ``write_tensors`` will yield."""
    shapes, leaves = expected(entries, params), tree.flatten(params)
    return {
        entry.name: jax.ShapeDtypeStruct(
            shapes[entry.name], leaves[entry.path].dtype if dtype is None else _dtype(dtype)
        )
        for entry in entries
    }


def _common(dtypes: set[np.dtype]) -> np.dtype:
    """Return the common dtype."""
    if len(dtypes) == 1:
        return next(iter(dtypes))
    return max(np.dtype(np.float32), *dtypes, key=lambda dtype: dtype.itemsize)


def _dtype(name: str) -> np.dtype:
    if name not in FLOATS:
        raise UserError(f"There is no dtype {name!r} for weights; choose from {', '.join(FLOATS)}.")
    return np.dtype(jax.numpy.dtype(name))


def _cast(tensor: np.ndarray, out: np.ndarray, where: str) -> None:
    """Write a tensor into ``out`` in out's dtype; raise an error on overflow of float16."""
    narrow = out.dtype == np.float16 and tensor.dtype != np.float16
    with np.errstate(over="ignore") if narrow else contextlib.nullcontext():
        out[...] = tensor
    if narrow and not np.isfinite(out).all():
        raise UserError(
            f"{where} contains values beyond float16's 65504; use --dtype bfloat16 or float32."
        )


def write_world(
    dst: Path,
    config: Config,
    parts: Mapping[str, Part],
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write a world model's ``config.json`` and ``weights.safetensors``, atomically.

    ``parts`` are by their names in a world model, ``more`` are further JSON files by name.

    Raises:
        UserError: ``dst`` exists.
    """
    specs = {f"{part}/{p}": spec for part, (like, _) in parts.items() for p, spec in like.items()}

    def tensors() -> Iterator[tuple[str, Array]]:
        for part, (_, make) in parts.items():
            for path, block in make():
                whole = f"{part}/{path}"
                yield whole, np.asarray(block).astype(specs[whole].dtype, copy=False)

    with new_folder(dst) as folder:
        header = tensor_files.header({"stage": "0"})
        with megabytes(f"write {dst.name}", tensor_files.size(specs)) as progress:
            tensor_files.write(folder / WEIGHTS, specs, tensors(), header, progress)
        configuration.save(config, folder / CONFIG)
        for name, values in (more or {}).items():
            write_json(folder / name, values)


def fresh_actions(config: Config, dtype: str | None) -> Part:
    """Return new layers for the control's actions, which have no effect until they are trained."""

    def make() -> Params:
        return jax.jit(config.model.control.init, static_argnums=0)(config.model, jax.random.key(0))

    return made(jax.eval_shape(make), make, dtype)


def cast_specs(params: Params, dtype: str | None) -> Specs:
    """Return abstract parameters in another dtype, by default float32."""
    new = np.dtype(jax.numpy.dtype(dtype or "float32"))
    flat = tree.flatten(params)
    return {path: jax.ShapeDtypeStruct(leaf.shape, new) for path, leaf in flat.items()}
