"""Satellite fixes: where an antenna was, by GNSS."""

from dataclasses import dataclass, replace

import numpy as np

from app.slam.arrays import F64
from app.slam.errors import HemislamError
from app.slam.types import Samples


@dataclass(frozen=True, slots=True)
class Fixes(Samples):
    """Where an antenna was, WGS84. Stamps are UTC, in the receiver's own clock.

    Attributes:
        latitude, longitude: (k,) degrees. height: (k,) m.
        sigmas: (k, 3) m, standard deviations to the east, north and up; nan where the receiver does not report them.
    """

    latitude: F64
    longitude: F64
    height: F64
    sigmas: F64

    @classmethod
    def of(cls, stamps_ns: object, places: object, sigmas: object = None) -> "Fixes":
        """From (k,) stamps, (k, 3) latitude, longitude, height, and (k, 3) sigmas, if known."""
        stamps, table = np.asarray(stamps_ns, np.int64), np.asarray(places, np.float64).reshape(-1, 3)
        known = np.full(table.shape, np.nan) if sigmas is None else np.asarray(sigmas, np.float64).reshape(-1, 3)
        latitude, longitude, height = np.ascontiguousarray(table.T)
        return cls(stamps, latitude, longitude, height, known)

    @property
    def places(self) -> F64:
        """(k, 3) latitude, longitude, height."""
        return np.column_stack([self.latitude, self.longitude, self.height])

    def sound(self, source: str) -> "Fixes":
        """In order of time, without empty ones, and with longitudes that do not jump from 180° to -180°.

        A sigma that is not greater than zero is unknown.

        Raises:
            HemislamError: naming `source`: fewer than three fixes, or a place that is not on Earth.
        """
        there = np.isfinite(self.latitude + self.longitude + self.height) & (
            (self.latitude != 0) | (self.longitude != 0)
        )
        order = np.flatnonzero(there)[np.argsort(self.stamps_ns[there], kind="stable")]
        known = np.where(np.isfinite(self.sigmas) & (self.sigmas > 0), self.sigmas, np.nan)
        fixes = Fixes.of(self.stamps_ns[order], self.places[order], known[order])
        if len(fixes) < 3:
            raise HemislamError(f"{source} holds {len(fixes)} fixes with a position; at least 3 are needed.")
        if (np.abs(fixes.latitude) > 90).any():
            advice = "exchange them" if (np.abs(fixes.longitude) <= 90).all() else "both must be in degrees"
            raise HemislamError(
                f"{source} has a latitude of {fixes.latitude[np.argmax(np.abs(fixes.latitude))]:.4f}°, beyond 90°;"
                f" latitude and longitude seem to be swapped: {advice}."
            )
        if (np.abs(fixes.longitude) > 360).any():
            raise HemislamError(f"{source} has a longitude beyond 360°; it must be in degrees.")
        return replace(fixes, longitude=np.unwrap(fixes.longitude, period=360.0))
