"""Maps of other programs are read, or refused with a sentence. Tests app/export/read_points.py."""

import struct
import warnings
from pathlib import Path

import laspy
import numpy as np
import pytest

from app.export.read_points import read_points
from app.slam.errors import HemislamError

POINTS = np.array([[1.5, -2.25, 3.125], [4.0, 5.0, -6.0], [1e5, 2e6, 7.5]])


def ply(order: str, properties: str, rows: bytes, count: int = 3, more: str = "") -> bytes:
    head = f"ply\nformat {order} 1.0\ncomment made by hand\nelement vertex {count}\n{properties}{more}end_header\n"
    return head.encode() + rows


XYZ = "property double x\nproperty double y\nproperty double z\n"
MIXED = f"property uchar red\n{XYZ}property float quality\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\n"
FILES = {
    "text": ply("ascii", MIXED, b"".join(b"7 %r %r %r 0.5\n" % tuple(map(float, row)) for row in POINTS)),
    "little": ply("binary_little_endian", MIXED, b"".join(struct.pack("<Bdddf", 7, *row, 0.5) for row in POINTS)),
    "big": ply("binary_big_endian", XYZ, b"".join(struct.pack(">ddd", *row) for row in POINTS)),
    "comment": ply("binary_little_endian", "comment Größe\n" + XYZ, POINTS.tobytes()),
    "faces": ply("binary_little_endian", XYZ, POINTS.tobytes() + b"\x03" + bytes(12), more=FACES),
}


@pytest.mark.parametrize("name", FILES)
def test_points_of_a_ply_are_read_in_every_order_of_bytes(name: str, tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_bytes(FILES[name])
    assert read_points(tmp_path / "map.ply", 0.01).tolist() == POINTS.tolist()


@pytest.mark.parametrize("suffix", [".las", ".LAZ"])
def test_points_of_a_las_are_read_to_its_scale(suffix: str, tmp_path: Path) -> None:
    file = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    file.header.scales, file.header.offsets = np.full(3, 0.001), np.array([1e5, 2e6, 0.0])
    file.x, file.y, file.z = POINTS.T
    file.write(str(tmp_path / f"map{suffix.lower()}"))
    path = (tmp_path / f"map{suffix.lower()}").rename(tmp_path / f"map{suffix}")
    assert read_points(path, 0.01) == pytest.approx(POINTS, abs=5e-4)


def test_of_points_closer_than_wished_the_first_is_taken(tmp_path: Path) -> None:
    rows = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.2, 0, 0]])
    (tmp_path / "map.ply").write_bytes(ply("binary_little_endian", XYZ, rows.tobytes()))
    assert read_points(tmp_path / "map.ply", 0.05).tolist() == rows[[0, 2]].tolist()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("map.ply", b"", "its header has no end"),
        ("map.ply", b"solid something\n" * 30, "no PLY"),
        ("map.ply", FILES["little"][:-5], "ends too early"),
        ("map.ply", ply("binary_little_endian", "property list uchar int a\n", b""), "lists"),
        ("map.ply", ply("binary_little_endian", "property double x\n", bytes(24)), "no field"),
        ("map.ply", ply("binary_little_endian", XYZ, bytes(24), count=-1), "no points"),
        ("map.ply", ply("binary_little_endian", XYZ, np.full(9, np.nan).tobytes()), "no points"),
        ("map.ply", ply("ascii", XYZ, b"", count=3), "ends too early"),
        ("map.ply", ply("ascii", XYZ, b"1 2 3\n\n", count=3), "ends too early"),
        ("map.ply", ply("ascii", XYZ, b"1 2 3\n1 2 #\n", count=2), "damaged"),
        ("map.laz", b"LASF" + bytes(400), "damaged"),
        ("map.las", b"", "damaged"),
        ("map.xyz", b"1 2 3", "choose a file"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_no_map_is_refused_in_a_sentence(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HemislamError, match=words):
        read_points(tmp_path / name, 0.05)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"gone.*; check the path"):
        read_points(tmp_path / "gone.ply", 0.05)


def test_a_point_where_no_place_on_earth_is_does_not_count(tmp_path: Path) -> None:
    points = np.array([[1.0, 2.0, 3.0], [1e30, 0.0, 0.0], [-np.inf, 0.0, 0.0]])
    (tmp_path / "map.ply").write_bytes(ply("binary_little_endian", XYZ, points.tobytes(), count=3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_points(tmp_path / "map.ply", 0.05).tolist() == [[1.0, 2.0, 3.0]]
