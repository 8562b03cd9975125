"""Tables of places with a heading: fixes (CSV, the GNSS/INS table of H2LID), control points, and points of the map."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from app.georeference import nmea
from app.georeference.fixes import Fixes
from app.georeference.reference import ELLIPSOIDAL
from app.slam.arrays import F64
from app.slam.errors import HemislamError
from app.slam.user_text import read_text

GEOID = "orthometric (geoid of the receiver)"
GPS_MINUS_UNIX_S = 18 - 315_964_800
"""To convert Unix to GPS time: the leap seconds since 2017, and the start of the first GPS week."""
WEEK_S = 604_800
MOST_S = 4e9
"""Larger numbers are milliseconds, not seconds."""

_NAMES = {
    "time": ("time", "t", "stamp", "timestamp", "unix", "utc", "time_s", "stamp_s"),
    "week_s": ("gpstime", "gps_time", "tow", "sow"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "height": ("height", "h", "alt", "altitude", "z", "h-ell", "h_m", "height_m"),
    "east": ("e", "east", "easting", "e_m", "east_m"),
    "north": ("n", "north", "northing", "n_m", "north_m"),
    "sigma_e": ("sigma_e", "sigma_east", "sd_e", "sde"),
    "sigma_n": ("sigma_n", "sigma_north", "sd_n", "sdn"),
    "sigma_u": ("sigma_u", "sigma_h", "sigma_up", "sd_u", "sdu", "sd_h"),
    "name": ("name", "id", "point", "label"),
    "x": ("x", "x_m"),
    "y": ("y", "y_m"),
    "z": ("z", "z_m"),
}
"""The kinds of columns, with their headings in small letters without units in brackets."""
_IN = {"time": "seconds", "week_s": "seconds", "latitude": "degrees", "longitude": "degrees"}
"""What the numbers of a kind are in; others are in metres."""
_OTHER_UNITS = re.compile(r"[\(\[]\s*(mm|cm|km|(us[ -]?)?(ft|feet)(us)?|rad|radians|gon|ms|us|µs|ns)\s*[\)\]]")
"""A unit in brackets, in small letters, that is none of these."""


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """A table that was read. columns: (n,) texts by kind; other columns are left out."""

    source: str
    columns: Mapping[str, Sequence[str]]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def has(self, *wanted: str) -> bool:
        return all(name in self.columns for name in wanted)

    def numbers(self, *wanted: str) -> F64:
        """(n, k) numbers of these columns; an empty cell is nan. Raises HemislamError: a word is not a number."""
        out = np.full((len(self), len(wanted)), np.nan)
        for at, name in enumerate(wanted):
            for row, word in enumerate(self.columns[name]):
                try:
                    out[row, at] = float(word) if word else np.nan
                except ValueError:
                    raise HemislamError(
                        f"{self.source}, row {row + 1}: `{word[:40]}` is not a number ({name})."
                    ) from None
        return out


def read_table(path: Path, *wanted: str) -> NamedColumns:
    """As `table_of`, from a file. Raises HemislamError also if the file cannot be read."""
    return table_of(read_text(path, "save it as CSV in UTF-8").splitlines(), str(path), *wanted)


def table_of(lines: Sequence[str], source: str, *wanted: str) -> NamedColumns:
    """A table with a heading, separated by commas, semicolons or spaces; `#` begins a comment.

    Args:
        source: name in error messages. wanted: the columns needed, in case a heading may mean several things.

    Raises:
        HemislamError: the table has no heading, a quotation mark is not closed, a column is in another unit than it
            must be, or a row is incomplete.
    """
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise HemislamError(f"{source} is empty.")
    separator = next((one for one in ",;\t" if one in rows[0]), None)
    if separator:
        try:
            cells = [[cell.strip() for cell in row] for row in csv.reader(rows, delimiter=separator)]
        except csv.Error as error:
            raise HemislamError(
                f"{source} is not a table ({error}); look for a quotation mark without its pair."
            ) from None
    else:
        cells = [row.split() for row in rows]
    titles = [_plain(title) for title in cells[0]]
    known: dict[str, int] = {}
    for what in dict.fromkeys([*wanted, *_NAMES]):
        found = [at for at, title in enumerate(titles) if title in _NAMES[what] and at not in known.values()]
        if found:
            known[what] = found[0]
        if found and _OTHER_UNITS.search(cells[0][found[0]].lower()):
            unit = _IN.get(what, "metres")
            raise HemislamError(f"{source} has the column `{cells[0][found[0]][:40]}`; convert it to {unit}.")
    body = cells[1:]
    if cut := next((row for row, one in enumerate(body, 1) if len(one) < len(titles)), 0):
        raise HemislamError(f"{source}, row {cut} has {len(body[cut - 1])} columns, but its heading {len(titles)}.")
    return NamedColumns(source, {what: [row[at] for row in body] for what, at in known.items()})


def read_fixes(path: Path, near_ns: int) -> tuple[Fixes, str]:
    """Fixes of a file: NMEA sentences, CSV of time, latitude, longitude, height, or the GNSS/INS table of H2LID.

    Args:
        near_ns: a time of the recording; gives the day of NMEA sentences and the week of GPS seconds.

    Returns:
        The fixes, and what their heights are above.

    Raises:
        HemislamError: the file cannot be read, or is none of these.
    """
    text = read_text(path, "give NMEA or CSV", errors="replace")  # a log may hold binary messages beside the sentences
    lines = text.splitlines()
    if any(re.search(r"\$G\w{4},", line) for line in lines[:50]):  # loggers may put times before a sentence
        fixes, ellipsoidal = nmea.read(lines, str(path), near_ns)
        return fixes.sound(str(path)), ELLIPSOIDAL if ellipsoidal else GEOID
    table = read_table(path, "time", "latitude", "longitude", "height")
    if not table.has("latitude", "longitude", "height") or not (table.has("time") or table.has("week_s")):
        raise HemislamError(
            f"{path} holds no fixes; its first line must name the columns time, latitude, longitude, height"
            " (and sigma_e, sigma_n, sigma_u, if known), or it must hold NMEA sentences."
        )
    stamps = [_stamp(table, word) for word in table.columns["time"]] if table.has("time") else _of_week(table, near_ns)
    names = ("sigma_e", "sigma_n", "sigma_u")
    sigmas = table.numbers(*names) if table.has(*names) else None
    fixes = Fixes.of(stamps, table.numbers("latitude", "longitude", "height"), sigmas)
    return fixes.sound(str(path)), ELLIPSOIDAL


def _plain(title: str) -> str:
    """A heading in small letters, without a unit in brackets."""
    return re.sub(r"[\(\[].*", "", title).strip().lower()


def _stamp(table: NamedColumns, word: str) -> int:
    """Unix seconds with any number of digits, or ISO 8601 (UTC unless it says otherwise), as ns."""
    try:
        return _nanoseconds(word)
    except (ValueError, ArithmeticError):
        raise HemislamError(
            f"{table.source}: the time `{word[:40]}` is neither Unix seconds nor a date such as 2026-05-01T10:00:00Z."
        ) from None


def _nanoseconds(word: str) -> int:
    """Raises ValueError or ArithmeticError: it is not a time, or not within 292 years of 1970."""
    try:
        return int(np.int64(int(Decimal(word).scaleb(9).to_integral_value())))
    except InvalidOperation:
        date = np.datetime64(word.removesuffix("Z"), "ns")
        if np.isnat(date) or date.astype("M8[s]") != np.datetime64(word.removesuffix("Z"), "s"):  # it wraps around
            raise ValueError from None
        return int(date.astype(np.int64))


def _of_week(table: NamedColumns, near_ns: int) -> list[int]:
    """Seconds of the GPS week, in the week that is nearest to a time."""
    seconds = table.numbers("week_s")[:, 0]
    if not len(seconds):
        return []
    if (wrong := ~(np.abs(seconds) < MOST_S)).any():
        row = int(np.argmax(wrong))
        word = table.columns["week_s"][row][:40]
        raise HemislamError(f"{table.source}, row {row + 1}: the time `{word}` is not in GPS seconds.")
    now = near_ns * 1e-9 + GPS_MINUS_UNIX_S
    weeks = round((now - float(seconds[0])) / WEEK_S)
    start = (weeks * WEEK_S - GPS_MINUS_UNIX_S) * 1_000_000_000
    return [start + round(value * 1e9) for value in seconds.tolist()]
