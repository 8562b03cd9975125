"""Georeferencing in the page. Tests app/ui/georeference.py, app/ui/georeference_maths.py."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from app.georeference.align import Alignment
from app.georeference.reference import GeoReference
from app.georeference.survey import Survey
from app.mapping.kept import Measure, Spot
from app.server.folders import Folders
from app.server.protocol import (
    Chunk,
    Command,
    Earth,
    EditLoop,
    Georeference,
    LoopsView,
    OpenedRecording,
    RedoLoop,
    Snapshot,
    UndoLoop,
)
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops.edits import Override
from app.ui.georeference import CONTROL, FILE, NOTHING, RECORDED, GeoreferencePanel
from app.ui.georeference_maths import centre_of_sphere, lines_of, names_of, numbers_in, rows_of
from app.ui.measure import STOP, MeasurePanel
from app.ui.measure_maths import as_csv, numbers, words
from app.ui.widgets import View
from tests.ui.conftest import Wire, page_of, user_clicks, user_sets
from tests.ui.test_measure import FLOOR, POSES, SEEN_AT, UP_AT_10, chunk_of

WHERE = GeoReference(
    "EPSG:32632", (691_500.0, 5_334_700.0, 520.0), ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
)
TABLE = "name,E,N,H\nP1,691500,5334700,520\nP2,691510,5334700,520\nP3,691500,5334710,520\n"


def alignment(residuals: np.ndarray, used: list[bool]) -> Alignment:
    """Of fixes 1, 2, ... a metre apart."""
    names = tuple(str(k + 1) for k in range(len(used)))
    grid = WHERE.to_crs(np.column_stack([np.arange(len(used)), np.zeros((len(used), 2))])) + residuals
    return Alignment(WHERE, names, grid, residuals, np.linalg.norm(residuals, axis=1) / 0.02, np.array(used))


FOUND = alignment(np.array([[0.01, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.02, 0.0]]), [True, False, True])
LAID = Snapshot(earth=Earth(Survey(lever=(0.1, -0.2, 0.4), crs="EPSG:32632", factors=True), FOUND))


class Paging:
    """The panel, and a map of one floor on which clicks are made from 10 m above."""

    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.sent: list[Command] = []
        self.now = Snapshot(chunks=(FLOOR,), keyframe_poses=POSES)
        page = page_of(server, self.sent.append, lambda: self.now)
        self.measure = MeasurePanel(page)
        self.panel = GeoreferencePanel(page, Folders([folder]), self.measure)

    def show(self, now: Snapshot) -> None:
        self.now = now
        self.panel.draw(now)

    def lay(self) -> Survey | None:
        user_clicks(self.panel._lay)
        command = self.sent.pop()
        assert isinstance(command, Georeference)
        return command.survey

    def click(self, x: float, y: float) -> None:
        self.measure._click = (UP_AT_10, np.array([x, y, 0.0]) - UP_AT_10, 0.01)
        self.measure.draw(self.now, View())


@pytest.fixture
def paging(server: viser.ViserServer, tmp_path: Path) -> Paging:
    return Paging(server, tmp_path)


def choose(control: Any, value: Any) -> None:
    user_sets(control, value)


def test_the_widgets_say_what_the_map_is_georeferenced_by(paging: Paging, tmp_path: Path) -> None:
    panel = paging.panel
    assert paging.lay() is None
    choose(panel._by, RECORDED)
    assert paging.lay() == Survey()
    choose(panel._lever, "0.1 -0.2, 0.4")
    choose(panel._offset, "80")
    choose(panel._crs, " EPSG:25832 ")
    choose(panel._use, "as factors")
    given = Survey(lever=(0.1, -0.2, 0.4), offset_s=0.08, crs="EPSG:25832", factors=True)
    assert paging.lay() == given
    panel._file = tmp_path / "rover.nmea"
    choose(panel._by, FILE)
    assert paging.lay() == replace(given, gnss=tmp_path / "rover.nmea")
    choose(panel._by, CONTROL)
    assert panel._table.visible and not panel._pick.visible
    panel._uploaded(TABLE.encode())
    assert panel._pick.visible
    assert paging.lay() == Survey(control=TABLE, crs="EPSG:25832")


def test_there_is_nothing_to_stop_where_nothing_is_georeferenced(paging: Paging) -> None:
    paging.show(Snapshot())
    assert not paging.panel._lay.visible
    choose(paging.panel._by, RECORDED)
    assert paging.panel._lay.visible and paging.panel._lay.label == "Georeference the map"
    paging.show(LAID)
    choose(paging.panel._by, NOTHING)
    assert paging.panel._lay.visible and paging.panel._lay.label == "Stop georeferencing"


@pytest.mark.parametrize("text", ["0.1 0.2", "a b c", "nan 0 0"])
def test_a_malformed_lever_arm_is_reported(text: str) -> None:
    with pytest.raises(HemislamError, match=r"The lever arm is .* it takes 3 numbers, or nothing"):
        numbers_in(text, "lever arm", 3)


def test_a_session_that_is_reopened_shows_what_it_was_georeferenced_by(paging: Paging) -> None:
    paging.show(LAID)
    assert paging.panel._by.value == RECORDED and paging.lay() == LAID.earth.survey
    paging.show(Snapshot())
    assert paging.panel._by.value == NOTHING and paging.panel._html.content == ""


def test_fixes_of_a_recording_that_is_opened_are_offered(paging: Paging) -> None:
    walk = OpenedRecording(Path("walk.mcap"), 0, 60.0, 600, (), fixes=True)
    paging.show(Snapshot(recording=walk))
    assert paging.panel._by.value == RECORDED and paging.lay() == Survey()
    paging.show(Snapshot(recording=walk, earth=Earth(Survey())))
    paging.show(Snapshot(recording=walk))  # the user took it back
    assert paging.panel._by.value == NOTHING
    choose(paging.panel._by, CONTROL)
    paging.show(Snapshot(recording=replace(walk, frames=601)))
    assert paging.panel._by.value == CONTROL
    paging.show(Snapshot(recording=replace(walk, path=Path("indoors.mcap"), fixes=False)))
    assert paging.panel._by.value == NOTHING


def test_rejected_fixes_come_first_and_a_click_lets_one_count(paging: Paging) -> None:
    paging.show(LAID)
    html = paging.panel._html.content
    assert "E 0.0071 m" in html and html.index("override fix 2") < html.index("override fix 3") < html.index("fix 1")
    paging.panel._act("override fix 2", None)  # type: ignore[arg-type]
    assert paging.sent == [EditLoop(Override("fix 2", accepted=True))]
    paging.panel._act("override fix 9", None)  # type: ignore[arg-type]
    paging.panel._act("undo", None)  # type: ignore[arg-type]
    paging.panel._act("redo", None)  # type: ignore[arg-type]
    assert paging.sent[1:] == [UndoLoop(), RedoLoop()]
    edited = replace(LAID, loops=LoopsView(undo=(Override("fix 1", accepted=True),)))
    assert [(row.name, row.edited) for row in rows_of(FOUND, edited)] == [("2", False), ("1", True), ("3", False)]
    paging.show(edited)
    assert "Undo: accept fix 1" in paging.panel._html.content


def test_fixes_are_drawn_where_they_were_measured_with_lines_to_the_map(paging: Paging, wire: Wire) -> None:
    measured, lines = lines_of(FOUND)
    np.testing.assert_allclose(lines[:, 1], [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(measured[1], [1 + 4, -3, 0], atol=1e-5)  # the map's x looks north, its y west
    paging.show(LAID)
    assert wire.nodes("LineSegmentsMessage") == ["/map/fixes/used", "/map/fixes/rejected"]


def test_a_problem_is_shown_instead_of_numbers(paging: Paging) -> None:
    paging.show(Snapshot(earth=Earth(Survey(), problem="Only 3 fixes <lie> there.")))
    assert "Only 3 fixes &lt;lie&gt; there." in paging.panel._html.content


def test_points_are_picked_one_after_the_other_by_clicks_on_the_map(paging: Paging) -> None:
    paging.show(replace(paging.now, earth=Earth(Survey(control=TABLE, crs="EPSG:32632"))))
    panel = paging.panel
    assert panel._name.options == ("P1", "P2", "P3") and panel._pick.visible
    for k, name in enumerate(("P1", "P2")):
        user_clicks(panel._pick)
        assert paging.measure.picking
        paging.click(0.5 * k, 0.2)
        (command,) = paging.sent
        assert isinstance(command, Georeference) and command.survey is not None
        pick = command.survey.picks[-1]
        at = POSES[pick.keyframe] @ (*pick.at, 1.0)
        assert pick.name == name and at[:3] == pytest.approx([0.5 * k, 0.2, 0.0], abs=0.1)
        assert not paging.measure.picking and len(command.survey.picks) == k + 1
        paging.sent.clear()
        paging.show(replace(paging.now, earth=Earth(command.survey, problem="open")))
    assert "drop P1" in panel._html.content
    panel._act("drop P1", None)  # type: ignore[arg-type]
    (command,) = paging.sent
    assert isinstance(command, Georeference) and [pick.name for pick in command.survey.picks] == ["P2"]  # type: ignore[union-attr]


@pytest.mark.parametrize("instead", [STOP, "distance"])
def test_the_button_asks_for_a_click_only_while_a_point_is_picked(paging: Paging, instead: str) -> None:
    earth = replace(paging.now, earth=Earth(Survey(control=TABLE, crs="EPSG:32632")))
    paging.show(earth)
    button, usual = paging.panel._pick, paging.panel._pick.label
    user_clicks(button)
    paging.show(earth)
    assert button.label == "Click P1 on the map …"
    paging.measure.begin(instead)
    paging.show(earth)
    assert button.label == usual == "Pick it on the map"


def sphere(centre: np.ndarray, radius: float, points: int = 400) -> Chunk:
    """The side of it that the sensor sees, with 2 mm of noise, and a floor around."""
    random = np.random.default_rng(3)
    ways = random.normal(size=(points, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    ways = ways[ways @ (SEEN_AT[:3, 3] - centre) > 0]
    floor = np.column_stack([centre[:2] + random.uniform(-0.3, 0.3, (60, 2)), np.zeros(60)])
    return chunk_of(1, np.concatenate([centre + radius * ways + random.normal(size=ways.shape) * 0.002, floor]))


@pytest.mark.parametrize("away", [True, False])
def test_picking_ends_with_the_control_points_and_takes_no_click_of_another_recording(
    paging: Paging, away: bool
) -> None:
    here = replace(paging.now, recording=OpenedRecording(Path("a.mcap"), 0, 9.0, 90, ()))
    paging.show(replace(here, earth=Earth(Survey(control=TABLE))))
    user_clicks(paging.panel._pick)
    assert paging.measure.picking
    if away:
        paging.show(replace(paging.now, recording=OpenedRecording(Path("b.mcap"), 0, 9.0, 90, ()), earth=Earth()))
    else:
        choose(paging.panel._by, NOTHING)
    assert not paging.measure.picking


def test_a_click_on_a_sphere_finds_its_centre_to_millimetres() -> None:
    centre, radius = np.array([1.0, 0.5, 0.25]), 0.1
    toward = (SEEN_AT[:3, 3] - centre) / np.linalg.norm(SEEN_AT[:3, 3] - centre)
    sideways = lie.exp(np.array([0.0, 0.0, 0.5])) @ toward
    on_it = lie.inverse(POSES[1]) @ (*(centre + radius * sideways), 1.0)
    chunk = sphere(centre, radius)
    found = POSES[1] @ (*centre_of_sphere((chunk,), POSES, Spot(1, tuple(on_it[:3])), radius), 1.0)  # type: ignore[arg-type]
    np.testing.assert_allclose(found[:3], centre, atol=0.003)
    for spot, size in ((Spot(1, tuple(on_it[:3])), 0.3), (Spot(1, (50.0, 0.0, 0.0)), radius)):  # type: ignore[arg-type]
        with pytest.raises(HemislamError, match="do not form a sphere"):
            centre_of_sphere((chunk,), POSES, spot, size)


def test_a_measured_point_has_its_coordinates_on_earth_too() -> None:
    at = np.array([[2.0, 3.0, 1.0]])
    found = numbers(at, (), POSES)
    assert "x 2.000, y 3.000, z 1.000 m; E 691497.000, N 5334702.000, H 521.000 m (EPSG:32632" in words(
        at, found, WHERE
    )
    head, row = as_csv([(Measure("door", (Spot(0, (0.0, 0.0, 0.0)),)), at, found)], WHERE).splitlines()
    assert head.endswith(",east_m,north_m,grid_height_m") and row.endswith("691497.0000,5334702.0000,521.0000")


def test_a_table_that_names_no_points_is_refused(paging: Paging) -> None:
    assert names_of(TABLE) == ("P1", "P2", "P3") and names_of("a,b\n1,2\n") == ()
    for text, why in ((b"a,b\n1,2\n", "holds no control points"), (b"x" * 70_000, "at most 64 kB")):
        with pytest.raises(HemislamError, match=why):
            paging.panel._uploaded(text)
    assert paging.panel._control == ""


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("P1,691520,5334700,520", "holds control point P1 more than once"),
        (",691520,5334700,520", "row 4: the name is missing"),
        ("P4,abc,5334700,520", r"row 4: `abc` is not a number \(east\)"),
        ("P4,691520,,520", "row 4: the north is missing"),
        ("P4,691520,5334700,nan", "row 4: the height is missing"),
        ("P4,691520", "row 4 has 2 columns"),
    ],
)
def test_a_row_that_is_no_control_point_is_named_when_the_table_is_loaded(paging: Paging, row: str, why: str) -> None:
    with pytest.raises(HemislamError, match=why):
        paging.panel._uploaded(f"{TABLE}{row}\n".encode())
    assert paging.panel._control == ""


@pytest.mark.parametrize(
    ("places", "why"),
    [
        (("48.1,11.5", "95,11.5", "48.1,11.6"), "row 2: the latitude 95.0000° is beyond 90°"),
        (("121.1,31.5", "121.2,31.5", "121.1,31.6"), "seem to be swapped: exchange them"),
    ],
)
def test_a_latitude_beyond_the_pole_is_refused_when_the_table_is_loaded(
    paging: Paging, places: tuple[str, ...], why: str
) -> None:
    rows = "".join(f"P{number},{place},520\n" for number, place in enumerate(places))
    with pytest.raises(HemislamError, match=why):
        paging.panel._uploaded(f"name,lat,lon,height\n{rows}".encode())
    assert paging.panel._control == ""


def test_a_session_that_names_a_point_twice_does_not_offer_it_twice(paging: Paging) -> None:
    paging.show(Snapshot(earth=Earth(Survey(control=f"{TABLE}P1,691520,5334700,520\n"))))
    assert paging.panel._name.options == ("P1", "P2", "P3")
