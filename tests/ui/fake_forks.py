"""A fake workspace with two engines: B drifts to the left from the fork on."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from app.mapping.session_file import Opened, SessionWriter, State, read_session
from app.server.fork import Workspace
from app.server.protocol import Seek, SetParams
from app.server.setup import Setup
from app.slam.params import Params
from tests.ui.fake_engine import FakeEngine, World

DRIFT_M = 0.01
"""Per frame."""
TURN_DEG = 2.0


class Drifting(World):
    def __init__(self, columns: int, since: int) -> None:
        super().__init__(columns)
        self.since = since

    def position(self, frame: int) -> np.ndarray:
        return super().position(frame) + np.array([0.0, DRIFT_M * max(frame - self.since, 0), 0.0])

    def rotation(self, frame: int) -> np.ndarray:
        angle = np.radians(TURN_DEG if frame > self.since else 0.0)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        return turn @ super().rotation(frame)


def alone(engine: FakeEngine) -> Workspace:
    """Of an engine that is not forked."""
    return Workspace(engine, Setup(), lambda _: engine)  # type: ignore[arg-type, return-value]


def workspace(a: FakeEngine, folder: Path, columns: int = 40) -> Workspace:
    """`a` can be forked; files go to the folder."""
    path = folder / "a.hemislam"
    writer = SessionWriter(path, Opened(Path("/data/hall_bpearl.mcap")))
    writer.write(0, State(Params(), ((0, Params()),)))
    writer.close()
    a.publish(session_file=path)
    return Workspace(a, Setup(session_folder=folder), starter(columns))  # type: ignore[arg-type, return-value]


def starter(columns: int) -> Callable[[Setup], FakeEngine]:
    def start(setup: Setup) -> FakeEngine:
        assert setup.recording is not None
        session = read_session(setup.recording)
        b = FakeEngine(columns=columns)
        b.world = Drifting(columns, session.frame)
        b.send(SetParams(Params().changed(session.state.params)))
        b.publish(session=setup.seen.session + 1, session_file=setup.recording)
        b.send(Seek(session.frame))
        return b

    return start
