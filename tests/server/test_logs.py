"""One format for the log lines of all processes."""

import json
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from app.logs import AtMost


def entries(err: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in err.splitlines()]


OWNER = """
import server_fakes as fakes
from app.logs import start_logging
from app.server.setup import Setup
from app.server.worker import EngineProcess

start_logging(json_lines=True)
engine = EngineProcess(Setup(), main=fakes.failing_main)
assert not engine.wait(0, timeout=60.0).engine_alive
engine.close()
"""


def test_what_ends_the_engine_is_one_line_of_json() -> None:
    folders = [str(Path(__file__).parent), str(Path(__file__).resolve().parents[2])]
    code = f"import sys; sys.path[:0] = {folders}\n{OWNER}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    warned, thread, ended = entries(done.stderr)
    assert warned["level"] == "warning" and "somewhat odd" in warned["message"]
    assert thread["level"] == "error" and "side work" in thread["message"] and "IndexError" in thread["traceback"]
    assert ended["level"] == "critical" and "an engine\nthat fails" in ended["message"]
    assert {entry["process"] for entry in (warned, thread, ended)} == {"engine"}


LOOPS = """
import pytest
from app.logs import start_logging
from app.mapping.loops import LoopProcess
from app.child import ChildDied

start_logging(json_lines=True)
loops = LoopProcess()
class Unknown: pass

loops.send(Unknown())
with pytest.raises(ChildDied, match="exit code 1"):
    loops.receive(60.0)
"""


def test_so_is_what_ends_the_process_that_looks_for_loops() -> None:
    code = f"import sys; sys.path[:0] = [{str(Path(__file__).resolve().parents[2])!r}]\n{LOOPS}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (ended,) = entries(done.stderr)
    assert (ended["level"], ended["process"]) == ("critical", "loops") and "Traceback" in ended["traceback"]


def test_processes_follow_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    command = [
        sys.executable,
        "-c",
        "from app.logs import process_logs\nwith process_logs('one'): raise OSError('gone')",
    ]
    monkeypatch.setenv("HEMISLAM_LOG_JSON", "")
    code = f"import subprocess, app.logs; app.logs.start_logging(json_lines=%s); subprocess.run({command})"
    for json_lines in (True, False):
        done = subprocess.run([sys.executable, "-c", code % json_lines], capture_output=True, text=True, timeout=60)
        if json_lines:
            assert [entry["process"] for entry in entries(done.stderr)] == ["one"]
        else:
            assert done.stderr.startswith("hemislam: The process ends: OSError: gone")


def test_of_one_kind_of_warning_a_minute_has_only_a_few() -> None:
    limit, kept = AtMost(), []
    for n in range(1000):
        record = logging.makeLogRecord({"name": "app.x", "levelno": logging.WARNING, "msg": "Refused %s", "args": (n,)})
        record.created = 60.0 * (n // 500)
        if limit.filter(record):
            kept.append(record.getMessage())
    assert len(kept) == 2 * AtMost.PER_MINUTE and "more of these" in kept[4]
    error = logging.makeLogRecord({"name": "app.x", "levelno": logging.ERROR, "msg": "Refused %s", "args": (1,)})
    assert all(limit.filter(error) for _ in range(100))
