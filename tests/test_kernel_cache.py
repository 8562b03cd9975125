"""The place of compiled kernels if the usual folders are not writable."""

import os
import tempfile
from pathlib import Path

import pytest

from app import kernel_cache
from app.kernel_cache import VARIABLE, fall_back


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The environment of a user who can write nowhere but to the temporary folder. root could, so access is faked."""
    access = os.access
    monkeypatch.setattr(kernel_cache.os, "access", lambda path, mode: not mode & os.W_OK and access(path, mode))
    return {"HOME": str(tmp_path / "home")}


def test_a_folder_that_can_be_written_to_is_left_to_numba(tmp_path: Path) -> None:
    environ = {"HOME": str(tmp_path / "home")}
    assert fall_back(environ, tmp_path / "missing") is None, "the user's cache can be made"
    assert fall_back(environ | {"HOME": "/proc"}, tmp_path) is None, "kernels can be kept beside their source"
    assert VARIABLE not in environ


def test_without_one_a_private_temporary_folder_is_used_again_and_again(
    read_only: dict[str, str], tmp_path: Path, temporary: Path
) -> None:
    folder = fall_back(dict(read_only), tmp_path)
    assert folder is not None and folder.parent == temporary
    assert folder.stat().st_mode & 0o777 == 0o700
    environ = dict(read_only)
    assert fall_back(environ, tmp_path) == folder and environ[VARIABLE] == str(folder)
    assert fall_back(environ, tmp_path) is None, "a process that this one starts does not say it again"


@pytest.mark.parametrize("trap", ["open to others", "a link", "a file"])
def test_a_folder_that_others_may_have_prepared_is_not_used(
    read_only: dict[str, str], tmp_path: Path, temporary: Path, trap: str
) -> None:
    folder = fall_back(dict(read_only), tmp_path)
    assert folder is not None
    if trap == "open to others":
        folder.chmod(0o777)
    else:
        folder.rmdir()
        folder.symlink_to(tmp_path) if trap == "a link" else folder.write_text("")
    other = fall_back(dict(read_only), tmp_path)
    assert other is not None and other != folder and other.is_dir() and other.parent == temporary
