"""Foreign tensors ↔ our parameter tree, tensor by tensor and strictly.

What is expected is worked out from the converter's entries and the abstract tree alone, before
any weight is read: a wrong name or shape costs no time and no memory.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.convert.mapping import Entry
from pewm_jax.convert.sources import Source
from pewm_jax.io import tree
from pewm_jax.types import Array, Params

FLOATS = ("float32", "bfloat16", "float16")
"""The dtypes weights can be converted to, by name."""
STORED = (*FLOATS, "float64")
"""The dtypes weights may come in; a table that a network has computed can be float64."""

_LISTED = 200
"""Most names that a message lists: whoever wrote the file needs all of them."""


def expected(entries: Sequence[Entry], like: Params) -> dict[str, tuple[int, ...]]:
    """Return the foreign names and shapes that the entries ask for, nothing allocated.

    Args:
        entries: the converter's table.
        like: our tree, abstract (``jax.eval_shape``) or not.

    Raises:
        ValueError: the table and the tree do not fit: a leaf (or a layer of one) without an
            entry, or an entry without a leaf.
    """
    leaves = tree.flatten(like)
    layers: dict[str, list[int | None]] = defaultdict(list)
    shapes: dict[str, tuple[int, ...]] = {}
    for entry in entries:
        if entry.path not in leaves or entry.theirs in shapes:
            raise ValueError(f"the entry of {entry.theirs} leads to {entry.path}: none or twice")
        layers[entry.path].append(entry.layer)
        shape = tuple(leaves[entry.path].shape)
        inner = shape if entry.layer is None else shape[1:]
        shapes[entry.theirs] = np.shape(entry.turn.theirs(np.broadcast_to(np.int8(0), inner)))
    for path, leaf in leaves.items():
        filled = layers[path]
        whole = filled == [None] or sorted(x for x in filled if x is not None) == list(
            range(leaf.shape[0] if leaf.ndim else 0)
        )
        if not filled or not whole:
            raise ValueError(f"{path} is not filled by the entries (layers {filled})")
    return shapes


def require(entries: Sequence[Entry], source: Source, like: Params) -> None:
    """Insist that a source holds exactly the tensors that the entries name, of the right shapes.

    Raises:
        UserError: with the list of tensors that are missing, left over or of another shape.
    """
    want = expected(entries, like)
    have = set(source.names())
    missing, unused = want.keys() - have, have - want.keys()
    if missing or unused:
        parts = [f"lacks {len(missing)} tensors ({tree.listing(missing, _LISTED)})"] * bool(missing)
        parts += [f"has {len(unused)} tensors of no use ({tree.listing(unused, _LISTED)})"] * bool(
            unused
        )
        raise UserError(
            f"{source.where} does not fit its config.json: it {' and '.join(parts)}; are they of "
            "the same network?"
        )
    wrong = [
        f"{name} {source.shape(name)} instead of {shape}"
        for name, shape in want.items()
        if source.shape(name) != shape
    ]
    if wrong:
        raise UserError(
            f"{source.where} holds tensors of other shapes than its config.json says: "
            f"{tree.listing(wrong)}; are they of the same network?"
        )
    other = [f"{n} {source.dtype(n)}" for n in want if source.dtype(n).name not in STORED]
    if other:
        raise UserError(
            f"{source.where} holds {tree.listing(other)}: weights of {', '.join(STORED)} can be "
            "read; save it in one of these."
        )


def read(
    entries: Sequence[Entry],
    source: Source,
    like: Params,
    dtype: str | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> Params:
    """Read foreign tensors into our tree, one by one into leaves allocated beforehand.

    Memory: the tree, and one tensor.

    Args:
        entries: the converter's table.
        source: the foreign tensors.
        like: our tree, abstract (``jax.eval_shape``) or not: paths and shapes.
        dtype: of the result, one of ``FLOATS``; by default the stored one (of several in one
            leaf, the dtype that holds them all).
        progress: called after every tensor with the bytes just read.

    Returns:
        Nested dictionaries of NumPy arrays.

    Raises:
        UserError: names or shapes do not fit, a damaged file, or a value too large for float16.
    """
    require(entries, source, like)
    announced = leaf_specs(entries, source, like, dtype)
    leaves = {path: np.empty(spec.shape, spec.dtype) for path, spec in announced.items()}
    for entry in entries:
        tensor = source.read(entry.theirs)
        place = leaves[entry.path] if entry.layer is None else leaves[entry.path][entry.layer]
        _cast(entry.turn.ours(tensor), place, f"{source.where}: {entry.theirs}")
        progress(tensor.nbytes)
        del tensor  # before the next one is read
    return tree.unflatten(leaves)


def leaf_specs(
    entries: Sequence[Entry], source: Source, like: Params, dtype: str | None = None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shape and dtype of every leaf that ``read`` will give, by path."""
    stored: dict[str, set[np.dtype]] = defaultdict(set)
    for entry in entries:
        stored[entry.path].add(source.dtype(entry.theirs))
    target = None if dtype is None else _dtype(dtype)
    return {
        path: jax.ShapeDtypeStruct(leaf.shape, target or _common(stored[path]))
        for path, leaf in tree.flatten(like).items()
    }


def write(
    entries: Sequence[Entry], params: Params, dtype: str | None = None
) -> Iterator[tuple[str, Array]]:
    """Yield the foreign tensors of our tree, one by one: the inverse of ``read``.

    Args:
        entries: the converter's table.
        params: our tree, NumPy or JAX arrays.
        dtype: of the tensors; by default that of the leaves.

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
        yield entry.theirs, np.ascontiguousarray(entry.turn.theirs(tensor))


def specs(
    entries: Sequence[Entry], params: Params, dtype: str | None = None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the names, shapes and dtypes of what ``write`` will yield."""
    shapes, leaves = expected(entries, params), tree.flatten(params)
    return {
        entry.theirs: jax.ShapeDtypeStruct(
            shapes[entry.theirs], leaves[entry.path].dtype if dtype is None else _dtype(dtype)
        )
        for entry in entries
    }


def _common(dtypes: set[np.dtype]) -> np.dtype:
    """Return the dtype that holds values of all of them."""
    if len(dtypes) == 1:
        return next(iter(dtypes))
    return max(np.dtype(np.float32), *dtypes, key=lambda dtype: dtype.itemsize)


def _dtype(name: str) -> np.dtype:
    if name not in FLOATS:
        raise UserError(f"There is no dtype {name!r} for weights; there is {', '.join(FLOATS)}.")
    return np.dtype(jax.numpy.dtype(name))


def _cast(tensor: np.ndarray, out: np.ndarray, where: str) -> None:
    """Write a tensor into ``out`` in out's dtype, and refuse what float16 cannot hold."""
    narrow = out.dtype == np.float16 and tensor.dtype != np.float16
    with np.errstate(over="ignore") if narrow else contextlib.nullcontext():
        out[...] = tensor
    if narrow and not np.isfinite(out).all():
        raise UserError(
            f"{where} holds values beyond float16's 65504; use --dtype bfloat16 or float32."
        )
