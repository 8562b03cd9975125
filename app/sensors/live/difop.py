"""DIFOP, the packet in which a RoboSense states its settings and calibration; and calibrations from CSV."""

import csv
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.sensors.live.msop import PACKET_BYTES, date_bytes
from app.sensors.robosense import AIRY, BPEARL, Model
from app.sensors.ros import structure
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import F64, U16

DIFOP_PORT = 7788
DIFOP_ID = bytes.fromhex("a5ff005a11115555")
RETURN_MODES = ("dual", "strongest", "last")
_ANGLE = np.dtype([("sign", "u1"), ("value", ">u2")])


@dataclass(frozen=True, slots=True)
class ChannelAngles:
    """The direction of each channel of one unit.

    Attributes:
        elevations_deg, horizontal_deg: (c,) by channel, above the base plane and added to the azimuth.
    """

    elevations_deg: F64
    horizontal_deg: F64

    @property
    def rings(self) -> U16:
        """(c,) ring by channel: the rank of its elevation."""
        return np.argsort(np.argsort(self.elevations_deg, kind="stable")).astype(np.uint16)

    def same(self, other: "ChannelAngles") -> bool:
        return all(map(np.array_equal, astuple(self), astuple(other)))

    @classmethod
    def nominal(cls, model: Model) -> "ChannelAngles":
        return cls(model.elevations_deg, np.zeros(model.channels))


NOMINAL = ChannelAngles.nominal(BPEARL)


@dataclass(frozen=True, slots=True)
class Difop:
    """Attributes:
    rpm: 600 or 1200. fov_deg: azimuths between which it measures; (0, 360) is the full turn.
    return_mode: of RETURN_MODES. reverse: whether it spins the other way.
    calibration: None if the unit has not been calibrated.
    T_imu_lidar: (4, 4) of an IMU inside; None where there is none, or it is not stated.
    """

    rpm: int = 600
    fov_deg: tuple[float, float] = (0.0, 360.0)
    serial: str = ""
    return_mode: str = "strongest"
    reverse: bool = False
    calibration: ChannelAngles | None = None
    T_imu_lidar: F64 | None = None

    def same(self, other: "Difop") -> bool:
        """Whether all that matters for decoding is equal."""
        ours, theirs = self.calibration, other.calibration
        angles = ours is theirs or (ours is not None and theirs is not None and ours.same(theirs))
        return angles and self.describe() == other.describe()

    def describe(self) -> str:
        begin, end = self.fov_deg
        view = "" if (end - begin) % 360.0 == 0.0 else f", {begin:g} to {end:g} deg"
        return f"{self.rpm} rpm, {self.return_mode} return{view}{', reversed' if self.reverse else ''}"


def read_difop(packet: bytes, model: Model = BPEARL) -> Difop | None:
    """The content of a packet of this model; None if it is not a DIFOP packet."""
    if len(packet) != PACKET_BYTES or packet[:8] != DIFOP_ID:
        return None
    (said,) = np.frombuffer(packet, _layout(model))
    rpm, begin, end, mode = (int(said[name]) for name in ("rpm", "begin", "end", "mode"))
    elevations, horizontal = (_read_angles(said[name]) for name in ("elevations", "horizontal"))
    calibration = None
    # A unit without calibration sends invalid signs, or zeros, which cannot be elevations.
    if elevations is not None and elevations.any() and np.abs(elevations).max() <= 91.0:
        calibration = ChannelAngles(elevations, np.zeros(model.channels) if horizontal is None else horizontal)
    return Difop(
        rpm=rpm if 60 <= rpm <= 6000 else 600,
        fov_deg=(begin / 100.0, end / 100.0) if begin != end else (0.0, 360.0),
        serial=said["serial"].tobytes().hex(),
        return_mode=RETURN_MODES[mode] if mode < len(RETURN_MODES) else RETURN_MODES[1],
        reverse=model is not AIRY and bool(said["reverse"]),
        calibration=calibration,
        T_imu_lidar=_read_pose(said["pose"]) if model is AIRY else None,
    )


def write_difop(difop: Difop, stamp_ns: int, model: Model = BPEARL) -> bytes:
    """The packet that states these settings."""
    packet = np.zeros((), _layout(model))
    packet["mark"], packet["date"] = np.void(DIFOP_ID), np.void(date_bytes(stamp_ns))
    packet["rpm"], packet["mode"] = difop.rpm, RETURN_MODES.index(difop.return_mode)
    packet["begin"], packet["end"] = (round(angle * 100) for angle in difop.fov_deg)
    packet["serial"] = np.void(bytes.fromhex(difop.serial or "000000000000")[:6])
    packet["reverse"] = difop.reverse
    if difop.calibration is None:
        packet["elevations"] = packet["horizontal"] = np.array((0xFF, 0xFFFF), _ANGLE)
    else:
        packet["elevations"] = _written_angles(difop.calibration.elevations_deg)
        packet["horizontal"] = _written_angles(difop.calibration.horizontal_deg)
    if difop.T_imu_lidar is not None:
        T_lidar_imu = lie.inverse(difop.T_imu_lidar)
        packet["pose"] = *lie.quaternion(T_lidar_imu[:3, :3]), *T_lidar_imu[:3, 3]
    return packet.tobytes()


def read_angles(path: Path) -> ChannelAngles:
    """A calibration from CSV: a line for each channel, `elevation, horizontal correction` in degrees.

    Raises:
        HemislamError: the file cannot be read, or is not a calibration.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [tuple(map(float, row[:2])) for row in csv.reader(file) if row]
        table = np.array(rows, np.float64)
    except OSError as error:
        raise HemislamError(f"The angles {path} cannot be read ({error.strerror}); check the path.") from None
    except (ValueError, csv.Error):
        table = np.empty((0, 0))
    counts = (BPEARL.channels, AIRY.channels)
    if table.shape not in [(count, 2) for count in counts] or not (np.abs(table) <= (91.0, np.finfo(float).max)).all():
        raise HemislamError(
            f"{path} is not a calibration of an RS-Bpearl or Airy; it must hold {counts[0]} or {counts[1]} lines, one "
            "for each channel, of elevation and horizontal correction in degrees."
        )
    return ChannelAngles(np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1]))


def _layout(model: Model) -> np.dtype[Any]:
    """A packet of this model. pose: of the IMU in the LiDAR's frame, quaternion x, y, z, w and position in m."""
    angles, at = (_ANGLE, (model.channels,)), 468
    return structure(
        PACKET_BYTES, mark=("V8", 0), rpm=(">u2", 8), begin=(">u2", 32), end=(">u2", 34), serial=("V6", 292),
        mode=("u1", 300), date=("V10", 303), reverse=("u1", 337), elevations=(angles, at),
        horizontal=(angles, at + 3 * model.channels), pose=((">f4", (7,)), 1092),
    )  # fmt: skip


def _read_angles(table: Any) -> F64 | None:
    if (table["sign"] > 1).any():
        return None
    angles: F64 = np.where(table["sign"] == 0, 1.0, -1.0) * table["value"] * 0.01
    return angles


def _written_angles(angles_deg: F64) -> Any:
    table = np.zeros(len(angles_deg), _ANGLE)
    table["sign"], table["value"] = angles_deg < 0, np.rint(np.abs(angles_deg) * 100)
    return table


def _read_pose(numbers: Any) -> F64 | None:
    """(4, 4) T_imu_lidar; None if the numbers cannot be a pose within a sensor."""
    *quaternion, x, y, z = numbers.tolist()
    if not abs(np.linalg.norm(quaternion) - 1.0) < 0.01 or not np.abs([x, y, z]).max() < 1.0:
        return None
    return lie.inverse(lie.transform(lie.matrix(np.array(quaternion)), np.array([x, y, z])))
