"""A recording, or a part of it: reading ahead in a thread gives the same entries as reading without one."""

from pathlib import Path

import pytest

from app.mapping.feed import FileFeed
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "cloister.mcap"


def read(path: Path, *, read_ahead: bool) -> tuple[list[bytes], str]:
    """The points of every measurement, and what ended it."""
    feed, clouds, ended = FileFeed(path, Params(), 0.0, 3.0, read_ahead=read_ahead), [], ""
    try:
        while (entry := feed.next()) is not None:
            assert isinstance(entry, Measurement)
            clouds.append(entry.scan.points.tobytes() + entry.imu.accel.tobytes())
    except HemislamError as error:
        ended = str(error)
    assert feed.next() is None, "after the end nothing comes"
    feed.close()
    return clouds, ended


def test_what_is_read_ahead_is_the_same() -> None:
    ahead, ended = read(SAMPLE, read_ahead=True)
    assert len(ahead) > 25 and not ended
    assert read(SAMPLE, read_ahead=False) == (ahead, "")


def test_a_cut_is_reported_after_the_same_measurements(tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    whole = SAMPLE.read_bytes()
    cut.write_bytes(whole[: len(whole) // 20])
    ahead, ended = read(cut, read_ahead=True)
    assert ahead and ended
    assert read(cut, read_ahead=False) == (ahead, ended)


@pytest.mark.parametrize(("part", "end"), [((2.0, 3.0), 5.0), ((80.0, 60.0), 83.9), ((2.0, None), 83.9)])
def test_it_is_known_where_a_part_ends_and_how_many_scans_it_has(part: tuple[float, float | None], end: float) -> None:
    feed = FileFeed(SAMPLE, Params(), *part)
    feed.close()
    assert feed.info.end_s == pytest.approx(end, abs=0.05)
    assert feed.info.frames == pytest.approx(10 * (end - part[0]), abs=1)


@pytest.mark.parametrize("count", [0, 3])
def test_a_feed_is_closed_while_it_reads(count: int) -> None:
    feed = FileFeed(SAMPLE, Params(), read_ahead=True)
    for _ in range(count):
        assert feed.next() is not None
    feed.close()
