"""A scene as drawn by the workbench, for tests of what it shows and sends."""

from dataclasses import replace

import viser

from app.server.chunks import within_budget
from app.server.protocol import Snapshot
from app.ui.scene import Scene
from app.ui.widgets import View
from tests.ui.conftest import Cloud, clouds
from tests.ui.fake_engine import FakeEngine


class Drawn:
    """A scene that remembers what it shows, as the workbench does; `budget`: most points of the map."""

    def __init__(self, server: viser.ViserServer, engine: FakeEngine, budget: int | None = None) -> None:
        self.scene = Scene(server)
        self.budget = budget
        self.engine = engine
        self.snapshot: Snapshot | None = None
        self.view: View | None = None

    def draw(self, view: View | None = None, **changes: object) -> None:
        view = view or self.view or View()
        snapshot = replace(self.engine.snapshot, **changes)  # type: ignore[arg-type]
        if self.budget is not None:
            known = self.snapshot.chunks if self.snapshot else ()
            chunks, result = known + snapshot.chunks[len(known) :], snapshot.result
            assert result is not None
            chunks = within_budget(chunks, snapshot.keyframe_poses, result.T_map_imu[:3, 3], self.budget)
            snapshot = replace(snapshot, chunks=chunks)
        self.scene.draw(snapshot, view)
        self.snapshot, self.view = snapshot, view


def chunk_nodes(server: viser.ViserServer) -> dict[str, Cloud]:
    """Keyframes that are seen."""
    found = clouds(server)
    return {name: cloud for name, cloud in found.items() if name.startswith("/map/keyframes/") and cloud.visible}
