"""Which sessions are offered as B, and what the two sides are told by a swap. Tests app/server/fork.py."""

from dataclasses import replace
from pathlib import Path

from test_fork import Recorder, at

from app.mapping.breakpoints import Breakpoints
from app.mapping.session_file import Opened, SessionWriter, State
from app.server.fork import Side, Workspace
from app.server.keeping import AddNote
from app.server.protocol import Command, Pause, Progress, Seek, SetBreakpoints, SetSpeed, Snapshot
from app.server.setup import Setup
from app.slam.params import Params


def test_only_sessions_from_the_same_start_are_offered_as_b(tmp_path: Path) -> None:
    for name, start_s in (("whole", 0.0), ("later", 10.0)):
        writer = SessionWriter(tmp_path / f"{name}.hemislam", Opened(tmp_path / "walk.mcap", start_s))
        writer.write(5, State(Params()))
        writer.close()
    (tmp_path / "empty.hemislam").touch()
    a = Recorder(at(5, name=str(tmp_path / "walk")))
    workspace = Workspace(a, Setup(session_folder=tmp_path), lambda setup: Recorder(at(5)))
    assert workspace.kept() == [tmp_path / "whole.hemislam"]
    a.snapshot = Snapshot()
    assert workspace.kept() == []
    workspace.close()


def swapped(a: Snapshot, b: Snapshot) -> tuple[list[Command], list[Command]]:
    """What A and B are sent."""
    sides = Recorder(a), Recorder(b)
    workspace = Workspace(sides[0], Setup(), lambda _: sides[1])
    workspace._sides = (Side(sides[0], "main"), Side(sides[1], "b"))
    workspace.swap()
    return sides[0].sent, sides[1].sent


def test_breakpoints_stay_with_what_is_shown() -> None:
    of_a, (*led, noted) = swapped(replace(at(7), breakpoints=Breakpoints(no_ground=True)), at(5))
    assert led == [SetSpeed(1.0), SetBreakpoints(Breakpoints(no_ground=True)), Seek(7)] and of_a == [Pause()]
    assert noted == AddNote("Swapped: replaces main.")


def test_a_seek_goes_on_after_a_swap() -> None:
    _, of_b = swapped(replace(at(30), progress=Progress("Going to frame 90", 0.2, 90)), at(28))
    assert Seek(90) in of_b and Seek(30) not in of_b
