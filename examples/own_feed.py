"""Your own feed: a text format that hemislam does not know becomes a session with a map.

    python examples/own_feed.py FOLDER

FOLDER/lidar.csv holds `stamp_ns,x,y,z,intensity,ring` per point, FOLDER/imu.csv holds
`stamp_ns,gx,gy,gz,ax,ay,az` per sample (rad/s and m/s^2, axes of the LiDAR). The feed makes ten scans per second.
"""

import sys
from pathlib import Path

import numpy as np

from app.mapping.feed import Feed, FeedInfo
from app.mapping.session import Session
from app.slam.engine import Engine
from app.slam.params import Params
from app.slam.types import ImuSamples, Measurement, Scan

PERIOD_NS = 100_000_000


class CsvFeed(Feed):
    """Splits points into scans and pairs each with the IMU samples that cover it. Only `info` and `next` are needed."""

    def __init__(self, folder: Path) -> None:
        self._points = np.loadtxt(folder / "lidar.csv", delimiter=",")
        self._imu = np.loadtxt(folder / "imu.csv", delimiter=",")
        first, last = int(self._points[0, 0]), int(self._points[-1, 0])
        self._edges = np.arange(first, last + PERIOD_NS, PERIOD_NS)
        self._info = FeedInfo(folder, first, (last - first) * 1e-9, frames=len(self._edges) - 1)
        self._number, self._begin_ns = 0, int(self._imu[0, 0])

    @property
    def info(self) -> FeedInfo:
        return self._info

    def next(self) -> Measurement | None:
        if self._number + 1 >= len(self._edges):
            return None
        begin, end = self._edges[self._number : self._number + 2]
        rows = self._points[(self._points[:, 0] >= begin) & (self._points[:, 0] < end)]
        offsets = (rows[:, 0] - begin).astype(np.int32)
        intensity, ring = rows[:, 4].astype(np.float32), rows[:, 5].astype(np.uint16)
        scan = Scan(int(begin), rows[:, 1:4].astype(np.float32), offsets, intensity, ring)
        stamps = self._imu[:, 0].astype(np.int64)
        first = max(int(np.searchsorted(stamps, self._begin_ns, side="right")) - 1, 0)
        samples = self._imu[first : int(np.searchsorted(stamps, scan.end_ns)) + 1]
        self._number, self._begin_ns = self._number + 1, scan.end_ns
        return Measurement(scan, ImuSamples(samples[:, 0].astype(np.int64), samples[:, 1:4], samples[:, 4:7]))


folder = Path(sys.argv[1])
session = Session(CsvFeed(folder), Engine(Params()))
while (result := session.advance()) is not None:
    print(f"frame {session.frame}: {result.status}, at {np.round(result.state.p_odom_imu, 3)} m")
session.save(folder / "results").result()
session.close()
