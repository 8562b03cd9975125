"""The clip box: its handles, its sections, and the visible part of the map.

Tests app/ui/clip.py, app/ui/clip_maths.py, app/ui/profile.py.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.export.box import Box
from app.mapping.kept import Clip, Spot
from app.server.keeping import SetClip
from app.server.protocol import Chunk, Command, Snapshot
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import NON_GROUND
from app.ui.chunks import MapChunks
from app.ui.clip import ClipPanel
from app.ui.clip_maths import FACES, along_line, carried, edges, handle, pulled
from app.ui.measure import DISTANCE, MeasurePanel
from app.ui.measure_maths import meet
from app.ui.profile import ProfileNode, unrolled
from app.ui.widgets import View
from tests.ui.conftest import BusyThreads, Wire, browser_sends, clouds, finish, page_of, user_sets

BOX = Box.around((4.0, -2.0, 1.0), (6.0, 2.0, 3.0), 30.0)
RANDOM = np.random.default_rng(5)


# --- handles -------------------------------------------------------------------------------------
@pytest.mark.parametrize(("axis", "sign"), FACES)
def test_a_side_follows_its_handle_and_all_others_stay(axis: int, sign: int) -> None:
    R, place = handle(BOX, axis, sign)
    outwards = R[:, axis]
    assert np.linalg.det(R) == pytest.approx(1.0) and outwards @ (place - BOX.middle) > 0
    wider = pulled(BOX, axis, sign, place + 0.5 * outwards)
    expected = BOX.size.copy()
    expected[axis] += 0.5
    np.testing.assert_allclose(wider.size, expected)
    for other in FACES:
        moved = handle(wider, *other)[1] - handle(BOX, *other)[1]
        along = moved @ BOX.axes[:, other[0]]
        assert along == pytest.approx(0.5 * sign if other == (axis, sign) else 0.0, abs=1e-9)


def test_a_side_that_is_pulled_through_the_box_stops_before_the_other() -> None:
    R, place = handle(BOX, 0, 1)
    thin = pulled(BOX, 0, 1, place - 20.0 * R[:, 0])
    assert thin.size[0] == pytest.approx(0.05)
    np.testing.assert_allclose(handle(thin, 0, -1)[1], handle(BOX, 0, -1)[1])


def test_the_handle_in_the_middle_moves_and_turns_the_box() -> None:
    moved = carried(BOX, lie.from_rpy_degrees((0.0, 0.0, -50.0)), np.array([1.0, 2.0, 3.0]))
    assert moved.turn == pytest.approx(-50.0)
    np.testing.assert_allclose(moved.middle, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(moved.size, BOX.size)


def test_the_edges_of_a_box_are_as_long_as_its_sides_and_hold_it() -> None:
    lines = edges(BOX).astype(np.float64)
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.sort(np.repeat(BOX.size, 4)), rtol=1e-5)
    np.testing.assert_allclose(np.abs(BOX.own(lines.reshape(-1, 3))), np.tile(BOX.size / 2, (24, 1)), atol=1e-5)


def test_a_slab_between_two_clicks_has_them_at_its_ends() -> None:
    first, second = np.array([1.0, 2.0, 0.3]), np.array([4.0, 6.0, 1.9])
    box = along_line(first, second, 0.4, -1.0, 5.0)
    assert box is not None
    np.testing.assert_allclose(box.own(np.stack([first, second]))[:, :2], [[-2.5, 0.0], [2.5, 0.0]], atol=1e-9)
    np.testing.assert_allclose(box.size, [5.0, 0.4, 6.0])
    assert along_line(first, first + np.array([0.0, 0.0, 2.0]), 0.4, -1.0, 5.0) is None


# --- what is shown -------------------------------------------------------------------------------
def chunk(index: int, points: np.ndarray) -> Chunk:
    n = len(points)
    labels, ring = np.full(n, NON_GROUND, np.uint8), np.zeros(n, np.uint16)
    return Chunk(index, index, index, points.astype(np.float32), labels, np.zeros(n, np.float32), ring, np.eye(4))


def house() -> tuple[tuple[Chunk, ...], np.ndarray]:
    """Three keyframes 10 m apart, each with points within 4 m."""
    poses = np.stack(
        [lie.transform(lie.from_rpy_degrees((0.0, 0.0, 40.0 * k)), np.array([10.0 * k, 0, 0])) for k in range(3)]
    )
    return tuple(chunk(k, RANDOM.uniform(-4, 4, (500, 3))) for k in range(3)), poses


def in_map(chunks: tuple[Chunk, ...], poses: np.ndarray) -> np.ndarray:
    return np.concatenate([one.points @ T[:3, :3].T + T[:3, 3] for one, T in zip(chunks, poses, strict=True)])


def test_only_what_is_in_the_box_is_drawn_and_only_cut_keyframes_are_sent_again(
    server: viser.ViserServer, wire: Wire
) -> None:
    chunks, poses = house()
    drawn = MapChunks(server.scene, "/map/keyframes")
    drawn.draw(chunks, poses, View(ceilings=True))
    wire.clear()
    box = Box((-6.0, -6.0, -6.0), (9.0, 6.0, 6.0), 0.0)  # all of the first, a part of the second, nothing of the last
    drawn.draw(chunks, poses, View(ceilings=True, clip=box))
    assert wire.nodes("PointCloudMessage") == ["/map/keyframes/1"]
    assert "/map/keyframes/2" not in clouds(server)
    points = in_map(chunks, poses)
    assert drawn.points == box.holds(points).sum() > 500
    shown = np.concatenate([at for at, _ in drawn.shown()])
    np.testing.assert_allclose(shown, points[box.holds(points)], atol=1e-5)
    drawn.draw(chunks, poses, View(ceilings=True))
    assert drawn.points == 1500


def test_a_loop_that_moves_the_map_through_the_box_shows_other_points(server: viser.ViserServer) -> None:
    chunks, poses = house()
    drawn, box = MapChunks(server.scene, "/map/keyframes"), Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
    drawn.draw(chunks, poses, View(ceilings=True, clip=box))
    moved = poses.copy()
    moved[:, 0, 3] -= 10.0
    drawn.draw(chunks, moved, View(ceilings=True, clip=box))
    assert drawn.points == box.holds(in_map(chunks, moved)).sum()


def test_a_click_takes_no_point_that_the_box_hides() -> None:
    near, far = np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, 0.0]])
    chunks, poses = (chunk(0, np.concatenate([near, far])),), np.eye(4)[None]
    from_above = np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, -1.0]), 0.01
    hit = meet(chunks, poses, *from_above, ceilings=True)
    below = meet(chunks, poses, *from_above, ceilings=True, clip=Box((-1.0, -1, -1), (1.0, 1, 1)))
    assert hit is not None and below is not None and (hit.at[2], below.at[2]) == (3.0, 0.0)


def test_an_unrolled_path_puts_what_is_left_of_it_behind_it() -> None:
    path = np.array([[0.0, 0.0], [0.0, 5.0], [5.0, 5.0]])
    points = np.array([[-0.3, 2.0, 1.0], [0.3, 2.0, 1.5], [2.0, 5.3, 0.5], [2.0, 9.0, 0.0]])
    colours = np.arange(12, dtype=np.uint8).reshape(4, 3)
    found, own = unrolled([(points, colours)], path, 1.0)
    np.testing.assert_allclose(found, [[2.0, 0.3, 1.0], [2.0, -0.3, 1.5], [7.0, 0.3, 0.5]], atol=1e-12)
    np.testing.assert_array_equal(own, colours[:3])


def test_the_profile_takes_the_place_of_the_map_and_gives_it_back(server: viser.ViserServer) -> None:
    chunks, poses = house()
    drawn, root = MapChunks(server.scene, "/map/keyframes"), server.scene.add_frame("/map")
    drawn.draw(chunks, poses, View(ceilings=True, map=False))
    profile = ProfileNode(server.scene, root, drawn.shown)
    now = Snapshot(chunks=chunks, keyframe_poses=poses, trajectory=poses[:, :3, 3])
    profile.draw(now, View(slab=2.0))
    points = in_map(chunks, poses)
    beside = points[(np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 0) & (points[:, 0] < 20)]
    assert not root.visible and len(clouds(server)["/profile"].points) == len(beside) > 100
    profile.draw(now, View())
    assert root.visible and "/profile" not in clouds(server)
    profile.draw(replace(now, trajectory=poses[:1, :3, 3]), View(slab=2.0))
    assert "/profile" not in clouds(server), "nobody has walked yet"


# --- the panel -----------------------------------------------------------------------------------
class Bench:
    """The clip panel on a map of a house, and a fake engine that applies the commands it receives."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.chunks, self.poses = house()
        self.now = Snapshot(chunks=self.chunks, keyframe_poses=self.poses, trajectory=self.poses[:, :3, 3])
        self.asked: list[str] = []
        self.faced: list[Any] = []
        page = page_of(server, self.send, lambda: self.now)
        self.measure = MeasurePanel(page)
        camera = SimpleNamespace(face=lambda *args: self.faced.append(args), look=lambda *args: self.faced.append(args))
        self.panel = ClipPanel(
            page,
            self.measure,
            camera,  # type: ignore[arg-type]
            lambda: in_map(self.chunks, self.poses),
            lambda client, format: self.asked.append(format),
        )
        self.client = SimpleNamespace(add_notification=lambda *args, **_: self.asked.append(str(args[1])))

    def send(self, command: Command) -> None:
        assert isinstance(command, SetClip)
        self.now = replace(self.now, clip=replace(self.now.clip, **command.changes))

    def draw(self) -> None:
        self.panel.draw(self.now)

    def drag(self, client: Any) -> None:
        """Show `BOX`, and begin to drag a side of it in a browser, which does not let go."""
        self.now = replace(self.now, clip=Clip(BOX, on=True))
        self.draw()
        gizmo = SimpleNamespace(position=handle(BOX, 0, 1)[1] + 1.0, wxyz=(1.0, 0.0, 0.0, 0.0))
        event = SimpleNamespace(client=client, target=gizmo, phase="update")
        finish(self.panel._noting(FACES.index((0, 1)))(event))
        self.draw()
        assert self.panel._dragged is not None


def test_switched_on_it_holds_the_map_and_shows_its_handles(server: viser.ViserServer, wire: Wire) -> None:
    bench = Bench(server)
    bench.panel._switch(True)
    bench.draw()
    box = bench.now.clip.hiding
    assert box is not None and box.holds(in_map(bench.chunks, bench.poses)).mean() > 0.9
    assert len(wire.nodes("TransformControlsMessage")) == 7 and bench.panel._fields.visible
    assert bench.panel.seen(bench.now, View()).clip == box
    bench.now = replace(bench.now, clip=replace(bench.now.clip, on=False))
    bench.draw()
    assert bench.panel.seen(bench.now, View()).clip is None and not bench.panel._handles
    bench.now = replace(bench.now, clip=Clip(BOX, on=True))
    bench.draw()
    np.testing.assert_allclose(bench.panel._middle.value, BOX.middle)


class BusyBench(Bench):
    """Whose engine takes commands only when it is told to."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.waiting: list[Command] = []
        super().__init__(server)

    def send(self, command: Command) -> None:
        self.waiting.append(command)

    def catch_up(self) -> None:
        for command in self.waiting:
            super().send(command)
        self.draw()


def test_what_is_set_while_the_engine_is_busy_all_counts(server: viser.ViserServer) -> None:
    bench = BusyBench(server)
    user_sets(bench.panel._slab, 2.5)
    user_sets(bench.panel._on, True)
    bench.catch_up()
    assert bench.now.clip.hiding is not None and bench.now.clip.slab == bench.panel._slab.value == 2.5


def test_a_number_that_arrives_just_before_an_older_snapshot_is_kept(
    server: viser.ViserServer, busy: BusyThreads
) -> None:
    bench = BusyBench(server)
    bench.now = replace(bench.now, clip=Clip(BOX, on=True))
    bench.draw()
    browser_sends(server, bench.panel._turn, 12.5)
    bench.now = replace(bench.now, clip=Clip(BOX, on=True, slab=3.0))  # of the slab that was set before
    bench.draw()
    busy.catch_up()
    bench.catch_up()
    assert bench.now.clip == Clip(Box.around(BOX.middle, BOX.size, 12.5), on=True, slab=3.0)


def test_two_clicks_cut_a_slab_and_the_camera_looks_at_its_front(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.now = replace(bench.now, clip=Clip(slab=0.5))
    bench.measure.client = bench.client  # type: ignore[assignment]
    bench.measure.begin(DISTANCE, bench.panel._picked)
    assert bench.measure.picking
    for keyframe in (0, 2):
        bench.measure._take(bench.measure._tool, Spot(keyframe, (0.0, 0.0, 0.0)), bench.now)
    box = bench.now.clip.hiding
    assert box is not None
    np.testing.assert_allclose(box.middle[:2], [10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(box.size[:2], [20.0, 0.5])
    assert len(bench.faced) == 1 and not bench.measure.picking
    assert bench.faced[0][0] is bench.measure.client, "not that of the button, which may have been reloaded since"


def test_a_cut_that_is_begun_is_not_ended_in_another_recording(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.measure.draw(bench.now, View())
    bench.measure.begin(DISTANCE, bench.panel._picked)
    bench.measure._take(bench.measure._tool, Spot(0, (0.0, 0.0, 0.0)), bench.now)
    bench.draw()
    assert "other end" in bench.panel._asked.content
    bench.now = replace(bench.now, session=bench.now.session + 1)
    bench.measure.draw(bench.now, View())
    bench.draw()
    assert "first end" in bench.panel._asked.content
    bench.measure._take(bench.measure._tool, Spot(2, (0.0, 0.0, 0.0)), bench.now)
    assert bench.now.clip.box is None and bench.measure.picking


def test_a_cut_whose_first_end_is_gone_after_going_back_begins_anew(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.measure.draw(bench.now, View())
    bench.measure.begin(DISTANCE, bench.panel._picked)
    bench.measure._take(bench.measure._tool, Spot(2, (0.0, 0.0, 0.0)), bench.now)
    bench.now = replace(bench.now, chunks=bench.chunks[:2], keyframe_poses=bench.poses[:2])
    bench.measure.draw(bench.now, View())
    bench.draw()
    assert "first end" in bench.panel._asked.content
    for keyframe in (0, 1):
        bench.measure._take(bench.measure._tool, Spot(keyframe, (0.0, 0.0, 0.0)), bench.now)
    assert bench.now.clip.box is not None


def test_a_box_that_is_hidden_while_it_is_dragged_has_its_handles_again_later(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another page hides it; the one that drags then says nothing more."""
    bench, dragging = Bench(server), SimpleNamespace(client_id=7)
    monkeypatch.setattr(server, "get_clients", lambda: {7: dragging})
    bench.drag(dragging)
    for on in (False, True):
        bench.now = replace(bench.now, clip=Clip(BOX, on=on))
        bench.draw()
    assert len(bench.panel._handles) == 7
    np.testing.assert_allclose(bench.panel._lines.points, edges(BOX))  # type: ignore[union-attr]


def test_a_handle_that_a_lost_browser_held_is_free_again(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, connected = Bench(server), {7: SimpleNamespace(client_id=7)}
    monkeypatch.setattr(server, "get_clients", lambda: connected)
    bench.drag(connected[7])
    connected.clear()
    bench.draw()
    np.testing.assert_allclose(bench.panel._lines.points, edges(BOX))  # type: ignore[union-attr]
    moved = Box.around(BOX.middle + 2.0, BOX.size, BOX.turn)
    bench.now = replace(bench.now, clip=Clip(moved, on=True))
    bench.draw()
    np.testing.assert_allclose(bench.panel._handles[-1].position, moved.middle, atol=1e-6)


def test_a_profile_stands_in_the_place_of_the_map(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.panel._unroll(True, bench.client)  # type: ignore[arg-type]
    view = bench.panel.seen(bench.now, View())
    assert view.slab == 1.0 and not view.map
    ((_, middle, size),) = bench.faced
    assert middle[0] == pytest.approx(10.0) and size[0] == pytest.approx(20.0)


def test_a_profile_is_not_cut_off_by_the_box_of_a_section(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.now = replace(bench.now, clip=Clip(BOX, on=True))
    bench.panel._unroll(True, bench.client)  # type: ignore[arg-type]
    assert bench.now.clip == Clip(BOX, on=False, unrolled=True)


def test_before_there_is_a_map_nothing_is_clipped_and_that_is_said(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.chunks, bench.poses = (), np.empty((0, 4, 4))
    bench.panel._around = lambda: np.empty((0, 3))
    bench.now = Snapshot()
    with pytest.raises(HemislamError, match="no map yet"):
        bench.panel._switch(True)
    with pytest.raises(HemislamError, match="walked path"):
        bench.panel._unroll(True, bench.client)  # type: ignore[arg-type]
    assert bench.now.clip == Clip()


def test_boxes_take_all_the_decimals_that_they_show(server: viser.ViserServer) -> None:
    panel = Bench(server).panel
    assert panel._turn.precision == 2
    assert min(panel._slab.precision, panel._middle.precision, panel._size.precision) >= 2


@pytest.mark.parametrize("slab", [-1.0, 0.0, float("nan"), 200.0])
def test_a_slab_that_a_session_could_not_be_opened_with_is_refused(slab: float) -> None:
    with pytest.raises(HemislamError, match="slab cannot be"):
        Clip(slab=slab)
