"""A run on a live source: frames come when they come, and there is no going back."""

from dataclasses import dataclass, replace
from pathlib import Path

from app.sensors.findings import Finding
from app.sensors.live.process import LiveAddress, LiveClient
from app.sensors.live.status import LiveState, Status
from app.server.loop_process import LoopProcess
from app.server.protocol import LIVE
from app.server.readouts import Readouts
from app.server.run import Quiet, Run
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement

POLL_S = 0.02
"""How long to wait for the next scan before looking for commands."""


@dataclass(frozen=True, slots=True)
class _Endless:
    """What `Run` asks of a recording, of one that is still going on."""

    path: Path = LIVE
    start_ns: int = 0
    duration_s: float = 0.0
    scan_count: int = 0
    findings: tuple[Finding, ...] = ()

    def measurements(self, *_: object, **__: object) -> None:
        return None

    def close(self) -> None:
        pass


class LiveRun(Run):
    """Takes scans from a `LiveProcess`."""

    live = True

    def __init__(self, client: LiveClient, engine: Engine) -> None:
        super().__init__(_Endless(), engine)  # type: ignore[arg-type]
        self._client = client

    def peek(self) -> Measurement | DroppedScan | Quiet | None:
        """As of a recording; `Quiet` if there is no scan just now."""
        if self._waiting is None:
            event = self._client.poll(POLL_S)
            if isinstance(event, DroppedScan):
                self._drop(event)
                return event
            if not isinstance(event, Measurement):
                return Quiet(event)
            if self.frame < 0:
                self._begin(event.scan.stamp_ns)
            self._waiting = event
        return self._waiting

    def _begin(self, start_ns: int) -> None:
        self.opened = replace(self.opened, start_ns=start_ns)
        self.readouts = Readouts(start_ns)

    def grown(self) -> None:
        """What was opened has become longer."""
        last = self.log.stamps_ns[-1] if len(self.log) else self.opened.start_ns
        seconds = (int(last) - self.opened.start_ns) * 1e-9
        self.opened = replace(self.opened, frames=self.frame + 1, duration_s=seconds)

    def state(self) -> LiveState:
        """How the source is doing. Raises HemislamError: it has ended."""
        return self._client.state()

    def remember(self, *, near: bool = False) -> None:
        """Nothing: what has passed can not be had again."""

    def go_before(self, frame: int) -> None:
        raise HemislamError("A live source has no past; open its recording to go back in it.")

    def close(self) -> None:
        self._client.close()
        super().close()


def open_live_run(address: LiveAddress, params: Params) -> LiveRun:
    """Begin to map what comes from now on. Raises HemislamError: the receiving process has ended."""
    return LiveRun(LiveClient(address), Engine(params, LoopProcess if params.loops.enabled else None))


def tells(status: Status) -> bool:
    """Whether a status is a warning, not only news."""
    return status.kind in ("disconnected", "silent", "jump", "recording", "units")
