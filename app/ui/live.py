"""The state of a live source: rates, ages, losses, clocks. Hidden while a recording is open."""

from collections.abc import Iterator
from typing import Final

import viser

from app.sensors.live.status import Counters, LiveState
from app.server.protocol import LIVE, OpenRecording, Snapshot
from app.ui.files import size_text
from app.ui.html import BAD, GOOD, QUIET, WARN, Tile, number, panel
from app.ui.widgets import Page, add_button

OLD_S: Final = 0.5
SILENT_S: Final = 2.0
"""Time since the last arrival after which a sensor is called late or silent. The slowest sends five times a second."""
BUSY_BACKLOG: Final = 5
"""Most waiting scans without a warning: half a second at 10 Hz. At 100 waiting scans, the oldest are dropped."""
OFFSET_S: Final = 0.05
"""Largest harmless offset between the sensors' clocks; more is visible in the map when the device turns."""
LOST_SHARE: Final = 0.001
_CLOCKS: Final = {"sensor": "the sensors' own", "host": "this computer's, on arrival", "": "being compared"}
_TROUBLES: Final = {
    "reordered": "packets put back in order",
    "late": "packets too late",
    "truncated": "packets cut short",
    "strays": "packets with stray times",
    "undated": "packets without a date",
    "bad_blocks": "bad blocks in packets",
    "imu_lost": "IMU samples lost",
    "imu_late": "IMU samples too late",
    "jumps": "jumps of a sensor's clock",
    "reconnects": "reconnections",
    "restarts": "restarts of the receiver",
}
"""Counts that are shown only if they are not zero."""


def live_html(state: LiveState, *, ended: bool = False, paused: bool = False) -> str:
    """The panel: one tile per reading, coloured by its quality; then the rarer counts.

    ended: the source has ended, and these are the last readings. paused: the user has paused, so that scans wait.
    """
    judged = ("ended", BAD) if ended else verdict(state, paused=paused)
    rare = [f"{count:,} {text}" for name, text in _TROUBLES.items() if (count := getattr(state.counters, name))]
    return panel("live", state.sensor or "The sensor has not described itself yet.", *judged, list(_tiles(state)), rare)


def verdict(state: LiveState, *, paused: bool = False) -> tuple[str, str]:
    """The worst reading in a few words, and its colour."""
    ages = (("LiDAR", state.lidar_age_s), ("IMU", state.imu_age_s))
    for name, age in ages:
        if age is None:
            return f"waiting for the {name}", WARN
    for name, age in ages:
        if age is not None and age > SILENT_S:
            return f"{name} silent", BAD
    if state.backlog > BUSY_BACKLOG:
        return "scans wait" if paused else "engine behind", WARN
    if not state.clock:
        return "settling", WARN
    return "receiving", GOOD


def _tiles(state: LiveState) -> Iterator[Tile]:
    counted = state.counters
    for name, rate, age in (("LiDAR", state.lidar_hz, state.lidar_age_s), ("IMU", state.imu_hz, state.imu_age_s)):
        last = "nothing received yet" if age is None else f"last {_age(age)} ago"
        colour = QUIET if age is None else BAD if age > SILENT_S else WARN if age > OLD_S else GOOD
        yield Tile(name, number(rate, 1), "Hz", last, colour, "half")
    lost, of = counted.lost, counted.packets + counted.lost
    share = lost / of if of else 0.0
    note = f"{100 * share:.2f} % of {of:,}" if of else "no packets"
    yield Tile("packets lost", f"{lost:,}", "", note, BAD if share > 10 * LOST_SHARE else WARN if lost else "")
    bad = unusable(counted)
    yield Tile("not usable", f"{bad:,}", "", "packets", WARN if bad else "")
    yield Tile("duplicates", f"{counted.duplicates:,}", "", "packets, ignored")
    colour = BAD if counted.dropped else GOOD
    yield Tile("scans dropped", f"{counted.dropped:,}", "", "oldest scans first; never IMU data", colour, "half")
    colour = WARN if state.backlog > BUSY_BACKLOG else ""
    yield Tile("waiting", f"{state.backlog:,}", "scans", "for the engine", colour, "half")
    offset = state.imu_lag_s
    far = offset is not None and abs(offset) > OFFSET_S and state.clock != "host"
    shown = "–" if offset is None else f"{1e3 * offset:+,.1f}"
    yield Tile("IMU behind LiDAR", shown, "ms", "by arrival", WARN if far else "", "half")
    recorded = state.recorded
    shown, note = ("–", "off; start with --record") if recorded is None else (size_text(recorded), "on disk")
    yield Tile("recorded", shown, "", note, width="half")
    yield Tile("clock in use", _CLOCKS.get(state.clock, state.clock), width="wide")


def unusable(counted: Counters) -> int:
    return counted.foreign + counted.truncated + counted.unreadable + counted.imu_foreign


def _age(age_s: float) -> str:
    return f"{1e3 * age_s:,.0f} ms" if age_s < 1 else f"{age_s:,.1f} s"


class LivePanel:
    """The panel in the caller's container; while a recording is open, a button that returns to the live source."""

    def __init__(self, page: Page) -> None:
        self._html = page.gui.add_html("")
        hint = "Start a new map with the last scans that wait, ten seconds at most. The file of --record has no gap."
        self._back = add_button(
            page.gui,
            "Back to the live source",
            lambda _: page.send(OpenRecording(LIVE)),
            viser.Icon.BROADCAST,
            visible=False,
            hint=hint,
        )
        self._was_live = False

    def draw(self, snapshot: Snapshot) -> None:
        live, transport = snapshot.live, snapshot.transport
        self._was_live |= live is not None
        self._back.visible = self._was_live and live is None and snapshot.progress is None
        ended, paused = transport.finished, not transport.playing
        self._html.content = live_html(live, ended=ended, paused=paused) if live is not None else ""
