"""A workbench on a walk with loops, drawn whenever a test wants it, and simulated clicks."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.server.folders import Folders
from app.slam.loops.types import Verdict
from app.ui.loops.panel import LoopsPanel
from app.ui.workbench import Workbench
from tests.ui.conftest import Clock
from tests.ui.fake_forks import alone
from tests.ui.fake_loops import LoopEngine

GOOD, WAITING = (12, 89), (34, 112)
OLDER, NEWER = "/map/submaps/older", "/map/submaps/newer"


class Page:
    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.clock = Clock()
        self.server = server
        self.engine = LoopEngine()
        self.workbench = Workbench(server, alone(self.engine), Folders([folder]), now=self.clock)
        self.loops: LoopsPanel = self.workbench._loops
        self.draw()
        self.engine.sent.clear()

    def draw(self, seconds: float = 1.0) -> None:
        self.clock.now += seconds
        self.workbench.draw(self.engine.snapshot)

    def choose(self, pair: tuple[int, int] | None) -> None:
        self.loops.choose(pair)
        for _ in range(3):  # it is asked for, it is there, the map gives way
            self.draw()

    def node(self, name: str) -> Any:
        return self.server.scene._handle_from_node_name.get(name)

    def click_scene(self, origin: np.ndarray, towards: np.ndarray) -> None:
        client = SimpleNamespace(gui=self.server.gui, camera=SimpleNamespace(fov=1.0))
        event: Any = SimpleNamespace(client=client, ray_origin=tuple(origin), ray_direction=tuple(towards - origin))
        self.workbench.clicked(event)

    def says(self, *html: str) -> bool:
        return all(part in self.loops._table.content for part in html)

    def edge(self, pair: tuple[int, int]) -> Any:
        return next(edge for edge in self.engine.snapshot.loops.edges if edge.pair == pair)


@pytest.fixture
def page(server: viser.ViserServer, tmp_path: Path) -> Page:
    return Page(server, tmp_path)


def rejected(page: Page) -> tuple[int, int]:
    edges = page.engine.snapshot.loops.edges
    return next(edge.pair for edge in edges if edge.verdict is Verdict.REJECTED and edge.evidence.overlap > 0)
