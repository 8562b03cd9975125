"""From a keyframe to candidates with evidence: place recognition and registration.

A keyframe is searched once all keyframes of its submap have come and odometry between them can be judged. Then its
surroundings are as dense as those of the older keyframes that it is compared with.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops import scan_context, slips, verification
from app.slam.loops.drift import Expectation
from app.slam.loops.scan_context import ScanContext
from app.slam.loops.slips import Slip
from app.slam.loops.submap import Submaps
from app.slam.loops.types import LoopDetail
from app.slam.loops.verification import Prepared
from app.slam.sections import LoopsParams
from app.slam.types import F64, I64, Cloud, Keyframe, Mask

NEAR_M = 3.0
"""Added to the reach of drift: places this far apart still share a view."""
FAR_M = 40.0
"""Reach of submaps where little stands upright nearby, as on a plaza."""
WIDER = 2.0
"""Odometry that slipped is farther off than the drift model allows, so the search reaches this many times as far."""
KEPT_PREPARED = 16
"""Submaps that stay in memory, ready for registration: the newer one, older ones, which are often met again, and clouds
on one side of a step: `slips.REACH` steps later, they are on the other side."""
KEPT_SUBMAPS = 1
"""Other submaps that stay in memory: the one just described is needed again."""
_NUMBERS = np.empty(0, np.float32)
_NO_POINTS = Cloud(_NUMBERS, np.empty(0, np.uint8), _NUMBERS, np.empty(0, np.uint16), np.empty(0, np.int32))


@dataclass(frozen=True, slots=True)
class Sighting:
    """A place that looks like an older one.

    Attributes:
        older, newer: keyframes. distance: between their contexts at the best column shift.
    """

    older: KeyframeId
    newer: KeyframeId
    distance: float


class Detector:
    """Describes and compares keyframes: the first `len` of those it was given.

    Args:
        params: only those that act on restart are read here.

    Attributes:
        half: number of keyframes on either side of a keyframe that form its submap with it. ahead: number that must
            follow before its surroundings are known: its submap, and whether odometry slipped there.
    """

    def __init__(self, params: LoopsParams) -> None:
        self.half = params.submap_keyframes
        self.ahead = self.half + slips.REACH - 1
        self._submaps = Submaps(params.submap_voxel, scan_context.RADIUS, FAR_M)
        self._around = lru_cache(KEPT_SUBMAPS)(
            lambda index, first, last, far=False: self._submaps.around(index, self._poses, first, last, far=far)
        )
        self._prepared = lru_cache(KEPT_PREPARED)(lambda *key: verification.prepare(self._around(*key)))
        self._slips: dict[tuple[int, int], Slip | None] = {}
        self._heads: list[Keyframe] = []
        self._poses = np.empty((0, 4, 4))
        self._stamps = np.empty(0, np.int64)
        self._resumed, self._astray = np.empty(0, np.bool_), np.empty(0)
        self._contexts: list[ScanContext] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def head(self, index: int) -> Keyframe:
        """A keyframe without its points; it may lie beyond the present one."""
        return self._heads[index]

    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_odom_imu."""
        return self._poses[: len(self)]

    @property
    def resumed(self) -> Mask:
        """(k,) whether each keyframe is the first after a pause."""
        return self._resumed[: len(self)]

    @property
    def astray(self) -> F64:
        """(k,) m, `Keyframe.astray` of each."""
        return self._astray[: len(self)]

    @property
    def pauses_before(self) -> I64:
        """(k,) number of pauses before each."""
        return np.cumsum(self.resumed)

    def take(self, keyframe: Keyframe) -> None:
        """Add a keyframe after the present one, which must be the last that was taken, and go to it."""
        self._heads.append(replace(keyframe, cloud=_NO_POINTS))
        self._poses = np.concatenate([self._poses, keyframe.T_odom_imu[None]])
        self._stamps = np.append(self._stamps, keyframe.stamp_ns)
        self._resumed = np.append(self._resumed, keyframe.resumed_ns > 0)
        self._astray = np.append(self._astray, keyframe.astray)
        self._submaps.append(keyframe)
        self._count += 1

    def go_to(self, count: int) -> None:
        """Go to the first `count` keyframes that were taken."""
        self._count = count

    def forget(self) -> None:
        """Forget the keyframes beyond the present one."""
        if len(self._heads) == len(self):
            return
        del self._heads[len(self) :]
        self._poses, self._stamps = self.poses, self._stamps[: len(self)]
        self._resumed, self._astray = self.resumed, self.astray
        self._submaps.truncate(len(self))
        del self._contexts[max(len(self) - self.half, 0) :]
        self._around.cache_clear()
        self._prepared.cache_clear()
        self._slips.clear()

    def close(self) -> None:
        self._submaps.close()

    def context(self, index: int) -> ScanContext:
        """The context of a keyframe, from the keyframes around it; kept once all of these have come."""
        if index + self.half >= len(self):
            return self._describe(index)
        while len(self._contexts) <= index:
            self._contexts.append(self._describe(len(self._contexts)))
        return self._contexts[index]

    def submap(self, index: int, *, wide: bool = False) -> Prepared:
        """The submap from the keyframes around this one, up to the nearest slip of odometry on either side."""
        first, last = self._span(index, self.half, self.half)
        before, after = range(index, first, -1), range(index + 1, last + 1)
        first = next((k for k in before if self.slip(k) is not None), before.stop)
        end = next((k for k in after if self.slip(k) is not None), after.stop) - 1
        return self._prepared(index, first, end, wide)

    def slip(self, index: int) -> Slip | None:
        """How odometry slipped on the step to a keyframe, from the few keyframes on each side; see `slips`.

        None across a pause, where odometry is a guess.
        """
        if self._resumed[index]:
            return None
        first, last = self._span(index, slips.REACH, slips.REACH - 1)
        if (index, last) not in self._slips:
            before, after = self._prepared(first, first, index - 1), self._prepared(index, index, last)
            self._slips[index, last] = slips.slip(before, after, self.guess(first, index, self._poses))
        return self._slips[index, last]

    def T_level_imu(self, index: int) -> F64:
        """(4, 4) from a keyframe's IMU frame to its level frame: a rotation."""
        return lie.transform(self.poses[index, :3, :3], np.zeros(3))

    def look(self, newer: int, expectation: Expectation, params: LoopsParams) -> list[Sighting]:
        """Older places that look like this keyframe's, the most similar first, each well apart from the others."""
        p, here = params, self.context(newer)  # made now even if there is nothing to compare, so that no work piles up
        candidates = self._eligible(newer, expectation, p)
        if not len(candidates):
            return []
        keys = np.array([self.context(older).ring_key for older in candidates])
        ranks = np.arange(1, min(p.candidates, len(candidates)) + 1)
        _, nearest = KDTree(keys).query(here.ring_key, k=ranks)  # type: ignore[no-untyped-call]  # no types
        sightings = [self._compare(int(older), newer, here, expectation, p) for older in candidates[nearest]]
        chosen: list[Sighting] = []
        for sighting in sorted(sightings, key=lambda s: s.distance):
            where = self.poses[sighting.older, :3, 3]
            if all(np.linalg.norm(where - self.poses[other.older, :3, 3]) > NEAR_M for other in chosen):
                chosen.append(sighting)
        return chosen[: p.verified]

    def guess(self, older: int, newer: int, poses: F64) -> F64:
        """(4, 4) T_older_newer of the level frames, by poses T_map_imu of all keyframes."""
        return self.level(older, newer, lie.inverse(poses[older]) @ poses[newer])

    def level(self, older: int, newer: int, T_older_newer: F64) -> F64:
        """(4, 4) T_older_newer of the level frames from that of the IMU frames."""
        return np.asarray(self.T_level_imu(older) @ T_older_newer @ lie.inverse(self.T_level_imu(newer)))

    def from_level(self, older: int, newer: int, T_level: F64) -> F64:
        """The inverse of `level`."""
        return np.asarray(lie.inverse(self.T_level_imu(older)) @ T_level @ self.T_level_imu(newer))

    def both(self, older: int, newer: int) -> tuple[Prepared, Prepared]:
        """The submaps of both. They reach farther if one place is bare. The newer is made first: it is needed again."""
        source = self.submap(newer)
        target = self.submap(older)
        if source.bare or target.bare:
            source = self.submap(newer, wide=True)
            target = self.submap(older, wide=True)
        return target, source

    def detail(self, older: int, newer: int, poses: F64, T_older_newer: F64 | None) -> LoopDetail:
        """Both places, and how well they fit.

        Args:
            poses: (k, 4, 4) T_map_imu. T_older_newer: a loop's measurement; None: by the graph's poses.
        """
        guess = T = self.guess(older, newer, poses)
        if T_older_newer is not None:
            T = self.level(older, newer, T_older_newer)
        a, b = self.context(older), self.context(newer)
        return LoopDetail(
            older=self.submap(older).submap.points,
            newer=self.submap(newer).submap.points,
            T_imu_level=lie.inverse(self.T_level_imu(older)),
            T_guess=guess,
            T_registered=T,
            older_context=np.where(a.seen, a.cells, np.float32(np.nan)),
            newer_context=np.where(b.seen, b.cells, np.float32(np.nan)),
            shift_distances=scan_context.shift_distances(a, b),
            residuals=verification.assess(*self.both(older, newer), T).residuals,
        )

    def _eligible(self, newer: int, expectation: Expectation, params: LoopsParams) -> I64:
        """Keyframes old enough and within the reach of drift."""
        old = self._stamps[: newer + 1] <= self._stamps[newer] - round(params.min_time * 1e9)
        old[: self._begin(newer)] = True
        old = np.flatnonzero(old)
        away = np.linalg.norm(expectation.poses[old, :3, 3] - expectation.poses[newer, :3, 3], axis=1)
        reach = WIDER * params.max_mahalanobis * expectation.position_sigmas()[old] + NEAR_M
        return np.asarray(old[away < reach])

    def _compare(
        self, older: int, newer: int, here: ScanContext, expectation: Expectation, params: LoopsParams
    ) -> Sighting:
        """Compare an older place with `here`, the newer one, at the column shifts that odometry allows."""
        distances = scan_context.shift_distances(self.context(older), here)
        expected = self.guess(older, newer, expectation.poses)
        yaw = np.arctan2(expected[1, 0], expected[0, 0])
        sigma = np.sqrt(expectation.covariance(older)[2, 2])
        away = np.abs(_wrapped(scan_context.YAWS - yaw))
        allowed = away <= WIDER * params.max_mahalanobis * sigma + scan_context.SECTOR
        distance = float(np.where(allowed, distances, np.inf).min())
        return Sighting(KeyframeId(0, older), KeyframeId(0, newer), distance)

    def _span(self, index: int, back: int, ahead: int) -> tuple[int, int]:
        """The first and the last keyframe, at most `back` before and `ahead` after this one, with no pause between."""
        end = min(len(self), index + ahead + 1)
        paused = np.flatnonzero(self._resumed[index + 1 : end])
        return max(self._begin(index), index - back), index + int(paused[0]) if len(paused) else end - 1

    def _begin(self, index: int) -> int:
        """The first keyframe after the last pause before this one; without a pause, the first of all."""
        paused = np.flatnonzero(self._resumed[: index + 1])
        return int(paused[-1]) if len(paused) else 0

    def _describe(self, index: int) -> ScanContext:
        return scan_context.describe(self._around(index, *self._span(index, self.half, self.half)).points)


def _wrapped(angle: npt.NDArray[np.float64]) -> F64:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
