"""The uncertainty of loops in loops.csv. Its other columns are tested in test_backend."""

import csv

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.files import loops_csv
from app.slam.loops.types import Evidence, LoopEdge, Verdict


def test_the_certainty_of_a_loop_is_that_of_poses_drawn_from_its_covariance() -> None:
    """A place that leaves one direction open to 10 m, turned against both IMU frames."""
    open_way = np.array([0.6, 0.0, 0.8])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag(np.radians([1.5, 1.0, 0.5]) ** 2)
    covariance[3:, 3:] = 0.04**2 * np.eye(3) + 10.0**2 * np.outer(open_way, open_way)
    T = lie.transform(Rotation.from_euler("xyz", [20.0, -35.0, 130.0], degrees=True).as_matrix(), np.array([3.0, 1, 0]))
    ids = KeyframeId(0, 0), KeyframeId(0, 1)
    edge = LoopEdge(*ids, 1, T, covariance, Evidence(0.1, overlap=0.8), Verdict.ACCEPTED, "")
    unregistered = LoopEdge(*ids, 1, T, np.eye(6), Evidence(0.9), Verdict.REJECTED, "the places look different")

    said, nothing = csv.DictReader(loops_csv((edge, unregistered), np.arange(2)).splitlines())
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, 100_000)
    positions = T[:3, 3] + drawn[:, 3:] @ T[:3, :3].T
    along = np.array([float(said[f"along_{axis}"]) for axis in "xyz"])
    across = np.linalg.svd(along[None])[2][1:]
    assert abs(along @ T[:3, :3] @ open_way) > 0.9999
    assert np.isclose(float(said["sigma_m"]), (positions @ along).std(), rtol=0.02)
    assert np.allclose(float(said["across_m"]), (positions @ across.T).std(axis=0), rtol=0.05)
    assert np.isclose(float(said["sigma_deg"]), np.degrees(drawn[:, :3].std(axis=0).max()), rtol=0.02)
    assert nothing["sigma_m"] == nothing["along_x"] == nothing["sigma_deg"] == ""
