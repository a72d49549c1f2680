"""Experiments: one file each, holding only what differs from the defaults in ``pewm_jax.config``.

A file ``configs/NAME.py`` is a preset for ``pewm-jax train NAME``: its docstring's first line is
what ``pewm-jax train --help`` says about it, its function ``config()`` returns the settings.

The folder is the package ``pewm_jax.presets``, which is a link to it: it is imported by that name
alone, so that a checkout, an editable install and a wheel hold the same modules.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
from pathlib import Path
from types import ModuleType

from pewm_jax.config import Config


def names() -> list[str]:
    """Return the names of all presets."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def describe(name: str) -> str:
    """Return a preset's one-line description."""
    file = next(Path(folder, f"{name}.py") for folder in __path__)
    # Parsed and not imported: a preset imports the networks that it configures, and so JAX.
    return (ast.get_docstring(ast.parse(file.read_text("utf-8"))) or "").split("\n")[0]


def load(name: str) -> Config:
    """Return a preset's settings."""
    return _module(name).config()


def _module(name: str) -> ModuleType:
    # By string, because a preset is any file of the folder: whoever adds one names it nowhere else.
    return importlib.import_module(f"{__name__}.{name}")
