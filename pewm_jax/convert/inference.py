"""A training run → a folder for inference: averaged weights in 16 bits, settings, and a card.

::

    DST/config.json           the run's settings
        weights.safetensors   every leaf of the run's weights, floats rounded to bfloat16, or to
                              float16 if that is asked for
        base.json             where the run has one: the checkpoint it was made from
        README.md             the card

``pewm_jax.load(DST)`` returns the leaves as they are stored, which halves the memory;
the networks compute in ``model.dtype`` all the same, because every layer casts its weights to it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import __version__
from pewm_jax import config as configuration
from pewm_jax import registry as kinds
from pewm_jax.config import Config, UserError
from pewm_jax.convert import card, output
from pewm_jax.eval.evaluate import METRICS
from pewm_jax.io import sources, tensor_files, tree, weights
from pewm_jax.io.store import file_hash
from pewm_jax.train import runs
from pewm_jax.types import Params
from pewm_jax.worlds import rollouts

CARD = "README.md"
REPORT = Path("report") / METRICS


def export(
    run: Path, dst: Path, dtype: str = "bfloat16", *, say: Callable[[str], Any] = print
) -> Path:
    """Write what inference needs of a training run into a new folder.

    The run's weights file already holds the moving average where the run trained and the frozen
    weights elsewhere. The folder is written aside and renamed when it is complete.

    Args:
        run: a run folder made by ``train.py`` (or a converted checkpoint in the same form).
        dst: the folder to make.
        dtype: ``bfloat16`` or ``float16``.
        say: called with a line on each step.

    Returns:
        ``dst``.

    Raises:
        UserError: ``dst`` exists; or the run is absent, damaged, a policy, or has no weights yet.
    """
    if not run.is_dir():
        raise UserError(f"{run} is not a folder; name a run made by train.py.")
    with output.new_folder(dst) as folder:
        say(f"reading {run} …")
        config, params = rollouts.load_finished(run)
        if not config.model.EXPORTED:
            raise UserError(
                f"{run} holds a {kinds.of(config.model).name}, of which no smaller form is written:"
                " its config.json and weights.safetensors are what pewm_jax.load reads, copy those."
            )
        origin = _base(run, config)
        metadata = weights.metadata(run / runs.WEIGHTS)
        facts = card.Facts(
            name=dst.name,
            version=__version__,
            config=config,
            params=params,
            stage=metadata.get("stage"),
            step=metadata.get("step"),
            base=sources.read_json(origin) if origin else None,
            metrics=_metrics(run),
        )
        total = sum(np.size(leaf) for leaf in jax.tree.leaves(params))
        say(f"writing {total / 1e6:.1f} million parameters in {dtype} …")
        _write(folder / runs.WEIGHTS, params, {**metadata, "dtype": dtype}, jnp.dtype(dtype))
        configuration.save(config, folder / runs.CONFIG)
        if origin:
            shutil.copyfile(origin, folder / runs.BASE)
        (folder / CARD).write_text(card.write(facts), encoding="utf-8")
    say(f"{dst} is ready: pewm_jax.load({str(dst)!r})")
    return dst


def narrow(leaf: Any, dtype: Any = jnp.bfloat16) -> np.ndarray:
    """Return an array with floats rounded to 16 bits; everything else as it is.

    Raises:
        UserError: a float is beyond the range of float16.
    """
    array = np.asarray(leaf)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        return array
    with np.errstate(over="ignore"):
        rounded = array.astype(dtype)
    if np.isfinite(array).all() and not np.isfinite(rounded).all():
        raise UserError("the weights exceed the range of float16: use --dtype bfloat16.")
    return rounded


def _write(path: Path, params: Params, metadata: Mapping[str, str], dtype: Any) -> None:
    """Write the weights leaf by leaf, so that no second copy of them is held."""
    leaves = tree.flatten(params)
    like = {
        name: jax.ShapeDtypeStruct(
            np.shape(leaf),
            dtype if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype,
        )
        for name, leaf in leaves.items()
    }

    def narrowed() -> Iterator[tuple[str, np.ndarray]]:
        for name, leaf in leaves.items():
            yield name, narrow(leaf, dtype)

    tensor_files.write(path, like, narrowed(), tensor_files.header(metadata))


def _base(run: Path, config: Config) -> Path | None:
    """Return the ``base.json`` of the run, or of the folder it started from, if there is one."""
    places = [run, *([Path(config.train.start)] if config.train.start else [])]
    found = [place / runs.BASE for place in places if (place / runs.BASE).is_file()]
    return found[0] if found else None


def _metrics(run: Path) -> dict[str, Any] | None:
    """Return the metrics of the run's report, if there is one and it is of these weights."""
    path = run / REPORT
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text("utf-8"))
        scored = found["protocol"]["weights_sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if scored == file_hash(run / runs.WEIGHTS) else None
