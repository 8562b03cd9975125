"""The result files about loops."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam import lie
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.map_frame import MapFrame
from app.slam.text_files import csv_text
from app.slam.trajectory import stamp_text
from app.slam.types import I64

COLUMNS = (
    "older", "newer", "older_stamp_s", "newer_stamp_s", "verdict", "origin", "edited", "weight",
    "represented_by", "repeats", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw",
    "sigma_m", "along_x", "along_y", "along_z", "across_m", "sigma_deg",
    "context_distance", "overlap", "residual_m", "slide_m", "alternative_m", "mahalanobis_sigma", "gate_m", "support",
    "reason",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class LoopResults:
    """The results of the loop search in a session.

    Attributes:
        frame: where odometry lies in the map. stamps_ns: (k,) of keyframes.
        edges: every candidate. g2o: the graph as text.
    """

    frame: MapFrame
    stamps_ns: I64
    edges: tuple[LoopEdge, ...]
    g2o: str

    @property
    def tied_ns(self) -> I64:
        """(m,) ends of the pauses that accepted loops span."""
        return tied_pauses(self.edges, self.stamps_ns, self.frame.pauses_ns)

    def count(self, verdict: Verdict) -> int:
        return sum(edge.verdict is verdict for edge in self.edges)


def moved_g2o(text: str, frame: MapFrame) -> str:
    """The text of a g2o file with its vertices, T_map_imu of keyframes, where `frame` puts them."""
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if line.startswith("VERTEX_SE3:QUAT"):
            kind, key, *pose = line.split()
            values = np.array(pose, np.float64)
            T = frame.at(int(key)) @ lie.transform(Rotation.from_quat(values[3:]).as_matrix(), values[:3])
            moved = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
            lines[number] = " ".join([kind, key, *(f"{value:.9g}" for value in moved)])
    return "\n".join(lines) + "\n"


def tied_pauses(edges: Iterable[LoopEdge], stamps_ns: I64, pauses_ns: I64) -> I64:
    """(m,) ends of the pauses that accepted loops span.

    Args:
        stamps_ns: (k,) of keyframes. pauses_ns: (p,) ends of all pauses.
    """
    pairs = np.array([edge.pair for edge in edges if edge.verdict is Verdict.ACCEPTED], np.int64).reshape(-1, 2)
    older, newer = stamps_ns[pairs].T
    spanned = (older < pauses_ns[:, None]) & (pauses_ns[:, None] <= newer)
    return np.asarray(pauses_ns[spanned.any(axis=1)])


def _certainty(edge: LoopEdge) -> tuple[float, ...]:
    """Standard deviation of the position (m) in its least certain direction, this direction in the older's IMU frame
    (unit), the largest one across it (m), and the largest one of the rotation (deg); nan if nothing was registered."""
    if np.isnan(edge.evidence.overlap):
        return (np.nan,) * 6
    R = edge.T_older_newer[:3, :3]
    values, axes = np.linalg.eigh(R @ edge.covariance[3:, 3:] @ R.T)
    rotation = np.linalg.eigvalsh(edge.covariance[:3, :3])[-1]
    across, along = np.sqrt(np.maximum(values[1:], 0.0))
    return along, *axes[:, 2], across, float(np.degrees(np.sqrt(max(rotation, 0.0))))


def loops_csv(edges: tuple[LoopEdge, ...], stamps_ns: I64) -> str:
    """One line per candidate; the pose is T_older_newer of the IMU frames, and numbers not measured are empty.

    Args:
        stamps_ns: (k,) of keyframes.
    """
    rows = []
    for edge in edges:
        T, e = edge.T_older_newer, edge.evidence
        pose = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
        measures = (e.context_distance, e.overlap, e.residual_rms, e.slide, e.alternative_m, e.mahalanobis, e.gate_m)
        rows.append(
            [
                edge.older,
                edge.newer,
                stamp_text(int(stamps_ns[edge.older])),
                stamp_text(int(stamps_ns[edge.newer])),
                edge.verdict.value,
                edge.origin.value,
                int(edge.edited),
                f"{edge.weight:g}",
                *("-".join(str(keyframe) for keyframe in pair or ()) for pair in (edge.represented_by, edge.repeats)),
                *(f"{value:.6f}" for value in pose),
                *("" if value != value else f"{value:.4f}" for value in (*_certainty(edge), *measures)),
                e.support,
                edge.reason,
            ]
        )
    return csv_text(COLUMNS, *rows)
