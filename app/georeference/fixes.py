"""Satellite fixes: where an antenna was, by GNSS."""

from dataclasses import dataclass

import numpy as np

from app.slam.arrays import F64
from app.slam.errors import HemislamError
from app.slam.types import Samples


@dataclass(frozen=True, slots=True)
class Fixes(Samples):
    """Where an antenna was, WGS84. Stamps are UTC, in the receiver's own clock.

    Attributes:
        places: (k, 3) latitude and longitude, degrees, and height, m.
        sigmas: (k, 3) m, standard deviations to the east, north and up; nan where the receiver does not report them.
    """

    places: F64
    sigmas: F64

    @classmethod
    def of(cls, stamps_ns: object, places: object, sigmas: object = None) -> "Fixes":
        """From (k,) stamps, (k, 3) latitude, longitude, height, and (k, 3) sigmas, if known."""
        table = np.asarray(places, np.float64).reshape(-1, 3)
        known = np.full(table.shape, np.nan) if sigmas is None else np.asarray(sigmas, np.float64).reshape(-1, 3)
        return cls(np.asarray(stamps_ns, np.int64), table, known)

    def sound(self, source: str) -> "Fixes":
        """In order of time, without empty ones, and with longitudes that do not jump from 180° to -180°.

        A sigma that is not greater than zero is unknown.

        Raises:
            HemislamError: naming `source`: fewer than three fixes, or a place that is not on Earth.
        """
        there = np.isfinite(self.places).all(axis=1) & self.places[:, :2].any(axis=1)
        order = np.flatnonzero(there)[np.argsort(self.stamps_ns[there], kind="stable")]
        if len(order) < 3:
            raise HemislamError(f"{source} holds {len(order)} fixes with a position; at least 3 are needed.")
        require_degrees(self.places, source, "fix")
        sigmas = np.where(np.isfinite(self.sigmas) & (self.sigmas > 0), self.sigmas, np.nan)
        return Fixes(self.stamps_ns[order], without_jumps(self.places[order]), sigmas[order])


def without_jumps(places: F64) -> F64:
    """Places (n, 3) in degrees and m with longitudes that do not jump from 180° to -180°."""
    latitude, longitude, height = places.T
    return np.column_stack([latitude, np.unwrap(longitude, period=360.0), height])


def require_degrees(places: F64, source: str, kind: str) -> None:
    """Raises HemislamError: a latitude or longitude (degrees) is beyond its range. kind: what a row is called."""
    latitude, longitude = np.abs(places[:, :2]).T
    if not (latitude <= 90).any() and (latitude > 90).any() and not (longitude > 90).any():
        raise HemislamError(
            f"{source} has latitudes beyond 90° only; latitude and longitude seem to be swapped: exchange them."
        )
    for column, name, most in ((0, "latitude", 90), (1, "longitude", 360)):
        beyond = np.abs(places[:, column]) > most
        if beyond.any():
            row = int(np.argmax(beyond))
            raise HemislamError(
                f"{source}, {kind} {row + 1}: the {name} {places[row, column]:.4f}° is beyond {most}°;"
                " give it in degrees, or remove it."
            )
