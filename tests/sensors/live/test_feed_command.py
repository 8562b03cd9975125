"""`hemislam feed` explains itself, and refuses impossible input with one sentence.

Tests app/__main__.py, app/cli/feed.py, app/cli/replay.py, app/cli/serve.py.
"""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from app.__main__ import cli
from tests.sensors.live import ports

SAMPLE = str(Path(__file__).resolve().parents[3] / "sample_data" / "cloister.mcap")


def test_it_plays_packets_whether_or_not_anybody_listens() -> None:
    one, two, three = ports.free(3)
    to, beside = f"rsbpearl://127.0.0.1:{one},{two}", f"imu-udp://127.0.0.1:{three}"
    done = CliRunner().invoke(
        cli, ["feed", SAMPLE, "--to", to, "--imu-to", beside, "--speed", "0", "--duration", "0.5"]
    )
    assert done.exit_code == 0, done.output
    assert "packets sent" in done.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "http://x"], "is not a live source"),
        (["--to", "imu-udp://127.0.0.1:1"], "Play it out to rsbpearl://, airy://, mid360:// or foxglove://"),
        (["--to", "rsbpearl://127.0.0.1:1,2?clock=host"], "the receiver chooses the clock"),
        (["--to", "foxglove://127.0.0.1:1", "--speed", "-1"], "is negative"),
        (["--to", "foxglove://127.0.0.1:1", "--imu-to", "imu-udp://127.0.0.1:1"], "applies to packets only"),
    ],
)
def test_what_cannot_be_is_refused(arguments: list[str], words: str) -> None:
    done = CliRunner().invoke(cli, ["feed", SAMPLE, *arguments])
    assert done.exit_code == 2
    assert words in done.output
