"""Parameters of worlds whose ``init`` returns another pytree than nested dictionaries.

Training, files and sharding name a parameter by its path in nested dictionaries. A world's ``init``
may return lists, tuples or dataclasses; its methods get that form again. The worlds of this package
return nested dictionaries.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax

from pewm_jax.config import Task
from pewm_jax.io import tree
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.stages import Stage

Form = tuple[Any, tuple[str, ...]]
"""The structure of parameters, and their paths in its order."""


def in_world_form(model: Task, params: Params) -> Any:
    """Return parameters in the form that the world's ``init``, or a stage's, returns them."""
    for structure, paths in _forms(model):
        leaves = tree.flatten(params)
        if leaves.keys() == set(paths):
            return jax.tree.unflatten(structure, [leaves[path] for path in paths])
    return params


def with_dictionaries(model: Task, stage: Stage) -> Stage:
    """Return a stage whose parameters are nested dictionaries."""
    return stage if _of_this_package(model) else _with_dictionaries(model, stage)


def _of_this_package(model: Task) -> bool:
    """Tell whether no ``init`` has to be traced to know the form."""
    return type(model).__module__.startswith("pewm_jax.")


@functools.lru_cache(maxsize=256)
def _with_dictionaries(model: Task, stage: Stage) -> Stage:
    form = _form(model, stage.init)
    if form is None:
        return stage
    prepare = stage.prepare

    def init(model: Task, key: Array) -> Params:
        return tree.unflatten(tree.flatten(stage.init(model, key)))

    def loss(model: Task, train: Any, params: Params, clip: Clip, key: Array) -> Any:
        return stage.loss(model, train, _in_form(form, params), clip, key)

    def prepared(model: Task, params: Params, clip: Clip) -> Clip:
        assert prepare is not None
        return prepare(model, _in_form(form, params), clip)

    changed = dataclasses.replace(stage, init=init, loss=loss)
    return changed if prepare is None else dataclasses.replace(changed, prepare=prepared)


@functools.lru_cache(maxsize=64)
def _forms(model: Task) -> tuple[Form, ...]:
    """Return the forms of all stages and of the world that are not nested dictionaries."""
    if _of_this_package(model):
        return ()
    kind = type(model)
    makers = [*(stage.init for stage in kind.stages(model)), kind.init]
    found = [_form(model, make) for make in makers]
    return tuple(form for form in found if form is not None)


def _form(model: Task, init: Any) -> Form | None:
    # No key is made: that would start JAX's devices, of which a plan sets the number.
    key = jax.eval_shape(jax.random.key, jax.ShapeDtypeStruct((), "uint32"))
    shapes = jax.eval_shape(functools.partial(init, model), key)
    leaves = tree.flatten(shapes)
    structure = jax.tree.structure(shapes)
    if structure == jax.tree.structure(tree.unflatten(leaves)):
        return None
    return structure, tuple(leaves)


def _in_form(form: Form, params: Params) -> Any:
    structure, paths = form
    leaves = tree.flatten(params)
    return jax.tree.unflatten(structure, [leaves[path] for path in paths])
