"""A fake engine with loops for drawing tests: two laps through the corridors of a small building.

It has no real graph: the more loops count, the nearer the keyframes are to their true poses. This is
enough to check that the page shows its data and sends the user's commands.
"""

import functools
import itertools
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from app.server.protocol import (
    Chunk,
    Command,
    EditLoop,
    InspectLoop,
    LoopsView,
    RedoLoop,
    Transport,
    TryLoop,
    UndoLoop,
)
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops import scan_context
from app.slam.loops.edits import Accept, Add, LoopEdit, SetWeight, Solve
from app.slam.loops.types import Evidence, FactorResidual, LoopDetail, LoopEdge, Origin, Pair, Preview, Verdict
from tests.ui.fake_engine import START_NS, FakeEngine

LAP = 76
"""Keyframes of a lap, one each metre."""
KEYFRAMES = 2 * LAP
_LONG, _SHORT, _HALF_WIDTH, _HEIGHT = 24.0, 14.0, 1.6, 1.3


def _walk() -> np.ndarray:
    """(KEYFRAMES, 4, 4) true poses: two laps, the second 0.3 m beside the first, the IMU held at a slant."""
    corners = np.array([[0, 0], [_LONG, 0], [_LONG, _SHORT], [0, _SHORT], [0, 0]], dtype=float)
    at = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
    out = []
    for index in range(KEYFRAMES):
        s = index % LAP
        side = int(np.searchsorted(at, s, side="right")) - 1
        way = (corners[side + 1] - corners[side]) / (at[side + 1] - at[side])
        xy = corners[side] + (s - at[side]) * way + 0.3 * (index // LAP) * np.array([-way[1], way[0]])
        yaw = np.arctan2(way[1], way[0]) + 0.1 * np.sin(index)
        R = Rotation.from_euler("ZYX", [yaw, np.radians(20.0), np.radians(5.0)]).as_matrix()
        out.append(lie.transform(R, np.array([*xy, _HEIGHT + 0.03 * np.sin(2 * index)])))
    return np.array(out)


def _drifting(truth: np.ndarray) -> np.ndarray:
    """The same walk as odometry with a heading that drifts has it."""
    turn = lie.exp(np.array([0.0, 0.0, np.radians(0.06)]))
    out = [truth[0]]
    for a, b in itertools.pairwise(truth):
        step = lie.inverse(a) @ b
        level = a[:3, :3].T @ turn @ a[:3, :3]
        out.append(out[-1] @ lie.transform(level, np.zeros(3)) @ step)
    return np.array(out)


def _building(rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points of walls, floor and things that stand about."""

    def ring(grow: float, n: int) -> np.ndarray:
        x0, x1, y0, y1 = -grow, _LONG + grow, -grow, _SHORT + grow
        side = rng.integers(0, 4, n)
        t = rng.uniform(0, 1, n)
        x = np.select([side == 0, side == 1, side == 2], [x0 + t * (x1 - x0), x0 + t * (x1 - x0), x0 + 0 * t], x1)
        y = np.select([side == 0, side == 1], [y0 + 0 * t, y1 + 0 * t], y0 + t * (y1 - y0))
        return np.column_stack((x, y, rng.uniform(0.0, 2.8, n)))

    floor = rng.uniform([-_HALF_WIDTH, -_HALF_WIDTH, 0], [_LONG + _HALF_WIDTH, _SHORT + _HALF_WIDTH, 0], (60_000, 3))
    inside = (
        (floor[:, 0] > _HALF_WIDTH)
        & (floor[:, 0] < _LONG - _HALF_WIDTH)
        & (floor[:, 1] > _HALF_WIDTH)
        & (floor[:, 1] < _SHORT - _HALF_WIDTH)
    )
    parts = [ring(_HALF_WIDTH, 30_000), ring(-_HALF_WIDTH, 24_000), floor[~inside]]
    for _ in range(18):  # cupboards along the outer wall
        corner = ring(_HALF_WIDTH - 0.35, 1)[0] * [1, 1, 0]
        parts.append(corner + rng.uniform([-0.5, -0.3, 0], [0.5, 0.3, rng.uniform(0.6, 2.2)], (900, 3)))
    return np.concatenate(parts)


def _near(T_map_imu: np.ndarray, points: np.ndarray, reach: float, ahead: bool = False) -> np.ndarray:
    away = points - T_map_imu[:3, 3]
    near = np.linalg.norm(away, axis=1) < reach
    if ahead:
        near &= away @ (T_map_imu[:3, 0] * [1, 1, 0]) > 0
    return np.asarray(points[near])


def _chunk(index: int, T_map_imu: np.ndarray, building: np.ndarray) -> Chunk:
    T_imu_map = lie.inverse(T_map_imu)
    points = np.random.default_rng(index).permutation(_near(T_map_imu, building, 7.0, ahead=True))[:700]
    local = (points @ T_imu_map[:3, :3].T + T_imu_map[:3, 3]).astype(np.float32)
    labels = (points[:, 2] < 0.03).astype(np.uint8)
    n = len(local)
    stamp = START_NS + 600_000_000 * index
    return Chunk(index, 6 * index, stamp, local, labels, np.full(n, 30, np.float32), np.zeros(n, np.uint16), np.eye(4))


@functools.cache
def _world() -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[Pair, LoopEdge], tuple[Chunk, ...]]:
    """True and drifting poses, the building's points, what was found, and the keyframes' points."""
    rng = np.random.default_rng(3)
    truth, building = _walk(), _building(rng)
    chunks = tuple(_chunk(index, T, building) for index, T in enumerate(truth))
    return truth, _drifting(truth), building, _found(truth, rng), chunks


class LoopEngine(FakeEngine):
    """Two laps that are done, with 6 loops accepted, 3 waiting and 20 rejected."""

    def __init__(self) -> None:
        super().__init__(columns=30, frames=6 * KEYFRAMES, truth=False)
        self.truth, self.odometry, self._points, self._found, chunks = _world()
        self._done: list[LoopEdit] = []
        self._undone: list[LoopEdit] = []
        frame = chunks[-1].frame
        self.publish(
            chunks=chunks,
            transport=Transport(frame=frame, stamp_ns=START_NS + 100_000_000 * frame),
        )
        self._show()

    def level(self, index: int) -> np.ndarray:
        """(4, 4) T_level_imu: the level frames have the true map's axes."""
        return lie.transform(self.truth[index][:3, :3], np.zeros(3))

    def detail(self, older: int, newer: int) -> LoopDetail:
        edge = {edge.pair: edge for edge in self._edges(self._done)}[older, newer]
        poses = self.snapshot.keyframe_poses
        assert poses is not None

        def laid(T: np.ndarray) -> np.ndarray:
            return np.asarray(self.level(older) @ T @ lie.inverse(self.level(newer)))

        submaps = [_near(self.truth[index], self._points, 8.0) - self.truth[index][:3, 3] for index in (older, newer)]
        contexts = [scan_context.describe(points.astype(np.float32)) for points in submaps]
        cells = [np.where(context.seen, context.cells, np.float32(np.nan)) for context in contexts]
        spread = 0.012 if edge.verdict is Verdict.ACCEPTED else 0.06
        return LoopDetail(
            older=submaps[0].astype(np.float32),
            newer=submaps[1].astype(np.float32),
            T_imu_level=lie.inverse(self.level(older)),
            T_guess=laid(lie.inverse(self.odometry[older]) @ self.odometry[newer]),
            T_registered=laid(edge.T_older_newer),
            older_context=cells[0],
            newer_context=cells[1],
            shift_distances=scan_context.shift_distances(*contexts),
            residuals=np.random.default_rng(newer).normal(0, spread, 800),
        )

    # --- inside ------------------------------------------------------------------------------
    def _obey(self, command: Command) -> None:
        view = self.snapshot.loops
        match command:
            case EditLoop(edit):
                self._check(edit)
                self._done.append(edit)
                self._undone.clear()
                self._show()
            case UndoLoop() if self._done:
                self._undone.append(self._done.pop())
                self._show()
            case RedoLoop() if self._undone:
                self._done.append(self._undone.pop())
                self._show()
            case TryLoop(None):
                self.publish(loops=replace(view, tried=None))
            case TryLoop(tried):
                assert tried is not None
                self._check(tried)
                done = [*self._done, tried]
                preview = Preview(self._poses(done), self._residuals(done))
                self.publish(loops=replace(view, tried=(tried, preview)))
            case InspectLoop(None):
                self.publish(loops=replace(view, inspected=None))
            case InspectLoop(pair):
                assert pair is not None
                self.publish(loops=replace(view, inspected=(pair, self.detail(*pair))))
            case _:
                super()._obey(command)

    def _check(self, command: LoopEdit) -> None:
        pair = command.pair
        if pair and not isinstance(command, Add) and pair not in {edge.pair for edge in self._edges(self._done)}:
            raise HemislamError(f"There is no loop candidate of keyframes {pair[0]} and {pair[1]}.")

    def _show(self) -> None:
        self.publish(
            keyframe_poses=self._poses(self._done),
            trajectory=self._poses(self._done)[:, :3, 3],
            loops=replace(
                self.snapshot.loops if isinstance(self.snapshot.loops, LoopsView) else LoopsView(),
                edges=self._edges(self._done),
                residuals=self._residuals(self._done),
                undo=tuple(self._done),
                redo=tuple(self._undone),
                tried=None,
            ),
        )

    def _edges(self, done: list[LoopEdit]) -> tuple[LoopEdge, ...]:
        edges = dict(self._found)
        for command in done:
            if isinstance(command, Solve):
                continue
            pair = command.older, command.newer
            if isinstance(command, Add):
                T = lie.inverse(self.truth[pair[0]]) @ self.truth[pair[1]]
                if not command.register and command.guess is not None:
                    T = np.array(command.guess)
                edges[pair] = LoopEdge(*pair, pair[1], *_measured(T), Verdict.ACCEPTED, "tied manually", Origin.USER)
            elif isinstance(command, SetWeight):
                edges[pair] = replace(edges[pair], weight=command.weight)
            else:
                verdict = Verdict.ACCEPTED if isinstance(command, Accept) else Verdict.REJECTED
                reason = f"{verdict} manually; the search had {edges[pair].verdict} it: {edges[pair].reason}"
                edges[pair] = replace(edges[pair], verdict=verdict, edited=True, reason=reason)
        return tuple(edges[pair] for pair in sorted(edges))

    def _poses(self, done: list[LoopEdit]) -> np.ndarray:
        """The more loops count, the nearer to the truth; nearer still solved at once."""
        counted = sum(edge.weight for edge in self._edges(done) if edge.verdict is Verdict.ACCEPTED)
        counted += 5 * (Solve() in done)
        share = counted / (counted + 1.5)
        poses = self.truth.copy()
        poses[:, :3, 3] += (1 - share) * (self.odometry[:, :3, 3] - self.truth[:, :3, 3])
        return poses

    def _residuals(self, done: list[LoopEdit]) -> tuple[FactorResidual, ...]:
        poses, out = self._poses(done), []
        for index in range(1, KEYFRAMES):
            bend = 0.01 * abs(np.sin(index))
            out.append(FactorResidual((index - 1, index), False, 0.3 * bend, bend, 40 * bend))
        for edge in self._edges(done):
            if edge.verdict is Verdict.ACCEPTED:
                error = lie.inverse(edge.T_older_newer) @ lie.inverse(poses[edge.older]) @ poses[edge.newer]
                moved = float(np.linalg.norm(error[:3, 3]))
                turned = float(np.degrees(np.linalg.norm(lie.log(error[:3, :3]))))
                out.append(FactorResidual(edge.pair, True, turned, moved, moved / 0.1))
        return tuple(out)


def _measured(T_older_newer: np.ndarray, evidence: Evidence = Evidence()) -> tuple[np.ndarray, np.ndarray, Evidence]:  # noqa: B008 - a value
    return T_older_newer, 1e-4 * np.eye(6), evidence


def _found(truth: np.ndarray, rng: np.random.Generator) -> dict[Pair, LoopEdge]:
    def edge(pair: Pair, verdict: Verdict, reason: str, off: float, evidence: Evidence) -> LoopEdge:
        T = lie.inverse(truth[pair[0]]) @ truth[pair[1]]
        T[:3, 3] += rng.normal(0, off, 3)
        return LoopEdge(*pair, min(pair[1] + 8, KEYFRAMES - 1), *_measured(T, evidence), verdict, reason)

    edges = []
    for older in (4, 12, 27, 41, 55, 66):
        e = Evidence(0.08 + 0.02 * rng.random(), 0.71 + 0.1 * rng.random(), 0.014, 0.21, 0.006, np.inf,
                     1.1 + rng.random(), 0.62, 3)  # fmt: skip
        reason = f"overlap {100 * e.overlap:.0f} %, residual 14 mm, {e.mahalanobis:.1f} σ from odometry, 3 agree"
        edges.append(edge((older, older + LAP + 1), Verdict.ACCEPTED, reason, 0.02, e))
    for older in (18, 34, 60):
        e = Evidence(0.14, 0.52, 0.021, 0.12, 0.017, np.inf, 2.2, 0.7, 1)
        reason = "fits, but only 1 other agrees where 2 are asked for"
        edges.append(edge((older, older + LAP + 2), Verdict.CANDIDATE, reason, 0.05, e))
    for k in range(20):
        older, newer = int(rng.integers(0, LAP - 5)), int(rng.integers(LAP, KEYFRAMES))
        distance = 0.2 + 0.2 * rng.random()
        if k % 3 == 0:
            e = Evidence(distance)
            reason = f"Scan Contexts differ by {distance:.2f}, over 0.30"
        elif k % 3 == 1:
            e = Evidence(distance, 0.22, 0.047, 0.09, 0.02, np.inf, 4.4 + 3 * rng.random(), 0.8, 0)
            reason = "overlap 22 %, under 30 %"
        else:
            e = Evidence(distance, 0.61, 0.019, 0.001, 0.84, 6.2, 2.9, 0.8, 0)
            reason = "slides by 84 cm along the corridor, over 5 cm"
        edges.append(edge((older, newer), Verdict.REJECTED, reason, 0.6, e))
    return {edge.pair: edge for edge in edges}
