"""Engine and receiver are forks of one process that has imported already, and that outlives what ends the others."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Elsewhere they are spawned, as multiprocessing does it, and there is none that the others are forks of; CI is Linux.
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere processes are not forked")

OWNER = f"""
import os, signal, sys, time
sys.path[:0] = {[str(ROOT), str(ROOT / "tests" / "server")]!r}
import server_fakes as fakes
from pathlib import Path
from app import processes
from app.server.protocol import Seek
from app.server.setup import Setup
from app.server.worker import EngineProcess

def parent(pid):
    return int(Path(f"/proc/{{pid}}/stat").read_text().rsplit(")", 1)[1].split()[1])

def name(pid):
    return Path(f"/proc/{{pid}}/comm").read_text().strip()

def until(wanted):
    deadline = time.monotonic() + 30.0
    while not wanted():
        assert time.monotonic() < deadline, engine.snapshot
        time.sleep(0.01)

def begin():
    global engine
    engine = EngineProcess(Setup(recording=Path("walk-300.mcap")), main=fakes.fake_main)
    until(lambda: engine.snapshot.transport.frame >= 0)
    return engine.pid
"""


def owned(text: str, *, timeout: float = 60.0) -> tuple[int, str, str]:
    """Run as the owner of an engine, in a group of its own. Returns exit code, output and errors."""
    command = [sys.executable, "-c", OWNER + text]
    done = subprocess.run(command, capture_output=True, text=True, start_new_session=True, timeout=timeout)
    return done.returncode, done.stdout, done.stderr


def test_each_shows_its_name_and_is_a_fork_of_the_same_one() -> None:
    code, out, err = owned("""
first = begin()
forked = parent(first)
print(name(first), name(forked), parent(forked) == os.getpid())
engine.close()
print(parent(begin()) == forked)
engine.close()
""")
    assert (code, out.split(), err) == (0, ["hemislam-engine", "hemislam-forks", "True", "True"], "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("wait", [0.05, 0.0])
def test_a_signal_to_the_whole_group_does_not_end_it(number: signal.Signals, wait: float) -> None:
    """Not even while it imports, but that SIGTERM it minds until then: another one begins in its place."""
    code, out, err = owned(f"""
signal.signal({number}, signal.SIG_IGN if {number} == signal.SIGTERM else lambda *_: None)
processes.context()
time.sleep({wait})
os.killpg(0, {number})
pid = begin()
os.killpg(0, {number})
engine.send(Seek(250))
until(lambda: engine.snapshot.transport.frame >= 250)
print(engine.pid == pid, engine.snapshot.engine_alive)
engine.close()
""")
    assert (code, out.split(), err) == (0, ["True", "True"], "")


def test_without_it_an_engine_goes_on_and_the_next_one_has_another() -> None:
    code, out, err = owned("""
pid = begin()
forked = parent(pid)
os.kill(forked, signal.SIGKILL)
time.sleep(0.2)
engine.send(Seek(250))
until(lambda: engine.snapshot.transport.frame >= 250)
print(engine.snapshot.engine_alive and engine.pid == pid)
engine.close()
print(parent(begin()) not in (forked, os.getpid()))
engine.close()
""")
    assert (code, out.split(), err) == (0, ["True", "True"], "")


def test_it_is_gone_with_its_owner() -> None:
    _, out, _ = owned("""
print(parent(begin()), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
""")
    deadline = time.monotonic() + 30.0
    while (forked := Path(f"/proc/{int(out)}")).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not forked.exists()
