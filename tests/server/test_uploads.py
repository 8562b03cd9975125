"""Recordings that are copied into the first folder in pieces, over a real socket.

Tests app/server/uploads.py.
"""

import shutil
from pathlib import Path

import httpx
import pytest
from server_site import OWNER, VIEWER, Site

from app.server import uploads

PIECE = 1000
WALK = bytes(range(256)) * 10


def put(
    site: Site, name: str, offset: int, piece: bytes, size: int = len(WALK), copy: str = "", **headers: str
) -> httpx.Response:
    kind = {"Content-Type": "application/octet-stream", **headers}
    params = {"offset": offset, "size": size, "copy": copy}
    return httpx.put(site.url(f"/api/recordings/{name}"), params=params, content=piece, headers=kind)


def hidden(site: Site) -> list[Path]:
    return list(site.folder.glob(".*.part"))


def test_a_recording_arrives_in_pieces_and_can_be_opened(site: Site) -> None:
    for offset in range(0, len(WALK), PIECE):
        assert not (site.folder / "my walk.mcap").exists(), "a part of it is no recording"
        assert put(site, "my walk.mcap", offset, WALK[offset : offset + PIECE]).status_code == 204
    assert (site.folder / "my walk.mcap").read_bytes() == WALK and not hidden(site)
    assert str(site.folder / "my walk.mcap") in httpx.get(site.url("/api/recordings")).json()


def test_what_was_there_is_never_replaced(site: Site) -> None:
    (site.folder / "old.mcap").write_bytes(b"precious")
    answer = put(site, "old.mcap", 0, WALK)
    assert answer.status_code == 422 and "already" in answer.json()["detail"]
    assert (site.folder / "old.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize(
    "name",
    ["..%2Fwalk.mcap", ".walk.mcap", "walk.exe", "%00.mcap", "x" * 300 + ".mcap", "ä" * 150 + ".mcap", "a%5Cb.mcap%0A"],
)
def test_only_ordinary_names_of_recordings_are_taken(site: Site, name: str) -> None:
    before = sorted(site.folder.parent.rglob("*"))
    assert put(site, name, 0, WALK).status_code in (404, 405, 422)
    assert sorted(site.folder.parent.rglob("*")) == before


def test_a_missing_piece_is_told_and_the_copy_begins_anew(site: Site) -> None:
    assert put(site, "gap.mcap", 0, WALK[:PIECE]).status_code == 204
    assert "missing" in put(site, "gap.mcap", 2 * PIECE, WALK[2 * PIECE :]).json()["detail"]
    assert "grown" in put(site, "gap.mcap", PIECE, WALK).json()["detail"]
    assert put(site, "gap.mcap", 0, WALK).status_code == 204
    assert (site.folder / "gap.mcap").read_bytes() == WALK


def test_two_pages_that_copy_files_of_one_name_never_mix_them(site: Site) -> None:
    other = WALK[::-1]
    put(site, "both.mcap", 0, WALK[:PIECE], copy="a")
    put(site, "both.mcap", 0, other[:PIECE], copy="b")
    assert "missing" in put(site, "both.mcap", PIECE, WALK[PIECE:], copy="a").json()["detail"]
    assert put(site, "both.mcap", PIECE, other[PIECE:], copy="b").status_code == 204
    assert (site.folder / "both.mcap").read_bytes() == other


def test_a_copy_that_is_given_up_leaves_nothing(site: Site) -> None:
    put(site, "half.mcap", 0, WALK[:PIECE])
    assert hidden(site)
    assert httpx.delete(site.url("/api/recordings/half.mcap")).status_code == 204
    assert not hidden(site) and not (site.folder / "half.mcap").exists()


def test_a_full_disk_is_told_before_anything_is_written(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "_LEFT_FREE", shutil.disk_usage(site.folder).total)
    assert "does not fit" in put(site, "large.mcap", 0, WALK).json()["detail"]
    assert not hidden(site)


def test_who_may_only_look_copies_nothing(public_site: Site) -> None:
    assert put(public_site, "seen.mcap", 0, WALK, **VIEWER).status_code == 403
    assert put(public_site, "seen.mcap", 0, WALK, **OWNER).status_code == 204
