"""``pewm-jax data import``: its arguments, in the present form and in the former one."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pewm_jax import registry
from pewm_jax.cli.parser import Arguments, choose
from pewm_jax.config import ConfigError
from pewm_jax.data.formats.options import ImportConfig


@dataclasses.dataclass(frozen=True)
class FormerImport(ImportConfig):
    """Import a recording of Open3D or TUM, by the former form of the command: SRC OUT."""


def import_arguments(argv: Sequence[str], prog: str) -> Arguments:
    """Return the arguments of ``data import FORMAT SRC OUT``, or of the former ``SRC OUT``.

    Raises:
        ConfigError: there is no such format.
    """
    words = list(itertools.takewhile(lambda word: not word.startswith("-"), argv))
    named = any(word.split("=")[0] == "--format" for word in argv)
    known = ["auto", *registry.names("format")]
    present = {"settings": (ImportConfig, None)}
    if named or not words:
        return Arguments(present)
    former = len(words) == 2 and (words[0] not in known or Path(words[0]).is_dir())
    if former:
        return Arguments({"settings": (FormerImport, None)}, hint=prog)
    if len(words) >= 3 and words[0] not in known:
        try:
            registry.named("format", words[0])  # of an installed package
        except ConfigError:
            choose(words[0], known, "format")
    if words[0] in known or len(words) >= 3:
        return Arguments(present, argv=["--format", words[0], *argv[1:]])
    return Arguments(present)


def import_data(settings: Any) -> None:
    """Run ``data import``."""
    from pewm_jax.data import importer

    if isinstance(settings, FormerImport) and settings.intrinsics is None:
        raise ConfigError(
            "--intrinsics is missing (fx fy cx cy in pixels of the recorded images); see "
            "`pewm-jax data import --help`."
        )
    importer.import_recording(settings)
    if isinstance(settings, FormerImport):
        print(
            "warning: `pewm-jax data import SRC OUT` is deprecated; name the format, such as "
            "`pewm-jax data import auto SRC OUT`.",
            file=sys.stderr,
        )
