"""Differences between two runs of one recording, in numbers and words: pure functions on snapshots and clouds."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from app.server.fork import same_recording
from app.server.protocol import Snapshot
from app.slam import lie
from app.slam.types import F64, I64, NON_GROUND, U8, Cloud
from app.ui.colours import LABEL_COLOURS, Rgb
from app.ui.html import BAD, WARN, Tile, number, panel
from app.ui.nodes import PATH_COLOUR
from app.ui.transport import working

A_COLOUR: Final[Rgb] = PATH_COLOUR
B_COLOUR: Final[Rgb] = (77, 163, 255)
"""Pink and blue: distinct for every kind of colour vision, also from the labels' teal and amber."""

COLUMNS: Final = 600
"""Most values in a plot; if several frames share one, the largest is shown."""


class Labelled(IntEnum):
    """Which of A and B label a point ground. ALONE: the point is in one of the two clouds only."""

    NEITHER = 0
    BOTH = 1
    ONLY_A = 2
    ONLY_B = 3
    ALONE = 4


GROUND_COLOURS: Final[U8] = np.array(
    [LABEL_COLOURS[NON_GROUND], LABEL_COLOURS[1], A_COLOUR, B_COLOUR, (74, 82, 96)], dtype=np.uint8
)
"""By `Labelled`."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Differences in the frames that both runs have, from the fork on.

    Attributes:
        stamps_s: since the start of the recording. position_m: distance between the positions before the maps were
            levelled; both start at the same pose, so nothing is aligned. turn_deg: angle between the orientations in
            odom.
        total_ms, error_m: of A and of B; the error is NaN without truth.
    """

    stamps_s: F64
    position_m: F64
    turn_deg: F64
    total_ms: tuple[F64, F64]
    error_m: tuple[F64, F64]

    def __len__(self) -> int:
        return len(self.stamps_s)


def common_frames(a: F64, b: F64) -> tuple[I64, I64]:
    """Indices of the common stamps in two ascending series."""
    _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_a, in_b


def difference(a: Snapshot, b: Snapshot, since: int) -> Difference:
    """The differences between two runs of one recording, from a frame of A on."""
    in_a, in_b = common_frames(a.series["stamp_s"][max(since, 0) :], b.series["stamp_s"])
    in_a = in_a + max(since, 0)
    return Difference(
        stamps_s=a.series["stamp_s"][in_a],
        position_m=np.linalg.norm(_positions(a)[in_a] - _positions(b)[in_b], axis=1),
        turn_deg=turn(_turns(a)[in_a], _turns(b)[in_b]),
        total_ms=(a.series["total_ms"][in_a], b.series["total_ms"][in_b]),
        error_m=(a.series["error_m"][in_a], b.series["error_m"][in_b]),
    )


def _positions(snapshot: Snapshot) -> F64:
    """(n, 3) m, the trajectory before one rotation levelled the whole map, which happens first to the run that ends."""
    turns = snapshot.adjustment.T_map_odom
    return lie.moved(lie.inverse(turns[0]), snapshot.trajectory) if len(turns) == 1 else snapshot.trajectory


def _turns(snapshot: Snapshot) -> F64:
    return np.column_stack([snapshot.series[f"turn_{axis}"] for axis in "xyz"])


def turn(a: F64, b: F64) -> F64:
    """Angles (deg) between orientations given as (n, 3) rotation vectors; NaN where either is NaN."""
    angles = np.full(len(a), np.nan)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    between = np.swapaxes(lie.exp(a[known]), -1, -2) @ lie.exp(b[known])
    angles[known] = np.degrees(np.linalg.norm(lie.log(between), axis=-1))
    return angles


def ground_difference(a: Cloud, b: Cloud) -> U8:
    """(n,) `Labelled` of the points of `a`, matched to those of `b` by measurement time and scan line."""
    found = np.full(len(a), Labelled.ALONE, dtype=np.uint8)
    if len(a) == len(b) and np.array_equal(a.offsets_ns, b.offsets_ns) and np.array_equal(a.ring, b.ring):
        in_a = in_b = np.arange(len(a))
    else:
        _, in_a, in_b = np.intersect1d(_moments(a), _moments(b), return_indices=True)
    ground_a, ground_b = a.labels[in_a] != NON_GROUND, b.labels[in_b] != NON_GROUND
    found[in_a] = np.where(
        ground_a,
        np.where(ground_b, Labelled.BOTH, Labelled.ONLY_A),
        np.where(ground_b, Labelled.ONLY_B, Labelled.NEITHER),
    )
    return found


def _moments(cloud: Cloud) -> I64:
    return cloud.offsets_ns.astype(np.int64) * 65536 + cloud.ring


def thinned(stamps: F64, *columns: F64) -> tuple[F64, ...]:
    """Stamps and columns with at most `COLUMNS` values each; rows with a NaN in any column are left out."""
    known = np.isfinite(stamps) & np.all([np.isfinite(column) for column in columns], axis=0)
    stamps, columns = stamps[known], tuple(column[known] for column in columns)
    if not len(stamps):
        return tuple(np.zeros(1) for _ in range(1 + len(columns)))
    starts = np.unique(np.arange(COLUMNS) * len(stamps) // COLUMNS)
    return (stamps[starts], *(np.maximum.reduceat(column, starts) for column in columns))


# --- words ---------------------------------------------------------------------------------------
def status(a: Snapshot, b: Snapshot | None, names: tuple[str, str], forked_at: int) -> str:
    """The names of A and B and the state of B; without a fork, what a fork is for."""
    if b is None:
        return panel("no_fork", a.live is not None)
    return panel("fork", names, forked_at, (A_COLOUR, B_COLOUR), *how(a, b))


def how(a: Snapshot, b: Snapshot) -> tuple[str, str]:
    """The state of B in a sentence, and its colour."""
    if not b.engine_alive:
        return "B's engine has stopped; A is not affected. Keep what B has, or discard it.", BAD
    if b.progress is not None:
        return working(b.progress), WARN
    if b.recording is None:
        return "B is starting …", WARN
    if not same_recording(a, b):
        return "A has opened another recording or part of it; B stays at its frame.", WARN
    behind = a.transport.frame - b.transport.frame
    unsaved = {saved.error for saved in b.saved}  # a failed save does not count as B's trouble
    errors = [one.text for one in b.notices if one.level == "error" and one.text not in unsaved]
    trouble = errors[-1] if errors else ""
    if abs(behind) > 1:
        ended = ", where its part of the recording ends" if behind > 0 and b.transport.finished else ""
        return f"B is {abs(behind):,} frames {'behind' if behind > 0 else 'ahead'}{ended}. {trouble}".strip(), WARN
    return (f"B: {trouble}", BAD) if trouble else ("", "")


def legend() -> str:
    names = ("ground only in A", "only in B", "both", "neither")
    return panel("keys", list(zip((A_COLOUR, B_COLOUR, LABEL_COLOURS[1], LABEL_COLOURS[0]), names, strict=True)), True)


def numbers(found: Difference, counts: I64 | None) -> str:
    """Tiles for the newest common frame: distance, ground labels, frame times and errors.

    Args:
        counts: points by `Labelled`; None while there is no common frame.
    """
    if not len(found):
        return ""
    turned = found.turn_deg[np.isfinite(found.turn_deg)]
    farthest = f"at most {number(100 * float(found.position_m.max()), 1)} cm"
    most = f"at most {number(float(turned.max()) if len(turned) else np.nan)}°"
    apart = [
        Tile("A to B", number(100 * float(found.position_m[-1]), 1), "cm", farthest, width="half"),
        Tile("turned", number(float(found.turn_deg[-1])), "°", most, width="half"),
    ]
    ground = []
    if counts is not None:
        alone = counts[Labelled.ALONE]
        ground = [
            Tile("only in A", f"{counts[Labelled.ONLY_A]:,}"),
            Tile("only in B", f"{counts[Labelled.ONLY_B]:,}"),
            Tile("in both", f"{counts[Labelled.BOTH]:,}", "", f"{alone:,} points of A are not in B" if alone else ""),
        ]
    means = []
    (ms_a, ms_b), (error_a, error_b) = found.total_ms, found.error_m
    if (known := np.isfinite(ms_a) & np.isfinite(ms_b)).any():
        a, b = (number(float(ms[known].mean()), 1) for ms in (ms_a, ms_b))
        means.append(Tile("frame, mean of A → B", f"{a} → {b}", "ms", width="wide"))
    if (known := np.isfinite(error_a) & np.isfinite(error_b)).any():
        a, b = (number(100 * float(np.sqrt(np.mean(error[known] ** 2))), 1) for error in (error_a, error_b))
        means.append(Tile("error to truth, RMS of A → B", f"{a} → {b}", "cm", width="wide"))
    return panel("comparison", apart, ground, means)
