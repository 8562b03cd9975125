"""Only a few places know that a session can go back: everything else follows logs and notices it there."""

import ast
import re
from pathlib import Path

APP = Path(__file__).resolve().parents[1] / "app"
GOES_BACK = re.compile(r"_?(go_to|go_back|take_back|return_to|rewind|restore|truncate|cut|forget(_\w+)?)")
KNOW = {"slam/log.py", "mapping/session.py", "slam/loops/schedule.py"}
"""The store that can be cut, the session that goes back, and when loops take effect."""
ONE_VALUE = {
    "slam/engine.py": "sets the engine to a checkpoint, a value",
    "slam/local_map.py": "sets the local map to a value",
    "mapping/feed.py": "goes on reading from a place in the source",
    "mapping/live.py": "goes on receiving from a number of a scan",
}
"""They take a value that they gave before, and know of no session."""
STORES = {
    "slam/rows.py": "an array that grows",
    "slam/keyframes.py": "the file of keyframes",
}
"""Containers with `truncate`, which others call."""
LOOP_BACK_END = {f"slam/loops/{name}.py" for name in ("backend", "detection", "search", "submap")}
"""What is derived from keyframes and edits. It is brought to another number of keyframes by `backend.py` alone."""


LAYERS = {
    "mapping/labels.py": "the user's labels, keyframe by keyframe",
    "mapping/moving.py": "what was found to move, keyframe by keyframe",
}
"""Values of keyframes that only the session drops, once the keyframes will be others."""


def test_only_a_few_files_know_how_to_go_back() -> None:
    found = {}
    for path in sorted(APP.rglob("*.py")):
        names = [node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
        if going_back := [name for name in names if GOES_BACK.fullmatch(name)]:
            found[path.relative_to(APP).as_posix()] = going_back
    allowed = KNOW | ONE_VALUE.keys() | STORES.keys() | LAYERS.keys() | LOOP_BACK_END
    assert not {path: names for path, names in found.items() if path not in allowed}, (
        "follow a cursor instead (app/slam/log.py)"
    )
    assert found.keys() == allowed, "the list of files is out of date"
