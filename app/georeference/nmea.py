"""NMEA 0183 sentences of a receiver: GGA for places, GST for their sigmas, RMC and ZDA for the day."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np

from app.georeference.fixes import Fixes
from app.slam.errors import HemislamError

_DAY_S = 86_400.0
_YEARS = range(1980, 2200)
"""Valid years: since GPS time began, and as far as stamps in ns reach."""
_PAUSE_NS = 60_000_000_000
"""After a longer pause, the day may be another one."""
_NOBODY = (float("nan"),) * 3


@dataclass(slots=True)
class _Log:
    """The content of a receiver's sentences, in their order.

    Attributes:
        walk_ns: the time of the walk: of two dates that contradict each other without a pause, the nearer one counts.
        near_ns: a time within half a day, for sentences without a date; at first the time of the walk.
        places: latitude and longitude in degrees, height above the geoid, and the geoid's height above the ellipsoid
            (nan if not stated), m. stamps: of each place, in ns.
        sigmas: of each place, m to the east, north and up. told: those of the day's GST, by s of the day.
        untold: by s of the day, the places without sigmas so far. now: s of the day; if it steps back, a day begins.
        fixed: whether the last GGA or RMC has a fix; None before the first. Without a fix, the date of ZDA may be that
            of the receiver's own clock.
        early: day, and s of the day, by the last ZDA before the first GGA or RMC, which decides whether it counts.
        begin: the first place after the last pause. dated: whether a sentence has stated its day.
    """

    walk_ns: int
    near_ns: int
    places: list[tuple[float, float, float, float]] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    sigmas: list[tuple[float, float, float]] = field(default_factory=list)
    told: dict[float, tuple[float, float, float]] = field(default_factory=dict)
    untold: dict[float, int] = field(default_factory=dict)
    now: float = 0.0
    fixed: bool | None = None
    early: tuple[datetime, float] | None = None
    begin: int = 0
    dated: bool = False

    def add(self, line: str) -> None:
        """Add one line; anything but a complete sentence with the right checksum is ignored."""
        body, star, checksum = line.strip().rpartition("$")[2].partition("*")
        if not star or checksum[:2].upper() != f"{reduce(xor, body.encode(), 0):02X}":
            return
        kind, *words = body.split(",")
        try:
            if kind.endswith("GGA") and len(words) > 10:
                self._set_fixed(int(words[5] or 0) > 0)
                if self.fixed:
                    self._place(words)
            elif kind.endswith("GST") and len(words) > 7 and words[5]:
                north, east, up = (float(word) for word in words[5:8])
                at = self._at(words[0])
                self.told[at] = east, north, up
                if at in self.untold:
                    self.sigmas[self.untold.pop(at)] = self.told[at]
            elif kind.endswith("RMC") and len(words) > 8:
                self._set_fixed(words[1] == "A")
                if self.fixed and words[8]:
                    self._day(datetime.strptime(words[8], "%d%m%y"), _seconds(words[0]))
            elif kind.endswith("ZDA") and len(words) > 3 and words[3]:
                day = datetime.strptime("".join(words[1:4]), "%d%m%Y"), _seconds(words[0])
                if self.fixed:
                    self._day(*day)
                elif self.fixed is None:
                    self.early = day
        except (ValueError, OverflowError, KeyError):
            return

    def _set_fixed(self, fixed: bool) -> None:
        if fixed and self.fixed is None and self.early:
            self._day(*self.early)
        self.fixed = fixed

    def _place(self, words: list[str]) -> None:
        latitude, longitude = _degrees(words[1], words[2]), _degrees(words[3], words[4])
        at = self._at(words[0])
        self.near_ns = self._guessed(at)
        self.places.append((latitude, longitude, float(words[8]), float(words[10] or "nan")))
        self.stamps.append(self.near_ns)
        self.sigmas.append(self.told.get(at, _NOBODY))
        if self.sigmas[-1] is _NOBODY:
            self.untold[at] = len(self.sigmas) - 1

    def _at(self, text: str) -> float:
        """s of the day, of a place or its sigmas."""
        before, self.now = self.now, _seconds(text)
        if self.now < before - _PAUSE_NS / 1e9:
            self.told.clear()
            self.untold.clear()
        return self.now

    def _day(self, day: datetime, at_s: float) -> None:
        if day.year not in _YEARS:
            return
        stamp_ns = round(day.replace(tzinfo=UTC).timestamp()) * 1_000_000_000 + round(at_s * 1e9)
        guessed_ns = self._guessed(at_s)
        if self.dated and abs(stamp_ns - self.walk_ns) >= abs(guessed_ns - self.walk_ns):
            return
        off = stamp_ns - guessed_ns
        self.stamps[self.begin :] = [stamp + off for stamp in self.stamps[self.begin :]]
        self.near_ns, self.dated = stamp_ns, True

    def _guessed(self, at_s: float) -> int:
        """The stamp of a time of the day, on the day of the sentences so far unless there was a pause."""
        stamp_ns = _nearest(at_s, self.near_ns)
        if abs(stamp_ns - self.near_ns) > _PAUSE_NS:
            self.begin, self.dated = len(self.stamps), False
        return stamp_ns


def read(lines: Iterable[str], source: str, near_ns: int) -> tuple[Fixes, bool]:
    """The fixes of a log, and whether their heights are above the ellipsoid rather than the geoid.

    Raises:
        HemislamError: naming `source`: there is no GGA sentence with a place.
    """
    log = _Log(near_ns, near_ns)
    for line in lines:
        log.add(line)
    if not log.places:
        raise HemislamError(f"{source} holds no NMEA sentence GGA with a position; switch it on in the receiver.")
    *place, height, separation = np.array(log.places).T
    ellipsoidal = bool(np.isfinite(separation).all())  # if it is missing once, all heights stay above the geoid
    places = np.column_stack([*place, height + separation if ellipsoidal else height])
    return Fixes.of(log.stamps, places, log.sigmas), ellipsoidal


def _degrees(text: str, side: str) -> float:
    """ddmm.mmmm and N, S, E or W."""
    whole, minutes = divmod(float(text), 100.0)
    return (whole + minutes / 60.0) * {"N": 1.0, "E": 1.0, "S": -1.0, "W": -1.0}[side]


def _seconds(text: str) -> float:
    """hhmmss.ss as seconds of the day."""
    return int(text[:2]) * 3600.0 + int(text[2:4]) * 60.0 + float(text[4:])


def _nearest(at_s: float, near_ns: int) -> int:
    """The stamp with this time of the day that is nearest to another one."""
    day = round(_DAY_S * 1e9)
    at = round(at_s * 1e9)
    return at + round((near_ns - at) / day) * day
