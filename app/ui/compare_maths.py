"""What differs between two runs of one recording: pure functions on snapshots and clouds."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from app.server.protocol import Snapshot
from app.slam import lie
from app.slam.types import F64, I64, NON_GROUND, U8, Cloud
from app.ui.colours import LABEL_COLOURS, Rgb
from app.ui.paths import PATH_COLOUR

A_COLOUR: Final[Rgb] = PATH_COLOUR
B_COLOUR: Final[Rgb] = (77, 163, 255)
"""Pink and blue: told apart by every kind of colour vision, and from the labels' teal and amber."""

COLUMNS: Final = 600
"""Most values of a plot; of frames that share one, the largest is shown."""


class Ground(IntEnum):
    """What two runs say of a point. ALONE: it is in one of the two clouds only."""

    NEITHER = 0
    BOTH = 1
    ONLY_A = 2
    ONLY_B = 3
    ALONE = 4


GROUND_COLOURS: Final[U8] = np.array(
    [LABEL_COLOURS[NON_GROUND], LABEL_COLOURS[1], A_COLOUR, B_COLOUR, (74, 82, 96)], dtype=np.uint8
)
"""By `Ground`."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Of the frames that both runs have, from the fork on.

    Attributes:
        stamps_s: since the start of the recording. position_m: between the positions in the map; both
            begin at the same pose, so nothing is aligned. turn_deg: between the orientations in odom.
        total_ms, error_m: of A and of B; the latter nan without truth.
    """

    stamps_s: F64
    position_m: F64
    turn_deg: F64
    total_ms: tuple[F64, F64]
    error_m: tuple[F64, F64]

    def __len__(self) -> int:
        return len(self.stamps_s)


def common_frames(a: F64, b: F64) -> tuple[I64, I64]:
    """Where two ascending series of stamps hold the same ones: indices into each."""
    n = min(len(a), len(b))
    if np.array_equal(a[:n], b[:n]):
        return np.arange(n), np.arange(n)
    _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_a, in_b


def difference(a: Snapshot, b: Snapshot, since: int) -> Difference:
    """What differs between two runs of one recording from a frame of A on."""
    if a.trajectory is None or b.trajectory is None or "stamp_s" not in a.series or "stamp_s" not in b.series:
        nothing = np.empty(0)
        return Difference(nothing, nothing, nothing, (nothing, nothing), (nothing, nothing))
    in_a, in_b = common_frames(a.series["stamp_s"][max(since, 0) :], b.series["stamp_s"])
    in_a = in_a + max(since, 0)
    return Difference(
        stamps_s=a.series["stamp_s"][in_a],
        position_m=np.linalg.norm(a.trajectory[in_a] - b.trajectory[in_b], axis=1),
        turn_deg=turn(_turns(a)[in_a], _turns(b)[in_b]),
        total_ms=(a.series["total_ms"][in_a], b.series["total_ms"][in_b]),
        error_m=(a.series["error_m"][in_a], b.series["error_m"][in_b]),
    )


def _turns(snapshot: Snapshot) -> F64:
    return np.column_stack([snapshot.series[f"turn_{axis}"] for axis in "xyz"])


def turn(a: F64, b: F64) -> F64:
    """Angles (deg) between orientations given as (n, 3) rotation vectors; nan where one is."""
    angles = np.full(len(a), np.nan)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    between = np.swapaxes(lie.exp(a[known]), -1, -2) @ lie.exp(b[known])
    angles[known] = np.degrees(np.linalg.norm(lie.log(between), axis=-1))
    return angles


def ground_difference(a: Cloud, b: Cloud) -> U8:
    """(n,) `Ground` of the points of `a`, found in `b` by the moment and line at which they were measured."""
    found = np.full(len(a), Ground.ALONE, dtype=np.uint8)
    if len(a) == len(b) and np.array_equal(a.offsets_ns, b.offsets_ns) and np.array_equal(a.ring, b.ring):
        in_a = in_b = np.arange(len(a))
    else:
        _, in_a, in_b = np.intersect1d(_moments(a), _moments(b), return_indices=True)
    ground_a, ground_b = a.labels[in_a] != NON_GROUND, b.labels[in_b] != NON_GROUND
    found[in_a] = np.where(
        ground_a,
        np.where(ground_b, Ground.BOTH, Ground.ONLY_A),
        np.where(ground_b, Ground.ONLY_B, Ground.NEITHER),
    )
    return found


def _moments(cloud: Cloud) -> I64:
    return cloud.offsets_ns.astype(np.int64) * 65536 + cloud.ring


def thinned(stamps: F64, *columns: F64) -> tuple[F64, ...]:
    """Stamps and columns with at most `COLUMNS` values each; those with a nan in any column are left out."""
    known = np.isfinite(stamps) & np.all([np.isfinite(column) for column in columns], axis=0)
    stamps, columns = stamps[known], tuple(column[known] for column in columns)
    if not len(stamps):
        return tuple(np.zeros(1) for _ in range(1 + len(columns)))
    starts = np.unique(np.arange(COLUMNS) * len(stamps) // COLUMNS)
    return (stamps[starts], *(np.maximum.reduceat(column, starts) for column in columns))
