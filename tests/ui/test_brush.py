"""Tests app/ui/brush.py: clicks and rectangles mark points of the frame; marks are kept, shown and downloaded."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.mapping.painted import UNMARKED, marks, to_json, undone
from app.server.keeping import Paint, UndoPaint
from app.server.protocol import Command, Play, Seek, StepFrame
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import GROUND, NON_GROUND, StepResult
from app.ui.brush import BrushPanel
from app.ui.widgets import View
from tests.ui.conftest import clouds, page_of, user_clicks, user_sets
from tests.ui.fake_engine import FakeEngine


class Painting:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.server, self.engine, self.sent = server, engine, list[Command]()
        engine.send(StepFrame(3))
        self.panel = BrushPanel(page_of(server, self.send, lambda: engine.snapshot))

    def send(self, command: Command) -> None:
        self.sent.append(command)
        painted = self.engine.snapshot.painted
        if isinstance(command, Paint):
            self.engine.publish(painted=(*painted, command.stroke))
        elif isinstance(command, UndoPaint):
            self.engine.publish(painted=undone(painted))

    @property
    def result(self) -> StepResult:
        assert self.engine.snapshot.result is not None
        return self.engine.snapshot.result

    @property
    def marks(self) -> np.ndarray:
        return marks(self.engine.snapshot.painted).get(self.result.stamp_ns, np.full(len(self.result.cloud), UNMARKED))

    def click(self, point: int) -> None:
        """Click on a point of the scan, from 5 m above it."""
        T = self.result.T_map_imu @ self.result.state.T_imu_lidar
        at = T[:3, :3] @ self.result.cloud.points[point] + T[:3, 3]
        event = SimpleNamespace(
            ray_origin=tuple(at + np.array([0.0, 0.0, 5.0])), ray_direction=(0.0, 0.0, -1.0), client=None
        )
        self.panel.clicked(event)  # type: ignore[arg-type]


@pytest.fixture
def painting(server: viser.ViserServer, engine: FakeEngine) -> Painting:
    return Painting(server, engine)


def floor_point(painting: Painting) -> int:
    return int(np.flatnonzero(painting.result.cloud.labels == GROUND)[0])


def test_a_click_marks_all_points_within_the_radius_and_undo_takes_that_back(painting: Painting) -> None:
    point = floor_point(painting)
    painting.click(point)
    assert not painting.sent, "the brush is off"
    painting.panel.choose("ground")
    user_sets(painting.panel._radius, 0.5)
    painting.click(point)
    (command,) = painting.sent
    assert isinstance(command, Paint) and command.stroke.mark == GROUND
    points = painting.result.cloud.points
    touched = command.stroke.mask
    middle = points[touched & (np.linalg.norm(points - points[point], axis=1) < 1)].mean(axis=0)
    assert touched.any() and np.linalg.norm(points[touched] - middle, axis=1).max() < 1.0
    user_clicks(painting.panel._undo)
    assert (painting.marks == UNMARKED).all()


def test_what_is_marked_lies_over_the_scan_and_the_list_goes_to_its_frame(painting: Painting) -> None:
    painting.panel.choose("not ground")
    painting.click(floor_point(painting))
    painting.panel.draw(painting.engine.snapshot, View())
    count = int((painting.marks == NON_GROUND).sum())
    assert len(clouds(painting.server)["/map/painted"].points) == count
    assert f"{count:,} not" in painting.panel._list.content
    painting.panel._go(f"frame {painting.result.stamp_ns}", None)  # type: ignore[arg-type]
    assert painting.sent[-1] == Seek(painting.engine.snapshot.transport.frame)
    painting.engine.send(StepFrame(1))
    painting.panel.draw(painting.engine.snapshot, View())
    assert "/map/painted" not in painting.server.scene._handle_from_node_name, "another frame has no marks yet"


def test_the_list_goes_on_to_a_later_frame_after_going_back(painting: Painting) -> None:
    painting.panel.choose("ground")
    painting.click(floor_point(painting))
    word, frame = f"frame {painting.result.stamp_ns}", painting.engine.snapshot.transport.frame
    painting.engine.send(Seek(0))
    painting.panel._go(word, None)  # type: ignore[arg-type]
    assert painting.sent[-1] == Seek(frame)
    with pytest.raises(HemislamError, match="not in the trajectory yet"):
        painting.panel._go(f"frame {painting.result.stamp_ns - 1}", None)  # type: ignore[arg-type]


def test_the_rest_takes_the_engines_labels_and_marks_by_hand_stay(painting: Painting) -> None:
    point = floor_point(painting)
    painting.panel.choose("not ground")
    painting.click(point)
    by_hand = painting.marks == NON_GROUND
    user_clicks(painting.panel._rest)
    assert (painting.marks[by_hand] == NON_GROUND).all()
    engine = painting.result.cloud.labels != NON_GROUND
    assert np.array_equal(painting.marks[~by_hand] == GROUND, engine[~by_hand])
    user_clicks(painting.panel._undo)
    assert np.array_equal(painting.marks != UNMARKED, by_hand), "one press takes back what one press did"


def test_nothing_is_marked_while_it_plays(painting: Painting) -> None:
    painting.panel.choose("ground")
    snapshot = painting.engine.snapshot
    painting.engine.publish(transport=replace(snapshot.transport, playing=True))
    painting.panel.draw(painting.engine.snapshot, View())
    assert "Pause, then click" in painting.panel._why.content and painting.panel._rest.disabled
    painting.click(floor_point(painting))
    assert not painting.sent


def test_a_rectangle_marks_what_lies_in_it(painting: Painting) -> None:
    """The camera looks down from 20 m; the left half of the picture is one half of the scan."""
    painting.panel.choose("ground")
    T = painting.result.T_map_imu
    down = lie.transform(np.diag([1.0, -1.0, -1.0]), T[:3, 3] + np.array([0.0, 0.0, 20.0]))
    x, y, z, w = lie.quaternion(down[:3, :3])
    camera = SimpleNamespace(position=down[:3, 3], wxyz=np.array([w, x, y, z]), fov=2.6, aspect=1.0)
    client: Any = SimpleNamespace(camera=camera)
    event = SimpleNamespace(client=client, screen_min=(0.0, 0.0), screen_max=(0.5, 1.0))
    painting.panel._drag(event)  # type: ignore[arg-type]
    T_map_lidar = T @ painting.result.state.T_imu_lidar
    x_map = painting.result.cloud.points @ T_map_lidar[0, :3] + T_map_lidar[0, 3]
    far = np.abs(x_map - T[0, 3]) > 0.01
    assert np.array_equal((painting.marks == GROUND)[far], (x_map < T[0, 3])[far])


def test_labels_that_are_loaded_are_marked(painting: Painting) -> None:
    painting.panel.choose("ground")
    painting.click(floor_point(painting))
    before = painting.marks.copy()
    files: list[bytes] = []
    client: Any = SimpleNamespace(send_file_download=lambda name, content, save_immediately: files.append(content))
    painting.panel._download(client)
    user_clicks(painting.panel._undo)
    painting.panel._read(SimpleNamespace(content=files[0], name="walk.labels.json"), client)
    assert np.array_equal(painting.marks, before)


def test_one_press_takes_back_all_labels_that_were_loaded(painting: Painting) -> None:
    painting.panel.choose("ground")
    user_clicks(painting.panel._rest)
    content = to_json(painting.engine.snapshot.painted).encode()
    user_clicks(painting.panel._undo)
    painting.panel._read(SimpleNamespace(content=content, name="walk.labels.json"), None)  # type: ignore[arg-type]
    assert len(painting.engine.snapshot.painted) == 2
    user_clicks(painting.panel._undo)
    assert painting.engine.snapshot.painted == ()


def test_play_is_not_in_the_way_of_the_panel(painting: Painting) -> None:
    painting.engine.send(Play())
    painting.panel.draw(painting.engine.snapshot, View())
    assert "Auto-tune finds the parameters" in painting.panel._why.content
