"""Lines over the map: where the sensor went, and where the truth says it did."""

from typing import Final

import numpy as np
import viser

from app.slam.types import F32, F64
from app.ui.colours import Rgb
from app.ui.geometry import STILL_M
from app.ui.nodes import add_lines, place

PATH_COLOUR: Final = (255, 92, 141)
TRUTH_COLOUR: Final = (240, 244, 250)
BLOCK: Final = 256
"""Segments per node: a new frame sends only the newest node again, not an hour's path."""
_MOST_TRUTH_POINTS: Final = 4000


def segments(positions: F64 | F32) -> F32:
    """(n, 3) positions -> (n-1, 2, 3) segments between neighbours."""
    return np.stack((positions[:-1], positions[1:]), axis=1).astype(np.float32)


class Trajectory:
    """The estimated path, in blocks of at most `BLOCK` segments below the node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str, colour: Rgb = PATH_COLOUR) -> None:
        self._scene = scene
        self._root = root
        self._colour = colour
        self._blocks: list[viser.LineSegmentsHandle] = []
        self._drawn: list[F32] = []

    def draw(self, positions: F64, visible: bool) -> None:
        """Draw (n, 3) positions, sending the blocks that differ from what is drawn."""
        while len(self._blocks) > -(-max(len(positions) - 1, 0) // BLOCK):
            self._blocks.pop().remove()
            self._drawn.pop()
        for index, first in enumerate(range(0, len(positions) - 1, BLOCK)):
            part = positions[first : first + BLOCK + 1].astype(np.float32)
            if index == len(self._blocks):
                self._drawn.append(part)
                self._blocks.append(add_lines(self._scene, f"{self._root}/{index}", segments(part), self._colour, 3.0))
            elif len(part) != len(self._drawn[index]) or np.abs(part - self._drawn[index]).max() > STILL_M:
                self._drawn[index] = part
                self._blocks[index].points = segments(part)
            self._blocks[index].visible = visible


class Truth:
    """The true path: sent once in the truth's own frame and laid over the map by the node's pose."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._line: viser.LineSegmentsHandle | None = None
        self._loaded: F64 | None = None

    def draw(self, positions: F64 | None, T_map_truth: F64 | None, visible: bool) -> None:
        """Show (m, 3) positions where `T_map_truth` (4, 4) lays them; hidden while that is unknown."""
        if positions is not self._loaded:
            self._loaded = positions
            if self._line is not None:
                self._line.remove()
                self._line = None
            if positions is not None and len(positions) >= 2:
                some = positions[:: max(1, len(positions) // _MOST_TRUTH_POINTS)]
                self._line = add_lines(self._scene, self._root, segments(some), TRUTH_COLOUR, 1.5, visible=False)
        if self._line is None:
            return
        self._line.visible = visible and T_map_truth is not None
        if T_map_truth is not None:
            place(self._line, T_map_truth)
