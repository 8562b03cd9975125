"""kill -9 of the real server: a reopened session has lost at most the last second, and reaches the same result."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from test_rewind import SAMPLE, Bench

from app.mapping.checkpoints import DEFAULT_BYTES
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.server.protocol import Save, Seek, SetParams
from app.slam.params import Params

LENGTH_S = 7.0
CHANGED_AT = 15
CHANGE = {"ground.sigma": 0.02, "filter.max_iterations": 3}
SETTINGS = ("loops.enabled=false",)
FILES = ("trajectory.tum", "map.ply")
LOSS_S = 1.0
PATIENCE_S = 120.0

State = dict[str, Any]


class Server:
    """`hemislam serve` in a session of its own, and who uses it over REST."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        errors = folder / "errors.txt"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "app", "serve", *arguments, "--paused", "--no-browser", "--port", "0"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(SAMPLE.parents[1])},
            stdout=subprocess.PIPE,
            stderr=errors.open("a"),
            text=True,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert "hemislam is at" in line, errors.read_text()
        self._address = line.split()[3]

    def ask(self, method: str, path: str, json: object = None) -> httpx.Response:
        answer = httpx.request(method, f"{self._address}api/{path}", json=json, timeout=PATIENCE_S)
        assert answer.status_code < 300, answer.text
        return answer

    def until(self, wanted: Callable[[State], bool]) -> State:
        deadline = time.monotonic() + PATIENCE_S
        while not wanted(state := self.ask("GET", "state").json()):
            assert time.monotonic() < deadline, state
            time.sleep(0.02)
        return state

    def ready(self) -> State:
        """Where the session is, once it is anywhere."""
        return self.until(
            lambda s: s["recording"] is not None and s["progress"] is None and s["transport"]["frame"] >= 0
        )

    def go_to(self, frame: int) -> None:
        self.ask("POST", "transport", {"action": "seek", "frame": frame})
        self.until(lambda s: s["transport"]["frame"] == frame and s["progress"] is None)

    def exports(self) -> dict[str, bytes]:
        return {name: self.ask("GET", f"export/{name}").content for name in FILES}

    def kill(self, *, engine_too: bool) -> None:
        if not engine_too:
            self._process.kill()
        elif self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process.stdout.close()  # type: ignore[union-attr]  # it is a pipe


@pytest.fixture(scope="module")
def never_killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, bytes]]:
    """The last frame, and what a session that nobody kills ends with."""

    def opener(path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
        return open_session(path, params, 0.0, LENGTH_S, truth=truth, checkpoint_bytes=DEFAULT_BYTES)

    bench, folder = (
        Bench(resolve_params(SAMPLE, None, None, list(SETTINGS)), opener, SAMPLE),
        tmp_path_factory.mktemp("e"),
    )
    last = bench.do(Seek(10_000)).transport.frame
    bench.do(Seek(CHANGED_AT), SetParams(CHANGE), Seek(last))
    bench.controller.handle(Save(folder))
    bench.controller.close()
    return last, {name: (folder / name).read_bytes() for name in FILES}


def killed_while_it_plays(server: Server, until_frame: int, *, engine_too: bool) -> int:
    """The last frame that a user saw a second before the kill."""
    begin = server.ready()["transport"]["frame"]
    server.ask("POST", "transport", {"action": "play"})
    seen: list[tuple[float, int]] = []
    server.until(lambda s: seen.append((time.monotonic(), s["transport"]["frame"])) or seen[-1][1] >= until_frame)
    server.kill(engine_too=engine_too)
    killed = time.monotonic()
    at_least = max(frame for at, frame in seen if at < killed - LOSS_S)
    assert at_least > begin, "else nothing is asked of it"
    return at_least


def test_a_server_killed_while_it_plays_is_reopened_where_it_was_and_comes_to_the_same_end(
    tmp_path: Path, never_killed: tuple[int, dict[str, bytes]]
) -> None:
    """First the server alone, then the one that reopened its session, with its engine."""
    last, expected = never_killed

    def check(state: State) -> None:
        assert at_least <= state["transport"]["frame"] < last
        assert [(note["frame"], note["text"]) for note in state["notes"]] == [(CHANGED_AT, "here it begins to drift")]
        params = server.ask("GET", "params").json()
        assert {name: params[name.partition(".")[0]][name.partition(".")[2]] for name in CHANGE} == CHANGE

    def session() -> str:
        """The file of the newest server; each has one."""
        (newest,) = {*(tmp_path / "runs" / "sessions").glob("*.hemislam")} - known
        known.add(newest)
        return str(newest)

    known = set[Path]()

    server = Server(tmp_path, str(SAMPLE), "--duration", str(LENGTH_S), "--set", *SETTINGS)
    try:
        server.ready()
        server.go_to(CHANGED_AT)
        tree = {name.partition(".")[0]: {name.partition(".")[2]: value} for name, value in CHANGE.items()}
        # The misspelt topic would take effect on restart; the session was opened, and is opened again, without it.
        server.ask("PATCH", "params", tree | {"recording": {"lidar_topic": "/misspelt"}})
        server.ask("POST", "notes", {"text": "here it begins to drift"})
        at_least = killed_while_it_plays(server, CHANGED_AT + 20, engine_too=False)  # a real time of 2 s later
        server = Server(tmp_path, session())
        check(server.ready())
        at_least = killed_while_it_plays(server, CHANGED_AT + 40, engine_too=True)
        server = Server(tmp_path, session())
        check(server.ready())
        server.go_to(last)
        assert server.exports() == expected
    finally:
        server.kill(engine_too=True)
