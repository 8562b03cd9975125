"""Baselines as run by `evaluate`, and its messages on baselines that are not installed.

Tests app/baselines/systems.py, app/baselines/poses.py, and of app/baselines/peers.py the use of KISS-ICP and
GenZ-ICP, with stand-ins for both. RKO-LIO is not run.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from app.__main__ import cli
from app.baselines import systems
from app.baselines.poses import keep_keyframe
from app.baselines.systems import SYSTEMS, find_system
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.params import Params
from app.slam.types import ImuSamples, Measurement, Scan
from tests.cli.conftest import write_walk

PARAMS = Params.model_validate({"sensor": {"translation": (0.1, 0.2, -0.3)}})


def wall(stamp_ns: int, points: np.ndarray, lasting_ns: int = 100_000_000) -> Scan:
    n = len(points)
    offsets = np.linspace(0, lasting_ns, n).astype(np.int32)
    return Scan(stamp_ns, points.astype(np.float32), offsets, np.zeros(n, np.float32), np.zeros(n, np.uint16))


def test_loam_stands_in_the_tables_and_is_not_run_again(tmp_path: Path) -> None:
    recording, out = tmp_path / "walk.mcap", tmp_path / "out"
    write_walk(recording, duration_s=2.0)
    arguments = ["evaluate", str(recording), "--out", str(out), "--no-ablation", "--baseline", "loam"]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    run = out / "runs" / "walk" / "LOAM" / "run.json"
    (column,) = json.loads((out / "results.json").read_text())["recordings"][0]["variants"]
    assert column["variant"] == "LOAM" and column["frames"] == 19 and column["lost"] == 0
    assert column["accuracy"]["ate_m"]["rmse"] < 0.1
    assert column["runtime_ms"]["total"]["median"] > 0 and "ground" not in column["runtime_ms"]
    assert column["map_sharpness"]["thickness"] < 0.05
    page = (out / "report.md").read_text()
    assert "LOAM" in page.split("## Run time per frame")[1] and "Stages" not in page
    before = run.stat().st_mtime_ns
    assert CliRunner().invoke(cli, arguments).exit_code == 0 and run.stat().st_mtime_ns == before


def test_what_is_missing_is_said_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(systems, "FOLDER", tmp_path)
    with pytest.raises(
        HemislamError, match=rf"KISS-ICP is not installed.*pip install.*--target {tmp_path} 'kiss-icp>="
    ):
        find_system("kiss-icp")
    with pytest.raises(HemislamError, match="no baseline `orb`; choose from loam, liom"):
        find_system("orb")


STUBS = {
    "kiss_icp": ("config.py", "class KISSConfig:\n    class data: pass\n    class mapping: pass\n", "KissICP"),
    "genz_icp": ("config.py", "class GenZConfig:\n    class data: pass\n", "GenZICP"),
}
ODOMETRY = """import numpy as np
class {name}:
    def __init__(self, config): self.last_pose = np.eye(4)
    def register_frame(self, frame, timestamps):
        assert frame.dtype == np.float64 and timestamps.min() == 0 and timestamps.max() == 1
        self.last_pose = self.last_pose @ np.array([[1., 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""


@pytest.mark.parametrize(("name", "share"), [("kiss-icp", 1.0), ("genz-icp", 0.5)])
def test_a_package_in_its_folder_moves_the_imu_with_the_lidar(
    name: str, share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stub moves the LiDAR by half a metre along its x in each scan; so the IMU moves, from a level origin."""
    module = name.replace("-", "_")
    file, config, odometry = STUBS[module]
    (tmp_path / module).mkdir()
    (tmp_path / module / "__init__.py").touch()
    (tmp_path / module / file).write_text(config)
    (tmp_path / module / f"{module}.py").write_text(ODOMETRY.format(name=odometry))
    (tmp_path / f"{module}-9.0.dist-info").mkdir()
    (tmp_path / f"{module}-9.0.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.0\n"
    )
    monkeypatch.setattr(systems, "FOLDER", tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for loaded in [key for key in sys.modules if key.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    assert SYSTEMS[name].version() == "9.0"
    system = SYSTEMS[name].start(PARAMS)
    level = ImuSamples(np.arange(3), np.zeros((3, 3)), np.tile([0.0, 0.0, 9.81], (3, 1)))
    scan = wall(1_000_000_000, np.random.default_rng(0).uniform(1, 5, (50, 3)))
    for metres in (0.5, 1.0):
        stamp_ns, T = system.step(Measurement(scan, level))
        assert stamp_ns == scan.stamp_ns + share * 100_000_000
        np.testing.assert_allclose(T, lie.transform(np.eye(3), np.array([metres, 0.0, 0.0])), atol=1e-12)
    for loaded in [key for key in sys.modules if key.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)


def test_a_wall_swept_on_the_way_is_straight_in_the_keyframe() -> None:
    """The sensor moves 0.4 m towards a wall during one scan: all its points end at one distance."""
    store, begin_ns = KeyframeStore(), 1_700_000_000_000_000_000
    before = np.eye(4)
    now = lie.transform(np.eye(3), np.array([0.6, 0.0, 0.0]))
    across = np.linspace(-2, 2, 40)
    points = np.column_stack([5.0 - np.linspace(0.2, 0.6, 40), across, np.zeros(40)])  # 0.2 m were walked before it
    scan = wall(begin_ns, points)
    keep_keyframe(store, scan, (scan.end_ns, now), (begin_ns - 50_000_000, before), PARAMS)
    (keyframe,) = store
    np.testing.assert_allclose(
        keyframe.cloud.points, np.column_stack([np.full(40, 4.4), across, np.zeros(40)]), atol=1e-5
    )
    keep_keyframe(store, scan, (scan.end_ns + 1, now), (scan.end_ns, now), PARAMS)
    assert len(store) == 1  # it has not moved since
    store.close()
