"""Fixes from files. Tests app/georeference/tables.py and app/georeference/fixes.py."""

from pathlib import Path

import numpy as np
import pytest

from app.georeference.ground import Ground
from app.georeference.tables import GEOID, read_fixes
from app.slam.errors import HemislamError

NEAR_NS = 1_700_000_000_000_000_000  # 2023-11-14T22:13:20Z, a Tuesday
H2LID = (
    "GPSTime(sec) Easting(m) Northing(m) H-Ell(m) Heading(deg) Pitch(deg) Roll(deg) Latitude(deg) Longitude(deg)"
    " VEast(m/s) VNorth(m/s) VUp(m/s) Q\n"
)
ROW = " 533843.632 3379901.251 17.899 -4.85 0.78 -0.08 30.5388466765 114.3526809197 0.0 -0.002 -0.001 1\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "fixes.csv"
    path.write_text(text)
    return path


def test_a_table_with_sigmas_is_read_to_the_last_digit_of_its_times(tmp_path: Path) -> None:
    text = "time,lat,lon,height,sigma_e,sigma_n,sigma_u\n" + "".join(
        f"170000000{k}.123456789,48.1{k},11.5,520.{k},0.01,0.02,0.03\n" for k in range(3)
    )
    fixes, height = read_fixes(written(tmp_path, text), NEAR_NS)
    assert fixes.stamps_ns.tolist() == [1_700_000_000_123_456_789 + k * 10**9 for k in range(3)]
    np.testing.assert_array_equal(fixes.places[:, 0], [48.10, 48.11, 48.12])
    np.testing.assert_array_equal(fixes.sigmas[1], [0.01, 0.02, 0.03])
    assert height == "ellipsoidal"


@pytest.mark.parametrize("unit", ["m", "metres", "ellipsoidal", "WGS84", "EPSG:25832", "inside"])
def test_brackets_behind_a_heading_are_no_part_of_it(tmp_path: Path, unit: str) -> None:
    text = f"Time [s];Latitude (°);Longitude [deg];Height ({unit})\n" + "1;48;11;5\n" * 3
    assert read_fixes(written(tmp_path, text), NEAR_NS)[0].places.tolist() == [[48.0, 11.0, 5.0]] * 3


def test_dates_are_read_and_rows_are_brought_in_order_of_time(tmp_path: Path) -> None:
    text = "Time;Latitude [deg];Longitude [deg];Altitude (m)\n" + "".join(
        f"2023-11-14T22:13:2{k}Z;48.1;11.{k};520\n" for k in (2, 0, 1)
    )
    fixes, _ = read_fixes(written(tmp_path, text), NEAR_NS)
    assert fixes.stamps_ns.tolist() == [NEAR_NS + k * 10**9 for k in range(3)]
    assert fixes.places[:, 1].tolist() == [11.0, 11.1, 11.2] and np.isnan(fixes.sigmas).all()


def test_a_walk_across_the_antimeridian_stays_in_one_place(tmp_path: Path) -> None:
    """Taveuni, Fiji. The median of longitudes on both sides lies in Africa."""
    longitudes = (179.99999, -179.99999, 179.99998, -179.99998)
    text = "time,lat,lon,height\n" + "".join(f"{k},-16.8,{lon},5\n" for k, lon in enumerate(longitudes))
    fixes, _ = read_fixes(written(tmp_path, text), NEAR_NS)
    ground = Ground.of(fixes)
    assert ground.centre.crs == "EPSG:32701" and np.ptp(ground.places[:, 0]) == pytest.approx(4.26, abs=0.01)


def test_seconds_of_the_gps_week_become_utc_by_the_recordings_week_and_leap_seconds(tmp_path: Path) -> None:
    # Tuesday 22:13:20 UTC is 2 days and 80000 s into the week, and GPS is 18 s ahead.
    text = H2LID + "".join(f"{2 * 86400 + 80000 + 18 + k}.5{ROW}" for k in range(3))
    fixes, height = read_fixes(written(tmp_path, text), NEAR_NS + 3600 * 10**9)
    assert fixes.stamps_ns.tolist() == [NEAR_NS + 500_000_000 + k * 10**9 for k in range(3)]
    assert (*fixes.places[0, 1:], height) == (114.3526809197, 17.899, "ellipsoidal")


def test_a_log_of_a_receiver_is_recognised_by_its_sentences(tmp_path: Path) -> None:
    line = "$GPGGA,2213{:05.2f},4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,"
    lines = [line.format(20 + k) for k in range(3)]
    path = written(tmp_path, "".join(f"{text}*{checksum(text)}\n" for text in lines))
    fixes, height = read_fixes(path, NEAR_NS + 5 * 10**9)
    assert fixes.stamps_ns[0] == NEAR_NS and height == "ellipsoidal"
    path.write_bytes(b"\xb5\x62\x01\xff\n" + path.read_bytes())  # a binary message of the same receiver
    assert len(read_fixes(path, NEAR_NS)[0]) == 3
    path = written(tmp_path, "".join(f"{text}*{checksum(text)}\n" for text in (x.replace("46.9", "") for x in lines)))
    assert read_fixes(path, NEAR_NS)[1] == GEOID
    path = written(tmp_path, "".join(f"2023-11-14 22:13:20.5 {text}*{checksum(text)}\n" for text in lines))
    assert read_fixes(path, NEAR_NS)[0].stamps_ns[0] == NEAR_NS, "a logger's own times stand before the sentences"


def checksum(sentence: str) -> str:
    value = 0
    for character in sentence[1:].encode():
        value ^= character
    return f"{value:02X}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,lat,lon,height\n1,48,11,5\n", "holds 1 fixes"),
        ("time,lat,lon,height\n" + "1,148,11,5\n" * 3, "swapped: exchange them"),
        ("time,lat,lon,height\n1,48,11,5\n2,95,11,5\n3,48,11,5\n", r"fix 2: the latitude 95.0000° is beyond 90°"),
        ("time,lat,lon,height\n" + "1,4812.5,1134.2,5\n" * 3, r"fix 1: the latitude 4812.5000° .* in degrees"),
        ("time,lat,lon,height\n" + "1,48,11\n" * 3, "row 1 has 3 columns"),
        ("time,lat,lon,height\n" + "1,x,11,5\n" * 3, "`x` is not a number"),
        ("time,lat,lon,height\n" + "noon,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "1700000000000,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "nan,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "9999-01-01,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "1600-01-01T10:00:00Z,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "inf,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ("time,lat,lon,height\n" + "1e999999,48,11,5\n" * 3, "neither Unix seconds nor a date"),
        ('time,lat,"lon,height\n' + "1,48,11,5\n" * 20_000, "a quotation mark without its pair"),
        ("time,lat,lon,height\n" + ",48,11,5\n" * 3, "the time `` is neither Unix seconds nor a date"),
        ("tow,lat,lon,height\n", "holds 0 fixes"),
        ("time,lat,lon,Altitude (ft)\n" + "1,48,11,1700\n" * 3, r"the column `Altitude \(ft\)`; convert it to metres"),
        ("time,lat [rad],lon [rad],height\n" + "1,0.8,0.2,5\n" * 3, "convert it to degrees"),
        ("Time (ms),lat,lon,height\n" + "1,48,11,5\n" * 3, "convert it to seconds"),
        ("tow,lat,lon,height\n1,48,11,5\n,48,11,5\n", "row 2: the time `` is not in GPS seconds"),
        ("tow,lat,lon,height\n" + "1700000000000,48,11,5\n" * 3, "is not in GPS seconds"),
        ("1,2,3,4\n" * 3, "its first line must name the columns"),
        ("", "is empty"),
    ],
)
def test_what_is_no_table_of_fixes_is_refused_in_one_sentence(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(HemislamError, match=words):
        read_fixes(written(tmp_path, text), NEAR_NS)
