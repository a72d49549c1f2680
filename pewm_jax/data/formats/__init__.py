"""The formats that ``pewm-jax data import`` reads, by name, and their recognition.

A format is a class of one file, registered as a kind of the section ``format``
(``pewm_jax.registry``), so ``--plugin FILE`` adds your own.
"""

from __future__ import annotations

from pathlib import Path

from pewm_jax import registry
from pewm_jax.config import UserError
from pewm_jax.data.formats.reader import Format

AUTO = "auto"
"""The name that stands for the format that ``recognise`` finds."""


def names() -> list[str]:
    """Return the names of all formats; ``auto`` is the first."""
    return [AUTO, *registry.names("format")]


def named(name: str) -> Format:
    """Return a format; ConfigError for an unknown name, with those that are known."""
    return registry.named("format", name).settings()


def recognise(src: Path) -> tuple[Format, str]:
    """Return the format of a folder, and what was found there.

    A format that looks for more files is preferred to one that looks for fewer.

    Raises:
        UserError: no format fits.
    """
    if not src.is_dir():
        raise UserError(f"{src} is not a folder; give the folder of a recording or data set.")
    known = [named(name) for name in registry.names("format")]
    for found in sorted(known, key=lambda one: one.LAST):
        why = found.recognise(src)
        if why:
            return found, why
    layouts = "; ".join(f"{one.NAME}: {one.LAYOUT}" for one in known)
    raise UserError(f"{src} has none of the known layouts ({layouts}): name its format.")
