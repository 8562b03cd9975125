"""Loops in the scene: an arch from keyframe to keyframe, and the arch that a click points at.

A good loop ties keyframes at nearly the same place, where a straight line would be too short to see. So every edge
rises to a knob above its middle.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import viser

from app.slam.loops.types import LoopEdge, Pair
from app.slam.types import F32, F64
from app.ui.colours import Rgb
from app.ui.geometry import STILL_M
from app.ui.loops.words import EDITED, KINDS, LoopKind, kind_of, name
from app.ui.nodes import add_exact_points, add_lines
from app.ui.widgets import Changes

_RISE: Final = (0.7, 0.12)
"""Height of a knob above the edge's middle: m, plus a share of the edge's length."""
CHOSEN: Final[dict[bool, Rgb]] = {False: (255, 255, 255), True: (16, 18, 22)}
"""Colour of the chosen loop on a dark and on a light background."""
_CHOSEN_WIDTH: Final = 5.0
_PICK_RAD: Final = np.radians(1.5)
_LABEL: Final = np.array([0.0, 0.0, 0.5])
_SAMPLES: Final = np.linspace(0.0, 1.0, 12)


def arches(edges: list[LoopEdge], poses: F64) -> F32:
    """(n, 3, 3) older keyframe, knob and newer keyframe of each edge in the map, from poses (k, 4, 4)."""
    ends = poses[[edge.pair for edge in edges], :3, 3].reshape(-1, 2, 3) if edges else np.empty((0, 2, 3))
    knobs = ends.mean(axis=1)
    knobs[:, 2] += _RISE[0] + _RISE[1] * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return np.stack((ends[:, 0], knobs, ends[:, 1]), axis=1).astype(np.float32)


def nearest(lines: npt.NDArray[np.floating], origin: F64, direction: F64, within: float = _PICK_RAD) -> int | None:
    """Index of the one of (n, k, 3) polylines that passes nearest to a ray, as seen from the ray's origin.

    Args:
        origin: (3,). direction: (3,). within: rad, largest angle between the ray and a polyline.
    """
    if not len(lines):
        return None
    a, b = lines[:, :-1, None], lines[:, 1:, None]
    points = (a + _SAMPLES[:, None] * (b - a)).reshape(len(lines), -1, 3) if lines.shape[1] > 1 else lines
    rays = points - origin
    along = rays @ (direction / np.linalg.norm(direction))
    off = np.linalg.norm(rays - along[..., None] * (direction / np.linalg.norm(direction)), axis=-1)
    angle = np.where(along > 0, np.arctan2(off, along), np.pi).min(axis=1)
    best = int(angle.argmin())
    return best if angle[best] <= within else None


class LoopEdges:
    """Arches and knobs of the loops shown: one node of lines and one of points per kind, in the graph or not."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._nodes: dict[str, list[viser.SceneNodeHandle]] = {}
        self._drawn: dict[str, tuple[str, Rgb, F32]] = {}
        self._changes = Changes()
        self._pickable: tuple[list[Pair], F32] = ([], np.empty((0, 3, 3), np.float32))

    def draw(
        self, edges: tuple[LoopEdge, ...], poses: F64, shown: frozenset[str], chosen: Pair | None, light: bool
    ) -> None:
        """Draw the edges of the kinds `shown` and the chosen edge, sending only changes.

        Args:
            poses: (k, 4, 4) T_map_imu of the keyframes; edges of later ones are left out.
        """
        if not self._changes(edges, poses, shown, chosen, light):
            return
        there = [edge for edge in edges if edge.newer < len(poses)]
        seen = [edge for edge in there if kind_of(edge).name in shown or edge.pair == chosen]
        lines = arches(seen, poses)
        self._pickable = ([edge.pair for edge in seen], lines)
        styles = np.array(["chosen" if edge.pair == chosen else _style(kind_of(edge), edge.counts) for edge in seen])
        for kind in KINDS.values():
            for inside, width in ((True, kind.width), (False, kind.out_width)):
                style = _style(kind, inside)
                self._draw(style, lines[styles == style], kind.colour, width, kind.knob_m)
        label = name(chosen) if chosen is not None else ""
        self._draw("chosen", lines[styles == "chosen"], CHOSEN[light], _CHOSEN_WIDTH, KINDS[EDITED].knob_m, label)

    def pick(self, origin: F64, direction: F64) -> Pair | None:
        """The loop that a ray in the map points at."""
        pairs, lines = self._pickable
        index = nearest(lines, origin, direction)
        return None if index is None else pairs[index]

    def _draw(self, style: str, lines: F32, colour: Rgb, width: float, knob_m: float, label: str = "") -> None:
        text, painted, before = self._drawn.get(style, ("", colour, lines[:0]))
        if (
            (text, painted) == (label, colour)
            and before.shape == lines.shape
            and (not len(lines) or np.allclose(before, lines, rtol=0.0, atol=STILL_M))
        ):
            return
        self._drawn[style] = label, colour, lines
        if not len(lines):
            for node in self._nodes.pop(style, []):
                node.remove()
            return
        path = f"{self._root}/{style}"
        legs = np.stack((lines[:, :-1], lines[:, 1:]), axis=2).reshape(-1, 2, 3)
        knobs = np.ascontiguousarray(lines[:, 1])
        self._nodes[style] = [
            add_lines(self._scene, path, legs, colour, width),
            add_exact_points(self._scene, f"{path}-knobs", knobs, colour, knob_m),
        ]
        if label:
            self._nodes[style].append(self._scene.add_label(f"{path}-label", label, position=lines[0, 1] + _LABEL))


def _style(kind: LoopKind, inside: bool) -> str:
    return f"{kind.name}-{'in' if inside else 'out'}"
