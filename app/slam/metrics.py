"""Errors of a trajectory against the truth, and scores of ground labels.

Errors follow Sturm et al. (IROS 2012, "A benchmark for the evaluation of RGB-D SLAM systems") and
equal those of the `evo` tool, except that truth is interpolated at our stamps.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from app.slam.errors import HemislamError
from app.slam.trajectory import Trajectory, count_text
from app.slam.types import F64, I64, NON_GROUND, U8

RPE_METRES = (1.0, 10.0, 50.0)
RPE_OVER = ("1 frame", *(f"{metres:g} m" for metres in RPE_METRES))
"""Distances over which relative errors are reported, and their names."""
MAX_TRUTH_GAP_S = 1.0
"""Truth is not interpolated between poses farther apart than this."""
MAX_ALIGNMENT_DEG = 5.0
"""Where the alignment is less certain than this, a rotation error after it would only show the alignment."""
_FINEST_M = 1e-6
"""Least position error assumed. Without it, rounding alone would fix the rotation of a straight line."""


# --- association and alignment -------------------------------------------------------------------
def interpolate(truth: Trajectory, stamps_ns: I64) -> tuple[Trajectory, npt.NDArray[np.bool_]]:
    """Truth at the given stamps: positions linearly, orientations by slerp.

    Returns the interpolated poses, and a mask over `stamps_ns` of those that have one: inside the time of the truth
    and not in a gap longer than MAX_TRUTH_GAP_S.
    """
    places = places_at(truth.stamps_ns, truth.positions, stamps_ns)
    usable = np.isfinite(places[:, 0])
    stamps, positions = stamps_ns[usable], places[usable]
    if not len(stamps):
        return Trajectory(stamps, positions, np.zeros((0, 4))), usable
    since_start = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    quaternions = Slerp(since_start, truth.rotations)((stamps - truth.stamps_ns[0]) * 1e-9).as_quat()
    return Trajectory(stamps, positions, quaternions), usable


def places_at(truth_ns: I64, positions: F64, stamps_ns: I64) -> F64:
    """(n, 3) true positions at `stamps_ns` (n,), linear between poses (m, 3) at `truth_ns` (m,).

    nan outside their time and in gaps longer than MAX_TRUTH_GAP_S.
    """
    right = np.searchsorted(truth_ns, stamps_ns).clip(1, len(truth_ns) - 1)
    before, after = truth_ns[right - 1], truth_ns[right]
    fraction = ((stamps_ns - before) / (after - before))[:, None]
    places: F64 = (1 - fraction) * positions[right - 1] + fraction * positions[right]
    exact = (stamps_ns == before) | (stamps_ns == after)
    outside = (stamps_ns < truth_ns[0]) | (stamps_ns > truth_ns[-1])
    places[outside | (~exact & (after - before > MAX_TRUTH_GAP_S * 1e9))] = np.nan
    return places


def paired(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Estimated and true poses at the same stamps.

    Raises:
        HemislamError: fewer than 3 stamps of the estimate have a truth.
    """
    there, usable = interpolate(truth, estimate.stamps_ns)
    if len(there) >= 3:
        return estimate.chosen(usable), there
    if len(estimate) < 3:
        raise HemislamError(
            f"The trajectory holds {count_text(len(estimate))}, but at least 3 are needed to compare it."
        )
    raise HemislamError(
        f"The truth ({_span(truth)}) covers {count_text(len(there))} of the trajectory ({_span(estimate)}),"
        " but at least 3 are needed; both must be stamped by the same clock, in seconds."
    )


def umeyama(source: F64, target: F64) -> F64:
    """The rigid T_target_source (4, 4) that brings points (n, 3) closest, without scale (Umeyama 1991).

    Raises:
        HemislamError: the points do not determine a rotation.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, spread, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean) / len(source))
    if spread[1] <= np.finfo(np.float64).eps:
        raise HemislamError(
            "The trajectory and its truth stand still or lie on one straight line, so they cannot be aligned to each"
            " other; compare a longer walk."
        )
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    transform = np.eye(4)
    transform[:3, :3] = u @ handed @ vt
    transform[:3, 3] = target_mean - transform[:3, :3] @ source_mean
    return transform


def alignment_doubt(truth: F64, rmse: float) -> str:
    """Why an alignment by positions does not fix the rotation, in a sentence; "" if it does.

    Turning about the main direction of the positions moves them by their distance from that line, of RMS w over both
    other axes. With errors r = `rmse` / sqrt(3) on each axis the rotation's standard deviation is r / (w sqrt(n)) for n
    independent errors. Those of a walk drift together over its whole length, so n is taken as one.

    Args:
        truth: (n, 3) positions, m. rmse: of the estimate's positions after the alignment, m.
    """
    spread = np.linalg.svd(truth - truth.mean(axis=0), compute_uv=False) / np.sqrt(len(truth))
    width = float(np.hypot(spread[1], spread[2]))
    if max(rmse, _FINEST_M) / np.sqrt(3) <= np.radians(MAX_ALIGNMENT_DEG) * width:
        return ""
    return (
        f"The truth lies within {width:.2g} m (RMS) of one straight line and the position error is {rmse:.2g} m, so"
        f" positions fix the rotation between the two worlds to no better than {MAX_ALIGNMENT_DEG:g}°; walk a bend."
    )


# --- errors --------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Errors:
    """A set of error lengths as root mean square, mean and maximum."""

    rmse: float
    mean: float
    max: float

    @classmethod
    def of(cls, values: F64) -> "Errors":
        return cls(float(np.sqrt(np.mean(values**2))), float(values.mean()), float(values.max()))


@dataclass(frozen=True, slots=True)
class Ate:
    """Absolute trajectory error after one rigid alignment.

    Attributes:
        position: m. rotation: deg; None if the alignment does not fix it. poses: compared.
        distance: true path length over them, m. T_truth_estimate: (4, 4), the alignment.
        doubt: why there is no rotation error, in a sentence; "" if there is.
    """

    position: Errors
    rotation: Errors | None
    poses: int
    distance: float
    T_truth_estimate: F64
    doubt: str = ""


def ate(estimate: Trajectory, truth: Trajectory) -> Ate:
    """Align `estimate` to `truth` by position (SE(3), no scale) and measure the remaining error.

    Raises:
        HemislamError: fewer than 3 stamps of the estimate have a truth, or nothing moved.
    """
    ours, theirs = paired(estimate, truth)
    transform = umeyama(ours.positions, theirs.positions)
    aligned = ours.positions @ transform[:3, :3].T + transform[:3, 3]
    turned = theirs.rotations.inv() * Rotation.from_matrix(transform[:3, :3]) * ours.rotations
    position = Errors.of(np.linalg.norm(aligned - theirs.positions, axis=1))
    doubt = alignment_doubt(theirs.positions, position.rmse)
    return Ate(
        position=position,
        rotation=None if doubt else Errors.of(np.degrees(turned.magnitude())),
        poses=len(ours),
        distance=theirs.distance,
        T_truth_estimate=transform,
        doubt=doubt,
    )


@dataclass(frozen=True, slots=True)
class Rpe:
    """Relative pose error over a fixed number of frames or of metres.

    Attributes:
        position: m. rotation: deg. pairs: compared.
    """

    position: Errors
    rotation: Errors
    pairs: int


def rpe(estimate: Trajectory, truth: Trajectory, *, frames: int = 1, metres: float | None = None) -> Rpe | None:
    """Error of the motion between poses `frames` apart or, if given, `metres` of true path apart.

    Pairs follow one another without overlap, as evo's default. None if the path is too short for
    a single pair.

    Raises:
        HemislamError: fewer than 3 stamps of the estimate have a truth.
    """
    ours, theirs = paired(estimate, truth)
    knots = np.arange(0, len(theirs), frames) if metres is None else _every(theirs.positions, metres)
    if len(knots) < 2:
        return None
    i, j = knots[:-1], knots[1:]
    turned_ours, moved_ours = _motion(ours, i, j)
    turned_theirs, moved_theirs = _motion(theirs, i, j)
    return Rpe(
        position=Errors.of(np.linalg.norm(moved_ours - moved_theirs, axis=1)),
        rotation=Errors.of(np.degrees((turned_theirs.inv() * turned_ours).magnitude())),
        pairs=len(i),
    )


def drift(estimate: Trajectory, truth: Trajectory, metres: float) -> F64:
    """(n,) errors of the motion over `metres` of true path, in per cent of it, as KITTI defines (Geiger et al. 2012).

    Every tenth pose begins a piece, so pieces overlap. Empty if the path is too short.

    Raises:
        HemislamError: fewer than 3 stamps of the estimate have a truth.
    """
    ours, theirs = paired(estimate, truth)
    walked = walked_m(theirs.positions)
    i = np.arange(0, len(theirs), 10)
    j = np.searchsorted(walked, walked[i] + metres)
    i, j = i[j < len(theirs)], j[j < len(theirs)]
    if not len(i):
        return np.zeros(0)
    wrong = _motion(ours, i, j)[1] - _motion(theirs, i, j)[1]
    return np.asarray(100 * np.linalg.norm(wrong, axis=1) / metres)


def walked_m(positions: F64) -> F64:
    """(n,) m of path up to each of (n, 3) positions."""
    return np.cumsum(np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1))


def compare(estimate: Trajectory, truth: Trajectory, *, rotations: bool = True) -> dict[str, Any]:
    """ATE, and RPE over each of RPE_OVER, as a tree for JSON. Lengths in m, angles in degrees.

    Args:
        rotations: whether the truth's orientations are known in the IMU's axes; if not, errors of rotation are None.

    Raises:
        HemislamError: as `ate`.
    """
    absolute = ate(estimate, truth)
    relative = [rpe(estimate, truth), *(rpe(estimate, truth, metres=metres) for metres in RPE_METRES)]
    return {
        "poses": absolute.poses,
        "distance_m": absolute.distance,
        "ate_m": asdict(absolute.position),
        "ate_deg": asdict(absolute.rotation) if absolute.rotation and rotations else None,
        "ate_deg_withheld": (absolute.doubt if rotations else "") or None,
        "rpe": {
            over: error
            and {
                "pairs": error.pairs,
                "m": asdict(error.position),
                "deg": asdict(error.rotation) if rotations else None,
            }
            for over, error in zip(RPE_OVER, relative, strict=True)
        },
    }


def _motion(trajectory: Trajectory, i: I64, j: I64) -> tuple[Rotation, F64]:
    """Rotation and translation (n, 3) of T_i_j."""
    back = trajectory.rotations[i].inv()
    return back * trajectory.rotations[j], back.apply(trajectory.positions[j] - trajectory.positions[i])


def _every(positions: F64, metres: float) -> I64:
    """Indices of the first pose and of each that lies at least `metres` of path after the last one."""
    knots, walked = [0], 0.0
    for index, step in enumerate(np.linalg.norm(np.diff(positions, axis=0), axis=1), start=1):
        walked += float(step)
        if walked >= metres:
            knots.append(index)
            walked = 0.0
    return np.array(knots, dtype=np.int64)


# --- ground --------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class GroundScore:
    """Counts of ground points, found and missed. Scores of frames add up with `+`."""

    true_positive: int = 0
    false_positive: int = 0
    false_negative: int = 0

    @classmethod
    def of(cls, labels: U8, truth_ground: U8) -> "GroundScore":
        """From labels (n,) of NON_GROUND, GROUND, SEED and the truth (n,), 1 = ground."""
        called, real = labels != NON_GROUND, truth_ground != 0
        return cls(int((called & real).sum()), int((called & ~real).sum()), int((~called & real).sum()))

    def __add__(self, other: "GroundScore") -> "GroundScore":
        return GroundScore(
            self.true_positive + other.true_positive,
            self.false_positive + other.false_positive,
            self.false_negative + other.false_negative,
        )

    @property
    def precision(self) -> float:
        """Share of the points labelled ground that are ground; nan if none was labelled so."""
        called = self.true_positive + self.false_positive
        return self.true_positive / called if called else float("nan")

    @property
    def recall(self) -> float:
        """Share of the ground points that were found; nan if there are none."""
        real = self.true_positive + self.false_negative
        return self.true_positive / real if real else float("nan")

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; nan if there is no ground and none was labelled so."""
        sizes = 2 * self.true_positive + self.false_positive + self.false_negative
        return 2 * self.true_positive / sizes if sizes else float("nan")


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.stamps_ns[0] * 1e-9:.1f} s to {trajectory.stamps_ns[-1] * 1e-9:.1f} s"
