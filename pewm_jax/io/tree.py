"""Strict selection of leaves in parameter trees, by regular expressions over their paths.

A leaf's path is its keys joined by slashes: ``{"memory": {"gate": x}}`` contains ``memory/gate``. A
pattern must match a whole path (``re.fullmatch``). Trained parameters, weight decay, sharding and
conversion are all selected this way. A leaf that no pattern matches, or a pattern that matches no
leaf, is an error that lists them.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.types import Params

T = TypeVar("T")
_LISTED = 8


class TreeError(UserError):
    """Paths and patterns, or two trees, do not match; the message lists the differences."""


def flatten(tree: Any) -> dict[str, Any]:
    """Convert any pytree to ``{path: leaf}``, in the tree's order."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {_path(keys): leaf for keys, leaf in leaves}


def unflatten(leaves: Mapping[str, Any]) -> Params:
    """Convert ``{path: leaf}`` to nested dictionaries; TreeError if a leaf has leaves."""
    tree: Params = {}
    for path, leaf in leaves.items():
        *branch, name = path.split("/")
        node = tree
        for key in branch:
            node = node.setdefault(key, {})
            if not isinstance(node, dict):
                raise TreeError(f"{path} has the prefix {key}, which is a leaf and not a branch.")
        if name in node:
            raise TreeError(f"{path} is both a leaf and a branch.")
        node[name] = leaf
    return tree


def assign(rules: Sequence[tuple[str, T]], tree: Any, what: str = "rules") -> Any:
    """Replace every leaf of a pytree by the value of the first rule whose pattern matches its path.

    Example::

        assign(((r".*/kernel", True), (r".*/bias", False)), params)  # a weight-decay mask

    Raises:
        TreeError: no rule matches some leaves; the message names the rules by ``what``.
    """
    compiled = [(re.compile(pattern), value) for pattern, value in rules]
    unmatched: list[str] = []

    def choose(keys: Any, _leaf: Any) -> Any:
        path = _path(keys)
        for pattern, value in compiled:
            if pattern.fullmatch(path):
                return value
        unmatched.append(path)
        return None

    out = jax.tree_util.tree_map_with_path(choose, tree)
    if unmatched:
        raise TreeError(f"No rule of the {what} matches {listing(unmatched)}; add one.")
    return out


def split(tree: Params, patterns: Sequence[str]) -> tuple[Params, Params]:
    """Split nested dictionaries into the leaves that patterns match and the others.

    Both halves keep their paths; ``merge`` joins them again.

    Raises:
        TreeError: a pattern matches no leaf.
    """
    leaves = flatten(tree)
    chosen: set[str] = set()
    for pattern in patterns:
        found = {path for path in leaves if re.fullmatch(pattern, path)}
        if not found:
            raise TreeError(f"The pattern {pattern!r} matches none of {listing(leaves)}.")
        chosen |= found
    inside = {path: leaf for path, leaf in leaves.items() if path in chosen}
    outside = {path: leaf for path, leaf in leaves.items() if path not in chosen}
    return unflatten(inside), unflatten(outside)


def select(tree: Params, patterns: Sequence[str]) -> Params:
    """Keep the leaves that a pattern matches; see ``split``."""
    return split(tree, patterns)[0]


def exclude(tree: Params, patterns: Sequence[str]) -> Params:
    """Drop the leaves that a pattern matches; see ``split``."""
    return split(tree, patterns)[1]


def merge(*trees: Params) -> Params:
    """Join nested dictionaries; TreeError if they share a leaf. The inverse of ``split``."""
    leaves: dict[str, Any] = {}
    for tree in trees:
        more = flatten(tree)
        twice = leaves.keys() & more.keys()
        if twice:
            raise TreeError(f"Trees to merge both contain {listing(twice)}.")
        leaves |= more
    return unflatten(leaves)


def mismatches(tree: Any, like: Any) -> list[str]:
    """Return the differences between two trees in paths and shapes, as phrases."""
    have, want = flatten(tree), flatten(like)
    out = [f"{path} is missing" for path in want if path not in have]
    out += [f"{path} is unexpected" for path in have if path not in want]
    for path in want.keys() & have.keys():
        shape, expected = np.shape(have[path]), np.shape(want[path])
        if shape != expected:
            out.append(f"{path} has shape {shape} instead of {expected}")
    return sorted(out)


def require_like(tree: Any, like: Any, what: str) -> None:
    """Raise TreeError if two trees differ in paths or shapes.

    It names ``what`` and the differences.
    """
    wrong = mismatches(tree, like)
    if wrong:
        raise TreeError(f"{what} does not fit this configuration: {listing(wrong)}.")


def digest(tree: Any) -> str:
    """Return a hash of paths, shapes and values, cast to float32, so independent of dtype."""
    found = hashlib.sha256()
    for path, leaf in sorted(flatten(tree).items()):
        values = np.ascontiguousarray(jax.device_get(leaf), np.float32)
        found.update(f"{path} {values.shape}".encode())
        found.update(values.data)
    return found.hexdigest()


def listing(items: Iterable[str], most: int = _LISTED) -> str:
    """Join up to ``most`` items for a message, and append the number of the others."""
    items = sorted(items)
    more = len(items) - most
    return ", ".join(items[:most]) + (f" and {more} more" if more > 0 else "")


def _path(keys: Any) -> str:
    return jax.tree_util.keystr(keys, simple=True, separator="/")
