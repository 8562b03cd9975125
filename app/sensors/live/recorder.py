"""A live session as a ROS 2 recording, written while it runs: readable by `ros2 bag` and by `open_recording`.

It has a thread of its own, so that a slow disk delays nothing. Twice a second it ends a chunk and syncs it to the disk:
a crash costs less than the last second, and a file without an end can be read (`mcap_stream.py`).
"""

import os
import struct
import threading
from collections import deque
from pathlib import Path

from app.sensors.recording import ImuEntry, ScanEntry
from app.sensors.ros import RecordingWriter
from app.slam.errors import HemislamError
from app.slam.types import Scan

FLUSH_S = 0.5
MAX_SCANS, MAX_SAMPLES = 200, 100_000
"""Most messages that wait for the disk: 20 s of scans. If the disk is too slow, the newest are left out."""

LATE_NS = 2_000_000_000
"""A scan whose rest is awaited in vain is written after IMU samples that came up to this much later."""


class Recorder:
    """Attributes:
    path: the .mcap. bytes_written: so far. left_out: messages that the disk was too slow for.
    failure: why it stopped before its end; "" if it did not.
    """

    def __init__(self, path: Path) -> None:
        """Raises HemislamError: the file is there already, or cannot be made."""
        self.path = path
        self.bytes_written = 0
        self.left_out = 0
        self.failure = ""
        if path.suffix != ".mcap":
            raise HemislamError(f"{path} cannot be recorded into; name a file that ends in .mcap, as it will be one.")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except OSError as error:
            if isinstance(error, FileExistsError) and path.exists():
                raise HemislamError(f"{path} is there already; record into another file.") from None
            raise HemislamError(f"{path} cannot be written ({error.strerror}); choose another place.") from None
        self._mcap = RecordingWriter(self._file)
        self._log_ns = 0
        self._waiting: deque[ScanEntry | ImuEntry] = deque()
        self._scans_waiting = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="recorder")
        self._thread.start()

    def add(self, entry: ScanEntry | ImuEntry) -> None:
        """Queue a message to be written, if there is room. A scan that was dropped is not written."""
        is_scan = isinstance(entry, ScanEntry)
        if self.failure or len(self._waiting) >= MAX_SAMPLES or (is_scan and self._scans_waiting >= MAX_SCANS):
            self.left_out += 1
            return
        self._scans_waiting += is_scan
        self._waiting.append(entry)

    def close(self) -> None:
        """Write the waiting messages and the end of the file."""
        self._closing.set()
        self._thread.join(30.0)

    def _run(self) -> None:
        try:
            with self._file:
                closing = False
                while not closing:
                    closing = self._closing.wait(FLUSH_S)
                    while self._waiting:
                        try:
                            self._write(self._waiting.popleft())
                        except (struct.error, OverflowError):  # a time that ROS cannot express
                            self.left_out += 1
                    if closing:
                        self._mcap.finish()
                    else:
                        self._mcap.flush()
                    self._file.flush()
                    os.fsync(self._file.fileno())
                    self.bytes_written = self._file.tell()
        except (OSError, ValueError) as error:
            self.failure = f"{self.path} cannot be written any more ({getattr(error, 'strerror', None) or error})"
            self._waiting.clear()

    def _write(self, entry: ScanEntry | ImuEntry) -> None:
        waited = 0 < self._log_ns - entry.log_ns < LATE_NS  # more is a clock that was set back
        self._log_ns = self._log_ns if waited else entry.log_ns
        if isinstance(entry, ImuEntry):
            self._mcap.add_imu(entry.stamp_ns, entry.gyro, entry.accel, self._log_ns)
            return
        self._scans_waiting -= 1
        if isinstance(entry.scan, Scan):
            self._mcap.add_scan(entry.scan, self._log_ns)
