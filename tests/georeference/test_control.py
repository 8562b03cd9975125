"""Control points. Oracle: SciPy's general least squares over a rotation vector and a translation."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from app.georeference.align import Alignment
from app.georeference.control import CONTROL, PICKS, align_with_points, read_picks
from app.georeference.tables import read_table
from app.slam.errors import HemislamError
from tests.georeference.walks import TRUTH

CORNERS = {"A": (0.0, 0.0, 0.0), "B": (40.0, 2.0, 1.0), "C": (38.0, 30.0, -0.5), "D": (-3.0, 28.0, 4.0)}


def written(folder: Path, points: dict[str, tuple[float, ...]], *, noise: float = 0.01) -> tuple[Path, Path]:
    """The files of control points and of where they were picked; each is off by `noise` m."""
    rng = np.random.default_rng(4)
    grid = TRUTH.to_crs(np.array([*points.values()])) + noise * rng.normal(size=(len(points), 3))
    rows = [f"{name},{e!r},{n!r},{h!r}" for name, (e, n, h) in zip(points, grid.tolist(), strict=True)]
    control, picks = folder / "control.csv", folder / "picks.csv"
    control.write_text("Name,E,N,H\n" + "\n".join(rows) + "\n")
    picks.write_text("name,x,y,z\n" + "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in points.items()))
    return control, picks


def laid(control: Path, picks: Path, **options: Any) -> Alignment:
    return align_with_points(read_table(control, *CONTROL), read_picks(read_table(picks, *PICKS)), **options)


def test_four_points_give_the_transform_of_an_independent_least_squares(tmp_path: Path) -> None:
    control, picks = written(tmp_path, CORNERS)
    found = laid(control, picks, grid="EPSG:32632")
    points = np.array([*CORNERS.values()])
    k = found.reference.scale
    there = (found.grid - found.grid.mean(axis=0)) / [k, k, 1.0]

    def errors(x: np.ndarray) -> np.ndarray:
        return (there - Rotation.from_rotvec(x[:3]).apply(points) - x[3:]).ravel()

    best = least_squares(errors, np.r_[0.0, 0.0, np.radians(37.0), np.zeros(3)], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(found.residuals.ravel(), best.fun, atol=1e-7)
    np.testing.assert_allclose(found.reference.rotation, Rotation.from_rotvec(best.x[:3]).as_matrix(), atol=1e-8)
    assert np.abs(found.reference.to_crs(points) - TRUTH.to_crs(points)).max() < 0.03
    assert found.rms.max() < 0.02


def test_exact_points_in_degrees_give_the_map_its_exact_place(tmp_path: Path) -> None:
    _, picks = written(tmp_path, CORNERS)
    rows = zip(CORNERS, TRUTH.to_geographic(np.array([*CORNERS.values()])).tolist(), strict=True)
    control = tmp_path / "degrees.csv"
    control.write_text("id;lat;lon;height\n" + "".join(f"{n};{a!r};{o!r};{h!r}\n" for n, (a, o, h) in rows))
    found = laid(control, picks, height="orthometric (EGM2008)")
    np.testing.assert_allclose(found.reference.origin, TRUTH.origin, atol=1e-4)
    assert found.reference.crs == "EPSG:32632" and found.reference.height == "orthometric (EGM2008)"


def test_a_point_that_is_only_in_one_file_is_left_out(tmp_path: Path) -> None:
    control, picks = written(tmp_path, CORNERS)
    picks.write_text(picks.read_text().replace("D,", "Z,"))
    assert laid(control, picks, grid="EPSG:32632").names == ("A", "B", "C")


def test_a_point_without_its_easting_is_reported_as_such(tmp_path: Path) -> None:
    control, picks = written(tmp_path, CORNERS)
    head, first, *others = control.read_text().splitlines()
    name, _, north, height = first.split(",")
    control.write_text("\n".join([head, f"{name},,{north},{height}", *others]))
    with pytest.raises(HemislamError, match="row 1: the east is missing"):
        laid(control, picks, grid="EPSG:32632")


def test_swapped_columns_or_names_are_told_by_the_map_that_they_turn_over(tmp_path: Path) -> None:
    _, picks = written(tmp_path, CORNERS)
    degrees = TRUTH.to_geographic(np.array([*CORNERS.values()])).tolist()
    swapped = tmp_path / "swapped.csv"
    rows = zip(CORNERS, degrees, strict=True)
    swapped.write_text("name,lat,lon,h\n" + "".join(f"{name},{lon},{lat},{h}\n" for name, (lat, lon, h) in rows))
    with pytest.raises(HemislamError, match="latitude and longitude seem to be swapped"):
        laid(swapped, picks)
    control, picks = written(tmp_path, CORNERS)
    control.write_text(control.read_text().replace("Name,E,N,H", "Name,N,E,H"))
    with pytest.raises(HemislamError, match="Easting and northing seem to be swapped"):
        laid(control, picks, grid="EPSG:32632")
    control, picks = written(tmp_path, {name: CORNERS[name] for name in "ABC"})
    picks.write_text(picks.read_text().replace("A,", "a,").replace("B,", "A,").replace("a,", "B,"))
    with pytest.raises(HemislamError, match="names exchanged"):
        laid(control, picks, grid="EPSG:32632")


@pytest.mark.parametrize(
    ("first", "words"),
    [
        ("95,11.5", "row 1: the latitude 95.0000° is beyond 90°; give it in degrees"),
        ("48,4300", "row 1: the longitude 4300.0000° is beyond 360°"),
        ("48,11.5", "only A and B are"),
    ],
)
def test_a_place_beyond_the_earth_is_refused_by_its_row_and_few_places_are_not_called_fixes(
    tmp_path: Path, first: str, words: str
) -> None:
    control, picks = tmp_path / "degrees.csv", tmp_path / "picks.csv"
    control.write_text(f"name,lat,lon,height\nA,{first},5\nB,48.1,11.5,5\n")
    picks.write_text("name,x,y,z\nA,0,0,0\nB,9,0,0\n")
    with pytest.raises(HemislamError, match=words):
        laid(control, picks)


def test_a_point_that_is_given_twice_is_named(tmp_path: Path) -> None:
    control, picks = written(tmp_path, CORNERS)
    control.write_text(control.read_text() + "A,691600,5334800,520\n")
    with pytest.raises(HemislamError, match="holds control point A more than once"):
        laid(control, picks, grid="EPSG:32632")


@pytest.mark.parametrize(
    ("row", "words"),
    [("A,1,2,3", "picks.csv holds control point A more than once"), ("E,1,,3", "picks.csv, row 5: the y is missing")],
)
def test_a_pick_that_is_there_twice_or_cut_is_named_with_its_own_file(tmp_path: Path, row: str, words: str) -> None:
    control, picks = written(tmp_path, CORNERS)
    picks.write_text(picks.read_text() + row)
    with pytest.raises(HemislamError, match=words):
        laid(control, picks, grid="EPSG:32632")


def test_places_on_one_line_are_refused_wherever_their_points_were_picked(tmp_path: Path) -> None:
    _, picks = written(tmp_path, CORNERS)
    control, _ = written(tmp_path, {name: (10.0 * k, 3.0 * k, 0.0) for k, name in enumerate(CORNERS)}, noise=0.0)
    picks.write_text("name,x,y,z\n" + "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in CORNERS.items()))
    with pytest.raises(HemislamError, match="lie on one line"):
        laid(control, picks, grid="EPSG:32632")


@pytest.mark.parametrize(
    ("points", "grid", "words"),
    [
        (
            dict([*CORNERS.items()][:2]),
            "EPSG:32632",
            "only A and B are: the map's rotation about the line",
        ),
        ({name: (10.0 * k, 5.0 * k, 0.1 * k) for k, name in enumerate("ABCD")}, "EPSG:32632", "lie on one line"),
        (CORNERS, "", "say of which grid: EPSG:CODE"),
        (CORNERS, "EPSG:2056", "is not made for|has no place"),
    ],
)
def test_points_that_leave_the_place_open_are_refused_and_it_is_said_what(
    tmp_path: Path, points: dict[str, tuple[float, ...]], grid: str, words: str
) -> None:
    with pytest.raises(HemislamError, match=words):
        laid(*written(tmp_path, points), grid=grid)


def test_a_point_that_the_user_leaves_out_pulls_nothing_and_still_shows_how_far_it_is_off(tmp_path: Path) -> None:
    control, picks = written(tmp_path, CORNERS, noise=0.0)
    picks.write_text(picks.read_text().replace("D,-3.0", "D,-2.0"))  # picked a metre beside
    found = laid(control, picks, grid="EPSG:32632", overridden={"D": False})
    assert found.used.tolist() == [True, True, True, False] and found.rms.max() < 1e-5
    assert np.linalg.norm(found.residuals[3]) == pytest.approx(1.0, abs=1e-3)


def test_points_that_are_rejected_are_not_said_to_be_unpicked(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match="must be picked and accepted, but only C and D are"):
        laid(*written(tmp_path, CORNERS), grid="EPSG:32632", overridden={"A": False, "B": False})


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_pick_that_is_no_place_is_refused_by_its_name(number: float, tmp_path: Path) -> None:
    """A session file may hold any number."""
    control, picks = written(tmp_path, CORNERS)
    picked = read_picks(read_table(picks, *PICKS)) | {"C": np.array([1.0, number, 0.0])}
    with pytest.raises(HemislamError, match="C was picked at no place"):
        align_with_points(read_table(control, *CONTROL), picked, grid="EPSG:32632")
