"""NMEA 0183 sentences of a receiver: GGA for places, GST for their sigmas, RMC and ZDA for the day."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np

from app.georeference.fixes import Fixes
from app.slam.errors import HemislamError

_DAY_NS = 86_400_000_000_000
_YEARS = range(1980, 2200)
"""Valid years: since GPS time began, and as far as stamps in ns reach."""
_PAUSE_NS = 60_000_000_000
"""After a longer pause, the day may be another one."""
_NOBODY = (float("nan"),) * 3


@dataclass(frozen=True, slots=True)
class _Sentence:
    """The content of a sentence: a place, sigmas, or the day.

    Attributes:
        at_ns: time of the day.
        place: latitude and longitude in degrees, height above the geoid, and the geoid's height above the ellipsoid
            (nan if not stated), m.
        sigmas: of the place at the same time, m to the east, north and up. day_ns: the start of the day.
    """

    at_ns: int
    place: tuple[float, float, float, float] | None = None
    sigmas: tuple[float, float, float] | None = None
    day_ns: int | None = None


def read(lines: Iterable[str], source: str, near_ns: int) -> tuple[Fixes, bool]:
    """The fixes of a log, and whether their heights are above the ellipsoid rather than the geoid.

    Args:
        near_ns: a time of the walk, which gives the day of sentences without a date.

    Raises:
        HemislamError: naming `source`: there is no GGA sentence with a place.
    """
    sentences = _parsed(lines)
    stamped = list(zip(_stamps(sentences, near_ns), sentences, strict=True))
    sigmas = {stamp: one.sigmas for stamp, one in stamped if one.sigmas}
    fixes = [(*one.place, *sigmas.get(stamp, _NOBODY)) for stamp, one in stamped if one.place]
    if not fixes:
        raise HemislamError(f"{source} holds no NMEA sentence GGA with a position; switch it on in the receiver.")
    table = np.array(fixes)
    place, height, separation = table[:, :2], table[:, 2], table[:, 3]
    ellipsoidal = bool(np.isfinite(separation).all())  # if it is missing once, all heights stay above the geoid
    places = np.column_stack([place, height + separation if ellipsoidal else height])
    return Fixes.of([stamp for stamp, one in stamped if one.place], places, table[:, 4:]), ellipsoidal


def _parsed(lines: Iterable[str]) -> list[_Sentence]:
    """The sentences that count, in their order.

    Places without a fix are left out, and so are dates, which may be those of the receiver's own clock. A date before
    the first GGA or RMC counts if that has a fix.
    """
    sentences = list[_Sentence]()
    fixed: bool | None = None  # whether the last GGA or RMC has a fix
    for kind, *words in _sound(lines):
        before = fixed
        with contextlib.suppress(ValueError, OverflowError, KeyError):  # what makes no sense is ignored
            match kind[-3:], words:
                case "GGA", [at, latitude, north, longitude, east, quality, _, _, height, _, separation, *_]:
                    if fixed := int(quality or 0) > 0:
                        place = _degrees(latitude, north), _degrees(longitude, east)
                        heights = float(height), float(separation or "nan")
                        sentences.append(_Sentence(_time_ns(at), place=(*place, *heights)))
                case "GST", [at, _, _, _, _, north, east, up, *_] if north:
                    sentences.append(_Sentence(_time_ns(at), sigmas=(float(east), float(north), float(up))))
                case "RMC", [at, status, _, _, _, _, _, _, date, *_]:
                    if (fixed := status == "A") and date:
                        sentences.append(_Sentence(_time_ns(at), day_ns=_day_ns(date, "%d%m%y")))
                case "ZDA", [at, day, month, year, *_] if year and fixed is not False:
                    sentences.append(_Sentence(_time_ns(at), day_ns=_day_ns(day + month + year, "%d%m%Y")))
        if before is None and fixed is False:
            sentences = [one for one in sentences if one.day_ns is None]
    return sentences


def _sound(lines: Iterable[str]) -> Iterator[list[str]]:
    """The words of each complete sentence with the right checksum. Loggers may put a time before a sentence."""
    for line in lines:
        body, star, checksum = line.strip().rpartition("$")[2].partition("*")
        if star and checksum[:2].upper() == f"{reduce(xor, body.encode(), 0):02X}":
            yield body.split(",")


def _stamps(sentences: Sequence[_Sentence], walk_ns: int) -> list[int]:
    """When each sentence was sent.

    Between pauses, one date gives the day of all sentences; of dates that contradict each other, the one nearer to the
    walk. Without a date, the day is the nearest to the time before the pause, at first to the walk.
    """
    stamps, last_ns, begin, dated = list[int](), walk_ns, 0, False
    for number, one in enumerate(sentences):
        stamp = one.at_ns + round((last_ns - one.at_ns) / _DAY_NS) * _DAY_NS
        if abs(stamp - last_ns) > _PAUSE_NS:
            begin, dated = number, False
        if one.day_ns is not None:
            stated = one.day_ns + one.at_ns
            if not dated or abs(stated - walk_ns) < abs(stamp - walk_ns):
                stamps[begin:] = [earlier + stated - stamp for earlier in stamps[begin:]]
                stamp, dated = stated, True
        stamps.append(stamp)
        last_ns = stamp
    return stamps


def _degrees(text: str, side: str) -> float:
    """ddmm.mmmm and N, S, E or W."""
    whole, minutes = divmod(float(text), 100.0)
    return (whole + minutes / 60.0) * {"N": 1.0, "E": 1.0, "S": -1.0, "W": -1.0}[side]


def _time_ns(text: str) -> int:
    """hhmmss.ss as time of the day."""
    return round((int(text[:2]) * 3600.0 + int(text[2:4]) * 60.0 + float(text[4:])) * 1e9)


def _day_ns(text: str, form: str) -> int:
    """The begin of a day. Raises ValueError: there is none, or it cannot be one of a log."""
    day = datetime.strptime(text, form).replace(tzinfo=UTC)
    if day.year not in _YEARS:
        raise ValueError
    return round(day.timestamp()) * 1_000_000_000
