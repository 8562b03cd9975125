"""A georeferenced session. Oracle: the simulator's position of the scene. Tests app/server/georeferencing.py,
app/mapping/earth.py and app/georeference/survey.py.
"""

import csv
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
from test_rewind import Bench, open_whole
from typer.testing import CliRunner

from app.__main__ import cli
from app.export.box import Box
from app.export.map_file import MapFile
from app.export.points import Choice
from app.georeference import reference
from app.georeference.reference import GeoReference
from app.georeference.survey import Pick, Survey
from app.mapping.session import Session
from app.mapping.session_file import read_session
from app.sensors.presets import resolve_params
from app.sensors.simulator.gnss import Gnss
from app.sensors.simulator.simulate import simulate
from app.server.controller import Controller
from app.server.protocol import EditLoop, Georeference, RedoLoop, Save, Seek, Snapshot, UndoLoop
from app.slam import lie
from app.slam.loops.edits import Override
from app.slam.trajectory import read_tum
from app.slam.types import F64

LEVER = (0.1, -0.2, 0.4)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """8 s in a room, with a receiver that is 80 ms late."""
    out = tmp_path_factory.mktemp("walk") / "walk.mcap"
    gnss = Gnss(offset=0.08, noise=0.005, rate=6.0, x=LEVER[0], y=LEVER[1], z=LEVER[2])
    simulate("room", out, duration_s=8.0, every_block=40, gnss=gnss)
    return out


class Laid(Bench):
    """A session at the end of the walk."""

    def __init__(self, walk: Path, folder: Path) -> None:
        self.folder = folder
        super().__init__(resolve_params(walk, None, None, []), open_whole, walk)
        self.do(Seek(200))

    def _controller(self, opener: Callable[..., Session]) -> Controller:
        return Controller(self.page, self.params, opener, session_folder=self.folder, clock=lambda: 0.0)

    def settle(self) -> None:
        while (wait := self.controller.work()) is not None:
            time.sleep(wait)

    def save(self, folder: Path) -> Path:
        self.do(Save(folder))
        saved = self.see().saved[-1]
        assert saved.folder == folder and not saved.error, saved.error
        return folder


@pytest.fixture(scope="module")
def bench(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laid]:
    made = Laid(walk, tmp_path_factory.mktemp("sessions"))
    yield made
    made.controller.close()


def off(bench: Laid, walk: Path) -> F64:
    """(n,) m, how far the path in the page is from where it truly was."""
    now = bench.see()
    truth = read_tum(walk.with_name("walk_truth.tum"))
    true = GeoReference.from_json(walk.with_name("walk_georeference.json").read_text())
    assert now.earth.found is not None
    stamps_ns = np.array([frame.stamp_ns for frame in bench.session.frames])
    at = [np.interp(stamps_ns, truth.stamps_ns, column) for column in truth.positions.T]
    there = now.earth.found.reference.to_crs(np.asarray(now.trajectory, np.float64))
    return np.asarray(np.linalg.norm(there - true.to_crs(np.column_stack(at)), axis=1))


def verdicts(now: Snapshot) -> dict[str, bool]:
    assert now.earth.found is not None
    return dict(zip(now.earth.found.names, now.earth.found.used.tolist(), strict=True))


def test_a_map_is_georeferenced_by_the_fixes_of_its_recording_and_again_when_it_has_grown(
    bench: Laid, walk: Path
) -> None:
    bench.do(Seek(50), Georeference(Survey(lever=LEVER)))
    fewer = len(verdicts(bench.see()))
    bench.do(Seek(200))
    assert len(verdicts(bench.see())) > fewer + 10
    assert np.sqrt((off(bench, walk) ** 2).mean()) < 0.05


def test_the_page_knows_at_once_what_was_chosen_last(bench: Laid) -> None:
    """Else a control point that is picked while the one before is being laid would take that back."""
    first, second = Survey(lever=LEVER), Survey(lever=LEVER, height="EPSG:5773")
    found = bench.do(Georeference(first)).earth.found
    bench.controller.handle(Georeference(replace(first, offset_s=0.08)))
    bench.controller.work()
    bench.controller.handle(Georeference(second))
    assert (bench.see().earth.survey, bench.see().earth.found) == (second, found)
    while (wait := bench.controller.work()) is not None:
        assert bench.see().earth.survey == second, "also when what was chosen before is found"
        time.sleep(wait)
    assert bench.see().earth.found is not found is not None


def test_a_fix_is_overridden_and_that_is_undone_as_a_loop_is(bench: Laid) -> None:
    bench.do(Georeference(Survey(lever=LEVER)))
    assert verdicts(bench.see())["30"]
    assert not verdicts(bench.do(EditLoop(Override("fix 30", accepted=False))))["30"]
    assert bench.see().loops.undo[-1] == Override("fix 30", accepted=False)
    assert verdicts(bench.do(UndoLoop()))["30"] and not verdicts(bench.do(RedoLoop()))["30"]
    bench.do(UndoLoop())


def test_fixes_bend_the_map_in_the_page_and_in_what_is_saved(bench: Laid, walk: Path, tmp_path: Path) -> None:
    straight = bench.do(Georeference(Survey(lever=LEVER))).keyframe_poses
    bent = bench.do(Georeference(Survey(lever=LEVER, factors=True))).keyframe_poses
    assert straight is not None and bent is not None
    moved = np.linalg.norm(bent[:, :3, 3] - straight[:, :3, 3], axis=1)
    assert 1e-5 < moved.max() < 0.2 and np.sqrt((off(bench, walk) ** 2).mean()) < 0.05
    saved = MapFile(bench.save(tmp_path / "bent") / "map.ply")
    for k in (0, 5):
        np.testing.assert_allclose(saved[k].T_odom_imu[:3, 3], (bent[k] @ T_imu_lidar(bench, k))[:3, 3])
    np.testing.assert_array_equal(bench.do(Georeference(None)).keyframe_poses, straight)


def T_imu_lidar(bench: Laid, keyframe: int = 0) -> F64:
    return bench.see().chunks[keyframe].T_imu_lidar


def test_a_session_file_repeats_the_georeference_to_the_same_bytes(bench: Laid, tmp_path: Path) -> None:
    survey = Survey(lever=LEVER, crs="EPSG:25832", factors=True)
    bench.do(Georeference(survey), EditLoop(Override("fix 30", accepted=False)))
    page = bench.save(tmp_path / "page")
    session = page / "session.hemislam"
    assert read_session(session).state.survey == survey
    for command in (("replay", session), ("export", session, "--format", "kmz,csv")):
        outcome = CliRunner().invoke(cli, [str(word) for word in (*command, "--out", tmp_path / command[0])])
        assert outcome.exit_code == 0, outcome.output
    for name in ("georeference.json", "gnss_residuals.csv", "trajectory.tum"):
        assert (tmp_path / "replay" / name).read_bytes() == (page / name).read_bytes(), name
    rows = csv.DictReader((page / "gnss_residuals.csv").read_text().splitlines())
    assert {row["name"]: row["verdict"] for row in rows}["30"] == "rejected"
    head = (tmp_path / "export" / "trajectory.csv").read_text().splitlines()[0]
    assert "east" in head and (tmp_path / "export" / "map.kmz").exists()
    bench.do(UndoLoop())


def test_every_format_of_the_page_is_where_the_map_was_georeferenced_and_what_is_in_the_box(
    bench: Laid, tmp_path: Path
) -> None:
    found = bench.do(Georeference(Survey(lever=LEVER))).earth.found
    assert found is not None
    box = Box((-1.0, -2.0, -3.0), (2.0, 1.0, 3.0), 20.0)
    bench.do(Save(tmp_path / "page", ("gpx", "kmz", "laz"), Choice(0.1, box)))
    assert not bench.see().saved[-1].error
    las = laspy.read(tmp_path / "page" / "map.laz")
    inside = np.abs(box.own(found.reference.from_crs(las.xyz))) - box.size / 2
    assert len(las.xyz) > 100 and inside.max() < 1e-3
    assert las.header.parse_crs().to_2d().to_epsg() == 32632
    track = ElementTree.parse(tmp_path / "page" / "trajectory.gpx").getroot()
    first = next(track.iter("{http://www.topografix.com/GPX/1/1}trkpt"))
    trajectory = bench.see().trajectory
    assert trajectory is not None
    expected = found.reference.to_geographic(np.asarray(trajectory[:1], np.float64))[0, :2]
    np.testing.assert_allclose([float(first.get(k, "nan")) for k in ("lat", "lon")], expected, atol=1e-7)
    assert (tmp_path / "page" / "map.kmz").exists()
    bench.do(Georeference(None), Save(tmp_path / "nowhere", ("gpx",)))
    assert (
        "needs a georeferenced map" in bench.see().saved[-1].error
        and not (tmp_path / "nowhere" / "trajectory.gpx").exists()
    )


def test_three_points_picked_on_the_map_georeference_it_and_with_two_the_page_says_what_is_undetermined(
    bench: Laid, walk: Path
) -> None:
    now = bench.do(Georeference(None))
    true = GeoReference.from_json(walk.with_name("walk_georeference.json").read_text())
    places = np.array([[0.0, 0.0, 0.0], [4.0, 0.5, 1.0], [0.5, 3.0, 0.2]])
    local = lie.inverse(now.keyframe_poses[3]) @ np.column_stack([places, np.ones(3)]).T
    picks = tuple(Pick(f"P{k}", 3, tuple(at)) for k, at in enumerate(local[:3].T.tolist()))
    rows = [f"P{k},{e!r},{n!r},{h!r}\n" for k, (e, n, h) in enumerate(true.to_crs(places).tolist())]
    survey = Survey(control="name,E,N,H\n" + "".join(rows), crs=true.crs, picks=picks)
    found = bench.do(Georeference(survey)).earth.found
    assert found is not None and found.rms.max() < 1e-6
    np.testing.assert_allclose(found.reference.origin, true.origin, atol=1e-6)
    two = bench.do(Georeference(replace(survey, picks=picks[:2]))).earth
    assert two.found is None and "only P0 and P1 are: the map's rotation about" in two.problem
    frame = now.chunks[3].frame
    assert bench.do(Georeference(replace(survey, picks=(*picks[:2], replace(picks[2], frame=frame))))).earth.found
    for nowhere in (replace(picks[2], keyframe=-1), replace(picks[2], frame=frame - 1)):
        lost = bench.do(Georeference(replace(survey, picks=(*picks[:2], nowhere)))).earth
        assert lost.found is None and "only P0 and P1 are" in lost.problem, lost.problem
    left = bench.do(Georeference(survey), EditLoop(Override("point P2", accepted=False))).earth
    assert "only P0 and P1" in left.problem
    bench.do(UndoLoop())


def test_a_map_that_cannot_be_georeferenced_is_saved_all_the_same_and_the_report_says_why(
    bench: Laid, tmp_path: Path
) -> None:
    bench.do(Georeference(Survey(gnss=tmp_path / "gone.csv")))
    assert "gone.csv" in bench.see().earth.problem
    folder = bench.save(tmp_path / "results")
    assert "gone.csv" in json.loads((folder / "report.json").read_text())["georeference"]["problem"]
    assert not (folder / reference.FILE).exists()
    bench.do(Georeference(None))


def test_a_session_file_of_before_opens_without_a_georeference(bench: Laid, tmp_path: Path) -> None:
    file = bench.save(tmp_path / "results") / "session.hemislam"
    head, *others = map(json.loads, file.read_text().splitlines())
    for entry in others:
        del entry["state"]["survey"]
    file.write_text("".join(json.dumps(entry) + "\n" for entry in (head, *others)))
    assert read_session(file).state.survey is None
