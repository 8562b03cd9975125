"""How a live source is doing: rates, ages, what was lost, the clocks. Hidden while a recording is open."""

from collections.abc import Iterator
from html import escape
from typing import Final

import viser

from app.sensors.live.counters import Counters
from app.sensors.live.status import LiveState
from app.server.protocol import Snapshot
from app.ui.files import size_text
from app.ui.html import BAD, GOOD, QUIET, WARN, box, chip, heading, number, tile, tiles

OLD_S: Final = 0.5
SILENT_S: Final = 2.0
"""Since the last arrival: then a sensor is late, or silent. The slowest one sends five times a second."""
BUSY_BACKLOG: Final = 5
"""Scans that wait: half a second of them at 10 Hz. At 20 the oldest are dropped."""
OFFSET_S: Final = 0.05
"""Between the sensors' clocks; what is more is seen in the map when the device turns."""
LOST_SHARE: Final = 0.001
_CLOCKS: Final = {"sensor": "the sensors' own", "host": "this computer's, on arrival", "": "being compared"}
_TROUBLES: Final = {
    "reordered": "packets put back in order",
    "late": "packets too late",
    "truncated": "packets cut short",
    "strays": "with a time of their own",
    "undated": "packets without a date",
    "bad_blocks": "bad blocks in packets",
    "imu_lost": "IMU samples lost",
    "imu_late": "IMU samples too late",
    "jumps": "jumps of a sensor's clock",
    "reconnects": "reconnections",
    "restarts": "restarts of the receiver",
}
"""Counted, and shown once they are not zero."""


def live_html(state: LiveState, *, ended: bool = False) -> str:
    """The panel: one tile a reading, coloured by how good it is; then the sensor's words and the rarer counts.

    ended: nothing will come any more; these are the last readings.
    """
    judged = ("ended", BAD) if ended else verdict(state)
    parts = [box(f'<div class="hs-row"><b>{escape(_sensor(state))}</b>{chip(*judged)}</div>')]
    parts.append(tiles(_tiles(state)))
    if rare := [f"{getattr(state.counters, name):,} {text}" for name, text in _TROUBLES.items() if _has(state, name)]:
        parts.append(box(f'<span class="hs-note">{escape(" · ".join(rare))}</span>'))
    return heading("The live source") + "".join(parts)


def verdict(state: LiveState) -> tuple[str, str]:
    """In a word, and its colour: the worst there is."""
    ages = (("LiDAR", state.lidar_age_s), ("IMU", state.imu_age_s))
    for name, age in ages:
        if age is None:
            return f"waiting for the {name}", WARN
    for name, age in ages:
        if age is not None and age > SILENT_S:
            return f"{name} silent", BAD
    if state.backlog > BUSY_BACKLOG:
        return "engine behind", WARN
    if not state.clock:
        return "settling", WARN
    return "receiving", GOOD


def age_colour(age_s: float | None) -> str:
    if age_s is None:
        return QUIET
    return BAD if age_s > SILENT_S else WARN if age_s > OLD_S else GOOD


def _tiles(state: LiveState) -> Iterator[str]:
    counted = state.counters
    for name, rate, age in (("LiDAR", state.lidar_hz, state.lidar_age_s), ("IMU", state.imu_hz, state.imu_age_s)):
        last = "nothing came yet" if age is None else f"last {_age(age)} ago"
        yield tile(name, number(rate, 1), "Hz", note=last, colour=age_colour(age), width="half")
    lost, of = counted.lost, counted.packets + counted.lost
    share = lost / of if of else 0.0
    yield tile(
        "packets lost",
        f"{lost:,}",
        note=f"{100 * share:.2f} % of {of:,}" if of else "no packets",
        colour=BAD if share > 10 * LOST_SHARE else WARN if lost else "",
    )
    bad = unusable(counted)
    yield tile("not usable", f"{bad:,}", note="packets", colour=WARN if bad else "")
    yield tile("duplicates", f"{counted.duplicates:,}", note="packets, ignored")
    yield tile(
        "scans dropped",
        f"{counted.dropped:,}",
        note="the oldest first; never IMU",
        colour=BAD if counted.dropped else GOOD,
        width="half",
    )
    yield tile(
        "waiting",
        f"{state.backlog:,}",
        "scans",
        note="for the engine",
        colour=WARN if state.backlog > BUSY_BACKLOG else "",
        width="half",
    )
    offset = state.offset_s
    far = offset is not None and abs(offset) > OFFSET_S
    yield tile(
        "IMU behind LiDAR",
        "–" if offset is None else f"{1e3 * offset:+,.1f}",
        "ms",
        note="by arrival",
        colour=WARN if far and state.clock != "host" else "",
        width="half",
    )
    recorded = state.recorded
    yield tile(
        "recorded",
        "–" if recorded is None else size_text(recorded),
        note="not asked for (--record)" if recorded is None else "on disk",
        width="half",
    )
    yield tile("clock in use", _CLOCKS.get(state.clock, state.clock), width="wide")


def unusable(counted: Counters) -> int:
    """Packets and messages that nothing could be made of."""
    return counted.foreign + counted.truncated + counted.unreadable + counted.imu_foreign


def _has(state: LiveState, name: str) -> bool:
    return bool(getattr(state.counters, name))


def _sensor(state: LiveState) -> str:
    return state.sensor or "The sensor has not told about itself yet."


def _age(age_s: float) -> str:
    return f"{1e3 * age_s:,.0f} ms" if age_s < 1 else f"{age_s:,.1f} s"


class LivePanel:
    """The panel in the caller's container; takes no place while a recording is open."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("", visible=False)
        self._drawn: LiveState | None = None
        self._ended = False

    def draw(self, snapshot: Snapshot) -> None:
        ended = snapshot.transport.finished
        if snapshot.live is self._drawn and ended == self._ended:
            return
        self._drawn, self._ended = snapshot.live, ended
        self._html.visible = snapshot.live is not None
        if snapshot.live is not None:
            self._html.content = live_html(snapshot.live, ended=ended)
