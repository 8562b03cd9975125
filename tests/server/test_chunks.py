"""If a map exceeds its budget of points, distant parts are thinned, and the removed points are stored nowhere.

Tests app/server/publisher.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.server import chunks as chunks_module
from app.server.chunks import COARSEST_LEVEL, MOST_SHOWN, at_level, next_to_thin, voxel_of_level, within_budget
from app.server.fold import Fold
from app.server.protocol import Chunk, Transport
from app.server.publisher import CHUNKS_AT_ONCE, Publisher
from app.slam.frames import READOUTS, Frame
from app.slam.log import Log
from app.slam.params import Params
from app.slam.types import Cloud, Keyframe

ALONG_M = 2.0


def chunk(index: int, points: int = 2000) -> Chunk:
    rng = np.random.default_rng(index)
    return Chunk(
        index=index,
        frame=5 * index,
        stamp_ns=index,
        points=rng.uniform(-6, 6, (points, 3)).astype(np.float32),
        labels=rng.integers(0, 3, points).astype(np.uint8),
        intensity=np.arange(points, dtype=np.float32),
        ring=np.zeros(points, np.uint16),
        T_imu_lidar=np.eye(4),
    )


def walk(keyframes: int) -> np.ndarray:
    """Poses (k, 4, 4) along x."""
    poses = np.tile(np.eye(4), (keyframes, 1, 1))
    poses[:, 0, 3] = ALONG_M * np.arange(keyframes)
    return poses


@given(st.integers(0, 1000), st.integers(1, 4))
def test_a_level_leaves_one_point_with_all_that_belongs_to_it_in_every_occupied_voxel(seed: int, levels: int) -> None:
    full = thin = chunk(seed, 400)
    for _ in range(levels):
        thin = at_level(thin, thin.level + 1)
    assert thin.level == levels
    assert np.array_equal(at_level(full, levels).intensity, thin.intensity), "at once as step by step"
    size = np.float32(1 / voxel_of_level(levels))
    cells = [tuple(cell) for cell in np.floor(thin.points * size).astype(int)]
    # levels nest: voxels of one are eight of the one before, so what is left of these fills all of those
    assert len(cells) == len(set(cells)) and set(cells) == {tuple(c) for c in np.floor(full.points * size).astype(int)}
    kept = thin.intensity.astype(int)
    assert np.array_equal(thin.points, full.points[kept]) and np.array_equal(thin.labels, full.labels[kept])
    assert (np.diff(kept) > 0).all()  # still in the random order


def test_a_map_within_its_budget_is_left_as_it_is() -> None:
    chunks = tuple(map(chunk, range(4)))
    assert within_budget(chunks, walk(4), np.zeros(3), 8000) is chunks


def test_the_farthest_of_the_finest_keyframes_is_thinned_first() -> None:
    positions = np.array([[0.0, 0, 0], [5.0, 0, 0], [9.0, 0, 0]])
    assert next_to_thin([0, 0, 0], positions, np.zeros(3)) == 2
    assert next_to_thin([0, 0, 1], positions, np.zeros(3)) == 1
    assert next_to_thin([0, 0, 0], positions, positions[2]) == 0


def test_of_equally_far_keyframes_the_oldest_is_thinned_first() -> None:
    assert next_to_thin([0, 0], np.array([[3.0, 0, 0], [-3.0, 0, 0]]), np.zeros(3)) == 0


def test_thinning_ends_where_nothing_is_left_to_thin() -> None:
    assert next_to_thin([COARSEST_LEVEL] * 2, np.zeros((2, 3)), np.zeros(3)) is None
    assert next_to_thin([], np.empty((0, 3)), np.zeros(3)) is None


class Session:
    """A session of keyframes along x, and a reader of it."""

    def __init__(self, budget: int) -> None:
        self.frames: Log[Frame] = Log()
        self.keyframes: list[Keyframe] = []
        self.page, self.fold = Publisher(Params()), Fold(point_budget=budget)
        self.page.begin(self.frames, self.keyframes)

    def add(self) -> None:
        T = walk(len(self.frames) + 1)[-1]
        one = chunk(len(self.keyframes))
        cloud = Cloud(one.points, one.labels, one.intensity, one.ring, np.zeros(len(one.points), np.int32))
        self.keyframes.append(Keyframe(one.index, one.frame, one.stamp_ns, T, np.eye(4), np.eye(6), cloud))
        self.frames.append(Frame(one.stamp_ns, True, T[:3, 3], np.array([0.0, 0, 0, 1]), np.zeros(len(READOUTS))))

    def show(self, frames: int) -> tuple[Chunk, ...]:
        """Everything that the reader shows at this frame."""
        self.page.put(transport=Transport(frame=frames - 1))
        while self.page.filled:
            self.fold.apply(self.page.take())
        return self.fold.snapshot.chunks


def test_a_reader_never_holds_more_points_than_its_budget() -> None:
    budget = 50_000
    session = Session(budget)
    for index in range(300):
        session.add()
        chunks = session.show(index + 1)
        assert len(chunks) == index + 1
        assert sum(len(one.points) for one in chunks) <= budget
    levels = [one.level for one in chunks]
    assert levels[0] > 0
    assert levels == sorted(levels, reverse=True)  # straight ahead: the farther, the coarser
    for one in chunks[:5]:  # a thinned chunk does not hold on to the whole one
        assert one.points.base is None or one.points.base.nbytes == one.points.nbytes


def test_keyframes_that_are_shown_again_are_as_they_were_and_within_the_budget() -> None:
    budget = 50_000
    session = Session(budget)
    for _ in range(300):
        session.add()
    some, every = session.show(120), session.show(300)
    assert (len(some), len(every)) == (120, 300)
    assert sum(len(one.points) for one in every) <= budget
    assert session.show(120) == every[:120], "levels never fall"


def test_labels_that_are_changed_over_and_over_make_the_map_no_coarser() -> None:
    session = Session(50_000)
    for _ in range(300):
        session.add()
    before = session.show(300)
    for keyframe in (0, 5, 299, 5):
        session.page.show_again(keyframe)
        after = session.show(300)
        assert [one.level for one in after] == [one.level for one in before]
        assert (
            np.array_equal(after[keyframe].points, before[keyframe].points) and after[keyframe] is not before[keyframe]
        )


def test_labels_changed_behind_where_the_session_was_taken_back_to_are_shown_when_it_is_there_again() -> None:
    session = Session(10**9)
    for _ in range(3):
        session.add()
    session.show(3)
    ahead = session.keyframes[1:]
    del session.keyframes[1:]  # their clouds cannot be read now; their frames stay known
    session.page.show_again(2)
    assert len(session.show(1)) == 1 and not session.page.filled
    cloud = ahead[1].cloud
    session.keyframes += [ahead[0], replace(ahead[1], cloud=replace(cloud, labels=np.ones_like(cloud.labels)))]
    assert (session.show(3)[2].labels == 1).all()


def test_a_reader_far_behind_gets_some_clouds_at_a_time() -> None:
    session = Session(10**9)
    for _ in range(3 * CHUNKS_AT_ONCE):
        session.add()
    session.page.put(transport=Transport(frame=3 * CHUNKS_AT_ONCE - 1))
    counts = []
    while session.page.filled:
        counts.append(len(session.fold.apply(session.page.take()).chunks))
    assert counts == [CHUNKS_AT_ONCE, 2 * CHUNKS_AT_ONCE, 3 * CHUNKS_AT_ONCE]


def drawn_with_all_points(keyframes: list[Chunk], poses: np.ndarray) -> tuple[Chunk, ...]:
    """What a reader holds at the end of a walk, with a budget for all points."""
    chunks: tuple[Chunk, ...] = ()
    for one in keyframes:
        chunks = within_budget((*chunks, one), poses, poses[one.index, :3, 3], 10**9)
    return chunks


def test_of_more_keyframes_than_a_page_can_draw_those_left_are_spread_over_the_whole_walk() -> None:
    """Walked slowly at first, so that keyframes are denser there."""
    count = MOST_SHOWN + 500
    poses = walk(count)
    poses[:, 0, 3] = np.cumsum(np.where(np.arange(count) < MOST_SHOWN // 2, 0.1, 0.4))
    chunks = drawn_with_all_points([chunk(index, 3) for index in range(count)], poses)
    shown = [one.index for one in chunks if len(one.points)]
    assert len(chunks) == count and len(shown) == MOST_SHOWN
    assert shown[0] == 0 and shown[-1] == count - 1
    gaps = np.diff(poses[shown, 0, 3])
    assert gaps.max() < 0.85
    assert sum(index < MOST_SHOWN // 2 for index in shown) < 0.3 * MOST_SHOWN, "the dense part is thinned first"


def test_where_one_turned_round_and_walked_back_the_map_is_spread_as_anywhere_else() -> None:
    """Each way back is a pace beside the way there: as the crow flies, there is hardly any way between the two."""
    count, turns = MOST_SHOWN + 500, 5
    poses = walk(count)
    along = np.arange(count) % (2 * turns)
    poses[:, 0, 3] = np.minimum(along, 2 * turns - along)
    chunks = drawn_with_all_points([chunk(index, 3) for index in range(count)], poses)
    assert max(len(one.points) for one in chunks) <= 3 * 3, "of at most three keyframes"


@pytest.mark.parametrize("levels", [1, 3])
def test_points_of_keyframes_that_share_a_cloud_stay_where_they_were_measured(
    levels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks_module, "MOST_SHOWN", 10)
    rng, poses = np.random.default_rng(1), walk(60)
    poses[:, :3, :3] = Rotation.random(60, rng=rng).as_matrix()
    T_imu_lidar = np.eye(4)
    T_imu_lidar[:3, :3], T_imu_lidar[:3, 3] = Rotation.random(rng=rng).as_matrix(), (0.1, -0.2, 0.3)
    names = [1000 * index + np.arange(50, dtype=np.float32) for index in range(60)]  # of every point, as intensity
    keyframes = [
        replace(chunk(i, 50), intensity=name, T_imu_lidar=T_imu_lidar, ring=np.full(50, i, np.uint16), level=i % levels)
        for i, name in enumerate(names)
    ]
    keyframes = [replace(one, points=one.points / np.float32(10)) for one in keyframes]  # many to a voxel

    def in_map(one: Chunk) -> np.ndarray:
        T = poses[one.index] @ one.T_imu_lidar
        return np.asarray(Rotation.from_matrix(T[:3, :3]).apply(one.points) + T[:3, 3])

    measured = dict(zip(np.concatenate(names), np.concatenate([in_map(one) for one in keyframes]), strict=True))
    labels = dict(zip(np.concatenate(names), np.concatenate([one.labels for one in keyframes]), strict=True))
    drawn = drawn_with_all_points(keyframes, poses)
    assert sum(len(one.points) > 0 for one in drawn) == 10
    left = np.concatenate([one.intensity for one in drawn])
    assert len(np.unique(left)) == len(left), "none is doubled"
    assert (len(left) == len(measured)) == (levels == 1), "none is lost but what others are there for"
    for one in drawn:
        if len(np.unique(one.ring)) > 1 and 0 < one.level < COARSEST_LEVEL:
            cells = np.floor(one.points * np.float32(1 / voxel_of_level(one.level)))
            assert len(np.unique(cells, axis=0)) == len(one.points), "one in each voxel"
        np.testing.assert_allclose(in_map(one), [measured[n] for n in one.intensity] or np.empty((0, 3)), atol=1e-4)
        assert np.array_equal(one.labels, [labels[name] for name in one.intensity])
        assert np.array_equal(one.ring, one.intensity // 1000)
        assert one.ring.max(initial=0) <= one.index, "going back shows nothing that was measured later"
    first = next(one for one in drawn if len(np.unique(one.ring)) > 3)
    assert len(set(first.ring[:50])) > 2, "the first points are a fair sample of all"
