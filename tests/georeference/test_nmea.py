"""NMEA sentences of a receiver. Oracle: the example quoted in every description of NMEA."""

import math

import pytest

from app.georeference import nmea
from app.slam.errors import HemislamError

GGA = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"
DAY_S = 86_400


def test_the_usual_example_is_munich_at_592_metres_above_the_ellipsoid() -> None:
    fixes, ellipsoidal = nmea.read([GGA], "log", 0)
    assert fixes.places[0].tolist() == pytest.approx([48.1173, 11.516667, 592.3], abs=1e-6) and ellipsoidal


def test_the_day_is_that_of_the_recording_also_across_midnight() -> None:
    at = 12 * 3600 + 35 * 60 + 19
    for day, near in ((19_000, 19_000 * DAY_S + 50_000), (19_001, 19_001 * DAY_S + 100), (18_999, 19_000 * DAY_S)):
        fixes, _ = nmea.read([GGA], "log", near * 10**9)
        assert abs(int(fixes.stamps_ns[0]) - near * 10**9) <= DAY_S // 2 * 10**9
        assert (int(fixes.stamps_ns[0]) // 10**9 - at) % DAY_S == 0, day


def test_a_sentence_with_the_date_overrides_the_recordings_day() -> None:
    rmc = "$GPRMC,123520,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*60"
    fixes, _ = nmea.read([GGA, rmc, GGA], "log", 1_700_000_000 * 10**9)
    assert (fixes.stamps_ns == 764_426_119 * 10**9).all()  # 1994-03-23T12:35:19Z


def test_the_date_of_a_receiver_without_a_fix_does_not_count() -> None:
    """After a cold start it is that of its own clock."""
    void = "$GPRMC,000010.00,V,,,,,,,060180,,,N*73"
    fixes, _ = nmea.read([GGA, void], "log", 764_426_000 * 10**9)
    assert (fixes.stamps_ns == 764_426_119 * 10**9).all()


def sentence(body: str) -> str:
    """With its checksum."""
    value = 0
    for character in body.encode():
        value ^= character
    return f"${body}*{value:02X}"


@pytest.mark.parametrize("void", ["GPRMC,000010.00,V,,,,,,,060180,,,N", "GPGGA,000010.00,,,,,0,00,99.99,,,,,,"])
def test_a_date_of_zda_counts_only_while_there_is_a_fix(void: str) -> None:
    cold, warm = sentence("GPZDA,000010.00,06,01,1980,00,00"), sentence("GPZDA,123519.00,23,03,1994,00,00")
    day_before = (764_426_119 - DAY_S) * 10**9
    for lines, near_ns in (
        ([sentence(void), cold, GGA], 764_426_000 * 10**9),
        ([GGA, warm, sentence(void), cold], day_before),
        ([warm, GGA], day_before),
        ([cold, sentence(void), GGA], 764_426_000 * 10**9),
        ([cold, warm, GGA, sentence(void), cold], day_before),
    ):
        fixes, _ = nmea.read(lines, "log", near_ns)
        assert (fixes.stamps_ns == 764_426_119 * 10**9).all()


@pytest.mark.parametrize(
    "absurd",
    [
        "GPZDA,123519.00,23,03,9999,00,00",
        "GPZDA,123519.00,23,03,0001,00,00",
        "GPGGA,1235inf,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        "GPGGA,123520,4807.038,,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
        "GPGGA,123520,4807.038,N,01131.000,X,1,08,0.9,545.4,M,46.9,M,,",
    ],
)
def test_a_sentence_that_cannot_be_is_ignored_though_its_checksum_is_right(absurd: str) -> None:
    for lines in ([GGA, sentence(absurd), GGA], [sentence(absurd), GGA, GGA]):
        fixes, _ = nmea.read(lines, "log", 764_426_000 * 10**9)
        assert (fixes.stamps_ns == 764_426_119 * 10**9).all() and fixes.places[:, 0] == pytest.approx(48.1173)


def test_sigmas_come_from_gst_and_belong_to_the_fix_of_the_same_time() -> None:
    fixes, _ = nmea.read([GGA, sentence("GPGST,123519,0.006,0.023,0.020,273.6,0.023,0.020,0.031")], "log", 0)
    assert fixes.sigmas[0].tolist() == [0.020, 0.023, 0.031]  # GST names north first


@pytest.mark.parametrize("gst_first", [False, True])
def test_sigmas_are_those_of_the_same_day(gst_first: bool) -> None:
    """A log that was left on over days has each time of the day again, and some without a fix or without sigmas."""
    lines, order = [], -1 if gst_first else 1
    for day, sigma in ((19, 0.5), (20, None), (21, 0.01), (22, 0.02)):
        lines.append(sentence(f"GPZDA,123518.00,{day},03,1994,00,00"))
        lines += [GGA, sentence(f"GPGST,123519,1,1,1,0,{sigma},{sigma},{sigma}")][::order] if sigma else [GGA]
        lines.append(sentence(GGA[1:-3].replace("123519", "133519")))
    fixes, _ = nmea.read(lines, "log", 764_426_119 * 10**9)
    assert fixes.sigmas[:, 0].tolist() == pytest.approx(
        [0.5, *[math.nan] * 3, 0.01, math.nan, 0.02, math.nan], nan_ok=True
    )


def test_heights_of_one_log_are_all_above_the_same_surface() -> None:
    """A receiver that leaves the geoid's height out once would lift this fix by 47 m off its neighbours."""
    without = "$GPGGA,123520,4807.038,N,01131.000,E,1,08,0.9,545.4,M,,M,,*58"
    fixes, ellipsoidal = nmea.read([GGA, without, GGA], "log", 0)
    assert fixes.places[:, 2].tolist() == [545.4] * 3 and not ellipsoidal


@pytest.mark.parametrize("line", [GGA[:-1] + "8", GGA.replace(",1,08", ",0,08"), GGA[:30], "noise", ""])
def test_a_wrong_checksum_a_cut_line_or_no_fix_give_nothing(line: str) -> None:
    with pytest.raises(HemislamError, match="no NMEA sentence GGA"):
        nmea.read([line], "log", 0)


def second(at: int, date: str = "", *, last: str = "") -> list[str]:
    """GGA at 10:00 and so many seconds, after RMC with a date, before one with another."""
    time = f"10{at // 60:02d}{at % 60:02d}.00"
    rmc = [sentence(f"GPRMC,{time},A,4807.038,N,01131.000,E,0.4,84.4,{day},,") if day else "" for day in (date, last)]
    return [rmc[0], sentence(f"GPGGA,{time},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"), rmc[1]]


WALK_NS = 1_711_188_000 * 10**9
"""2024-03-23T10:00:00Z."""


@pytest.mark.parametrize("wrong", ["070804", "220324", "240324"], ids=["1024 weeks early", "a day early", "a day late"])
@pytest.mark.parametrize("when", [(0,), (5,), (9,), (7, 8, 9), (0, 1, 2)], ids=str)
@pytest.mark.parametrize("before", [True, False], ids=["date first", "date last"])
def test_a_wrong_date_does_not_move_fixes_of_the_walk(wrong: str, when: tuple[int, ...], before: bool) -> None:
    dates = [wrong if at in when else "230324" for at in range(10)]
    lines = [second(at, date) if before else second(at, last=date) for at, date in enumerate(dates)]
    fixes, _ = nmea.read([line for one in lines for line in one], "log", WALK_NS + 3 * 10**9)
    assert [(stamp - WALK_NS) / 1e9 for stamp in fixes.stamps_ns.tolist()] == list(range(10))


@pytest.mark.parametrize("walk", [0, 4])
@pytest.mark.parametrize("before", [True, False], ids=["date first", "date last"])
def test_a_log_of_several_days_keeps_each_on_its_own(walk: int, before: bool) -> None:
    """As of a logger that appends to its file."""
    days = {0: range(5), 4: range(120, 125)}
    lines: list[str] = []
    for day, seconds in days.items():
        for at in seconds:
            date = f"{23 + day}0324"
            lines += second(at, date) if before else second(at, last=date)
    fixes, _ = nmea.read(lines, "log", WALK_NS + walk * DAY_S * 10**9)
    expected = [day * DAY_S + at for day, seconds in days.items() for at in seconds]
    assert [(stamp - WALK_NS) / 1e9 for stamp in fixes.stamps_ns.tolist()] == expected
