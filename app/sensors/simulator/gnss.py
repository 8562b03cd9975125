"""A satellite receiver on the simulated scanner."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.georeference import crs
from app.georeference.fixes import Fixes
from app.georeference.reference import GeoReference
from app.sensors.simulator.trajectory import SmoothTrajectory
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.user_text import read_numbers


@dataclass(frozen=True, slots=True)
class Gnss:
    """The receiver, and the scene's position on Earth.

    Attributes:
        rate: fixes per second. noise: m, standard deviation on each axis. offset: s by which its stamps are late.
        outliers: share of fixes that are off by `wild` m in a random direction.
        x, y, z: m, lever arm from the IMU to the antenna, IMU frame.
        latitude, longitude, height: degrees and m, of the scene's origin. heading: deg, rotation of the scene's x axis
            from east towards north.
    """

    rate: float = 5.0
    noise: float = 0.02
    offset: float = 0.0
    outliers: float = 0.0
    wild: float = 5.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    latitude: float = 48.137
    longitude: float = 11.575
    height: float = 520.0
    heading: float = 30.0

    def with_sizes(self, assignments: Sequence[str]) -> "Gnss":
        """A receiver with other values, each given as `name=value`. Raises HemislamError, which names valid values."""
        made = replace(self, **read_numbers(assignments, self.__slots__))
        shares = 0.1 <= made.rate <= 50 and made.noise > 0 and 0 <= made.outliers <= 1
        if not (shares and abs(made.latitude) <= 84 and abs(made.offset) <= 3600):
            raise HemislamError(
                "A simulated receiver has a rate of 0.1 to 50, a noise over 0, outliers of 0 to 1, a latitude within"
                " 84, and an offset within 3600."
            )
        return made

    @property
    def reference(self) -> GeoReference:
        """The true georeference of the scene, in its UTM zone."""
        grid = crs.utm(self.latitude, self.longitude)
        east, north = crs.transformer(crs.WGS84, grid).transform(self.longitude, self.latitude)
        rows = lie.from_rpy_degrees((0.0, 0.0, self.heading)).tolist()
        first, second, third = (tuple(row) for row in rows)
        scale = crs.grid_scale(grid, self.latitude, self.longitude, self.height)
        return GeoReference(grid, (east, north, self.height), (first, second, third), scale)


def received(
    gnss: Gnss, trajectory: SmoothTrajectory, duration_s: float, start_ns: int, rng: np.random.Generator
) -> Fixes:
    """The fixes that the receiver reports during a walk, with covariances."""
    times = np.arange(0.5 / gnss.rate, duration_s, 1.0 / gnss.rate)
    places, rotations = trajectory.poses(times)
    places = places + rotations @ np.array([gnss.x, gnss.y, gnss.z]) + gnss.noise * rng.normal(size=places.shape)
    wild = rng.random(len(times)) < gnss.outliers
    directions = rng.normal(size=places.shape)
    places += np.where(wild[:, None], gnss.wild * directions / np.linalg.norm(directions, axis=1, keepdims=True), 0.0)
    stamps = start_ns + np.rint((times + gnss.offset) * 1e9).astype(np.int64)
    return Fixes.of(stamps, gnss.reference.to_geographic(places), np.full(places.shape, gnss.noise))
