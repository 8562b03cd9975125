"""Headers of binary PLY and PCD files."""

from typing import Protocol

import numpy as np

from app.slam.types import Keyframe

_KINDS = {"<f4": "float", "<u2": "ushort", "<i4": "int", "|u1": "uchar", "<f8": "double"}


class Keyframes(Protocol):
    """Keyframes by index, as an export reads them."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Keyframe: ...


def header(vertex: np.dtype, count: int, *comments: str, keyframe: np.dtype | None = None, keyframes: int = 0) -> bytes:
    """The header of `count` vertices of a structured type, and of keyframes of another after them, if that is given.

    Its length does not depend on the counts.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += _element("vertex", vertex, count) + ([] if keyframe is None else _element("keyframe", keyframe, keyframes))
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def pcd_header(kind: np.dtype, count: int, comment: str, viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    """The header of `count` points as binary PCD 0.7. viewpoint: x y z qw qx qy qz. Its length is fixed."""
    kinds = [kind[name] for name in kind.names or ()]
    lines = [
        f"# .PCD v0.7 - {comment}",
        "VERSION 0.7",
        f"FIELDS {' '.join(kind.names or ())}",
        f"SIZE {' '.join(str(one.itemsize) for one in kinds)}",
        f"TYPE {' '.join(one.kind.upper() for one in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count:012d}",
        "HEIGHT 1",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {count:012d}",
        "DATA binary",
        "",
    ]
    return "\n".join(lines).encode("ascii")


def _element(name: str, kind: np.dtype, count: int) -> list[str]:
    return [
        f"element {name} {count:012d}",
        *(f"property {_KINDS[kind[field].str]} {field}" for field in kind.names or ()),
    ]
