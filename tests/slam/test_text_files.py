from pathlib import Path

import pytest

from app.slam.errors import HemislamError
from app.slam.text_files import csv_text, free_path, make_folder, write_texts


def test_cells_with_commas_are_quoted() -> None:
    assert csv_text(("name", "x"), ("a, b", 0.5), ["c", ""]) == 'name,x\n"a, b",0.5\nc,\n'


def test_no_file_is_replaced_unless_all_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    (tmp_path / ".b.txt.part").mkdir()  # so that writing the second fails
    with pytest.raises(HemislamError, match=r"a.txt, b.txt cannot be written to"):
        write_texts(tmp_path, {"a.txt": "new", "b.txt": "new"})
    assert (tmp_path / "a.txt").read_text() == "old"
    assert not (tmp_path / ".a.txt.part").exists(), "nothing half written is left"


def test_files_hold_their_texts(tmp_path: Path) -> None:
    write_texts(tmp_path, {"a.txt": "α", "b.txt": "β"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "b.txt"]
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "α"


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    make_folder(tmp_path / "a" / "b")
    (tmp_path / "file").write_text("")
    with pytest.raises(HemislamError, match=r"file/c cannot be made: Not a directory"):
        make_folder(tmp_path / "file" / "c")


def test_free_names_have_the_next_number(tmp_path: Path) -> None:
    for name in ("a.b.mcap", "a.b-2.mcap", "a.b-3.mcap"):
        path = free_path(tmp_path / "a.b", ".mcap")
        assert path == tmp_path / name
        path.touch()
    assert free_path(tmp_path / "walk", always_numbered=True) == tmp_path / "walk-1"
