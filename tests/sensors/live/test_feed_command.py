"""`hemislam feed` explains itself, and refuses impossible input with one sentence.

Tests app/__main__.py, app/cli/feed.py, app/cli/replay.py, app/cli/serve.py.
"""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from app.__main__ import cli
from tests.sensors import rig
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


class Listener:
    """A Foxglove server with a client, without a port."""

    def __init__(self, *_: object) -> None:
        self.number = 0

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None: ...

    def wait_for_subscribers(self, _: float) -> bool:
        return True

    def publish(self, *_: object) -> None:
        self.number += 1


@pytest.mark.parametrize("scheme", ["mid360", "foxglove"])
def test_it_says_how_many_messages_it_could_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    monkeypatch.setattr("app.sensors.live.feed.FoxgloveServer", Listener)
    path = rig.write(tmp_path / "walk", rig.walk(turns=20, columns=20), "sqlite3")
    arguments = ["feed", str(path), "--to", f"{scheme}://127.0.0.1", "--speed", "0"]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0 and "cannot be read" not in done.output, done.output
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database, database:
        of_clouds = "topic_id = (SELECT id FROM topics WHERE name = '/points')"
        database.execute(
            f"UPDATE messages SET data = x'0102' WHERE id IN"
            f" (SELECT id FROM messages WHERE {of_clouds} ORDER BY timestamp LIMIT 2 OFFSET 12)"
        )
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0 and "not sent: at least 2; the first: " in done.output, done.output


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
