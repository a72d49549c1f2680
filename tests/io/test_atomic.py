"""Nothing half-written is ever taken for whole."""

import errno

import pytest

from pewm_jax.io import atomic


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "a.txt"
    atomic.write_text(path, "old")
    with atomic.replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("folder", [False, True])
def test_what_fails_leaves_nothing_behind(tmp_path, folder):
    path = tmp_path / "a"
    with pytest.raises(KeyboardInterrupt), atomic.replacing(path) as partial:  # noqa: PT012
        if folder:
            partial.mkdir()
            (partial / "b").write_text("half")
        else:
            partial.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_folder_appears_whole(tmp_path):
    path = tmp_path / "a"
    with atomic.replacing(path) as partial:
        partial.mkdir()
        (partial / "b").write_text("c")
        assert not path.exists()
    assert (path / "b").read_text() == "c"


@pytest.mark.parametrize("named", [None, "partial", "other"])
def test_an_error_of_the_disk_names_the_file_that_was_to_be_written(tmp_path, named):
    """The error of a full disk names no file, and the name of a partial file helps nobody."""
    path = tmp_path / "a.txt"
    with pytest.raises(OSError, match="No space left") as caught, atomic.replacing(path) as partial:  # noqa: PT012
        names = {None: (), "partial": (str(partial),), "other": ("b.txt",)}[named]
        raise OSError(errno.ENOSPC, "No space left on device", *names)
    assert caught.value.filename == ("b.txt" if named == "other" else str(path))
