"""A small walk with a stored trajectory, so that no change of the engine shifts results unnoticed.

After an intended change, store the new trajectory with `python -m tests.golden.test_golden_walk`, and say why in the
commit.
"""

from pathlib import Path

import numpy as np

from app.slam.engine import Engine
from app.slam.trajectory import Trajectory, read_tum, write_tum
from tests.slam.scenes import Rig, Walk, furnished_room, measurements, mounted, params_for

KEPT = Path(__file__).with_name("room_walk.tum")
RIG = Rig(
    columns=48,
    T_imu_lidar=mounted((0, 0, 0), (0.0175, 0.0276, -0.1083)),
    range_noise=0.005,
    gyro_noise=0.005,
    accel_noise=0.05,
    b_gyro=(0.01, -0.008, 0.005),
    b_accel=(0.03, -0.02, 0.04),
)


def trajectory() -> Trajectory:
    engine = Engine(params_for(RIG))
    results = [engine.step(m.scan, m.imu) for m in measurements(furnished_room(), Walk(), RIG, 60)]
    engine.close()
    return Trajectory.from_poses([r.stamp_ns for r in results], [r.T_map_imu for r in results])


def test_the_walk_is_the_one_that_is_kept() -> None:
    """Within a tenth of a millimetre and 0.005 degrees: room for another machine's rounding, and for nothing else."""
    kept, now = read_tum(KEPT), trajectory()
    np.testing.assert_array_equal(now.stamps_ns, kept.stamps_ns)
    np.testing.assert_allclose(now.positions, kept.positions, atol=1e-4)
    assert np.degrees((kept.rotations.inv() * now.rotations).magnitude()).max() < 0.005


if __name__ == "__main__":
    write_tum(KEPT, trajectory())
