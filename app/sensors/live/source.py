"""A live source: gives the same events as a recording, as they happen."""

import threading
import time
from collections import deque
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

from app.sensors.live.intake import Intake, Receive, Settled
from app.sensors.live.status import Kind, LiveState, Status
from app.sensors.recording import ImuEntry
from app.sensors.sequencer import MAX_WAITING, Sequencer
from app.slam.types import DroppedScan, Measurement

SILENCE_S = 1.0
"""s: a sensor that has sent nothing for this time is silent. If the IMU is, a scan waits only until the next scan."""

Event = Measurement | DroppedScan | Status


@dataclass(frozen=True, slots=True)
class Known:
    """The state of a source, for another source that takes its place.

    Attributes:
        at_ns: the time of this state, by the host's clock. state: counts, bytes recorded, scans that wait.
        settled: units and clocks, None while they are not settled. pairing: the sequencer with its newest samples.
    """

    at_ns: int
    state: LiveState
    settled: Settled | None = None
    pairing: Sequencer | None = None


class LiveSource(AbstractContextManager["LiveSource"]):
    """Receives on threads of its own; `poll` gives scans paired with IMU samples, and news.

    One thread may poll. `close` ends the threads and the recording.

    Args:
        before: the state of the source that this one replaces.
    """

    def __init__(self, receivers: list[Receive], intake: Intake, before: Known | None = None) -> None:
        self._intake, self._recorder = intake, intake.recorder
        self._recorded_before = (before and before.state.recorded) or 0
        self._sequencer = (before and before.pairing) or Sequencer(intake.params.imu)
        self._stop = threading.Event()
        self._events: deque[Event] = deque()
        self._heard_ns, self._heard_at = self._sequencer.newest_imu_ns, time.monotonic()
        self._silent_since: dict[str, float] = {}
        self._watched_at = 0.0
        self._threads = [
            threading.Thread(target=_run, args=(receive, intake, self._stop), daemon=True, name=f"receive-{number}")
            for number, receive in enumerate(receivers)
        ]
        for thread in self._threads:
            thread.start()

    def poll(self, timeout_s: float = 0.1) -> Event | None:
        """The next scan with its IMU samples, dropped scan, or news; None if nothing comes in time."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._watch()
            if self._events:
                return self._events.popleft()
            remaining = deadline - time.monotonic()
            self._gather(max(0.0, min(remaining, 0.25)))
            if not self._events and remaining <= 0:
                return None

    def state(self) -> LiveState:
        """The present state of the source."""
        recorded = None if self._recorder is None else self._recorded_before + self._recorder.bytes_written
        return replace(self._intake.state(), recorded=recorded)

    def known(self) -> Known:
        """The state that another source needs to replace this one. Do not call it while another thread polls."""
        return Known(time.time_ns(), self.state(), self._intake.settled(), self._sequencer.tail())

    def tell(self, kind: Kind, text: str) -> None:
        """Add news for the thread that polls."""
        self._intake.put_status(kind, text)

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        self._intake.end()
        if self._recorder is not None:
            self._recorder.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _gather(self, timeout_s: float) -> None:
        """Pass scans to the sequencer one at a time, so that later ones can still be dropped.

        While the IMU is silent, a waiting scan is passed on when the next one comes.
        """
        if self._heard_ns != self._sequencer.newest_imu_ns:
            self._heard_ns, self._heard_at = self._sequencer.newest_imu_ns, time.monotonic()
        silent = time.monotonic() - self._heard_at > SILENCE_S  # of samples that the sequencer accepts
        rest, scan = self._intake.take(timeout_s, scan=silent or not self._sequencer.waiting)
        for entry in rest:
            if isinstance(entry, ImuEntry):
                self._sequencer.add_imu(entry.stamp_ns, entry.gyro, entry.accel)
            else:
                self._events.append(entry)
        if scan is not None:
            self._sequencer.add_scan(scan)
        self._events.extend(self._sequencer.ready(1 if silent else MAX_WAITING))

    def _watch(self) -> None:
        """Report sensors that fell silent or are back, and a recording that failed."""
        now = time.monotonic()
        if now - self._watched_at < 0.1:
            return
        self._watched_at = now
        state = self._intake.state()
        if self._recorder is not None:
            slow = "the disk is too slow; some scans are missing in the recording"
            if trouble := self._recorder.failure or (slow if self._recorder.left_out else ""):
                self._intake.put_status("recording", trouble, once=True)
        for sensor, age in (("LiDAR", state.lidar_age_s), ("IMU", state.imu_age_s)):
            if age is None or (age > SILENCE_S) == (sensor in self._silent_since):
                continue
            if age > SILENCE_S:
                self._silent_since[sensor] = now - age
                self.tell("silent", f"the {sensor} has been silent for {age:.1f} s")
            else:
                self.tell("back", f"the {sensor} is back after {now - self._silent_since.pop(sensor):.1f} s")


def _run(receive: Receive, intake: Intake, stop: threading.Event) -> None:
    try:
        receive(stop)
    except Exception as error:  # the other threads continue; the user must know that this one does not
        intake.put_status("disconnected", f"receiving ended: {type(error).__name__}: {error}")
        raise
