"""Engines die one after another on live data, at every moment: nothing is missed, and nothing is counted twice.

Tests app/sensors/live/address.py, app/sensors/live/receiver.py.
"""

import random
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Listener
from pathlib import Path

import numpy as np
import pytest
from test_rewind import SAMPLE

from app.mapping.live import open_live_session
from app.mapping.session import Session
from app.sensors.live import receiver
from app.sensors.live.address import LiveAddress
from app.sensors.live.intake import BUSY
from app.sensors.live.receiver import ScanServer
from app.sensors.live.source import Event
from app.sensors.live.status import LiveState, Status
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import LIVE, Pause, Save, Snapshot
from app.server.publisher import Publisher
from app.server.setup import Seen
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement

LENGTH_S = 4.0


class Script:
    """A live source that gives these events, each once."""

    def __init__(self, events: list[Event]) -> None:
        self.left = events.copy()

    def poll(self, _timeout_s: float) -> Event | None:
        return self.left.pop(0) if self.left else None

    def state(self) -> LiveState:
        return LiveState()


class Bench:
    """Engines, each in its turn, and the page's side, which outlives them."""

    def __init__(self, address: LiveAddress, params: Params, folder: Path) -> None:
        self._address, self._params, self._folder = address, params, folder
        self.fold = Fold(Snapshot(params=params))
        self.session: Session | None = None
        self.begin(revive=False)

    @property
    def page(self) -> Snapshot:
        return self.fold.snapshot

    def begin(self, *, revive: bool = True) -> None:
        page = self.page
        seen = Seen(page.session, frames=len(page.trajectory), chunks=len(page.chunks))
        self.publisher = Publisher(self._params, seen)

        def opened(*_: object) -> Session:
            self.session = open_live_session(self._address, LIVE, self._params, self._folder, take_over=revive)
            return self.session

        self.controller = Controller(self.publisher, self._params, opened, clock=lambda: 0.0)
        self.controller.open(LIVE, None, play=True)

    def kill(self, *, asking: bool) -> None:
        """asking: it has asked for a scan and dies before the answer."""
        if self.session is not None:
            if asking:
                client = self.session.feed._client
                client._connection.send(("poll", client.place, 1.0))
            self.session.feed.close()
            self.session.engine.close()

    def tell(self) -> None:
        """The page hears what there is to hear."""
        if self.publisher.filled:
            self.fold.apply(self.publisher.take())


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, []).with_values({"loops.enabled": False})


@pytest.fixture(scope="module")
def events(params: Params) -> list[Event]:
    """Scans, and among them some that were let go, also several in a row."""
    rng = random.Random(1)
    found: list[Event] = []
    with open_recording(SAMPLE, params) as recording:
        for measurement in recording.measurements(0.0, LENGTH_S):
            found.append(measurement)
            found += [DroppedScan(measurement.scan.stamp_ns + k, BUSY) for k in range(rng.choice((0, 0, 0, 1, 5)))]
    return found


@contextmanager
def given(events: list[Event], folder: Path) -> Iterator[LiveAddress]:
    """Where these can be polled."""
    address = LiveAddress(str(folder / "live"), secrets.token_bytes(16))
    server = ScanServer(Script(events))  # type: ignore[arg-type]
    with Listener(address.path, authkey=address.key) as listener:
        threading.Thread(target=receiver.accept, args=(listener, server), daemon=True).start()
        yield address


def walked(bench: Bench, events: list[Event]) -> Snapshot:
    """To the end of the events."""
    for _ in range(5 * len(events)):
        bench.controller.work()
    bench.tell()
    done = bench.page.transport
    assert done.frame + 1 + done.dropped == len(events)
    return bench.page


@pytest.fixture(scope="module")
def undisturbed(params: Params, events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Snapshot:
    folder = tmp_path_factory.mktemp("undisturbed")
    with given(events, folder) as address:
        return walked(Bench(address, params, folder), events)


@pytest.mark.parametrize("seed", range(3))
def test_however_often_engines_die_every_scan_is_mapped_once_or_counted_as_dropped(
    seed: int, params: Params, tmp_path: Path, events: list[Event], undisturbed: Snapshot
) -> None:
    rng = random.Random(seed)
    with given(events, tmp_path) as address:
        bench = Bench(address, params, tmp_path)
        for _ in range(15):
            for _ in range(rng.choice((1, 2, 4, 9, 25))):
                bench.controller.work()
                if rng.random() < 0.3:
                    bench.tell()
            bench.kill(asking=rng.random() < 0.5)
            bench.begin()
        page = walked(bench, events)

    assert page.transport.dropped == sum(isinstance(event, DroppedScan) for event in events)
    assert bench.session is not None and bench.session.log.dropped == {BUSY: page.transport.dropped}
    mapped = [event.scan.end_ns for event in events if isinstance(event, Measurement)]
    assert bench.session.log.stamps_ns.tolist() == mapped
    np.testing.assert_allclose(page.trajectory, undisturbed.trajectory, rtol=0, atol=1e-9)
    for name in ("stamp_s", "dropped", "used", "distance"):
        np.testing.assert_allclose(page.series[name], undisturbed.series[name], err_msg=name)
    assert [chunk.index for chunk in page.chunks] == list(range(len(undisturbed.chunks)))


def test_scans_dropped_before_the_first_one_of_a_map_do_not_count_as_its_own(
    params: Params, tmp_path: Path, events: list[Event]
) -> None:
    """As after returning to the live source from a recording."""
    waited = [DroppedScan(k, BUSY) for k in range(9)]
    with given([*waited, DroppedScan(9, "no IMU"), *events], tmp_path) as address:
        bench = Bench(address, params, tmp_path)
        while bench.session is None or bench.session.frame < 0:
            bench.controller.work()
        bench.tell()
    assert bench.session.log.dropped == {"no IMU": 1} and bench.page.transport.dropped == 1


def test_a_clock_that_jumps_all_the_time_does_not_bury_the_page_in_messages(
    params: Params, tmp_path: Path, events: list[Event]
) -> None:
    """As with two senders on one port."""
    jumps = [
        Status("jump", f"the IMU's clock was set by {53.3 * (-1) ** k:+.3f} s; its time continues") for k in range(2000)
    ]
    with given([*jumps, *events], tmp_path) as address:
        bench = Bench(address, params, tmp_path)
        while bench.session is None or bench.session.frame < 0:
            bench.controller.work()
        bench.tell()
    assert sum("clock was set" in notice.text for notice in bench.page.notices) == 2, "once in ten seconds, each way"


def test_a_paused_map_that_a_new_engine_took_over_has_its_time_and_can_be_saved(
    params: Params, tmp_path: Path, events: list[Event]
) -> None:
    with given(events, tmp_path) as address:
        bench = Bench(address, params, tmp_path)
        while bench.session is None or bench.session.frame < 12:
            bench.controller.work()
        bench.tell()
        bench.kill(asking=False)
        bench.begin()
        for command in (Pause(), Save(tmp_path / "saved", ("tum",))):
            bench.controller.handle(command)
        deadline = time.monotonic() + 60.0
        while not bench.page.saved and time.monotonic() < deadline:
            bench.controller.work()
            bench.tell()
    (saved,), shown = bench.page.saved, bench.page.transport
    assert shown.frame >= 0 and not shown.playing and shown.stamp_ns == bench.session.log.stamps_ns[shown.frame]
    assert saved.error == "" and len((tmp_path / "saved" / "trajectory.tum").read_text().splitlines()) > shown.frame


def test_scans_that_are_too_many_to_be_had_again_are_counted_as_dropped(
    params: Params, tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Should there be no checkpoint for long, the disk being full."""
    monkeypatch.setattr(receiver, "HISTORY", 5)
    with given(events, tmp_path) as address:
        bench = Bench(address, params, tmp_path)
        while bench.session is None or bench.session.frame < 9:  # one before the second checkpoint
            bench.controller.work()
        given_before = bench.session.frame + 1 + sum(bench.session.log.dropped.values())
        bench.kill(asking=False)
        bench.begin()
        page = walked(bench, events)
    assert bench.session.log.dropped[receiver.LOST] == given_before - 1 - 5  # the first frame has a checkpoint
    assert page.series["dropped"].sum() == page.transport.dropped
