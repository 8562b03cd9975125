"""The systems that `evaluate --baseline` runs beside this engine, by name."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import Protocol

from app.baselines import peers
from app.baselines.liom import Liom
from app.baselines.loam import Loam
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F64, Measurement

FOLDER = Path(__file__).parents[2] / "build" / "peers"
"""Separate folder for systems from PyPI, since some need other versions of shared packages."""


class Baseline(Protocol):
    """An odometry system. A new instance is made for each recording and gets every measurement in order."""

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        """Process a scan. Returns a time in ns, usually that of the scan's end, and T_odom_imu (4, 4) at that time."""
        ...


@dataclass(frozen=True, slots=True)
class System:
    """Attributes:
    title: column of the tables. meaning: in words. make: makes an instance. package: for pip; "" if part of hemislam.
    """

    title: str
    meaning: str
    make: Callable[[Params], Baseline]
    package: str = ""

    def start(self, params: Params) -> Baseline:
        """Make an instance for a recording. Packages go last on the path, so hemislam's shared packages have priority.

        Raises:
            HemislamError: it is not installed.
        """
        self.version()
        if self.package and str(FOLDER) not in sys.path:
            sys.path.append(str(FOLDER))
        return self.make(params)

    def version(self) -> str:
        """Version of the installed package; "" for a system that is part of hemislam.

        Raises:
            HemislamError: it is not installed.
        """
        if not self.package:
            return ""
        name = self.package.partition(">")[0]
        found = next(iter(distributions(name=name, path=[*sys.path, str(FOLDER)])), None)
        if found is None:
            raise HemislamError(
                f"{self.title} is not installed; `{sys.executable} -m pip install --no-warn-conflicts --target {FOLDER}"
                f" '{self.package}'` installs it in a folder of its own."
            )
        return found.version


SYSTEMS = {
    "loam": System("LOAM", "edges and planes, LiDAR only (Zhang and Singh 2014), reimplemented", Loam),
    "liom": System("LIOM", "IMU and LiDAR in a fixed-lag smoother (Ye et al. 2019), reimplemented", Liom),
    "kiss-icp": System("KISS-ICP", "point to point, LiDAR only, its own defaults", peers.KissIcp, "kiss-icp>=1.3"),
    "rko-lio": System("RKO-LIO", "LiDAR and IMU, its own defaults", peers.RkoLio, "rko_lio>=0.4"),
    "genz-icp": System("GenZ-ICP", "point and plane, LiDAR only, its own defaults", peers.GenzIcp, "genz-icp>=0.3"),
}


def find_system(name: str) -> System:
    """The system of this name, installed.

    Raises:
        HemislamError: there is no such system, or its package is missing.
    """
    if name not in SYSTEMS:
        raise HemislamError(f"There is no baseline `{name}`; choose from {', '.join(SYSTEMS)}.")
    SYSTEMS[name].version()
    return SYSTEMS[name]
