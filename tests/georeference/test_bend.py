"""Bend a drifted map to fixes. Oracle: the true walk."""

from dataclasses import replace

import numpy as np
import pytest

from app.georeference.align import Alignment, align
from app.georeference.bend import bend
from app.georeference.ledger import summary
from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.factors import Factor
from app.slam.map_frame import corrected
from app.slam.trajectory import Trajectory
from app.slam.types import F64
from tests.georeference.walks import LEVER, TRUTH, Walked, walked

STEP = 10
"""Scans between keyframes."""


@pytest.fixture(scope="module")
def made() -> Walked:
    return walked(rate_hz=4.0, duration_s=60.0)


@pytest.fixture(scope="module")
def drifted(made: Walked) -> Trajectory:
    """The walk by an odometry that turns by 0.02° in each scan."""
    steps = lie.inverse(made.trajectory.poses[:-1]) @ made.trajectory.poses[1:]
    up = np.swapaxes(made.trajectory.poses[1:, :3, :3], 1, 2) @ np.array([0.0, 0.0, np.radians(0.02)])
    poses = [made.trajectory.poses[0]]
    for step, turn in zip(steps, up, strict=True):
        poses.append(poses[-1] @ step @ lie.transform(lie.exp(turn), np.zeros(3)))
    return Trajectory.from_poses(made.trajectory.stamps_ns, poses)


def solved(
    made: Walked, drifted: Trajectory, *, offset_known: bool = True, overridden: dict[str, bool] | None = None
) -> tuple[F64, Alignment, Alignment]:
    """(k, 4, 4) corrections, and the alignments after and before."""
    keyframes = drifted.poses[::STEP]
    noise = np.diag([np.radians(0.3)] * 3 + [0.01] * 3) ** 2
    graph = [
        Factor(KeyframeId(0, k), KeyframeId(0, k + 1), lie.inverse(keyframes[k]) @ keyframes[k + 1], noise)
        for k in range(len(keyframes) - 1)
    ]
    found = align(drifted, made.fixes, grid="EPSG:32632", lever=LEVER)
    if not offset_known:
        found = replace(found, offset_s=0.0, offset_sigma_s=float("nan"))
    return *bend(drifted, drifted.stamps_ns[::STEP], graph, made.fixes, found, overridden or {}), found


def test_a_map_that_turned_by_12_degrees_is_bent_back_to_where_it_was(made: Walked, drifted: Trajectory) -> None:
    corrections, after, before = solved(made, drifted)
    poses = corrected(drifted.stamps_ns, drifted.poses, drifted.stamps_ns[::STEP], corrections)
    bent = Trajectory.from_poses(drifted.stamps_ns, poses)
    true = TRUTH.to_crs(made.trajectory.positions)
    errors = [
        np.linalg.norm(found.reference.to_crs(path.positions) - true, axis=1)
        for found, path in ((before, drifted), (after, bent))
    ]
    assert errors[0].max() > 0.5 and np.sqrt((errors[1] ** 2).mean()) < 0.03
    rejected = {int(name) for name, used in zip(after.names, after.used, strict=True) if not used}
    assert {n for n in made.outliers.tolist() if str(n) in after.names} <= rejected
    assert after.rms.max() < 0.03 < before.rms.max()


def test_fixes_leave_a_map_that_has_not_drifted_as_it_is(made: Walked) -> None:
    """The graph expects 0.3° of drift a step, so noise of 2 cm could turn keyframes and what they saw far away."""
    corrections, after, _ = solved(made, made.trajectory)
    far = np.random.default_rng(0).uniform((-20, -20, -2), (20, 20, 4), (100, 3))
    own = made.trajectory.poses[::STEP]
    seen, bent = (far @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3] for T in (own, corrections @ own))
    off = after.reference.to_crs(bent.reshape(-1, 3)) - TRUTH.to_crs(seen.reshape(-1, 3))
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.03


def test_the_clock_offset_is_found_although_the_map_drifts(made: Walked, drifted: Trajectory) -> None:
    """To an alignment, the drift looks like an offset."""
    _, after, before = solved(made, drifted)
    assert abs(before.offset_s - 0.08) > 0.05
    assert abs(after.offset_s - 0.08) < 4 * after.offset_sigma_s < 0.02
    _, after, before = solved(made, made.trajectory)
    assert abs(after.offset_s - 0.08) < 4 * after.offset_sigma_s < 0.012, "its drift is not known to be none"


def test_the_users_word_on_a_fix_overrides_the_verdict(made: Walked, drifted: Trajectory) -> None:
    wild, sound = str(made.outliers[2]), next(str(n) for n in range(30, 99) if n not in made.outliers)
    _, after, _ = solved(made, drifted, overridden={wild: True, sound: False})
    verdict = dict(zip(after.names, after.used.tolist(), strict=True))
    assert verdict[wild] and not verdict[sound]


def test_a_clock_offset_that_the_motion_does_not_determine_is_not_looked_for_again(
    made: Walked, drifted: Trajectory
) -> None:
    _, after, _ = solved(made, drifted, offset_known=False)
    lines = "\n".join(summary(after, "fixes"))
    assert after.offset_s == 0.0 and "Clock offset" not in lines
    assert "Lever arm          0.100 -0.200 0.450 m\n" in lines  # as given
