"""Messages of the scene: only changes, and nothing twice."""

from dataclasses import replace

import numpy as np
import pytest
import viser

from app.export.box import Box
from app.server.protocol import SetParams, StepFrame
from app.slam.types import MOVING
from app.ui.appearance import AppearancePanel
from app.ui.chunks import MapChunks
from app.ui.colours import LABEL_COLOURS, Limits
from app.ui.scale import Looks
from app.ui.widgets import View
from tests.ui.conftest import Wire, clouds
from tests.ui.drawn import Drawn, chunk_nodes
from tests.ui.fake_engine import FakeEngine

SCAN = "/map/sensor/lidar/scan"


def test_nothing_is_sent_when_nothing_changed(drawn: Drawn, wire: Wire) -> None:
    drawn.draw()
    assert [m for m in wire.messages if type(m).__name__ != "SetPositionMessage"] == []


def test_a_relabelled_frame_sends_its_colours_and_no_points(drawn: Drawn, wire: Wire) -> None:
    drawn.engine.send(SetParams({"ground.sigma": 0.2}))
    drawn.draw()
    sent = wire.updates(SCAN)
    assert set(sent) == {"colors"}
    assert len(sent["colors"]) == len(drawn.engine.snapshot.result.cloud)  # type: ignore[union-attr]


def test_the_page_shows_the_labels_that_the_engine_gave(drawn: Drawn, server: viser.ViserServer) -> None:
    drawn.engine.send(SetParams({"ground.sigma": 0.005, "ground.alpha": 20}))
    drawn.draw()
    scan = server.scene.get_handle_by_name(SCAN)
    result = drawn.engine.snapshot.result
    assert isinstance(scan, viser.PointCloudHandle) and result is not None
    expected = np.array([LABEL_COLOURS[int(label)] for label in result.cloud.labels])
    assert np.array_equal(scan.colors, expected)


@pytest.mark.parametrize("by", ["height", "height × intensity"])
def test_while_the_ground_is_tuned_the_map_is_dimmed_and_the_scan_shows_its_labels(
    drawn: Drawn, server: viser.ViserServer, wire: Wire, by: str
) -> None:
    drawn.draw(View(colour_by=by))
    before = {name: node.colors.copy() for name, node in chunk_nodes(server).items()}
    wire.clear()
    drawn.draw(View(colour_by=by, tuning=True))
    for name, node in chunk_nodes(server).items():
        assert node.colors.shape == (3,) and node.colors.max() < 80, "one dark colour, of three bytes"
        assert set(wire.updates(name)) <= {"colors", "point_size"}
    result = drawn.engine.snapshot.result
    assert result is not None
    expected = np.array([LABEL_COLOURS[int(label)] for label in result.cloud.labels])
    assert np.array_equal(clouds(server)[SCAN].colors, expected)
    drawn.engine.send(StepFrame(8))
    drawn.draw()
    drawn.draw(View(colour_by=by))
    after = chunk_nodes(server)
    assert len(after) > len(before) and all(node.colors.shape == node.points.shape for node in after.values())
    assert all(after[name].colors.shape == colors.shape for name, colors in before.items())


def test_keyframes_that_a_loop_moves_send_poses_and_no_points(drawn: Drawn, wire: Wire) -> None:
    moved = drawn.engine.snapshot.keyframe_poses.copy()
    moved[:, 0, 3] += 0.5
    drawn.draw(keyframe_poses=moved)
    assert wire.nodes("PointCloudMessage") == []
    assert all("points" not in m.updates for m in wire.messages if type(m).__name__ == "SceneNodeUpdateMessage"
               and m.name.startswith("/map/keyframes"))  # fmt: skip
    placed = {m.name: m.position for m in wire.messages if type(m).__name__ == "SetPositionMessage"}
    for index, T in enumerate(moved):
        assert placed[f"/map/keyframes/{index}"] == pytest.approx(T[:3, 3])


def test_a_new_frame_sends_no_keyframe_again(drawn: Drawn, wire: Wire) -> None:
    drawn.engine.send(StepFrame(2))
    drawn.draw()
    assert not [name for name in wire.nodes("SceneNodeUpdateMessage") if name.startswith("/map/keyframes")]


def test_points_are_drawn_where_the_map_has_them(drawn: Drawn, server: viser.ViserServer) -> None:
    from viser.transforms import SE3, SO3

    drawn.draw(View(ceilings=True))
    snapshot = drawn.engine.snapshot
    for chunk, T in zip(snapshot.chunks, snapshot.keyframe_poses, strict=True):
        node = chunk_nodes(server)[f"/map/keyframes/{chunk.index}"]
        placed = SE3.from_rotation_and_translation(
            SO3(np.array(node.wxyz)), np.array(node.position)
        ) @ node.points.astype(float)
        assert np.abs(placed - (chunk.points @ T[:3, :3].T + T[:3, 3])).max() < 0.03  # float16 at 40 m


def test_without_ceilings_the_map_has_no_points_above_the_walls(drawn: Drawn, server: viser.ViserServer) -> None:
    node = chunk_nodes(server)["/map/keyframes/0"]
    up = drawn.engine.snapshot.keyframe_poses[0, 2, :3]
    assert (node.points.astype(float) @ up).max() < 1.3
    drawn.draw(View(ceilings=True))
    node = chunk_nodes(server)["/map/keyframes/0"]
    assert (node.points.astype(float) @ up).max() > 1.4


def test_of_the_scan_only_what_is_in_the_clip_box_is_shown(drawn: Drawn, server: viser.ViserServer) -> None:
    result = drawn.engine.snapshot.result
    assert result is not None
    T = result.T_map_imu @ result.state.T_imu_lidar
    whole = len(clouds(server)["/map/sensor/lidar/scan"].points)
    box = Box.around(T[:3, 3] + [2.0, 0.0, 0.0], (4.0, 4.0, 4.0), 20.0)
    drawn.draw(View(clip=box))
    scan = clouds(server)["/map/sensor/lidar/scan"]
    places = scan.points.astype(float) @ T[:3, :3].T + T[:3, 3]
    assert 10 < len(scan.points) < whole and np.abs(box.own(places)).max() < 2.02  # float16
    drawn.draw(View(clip=Box((90.0, 90, 90), (91.0, 91, 91))))
    assert not clouds(server)["/map/sensor/lidar/scan"].visible
    drawn.draw(View())
    assert len(clouds(server)["/map/sensor/lidar/scan"].points) == whole


def test_the_map_stays_within_its_budget(server: viser.ViserServer, wire: Wire, engine: FakeEngine) -> None:
    drawn = Drawn(server, engine, budget=6_000)
    for _ in range(20):
        engine.send(StepFrame(6))
        drawn.draw(View(ceilings=True))
        assert drawn.scene.chunks.points <= 6_000
        assert sum(len(node.points) for node in chunk_nodes(server).values()) == drawn.scene.chunks.points
    assert len(chunk_nodes(server)) == len(engine.snapshot.chunks)
    newest, oldest = (chunk_nodes(server)[f"/map/keyframes/{i}"] for i in (len(engine.snapshot.chunks) - 1, 0))
    assert len(newest.points) > 2 * len(oldest.points)


def test_of_a_map_larger_than_the_page_s_budget_what_is_near_the_eye_is_sent_again(
    server: viser.ViserServer, wire: Wire, engine: FakeEngine
) -> None:
    engine.send(StepFrame(60))
    snapshot = engine.snapshot
    chunks = snapshot.chunks
    poses = np.tile(np.eye(4), (len(chunks), 1, 1))
    poses[:, 0, 3] = 5.0 * np.arange(len(chunks))
    budget = sum(len(chunk.points) for chunk in chunks) // 3
    drawn = MapChunks(server.scene, "/map/keyframes", budget)

    def shown(*eyes: np.ndarray) -> np.ndarray:
        drawn.draw(chunks, poses, View(ceilings=True), np.array(eyes).reshape(-1, 3))
        found = chunk_nodes(server)
        assert drawn.points <= budget and drawn.points == sum(len(node.points) for node in found.values())
        return np.array([len(found[f"/map/keyframes/{chunk.index}"].points) for chunk in chunks])

    first = shown(poses[0, :3, 3])
    assert first[0] == len(chunks[0].points) and first[-1] < len(chunks[-1].points) / 2
    wire.clear()
    assert (shown(poses[0, :3, 3]) == first).all() and not wire.nodes("PointCloudMessage"), "who stands still"
    last = shown(poses[-1, :3, 3])
    assert last[-1] == len(chunks[-1].points) and last[0] < first[0]
    assert len(chunk_nodes(server)) == len(chunks)


def test_two_pages_thin_the_same_way(server: viser.ViserServer, wire: Wire, engine: FakeEngine) -> None:
    shown = []
    for _ in range(2):
        server.scene.reset()
        drawn = Drawn(server, engine, budget=4_000)
        engine.send(StepFrame(30)) if not shown else None
        drawn.draw()
        shown.append({name: len(node.points) for name, node in chunk_nodes(server).items()})
    assert shown[0] == shown[1] and shown[0]


def test_colouring_sends_colours_only_and_the_legend_knows_its_limits(drawn: Drawn, wire: Wire) -> None:
    for by in ("height", "intensity", "ring", "time"):
        wire.clear()
        drawn.draw(View(colour_by=by))
        assert set(wire.updates("/map/keyframes/0")) == {"colors"}
        assert wire.nodes("PointCloudMessage") == []
        limits = drawn.scene.chunks.limits.get(by)
        assert limits is not None and limits.low < limits.high


def test_higher_points_are_lighter_when_coloured_by_height(drawn: Drawn, server: viser.ViserServer) -> None:
    drawn.draw(View(colour_by="height"))
    node = chunk_nodes(server)["/map/keyframes/0"]
    height = node.points.astype(float) @ drawn.engine.snapshot.keyframe_poses[0, 2, :3]
    order = np.argsort(height)
    third = len(order) // 3
    assert node.colors[order[-third:]].mean() > node.colors[order[:third]].mean() + 20


def test_colours_spread_over_the_chosen_ends_and_saturate_beyond(drawn: Drawn, server: viser.ViserServer) -> None:
    drawn.draw(View(colour_by="height"))
    all_values = drawn.scene.chunks.limits.get("height")
    assert all_values is not None
    low, high = all_values.low, all_values.low + 0.4 * (all_values.high - all_values.low)
    drawn.draw(View(colour_by="height", ends=Limits(low, high)))
    node = chunk_nodes(server)["/map/keyframes/0"]
    pose = drawn.engine.snapshot.keyframe_poses[0]
    chunk = drawn.engine.snapshot.chunks[0]
    height = (node.points.astype(float) @ (pose @ chunk.T_imu_lidar)[2, :3]) + (pose @ chunk.T_imu_lidar)[2, 3]
    beyond = node.colors[height > high + 0.05].astype(int)
    red = beyond.max(axis=1, keepdims=True)
    assert len(beyond) > 10 and np.ptp(beyond / red, axis=0).max() < 0.03, "one colour, lit differently"
    assert drawn.scene.chunks.limits.get("height") == all_values, "the bar still ends at all values"


@pytest.mark.parametrize(
    ("word", "ends"),
    [("ends 10 80", Limits(2.2, 3.6)), ("ends 80 10", None), ("ends 0 101", None), ("ends x 3", None), ("", None)],
)
def test_the_ends_of_the_colour_bar_are_shares_of_all_values(
    server: viser.ViserServer, word: str, ends: Limits | None
) -> None:
    panel = AppearancePanel(server.gui, server.gui.add_html(""), Looks(server))
    panel.choose_ends("ends 10 80")
    assert panel.view.ends is None, "there are no values yet"
    panel.draw(View(), Limits(2.0, 4.0), [], 0, 0, 1)
    panel.choose_ends(word)
    assert panel.view.ends == ends
    panel.choose_ends("ends 0 100")
    assert panel.view.ends is None


def test_following_keeps_the_sensor_near_the_origin_and_leaves_the_camera_alone(drawn: Drawn, wire: Wire) -> None:
    for _ in range(60):
        drawn.engine.send(StepFrame(1))
        drawn.draw(View(follow=True))
    root = next(
        m.position for m in reversed(wire.messages) if getattr(m, "name", "") == "/map" and hasattr(m, "position")
    )
    sensor = drawn.engine.snapshot.result.T_map_imu[:3, 3]  # type: ignore[union-attr]
    assert np.linalg.norm(sensor) > 5
    assert np.linalg.norm(sensor + root) < 0.5
    assert not [m for m in wire.messages if type(m).__name__.startswith("SetCamera")]


def test_looking_freely_the_map_stands_still(drawn: Drawn, wire: Wire) -> None:
    drawn.draw(View(follow=False))
    wire.clear()
    drawn.engine.send(StepFrame(5))
    drawn.draw()
    assert not [m for m in wire.messages if getattr(m, "name", "") == "/map"]


def test_the_grid_lies_on_the_ground_below_the_sensor(drawn: Drawn, server: viser.ViserServer) -> None:
    grid = server.scene.get_handle_by_name("/map/grid")
    assert grid is not None
    assert grid.position[2] == pytest.approx(-1.3, abs=0.05)  # the map starts at the sensor, 1.3 m up


def test_the_path_is_sent_in_blocks(server: viser.ViserServer, wire: Wire, engine: FakeEngine) -> None:
    drawn = Drawn(server, engine)
    walk = np.cumsum(np.full((600, 3), 0.01), axis=0)
    engine.send(StepFrame(1))
    drawn.draw(trajectory=walk[:590])
    wire.clear()
    drawn.draw(trajectory=walk[:595])
    assert wire.nodes("SceneNodeUpdateMessage") == ["/map/trajectory/2"]
    bent = walk[:595].copy()
    bent[:100, 0] += 1.0
    wire.clear()
    drawn.draw(trajectory=bent)
    assert wire.nodes("SceneNodeUpdateMessage") == ["/map/trajectory/0"]


def test_truth_is_hidden_until_it_can_be_drawn_over_the_map(drawn: Drawn, server: viser.ViserServer) -> None:
    truth = server.scene.get_handle_by_name("/map/truth")
    assert truth is not None and truth.visible
    drawn.draw(T_map_truth=None)
    assert not truth.visible


def test_a_frame_without_points_is_drawn_as_nothing(drawn: Drawn, server: viser.ViserServer) -> None:
    result = drawn.engine.snapshot.result
    assert result is not None
    none = replace(
        result.cloud,
        **{name: getattr(result.cloud, name)[:0] for name in ("points", "labels", "intensity", "ring", "offsets_ns")},
    )
    drawn.draw(result=replace(result, index=99, cloud=none))
    scan = server.scene.get_handle_by_name(SCAN)
    assert scan is not None and not scan.visible


def test_without_a_plane_neither_disc_nor_ground_is_shown(drawn: Drawn, server: viser.ViserServer) -> None:
    result = drawn.engine.snapshot.result
    assert result is not None
    drawn.draw(result=replace(result, index=99, ground=replace(result.ground, found=False)))
    plane = server.scene.get_handle_by_name("/map/sensor/lidar/plane")
    assert plane is not None and not plane.visible


def test_people_are_not_in_the_map_unless_they_are_asked_for(drawn: Drawn, server: viser.ViserServer) -> None:
    first, *rest = drawn.engine.snapshot.chunks
    labels = first.labels.copy()
    labels[:50] = MOVING
    chunks = (replace(first, labels=labels), *rest)
    drawn.draw(View(ceilings=True), chunks=chunks)
    node = chunk_nodes(server)["/map/keyframes/0"]
    assert np.array_equal(node.points, first.points[50:].astype(np.float16)) and drawn.scene.chunks.moving == 50
    drawn.draw(View(ceilings=True, moving=True, colour_by="label"), chunks=chunks)
    node = chunk_nodes(server)["/map/keyframes/0"]
    assert len(node.points) == len(labels)
    crimson = LABEL_COLOURS[MOVING]
    assert (node.colors[:50].astype(int) <= crimson).all() and node.colors[0].argmax() == 0
