"""NMEA 0183 sentences of a receiver: GGA for places, GST for their sigmas, RMC and ZDA for the day."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import reduce
from operator import xor

from app.georeference.fixes import Fixes
from app.slam.errors import HemislamError

_DAY_S = 86_400.0
_NOBODY = (float("nan"),) * 3


@dataclass(slots=True)
class Sentences:
    """Collects sentences, in the order of the receiver.

    Attributes:
        near_ns: a time within half a day, for sentences before the first one with a date.
        separated: whether every place came with the geoid's height, so that heights are above the ellipsoid.
    """

    near_ns: int
    separated: bool = True
    _places: list[tuple[float, float, float]] = field(default_factory=list)
    _stamps: list[int] = field(default_factory=list)
    _at: list[float] = field(default_factory=list)  # s of the day
    _sigmas: dict[float, tuple[float, float, float]] = field(default_factory=dict)

    def add(self, line: str) -> None:
        """One line; anything but a whole sentence with the right checksum is ignored."""
        body, star, checksum = line.strip().rpartition("$")[2].partition("*")
        if not star or checksum[:2].upper() != f"{reduce(xor, body.encode(), 0):02X}":
            return
        kind, *words = body.split(",")
        try:
            if kind.endswith("GGA") and len(words) > 10 and int(words[5] or 0) > 0:
                self._place(words)
            elif kind.endswith("GST") and len(words) > 7 and words[5]:
                north, east, up = (float(word) for word in words[5:8])
                self._sigmas[_seconds(words[0])] = east, north, up
            elif kind.endswith("RMC") and len(words) > 8 and words[1] == "A" and words[8]:
                self._day(datetime.strptime(words[8], "%d%m%y"), words[0])
            elif kind.endswith("ZDA") and len(words) > 3 and words[3]:
                self._day(datetime.strptime("".join(words[1:4]), "%d%m%Y"), words[0])
        except ValueError:
            return

    def fixes(self) -> Fixes:
        """All so far."""
        sigmas = [self._sigmas.get(at, _NOBODY) for at in self._at]
        return Fixes.of(self._stamps, self._places, sigmas)

    def _place(self, words: list[str]) -> None:
        latitude, longitude = _degrees(words[1], words[2]), _degrees(words[3], words[4])
        height, separation = float(words[8]), words[10]
        self.separated = self.separated and bool(separation)
        at = _seconds(words[0])
        self._places.append((latitude, longitude, height + float(separation or 0.0)))
        self._stamps.append(_nearest(at, self.near_ns))
        self._at.append(at)
        self.near_ns = self._stamps[-1]

    def _day(self, day: datetime, time: str) -> None:
        at = round(_seconds(time) * 1e9)
        stamp_ns = round(day.replace(tzinfo=UTC).timestamp()) * 1_000_000_000 + at
        off = round((stamp_ns - _nearest(at * 1e-9, self.near_ns)) / (_DAY_S * 1e9)) * round(_DAY_S * 1e9)
        if off:  # the day was guessed so far
            self._stamps = [stamp + off for stamp in self._stamps]
        self.near_ns = stamp_ns


def read(lines: Iterable[str], source: str, near_ns: int) -> tuple[Fixes, bool]:
    """The fixes of a log, and whether their heights are above the ellipsoid rather than the geoid.

    Raises:
        HemislamError: naming `source`: there is no GGA sentence with a place.
    """
    sentences = Sentences(near_ns)
    for line in lines:
        sentences.add(line)
    fixes = sentences.fixes()
    if not len(fixes):
        raise HemislamError(f"{source} holds no NMEA sentence GGA with a position; switch it on in the receiver.")
    return fixes, sentences.separated


def _degrees(text: str, side: str) -> float:
    """ddmm.mmmm and N, S, E or W."""
    whole, minutes = divmod(float(text), 100.0)
    return (whole + minutes / 60.0) * (-1.0 if side in "SW" else 1.0)


def _seconds(text: str) -> float:
    """hhmmss.ss as seconds of the day."""
    return int(text[:2]) * 3600.0 + int(text[2:4]) * 60.0 + float(text[4:])


def _nearest(at_s: float, near_ns: int) -> int:
    """The stamp with this time of the day that is nearest to another one."""
    day = round(_DAY_S * 1e9)
    at = round(at_s * 1e9)
    return at + round((near_ns - at) / day) * day
