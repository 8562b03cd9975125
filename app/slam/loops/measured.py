"""What was measured of a candidate loop, and what speaks for it; kept small, since three processes hold thousands.

Pickled, as for a pipe, it leaves its covariance behind, half of it: that is of use only where loops are looked for.
"""

import struct
import sys
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for and against one candidate. nan: not looked at.

    Attributes:
        context_distance: of the two Scan Contexts at the best column shift, 0 (same) to 1.
        context_yaw: rad, heading of the newer in the older's level frame by that shift.
        overlap: share of points near both keyframes that have a partner in the other submap, 0-1.
        residual_rms: m, point to plane, of those.
        condition: smallest eigenvalue of the registration's translation information over its
            largest, 0-1; near 0 the two submaps slide along each other.
        slide: m, how far registrations from disturbed starts ended from one another.
        rival_m: m to the nearest other alignment that fits as well and that odometry allows too; inf:
            there is none.
        mahalanobis: distance to what odometry predicts, in standard deviations.
        gate_m: m, standard deviation of that prediction's position.
        support: other candidates nearby that agree.
    """

    context_distance: float = float("nan")
    context_yaw: float = float("nan")
    overlap: float = float("nan")
    residual_rms: float = float("nan")
    condition: float = float("nan")
    slide: float = float("nan")
    rival_m: float = float("nan")
    mahalanobis: float = float("nan")
    gate_m: float = float("nan")
    support: int = 0

    @property
    def ambiguous(self) -> bool:
        return self.rival_m < float("inf")

    @property
    def summary(self) -> str:
        """Of a candidate that was registered, in words and numbers."""
        return (
            f"overlap {self.overlap:.2f}, residual {self.residual_rms * 1e3:.0f} mm, slide {self.slide * 1e3:.0f} mm, "
            f"{self.mahalanobis:.1f} σ from odometry"
        )


_POSE, _COVARIANCE = 12, 21
"""Numbers: the upper three rows of the one, the upper triangle of the other."""
_EVIDENCE: Final = struct.Struct("=9fi")
_EVIDENCE_AT: Final = 8 * _POSE
_COVARIANCE_AT: Final = _EVIDENCE_AT + _EVIDENCE.size
_UPPER: Final = np.triu_indices(6)
_WHERE: Final = np.empty((6, 6), np.intp)
"""In the triangle, of each entry."""
_WHERE[_UPPER] = _WHERE.T[_UPPER] = np.arange(_COVARIANCE)
_LAST_ROW: Final = np.eye(4)[3].tobytes()


class Measured(bytes):
    """A measured pose with its covariance, which come out of it to the last bit, and the evidence, to seven digits.

    Two small arrays and ten floats would take three times the memory of their numbers.
    """

    __slots__ = ()

    @classmethod
    def of(cls, T_older_newer: F64, covariance: F64, evidence: Evidence) -> "Measured":
        """From (4, 4), whose last row is 0 0 0 1, and (6, 6), symmetric."""
        pose, triangle = np.asarray(T_older_newer, np.float64)[:3], np.asarray(covariance, np.float64)[_UPPER]
        return cls(pose.tobytes() + _packed(evidence) + triangle.tobytes())

    def __reduce__(self) -> tuple[type["Measured"], tuple[bytes]]:
        return Measured, (self[:_COVARIANCE_AT],)

    @property
    def T_older_newer(self) -> F64:
        """(4, 4), read-only."""
        return np.frombuffer(self[: 8 * _POSE] + _LAST_ROW, np.float64).reshape(4, 4)

    @property
    def covariance(self) -> F64:
        """(6, 6), read-only. Raises ValueError if it was left behind."""
        whole = covariances([self])
        whole.setflags(write=False)
        return np.asarray(whole[0])

    @property
    def evidence(self) -> Evidence:
        return Evidence(*_EVIDENCE.unpack_from(self, _EVIDENCE_AT))

    def by(self, evidence: Evidence) -> "Measured":
        """The same with other evidence."""
        return Measured(self[:_EVIDENCE_AT] + _packed(evidence) + self[_COVARIANCE_AT:])


def _packed(evidence: Evidence) -> bytes:
    *numbers, support = astuple(evidence)
    with np.errstate(over="ignore"):  # infinite, where it is too large
        return np.array(numbers, np.float32).tobytes() + int(support).to_bytes(4, sys.byteorder)


def poses(measured: Iterable[Measured]) -> F64:
    """(n, 4, 4) of many at once."""
    upper = np.frombuffer(b"".join(one[:_EVIDENCE_AT] for one in measured), np.float64).reshape(-1, 3, 4)
    out = np.tile(np.eye(4), (len(upper), 1, 1))
    out[:, :3] = upper
    return out


def covariances(measured: Iterable[Measured]) -> F64:
    """(n, 6, 6) of many at once. Raises ValueError if one was left behind."""
    triangles = [one[_COVARIANCE_AT:] for one in measured]
    if not all(triangles):
        raise ValueError("a covariance was left behind: it is only where loops are looked for")
    return np.asarray(np.frombuffer(b"".join(triangles), np.float64).reshape(-1, _COVARIANCE)[:, _WHERE])
