"""Odometry from keyframe to keyframe: any stretch as one measurement, and the poses within a stretch.

A pose that no loop ties can be left out of the graph without loss, if the odometry across it is one factor. Once the
poses at the ends of a stretch are known, the most likely poses between them follow in closed form: the error at the
far end is distributed over the steps by their covariances (a Gaussian random walk conditioned on its end; errors are
right perturbations, carried by the adjoint, Barfoot 2017).
"""

import numpy as np

from app.slam import lie
from app.slam.rows import Rows
from app.slam.types import F64, I64


class Chain:
    """Poses one after the other, each with the covariance (6, 6) of the step to it, rotation then translation.

    Args:
        first: (4, 4).
    """

    def __init__(self, first: F64) -> None:
        self._poses = Rows((4, 4), np.float64, [first])
        self._covariances = Rows((6, 6), np.float64, [np.zeros((6, 6))])

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> F64:
        """(n, 4, 4), by odometry alone."""
        return self._poses.view()

    def append(self, T_before_after: F64, covariance: F64) -> None:
        """One more step."""
        self._poses.append(self._poses.view()[-1] @ T_before_after)
        self._covariances.append(covariance)

    def between(self, first: int, second: int) -> tuple[F64, F64]:
        """The pose (4, 4) of `second` as seen from `first`, an earlier one, and its covariance (6, 6)."""
        poses = self._poses.view()
        covariance = self._steps(first, np.full(second - first, second))[1].sum(axis=0)
        return lie.inverse(poses[first]) @ poses[second], (covariance + covariance.T) / 2

    def bent(self, ends: I64, T_ends: F64, stop: int) -> F64:
        """The most likely poses from ends[0] to before `stop`, given the poses at the ends.

        Args:
            ends: (m,), rising. T_ends: (m, 4, 4), their poses.

        Returns:
            (stop - ends[0], 4, 4); after the last end, odometry continues.
        """
        first, last = int(ends[0]), int(ends[-1])
        poses = self._poses.view()
        out = np.empty((stop - first, 4, 4))
        beyond = T_ends[-1] @ lie.inverse(poses[last])
        out[last - first :] = beyond @ poses[last:stop]
        if last > first:
            stretch = np.searchsorted(ends, np.arange(first + 1, last + 1)) - 1  # of each pose after the first
            T_end_each, steps = self._steps(first, ends[stretch + 1])
            walked = np.cumsum(np.concatenate([np.zeros((1, 6, 6)), steps]), axis=0)
            starts = walked[ends - first]  # of each stretch; the last one starts none
            expected = T_ends[:-1] @ lie.inverse(poses[ends[:-1]]) @ poses[ends[1:]]
            missed = lie.log_se3(lie.inverse(expected) @ T_ends[1:])
            pull = np.linalg.solve(np.diff(starts, axis=0), missed[..., None])[..., 0]
            shares = np.einsum("nij,nj->ni", walked[1:] - starts[stretch], pull[stretch])
            out[1 : last - first + 1] = expected[stretch] @ lie.exp_se3(shares) @ T_end_each
        out[ends - first] = T_ends
        return out

    def _steps(self, before: int, ends: I64) -> tuple[F64, F64]:
        """The poses after `before`, each relative to its end in `ends`.

        Returns:
            (n, 4, 4) poses, and (n, 6, 6) covariances of the steps to them, at the ends.
        """
        own = slice(before + 1, before + 1 + len(ends))
        poses = self._poses.view()
        T_end_own = lie.inverse(poses[ends]) @ poses[own]
        carry = lie.adjoint(T_end_own)
        return T_end_own, carry @ self._covariances.view()[own] @ np.swapaxes(carry, -1, -2)
