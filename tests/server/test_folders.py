"""The page sees only the given folders."""

from pathlib import Path

import pytest

from app.mapping.session_file import Opened, SavedSession, State, write_session
from app.server.folders import Folders
from app.slam.errors import HemislamError
from app.slam.params import Params


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    """open/ may be seen; private/ may not; links lead from one to the other."""
    for name in ("open/walks/deep", "open/ros2", "private"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("open/a.mcap", "open/walks/b.bag", "open/walks/deep/c.db3", "private/secret.mcap"):
        (tmp_path / name).write_bytes(b"1234")
    (tmp_path / "open/ros2/metadata.yaml").write_text("x")
    (tmp_path / "open/ros2/data_0.db3").write_bytes(b"123")
    (tmp_path / "open/notes.txt").write_text("x")
    (tmp_path / "open/.hidden.mcap").write_text("x")
    (tmp_path / "open/out.mcap").symlink_to(tmp_path / "private/secret.mcap")
    (tmp_path / "open/outside").symlink_to(tmp_path / "private")
    (tmp_path / "open/loop").symlink_to(tmp_path / "open")
    return tmp_path


OUTSIDE = (
    "../private/secret.mcap",
    "walks/../../private/secret.mcap",
    "out.mcap",
    "outside/secret.mcap",
    "/etc/passwd",
    "..",
    "/",
    "missing.mcap",
    "a.mcap/../../private",
    "nul\0byte",
    "~",
)


@pytest.mark.parametrize("path", OUTSIDE)
def test_nothing_outside_is_reached_and_the_answer_shows_nothing(disk: Path, path: str) -> None:
    with pytest.raises(HemislamError, match=r"There is no .* in the folders that hemislam may open"):
        Folders([disk / "open"]).inside(path)


def test_a_folder_whose_name_begins_alike_is_not_inside(disk: Path) -> None:
    (disk / "open-not").mkdir()
    with pytest.raises(HemislamError):
        Folders([disk / "open"]).inside(disk / "open-not")


def test_a_listing_shows_folders_and_recordings_but_no_way_out(disk: Path) -> None:
    listing = Folders([disk / "open"]).listing("")
    assert [(entry.path.name, entry.is_choice, entry.size, entry.outside) for entry in listing] == [
        ("loop", False, 0, False), ("out.mcap", False, 0, True), ("walks", False, 0, False),
        ("a.mcap", True, 4, False), ("ros2", True, 4, False),
    ]  # fmt: skip


def test_a_file_behind_a_link_is_listed_and_opened_if_it_lies_inside(disk: Path) -> None:
    (disk / "open/walks/again.mcap").symlink_to(disk / "open/a.mcap")
    folders = Folders([disk / "open"])
    assert ("again.mcap", True, 4) in [(e.path.name, e.is_choice, e.size) for e in folders.listing("walks")]
    assert folders.inside("walks/again.mcap") == (disk / "open/a.mcap").resolve()


def test_all_recordings_are_found_once_in_spite_of_loops(disk: Path) -> None:
    names = [path.relative_to(disk / "open").as_posix() for path in Folders([disk / "open"]).recordings()]
    assert names == ["a.mcap", "ros2", "walks/b.bag", "walks/deep/c.db3"]


def test_a_root_given_through_a_link_works(disk: Path) -> None:
    (disk / "link").symlink_to(disk / "open")
    assert Folders([disk / "link"]).inside(disk / "link" / "a.mcap") == (disk / "open/a.mcap").resolve()


def test_a_root_that_is_no_folder_is_refused(disk: Path) -> None:
    with pytest.raises(HemislamError, match=r"a\.mcap is not a folder"):
        Folders([disk / "open/a.mcap"])


def test_what_may_not_be_read_hides_nothing_but_itself(disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk has a lost+found that only root may enter; a link may lead to itself."""
    (disk / "open/self.mcap").symlink_to(disk / "open/self.mcap")
    for name in ("closed", "half"):
        (disk / "open" / name).mkdir()
        (disk / "open" / name / "d.mcap").write_bytes(b"1")
    stat, iterdir = Path.stat, Path.iterdir

    def refusing_stat(path: Path, **how: bool) -> object:
        if path.parent.name == "closed":
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **how)

    def refusing_iterdir(path: Path) -> object:
        if path.name in ("closed", "half"):
            raise PermissionError(13, "Permission denied", str(path))
        return iterdir(path)

    monkeypatch.setattr(Path, "stat", refusing_stat)
    monkeypatch.setattr(Path, "iterdir", refusing_iterdir)
    folders = Folders([disk / "open"])
    names = [entry.path.name for entry in folders.listing("")]
    assert names == ["half", "loop", "out.mcap", "walks", "a.mcap", "ros2"]
    assert len(folders.recordings()) == 4
    with pytest.raises(HemislamError, match=r"half cannot be read: Permission denied"):
        folders.listing("half")


def test_a_session_file_that_leads_nowhere_hides_no_other(disk: Path) -> None:
    (disk / "open/gone.hemislam").symlink_to(disk / "nowhere")
    recording = disk / "open/a.mcap"
    write_session(disk / "open/b.hemislam", SavedSession(Opened(recording, nbytes=4), State(Params()), 7))
    folders = Folders([disk / "open"])
    assert [(path.name, saved.frame) for path, saved in folders.sessions(disk / "open")] == [("b.hemislam", 7)]
