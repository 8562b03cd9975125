"""The map as E57 (ASTM E2807): one scan per keyframe, in the LiDAR's frame, with its pose."""

import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pye57
from pye57 import libe57
from scipy.spatial.transform import Rotation

from app.export.points import Block
from app.export.results import Results
from app.georeference.reference import GeoReference
from app.georeference.tables import GPS_MINUS_UNIX_S


def write(path: Path, results: Results) -> None:
    """Write the map; poses are in the coordinate system on Earth if known, else in the map. Each file has new GUIDs."""
    try:
        file = _Writer(str(path), results.where)
        try:
            for block in results.still_blocks():
                if len(block):
                    _add(file, block, results.where)
        finally:
            file.close()
    except libe57.E57Exception as error:
        raise OSError("the disk is full or fails") from error


class _Writer(pye57.E57):  # type: ignore[misc] # it has no types
    """Sets the coordinate system, which pye57 leaves empty; nodes cannot be set twice."""

    def __init__(self, path: str, where: GeoReference | None) -> None:
        self._wkt = "" if where is None else where.wkt1()
        super().__init__(path, "w")

    def close(self) -> None:
        """Close only once: after a disk failure, closing again on deletion would print a second error."""
        if (image_file := self.__dict__.pop("image_file", None)) is not None:
            image_file.close()

    def write_default_header(self) -> None:
        file, root = self.image_file, self.root
        file.extensionsAdd("", libe57.E57_V1_0_URI)
        texts = {
            "formatName": "ASTM E57 3D Imaging Data File",
            "guid": f"{{{uuid.uuid4()}}}",
            "e57LibraryVersion": libe57.E57_LIBRARY_ID,
            "coordinateMetadata": self._wkt,
        }
        for name, text in texts.items():
            root.set(name, libe57.StringNode(file, text))
        for name, number in {"versionMajor": libe57.E57_FORMAT_MAJOR, "versionMinor": libe57.E57_FORMAT_MINOR}.items():
            root.set(name, libe57.IntegerNode(file, number))
        for name in ("data3D", "images2D"):
            root.set(name, libe57.VectorNode(file, True))


def _add(file: Any, block: Block, where: GeoReference | None) -> None:
    rotation, translation, points = block.T_map_lidar[:3, :3], block.T_map_lidar[:3, 3], block.points
    if where is not None:
        rotation, translation = np.array(where.rotation) @ rotation, where.to_crs(translation[None])[0]
        points = where.to_crs(points)
    own = ((points - translation) @ rotation).astype(np.float32).astype(np.float64)
    limits = (("Minimum", own.min(axis=0)), ("Maximum", own.max(axis=0)))
    head = {f"{axis}{end}": float(values[k]) for k, axis in enumerate("xyz") for end, values in limits}
    for name, stamp_ns in (("Start", block.stamps_ns.min()), ("End", block.stamps_ns.max())):
        head[f"acquisition{name}_dateTimeValue"] = int(stamp_ns) * 1e-9 + GPS_MINUS_UNIX_S
    file.write_scan_raw(
        {**{f"cartesian{axis}": own[:, k] for k, axis in enumerate("XYZ")}, "intensity": block.intensity.astype("f4")},
        name=f"keyframe {block.keyframe}",
        rotation=np.roll(Rotation.from_matrix(rotation).as_quat(), 1),
        translation=translation,
        scan_header=SimpleNamespace(**head),
    )
