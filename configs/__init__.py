"""Experiments: one file each, holding only what differs from the defaults in ``pewm_jax.config``.

A file ``configs/NAME.py`` is a preset for ``python train.py NAME``: its docstring's first line is
what ``python train.py --help`` says about it, its function ``config()`` returns the settings.
"""

from __future__ import annotations

import importlib
import pkgutil

from pewm_jax.config import Config


def names() -> list[str]:
    """Return the names of all presets."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def describe(name: str) -> str:
    """Return a preset's one-line description."""
    text = importlib.import_module(f"{__name__}.{name}").__doc__ or ""
    return text.strip().split("\n")[0]


def load(name: str) -> Config:
    """Return a preset's settings."""
    return importlib.import_module(f"{__name__}.{name}").config()
