"""`hemislam export` from the outside: results and a session give the same points."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pypcd4 import PointCloud

from app.export.exports import FORMATS
from app.mapping.session_file import Opened, SavedSession, State, size_of, write_session
from app.sensors.presets import resolve_params

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def results(hemislam: Call, walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "results"
    assert hemislam("run", walk, "--out", folder).code == 0
    return folder


def test_help_lists_every_format(hemislam: Call) -> None:
    lines = [line.strip().split("  ")[0] for line in hemislam("export", "--help").out.splitlines()]
    assert {name for line in lines for name in line.split(", ")} >= set(FORMATS)


def test_a_map_is_exported_whole_and_thinned_in_a_box(results: Path, hemislam: Call, tmp_path: Path) -> None:
    outcome = hemislam("export", results, "--format", "laz,pcd")
    assert outcome.code == 0, outcome.err
    assert str(results / "export" / "map.laz") in outcome.out and outcome.err == ""
    whole = laspy.read(results / "export" / "map.laz")
    assert len(whole) == json.loads((results / "report.json").read_text())["map"]["points"]
    box = ("--thin", "0.1", "--box=-1,-1,-2,2,2,2", "--out", tmp_path)
    assert hemislam("export", results, "--format", "laz", *box).code == 0
    part = laspy.read(tmp_path / "map.laz").xyz
    assert 100 < len(part) < len(whole) and (np.abs(part) <= 2.001).all() and part[:, :2].min() >= -1.001


def test_a_session_gives_the_points_of_a_run_to_its_frame(hemislam: Call, walk: Path, tmp_path: Path) -> None:
    session, params = tmp_path / "walk.hemislam", resolve_params(walk, None, None, [])
    write_session(session, SavedSession(Opened(walk, nbytes=size_of(walk)), State(params), 9))
    assert hemislam("run", walk, "--duration", "1.0", "--out", tmp_path / "run").code == 0
    for source, out in ((session, "of_session"), (tmp_path / "run", "of_run")):
        outcome = hemislam("export", source, "--format", "pcd", "--out", tmp_path / out)
        assert outcome.code == 0, outcome.err
    of_session, of_run = (PointCloud.from_path(tmp_path / out / "map.pcd").numpy() for out in ("of_session", "of_run"))
    np.testing.assert_allclose(of_session, of_run, atol=1e-3)
    assert len(of_run) > 1000


def test_a_session_whose_clip_cannot_be_is_exported_with_a_sentence(hemislam: Call, walk: Path, tmp_path: Path) -> None:
    session, params = tmp_path / "walk.hemislam", resolve_params(walk, None, None, [])
    write_session(session, SavedSession(Opened(walk, nbytes=size_of(walk)), State(params), 2))
    session.write_text(session.read_text().replace('"slab": 1.0', '"slab": 0.0'))
    outcome = hemislam("export", session, "--format", "tum", "--out", tmp_path / "out")
    assert outcome.code == 0 and "clip box and slab were left out (" in outcome.err, outcome.err
    assert (tmp_path / "out" / "trajectory.tum").is_file()


def test_a_grid_that_cannot_be_used_costs_only_the_georeference(results: Path, hemislam: Call, tmp_path: Path) -> None:
    """Earlier versions took grids that count towards the west."""
    folder = tmp_path / "results"
    shutil.copytree(results, folder)
    file = folder / "georeference.json"
    file.write_text('{"crs": "EPSG:2048", "origin": [1.0, 2.0, 3.0]}')
    params = resolve_params(results, None, None, [])
    walk = Path(json.loads((results / "report.json").read_text())["recording"]["path"])
    session = SavedSession(Opened(walk, nbytes=size_of(walk)), State(params), 2)
    write_session(folder / "session.hemislam", session)
    for source in (folder, folder / "session.hemislam"):
        outcome = hemislam("export", source, "--format", "tum", "--out", tmp_path / "out")
        assert outcome.code == 0 and "georeference.json" in outcome.err and "towards the west" in outcome.err, outcome
        refused = hemislam("export", source, "--format", "gpx")
        assert refused.code == 2 and "towards the west" in refused.err
    refused = hemislam("export", folder / "session.hemislam", "--format", "tum", "--out", folder)
    assert refused.code == 2 and "Choose another folder" in refused.err
    assert hemislam("export", folder, "--format", "tum", "--out", folder / "export").code == 0 and file.exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--format", "dwg"), "There is no format dwg"),
        (("--format", " , "), "names no format"),
        (("--format", "laz", "--box", "1,2,3"), "--box takes six numbers"),
        (("--format", "gpx"), "needs a georeferenced map"),
        *(
            (("--format", name, "--box=90,90,90,91,91,91"), "no points in the box; choose another one")
            for name in ("ply", "las", "laz", "e57", "pcd", "html", "floor")
        ),
    ],
)
def test_what_cannot_be_exported_is_said_in_a_sentence(
    results: Path, hemislam: Call, options: tuple[str, ...], sentence: str
) -> None:
    outcome = hemislam("export", results, *options)
    assert outcome.code == 2 and sentence in outcome.err and "Traceback" not in outcome.err


def test_results_are_not_exported_onto_themselves(results: Path, hemislam: Call, tmp_path: Path) -> None:
    before = (results / "map.ply").read_bytes()
    assert (
        "choose another folder" in hemislam("export", results, "--format", "ply", "--thin", "1", "--out", results).err
    )
    assert (results / "map.ply").read_bytes() == before
    assert "no map.ply" in hemislam("export", tmp_path, "--format", "ply").err


def test_where_nothing_can_be_written_a_session_is_not_repeated_first(
    hemislam: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (there := tmp_path / "there").write_bytes(b"mine")
    monkeypatch.setattr("app.cli.replay.repeat", lambda _: pytest.fail("it is repeated first"))
    assert "cannot be made" in hemislam("export", tmp_path / "s.hemislam", "--format", "tum", "--out", there).err
