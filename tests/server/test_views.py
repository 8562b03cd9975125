"""The state as sent by REST: JSON can express every number."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from app.server.protocol import Progress, Snapshot, StepFrame
from app.server.views import state_view
from tests.ui.fake_engine import FakeEngine


@pytest.fixture
def snapshot() -> Snapshot:
    engine = FakeEngine()
    engine.send(StepFrame())
    return engine.snapshot


def test_the_state_holds_the_snapshots_values(snapshot: Snapshot) -> None:
    state = json.loads(state_view(replace(snapshot, session_file=Path("runs/a.hemislam"))).model_dump_json())
    assert snapshot.result is not None and snapshot.recording is not None
    assert state["recording"]["path"] == str(snapshot.recording.path)
    assert [finding["subject"] for finding in state["recording"]["findings"]] == [
        finding.subject for finding in snapshot.recording.findings
    ]
    assert state["transport"]["frame"] == snapshot.transport.frame
    assert state["frame"]["position"] == pytest.approx(snapshot.result.T_map_imu[:3, 3])
    assert state["frame"]["planarity"] == pytest.approx(snapshot.result.ground.planarity)
    assert state["keyframes"] == len(snapshot.chunks)
    assert state["session_file"] == "runs/a.hemislam"


def test_infinite_speed_is_max_and_unknown_numbers_are_null(snapshot: Snapshot) -> None:
    assert snapshot.result is not None
    ground = replace(snapshot.result.ground, planarity=math.nan)
    unknown = replace(
        snapshot,
        transport=replace(snapshot.transport, speed=math.inf),
        progress=Progress("Compiling", math.nan),
        result=replace(snapshot.result, ground=ground),
        series={},
    )
    text = state_view(unknown).model_dump_json()
    state = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert state["transport"]["speed"] == "max"
    assert state["progress"]["fraction"] is None
    assert state["frame"]["planarity"] is None and state["frame"]["error"] is None


def test_a_session_without_a_recording_has_a_state() -> None:
    state = state_view(Snapshot())
    assert (state.recording, state.frame, state.live, state.session_file) == (None, None, None, None)
