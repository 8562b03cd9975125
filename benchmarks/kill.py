"""kill -9 of server, engine, both or loop search at 20 random moments: the session still reaches the same result.

A simulated user works over REST with the real program, on a recording with loops: seeks, changes parameters, writes
notes, edits loops. After a kill, everything done more than a second before it must still be there; later actions are
repeated if they are missing. At the end, map and trajectory must equal those of a session that was never killed, byte
for byte.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.live import children
from benchmarks.record import Line

SAMPLE = next((Path(__file__).resolve().parents[1] / "sample_data").glob("*.mcap"))
KILLS, KILLS_A_RUN = 20, 5
LOSS_S = 1.0
"""An action may be lost only if it was done within this time before the kill."""
TIMEOUT_S, AT_REST_S = 900.0, 10.0
FILES = ("trajectory.tum", "map.ply")
Kind = Literal["engine", "loops", "server", "both"]
KINDS: tuple[Kind, ...] = ("engine", "server", "loops", "engine", "both")

State = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Action:
    """An action of the user at a share of the recording (1: at its end). `done` asks the server whether it was done."""

    at: float
    act: Callable[["Workbench"], None]
    done: Callable[["Workbench"], bool]


class Lost(Exception):
    """The server does not answer because it was killed."""


class Workbench:
    """`hemislam serve` and a user of its REST interface."""

    def __init__(self, folder: Path, recording: Path) -> None:
        self.folder = folder
        self.server: subprocess.Popen[str] | None = None
        self._address = ""
        self.start(recording)

    def start(self, what: Path) -> None:
        command = [sys.executable, "-m", "app", "serve", str(what), "--paused", "--no-browser", "--port", "0"]
        self.server = subprocess.Popen(
            command,
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(SAMPLE.parents[1]), *filter(None, sys.path)])},
            stdout=subprocess.PIPE,
            stderr=(self.folder / "errors.txt").open("a"),
            text=True,
            start_new_session=True,
        )
        assert self.server.stdout is not None
        line = ""
        while "hemislam is at" not in line:
            line = self.server.stdout.readline()
            assert line, (self.folder / "errors.txt").read_text()
        self._address = line.split()[3]

    def reopen(self) -> None:
        """Open the newest session file, once the old engine has ended."""
        assert self.server is not None
        self.server.wait()
        files = (self.folder / "runs" / "sessions").glob("*.hemislam")
        self.start(max(files, key=lambda file: file.stat().st_mtime).resolve())

    def ask(self, method: str, path: str, **kwargs: Any) -> Any:
        try:
            answer = httpx.request(method, f"{self._address}api/{path}", timeout=60.0, **kwargs)
        except httpx.TransportError:
            raise Lost from None
        assert answer.status_code < 300 or answer.status_code == 503, answer.text
        return answer

    def state(self) -> State:
        return dict(self.ask("GET", "state").json())

    def until(self, wanted: Callable[[State], bool]) -> State:
        deadline = time.monotonic() + TIMEOUT_S
        while not wanted(state := self.state()):
            assert time.monotonic() < deadline, state
            assert not self._refused(state), state["notices"]
            time.sleep(0.05)
        return state

    @staticmethod
    def _refused(state: State) -> bool:
        return any("cannot" in notice["text"] and notice["level"] == "error" for notice in state["notices"])

    def ready(self) -> State:
        """Wait until the session is at a frame, and return its state."""
        return self.until(
            lambda s: s["recording"] is not None and s["progress"] is None and s["transport"]["frame"] >= 0
        )

    def go_to(self, frame: int) -> None:
        """Seek to a frame; repeat the request in case the engine died before it got the command."""
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            self.ask("POST", "transport", json={"action": "seek", "frame": frame})
            asked = time.monotonic()
            while time.monotonic() < asked + 5.0:
                state = self.ready()
                if state["transport"]["frame"] == frame:
                    return
                time.sleep(0.05)
            assert time.monotonic() < deadline, state

    def finish(self, last: int, killed: threading.Event) -> None:
        """Go to the end of the recording, where the last loops are found, or until a process is killed."""
        if not self.state()["transport"]["finished"]:
            self.go_to(last)  # the session then goes on to the end
            self.until(lambda state: bool(state["transport"]["finished"]) or killed.is_set())

    def child(self, name: str) -> int | None:
        """The child process of this name; None while there is none."""
        assert self.server is not None
        with contextlib.suppress(OSError):  # a process may end meanwhile
            for pid in children(self.server.pid):
                if Path(f"/proc/{pid}/comm").read_text().strip() == f"hemislam-{name}":
                    return pid
        return None

    def kill(self, kind: Kind) -> None:
        """Kill, and return once the server knows."""
        assert self.server is not None
        name = "loops" if kind == "loops" else "engine"
        child = self.child(name)
        if kind in ("server", "both"):
            self.server.kill()
        if kind != "server" and child is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        if kind in ("engine", "loops"):
            # An engine at rest notices that its loop search has died only when it asks it again.
            deadline = time.monotonic() + (TIMEOUT_S if kind == "engine" else AT_REST_S)
            while self.child(name) in (None, child) and time.monotonic() < deadline:
                time.sleep(0.01)

    def close(self) -> None:
        if self.server is not None:
            self.server.terminate()
            self.server.wait(timeout=60)


# --- what the user does --------------------------------------------------------------------------
def _sets(at: float, **values: float) -> Action:
    """Set parameters, given as section__name."""
    tree: dict[str, dict[str, float]] = {}
    for path, value in values.items():
        section, name = path.split("__")
        tree.setdefault(section, {})[name] = value

    def act(bench: Workbench) -> None:
        bench.ask("PATCH", "params", json=tree)

    def done(bench: Workbench) -> bool:
        now = bench.ask("GET", "params").json()
        return all(now[section][name] == value for section, part in tree.items() for name, value in part.items())

    return Action(at, act, done)


def _notes(at: float, text: str) -> Action:
    def act(bench: Workbench) -> None:
        bench.ask("POST", "notes", json={"text": text})

    def done(bench: Workbench) -> bool:
        return any(note["text"] == text for note in bench.state()["notes"])

    return Action(at, act, done)


def _edits_loop(at: float, number: int, word: str, **more: float) -> Action:
    """Edit the accepted loop with this number in the order of keyframes."""
    chosen = list[tuple[int, int]]()

    def pair(bench: Workbench) -> tuple[int, int]:
        found, before, deadline = list[State](), list[State](), time.monotonic() + TIMEOUT_S
        while not chosen and (len(found) <= number or found != before):  # loops may still arrive
            assert time.monotonic() < deadline, "there is no such loop to edit; choose another recording"
            time.sleep(1.0)
            before, loops = found, bench.ask("GET", "loops").json()["loops"]
            found = [loop for loop in loops if loop["verdict"] == "accepted" or loop["edited"]]
        if not chosen:
            chosen.append((found[number]["older"], found[number]["newer"]))
        return chosen[0]

    def act(bench: Workbench) -> None:
        if not bench.state()["transport"]["finished"]:
            return  # killed meanwhile: the last loops are missing until the end is reached again
        older, newer = pair(bench)
        bench.ask("POST", "loops", json={"action": word, "older": older, "newer": newer, **more})

    def done(bench: Workbench) -> bool:
        return any(word in entry for entry in bench.ask("GET", "loops").json()["edits"])

    return Action(at, act, done)


ACTIONS = (
    _sets(0.15, ground__sigma=0.02),
    _notes(0.25, "the first turn"),
    _sets(0.4, filter__max_points=1500, filter__plane_tilt=2.0),
    _sets(0.3, ground__alpha=35.0),  # everything after it is mapped again
    _sets(0.7, filter__max_iterations=3),
    _notes(0.8, "on the way home"),
    _edits_loop(1.0, 0, "reject"),
    _edits_loop(1.0, 1, "weigh", weight=0.2),
)


def work_through(bench: Workbench, moments: "list[tuple[float, Kind]]") -> dict[str, bytes]:
    """Do all actions while processes are killed, each a given time (s) after the session is ready. Returns results."""
    index, when = 0, [0.0] * len(ACTIONS)
    killed_at, killed, waiting = [0.0], threading.Event(), list(moments)
    last = int(bench.ready()["recording"]["frames"]) - 1

    def killer(delay: float, kind: Kind) -> None:
        time.sleep(delay)
        killed_at[0] = time.monotonic()
        bench.kill(kind)
        killed.set()

    thread: threading.Thread | None = None
    while True:
        if waiting and (thread is None or not thread.is_alive()) and not killed.is_set():
            thread = threading.Thread(target=killer, args=waiting.pop(0), daemon=True)
            thread.start()
        try:
            if killed.is_set():
                killed.clear()
                bench.ready()
                index = _what_is_left(bench, index, when, killed_at[0])
            if index < len(ACTIONS):
                action = ACTIONS[index]
                bench.go_to(round(action.at * last)) if action.at < 1.0 else bench.finish(last, killed)
                action.act(bench)
                when[index] = time.monotonic()
                while not (done := action.done(bench)) and not killed.is_set():
                    time.sleep(0.05)
                index += done
                continue
            bench.finish(last, killed)
            if not waiting and (thread is None or not thread.is_alive()) and not killed.is_set():
                return {name: bench.ask("GET", f"export/{name}").content for name in FILES}
            time.sleep(0.05)
        except Lost:
            bench.reopen()


def _what_is_left(bench: Workbench, index: int, when: list[float], killed_at: float) -> int:
    """The first lost action, from which to continue. No action done long before the kill may be lost."""
    for number, action in enumerate(ACTIONS[:index]):
        deadline = time.monotonic() + 20.0  # loops are published a little after the frame
        while not (done := action.done(bench)) and time.monotonic() < deadline:
            time.sleep(0.1)
        if not done:
            assert killed_at - when[number] <= LOSS_S, (
                f"action {number} was done {killed_at - when[number]:.1f} s before"
            )
            return number
    return index


def run(recording: Path | None = None, kills: int = KILLS) -> list[Line]:
    """Raises AssertionError: something was lost, or the results differ."""
    path = (recording or SAMPLE).resolve()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory(prefix="hemislam-kill-") as folder:
        expected, took = _ended(Path(folder) / "never", path, [])
        runs = -(-kills // KILLS_A_RUN)
        for number in tqdm(range(runs), desc="Killed", disable=None):
            delays = rng.uniform(0.0, took / KILLS_A_RUN, KILLS_A_RUN).tolist()
            moments = [(delay, KINDS[k % len(KINDS)]) for k, delay in enumerate(delays)]
            came, _ = _ended(Path(folder) / str(number), path, moments)
            differ = [name for name in FILES if came[name] != expected[name]]
            assert not differ, f"these differ after the kills of run {number}: {', '.join(differ)}"
    on = f"{path.stem}: {len(ACTIONS)} actions, {runs * KILLS_A_RUN} kills of engine, loop search, server or both"
    return [Line("reopened sessions with other results", on, "runs", 0.0, 0.0, 0.0, runs)]


def _ended(folder: Path, path: Path, moments: "list[tuple[float, Kind]]") -> tuple[dict[str, bytes], float]:
    folder.mkdir()
    bench = Workbench(folder, path)
    try:
        bench.ready()
        began = time.monotonic()
        return work_through(bench, moments), time.monotonic() - began
    finally:
        bench.close()
