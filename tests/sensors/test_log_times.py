"""Log times made wrong by a flipped bit or a recorder's clock do not affect other messages."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from app.sensors import log_times
from app.sensors.findings import Finding
from app.sensors.recording import open_recording
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors import rig

S = 1_000_000_000
TURNS = 100
LAYOUT = rig.Layout(absolute=False, fields=rig.RELATIVE, header="first")
Wrong = list[tuple[str, float, int]]
"""Topic, place among its messages, 0-1, and by how many seconds its log time is wrong."""


@cache
def right(ros: int) -> tuple[rig.Entry, ...]:
    return tuple(rig.walk(TURNS, LAYOUT, columns=4, ros=ros))


def walk(wrong: Wrong, ros: int = 2) -> list[rig.Entry]:
    entries = list(right(ros))
    for topic, place, by_s in wrong:
        numbers = [number for number, entry in enumerate(entries) if entry[0] == topic]
        number = numbers[min(round(place * len(numbers)), len(numbers) - 1)]
        entries[number] = (topic, entries[number][1] + by_s * S, entries[number][2])
    return entries


def written(path: Path, container: str, wrong: Wrong) -> Path:
    entries = walk(wrong, 1 if container == "bag" else 2)
    if container in ("unchunked", "single"):
        return rig.write_mcap(path.with_suffix(".mcap"), entries, chunk_size=1, use_chunking=container == "single")
    return rig.write(path, entries, container)


def read(path: Path) -> tuple[float, int, int, list[Finding]]:
    """Length in s, scans of all, scans from 5 to 9 s, and what is not fine about log times and clocks."""
    with open_recording(path, Params()) as recording:
        parts = [list(recording.measurements()), list(recording.measurements(5.0, 4.0))]
        of_times = [f for f in recording.findings if f.subject in ("log times", "clocks", "clock leap")]
        return (
            recording.duration_s,
            *(sum(isinstance(entry, Measurement) for entry in part) for part in parts),
            [finding for finding in of_times if finding.verdict != "fine"],
        )


@pytest.mark.parametrize("container", ["small-chunks", "mcap", "single", "unchunked", "bag", "bare-db3", "sqlite3"])
@pytest.mark.parametrize(
    "wrong",
    [
        [("/points", 0.5, 3600)],
        [("/points", 0.5, -3600), ("/imu", 0.5, -3600)],
        [("/points", 0.5, 3600), ("/imu", 0.5, 3600)],
        [("/points", place, 3600) for place in (0.2, 0.7)] + [("/imu", place, -3600) for place in (0.3, 0.7)],
        [("/points", 0.0, 3600)],
        [("/imu", 1.0, 3600)],
    ],
)
def test_a_few_wild_log_times_spoil_no_other_message(tmp_path: Path, container: str, wrong: Wrong) -> None:
    duration_s, scans, part, told = read(written(tmp_path / "walk", container, wrong))
    left_out = sum(topic == "/points" for topic, _, _ in wrong) if container in ("bag", "bare-db3", "sqlite3") else 0
    assert duration_s == pytest.approx(TURNS / 10, abs=0.2)
    assert scans == TURNS - left_out and 40 - left_out <= part <= 40
    assert [finding.subject for finding in told] == ["log times"]
    assert f"for {len(wrong)} of " in told[0].text
    assert ("left out" in told[0].text) == (container in ("bag", "bare-db3", "sqlite3"))


@pytest.mark.parametrize("container", ["small-chunks", "unchunked"])
def test_messages_that_were_written_in_another_order_are_no_damage(tmp_path: Path, container: str) -> None:
    entries = walk([])
    entries[400:402] = entries[401], entries[400]
    path = tmp_path / "walk.mcap"
    unchunked = container == "unchunked"
    path = rig.write_mcap(path, entries, use_chunking=False) if unchunked else rig.write(path, entries, container)
    assert read(path)[1:] == (TURNS, 40, [])


def test_the_latest_log_time_that_an_mcap_can_hold_is_wild_too(tmp_path: Path) -> None:
    entries = walk([])
    topic, _, sent = entries.pop()
    path = rig.write_mcap(tmp_path / "walk.mcap", [*entries, (topic, 2**64 - 1, sent)], chunk_size=1)
    assert read(path)[:3] == (pytest.approx(TURNS / 10, abs=0.2), TURNS, 40)


def test_pauses_and_clocks_that_are_set_are_not_wild() -> None:
    steady = np.arange(500, dtype=np.int64) * S // 100 + rig.START_NS
    sparse = np.arange(60, dtype=np.int64) * 15 * S + rig.START_NS
    for times in (
        steady,
        sparse,
        np.concatenate([steady, steady + 3600 * S]),
        np.concatenate([steady, steady - 9 * S]),
    ):
        assert log_times.mended(times) == {}
        assert log_times.sound_span(times) == (times.min(), times.max() + 1, 0)


@pytest.mark.parametrize("container", ["small-chunks", "bag", "bare-db3"])
@pytest.mark.parametrize("log_ns", [0, rig.START_NS])
def test_log_times_that_stand_still_are_taken_for_no_clock(tmp_path: Path, container: str, log_ns: int) -> None:
    """As a program leaves them that writes every message with one log time."""
    entries = [(topic, log_ns, message) for topic, _, message in walk([], 1 if container == "bag" else 2)]
    path = rig.write(tmp_path / "walk", entries, container)
    with open_recording(path, Params()) as recording:
        (finding,) = [finding for finding in recording.findings if finding.subject == "clocks"]
        used = [entry for entry in recording.measurements() if isinstance(entry, Measurement)]
    assert (
        finding.verdict == "needs you" and not finding.option and "write the recording with log times" in finding.text
    )
    assert len(used) == TURNS
