"""What the inspector shows: one candidate's evidence in full, and how far each factor is from being met."""

from collections.abc import Sequence

import numpy as np

from app.slam import lie
from app.slam.loops import scan_context, se3
from app.slam.loops.detection import Detector
from app.slam.loops.factors import Factor
from app.slam.loops.types import FactorResidual, LoopDetail
from app.slam.types import F64


def detail(detector: Detector, older: int, newer: int, poses: F64, T_older_newer: F64 | None) -> LoopDetail:
    """Both places, and how they fit at a loop's measurement; None: as the graph has them.

    Args:
        poses: (k, 4, 4) T_map_imu.
    """
    guess = T = detector.guess(older, newer, poses)
    if T_older_newer is not None:
        T = detector.T_level_imu(older) @ T_older_newer @ lie.inverse(detector.T_level_imu(newer))
    a, b = detector.context(older), detector.context(newer)
    return LoopDetail(
        older=detector.submap(older).submap.points,
        newer=detector.submap(newer).submap.points,
        T_imu_level=lie.inverse(detector.T_level_imu(older)),
        T_guess=guess,
        T_registered=T,
        older_context=np.where(a.seen, a.cells, np.float32(np.nan)),
        newer_context=np.where(b.seen, b.cells, np.float32(np.nan)),
        shift_distances=scan_context.shift_distances(a, b),
        residuals=detector.assess(older, newer, T).residuals,
    )


def residuals(factors: Sequence[Factor], poses: F64) -> tuple[FactorResidual, ...]:
    """Of every factor, by poses (k, 4, 4)."""
    if not factors:
        return ()
    first, second = np.array([(f.first.index, f.second.index) for f in factors]).T
    measured = np.array([f.T_first_second for f in factors])
    errors = se3.log(lie.inverse(measured) @ lie.inverse(poses[first]) @ poses[second])
    whitened = np.linalg.solve(np.array([f.covariance for f in factors]), errors[..., None])[..., 0]
    sigmas = np.sqrt(np.einsum("ni,ni->n", errors, whitened))
    turned = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    moved = np.linalg.norm(errors[:, 3:], axis=1)
    rows = zip(factors, turned.tolist(), moved.tolist(), sigmas.tolist(), strict=True)
    return tuple(FactorResidual(f.name, f.robust, r, t, s) for f, r, t, s in rows)
