"""The map as LAS 1.4 (ASPRS, "LAS Specification 1.4 - R15"), compressed or not, written keyframe by keyframe."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr

from app import __version__
from app.export.points import Block
from app.export.results import Results
from app.georeference.reference import GeoReference
from app.georeference.tables import GPS_MINUS_UNIX_S
from app.slam.types import F64, MOVING

SCALE = 0.001
"""m."""
BATCH = 1_000_000
"""Points compressed at once: lazrs gives each core chunks of 50,000."""
OTHER, GROUND_CLASS, MOVING_CLASS = 1, 2, 18
"""Class 18 is "high noise", which viewers and filters can leave out."""
CLASSES = np.array([OTHER, GROUND_CLASS, GROUND_CLASS, MOVING_CLASS], np.uint8)
"""Class by label."""
ADJUSTED_S = GPS_MINUS_UNIX_S - 1_000_000_000
"""Offset from Unix time to "adjusted standard GPS time"."""


def write_las(path: Path, results: Results) -> None:
    """Write the map uncompressed."""
    _write(path, results, compressed=False)


def write_laz(path: Path, results: Results) -> None:
    """Write the map, compressed by lazrs on all cores."""
    _write(path, results, compressed=True)


def _write(path: Path, results: Results, *, compressed: bool) -> None:
    header, where = _header(results.where), results.where
    if len(results.keyframes):
        header.creation_date = datetime.fromtimestamp(results.keyframes[0].stamp_ns // 10**9, UTC).date()
    backend = laspy.LazBackend.LazrsParallel if compressed else None
    batch: list[np.ndarray] = []
    try:
        with laspy.open(path, mode="w", header=header, do_compress=compressed, laz_backend=backend) as file:
            for block in results.blocks():
                batch.append(_record(block, header, where))
                if sum(map(len, batch)) > BATCH:
                    _write_batch(file, header, batch)
            _write_batch(file, header, batch)
    except lazrs.LazrsError as error:
        raise OSError("the disk is full or fails") from error


def _write_batch(file: Any, header: laspy.LasHeader, batch: list[np.ndarray]) -> None:
    """Write points at once and forget them."""
    if any(map(len, batch)):
        file.write_points(laspy.PackedPointRecord(np.concatenate(batch), header.point_format))
    batch.clear()


def _header(where: GeoReference | None) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, SCALE)
    header.offsets = np.floor(where.origin) if where is not None else np.zeros(3)
    header.generating_software = f"hemislam {__version__}"
    header.global_encoding.wkt = True
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if where is not None:
        header.vlrs.append(WktCoordinateSystemVlr(where.wkt1()))
    return header


def _record(block: Block, header: laspy.LasHeader, where: GeoReference | None) -> np.ndarray:
    points: F64 = block.points if where is None else where.to_crs(block.points)
    array: np.ndarray = laspy.PackedPointRecord.zeros(len(block), header.point_format).array
    array["X"], array["Y"], array["Z"] = np.rint((points - header.offsets) / SCALE).T
    array["intensity"] = np.clip(np.rint(block.intensity), 0, 65535)
    array["bit_fields"] = 0x11  # each point is the only return of its pulse
    array["classification"] = CLASSES[np.minimum(block.labels, MOVING)]
    array["user_data"] = np.minimum(block.ring, 255)
    array["point_source_id"] = block.keyframe % 65536
    array["gps_time"] = block.stamps_ns * 1e-9 + ADJUSTED_S
    return array
