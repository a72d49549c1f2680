"""Models by name, ``org/name`` or ``org/name@revision``, on a hub that huggingface_hub reaches.

``find`` returns the folder of a name in the library's cache, which is downloaded there first. The
cache, offline mode, the server and the login are those of huggingface_hub: HF_HOME (or
HF_HUB_CACHE), HF_HUB_OFFLINE, HF_ENDPOINT, HF_TOKEN. An interrupted download is resumed by the next
call. Every file is compared with the hash that the hub states; the cache stores it as the name of
the file's content.
"""

from __future__ import annotations

import errno
import fnmatch
import functools
import hashlib
import importlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pewm_jax.errors import UserError

PREFIX = "hf://"
"""Optional beginning of a name; it is needed only if a folder here is called like the name's
first part."""
WORLD = ("config.json", "weights.safetensors", "base.json", "README.md")
"""Files of a world model in our format."""
LOCAL = ("data", "runs")
"""First parts of paths that never name a model on a hub."""
_NAME = re.compile(r"([A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*?)(?:@([A-Za-z0-9][\w./-]*))?")
_CACHED = re.compile(r"models--([^/]+)--([^/]+)/snapshots/([0-9a-zA-Z]+)$")
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)


def parse(path: str | Path) -> tuple[str, str | None] | None:
    """Return the name on a hub and the revision that a text gives; None if it is a path."""
    text = str(path)
    explicit = re.match(r"hf:/{1,2}", text)  # a Path of it has one slash
    found = _NAME.fullmatch(text[explicit.end() :] if explicit else text)
    if found is None:
        return None
    head = text.partition("/")[0]
    if not explicit and (head in LOCAL or Path(head).exists()):
        return None
    return found[1], found[2]


def find(
    path: str | Path, wanted: Sequence[str] = WORLD, revision: str | None = None
) -> Path | None:
    """Return the folder in the cache with the files of a model, by its name; None for a path.

    Args:
        path: ``org/name``, ``org/name@revision`` or a path. A path that exists is never a name.
        wanted: patterns of the files to download.
        revision: a branch, a tag or a commit, by default that after the ``@``, or the newest.

    Raises:
        UserError: huggingface_hub is not installed, the hub cannot be reached and the model is not
            in the cache, there is no such model or revision, the download was cut, or a file is
            damaged.
    """
    named = parse(path)
    if named is None:
        return None
    name, stated = named
    if revision and stated and revision != stated:
        raise UserError(f"{path} was given with --revision {revision}; give one revision.")
    where = (endpoint(), str(cache()), is_offline())
    return _find(name, revision or stated, tuple(wanted), *where)


@functools.lru_cache(maxsize=64)
def _find(
    name: str,
    revision: str | None,
    wanted: tuple[str, ...],
    server: str | None,
    store: str,
    offline: bool,
) -> Path:
    """Download what the cache lacks, verify the files, and return their folder."""
    hub = require(name)
    try:
        folder = Path(
            hub.snapshot_download(
                name,
                revision=revision,
                allow_patterns=list(wanted),
                endpoint=server,
                cache_dir=store,
                local_files_only=offline,
                max_workers=1,
            )
        )
    except Exception as error:
        raise _sentence(error, name, revision, store) from error
    verify(folder, wanted)
    if not any(folder.glob("*")):
        raise UserError(f"{name} contains none of {', '.join(wanted)}; name another model.")
    return folder


def require(name: str) -> Any:
    """Return the module ``huggingface_hub``; UserError, which names the model, if it is missing."""
    try:
        return importlib.import_module("huggingface_hub")
    except ImportError:
        raise UserError(
            f"{name} is not a folder here; to use a model by its name on a hub: pip install "
            "'pewm-jax[hub]'."
        ) from None


def endpoint() -> str | None:
    """Return the address of the hub; None for the library's own."""
    return os.environ.get("HF_ENDPOINT") or None


def cache() -> Path:
    """Return the folder of the cache, as huggingface_hub chooses it."""
    own = os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE")
    if own:
        return Path(own).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("HF_HOME") or f"{base}/huggingface").expanduser() / "hub"


def is_offline() -> bool:
    """Return whether HF_HUB_OFFLINE (or TRANSFORMERS_OFFLINE) forbids connections."""
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
    return any(os.environ.get(name, "").upper() in {"1", "ON", "YES", "TRUE"} for name in names)


def title(folder: Path) -> str:
    """Return ``org/name@commit`` of a folder in the cache, and the name of any other folder."""
    found = _CACHED.search(folder.absolute().as_posix())
    return f"{found[1]}/{found[2]}@{found[3]}" if found else folder.resolve().name


def verify(folder: Path, wanted: Sequence[str] = ("*",)) -> None:
    """Compare the files of a folder in the cache with their hashes.

    Large files have a SHA-256, small ones the hash of Git.

    Raises:
        UserError: files are damaged; they are removed, so that they can be downloaded again.
    """
    damaged = []
    for path in sorted(folder.rglob("*")):
        known = any(fnmatch.fnmatch(path.relative_to(folder).as_posix(), p) for p in wanted)
        if not (known and path.is_symlink() and path.is_file()):
            continue
        content = path.resolve()
        stated = content.name
        if re.fullmatch("[0-9a-f]{40}|[0-9a-f]{64}", stated) and not _has_hash(content, stated):
            damaged.append(path.relative_to(folder).as_posix())
            content.unlink()
            path.unlink()
    if damaged:
        # Imported here: it imports JAX, which help does without.
        from pewm_jax.io import tree  # noqa: PLC0415

        raise UserError(
            f"{title(folder)}: {tree.listing(damaged)} in the cache is damaged, its hash is not "
            "the one that the hub states; it is removed: run the same command again to download it."
        )


def _has_hash(path: Path, stated: str) -> bool:
    """Return whether a file has a SHA-256 (64 digits) or a hash of Git (40 digits)."""
    if len(stated) == 64:
        digests = [hashlib.sha256()]
    else:
        git = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
        digests = [git, hashlib.sha1(usedforsecurity=False)]
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            for digest in digests:
                digest.update(block)
    return any(digest.hexdigest() == stated for digest in digests)


def push(folder: Path, name: str, *, private: bool = False) -> str:
    """Upload the files of a folder as a model, made if it is new; return the commit.

    Raises:
        UserError: huggingface_hub is not installed, the hub cannot be reached, or refuses.
    """
    hub = require(name)
    if is_offline():
        raise UserError(f"{name} cannot be pushed, because HF_HUB_OFFLINE is set; unset it.")
    api = hub.HfApi(endpoint=endpoint())
    try:
        api.create_repo(name, private=private, exist_ok=True)
        done = api.upload_folder(repo_id=name, folder_path=folder, commit_message="Push the model")
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK:
            raise
        raise UserError(
            f"{name} cannot be pushed to the hub ({_reason(error)}); check the network, and log in "
            "with `hf auth login` or HF_TOKEN as a user who may write there."
        ) from error
    return str(done.oid)


def _sentence(error: Exception, name: str, revision: str | None, store: str) -> Exception:
    """Return an error of a download as one sentence; errors of the disk are unchanged."""
    errors = importlib.import_module("huggingface_hub.errors")
    if isinstance(error, OSError) and error.errno in _DISK:
        return error
    at = f"{name}@{revision}" if revision else name
    lacking = f"there is no folder {name} here, it is not complete in the cache {store}"
    cause = _reason(error.__cause__ or error)
    if isinstance(error, errors.RevisionNotFoundError):
        text = f"{name} has no revision {revision}; choose another --revision."
    elif isinstance(error, errors.GatedRepoError):
        text = f"{name} needs the consent of its owners; ask on its page, then log in."
    elif isinstance(error, errors.RepositoryNotFoundError):
        text = (
            f"{at}: there is no folder {name} here, and the hub has no such model, or it is "
            "private; check the name, or log in with `hf auth login`."
        )
    elif is_offline():
        text = f"{at}: {lacking} and HF_HUB_OFFLINE is set; run the command once with a network."
    elif isinstance(error, errors.LocalEntryNotFoundError):
        text = (
            f"{at}: {lacking} and the hub cannot be reached ({cause}); check the network and run "
            "the same command again."
        )
    else:
        text = (
            f"{at}: the download was interrupted ({_reason(error)}); run the same command again, "
            "it resumes."
        )
    return UserError(text)


def _reason(error: BaseException) -> str:
    """Return the first line of an error, or its type."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:160].rstrip(" .:")
