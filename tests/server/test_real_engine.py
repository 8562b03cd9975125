"""The real engine in its process on the sample recording."""

from pathlib import Path

import numpy as np
import pytest

from app.mapping.opening import open_session
from app.sensors.presets import resolve_params
from app.server.protocol import Seek, SetParams
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.loops.service import InlineLoops
from app.slam.types import GROUND, StepResult

SAMPLE_DATA = Path(__file__).resolve().parents[2] / "sample_data"
DURATION_S = 3.0


def test_the_page_sees_exactly_what_a_headless_run_computes() -> None:
    recording = next(SAMPLE_DATA.glob("*.mcap"))
    params = resolve_params(recording, None, None, [])
    session = open_session(recording, params, 0.0, DURATION_S, loops=InlineLoops)
    positions = []
    while (result := session.advance()) is not None:
        if isinstance(result, StepResult):
            positions.append(result.T_map_imu[:3, 3])
    session.close()

    engine = EngineProcess(Setup(recording, params=params, duration_s=DURATION_S, play=True, speed=float("inf")))
    try:
        snapshot = engine.snapshot
        while not snapshot.transport.finished:
            newer = engine.wait(snapshot.revision, timeout=60)
            assert newer is not snapshot, f"nothing happens any more: {snapshot.transport} {snapshot.notices}"
            snapshot = newer
        assert snapshot.recording is not None
        np.testing.assert_array_equal(snapshot.trajectory, positions)
        assert snapshot.recording.frames == pytest.approx(len(positions), abs=2)

        before = snapshot.result
        engine.send(SetParams({"ground.sigma": 0.001}))
        while snapshot.result is before:
            snapshot = engine.wait(snapshot.revision, timeout=60)
        assert before is not None and snapshot.result is not None
        assert snapshot.result.index == before.index
        fewer, more = (np.count_nonzero(result.cloud.labels == GROUND) for result in (snapshot.result, before))
        assert fewer < more, "a narrower band about the plane holds less ground"

        engine.send(SetParams({"ground.sigma": params.ground.sigma}))
        engine.send(Seek(10))
        while snapshot.transport.frame != 10:
            snapshot = engine.wait(snapshot.revision, timeout=60)
        np.testing.assert_array_equal(snapshot.trajectory, positions[:11])
        assert snapshot.session == 1
    finally:
        engine.close()
