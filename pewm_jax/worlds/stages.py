"""Training stages: trained parameters, loss and order; and the form of a world's parameters.

Each world lists its stages. A stage has a loss, and rules over parameter paths that select trained
and frozen parameters. Its settings (steps, batch, learning rate) are in ``train``, under its name.

Training, files and sharding name a parameter by its path in nested dictionaries. A world's ``init``
may return lists, tuples or dataclasses; its methods get that form again (``in_world_form``). The
worlds of this package return nested dictionaries.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any

import jax

from pewm_jax.config import Config, StageConfig, Task, UserError
from pewm_jax.io import tree
from pewm_jax.types import Array, Clip, Params

TRAIN, FREEZE, ADVERSARY = "train", "freeze", "adversary"
"""What a stage does with a parameter: it trains it, keeps it, or trains it as the part of a
discriminator, which has an optimizer of its own and serves training alone."""

Loss = Callable[..., tuple[Array, dict[str, Array]]]
"""``loss(model, train, params, clip, key) -> (loss, measured)``: the loss of a batch of clips with
the settings of the model and of training, and scalars to log."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of training; static and hashable.

    Attributes:
        name: names its settings (``train.NAME``), folders and log entries.
        number: its place among the world's stages, from 1; seeds its weights, noise and data order.
        rules: (pattern, ``TRAIN``, ``FREEZE`` or ``ADVERSARY``) over parameter paths, the first
            match wins (see ``pewm_jax.io.tree``); a leaf that no rule matches is an error.
        init: ``init(model, key) -> params``, all the parameters that the stage needs.
        loss: the function to minimise.
        memory: whether it reads the clips' context, and so may use cached image features.
        prepare: ``prepare(model, params, clip) -> clip``: computes beforehand the parts of the loss
            that depend on frozen weights alone, and drops arrays that are then unused; the loss is
            the same.
        prepares_by: the top-level parameters that ``prepare`` reads. Further names only keep
            prepared clips on disk apart from those of other stages.
        extra_weights: ``extra_weights(model, train) -> params`` or None: weights that the loss
            needs and that are not part of the model, under top-level names of their own. They are
            read when training starts, placed on every device, never trained and never saved.
        optional: whether it is skipped if its settings give it no steps.
        require: ``require(model)`` refuses a model without the parameters that the stage trains,
            before any stage is trained.
        rates: (pattern, factor) over the paths of trained parameters, the first match wins: the
            learning rate there is the stage's times the factor; elsewhere it is the stage's.
        stored: paths of the parameters that checkpoints hold; empty for all. The others are those
            of ``train.start``, and are not trained.
    """

    name: str
    number: int
    rules: tuple[tuple[str, str], ...]
    init: Callable[[Any, Array], Params]
    loss: Loss
    memory: bool = False
    prepare: Callable[[Any, Params, Clip], Clip] | None = None
    prepares_by: tuple[str, ...] = ("codec", "encoder")
    extra_weights: Callable[[Any, Any], Params | None] | None = None
    optional: bool = False
    require: Callable[[Any], None] | None = None
    rates: tuple[tuple[str, float], ...] = ()
    stored: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The name for people to read: "stage 1" for ``stage1``."""
        return re.sub(r"(?<=[a-z])(?=[0-9])|_", " ", self.name)

    @property
    def trained(self) -> tuple[str, ...]:
        """The path patterns of the trained parameters."""
        return tuple(pattern for pattern, label in self.rules if label in (TRAIN, ADVERSARY))

    @property
    def averaged(self) -> tuple[str, ...]:
        """The path patterns of the trained parameters whose moving average is published."""
        return tuple(pattern for pattern, label in self.rules if label == TRAIN)

    @property
    def training_only(self) -> tuple[str, ...]:
        """The path patterns of trained parameters that are in checkpoints, but in no weights."""
        return tuple(pattern for pattern, label in self.rules if label == ADVERSARY)

    def published(self, params: Params) -> Params:
        """Return parameters without those that serve training alone."""
        return tree.exclude(params, self.training_only) if self.training_only else params

    def labels(self, params: Any) -> Any:
        """Return a tree of the rules' labels, one per parameter, for the optimizer.

        Raises:
            TreeError: leaves that no rule matches.
        """
        return tree.assign(self.rules, params, f"rules of {self.name}")

    def settings(self, config: Config) -> StageConfig:
        """Return this stage's settings.

        Raises:
            UserError: the world's ``TRAIN`` has no field of the stage's name.
        """
        found = getattr(config.train, self.name, None)
        if not isinstance(found, StageConfig):
            kind = type(config.train).__name__
            raise UserError(
                f"The stage {self.name!r} has no settings: {kind}, the TRAIN of "
                f"{type(config.model).__name__}, needs a field `{self.name}: StageConfig`."
            )
        return found

    def data_seed(self, config: Config) -> int:
        """Return the seed of this stage's data order."""
        return config.train.seed + self.number


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
    return stage if is_of_this_package(model) else _with_dictionaries(model, stage)


def is_of_this_package(settings: Any) -> bool:
    """Tell whether settings are of a class of this package, whose parameters have a known form."""
    return type(settings).__module__.startswith("pewm_jax.")


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
    if is_of_this_package(model):
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
