"""Loops in the scene: an arch from keyframe to keyframe, and which one a click meant.

A good loop ties keyframes at nearly the same place, so that a straight line would be too short to
see: every edge rises to a knob above its middle.
"""

import itertools
from typing import Final

import numpy as np
import numpy.typing as npt
import viser

from app.slam.loops.types import LoopEdge, Pair
from app.slam.types import F32, F64
from app.ui.colours import Rgb
from app.ui.loops.kinds import COLOURS, Kind, kind_of, name
from app.ui.view import STILL_M
from app.ui.widgets import unchanged

_RISE: Final = (0.7, 0.12)
"""Height of a knob above the edge's middle: m, and its share of the edge's length."""
_WIDTH: Final = {Kind.ACCEPTED: 3.0, Kind.CANDIDATE: 2.0, Kind.REJECTED: 1.0, Kind.USER: 3.5}
_OUT_WIDTH: Final = 1.0
_KNOB_M: Final = {Kind.ACCEPTED: 0.1, Kind.CANDIDATE: 0.1, Kind.REJECTED: 0.07, Kind.USER: 0.12}
_CHOSEN: Final[Rgb] = (255, 255, 255)
_CHOSEN_WIDTH: Final = 5.0
_PICK_RAD: Final = np.radians(1.5)
_LABEL: Final = np.array([0.0, 0.0, 0.5])
BLOCK: Final = 256
"""Loops per node: who walks back finds one with every keyframe, and only the newest node is sent again."""
_SAMPLES: Final = np.linspace(0.0, 1.0, 12)


def arches(edges: list[LoopEdge], poses: F64) -> F32:
    """(n, 3, 3) older keyframe, knob and newer keyframe of each edge in the map, from poses (k, 4, 4)."""
    ends = poses[[edge.pair for edge in edges], :3, 3].reshape(-1, 2, 3) if edges else np.empty((0, 2, 3))
    knobs = ends.mean(axis=1)
    knobs[:, 2] += _RISE[0] + _RISE[1] * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return np.stack((ends[:, 0], knobs, ends[:, 1]), axis=1).astype(np.float32)


def nearest(lines: npt.NDArray[np.floating], origin: F64, direction: F64, within: float = _PICK_RAD) -> int | None:
    """Which of (n, k, 3) polylines passes nearest to a ray, as the eye at its origin sees them.

    Args:
        origin: (3,). direction: (3,). within: rad, beyond which nothing was meant.
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
    """Arches and knobs of the loops shown, in blocks of at most `BLOCK` of a kind, in the graph or not, each a node of
    lines and one of points.
    """

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._nodes: dict[str, viser.LineSegmentsHandle | viser.PointCloudHandle | viser.LabelHandle] = {}
        self._drawn: dict[str, F32] = {}
        self._asked: tuple[object, ...] = ()
        self._pickable: tuple[list[Pair], F32] = ([], np.empty((0, 3, 3), np.float32))

    def draw(self, edges: tuple[LoopEdge, ...], poses: F64, shown: frozenset[Kind], chosen: Pair | None) -> None:
        """Draw the edges of the kinds `shown` and the chosen one, sending what differs.

        Args:
            poses: (k, 4, 4) T_map_imu of the keyframes; edges of later ones are left out.
        """
        asked = (edges, poses, shown, chosen)
        if unchanged(self._asked, asked):
            return
        self._asked = asked
        there = [edge for edge in edges if edge.newer < len(poses)]
        seen = [edge for edge in there if kind_of(edge) in shown or edge.pair == chosen]
        seen.sort(key=lambda edge: (edge.newer, edge.older))  # new ones come last
        lines = arches(seen, poses)
        self._pickable = ([edge.pair for edge in seen], lines)
        styles = np.array([list(Kind).index(kind_of(edge)) * 2 + edge.counts for edge in seen], dtype=np.int64)
        marked = np.array([edge.pair == chosen for edge in seen], dtype=np.bool_)
        for number in range(2 * len(Kind)):
            self._draw_style(list(Kind)[number // 2], bool(number % 2), lines[(styles == number) & ~marked])
        self._draw_chosen(name(chosen) if chosen is not None else "", lines[marked])

    def pick(self, origin: F64, direction: F64) -> Pair | None:
        """The loop that a ray in the map points at."""
        pairs, lines = self._pickable
        index = nearest(lines, origin, direction)
        return None if index is None else pairs[index]

    def _draw_style(self, kind: Kind, inside: bool, lines: F32) -> None:
        nodes = f"{self._root}/{kind.replace(' ', '-')}-{'in' if inside else 'out'}"
        width = _WIDTH[kind] if inside or kind is Kind.CANDIDATE else _OUT_WIDTH
        for block in itertools.count():
            node, part = f"{nodes}/{block}", lines[block * BLOCK : (block + 1) * BLOCK]
            if not len(part) and node not in self._drawn:
                break
            if self._differs(node, part):
                self._send(node, part, COLOURS[kind], width, _KNOB_M[kind])

    def _draw_chosen(self, text: str, lines: F32) -> None:
        node = f"{self._root}/chosen"
        label = self._nodes.get(f"{node}-label")
        renamed = isinstance(label, viser.LabelHandle) and label.text != text
        if self._differs(node, lines) or (renamed and len(lines)):
            self._send(node, lines, _CHOSEN, _CHOSEN_WIDTH, _KNOB_M[Kind.USER])
            self._nodes[f"{node}-label"] = self._scene.add_label(f"{node}-label", text, position=lines[0, 1] + _LABEL)

    def _send(self, node: str, lines: F32, colour: Rgb, width: float, knob_m: float) -> None:
        self._nodes[node] = self._scene.add_line_segments(
            node, _legs(lines), colour, thickness=width, thickness_units="screen"
        )
        knobs = np.ascontiguousarray(lines[:, 1])
        self._nodes[f"{node}-knobs"] = self._scene.add_point_cloud(
            f"{node}-knobs", knobs, colour, point_size=knob_m, point_shape="circle", precision="float32"
        )

    def _differs(self, node: str, lines: F32) -> bool:
        """Whether a node has to be sent; one of no lines is taken away."""
        before = self._drawn.get(node)
        if before is not None and before.shape == lines.shape and np.allclose(before, lines, rtol=0.0, atol=STILL_M):
            return False
        if len(lines):
            self._drawn[node] = lines.copy()  # of a block, without all the others
            return True
        self._drawn.pop(node, None)
        for key in [key for key in self._nodes if key == node or key.startswith(f"{node}-")]:
            self._nodes.pop(key).remove()
        return False


def _legs(lines: F32) -> F32:
    """(n, 3, 3) arches -> (2n, 2, 3) segments."""
    return np.stack((lines[:, :-1], lines[:, 1:]), axis=2).reshape(-1, 2, 3)
