"""Child processes: messages, death, signals, orderly shutdown, and the fork server.

Tests app/fork_server.py.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from app.child import Child, ChildDied, Link, LinkClosed, RestartLimit, _main_hidden

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 30.0

forked = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere processes are not forked")

OWNER = f"""
import os, signal, sys, time
sys.path[:0] = {[str(ROOT), str(ROOT / "tests" / "server")]!r}
import server_fakes as fakes
from pathlib import Path
from app.child import fork_context
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


@pytest.fixture(scope="module")
def told() -> list[str]:
    """What an owner of three engines in turn tells; it kills the fork server of the second, and at last itself."""
    _, out, err = owned("""
first = begin()
forked = parent(first)
print(name(first), name(forked), parent(forked) == os.getpid())
engine.close()
pid = begin()
print(parent(pid) == forked)
os.kill(forked, signal.SIGKILL)
time.sleep(0.2)
engine.send(Seek(250))
until(lambda: engine.snapshot.transport.frame >= 250)
print(engine.snapshot.engine_alive and engine.pid == pid)
engine.close()
another = parent(begin())
print(another not in (forked, os.getpid()), another, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
""")
    assert err == ""
    return out.split()


@forked
def test_engines_show_their_name_and_are_forks_of_the_same_process(told: list[str]) -> None:
    assert told[:4] == ["hemislam-engine", "hemislam-forks", "True", "True"]


@forked
def test_without_the_fork_server_an_engine_goes_on_and_the_next_one_has_another(told: list[str]) -> None:
    assert told[4:6] == ["True", "True"]


@forked
def test_the_fork_server_is_gone_with_its_owner(told: list[str]) -> None:
    deadline = time.monotonic() + 30.0
    while (forked := Path(f"/proc/{int(told[6])}")).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not forked.exists()


@forked
@pytest.mark.parametrize("wait", [0.05, 0.0])
def test_a_signal_to_the_whole_group_does_not_end_it(wait: float) -> None:
    """Neither SIGINT nor SIGTERM, not even while it imports."""
    code, out, err = owned(f"""
def signals():
    for number in (signal.SIGINT, signal.SIGTERM):
        os.killpg(0, number)

for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: None)
fork_context("app.server.engine_process")
time.sleep({wait})
signals()
pid = begin()
signals()
engine.send(Seek(250))
until(lambda: engine.snapshot.transport.frame >= 250)
print(engine.pid == pid, engine.snapshot.engine_alive)
engine.close()
""")
    assert (code, out.split(), err) == (0, ["True", "True"], "")


# --- any child -----------------------------------------------------------------------------------
def echo(owner: Link, first: str) -> None:
    """Answers with what it was sent, and says goodbye."""
    owner.send(first)
    try:
        while True:
            message = owner.receive()
            if message == "die":
                raise ValueError("as it was told")
            owner.send(message)
    except LinkClosed:
        owner.send("goodbye")


def hang(owner: Link, grandchild: bool = False) -> None:
    """Works for ever, and looks at no message."""
    child = Child(hang, name="hang", title="The grandchild", grace_s=0.0) if grandchild else None
    owner.send((os.getpid(), child.pid if child else 0))
    while True:
        time.sleep(1.0)


def echoing() -> Child:
    return Child(echo, "hello", name="echo", title="The echo")


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1]
    except OSError:
        return False


def until_gone(pid: int) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while alive(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("order", ["C", "F"])
def test_messages_arrive_in_order_and_read_only_arrays_stay_read_only(order: Literal["C", "F"]) -> None:
    child = echoing()
    rows = np.arange(500_000, dtype=np.int32).reshape(-1, 4).copy(order=order)
    rows.setflags(write=False)
    child.send(1)
    child.send({"rows": rows})
    assert child.receive(TIMEOUT_S) == "hello"
    assert child.receive(TIMEOUT_S) == 1
    got = child.receive(TIMEOUT_S)["rows"]
    assert np.array_equal(got, rows) and got.dtype == rows.dtype and not got.flags.writeable
    assert child.receive(0.05) is None, "nothing more was sent"
    child.close()
    assert not alive(child.pid)


def test_an_orderly_end_lets_it_finish_what_it_has_to_say() -> None:
    child = echoing()
    assert child.receive(TIMEOUT_S) == "hello"
    child.send("last")
    child.close()
    assert (child.receive(0.0), child.receive(0.0)) == ("last", "goodbye")
    with pytest.raises(ChildDied, match=r"^The echo ended unexpectedly \(exit code 0\)\.$"):
        child.receive()


@pytest.mark.parametrize(
    ("deed", "how"),
    [(lambda c: os.kill(c.pid, signal.SIGKILL), "signal 9, SIGKILL"), (lambda c: c.send("die"), "exit code 1")],
    ids=["killed", "raised"],
)
def test_how_it_died_is_said_in_a_sentence(deed: Callable[[Child], None], how: str) -> None:
    child = echoing()
    assert child.receive(TIMEOUT_S) == "hello"
    deed(child)
    for _ in range(2):
        with pytest.raises(ChildDied, match=rf"^The echo ended unexpectedly \({how}\)\.$") as died:
            child.receive(TIMEOUT_S)
        assert died.value.how == how
    child.send("nobody takes it")
    child.close()


def test_news_are_none_a_message_or_the_reason_of_death_in_words() -> None:
    child = echoing()
    assert child.receive(TIMEOUT_S) == "hello"
    assert child.news() is None
    os.kill(child.pid, signal.SIGKILL)
    deadline = time.monotonic() + TIMEOUT_S
    while (news := child.news()) is None:
        assert time.monotonic() < deadline
    assert news == "The echo ended unexpectedly (signal 9, SIGKILL)."


def test_a_dead_child_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    child = Child(hang, name="hang", title="The child")
    child.receive(TIMEOUT_S)
    os.kill(child.pid, signal.SIGKILL)
    with pytest.raises(ChildDied):
        child.receive(TIMEOUT_S)
    child.flush()
    assert threading.active_count() <= before  # a thread of an earlier test may end meanwhile


def test_children_started_at_the_same_time_leave_the_script_in_its_place() -> None:
    script = sys.modules["__main__"]

    def start() -> None:
        with _main_hidden():
            time.sleep(0.02)

    threads = [threading.Thread(target=start) for _ in range(2)]
    for thread in threads:
        thread.start()
        time.sleep(0.01)
    for thread in threads:
        thread.join()
    assert sys.modules["__main__"] is script


def test_one_that_does_not_end_when_asked_is_killed_after_the_time() -> None:
    child = Child(hang, name="hang", title="The child")
    pid, _ = child.receive(TIMEOUT_S)
    begin = time.monotonic()
    child.close(timeout=0.3)
    assert 0.3 <= time.monotonic() - begin < 10.0
    assert not alive(pid)


def test_children_of_children_end_with_them() -> None:
    child = Child(hang, True, name="hang", title="The child")
    pids = child.receive(TIMEOUT_S)
    child.close(timeout=0)
    for pid in pids:
        until_gone(pid)
    assert not any(alive(pid) for pid in pids)


LEFT_OPEN = """
import os, sys
sys.path[:0] = [{root!r}, {here!r}]
import test_child
from app.child import Child
children = [test_child.echoing(), Child(test_child.hang, True, name="hang", title="The child", grace_s={grace})]
assert children[0].receive(30.0) == "hello"
print(children[0].pid, *children[1].receive(30.0), flush=True)
{end}
"""


@pytest.mark.parametrize(
    "end", ["raise ValueError('forgot to close them')", "os.kill(os.getpid(), 9)"], ids=["raises", "killed"]
)
def test_no_child_outlives_its_owner(end: str) -> None:
    code = LEFT_OPEN.format(root=str(ROOT), here=str(Path(__file__).parent), grace=0.5, end=end)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, -signal.SIGKILL)
    pids = [int(pid) for pid in done.stdout.split()]
    assert len(pids) == 3, done.stderr
    for pid in pids:
        until_gone(pid)


def test_the_script_of_the_owner_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    paths = [str(ROOT), str(Path(__file__).parent)]
    script.write_text(f"""
import sys
sys.path[:0] = {paths!r}
import test_child
from app.child import Child
print("run")
for fork in (False, True):
    child = Child(test_child.echo, "hello", name="echo", title="The echo", fork=fork)
    print(child.receive(30.0))
    child.close()
""")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert (done.stdout.split(), done.stderr) == (["run", "hello", "hello"], "")


def runs_nothing(owner: Link) -> None:
    from app.evaluation.runner import run_jobs

    run_jobs([], parallel=1, quiet=True)
    owner.send("ran")
    owner.receive()


def test_runs_that_are_killed_leave_no_semaphore_of_which_python_would_warn() -> None:
    code = f"""
import sys
sys.path[:0] = {[str(ROOT), str(Path(__file__).parent)]!r}
import test_child
from app.child import Child
child = Child(test_child.runs_nothing, name="tune", title="The search", fork=True)
print(child.receive(60.0))
child.close(0.0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=90)
    assert (done.stdout.split(), done.stderr) == (["ran"], "")


def test_restarts_are_allowed_so_often_within_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("app.child.time.monotonic", lambda: now)
    ever, within = RestartLimit(2), RestartLimit(2, within_s=60.0)
    assert [ever.allows() for _ in range(4)] == [True, True, False, False]
    assert [within.allows() for _ in range(3)] == [True, True, False]
    now = 60.0
    assert within.allows(), "the first death is long ago"
    now = 61.0
    assert not ever.allows()
